"use strict";
// M, the MDN-RNN: an LSTM that predicts the next z as a mixture of Gaussians.
// The same as stad_lab/models/mdn_rnn.py, with its weights, for one car and one step. Its layers
// run in the compiled engine. This script also runs in a worker, so it touches no document.
globalThis.stad ??= {};

stad.Mixture = class {
  /** @param {Float32Array} output of M's head: logits, means and logsigmas, (latents, mixtures) */
  constructor(output, latents, mixtures) {
    const size = latents * mixtures;
    this.latents = latents;
    this.mixtures = mixtures;
    this.logits = output.subarray(0, size);
    this.mean = output.subarray(size, 2 * size);
    this.logsigma = output.subarray(2 * size).map((value) => stad.softBound(value, -5, 3));
  }

  /** The weights of latent i's Gaussians at a temperature: softmax(logits / temperature). */
  weights(i, temperature = 1) {
    const logits = this.logits.subarray(i * this.mixtures, (i + 1) * this.mixtures);
    const largest = Math.max(...logits); // exp of a large number would be infinite
    const sizes = Array.from(logits, (logit) => Math.exp((logit - largest) / temperature));
    const sum = sizes.reduce((total, size) => total + size);
    return sizes.map((size) => size / sum);
  }

  /**
   * Sample z: for each latent choose one Gaussian by its weight, then draw from it.
   * @param {number} temperature 1 as trained; below 1 narrower, above 1 wider
   * @param {{uniform: () => number, normal: () => number}} random
   * @returns {Float64Array}
   */
  sample(temperature, random) {
    const z = new Float64Array(this.latents);
    for (let i = 0; i < this.latents; i++) {
      const weights = this.weights(i, temperature);
      let rest = random.uniform();
      let chosen = 0;
      while (chosen < this.mixtures - 1 && rest > weights[chosen]) rest -= weights[chosen++];
      const k = i * this.mixtures + chosen;
      z[i] = this.mean[k] + Math.exp(this.logsigma[k]) * Math.sqrt(temperature) * random.normal();
    }
    return z;
  }

  /** Standard deviation of each latent's whole mixture: how uncertain M is about it. */
  standardDeviation() {
    return Float64Array.from({ length: this.latents }, (_, i) => {
      const weights = this.weights(i);
      let [mean, square] = [0, 0];
      for (let k = 0, j = i * this.mixtures; k < this.mixtures; k++, j++) {
        mean += weights[k] * this.mean[j];
        square += weights[k] * (this.mean[j] ** 2 + Math.exp(2 * this.logsigma[j]));
      }
      return Math.sqrt(Math.max(0, square - mean ** 2));
    });
  }
};

stad.MDNRNN = class {
  /**
   * @param {stad.Engine} engine
   * @param tensors of `data/mdn_rnn_VARIANT.js`, see stad.loadTensors
   */
  constructor(engine, tensors) {
    const { memory } = engine;
    const [input, hidden] = [tensors["lstm.weight_ih_l0"], tensors["lstm.weight_hh_l0"]];
    const [seen, size] = [input.shape[1], hidden.shape[1]];
    [this.engine, this.memory, this.hiddenSize] = [engine, memory, size];
    this.latentSize = seen - 3; // beside the action
    this.mixtures = tensors["head.weight"].shape[0] / (3 * this.latentSize);
    // Both matrices of the LSTM as one, for z, the action and h side by side.
    const weight = (i, o) =>
      i < seen ? input.data[o * seen + i] : hidden.data[o * size + (i - seen)];
    const [first, second] = ["lstm.bias_ih_l0", "lstm.bias_hh_l0"].map((n) => tensors[n].data);
    const bias = first.map((value, i) => Math.fround(value + second[i]));
    this.lstm = stad.denseLayer(engine, [seen + size, 4 * size], weight, bias);
    const { shape, data } = tensors["head.weight"];
    const at = (i, o) => data[o * size + i];
    this.head = stad.denseLayer(engine, [size, shape[0]], at, tensors["head.bias"].data);
    this.seen = memory.take(4 * (seen + size));
    this.gates = memory.take(4 * Math.max(this.lstm.outputs, this.head.outputs));
    this.state = memory.take(8 * size);
  }

  /** The memory at the start of an episode. */
  emptyState() {
    return { h: new Float32Array(this.hiddenSize), c: new Float32Array(this.hiddenSize) };
  }

  /**
   * One step of the LSTM.
   * @param {ArrayLike<number>} z
   * @param {ArrayLike<number>} action steering, gas and brake
   * @param {{h: Float32Array, c: Float32Array}} state is not changed
   */
  remember(z, action, { h, c }) {
    const { engine, memory, hiddenSize: size } = this;
    const seen = memory.read(Float32Array, this.seen, z.length + 3 + size);
    seen.set(z);
    seen.set(action, z.length);
    seen.set(h, z.length + 3);
    const state = memory.read(Float32Array, this.state, 2 * size);
    state.set(h);
    state.set(c, size);
    const places = [this.seen, this.gates, this.state, BigInt(size)];
    engine.call("remember", ...this.lstm.arguments, ...places);
    const next = memory.read(Float32Array, this.state, 2 * size).slice();
    return { h: next.slice(0, size), c: next.slice(size) };
  }

  /** The predicted mixture for the next z, from the memory h. */
  mixture(h) {
    const { memory, latentSize, mixtures } = this;
    memory.read(Float32Array, this.seen, h.length).set(h);
    this.head.run(this.seen, h.length, this.gates);
    const output = memory.read(Float32Array, this.gates, 3 * latentSize * mixtures).slice();
    return new stad.Mixture(output, latentSize, mixtures);
  }

  /** Load M of a shipped agent. */
  static async load(agent) {
    const parts = [stad.loadEngine(), stad.loadTensors(`mdn_rnn_${agent}`)];
    return new stad.MDNRNN(...(await Promise.all(parts)));
  }
};
