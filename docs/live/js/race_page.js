"use strict";
// The page "Race the agent": draws what the worker drives, and passes on keys, touch and gamepad.

stad.start(async () => {
  const get = stad.get;
  const AGENTS = ["frame", "input", "output", "input_output", "cropped_input"];
  const [ORANGE, BLUE, PURPLE] = ["#E69F00", "#0072B2", "#CC79A7"];
  const SIZES = [32, 256]; // how many numbers z and h have
  // World units: half the field, the height of the picture, and half the road's width.
  const [FIELD, VIEW, HALF_WIDTH] = [333, 62, 6.67];
  const lacking = stad.whatIsMissing();
  if (lacking) throw new Error(lacking);

  let [track, state, before, arrived] = [null, null, null, 0];
  let [best, asleep, sleptAt] = [readBest(), false, null];
  let seen = true; // whether enough of the picture is in the window
  let still = stad.prefersStill(); // whether the demonstration before a race stands still
  let released = false; // after Esc the arrow keys are the page's, until the reader comes back
  let { seed, agent, driver } = readAddress();
  const held = new Map();
  const worker = await startWorker();
  const evolved = driver && { driver, agent };
  if (evolved) get("agent").append(new Option("evolved driver", "evolved"));
  get("agent").value = evolved ? "evolved" : agent;

  // --- The worker ---------------------------------------------------------------------------------

  async function startWorker() {
    const { workers, engine } = await stad.startWorkers("race", 1);
    workers[0].addEventListener("message", ({ data }) => receive(data));
    workers[0].postMessage({ type: "load", ...engine });
    return workers[0];
  }

  /** Give the worker the networks of an agent. */
  async function choose(name) {
    const own = driver;
    const names = [`vae_${name}`, `mdn_rnn_${name}`, `controller_${name}`];
    const [vae, mdnRnn, c] = await Promise.all(names.map(stad.loadTensors));
    if (name !== agent || own !== driver) return; // another one was chosen meanwhile
    const controller = own
      ? stad.expandController(own, ...SIZES)
      : Float64Array.from(c.parameters.data);
    const networks = { vae, mdnRnn, controller, cropBar: name.startsWith("cropped") };
    worker.postMessage({ type: "choose", networks });
  }

  let missing = false; // whether the files of the last rival did not arrive

  /** Let the chosen rival drive. */
  async function change() {
    try {
      await choose(agent);
      if (missing) stad.recover();
      missing = false;
      if (state?.phase === "attract") showStart(); // with the rival's name
    } catch (error) {
      missing = true;
      stad.fail(error);
    }
  }

  function receive(message) {
    if (message.type === "error") return stad.fail(new Error(message.text.split("\n")[0]));
    if (message.type === "track") {
      track = prepare(message.track);
      return;
    }
    [before, state, arrived] = [state, message, performance.now()];
    if (before?.phase !== state.phase) changePhase(before?.phase);
    if (message.seen) showSeen(message.seen);
    tell();
  }

  // --- Drawing ------------------------------------------------------------------------------------

  const PIECE = 20; // tiles

  /** The road in pieces, each as one path for each shade, and the whole as a line for the map. */
  function prepare(found) {
    const polygon = (path, corners, i) => {
      path.moveTo(corners[8 * i], corners[8 * i + 1]);
      for (let k = 1; k < 4; k++) path.lineTo(corners[8 * i + 2 * k], corners[8 * i + 2 * k + 1]);
      path.closePath();
    };
    const colors = ["#666", "#696969", "#6b6b6b", "#fff", "#e8342c"]; // the last two are kerbs
    const pieces = [];
    for (let first = 0; first < found.count; first += PIECE) {
      const middle = 4 * Math.min(first + PIECE / 2, found.count - 1);
      const layers = colors.map((color) => ({ color, path: new Path2D() }));
      pieces.push({ x: found.path[middle + 2], y: found.path[middle + 3], layers });
    }
    const layersOf = (tile) => pieces[Math.floor(tile / PIECE)].layers;
    for (let i = 0; i < found.count; i++) polygon(layersOf(i)[i % 3].path, found.tiles, i);
    found.kerbTiles.forEach((tile, i) =>
      polygon(layersOf(tile)[3 + (tile % 2)].path, found.kerbs, i),
    );
    const line = stad.middleLine(found);
    const [xs, ys] = [line.map(([x]) => x), line.map(([, y]) => y)];
    const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
    return { ...found, pieces, line, box };
  }

  /** A pose between the last two steps, so that the picture moves at the screen's rate. */
  function between(name, share) {
    const [now, was] = [state[name].pose, before?.[name].pose];
    if (!was || Math.hypot(now.x - was.x, now.y - was.y) > 10) return now; // a new episode
    const mix = (a, b) => a + (b - a) * share;
    const wheels = now.wheels.map((one, i) => one.map((value, k) => mix(was.wheels[i][k], value)));
    const [x, y, angle] = ["x", "y", "angle"].map((part) => mix(was[part], now[part]));
    return { x, y, angle, wheels, speed: now.speed };
  }

  function draw() {
    requestAnimationFrame(draw);
    if (!state || !track || document.hidden || !seen) return;
    const cleared = stad.clearCanvas(get("race"));
    if (!cleared) return;
    const { context, width, height } = cleared;
    const share = Math.min(1, (performance.now() - arrived) / 20);
    const cars = { you: between("you", share), rival: between("rival", share) };
    const shown = state.phase === "attract" ? cars.rival : cars.you;
    const scale = height / VIEW;
    context.save();
    context.fillStyle = "#333"; // beyond the field
    context.fillRect(0, 0, width, height);
    context.translate(width / 2, height * 0.72);
    context.scale(scale, -scale);
    context.rotate(-shown.angle);
    context.translate(-shown.x, -shown.y);
    drawGrass(context, shown, width / scale);
    const reach = Math.max(VIEW, width / scale) + 2 * PIECE; // a piece is less than 4 * PIECE long
    for (const { x, y, layers } of track.pieces) {
      if (Math.hypot(x - shown.x, y - shown.y) > reach) continue;
      for (const { color, path } of layers) {
        context.fillStyle = color;
        context.fill(path);
      }
    }
    drawStart(context);
    if (state.phase === "attract") drawCar(context, cars.rival, BLUE, 1);
    else {
      drawCar(context, cars.rival, BLUE, 0.65);
      drawCar(context, cars.you, ORANGE, 1);
    }
    context.restore();
    if (state.phase === "race" && !asleep) drawWayBack(context, width, height, cars.you);
    drawMap(context, width, height, cars);
    drawSpeed(context, width, height, shown.speed);
    if (touching && state.phase === "race") drawPads(context, width, height);
  }

  /** Where a finger steers. */
  function drawPads(context, width, height) {
    const steers = new Set(held.values());
    context.font = "600 44px system-ui, sans-serif";
    context.textAlign = "center";
    for (const [side, x, sign] of [
      ["left", 40, "\u25c0"],
      ["right", width - 40, "\u25b6"],
    ]) {
      context.fillStyle = steers.has(side) ? "#fff" : "#fff9";
      context.fillText(sign, x, height / 2);
    }
    if (!touched) drawHint(context, width, height);
  }

  /** What a finger does, until it has done it. */
  function drawHint(context, width, height) {
    context.font = "600 17px system-ui, sans-serif";
    context.fillStyle = "#000b";
    context.beginPath();
    context.roundRect(width / 2 - 130, 0.28 * height - 25, 260, 62, 10);
    context.fill();
    context.fillStyle = "#fff";
    context.fillText("Hold a side to steer.", width / 2, 0.28 * height);
    context.fillText("Gas comes by itself.", width / 2, 0.28 * height + 24);
  }

  function drawGrass(context, { x, y }, wide) {
    const [square, reach] = [FIELD / 10, Math.max(VIEW, wide)];
    context.fillStyle = "#5fae57";
    context.fillRect(-FIELD, -FIELD, 2 * FIELD, 2 * FIELD);
    context.fillStyle = "#56a44e";
    const within = (value) => Math.max(-FIELD, Math.min(FIELD, value));
    const first = (value) => Math.floor(within(value - reach) / (2 * square)) * 2 * square;
    for (let left = first(x); left < within(x + reach); left += 2 * square)
      for (let low = first(y); low < within(y + reach); low += 2 * square)
        context.fillRect(left, low, square, square);
  }

  function drawStart(context) {
    context.fillStyle = "#fff";
    const corners = track.tiles.subarray(0, 8);
    context.beginPath();
    context.moveTo(corners[0], corners[1]);
    context.lineTo(corners[2], corners[3]);
    context.lineWidth = 0.8;
    context.strokeStyle = "#fff";
    context.stroke();
  }

  // The car of Gymnasium, in world units.
  const HULL = [
    [-1.2, 2.6, 1.2, 2.6, 1.2, 2.2, -1.2, 2.2],
    [-0.3, 2.4, 0.3, 2.4, 1, 0.4, -1, 0.4],
    [0.5, 0.5, 1, 0.2, 1, -1, 0.4, -1.8, -0.4, -1.8, -1, -1, -1, 0.2, -0.5, 0.5],
    [-1, -2.4, 1, -2.4, 1, -1.8, -1, -1.8],
  ];

  function drawCar(context, { x, y, angle, wheels }, color, alpha) {
    context.globalAlpha = alpha;
    for (const [wheelX, wheelY, turn, phase] of wheels) {
      context.save();
      context.translate(wheelX, wheelY);
      context.rotate(turn);
      context.fillStyle = "#111";
      context.fillRect(-0.28, -0.54, 0.56, 1.08);
      const place = 0.54 * Math.sin(phase);
      context.fillStyle = "#999";
      if (Math.cos(phase) > 0) context.fillRect(-0.28, place - 0.08, 0.56, 0.16);
      context.restore();
    }
    context.save();
    context.translate(x, y);
    context.rotate(angle);
    context.fillStyle = color;
    for (const corners of HULL) {
      context.beginPath();
      for (let i = 0; i < corners.length; i += 2) context.lineTo(corners[i], corners[i + 1]);
      context.fill();
    }
    context.restore();
    context.globalAlpha = 1;
  }

  /** An arrow to the road, for a car that has left it. */
  function drawWayBack(context, width, height, { x, y, angle }) {
    const distances = track.line.map(([a, b]) => Math.hypot(a - x, b - y));
    const nearest = distances.indexOf(Math.min(...distances));
    if (distances[nearest] < 2 * HALF_WIDTH) return;
    const [a, b] = track.line[nearest];
    const scale = height / VIEW;
    context.save();
    context.translate(width / 2, height * 0.72);
    context.rotate(angle - Math.atan2(b - y, a - x)); // the picture turns with the car
    context.translate(7 * scale, 0);
    context.scale(scale, scale);
    context.fillStyle = "#fff";
    context.beginPath();
    for (const [right, down] of [
      [0, -0.6],
      [3, -0.6],
      [3, -1.8],
      [6, 0],
      [3, 1.8],
      [3, 0.6],
      [0, 0.6],
    ])
      context.lineTo(right, down);
    context.fill();
    context.restore();
    context.fillStyle = "#fff";
    context.font = "600 17px system-ui, sans-serif";
    context.textAlign = "center";
    const told = autopilot()
      ? "It never learned to come back."
      : "The arrow leads back to the road.";
    context.fillText(told, width / 2, 0.2 * height);
  }

  function drawMap(context, width, height, cars) {
    const side = Math.min(150, 0.3 * width);
    const [left, low, right, high] = track.box;
    const scale = (side - 16) / Math.max(right - left, high - low);
    const tall = (high - low) * scale + 16;
    const top = width < 500 ? height - tall - 8 : 8; // on a phone the scores are above
    const within = (value, size) => Math.max(5, Math.min(size - 5, value)); // off the road, too
    const place = ([x, y]) => [
      width - side - 8 + within(8 + (x - left) * scale, side),
      top + within(8 + (high - y) * scale, tall),
    ];
    context.fillStyle = "#fffd";
    context.beginPath();
    context.roundRect(width - side - 8, top, side, tall, 8);
    context.fill();
    stad.strokeLine(context, [...track.line, track.line[0]].map(place), "#777", 3);
    stad.fillDot(context, place([cars.rival.x, cars.rival.y]), 5, BLUE);
    if (state.phase !== "attract")
      stad.fillDot(context, place([cars.you.x, cars.you.y]), 5, ORANGE);
  }

  function drawSpeed(context, width, height, speed) {
    context.fillStyle = "#000a";
    context.beginPath();
    context.roundRect(8, height - 44, 132, 36, 8);
    context.fill();
    context.fillStyle = "#fff";
    context.font = "600 15px system-ui, sans-serif";
    context.textAlign = "left";
    context.fillText(`speed ${Math.round(speed)}`, 18, height - 28);
    context.fillStyle = speed > 70 ? "#ff8a5c" : "#9fd49a";
    context.fillRect(18, height - 22, Math.min(1, speed / 100) * 112, 6);
  }

  function showSeen({ frame, earlier, z, decoded }) {
    const [now, then] = [frame, earlier].map(stad.scaleFrame);
    const dreams = state.asleep && state.phase !== "over";
    stad.paintFrame(get("frame"), now);
    stad.paintDifference(get("difference"), stad.differenceImage(now, then));
    stad.paintFrame(get("decoded"), decoded);
    if (dreams) stad.paintFrame(get("dreamed"), decoded);
    stad.drawBars(get("bars"), z, 3, () => (asleep ? PURPLE : BLUE));
  }

  // --- Words --------------------------------------------------------------------------------------

  const seconds = (frames) => (frames / stad.FRAMES_A_SECOND).toFixed(1);
  const set = (id, text) => {
    if (get(id).textContent !== text) get(id).textContent = text;
  };

  function tell() {
    const { you, rival, phase } = state;
    const mine = phase === "attract" ? "0" : you.score.toFixed(0);
    set("your-score", mine);
    set("rival-score", rival.score.toFixed(0));
    const time = phase === "attract" ? rival.frames : you.frames;
    set("time", `${seconds(time)} s`);
    const driven = Math.round(100 * you.tiles);
    const name = driver ? "evolved driver" : `agent ${agent}`;
    const text = {
      attract: `The ${name} drives on track ${seed}. Touch the picture or press the up arrow to race it.`,
      race: `You race on track ${seed}: ${driven}% of the lap, ${mine} points.`,
      paused: `Paused at ${driven}% of the lap.`,
      over: `The race is over: you ${mine}, the agent ${rival.score.toFixed(0)} points.`,
    }[phase];
    stad.describe(get("race"), text);
  }

  function changePhase(was) {
    const { phase } = state;
    get("live").dataset.phase = phase;
    get("card").hidden = phase === "race";
    [get("again").hidden, get("share").hidden] = [phase === "attract", phase === "attract"];
    showPause();
    get("pause").disabled = phase === "over";
    get("eyes").disabled = get("auto").disabled = phase !== "race";
    // A disabled button would keep the keys from the page.
    if (document.activeElement.disabled) get("seat").focus({ preventScroll: true });
    if (phase !== "race" && phase !== "paused") wake();
    if (phase === "over") [endedAt, touched] = [performance.now(), false];
    if (phase === "over" || phase === "attract") setAuto(false);
    set("share", "Copy the link");
    showWay();
    if (phase === "attract") showStart();
    if (phase === "paused") showCard("Paused", "");
    if (phase === "over") showEnd();
    if (phase === "race" && was === "attract") stad.announce("The race has begun.");
  }

  function showPause() {
    const { phase } = state;
    const stands = phase === "attract" && still;
    set("pause", phase === "paused" ? "Go on" : stands ? "Play" : "Pause");
  }

  function showCard(title, text) {
    set("card-title", title);
    set("card-text", text);
  }

  /** How the reader begins or goes on, now: the last sentence of the card. */
  function showWay() {
    const keys = {
      attract: ["Touch the picture or press the up arrow", "to race it"],
      paused: ["Press P or an arrow key", "to go on"],
      over: ["Press the up arrow", "to race again"],
    }[state.phase];
    if (!keys) return set("card-way", "");
    const way = touching ? "Touch the picture" : released ? "Click the picture" : keys[0];
    set("card-way", `${way} ${keys[1]}.`);
  }

  function showStart() {
    const title = `Beat the ${driver ? "evolved driver" : "agent"}`;
    showCard(title, "It drives alone until you start. You have 20 seconds.");
  }

  function showEnd() {
    const { you, rival, helped } = state;
    const [mine, its] = [you.score, rival.score];
    const won = mine > its ? "You beat the agent!" : mine === its ? "A draw" : "The agent wins";
    const title = helped ? "The autopilot has driven" : won;
    const ways = ["The time is up", "A complete lap", "You left the field"];
    const text =
      `${ways[you.ending]} after ${seconds(you.frames)} s: ${mine.toFixed(1)} points. ` +
      `The agent has ${its.toFixed(1)}. ${recordOf(mine, helped)}`;
    showCard(title, text);
    stad.announce(`${title} ${text} ${get("card-way").textContent}`);
  }

  /** The reader's best on this track; a lap with the autopilot is none. */
  function recordOf(mine, helped) {
    const record = !helped && mine > (best[seed] ?? -Infinity);
    if (record) {
      best[seed] = mine;
      keepBest();
    }
    if (best[seed] === undefined) return "Laps with the autopilot do not count.";
    return `Your best on this track: ${best[seed].toFixed(1)}${record ? ", just now" : ""}.`;
  }

  function keepBest() {
    try {
      localStorage.setItem("stad-race", JSON.stringify(best));
    } catch {
      // without storage nothing is kept
    }
  }

  function readBest() {
    try {
      return JSON.parse(localStorage.getItem("stad-race")) ?? {};
    } catch {
      return {}; // without storage nothing is kept
    }
  }

  // --- Address, eyes and controls -----------------------------------------------------------------

  function readAddress() {
    const asked = new URLSearchParams(location.hash.slice(1));
    const [wanted, number] = [asked.get("agent"), asked.get("track")];
    const found = /^\d{1,9}$/.test(number ?? "") ? Number(number) : 5;
    const own = stad.unpackDriver(asked.get("driver") ?? "", ...SIZES); // evolved by the reader
    return { seed: found, agent: AGENTS.includes(wanted) ? wanted : "frame", driver: own };
  }

  /** Note what the reader has chosen, so that the address shows this race to others, too. */
  function writeAddress() {
    const own = driver ? `&driver=${stad.packDriver(driver)}` : "";
    history.replaceState(null, "", `#track=${seed}&agent=${agent}${own}`);
  }

  function drive(newSeed) {
    seed = newSeed;
    set("seed", String(seed));
    worker.postMessage({ type: "track", seed });
    worker.postMessage({ type: "begin", phase: "attract" });
  }

  function begin() {
    released = false;
    wake();
    setAuto(false);
    worker.postMessage({ type: "begin", phase: "race" });
    get("seat").focus({ preventScroll: true });
  }

  function toggleEyes() {
    if (state?.phase !== "race") return;
    asleep = !asleep;
    if (asleep) sleptAt = state.you.frames;
    worker.postMessage({ type: "eyes", closed: asleep });
    get("dream").hidden = !asleep;
    set("eyes", asleep ? "Open the eyes" : "Close the eyes");
    const slept = seconds(state.you.frames - (sleptAt ?? 0));
    stad.announce(asleep ? "The eyes are closed: you see the dream." : `Awake after ${slept} s.`);
  }

  const autopilot = () => get("auto").getAttribute("aria-pressed") === "true";

  function setAuto(on) {
    worker.postMessage({ type: "autopilot", on });
    get("auto").setAttribute("aria-pressed", String(on));
    set("auto", on ? "Drive yourself" : "Autopilot");
  }

  function wake() {
    if (!asleep) return;
    asleep = false;
    worker.postMessage({ type: "eyes", closed: false });
    get("dream").hidden = true;
    set("eyes", "Close the eyes");
  }

  function setPaused(paused) {
    worker.postMessage({ type: "pause", paused });
  }

  /** P or its button. Before a race it stops the demonstration. */
  function togglePause() {
    if (state.phase === "paused") return wish();
    if (state.phase !== "attract") return setPaused(true);
    still = !still;
    showPause();
    rest();
  }

  /** Nothing moves that nobody sees, or wants to see. */
  function rest() {
    worker.postMessage({ type: "rest", on: !seen || document.hidden || still });
  }

  /** Esc: the keys are the page's again. */
  function leave() {
    released = true;
    setPaused(true);
    document.activeElement.blur();
    showWay();
  }

  function sendPedals() {
    const pads = stad.readGamepad();
    const down = [...held.values()];
    if (touching && !held.has("brake")) down.push("gas"); // by itself
    worker.postMessage({ type: "pedals", held: down, easy: get("easy").checked, gamepad: pads });
  }

  /** A driver has touched a pedal: begin, or go on. */
  function wish() {
    released = false;
    if (state?.phase === "attract") begin();
    else if (state?.phase === "paused") setPaused(false);
    else if (state?.phase === "over" && performance.now() - endedAt > 1500) begin(); // not by chance
  }

  let [touching, touched, endedAt] = [false, false, 0]; // a finger drives; has steered; when it ended
  const KEYS = { ...stad.PEDAL_KEYS, Space: "brake" };
  const TAKES_KEYS = "select, textarea, input:not([type=checkbox])";

  document.addEventListener("keydown", (event) => {
    if (!state || event.ctrlKey || event.altKey || event.metaKey) return;
    const { target } = event;
    // What takes letters or arrow keys itself keeps them.
    if (target.isContentEditable || target.matches(TAKES_KEYS)) return;
    const { phase } = state;
    const inside = seen && get("seat").contains(document.activeElement);
    const racing = inside || (phase === "race" && !released);
    const free = document.activeElement === document.body; // no other control wants the keys
    if (!racing && !(seen && free)) return;
    if (event.key === "Escape") return leave();
    if (event.key.toLowerCase() === "p" && !event.repeat) return togglePause();
    if (event.key.toLowerCase() === "e" && !event.repeat) return toggleEyes();
    const pedal = KEYS[event.code];
    if (!pedal || (event.code === "Space" && target.matches("button, input"))) return;
    if (released && !racing) return;
    // The down arrow and space move the page, unless there is a race to brake in. A key that is
    // still down at the end of a race moves nothing.
    const brakes = racing && (phase === "race" || phase === "paused");
    if (pedal === "brake" && !brakes && !held.has(event.code)) return;
    event.preventDefault();
    if (event.repeat) return;
    held.set(event.code, pedal);
    touching = false;
    if (autopilot()) setAuto(false);
    wish();
    sendPedals();
  });
  addEventListener("keyup", ({ code }) => {
    if (held.delete(code)) sendPedals();
  });
  addEventListener("blur", () => {
    held.clear();
    sendPedals();
    setPaused(true);
  });
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) setPaused(true);
    rest();
  });

  new IntersectionObserver(
    (entries) => {
      seen = entries.at(-1).isIntersecting; // the newest: several may have been waiting
      if (!seen) setPaused(true);
      rest();
    },
    { threshold: 0.4 },
  ).observe(get("race"));

  // Touch: the left and the right half of the picture steer, also of a finger that slides.
  function steer(event) {
    const { left, width } = get("race").getBoundingClientRect();
    const place = (event.clientX - left) / width - 0.5;
    const side = Math.abs(place) < 0.04 ? "straight" : place < 0 ? "left" : "right";
    if (held.get(event.pointerId) === side) return;
    held.set(event.pointerId, side);
    sendPedals();
  }
  get("race").addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" || state?.phase !== "race") return; // a click begins
    event.preventDefault();
    get("race").setPointerCapture(event.pointerId);
    if (autopilot()) setAuto(false);
    touched = true;
    steer(event);
  });
  get("race").addEventListener("pointermove", (event) => held.has(event.pointerId) && steer(event));
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"])
    get("race").addEventListener(end, ({ pointerId }) => held.delete(pointerId) && sendPedals());
  const brake = get("brake");
  const press = (down) => (event) => {
    event.preventDefault();
    if (down) held.set("brake", "brake");
    else held.delete("brake");
    sendPedals();
  };
  brake.addEventListener("pointerdown", press(true));
  for (const end of ["pointerup", "pointercancel", "pointerleave"])
    brake.addEventListener(end, press(false));

  // A gamepad sends no events. When it is let go, the worker is told that, too.
  let gripped = false;
  setInterval(() => {
    const [was, now] = [gripped, stad.readGamepad() !== null];
    gripped = now;
    if (now && !was && seen) wish(); // not while it is held: the reader may have paused since
    if (now || was) sendPedals();
  }, 40);

  for (const id of ["card", "race"]) {
    get(id).addEventListener("pointerdown", ({ pointerType }) => {
      touching = pointerType !== "mouse"; // not every browser tells it with the click
    });
    get(id).addEventListener("click", () => {
      wish();
      sendPedals();
    });
  }
  get("easy").addEventListener("change", sendPedals);
  get("again").addEventListener("click", begin);
  get("another").addEventListener("click", () => {
    drive(Math.floor(Math.random() * 10000));
    writeAddress();
  });
  get("pause").addEventListener("click", togglePause);
  get("eyes").addEventListener("click", toggleEyes);
  get("auto").addEventListener("click", () => setAuto(!autopilot()));
  get("agent").addEventListener("change", ({ target }) => {
    const chosen = target.value === "evolved" ? evolved : { driver: null, agent: target.value };
    ({ driver, agent } = chosen);
    writeAddress();
    change();
  });
  get("share").addEventListener("click", async () => {
    writeAddress();
    try {
      await navigator.clipboard.writeText(location.href);
      stad.announce("The link is copied.");
      set("share", "Copied");
    } catch {
      set("share", "The link is in the address bar"); // there is no clipboard
    }
  });
  addEventListener("hashchange", () => {
    if (!location.hash.includes("track=")) return; // another place of the page
    const asked = readAddress();
    const [theirs, ours] = [asked.driver, driver].map((one) => stad.packDriver(one ?? []));
    // An evolved driver belongs to one V, and to the list of rivals.
    if (theirs !== ours || (driver && asked.agent !== agent)) return location.reload();
    if (asked.agent !== agent) {
      agent = get("agent").value = asked.agent;
      change();
    }
    if (asked.seed !== seed) drive(asked.seed);
  });

  await choose(agent);
  drive(seed);
  await new Promise((done) => {
    const timer = setInterval(() => state && track && (clearInterval(timer), done()), 10);
  });
  stad.page = { worker, get state() { return state; }, get track() { return track; } }; // prettier-ignore
  requestAnimationFrame(draw);
});
