"use strict";
// The dream: M instead of the world. As stad_lab/envs/dream.py.
//
// In each step M predicts a mixture for the next z from z, the action and its memory, and one z is
// sampled from it. V is only needed to show z as a picture.
globalThis.stad ??= {};

stad.Dream = class {
  /**
   * @param {stad.MDNRNN} mdnRnn
   * @param {ArrayLike<number>} z the first one, for example that of a real frame
   * @param {{h: Float32Array, c: Float32Array}} state M's memory of all frames before
   * @param {{uniform: () => number, normal: () => number}} random
   */
  constructor(mdnRnn, z, state, random) {
    [this.mdnRnn, this.z, this.state, this.random] = [mdnRnn, z, state, random];
    this.temperature = 1; // may be changed between steps
    this.prediction = null; // the mixture from which z was sampled
    this.frames = 0;
  }

  /** Dream one frame after an action. */
  step(action) {
    this.state = this.mdnRnn.remember(this.z, action, this.state);
    this.prediction = this.mdnRnn.mixture(this.state.h);
    this.z = this.prediction.sample(this.temperature, this.random);
    this.frames += 1;
  }
};

/** What V and M make of a recorded episode: z of each frame, and M's memory before it. */
stad.EncodedEpisode = class {
  constructor(vae, mdnRnn, drive) {
    [this.vae, this.mdnRnn, this.drive] = [vae, mdnRnn, drive];
    [this.latents, this.before] = [[], [mdnRnn.emptyState()]];
  }

  /** Number of frames that V has encoded. */
  get length() {
    return this.latents.length;
  }

  /** Encode the next frame, and remember it with its recorded action. */
  advance() {
    const t = this.length;
    const mu = this.vae.encodeMean(this.drive.bytes(t), this.drive.bytes(this.drive.earlier(t)));
    this.latents.push(mu);
    this.before.push(this.mdnRnn.remember(mu, this.drive.action(t), this.before[t]));
  }
};
