"use strict";
// The page "Race the agent": draws what the worker drives, and passes on keys, touch and gamepad.

stad.start(async () => {
  const get = stad.get;
  const AGENTS = ["frame", "input", "output", "input_output", "cropped_input"];
  const SIZES = [32, 256]; // how many numbers z and h have
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

  // --- The worker -------------------------------------------------------------------------------

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

  let wishes = 0; // rivals that were wished for
  let coming = false; // whether the files of the last one are on their way
  let missing = false; // whether they did not arrive

  /** Let the chosen rival drive. */
  async function change() {
    const own = ++wishes;
    coming = true;
    showWay();
    try {
      await choose(agent);
      if (own !== wishes) return; // another one was chosen meanwhile
      if (missing) stad.recover();
      missing = false;
      if (state?.phase === "attract") showStart(); // with the rival's name
    } catch (error) {
      if (own !== wishes) return;
      missing = true;
      stad.fail(error);
    } finally {
      if (own === wishes) coming = false;
      showWay();
    }
  }

  function receive(message) {
    if (message.type === "error") return stad.fail(new Error(message.text));
    if (message.type === "track") {
      track = stad.prepareRoad(message.track);
      return;
    }
    [before, state, arrived] = [state, message, performance.now()];
    if (before?.phase !== state.phase) changePhase(before?.phase);
    if (message.seen) showSeen(message.seen);
    tell();
  }

  // --- Drawing ----------------------------------------------------------------------------------

  function draw() {
    requestAnimationFrame(draw);
    if (!state || !track || document.hidden || !seen) return;
    const share = Math.min(1, ((performance.now() - arrived) * stad.FRAMES_A_SECOND) / 1000);
    const pose = (name) => stad.poseBetween(before?.[name].pose, state[name].pose, share);
    const racing = state.phase === "race";
    const told = autopilot()
      ? "It never learned to come back."
      : "The arrow leads back to the road.";
    stad.drawRace(get("race"), {
      track,
      cars: { you: pose("you"), rival: pose("rival") },
      alone: state.phase === "attract",
      lost: racing && !asleep ? told : null,
      fingers: racing && touching ? { steers: new Set(held.values()), hint: !touched } : null,
    });
  }

  function showSeen({ frame, earlier, z, decoded }) {
    const [now, then] = [frame, earlier].map(stad.scaleFrame);
    const dreams = state.asleep && state.phase !== "over";
    stad.paintFrame(get("frame"), now);
    stad.paintDifference(get("difference"), stad.differenceImage(now, then));
    stad.paintFrame(get("decoded"), decoded);
    if (dreams) stad.paintFrame(get("dreamed"), decoded);
    stad.drawBars(get("bars"), z, 3, () => stad.COLORS[asleep ? "purple" : "blue"]);
  }

  // --- Words ------------------------------------------------------------------------------------

  const set = (id, text) => stad.setText(get(id), text);

  function tell() {
    const { you, rival, phase } = state;
    const mine = phase === "attract" ? "0" : stad.fixed(you.score);
    set("your-score", mine);
    set("rival-score", stad.fixed(rival.score));
    const time = phase === "attract" ? rival.frames : you.frames;
    set("time", `${stad.seconds(time)} s`);
    const driven = Math.round(100 * you.tiles);
    const name = driver ? "evolved driver" : `agent ${agent}`;
    const where = `on track ${seed}`;
    const text = {
      attract: `The ${name} drives ${where}. To race it, touch the picture or press the up arrow.`,
      race: `You race ${where}: ${driven}% of the lap, ${mine} points.`,
      paused: `Paused at ${driven}% of the lap.`,
      over: `The race is over: you ${mine}, the agent ${stad.fixed(rival.score)} points.`,
    }[phase];
    stad.describe(get("race"), text);
  }

  function changePhase(was) {
    const { phase } = state;
    get("live").dataset.phase = phase;
    get("card").hidden = phase === "race";
    get("again").hidden = false;
    set("again", phase === "attract" ? "Start" : "Again");
    get("share").hidden = phase === "attract";
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
    if (coming) return set("card-way", "The agent is being loaded.");
    if (missing && state?.phase !== "paused")
      return set("card-way", "It did not arrive: choose another one.");
    const keys = {
      attract: ["Touch the picture or press the up arrow", "to race it"],
      paused: ["Press P or an arrow key", "to go on"],
      over: ["Press the up arrow", "to race again"],
    }[state?.phase];
    if (!keys) return set("card-way", "");
    const click = state.phase === "paused" ? "Press P or click the picture" : "Click the picture";
    const way = touching ? "Touch the picture" : released ? click : keys[0];
    set("card-way", `${way} ${keys[1]}.`);
  }

  function showStart() {
    const title = `Beat the ${driver ? "evolved driver" : "agent"}`;
    const until = still ? "It waits until you start." : "It drives alone until you start.";
    showCard(title, `${until} You have 20 seconds.`);
  }

  function showEnd() {
    const { you, rival, helped } = state;
    const [mine, its] = [you.score, rival.score];
    const won = mine > its ? "You beat the agent!" : mine === its ? "A draw" : "The agent wins";
    const title = helped ? "The autopilot has driven" : won;
    const ways = ["The time is up", "A complete lap", "You left the field"];
    const text =
      `${ways[you.ending]} after ${stad.seconds(you.frames)} s: ${mine.toFixed(1)} points. ` +
      `The agent has ${its.toFixed(1)}. ${recordOf(mine, helped)}`;
    showCard(title, text);
    stad.announce(`${title} ${text} ${get("card-way").textContent}`);
  }

  /** The reader's best on this track; a lap with the autopilot is none. */
  function recordOf(mine, helped) {
    const { seed } = track; // of this race: the reader may have wished for another one since
    // Another tab may have driven, too.
    for (const [track, score] of Object.entries(readBest()))
      best[track] = Math.max(score, best[track] ?? score);
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

  // --- Address, eyes and controls ---------------------------------------------------------------

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
    // Files that arrive end a race; and without them another rival would drive.
    if (coming || missing) return;
    released = false;
    lookAtRace();
    wake();
    setAuto(false);
    worker.postMessage({ type: "begin", phase: "race" });
    get("seat").focus({ preventScroll: true });
  }

  /** Nobody is to drive what the window does not show. */
  function lookAtRace() {
    if (!seen) get("race").scrollIntoView({ block: "center", behavior: "instant" });
  }

  function toggleEyes() {
    if (state?.phase !== "race") return;
    asleep = !asleep;
    if (asleep) sleptAt = state.you.frames;
    setEyes();
    const slept = stad.seconds(state.you.frames - sleptAt);
    stad.announce(asleep ? "The eyes are closed: you see the dream." : `Awake after ${slept} s.`);
  }

  const autopilot = () => get("auto").getAttribute("aria-pressed") === "true";

  function setAuto(on) {
    worker.postMessage({ type: "autopilot", on });
    get("auto").setAttribute("aria-pressed", String(on));
  }

  function wake() {
    if (!asleep) return;
    asleep = false;
    setEyes();
  }

  function setEyes() {
    worker.postMessage({ type: "eyes", closed: asleep });
    get("dream").hidden = !asleep;
    set("eyes", asleep ? "Open the eyes" : "Close the eyes");
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
    showStart();
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
    if (coming || (missing && state?.phase !== "paused")) return; // as above
    released = false;
    lookAtRace();
    if (state?.phase === "attract") begin();
    else if (state?.phase === "paused") setPaused(false);
    // A key that was still held when the race ended begins no other.
    else if (state?.phase === "over" && performance.now() - endedAt > 1500) begin();
  }

  let [touching, touched, endedAt] = [false, false, 0]; // a finger drives, has steered; its end
  const KEYS = { ...stad.PEDAL_KEYS, Space: "brake" };
  const TAKES_KEYS = "select, textarea, input:not([type=checkbox])";

  function listenToKeys() {
    document.addEventListener("keydown", pressKey);
    addEventListener("keyup", ({ code }) => {
      if (held.delete(code)) sendPedals();
    });
  }

  function pressKey(event) {
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
  }

  /** A race that nobody sees or steers pauses. */
  function listenToWindow() {
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
    addEventListener("hashchange", followAddress);
  }

  /** The reader has changed the address. */
  function followAddress() {
    if (!/[#&](track|agent|driver)=/.test(location.hash)) return; // another place of the page
    if (!stad.page) return location.reload(); // it has not started
    const asked = readAddress();
    const [theirs, ours] = [asked.driver, driver].map((one) => stad.packDriver(one ?? []));
    // An evolved driver belongs to one V, and to the list of rivals.
    if (theirs !== ours || (driver && asked.agent !== agent)) return location.reload();
    if (asked.agent !== agent) {
      agent = get("agent").value = asked.agent;
      change();
    }
    if (asked.seed !== seed) drive(asked.seed);
  }

  /** A finger steers to its half of the picture, also while it slides. */
  function steer(event) {
    const { left, width } = get("race").getBoundingClientRect();
    const place = (event.clientX - left) / width - 0.5;
    const side = Math.abs(place) < 0.04 ? "straight" : place < 0 ? "left" : "right";
    if (held.get(event.pointerId) === side) return;
    held.set(event.pointerId, side);
    sendPedals();
  }

  function listenToTouch() {
    const race = get("race");
    race.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "mouse" || state?.phase !== "race") return; // a click begins
      event.preventDefault();
      race.setPointerCapture(event.pointerId);
      if (autopilot()) setAuto(false);
      touched = true;
      steer(event);
    });
    race.addEventListener("pointermove", (event) => held.has(event.pointerId) && steer(event));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"])
      race.addEventListener(end, ({ pointerId }) => held.delete(pointerId) && sendPedals());
    const press = (down) => (event) => {
      event.preventDefault();
      if (down && autopilot()) setAuto(false);
      if (down) held.set("brake", "brake");
      else held.delete("brake");
      sendPedals();
    };
    get("brake").addEventListener("pointerdown", press(true));
    for (const end of ["pointerup", "pointercancel", "pointerleave"])
      get("brake").addEventListener(end, press(false));
  }

  /** A gamepad sends no events. When it is let go, the worker is told that, too. */
  function listenToGamepad() {
    let gripped = false;
    setInterval(() => {
      const [was, now] = [gripped, stad.readGamepad() !== null];
      gripped = now;
      if (now && !was && seen) {
        // not while it is held: the reader may have paused since
        if (autopilot()) setAuto(false);
        wish();
      }
      if (now || was) sendPedals();
    }, 40);
  }

  function listenToControls() {
    for (const id of ["card", "race", "again"])
      get(id).addEventListener("pointerdown", ({ pointerType }) => {
        touching = pointerType !== "mouse"; // not every browser tells it with the click
      });
    for (const id of ["card", "race"])
      get(id).addEventListener("click", () => {
        wish();
        sendPedals();
      });
    get("easy").addEventListener("change", sendPedals);
    get("again").addEventListener("click", () => {
      begin();
      sendPedals();
    });
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
      // After a mouse the up arrow is to begin a race, not to choose another rival.
      if (!target.matches(":focus-visible")) get("seat").focus({ preventScroll: true });
    });
    get("share").addEventListener("click", share);
  }

  async function share() {
    writeAddress();
    try {
      await navigator.clipboard.writeText(location.href);
      stad.announce("The link is copied.");
      set("share", "Copied");
    } catch {
      set("share", "The link is in the address bar"); // there is no clipboard
    }
  }

  listenToKeys();
  listenToWindow();
  listenToControls(); // before the touch, which needs to know that a finger drives
  listenToTouch();
  listenToGamepad();

  await choose(agent);
  drive(seed);
  rest(); // a tab that was opened in the background has no observer yet
  await new Promise((done) => {
    const timer = setInterval(() => state && track && (clearInterval(timer), done()), 10);
  });
  stad.page = {
    worker,
    get state() {
      return state;
    },
    get track() {
      return track;
    },
  };
  requestAnimationFrame(draw);
});
