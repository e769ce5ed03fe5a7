"use strict";
// The evolution of a C: CMA-ES, the tracks of each generation, and a log.
//
// All follows from the settings and the logged scores. So these are what a page keeps: told again,
// they give the same state to the last bit. Python's evolution.py does it in the same way.
globalThis.stad ??= {};

{
  const GAS = -0.5; // gas output of the first C before squashing: 27% gas
  const [FIRST_TRACK, TRACKS] = [2_000_000, 1_000_000]; // those for evolution, as in config.py

  /** A number that follows from all bits of some float64 (FNV-1a, 32 bits). */
  stad.checksum = (numbers) => {
    let sum = 0x811c9dc5;
    for (const byte of new Uint8Array(Float64Array.from(numbers).buffer))
      sum = Math.imul(sum ^ byte, 0x01000193) >>> 0;
    return sum;
  };

  stad.Evolution = class {
    /**
     * @param {{seed: number, population: number, sigma: number, decay: number, tracks: number}}
     *   settings with a `decay`, σ shrinks by this factor in each generation; 0 leaves it to CMA-ES
     * @param {number} inputs numbers that C sees
     */
    constructor(settings, inputs) {
      [this.settings, this.random] = [settings, new stad.Random(settings.seed)];
      this.first = new Float64Array(3 * inputs + 3); // weights, and the biases of three outputs
      this.first[3 * inputs + 1] = GAS;
      this.strategy = new stad.CMAES(this.first, settings.sigma, settings.population);
    }

    /** The next generation: its tracks, its candidates, and the distribution they come from. */
    ask() {
      const { settings, strategy, random } = this;
      const track = () => FIRST_TRACK + Math.floor(TRACKS * random.uniform());
      const tracks = Array.from({ length: settings.tracks }, track);
      const normals = Array.from({ length: settings.population }, () =>
        Float64Array.from({ length: strategy.n }, () => random.normal()),
      );
      this.points = strategy.ask(normals);
      return { tracks, points: this.points, ...this.state() };
    }

    /** Learn from the candidates' scores, (population, tracks). */
    tell(scores) {
      const average = (own) => own.reduce((total, one) => total + one, 0) / own.length;
      this.strategy.tell(
        this.points,
        scores.map((own) => -average(own)),
      );
      const { sigma, decay } = this.settings;
      if (decay) this.strategy.sigma = sigma * decay ** this.strategy.generation;
      return this.state();
    }

    /** Tell a kept log again, entry by entry; returns the state after each. */
    replay(log) {
      return log.map(({ scores, checksum }) => {
        this.ask();
        const state = this.tell(scores);
        if (state.checksum !== checksum)
          throw new Error("What was kept here comes from another version, so this begins afresh.");
        return state;
      });
    }

    /** The distribution: mean, sigma, and the ellipse of the two numbers moved most. */
    state() {
      const { mean, sigma } = this.strategy;
      const moved = mean.map((value, i) => Math.abs(value - this.first[i]));
      const order = moved.map((_, i) => i).sort((a, b) => moved[b] - moved[a]);
      const pair = order.slice(0, 2);
      const ellipse = this.strategy.ellipse(...pair);
      return { mean: [...mean], sigma, pair, ellipse, checksum: stad.checksum(mean) };
    }
  };
}
