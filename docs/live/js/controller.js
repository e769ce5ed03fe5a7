"use strict";
// C, the controller: one linear layer from z and h to the action.
// The same as stad_lab/models/controller.py.
globalThis.stad ??= {};

/**
 * The action for z and M's memory h.
 * @param {Float64Array} parameters weights (3, z and h) and then 3 biases
 * @param {ArrayLike<number>} z
 * @param {ArrayLike<number>} h
 * @returns {Float32Array} steering in [-1, 1], gas and brake in [0, 1]
 */
stad.control = (parameters, z, h) => {
  const features = z.length + h.length;
  const raw = [0, 1, 2].map((output) => {
    let sum = 0;
    const row = output * features;
    for (let i = 0; i < z.length; i++) sum += parameters[row + i] * z[i];
    for (let i = 0; i < h.length; i++) sum += parameters[row + z.length + i] * h[i];
    return Math.tanh(sum + parameters[3 * features + output]);
  });
  return Float32Array.of(raw[0], (raw[1] + 1) / 2, Math.max(0, raw[2]));
};

/**
 * The parameters of a C for z and h, from those of a C that may see only one of them.
 * @param {ArrayLike<number>} point 3 weights for each number that it sees, and 3 biases
 * @param {number} z how many numbers z has
 * @param {number} h how many numbers M's memory has
 * @returns {Float64Array} the other weights are 0
 */
stad.expandController = (point, z, h) => {
  const [seen, features] = [point.length / 3 - 1, z + h];
  const begin = seen === h ? z : 0;
  const parameters = new Float64Array(3 * features + 3);
  for (let output = 0; output < 3; output++)
    for (let i = 0; i < seen; i++)
      parameters[output * features + begin + i] = point[output * seen + i];
  for (let output = 0; output < 3; output++)
    parameters[3 * features + output] = point[3 * seen + output];
  return parameters;
};

/** Load the parameters of a shipped agent's C. */
stad.loadController = async (agent) =>
  (await stad.loadTensors(`controller_${agent}`)).parameters.data;
