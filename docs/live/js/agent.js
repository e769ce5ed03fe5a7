"use strict";
// The agent: V sees, M remembers, C drives. As stad_lab/agent.py.
// This script also runs in a worker, so it touches no document.
globalThis.stad ??= {};

stad.STRIDE ??= 4; // k of the shipped V: frames between the two pictures of a difference image

stad.Agent = class {
  /**
   * Several agents may share V and M.
   * @param {stad.VAE} vae
   * @param {stad.MDNRNN | null} mdnRnn null if C does not see h
   * @param {Float64Array} parameters of C, for z and h, or for z alone
   * @param {boolean} cropBar whether V sees frames without the indicator bar
   */
  constructor(vae, mdnRnn, parameters, cropBar = false) {
    Object.assign(this, { vae, mdnRnn, parameters, cropBar });
    this.reset();
  }

  /** Forget the past: every episode begins with this. */
  reset() {
    [this.past, this.z] = [[], new Float32Array(this.vae.latentSize)];
    this.state = this.mdnRnn?.emptyState() ?? { h: new Float32Array(0) };
  }

  /** M's memory, which C sees beside z. */
  get h() {
    return this.state.h;
  }

  /** Encode what the car sees; the difference image is to the frame STRIDE steps before. */
  see(frame) {
    this.past.push(frame);
    if (this.past.length > stad.STRIDE + 1) this.past.shift();
    const earlier = this.past.length > stad.STRIDE ? this.past[0] : frame;
    this.z = this.vae.encodeMean(frame, earlier);
    return this.z;
  }

  /** C's action for z and h: steering -1 to 1, gas and brake 0 to 1, float32. */
  control() {
    return stad.control(this.parameters, this.z, this.h);
  }

  /** Update M's memory with z and an action. */
  remember(action) {
    if (this.mdnRnn) this.state = this.mdnRnn.remember(this.z, action, this.state);
  }

  /** One frame: encode, decide, remember; the action. */
  act(frame) {
    this.see(frame);
    const action = this.control();
    this.remember(action);
    return action;
  }
};
