"use strict";
// M, the MDN-RNN: an LSTM that predicts the next z as a mixture of Gaussians.
// The same as stad_lab/models/mdn_rnn.py, with its weights, for one car and one step. It computes in
// double precision: a dream feeds M with its own output, which amplifies every rounding.
globalThis.stad ??= {};

stad.Mixture = class {
  /** @param {Float64Array} output of M's head: logits, means and logsigmas, (latents, mixtures) */
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
  /** @param tensors of `data/mdn_rnn_VARIANT.js`, see stad.loadTensors */
  constructor(tensors) {
    this.hiddenSize = tensors["lstm.weight_hh_l0"].shape[1];
    this.latentSize = tensors["lstm.weight_ih_l0"].shape[1] - 3; // beside the action
    this.mixtures = tensors["head.weight"].shape[0] / (3 * this.latentSize);
    const at = (weight, bias) => stad.linear(tensors[weight], tensors[bias], Float64Array);
    this.fromInput = at("lstm.weight_ih_l0", "lstm.bias_ih_l0");
    this.fromHidden = at("lstm.weight_hh_l0", "lstm.bias_hh_l0");
    this.head = at("head.weight", "head.bias");
  }

  /** The memory at the start of an episode. */
  emptyState() {
    return { h: new Float64Array(this.hiddenSize), c: new Float64Array(this.hiddenSize) };
  }

  /**
   * One step of the LSTM. The gates i, f, g and o decide what enters the memory c, what stays in
   * it, what the new content is, and what h shows of it.
   * @param {ArrayLike<number>} z
   * @param {ArrayLike<number>} action steering, gas and brake
   * @param {{h: Float64Array, c: Float64Array}} state is not changed
   */
  remember(z, action, state) {
    const size = this.hiddenSize;
    const input = new Float64Array(z.length + action.length);
    input.set(z);
    input.set(action, z.length);
    const [x, y] = [this.fromInput(input), this.fromHidden(state.h)];
    const next = this.emptyState();
    for (let j = 0; j < size; j++) {
      const enter = stad.sigmoid(x[j] + y[j]);
      const stay = stad.sigmoid(x[size + j] + y[size + j]);
      const content = Math.tanh(x[2 * size + j] + y[2 * size + j]);
      const show = stad.sigmoid(x[3 * size + j] + y[3 * size + j]);
      next.c[j] = stay * state.c[j] + enter * content;
      next.h[j] = show * Math.tanh(next.c[j]);
    }
    return next;
  }

  /** The predicted mixture for the next z, from the memory h. */
  mixture(h) {
    return new stad.Mixture(this.head(h), this.latentSize, this.mixtures);
  }

  /** Load a shipped M: "frame", "input", "output" or "input_output". */
  static async load(variant) {
    return new stad.MDNRNN(await stad.loadTensors(`mdn_rnn_${variant}`));
  }
};
