"use strict";
// The layers of V and M. All but the decoder's convolutions run in the compiled engine, as
// `run_layer` of stad_lab/inference.py. Pictures are flat, rows x columns x channels: the numbers
// of one pixel lie side by side. This script also runs in a worker, so it touches no document.
globalThis.stad ??= {};

{
  const TILE = 16; // outputs of a layer that are computed together, as inference.py

  /** Weights (inputs, outputs) and bias, filled up to whole tiles: `pack` of inference.py. */
  function pack(inputs, outputs, at, bias) {
    const tiles = Math.ceil(outputs / TILE);
    const weights = new Float32Array(tiles * inputs * TILE);
    for (let o = 0; o < outputs; o++)
      for (let i = 0; i < inputs; i++)
        weights[(Math.floor(o / TILE) * inputs + i) * TILE + (o % TILE)] = at(i, o);
    const filled = new Float32Array(tiles * TILE);
    filled.set(bias);
    return { weights, bias: filled };
  }

  /** A layer in the engine's memory: each patch of its input makes `outputs` numbers. */
  class Layer {
    constructor(engine, starts, [rows, row, run], { weights, bias }, floor) {
      const { memory } = engine;
      [this.engine, this.patches, this.outputs] = [engine, starts.length, bias.length];
      const places = [memory.put(starts), memory.put(weights), memory.put(bias)];
      const sizes = [this.patches, rows, row, run].map(BigInt);
      this.arguments = [places[0], ...sizes, places[1], places[2], BigInt(this.outputs), floor];
    }

    /** Read `inputs` numbers at the address x, and write the outputs to y. */
    run(x, inputs, y) {
      this.engine.call("layer", x, BigInt(inputs), ...this.arguments, y);
    }
  }

  /**
   * y = max(floor, W x + b), as torch.nn.Linear.
   * @param {(i: number, o: number) => number} at the weight from input i to output o
   */
  stad.denseLayer = (engine, [inputs, outputs], at, bias, floor = -Infinity) =>
    new Layer(engine, new BigInt64Array(1), [1, 0, inputs], pack(inputs, outputs, at, bias), floor);

  /**
   * A convolution of stride 2 without padding and a ReLU, as torch.nn.Conv2d.
   * @param {{shape: number[], data: Float32Array}} weight (outputs, inputs, kernel, kernel)
   * @param {{data: Float32Array}} bias
   * @param {number} size width and height of its input, in pixels
   * @param {number} channels of its input: those beyond `inputs` are filled up
   */
  stad.convolution = (engine, weight, bias, size, channels) => {
    const { shape: [outputs, inputs, kernel], data } = weight; // prettier-ignore
    const [area, side] = [kernel * kernel, Math.floor((size - kernel) / 2) + 1];
    const at = (i, o) => {
      const [pixel, channel] = [Math.floor(i / channels), i % channels];
      return channel < inputs ? data[(o * inputs + channel) * area + pixel] : 0;
    };
    const starts = new BigInt64Array(side * side);
    for (let p = 0; p < starts.length; p++)
      starts[p] = BigInt((2 * Math.floor(p / side) * size + 2 * (p % side)) * channels);
    const packed = pack(area * channels, outputs, at, bias.data);
    return new Layer(engine, starts, [kernel, size * channels, kernel * channels], packed, 0);
  };
}

/**
 * A transposed convolution of stride 2, as torch.nn.ConvTranspose2d: each pixel of the input adds
 * its copy of the kernel to the output.
 * @param {{shape: number[], data: Float32Array}} weight of shape (inputs, outputs, kernel, kernel)
 * @param {{data: Float32Array}} bias
 * @returns {(x: Float32Array, size: number) => Float32Array} for a picture of size x size pixels
 */
stad.transposedConvolution = ({ shape: [inputs, outputs, kernel], data }, { data: bias }) => {
  const [run, area] = [kernel * outputs, kernel * kernel];
  const weight = new Float32Array(data.length); // channels last
  for (let i = 0; i < inputs; i++)
    for (let o = 0; o < outputs; o++)
      for (let k = 0; k < area; k++)
        weight[(i * area + k) * outputs + o] = data[(i * outputs + o) * area + k];

  return (x, size) => {
    const side = 2 * (size - 1) + kernel;
    const y = new Float32Array(side * side * outputs);
    for (let p = 0; p < y.length; p += outputs) y.set(bias, p);
    for (let row = 0, place = 0; row < size; row++)
      for (let column = 0; column < size; column++)
        for (let i = 0; i < inputs; i++) {
          const value = x[place++];
          if (value === 0) continue; // most are, after a ReLU
          for (let k = 0, w = i * kernel * run; k < kernel; k++) {
            let p = ((2 * row + k) * side + 2 * column) * outputs;
            for (const end = p + run; p < end; p++, w++) y[p] += value * weight[w];
          }
        }
    return y;
  };
};

stad.sigmoid = (x) => 1 / (1 + Math.exp(-x));

stad.softplus = (x) => (x > 20 ? x : Math.log1p(Math.exp(x)));

/** Keep a number between two bounds smoothly; `soft_bound` of stad_lab/models/vae.py. */
stad.softBound = (value, low, high) => {
  const sharpness = 5;
  const raised = low + stad.softplus(sharpness * (value - low)) / sharpness;
  return high - stad.softplus(sharpness * (high - raised)) / sharpness;
};
