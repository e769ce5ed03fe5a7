"use strict";
// V, the variational autoencoder: a picture -> 32 numbers z -> a picture.
// The same as stad_lab/models/vae.py, with its weights. The encoder runs in the compiled engine.
// This script also runs in a worker, so it touches no document.
globalThis.stad ??= {};

stad.FRAME_SIZE ??= 64; // pixels, width and height of a frame

stad.VAE = class {
  /**
   * @param {stad.Engine} engine
   * @param tensors of `data/vae_VARIANT.js`, see stad.loadTensors
   */
  constructor(engine, tensors) {
    const at = (name) => [tensors[`${name}.weight`], tensors[`${name}.bias`]];
    const { memory } = engine;
    [this.engine, this.memory] = [engine, memory];
    this.channels = tensors["encoder.0.weight"].shape[1];
    this.latentSize = tensors["decoder.folded.weight"].shape[1];
    this.seesDifference = this.channels === 6;
    this.reconstructsDifference = tensors["decoder.8.weight"].shape[1] === 6;
    this.makeEncoder(at);
    // The first two layers of the decoder are linear, so the site's build has multiplied them.
    const [folded, offset] = at("decoder.folded");
    const [outputs, latents] = folded.shape;
    const weight = (i, o) => folded.data[o * latents + i];
    this.fromLatent = stad.denseLayer(engine, [latents, outputs], weight, offset.data, 0);
    this.up = [4, 6, 8].map((layer) => stad.transposedConvolution(...at(`decoder.${layer}`)));
    const largest = Math.max(...this.down.map((one) => one.patches * one.outputs), outputs);
    this.places = [memory.take(4 * largest), memory.take(4 * largest)];
    this.pictures = memory.take(4 * stad.FRAME_SIZE ** 2 * this.channels);
    this.frames = [0, 1].map(() => memory.take(3 * stad.FRAME_SIZE ** 2));
  }

  makeEncoder(at) {
    let [size, channels] = [stad.FRAME_SIZE, this.channels]; // 64 -> 31 -> 14 -> 6 -> 2 pixels
    this.down = [0, 2, 4, 6].map((part) => {
      const layer = stad.convolution(this.engine, ...at(`encoder.${part}`), size, channels);
      [size, channels] = [Math.sqrt(layer.patches), layer.outputs];
      return layer;
    });
    // PyTorch flattens channels first, our pictures have them last.
    const [{ shape, data }, bias] = at("encoder.9");
    const [pixels, inputs] = [size * size, shape[1]];
    const place = (i) => (i % channels) * pixels + Math.floor(i / channels);
    const weight = (i, o) => (place(i) < inputs ? data[o * inputs + place(i)] : 0);
    const sizes = [pixels * channels, shape[0]];
    this.down.push(stad.denseLayer(this.engine, sizes, weight, bias.data));
  }

  /**
   * The mean of q(z | x): what the agent sees.
   * @param {Uint8Array} frame 64 x 64 x 3
   * @param {Uint8Array} earlier the frame from which the difference image is taken
   * @returns {Float32Array}
   */
  encodeMean(frame, earlier) {
    const { engine, memory } = this;
    memory.write(this.frames[0], frame);
    memory.write(this.frames[1], earlier);
    engine.call("see", ...this.frames, this.pictures, BigInt(this.channels));
    let [x, inputs] = [this.pictures, stad.FRAME_SIZE ** 2 * this.channels];
    this.down.forEach((layer, i) => {
      const y = this.places[i % 2];
      layer.run(x, inputs, y);
      [x, inputs] = [y, layer.patches * layer.outputs];
    });
    return memory.read(Float32Array, x, this.latentSize).slice();
  }

  /**
   * @param {ArrayLike<number>} z
   * @returns {{frame: Float32Array, difference: Float32Array | null}} in [0, 1] and [-1, 1]
   */
  decode(z) {
    const [from, to] = this.places;
    this.memory.read(Float32Array, from, z.length).set(z);
    this.fromLatent.run(from, z.length, to);
    let x = this.memory.read(Float32Array, to, this.fromLatent.outputs).slice();
    let size = 5; // 5 -> 13 -> 30 -> 64 pixels
    this.up.forEach((layer, number) => {
      x = layer(x, size);
      if (number < 2) for (let i = 0; i < x.length; i++) if (x[i] < 0) x[i] = 0; // ReLU
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

  /** Load V of a shipped agent. */
  static async load(agent) {
    const parts = [stad.loadEngine(), stad.loadTensors(`vae_${agent}`)];
    return new stad.VAE(...(await Promise.all(parts)));
  }
};
