"use strict";
// Evolution in a worker: it drives its share of a generation, all cars at once, frame by frame. One
// of the workers also keeps the distribution from which the candidates come.
globalThis.stad ??= {};

{
  const SLICE = 25; // milliseconds of driving between two messages

  stad.Drivers = class {
    /**
     * Cars that drive one track at the same time, each with its own C and the same V and M.
     * @param {stad.Engine} engine
     * @param {stad.Agent} agent whose V and M they share
     */
    constructor(engine, agent) {
      [this.engine, this.agent, this.cars] = [engine, agent, []];
    }

    /**
     * Put a car for each C on the start of a track.
     * @param {Float64Array[]} candidates parameters of C
     * @param {object} track from `makeTrack`
     * @param {{patience: number, longest: number}} limits an episode ends after so many frames
     *   without a new tile, or in all
     */
    begin(candidates, track, limits) {
      this.limits = limits;
      while (this.cars.length < candidates.length) this.cars.push(this.engine.makeCar());
      this.all = candidates.map((parameters, i) => {
        this.cars[i].reset(track);
        const { vae, mdnRnn, cropBar } = this.agent;
        const driver = new stad.Agent(vae, mdnRnn, parameters, cropBar);
        return { car: this.cars[i], driver, tiles: 0, waited: 0, going: true };
      });
      this.going = this.all;
    }

    /** One frame of every car that still drives. */
    step() {
      const { patience, longest } = this.limits;
      for (const one of this.going) {
        const { car, driver } = one;
        car.step(driver.act(car.frame(driver.cropBar)));
        const reached = car.tilesVisited;
        one.waited = reached > one.tiles ? 0 : one.waited + 1;
        one.tiles = reached;
        one.going = !car.over && car.frames < longest && one.waited < patience;
      }
      this.going = this.going.filter(({ going }) => going);
    }

    /** Of each car: x, y, angle, score, and whether it still drives. */
    places() {
      const rows = this.all.map(({ car, going }) => {
        const { x, y, angle } = car.pose();
        return [x, y, angle, car.score, Number(going)];
      });
      return Float32Array.from(rows.flat());
    }

    results() {
      return this.all.map(({ car }) => ({
        score: car.score,
        frames: car.frames,
        lap: car.ending === 1,
      }));
    }
  };

  /** Let messages of the page come in; a timer would wait at least 4 ms. */
  const breathe = () =>
    new Promise((done) => {
      const { port1, port2 } = new MessageChannel();
      port1.onmessage = () => {
        port1.close();
        done();
      };
      port2.postMessage(null);
    });

  stad.EvolveWorker = class {
    constructor(post) {
      [this.post, this.paused, this.wake] = [post, false, () => {}];
      this.run = 0; // counts what the page has begun, so that an abandoned drive ends
    }

    async load({ code, facts, tables }) {
      this.engine = await stad.Engine.make(code, facts, tables);
    }

    /** V, and M if C sees its memory; the earlier cars and networks are forgotten. */
    choose({ vae, mdnRnn, cropBar }) {
      this.memoryTop ??= this.engine.memory.top;
      this.engine.memory.top = this.memoryTop;
      const eye = new stad.VAE(this.engine, vae);
      const memory = mdnRnn && new stad.MDNRNN(this.engine, mdnRnn);
      this.drivers = new stad.Drivers(this.engine, new stad.Agent(eye, memory, null, cropBar));
      this.sizes = [eye.latentSize, memory?.hiddenSize ?? 0];
    }

    /** Begin an evolution, or go on with a kept one; the state after each generation. */
    evolve({ settings, inputs, log }) {
      this.evolution = new stad.Evolution(settings, inputs);
      return [this.evolution.state(), ...this.evolution.replay(log)];
    }

    ask() {
      return this.evolution.ask();
    }

    tell({ scores }) {
      return this.evolution.tell(scores);
    }

    track({ seed }) {
      return this.engine.makeTrack(seed);
    }

    /** Drive candidates on a track; null if the page gave up on it meanwhile. */
    async drive({ points, seed, limits }) {
      const { drivers, run } = this;
      const candidates = points.map((point) => stad.expandController(point, ...this.sizes));
      drivers.begin(candidates, this.engine.makeTrack(seed), limits);
      while (drivers.going.length) {
        if (this.paused) await new Promise((done) => (this.wake = done));
        if (run !== this.run) return null;
        const end = performance.now() + SLICE;
        do drivers.step();
        while (drivers.going.length && performance.now() < end);
        this.post({ places: drivers.places() });
        await breathe();
      }
      return drivers.results();
    }

    pause({ paused }) {
      this.paused = paused;
      if (!paused) this.wake();
    }

    stop() {
      this.run += 1;
      this.pause({ paused: false });
    }
  };

  if (typeof WorkerGlobalScope !== "undefined" && self instanceof WorkerGlobalScope) {
    const worker = new stad.EvolveWorker((message) => postMessage(message));
    onmessage = async ({ data: { id, type, ...rest } }) => {
      try {
        postMessage({ id, result: await worker[type](rest) });
      } catch (error) {
        postMessage({ id, error: String(error.message ?? error) });
      }
    };
  }
}
