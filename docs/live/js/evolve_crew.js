"use strict";
// The workers of an evolution: each drives a share of the candidates, the first also keeps CMA-ES.
globalThis.stad ??= {};

{
  const NUMBERS = 5; // of each car in a message: x, y, angle, score, whether it drives
  const MOST = 8; // workers

  stad.Crew = class {
    /** Start as many workers as the processor has cores. */
    static async start() {
      const crew = new stad.Crew();
      const count = Math.min(MOST, Math.max(1, navigator.hardwareConcurrency ?? 1));
      const { workers, engine } = await stad.startWorkers("evolve", count);
      [crew.workers, crew.waiting, crew.calls] = [workers, new Map(), 0];
      workers.forEach((worker, place) =>
        worker.addEventListener("message", ({ data }) => crew.receive(place, data)),
      );
      await crew.callAll("load", engine);
      return crew;
    }

    receive(place, { id, result, error, places }) {
      if (places) return this.showPlaces?.(place, places);
      const { done, fail } = this.waiting.get(id);
      this.waiting.delete(id);
      if (error) fail(new Error(error));
      else done(result);
    }

    /** Let a worker do something; the result. */
    call(place, type, message = {}) {
      const id = this.calls++;
      return new Promise((done, fail) => {
        this.waiting.set(id, { done, fail });
        this.workers[place].postMessage({ id, type, ...message });
      });
    }

    callAll(type, message) {
      return Promise.all(this.workers.map((_, place) => this.call(place, type, message)));
    }

    /** What the worker that keeps CMA-ES does. */
    lead(type, message) {
      return this.call(0, type, message);
    }

    /**
     * Drive candidates on a track, each worker its share.
     * @param {Float64Array[]} points parameters of each C
     * @param {(car: number, place: object) => void} show is told where each car is, again and again
     * @returns {Promise<{score: number, frames: number, lap: boolean}[] | null>} null if stopped
     */
    async drive(points, seed, limits, show) {
      const count = this.workers.length;
      const shares = this.workers.map((_, worker) => points.filter((_, i) => i % count === worker));
      this.showPlaces = (worker, places) => {
        for (let n = 0; n * NUMBERS < places.length; n++) {
          const [x, y, angle, score, going] = places.subarray(n * NUMBERS, (n + 1) * NUMBERS);
          show(n * count + worker, { x, y, angle, score, going: going === 1 });
        }
      };
      const driven = await Promise.all(
        shares.map((own, worker) => this.call(worker, "drive", { points: own, seed, limits })),
      );
      this.showPlaces = null;
      if (driven.includes(null)) return null;
      return points.map((_, i) => driven[i % count][Math.floor(i / count)]);
    }

    pause(paused) {
      return this.callAll("pause", { paused });
    }

    stop() {
      return this.callAll("stop", {});
    }
  };
}
