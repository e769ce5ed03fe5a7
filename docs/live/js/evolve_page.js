"use strict";
// The page "Evolve a driver": asks CMA-ES for a generation, has the workers drive it, shows it.

stad.start(async () => {
  const get = stad.get;
  const LIMITS = { patience: 50, longest: stad.LONGEST }; // frames
  const [Z, H] = [32, 256]; // how many numbers the shipped V and M have
  const INPUTS = { z: Z, h: H, both: Z + H };
  const lacking = stad.whatIsMissing();
  if (lacking) throw new Error(lacking);

  const crew = await stad.Crew.start();
  const view = new stad.EvolveView();
  // `log` is all that has to be kept: `states`, one more than generations, follow from it.
  let [settings, log, states, bet] = [null, [], [], null];
  let upcoming = null; // what CMA-ES has asked for, and nobody has driven yet
  let finished = null; // the candidates that have driven last, and where they came from
  let wanted = 0; // generations to drive
  let [starts, run] = [0, 0]; // how many fresh starts were wished for, and how many have begun
  let wished = null; // settings of the newest of them
  let [paused, idle] = [null, 0]; // since when, and for how long in this generation; milliseconds
  let [driving, beginning] = [null, null]; // promises, while this goes on
  let identity = null; // of V and M, for the file

  // --- One generation ---------------------------------------------------------------------------

  async function drive() {
    await beginning.catch(() => {}); // after one that failed the earlier evolution goes on
    const own = run;
    while (wanted > 0 && own === run) {
      wanted -= 1;
      showButtons();
      await generation(own);
    }
  }

  async function generation(own) {
    const [began, { tracks, points, ...before }] = [performance.now(), upcoming];
    idle = 0;
    const drivers = [...points, before.mean]; // the mean drives along, but does not count
    const driven = drivers.map(() => []);
    for (const [number, seed] of tracks.entries()) {
      const track = await crew.lead("track", { seed });
      if (own !== run) return;
      const name = tracks.length > 1 ? `, track ${number + 1}` : "";
      view.begin(track, drivers.length, `Generation ${log.length + 1}${name}.`);
      const found = await crew.drive(drivers, seed, LIMITS, (car, at) => view.map.move(car, at));
      if (!found || own !== run) return; // a fresh start meanwhile
      found.forEach((one, i) => driven[i].push(one));
    }
    const mean = driven.pop();
    const scores = driven.map((one) => one.map(({ score }) => score));
    const state = await crew.lead("tell", { scores });
    const next = await crew.lead("ask");
    if (own !== run) return;
    log.push({
      scores,
      mean: mean.map(({ score }) => score),
      laps: driven.filter((one) => one.some(({ lap }) => lap)).length,
      frames: [...driven, mean].flat().reduce((total, { frames }) => total + frames, 0),
      seconds: (performance.now() - began - idle) / 1000,
      checksum: state.checksum,
    });
    [finished, upcoming] = [{ points, before }, next];
    states.push(state);
    stad.evolveSettings.keep({ settings, log, bet });
    show();
    stad.announce(get("summary").textContent);
  }

  /** Begin an evolution afresh, or go on with a kept log. */
  async function begin(chosen, kept) {
    const [mine, before] = [++starts, driving];
    [wished, wanted] = [chosen, 0];
    let loaded;
    try {
      loaded = await loadNetworks(chosen);
    } catch (error) {
      if (mine !== starts) return; // another start has overtaken this one
      wished = settings;
      throw Object.assign(error, { loading: true });
    }
    if (mine !== starts) return;
    const own = ++run;
    paused = null;
    await crew.stop();
    await before;
    if (own !== run) return;
    await crew.callAll("choose", loaded.networks);
    if (own !== run) return;
    const inputs = INPUTS[chosen.sees];
    const found = await crew.lead("evolve", { settings: chosen, inputs, log: kept?.log ?? [] });
    const next = await crew.lead("ask");
    const track = await crew.lead("track", { seed: next.tracks[0] });
    if (own !== run) return;
    if (kept) bet = kept.bet ?? null;
    else if (log.length) bet = null; // it was on that evolution
    [settings, identity] = [chosen, loaded.identity];
    [log, states, upcoming, finished, saved] = [kept?.log ?? [], found, next, null, 0];
    view.begin(track, settings.population + 1, "");
    stad.evolveSettings.show(settings);
    if (!kept) stad.evolveSettings.drop(settings);
    show();
    mend();
    if (wanted > 0) go(wanted); // an impatient reader has pressed Start meanwhile
  }

  function restart(chosen, kept) {
    beginning = begin(chosen, kept);
    return beginning;
  }

  /** Go on with what was kept, or begin afresh, with the settings in the address. */
  async function open() {
    const address = location.hash;
    const kept = stad.evolveSettings.kept();
    const first = kept?.settings ?? stad.evolveSettings.fromAddress();
    try {
      await restart(first, kept);
      get("answer").textContent ||= stad.evolveSettings.ignored(address);
    } catch (error) {
      if (error.loading) throw error; // what was kept is as good as before
      await restart(first);
      get("answer").textContent = error.message;
    }
  }

  /** V and, if C sees its memory, M for the workers; and which they are, for the file. */
  async function loadNetworks({ agent, sees }) {
    const [vae, mdnRnn, c] = await Promise.all([
      stad.loadTensors(`vae_${agent}`),
      sees === "z" ? null : stad.loadTensors(`mdn_rnn_${agent}`),
      stad.load(`controller_${agent}`),
    ]);
    const networks = { vae, mdnRnn, cropBar: agent.startsWith("cropped") };
    const { variant, vae: v, mdn_rnn: m } = stad.readMetadata(await stad.decodeBase64(c));
    return { networks, identity: { variant, vae: v, mdn_rnn: m } };
  }

  // --- Pictures, words and buttons --------------------------------------------------------------

  function show() {
    const inputs = INPUTS[settings.sees];
    view.show({ log, states, finished, bet, settings, inputs });
    showButtons();
  }

  /** What failed is over when the reader goes on, or a fresh start has succeeded. */
  function mend() {
    if (get("live").dataset.state === "failed") stad.recover();
  }

  function showButtons() {
    const begun = log.length > 0 || driving !== null;
    get("run").textContent = driving && paused === null ? "Pause" : begun ? "Go on" : "Start";
    get("bet-value").textContent = bet ?? "?";
    const stops = wanted > 0 ? "Stop after this generation" : "Stops after this generation";
    get("step").textContent = driving ? stops : "One generation";
    get("bet").value = bet ?? 0;
    get("bet").setAttribute("aria-valuetext", bet ?? "no bet yet");
    get("bet").disabled = begun;
    get("download").disabled = get("race").hidden = log.length === 0;
    const { seed, agent } = settings;
    const driver = stad.packDriver(states.at(-1).mean);
    get("race").href = `race.html#track=${seed}&agent=${agent}&driver=${driver}`;
  }

  let drawn = 0;
  function draw(now) {
    requestAnimationFrame(draw);
    if (!driving || paused !== null || document.hidden) return;
    if (stad.prefersStill() && now - drawn < 1000) return; // stills instead of motion
    drawn = now;
    view.map.draw();
  }

  // --- Controls ---------------------------------------------------------------------------------

  /** Drive so many more generations. */
  function go(count) {
    mend();
    wanted = count;
    setPaused(false);
    driving ??= drive()
      .catch(stad.fail)
      .finally(() => {
        driving = null;
        showButtons();
      });
    showButtons();
  }

  function setPaused(on) {
    if (!on && paused !== null) idle += performance.now() - paused;
    paused = on ? performance.now() : null;
    crew.pause(on);
    showButtons();
  }

  let saved = 0; // generations of the driver that was downloaded last
  async function download() {
    const generation = log.length; // another one may end meanwhile
    const parameters = stad.expandController(states.at(-1).mean, Z, H);
    const facts = { ...identity, generation, seed: settings.seed };
    const link = document.createElement("a");
    link.href = URL.createObjectURL(await stad.controllerFile(parameters, facts));
    link.download = "driver.safetensors";
    link.click();
    saved = generation;
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000); // when it has been saved
  }

  get("run").addEventListener("click", () => {
    if (driving && paused === null) setPaused(true);
    else go(Infinity);
  });
  get("step").addEventListener("click", () => go(driving ? 0 : 1)); // or no more than this one
  // A driver that took minutes is not thrown away by one click.
  get("restart").addEventListener("click", ({ detail }) => {
    if (detail > 1) return; // a double click does not answer the question
    const wrong = stad.evolveSettings.wrong();
    const sure = log.length === saved || get("restart").dataset.asked === "true";
    get("warning").textContent =
      wrong ??
      (sure ? "" : `This ends your driver of generation ${log.length}. Download it first?`);
    ask(!wrong && !sure);
    get("restart").focus(); // Safari does not, and then no blur would take the question back
    if (wrong || !sure) return;
    restart(stad.evolveSettings.fromControls()).catch(stad.fail);
  });
  for (const name of stad.evolveSettings.NAMES)
    get(name).addEventListener("change", () => {
      get("warning").textContent = "Press Start afresh to apply it.";
    });
  get("restart").addEventListener("blur", () => {
    get("warning").textContent = "";
    ask(false);
  });
  function ask(on) {
    get("restart").dataset.asked = on;
    get("restart").textContent = on ? "Start afresh all the same" : "Start afresh";
  }
  get("bet").addEventListener("input", ({ target }) => {
    bet = Number(target.value) || null;
    showButtons();
  });
  get("download").addEventListener("click", () =>
    download().catch((error) => (get("answer").textContent = error.message)),
  );
  addEventListener("hashchange", () => {
    if (!stad.page) return location.reload(); // it has not started
    const { asked } = stad.evolveSettings;
    const same = stad.evolveSettings.equal(stad.evolveSettings.fromAddress(), wished);
    if (asked && !same) open().catch(stad.fail);
    else if (asked) get("warning").textContent = stad.evolveSettings.ignored(location.hash);
  });

  await open();
  stad.page = {
    view,
    get log() { return log; },
    get states() { return states; },
    get busy() { return driving !== null; },
  }; // prettier-ignore
  requestAnimationFrame(draw);
});
