"use strict";
// V, the variational autoencoder: a picture -> 32 numbers z -> a picture.
// The same as stad_lab/models/vae.py, with its weights.
globalThis.stad ??= {};

stad.VAE = class {
  /** @param tensors of `data/vae_VARIANT.js`, see stad.loadTensors */
  constructor(tensors) {
    const at = (name) => [tensors[`${name}.weight`], tensors[`${name}.bias`]];
    this.down = [0, 2, 4, 6].map((layer) => stad.convolution(...at(`encoder.${layer}`)));
    this.toMoments = stad.linear(channelsLast(tensors["encoder.9.weight"]), at("encoder.9")[1]);
    // The first two layers of the decoder are linear, so the site's build has multiplied them.
    this.fromLatent = stad.linear(...at("decoder.folded"));
    this.up = [4, 6, 8].map((layer) => stad.transposedConvolution(...at(`decoder.${layer}`)));
    this.latentSize = tensors["decoder.folded.weight"].shape[1];
    this.seesDifference = tensors["encoder.0.weight"].shape[1] === 6;
    this.reconstructsDifference = tensors["decoder.8.weight"].shape[1] === 6;

    // PyTorch flattens channels first, our pictures have them last.
    function channelsLast({ shape, data }) {
      const pixels = 4;
      const channels = shape[1] / pixels;
      const ordered = new Float32Array(data.length);
      for (let o = 0; o < shape[0]; o++)
        for (let p = 0; p < pixels; p++)
          for (let c = 0; c < channels; c++)
            ordered[o * shape[1] + p * channels + c] = data[o * shape[1] + c * pixels + p];
      return { shape, data: ordered };
    }
  }

  /**
   * q(z | x) = N(mu, exp(logvar)).
   * @param {Float32Array} frame 64 x 64 x 3 in [0, 1]
   * @param {Float32Array} difference the same size in [-1, 1]; not read by variants without it
   * @returns {{mu: Float32Array, logvar: Float32Array}}
   */
  encode(frame, difference) {
    let x = this.seesDifference ? sideBySide(frame, difference) : frame;
    let size = stad.FRAME_SIZE; // 64 -> 31 -> 14 -> 6 -> 2 pixels
    for (const layer of this.down) {
      x = stad.relu(layer(x, size));
      size = Math.floor((size - 4) / 2) + 1;
    }
    const moments = this.toMoments(x);
    const logvar = moments.slice(this.latentSize).map((value) => stad.softBound(value, -10, 10));
    return { mu: moments.slice(0, this.latentSize), logvar };

    function sideBySide(first, second) {
      const both = new Float32Array(2 * first.length);
      for (let p = 0, q = 0; p < first.length; p += 3, q += 6)
        for (let c = 0; c < 3; c++) {
          both[q + c] = first[p + c];
          both[q + 3 + c] = second[p + c];
        }
      return both;
    }
  }

  /**
   * @param {Float32Array} z
   * @returns {{frame: Float32Array, difference: Float32Array | null}} in [0, 1] and [-1, 1]
   */
  decode(z) {
    let x = stad.relu(this.fromLatent(z));
    let size = 5; // 5 -> 13 -> 30 -> 64 pixels
    this.up.forEach((layer, number) => {
      x = layer(x, size);
      if (number < 2) stad.relu(x);
      size = 2 * (size - 1) + (number ? 6 : 5);
    });
    const channels = this.reconstructsDifference ? 6 : 3;
    const frame = new Float32Array(3 * stad.FRAME_SIZE ** 2);
    const difference = this.reconstructsDifference ? new Float32Array(frame.length) : null;
    for (let p = 0, q = 0; p < frame.length; p += 3, q += channels)
      for (let c = 0; c < 3; c++) {
        frame[p + c] = stad.sigmoid(x[q + c]);
        if (difference) difference[p + c] = Math.tanh(x[q + 3 + c]);
      }
    return { frame, difference };
  }

  /** Load a shipped V: "frame", "input", "output" or "input_output". */
  static async load(variant) {
    return new stad.VAE(await stad.loadTensors(`vae_${variant}`));
  }
};

/** KL divergence of N(mu, exp(logvar)) from N(0, 1) in nats, for each latent by itself. */
stad.klDivergence = ({ mu, logvar }) =>
  mu.map((mean, i) => 0.5 * (mean ** 2 + Math.exp(logvar[i]) - 1 - logvar[i]));
