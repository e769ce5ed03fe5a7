"use strict";
// The race, in a worker: the true engine, the reader's car, the agent's car, and what each driver
// sees. 50 steps a second; after each the page is told where the cars are.

stad.Racer = class {
  /**
   * One car and its driver's eyes and memory.
   * @param {stad.Engine} engine
   * @param {stad.Agent} agent
   */
  constructor(engine, agent) {
    [this.car, this.agent] = [engine.makeCar(), agent];
  }

  reset(track) {
    this.car.reset(track);
    this.agent.reset();
    [this.asleep, this.frame] = [false, null];
  }

  /** What the driver sees next: z of the true frame, or of the dream while the eyes are closed. */
  see(random) {
    if (this.asleep) {
      const { mdnRnn, h } = this.agent;
      this.agent.z = Float32Array.from(mdnRnn.mixture(h).sample(1, random));
      return;
    }
    this.frame = this.car.frame(this.agent.cropBar);
    this.agent.see(this.frame);
  }

  /** Drive one frame with this action, or with C's. */
  drive(action = this.agent.control()) {
    this.agent.remember(action);
    this.car.step(action);
    return action;
  }

  report() {
    const { car } = this;
    const facts = { score: car.score, frames: car.frames, ending: car.ending };
    return { ...facts, tiles: car.tilesVisited / car.track.count, pose: car.pose() };
  }
};

stad.Race = class {
  constructor(post) {
    this.post = post;
    this.hand = new stad.Hand();
    this.random = new stad.Random(1);
    this.phase = "waiting"; // "attract": the agent drives alone; "race"; "paused"; "over"
    this.resting = false; // no car drives before the race while nobody sees it
    this.steps = 0;
    [this.pedals, this.gamepad, this.easy] = [[], null, true];
  }

  async load({ code, facts, tables }) {
    this.engine = await stad.Engine.make(code, facts, tables);
  }

  /** The tensors of an agent's networks: it drives the ghost; V and M are also the reader's. */
  choose(networks) {
    this.memoryTop ??= this.engine.memory.top;
    this.engine.memory.top = this.memoryTop; // the earlier cars and networks are forgotten
    const { engine } = this;
    this.vae = new stad.VAE(engine, networks.vae);
    const mdnRnn = new stad.MDNRNN(engine, networks.mdnRnn);
    const driver = () => new stad.Agent(this.vae, mdnRnn, networks.controller, networks.cropBar);
    [this.you, this.rival] = [0, 1].map(() => new stad.Racer(engine, driver()));
    if (this.track) this.begin("attract"); // a pause or a result is the earlier rival's
  }

  setTrack(seed) {
    this.track = this.engine.makeTrack(seed);
    this.post({ type: "track", track: this.track });
  }

  begin(phase) {
    for (const racer of [this.you, this.rival]) racer.reset(this.track);
    [this.you.autopilot, this.helped] = [false, false];
    this.hand.action.fill(0);
    [this.phase, this.due] = [phase, performance.now()];
    this.tell(true);
    this.schedule();
  }

  schedule() {
    clearTimeout(this.timer);
    const shown = this.phase === "attract" && !this.resting;
    if (!shown && this.phase !== "race") return;
    this.timer = setTimeout(() => this.tick(), Math.max(0, this.due - performance.now()));
  }

  tick() {
    const [now, interval] = [performance.now(), 1000 / stad.FRAMES_A_SECOND];
    this.due = Math.max(this.due + interval, now - 3 * interval); // a slow device never lags behind
    this.step();
    this.tell(false);
    this.schedule();
  }

  step() {
    this.steps += 1;
    const { you, rival } = this;
    if (!rival.car.over) {
      rival.see(this.random);
      rival.drive();
    } else if (this.phase === "attract") return this.begin("attract");
    if (this.phase !== "race") return;
    you.see(this.random);
    this.press(you.car.pose().speed);
    this.helped ||= you.autopilot;
    const action = you.autopilot ? undefined : this.hand.act();
    this.hand.action.set(you.drive(action));
    if (you.car.over) this.finish();
  }

  /** Pedals that are down; who drives the easy way gets gas up to a speed, a lower one in bends. */
  press(speed) {
    const { gamepad } = this;
    const turned = Math.abs(gamepad?.[0] ?? 0) > 0.5; // a stick is seldom quite straight
    const steers = turned || this.pedals.some((one) => one === "left" || one === "right");
    const fast = this.easy && speed > (steers ? 40 : 60);
    const down = this.pedals.filter((one) => !(fast && one === "gas"));
    this.hand.held = new Map(down.map((pedal, i) => [i, pedal]));
    this.hand.gamepad = gamepad && [gamepad[0], fast ? 0 : gamepad[1], gamepad[2]];
  }

  /** The reader's episode is over: the agent's is driven to its end at once. */
  finish() {
    const { rival } = this;
    while (!rival.car.over) {
      rival.see(this.random);
      rival.drive();
    }
    this.phase = "over";
    this.tell(true);
  }

  /** Tell the page what it draws; what a driver sees comes less often, as V has to decode it. */
  tell(complete) {
    const { you, rival } = this;
    const shown = this.phase === "attract" ? rival : you;
    const message = {
      type: "state",
      phase: this.phase,
      you: you.report(),
      rival: rival.report(),
      asleep: shown.asleep,
      helped: this.helped, // whether the autopilot has driven the reader's car
      action: Array.from(this.hand.action),
    };
    const often = you.asleep && this.phase === "race" ? 2 : 5; // steps
    if (shown.frame && (complete || this.steps % often === 0)) {
      const decoded = this.vae.decode(shown.agent.z);
      const { past } = shown.agent;
      const earlier = past.length > stad.STRIDE ? past[0] : shown.frame;
      message.seen = { frame: shown.frame, earlier, z: shown.agent.z, decoded: decoded.frame };
    }
    this.post(message);
  }

  pause(paused) {
    if (paused && this.phase === "race") this.phase = "paused";
    else if (!paused && this.phase === "paused")
      [this.phase, this.due] = ["race", performance.now()];
    else return;
    this.tell(false);
    this.schedule();
  }

  rest(on) {
    [this.resting, this.due] = [on, performance.now()];
    this.schedule();
  }

  closeEyes(closed) {
    if (!closed) this.you.agent.past = []; // the frames before now were not seen
    if (this.you.frame || !closed) this.you.asleep = closed;
  }
};

if (typeof WorkerGlobalScope !== "undefined" && self instanceof WorkerGlobalScope) {
  const race = new stad.Race((message) => postMessage(message));
  const acts = {
    load: (message) => race.load(message),
    choose: ({ networks }) => race.choose(networks),
    track: ({ seed }) => race.setTrack(seed),
    begin: ({ phase }) => race.begin(phase),
    pause: ({ paused }) => race.pause(paused),
    rest: ({ on }) => race.rest(on),
    eyes: ({ closed }) => race.closeEyes(closed),
    autopilot: ({ on }) => (race.you.autopilot = on),
    pedals: ({ held, gamepad, easy }) => {
      race.easy = easy;
      race.pedals = held;
      race.gamepad = gamepad;
    },
  };
  let last = Promise.resolve(); // one after the other: the engine may still be compiling
  onmessage = ({ data }) => {
    last = last
      .then(() => acts[data.type](data))
      .catch((error) => postMessage({ type: "error", text: String(error.message ?? error) }));
  };
}
