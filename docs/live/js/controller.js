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

/** Load the parameters of a shipped C: "frame", "input", "output" or "input_output". */
stad.loadController = async (variant) =>
  (await stad.loadTensors(`controller_${variant}`)).parameters.data;
