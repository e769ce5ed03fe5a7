"use strict";
// The page "Drive the dream".

stad.start(async () => {
  const AGENT = "input_output"; // its V decodes a difference image, too
  const [BEGIN, SHOW_OFF, LONGEST] = [50, 100, 1000]; // frames: CarRacing zooms in until 50
  const LASTING = 10; // frames in a row that dream and drive must be apart to have diverged
  const COLORS = stad.COLORS;
  const get = stad.get;

  const drive = await stad.Drive.load();
  let [t, dream, from, seed] = [BEGIN, null, 0, 1];
  let driver = "agent";
  let shown = null; // what V has decoded of the dream or of the drive
  let untouched = !stad.prefersStill(); // the first dream begins by itself
  let request = 0; // number of the last wish to close the eyes: a newer one replaces it
  let waiting = false; // for M, to read the drive as far as a wish
  let [distances, spreads, diverged] = [[], [], null];
  let others = []; // distances of earlier dreams from the same frame
  let [vae, mdnRnn, controller, encoded] = [null, null, null, null];

  const hand = new stad.Hand();
  const clock = new stad.Clock(step, draw);
  const distanceChart = new stad.Chart(get("distance"), {
    xMax: 200,
    yMax: 0.3,
    xLabel: "frames of the dream",
    yLabel: "RMS difference",
  });
  const spreadChart = new stad.Chart(get("spread"), {
    xMax: 200,
    yMax: 1.2,
    xLabel: "frames of the dream",
    yLabel: "standard deviation",
  });
  const level = await typicalDistance();

  function step() {
    if (!dream) {
      t = t < drive.length - 1 ? t + 1 : BEGIN;
      if (untouched && t === SHOW_OFF) closeEyes();
      return;
    }
    if (dream.frames >= LONGEST) return setPlaying(false);
    const now = from + dream.frames;
    if (driver !== "hand" && stad.readGamepad()) setDriver("hand");
    let action;
    if (driver === "hand") action = hand.act();
    else if (driver === "recorded" && now < drive.length) action = drive.action(now);
    else action = stad.control(controller, dream.z, dream.state.h);
    hand.action.set(action);
    dream.step(action);
    t = Math.min(from + dream.frames, drive.length - 1);
    const spread = dream.prediction.standardDeviation();
    spreads.push([dream.frames, spread.reduce((sum, one) => sum + one, 0) / spread.length]);
  }

  function draw() {
    const frame = drive.frame(t);
    const difference = drive.difference(t);
    stad.paintFrame(get("real"), frame);
    stad.paintDifference(get("real-difference"), difference);
    const z = dream ? dream.z : encoded?.latents[t];
    shown = z ? vae.decode(z) : { frame, difference }; // V still reads: show what it will see
    stad.paintFrame(get("dream"), shown.frame);
    stad.paintDifference(get("dream-difference"), shown.difference);
    if (dream) compare(frame);
    tell();
  }

  /** Note how far the dream is from the drive, and when they have diverged. */
  function compare(frame) {
    const count = dream.frames;
    if (count && from + count < drive.length && distances.at(-1)?.[0] !== count) {
      distances.push([count, stad.rmsDistance(shown.frame, frame)]);
      // A slow device draws fewer frames than it dreams.
      const last = distances.filter(([when]) => when > count - LASTING);
      const apart = count >= LASTING && last.every(([, one]) => one > level);
      if (diverged === null && apart) {
        diverged = last[0][0];
        stad.announce(`Dream and episode have diverged, ${diverged} frames after the eyes closed.`);
      }
    }
    const xMax = Math.max(200, Math.ceil(count / 100) * 100);
    distanceChart.axes.xMax = spreadChart.axes.xMax = xMax;
    showCharts();
  }

  function showCharts() {
    distanceChart.show({
      lines: [
        ...others.map((points) => ({ points, color: "#8887" })),
        { points: distances, color: COLORS.orange },
      ],
      levels: [{ y: level, text: "1 s apart" }],
      marks: diverged === null ? [] : [{ x: diverged, text: `diverged: ${diverged}` }],
    });
    spreadChart.show({ lines: [{ points: spreads, color: COLORS.blue }] });
  }

  /** Captions and text alternatives. */
  function tell() {
    const set = (id, text) => stad.setText(get(id), text);
    const [steering, gas, brake] = dream ? hand.action : drive.action(t);
    const over = dream && from + dream.frames >= drive.length;
    const names = { agent: "C drives", hand: "you drive", recorded: "recorded actions" };
    const wheel = names[over && driver === "recorded" ? "agent" : driver]; // no more is recorded
    set("t", `${t}${over ? ", the recording has ended" : ""}`);
    set("dream-name", dream ? "The dream" : encoded?.latents[t] ? "Reconstruction" : "Seen");
    const open = waiting ? "M is processing the episode up to this frame." : "The eyes are open.";
    set("dream-note", dream ? `${stad.seconds(dream.frames)} s, ${wheel}` : open);
    set("eyes", dream ? "Open the eyes" : waiting ? "Keep them open" : "Close the eyes here");
    set("scrub-value", String(t));
    set(
      "diverged",
      diverged !== null
        ? `They diverged after ${diverged} frames (${stad.seconds(diverged)} s).`
        : dream
          ? over
            ? "The recording ended before they had diverged."
            : "They have not diverged yet."
          : "Close the eyes to see the curve.",
    );
    get("scrub").value = t;
    get("again").disabled = !dream;
    get("live").classList.toggle("asleep", Boolean(dream));
    get("bar-steering").style.transform = `scaleX(${steering})`;
    get("bar-gas").style.transform = `scaleX(${gas})`;
    get("bar-brake").style.transform = `scaleX(${brake})`;
    const [turn, press, stop] = [steering, gas, brake].map((pedal) => stad.fixed(pedal, 1));
    const pedals = `steering ${turn}, gas ${press}, brake ${stop}`;
    stad.describe(get("real"), `recorded episode, frame ${t} of ${drive.length}`);
    const distance = distances.at(-1)?.[1].toFixed(2);
    stad.describe(
      get("dream"),
      dream
        ? `the dream, frame ${dream.frames}, ${wheel}, ${pedals}` +
            (distance ? `, distance from the recorded episode ${distance}` : "")
        : encoded?.latents[t]
          ? `reconstruction of frame ${t} by V, ${pedals}`
          : `frame ${t}, which V has not read yet, ${pedals}`,
    );
    if (!dream) return;
    const at = `after ${dream.frames} frames`;
    stad.describe(
      get("distance"),
      `distance from the recorded episode ${at}: ${distance ?? "none"}`,
    );
    stad.describe(
      get("spread"),
      `spread of M's prediction ${at}: ${spreads.at(-1)?.[1].toFixed(2)}`,
    );
  }

  /** Begin a dream at the present frame, as soon as M remembers the drive up to it. */
  async function closeEyes(start = t) {
    const wish = ++request;
    if (!encoded || encoded.length <= start) {
      waiting = true;
      setPlaying(false);
      draw();
      while (!encoded || encoded.length <= start) {
        await new Promise((done) => setTimeout(done, 20));
        if (wish !== request) return;
      }
      waiting = false;
    }
    others = start === from ? [...others, distances].slice(-8) : [];
    [t, from] = [start, start];
    dream = new stad.Dream(
      mdnRnn,
      encoded.latents[from],
      encoded.before[from],
      new stad.Random(seed++),
    );
    dream.temperature = Number(get("temperature").value);
    hand.action.set(drive.action(from)); // the car goes on as it was
    [distances, spreads, diverged] = [[], [], null];
    stad.announce(`The eyes are closed at frame ${from}: the dream begins.`);
    setPlaying(true);
    draw();
  }

  function openEyes() {
    cancelWish();
    dream = null;
    if (t >= drive.length - 1) t = BEGIN;
    stad.announce(`The eyes are open at frame ${t}.`);
    draw();
  }

  /** Forget a wish to close the eyes for which M is still reading. */
  function cancelWish() {
    request++;
    waiting = false;
  }

  function setPlaying(playing) {
    if (playing) clock.play();
    else clock.pause();
    get("play").textContent = playing ? "Pause" : "Play";
  }

  function setDriver(value) {
    driver = value;
    document.querySelector(`input[name=driver][value=${value}]`).checked = true;
    if (!dream) closeEyes();
    else setPlaying(true);
  }

  /** Let V and M read the drive, in the background of a dream. */
  async function readDrive() {
    while (encoded.length < drive.length) {
      const begin = performance.now();
      encoded.advance();
      if (encoded.length === t + 1 && !clock.running) draw();
      const rest = 4 * (performance.now() - begin);
      if (dream && clock.running) await new Promise((done) => setTimeout(done, rest));
      else await stad.pause();
    }
    if (!clock.running) draw();
  }

  /** Two frames of this drive that are a second apart differ by so much on average. */
  async function typicalDistance() {
    let [sum, count, i] = [0, 0, BEGIN];
    await stad.inBackground(() => {
      sum += stad.rmsDistance(drive.frame(i), drive.frame(i + 50));
      count += 1;
      i += 7;
      return i + 50 < drive.length;
    });
    return sum / count;
  }

  // Controls
  const touched = (act) => (event) => {
    untouched = false;
    act(event);
  };
  const toggleEyes = touched((event) => {
    if (dream || waiting) return openEyes();
    closeEyes();
    if (event.detail > 0) sit(); // a click; who uses the keyboard keeps the focus
  });
  const sit = () => get("seat").focus({ preventScroll: true });
  const togglePlay = touched(() => {
    cancelWish();
    if (!clock.running && dream?.frames >= LONGEST) openEyes();
    setPlaying(!clock.running);
  });
  get("eyes").addEventListener("click", toggleEyes);
  get("play").addEventListener("click", togglePlay);
  get("again").addEventListener(
    "click",
    touched((event) => {
      closeEyes(from);
      if (event.detail > 0) sit(); // so that the arrow keys steer
    }),
  );
  get("driver").addEventListener(
    "change",
    touched(({ target }) => setDriver(target.value)),
  );
  get("scrub").addEventListener(
    "input",
    touched(({ target }) => {
      cancelWish();
      [dream, t] = [null, Number(target.value)];
      setPlaying(false);
      draw();
    }),
  );
  get("temperature").addEventListener("input", ({ target }) => {
    get("temperature-value").textContent = Number(target.value).toFixed(2);
    if (dream) dream.temperature = Number(target.value);
  });
  get("driver").addEventListener("click", ({ target, detail }) => {
    if (detail > 0 && target.value === "hand") sit();
  });
  get("seat").addEventListener("keydown", (event) => {
    if (event.target.matches("button") || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key !== " " && event.key.toLowerCase() !== "e") return;
    event.preventDefault();
    if (event.repeat) return;
    if (event.key === " ") togglePlay();
    else toggleEyes(event);
  });
  // Esc gives the arrow keys back to the page, wherever the focus is while they steer.
  document.addEventListener("keydown", (event) => {
    if (event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
    const sits = get("seat").contains(document.activeElement);
    const free = document.activeElement === document.body;
    const near = free || get("live").contains(document.activeElement);
    if (event.key.toLowerCase() === "p" && near) return togglePlay(event);
    if (event.key !== "Escape" || !(drives() || sits)) return;
    document.activeElement.blur();
    if (dream && driver === "hand") setPlaying(false);
  });
  const take = touched(() => {
    if (driver !== "hand" || !dream || !clock.running) setDriver("hand");
  });
  const drives = () =>
    dream && clock.running && (driver === "hand" || get("live").contains(document.activeElement));
  stad.listenToPedals(hand, get("seat"), take, drives);
  addEventListener("gamepadconnected", ({ gamepad }) => {
    get("gamepad").textContent =
      `Gamepad found (${gamepad.id}): its stick and triggers drive the dream.`;
  });

  // The drive plays at once; V and M are loaded and read it meanwhile.
  draw();
  showCharts();
  setPlaying(untouched);
  [vae, mdnRnn, controller] = await Promise.all([
    stad.VAE.load(AGENT),
    stad.MDNRNN.load(AGENT),
    stad.loadController(AGENT),
  ]).catch((error) => {
    untouched = false; // without networks the eyes stay open
    cancelWish();
    setPlaying(false);
    draw();
    throw error;
  });
  encoded = new stad.EncodedEpisode(vae, mdnRnn, drive);
  stad.page = {
    drive,
    vae,
    mdnRnn,
    controller,
    encoded,
    clock,
    get dream() {
      return dream;
    },
  };
  readDrive().catch(stad.fail);
});
