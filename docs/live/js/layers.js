"use strict";
// The layers of V and M. Pictures are flat Float32Arrays, rows x columns x channels: the numbers of
// one pixel lie side by side, so that the inner loops are long and read memory in order.
globalThis.stad ??= {};

/**
 * y = W x + b, as torch.nn.Linear.
 * @param {{shape: number[], data: Float32Array}} weight of shape (outputs, inputs)
 * @param {{data: Float32Array}} bias
 * @param Numbers kind of array for y
 * @returns {(x: Float32Array) => Float32Array}
 */
stad.linear = (
  { shape: [outputs, inputs], data: weight },
  { data: bias },
  Numbers = Float32Array,
) => {
  return (x) => {
    const y = new Numbers(outputs);
    for (let o = 0; o < outputs; o++) {
      const row = o * inputs;
      let sum = bias[o]; // four sums, because the processor adds in parallel
      let sum1 = 0;
      let sum2 = 0;
      let sum3 = 0;
      let i = 0;
      for (; i + 3 < inputs; i += 4) {
        sum += x[i] * weight[row + i];
        sum1 += x[i + 1] * weight[row + i + 1];
        sum2 += x[i + 2] * weight[row + i + 2];
        sum3 += x[i + 3] * weight[row + i + 3];
      }
      for (; i < inputs; i++) sum += x[i] * weight[row + i];
      y[o] = sum + sum1 + sum2 + sum3;
    }
    return y;
  };
};

/** max(0, x), in place. */
stad.relu = (x) => {
  for (let i = 0; i < x.length; i++) if (x[i] < 0) x[i] = 0;
  return x;
};

/** Weights of shape (outer, inner, kernel, kernel) as (outer, kernel, kernel, inner). */
stad.channelsLast = (data, outer, inner, kernel) => {
  const area = kernel * kernel;
  const found = new Float32Array(data.length);
  for (let o = 0; o < outer; o++)
    for (let i = 0; i < inner; i++)
      for (let k = 0; k < area; k++)
        found[(o * area + k) * inner + i] = data[(o * inner + i) * area + k];
  return found;
};

/**
 * A convolution of stride 2 without padding, as torch.nn.Conv2d.
 * @param {{shape: number[], data: Float32Array}} weight of shape (outputs, inputs, kernel, kernel)
 * @param {{data: Float32Array}} bias
 * @returns {(x: Float32Array, size: number) => Float32Array} for a picture of size x size pixels
 */
stad.convolution = ({ shape: [outputs, inputs, kernel], data }, { data: bias }) => {
  const run = kernel * inputs; // a row of the kernel: neighbours in x, and so in the weights
  const weight = stad.channelsLast(data, outputs, inputs, kernel);
  const dot = stad.dotRows(weight, run, kernel);
  return (x, size) => {
    const side = Math.floor((size - kernel) / 2) + 1;
    const y = new Float32Array(side * side * outputs);
    for (let row = 0, place = 0; row < side; row++)
      for (let column = 0; column < side; column++) {
        const corner = (2 * row * size + 2 * column) * inputs;
        for (let o = 0; o < outputs; o++)
          y[place++] = bias[o] + dot(x, corner, size * inputs, o * kernel * run);
      }
    return y;
  };
};

/** The sum of products of a kernel with the pixels below it; `run` is a multiple of 4. */
stad.dotRows = (weight, run, rows) => (x, corner, line, start) => {
  let sum = 0; // `let [a, b] = [0, 0]` would halve the speed
  let sum1 = 0;
  let sum2 = 0;
  let sum3 = 0;
  for (let row = 0, w = start; row < rows; row++)
    for (let p = corner + row * line, end = p + run; p < end; p += 4, w += 4) {
      sum += x[p] * weight[w];
      sum1 += x[p + 1] * weight[w + 1];
      sum2 += x[p + 2] * weight[w + 2];
      sum3 += x[p + 3] * weight[w + 3];
    }
  return sum + sum1 + sum2 + sum3;
};

/**
 * A transposed convolution of stride 2, as torch.nn.ConvTranspose2d: each pixel of the input adds
 * its copy of the kernel to the output.
 * @param {{shape: number[], data: Float32Array}} weight of shape (inputs, outputs, kernel, kernel)
 * @param {{data: Float32Array}} bias
 * @returns {(x: Float32Array, size: number) => Float32Array} for a picture of size x size pixels
 */
stad.transposedConvolution = ({ shape: [inputs, outputs, kernel], data }, { data: bias }) => {
  const run = kernel * outputs;
  const weight = stad.channelsLast(data, inputs, outputs, kernel);

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
