"use strict";
// The page "A recorded evolution", upper part: a run of CMA-ES, on the track and in M.

stad.start(async () => {
  const AGENT = "cropped_input"; // whose run it is
  const [run, tensors, vae, mdnRnn] = await Promise.all([
    stad.load("evolution"),
    stad.loadTensors("evolution_tensors"),
    stad.VAE.load(AGENT),
    stad.MDNRNN.load(AGENT),
  ]);
  const generations = run.generations; // those whose mean controllers are here
  const [{ shape }, last] = [tensors.controllers, generations.length - 1];
  const controllers = generations.map((_, i) =>
    tensors.controllers.data.subarray(i * shape[1], (i + 1) * shape[1]),
  );
  const slider = stad.get("generation");
  let [chosen, which] = [0, 0];

  // The track

  const tracks = run.tracks.map((facts, number) => {
    const [road, paths] = stad.readPaths(tensors, number, facts.points);
    return { ...facts, road, paths };
  });
  const MARGIN = 0.06; // of the map, share of its width
  let moment = 0; // of the dot, in points of the path

  let background = null; // the road and all paths, painted once for a size and track

  function drawTrack() {
    const canvas = stad.get("track");
    const cleared = stad.clearCanvas(canvas);
    if (!cleared) return;
    const { context, width } = cleared;
    const track = tracks[which];
    const { place } = stad.projectMap(track.road, width, MARGIN * width);
    const key = [which, canvas.width].join();
    if (background?.key !== key) background = { key, picture: paintBackground(canvas, width) };
    context.drawImage(background.picture, 0, 0, width, width);
    const path = track.paths[chosen];
    const points = path.map(place);
    stad.strokeLine(context, points.slice(0, Math.ceil(moment) + 1), stad.COLORS.green, 2.5);
    stad.strokeLine(context, points, "rgba(0, 158, 115, 0.55)", 1.5);
    stad.fillDot(context, points[Math.min(points.length - 1, Math.floor(moment))], 5, "#c00000");
  }

  function paintBackground(canvas, width) {
    const picture = document.createElement("canvas");
    [picture.width, picture.height] = [canvas.width, canvas.height];
    const context = picture.getContext("2d");
    context.scale(canvas.width / width, canvas.width / width);
    const track = tracks[which];
    const { place, scale } = stad.projectMap(track.road, width, MARGIN * width);
    stad.paintRoad(context, track.road, place, scale);
    for (const path of track.paths)
      stad.strokeLine(context, path.map(place), "rgba(0, 114, 178, 0.22)", 1);
    stad.fillDot(context, place(track.road[0]), 4, "white");
    return picture;
  }

  // The learning curve

  const count = run.mean.length;
  const line = (values, color) => ({ points: values.map((value, i) => [i + 1, value]), color });
  const validation = Object.entries(run.validation).map(([n, value]) => [Number(n), value]);
  const curve = new stad.Chart(stad.get("learning"), {
    xMax: count,
    yMax: 1000,
    xLabel: "generation",
    yLabel: "points",
  });

  // The dream

  const random = new stad.Random(1);
  const starts = tensors["start.z"].shape[0];
  let [dream, start] = [null, 0];

  function beginDream() {
    const row = (name) => {
      const [, size] = tensors[name].shape;
      return tensors[name].data.slice(start * size, (start + 1) * size);
    };
    dream = new stad.Dream(
      mdnRnn,
      row("start.z"),
      { h: row("start.h"), c: row("start.c") },
      random,
    );
    drawDream();
  }

  function drawDream() {
    stad.paintFrame(stad.get("dream"), vae.decode(dream.z).frame);
    const seconds = stad.seconds(dream.frames);
    const generation = `generation ${generations[chosen]}`;
    stad.get("dream-text").textContent = `${generation}, ${seconds} s`;
    stad.describe(
      stad.get("dream"),
      `M's dream, driven by the mean driver of ${generation}, after ${seconds} seconds.`,
    );
  }

  const LONGEST = 600; // frames of a dream, then another one begins
  const clock = new stad.Clock(
    () => {
      if (dream.frames >= LONGEST) nextDream();
      dream.step(stad.control(controllers[chosen], dream.z, dream.state.h));
      moment += 1; // a tenth of a second of the drive in a fiftieth
      if (moment > tracks[which].paths[chosen].length + 60) moment = 0; // after a rest at the end
    },
    () => {
      drawDream();
      drawTrack();
    },
  );

  function nextDream() {
    start = (start + 1) % starts;
    beginDream();
  }

  // The generation

  function show() {
    const [generation, track] = [generations[chosen], tracks[which]];
    slider.value = chosen;
    stad.get("generation-value").textContent = generation;
    slider.setAttribute("aria-valuetext", `generation ${generation}`);
    const [points, frames] = [track.returns[chosen], track.frames[chosen]];
    const seconds = stad.seconds(frames, 0);
    const end = track.laps[chosen]
      ? `a complete lap in ${seconds} seconds`
      : frames < 1000
        ? `it left the field after ${seconds} seconds`
        : "no complete lap in 20 seconds";
    const driven = generation * run.episodes;
    const text = `Generation ${generation}: ${points.toFixed(0)} points, ${end}.`;
    stad.get("summary").textContent =
      driven === 0 ? text : `${text} ${driven.toLocaleString("en")} episodes were driven for it.`;
    stad.announce(text);
    stad.describe(
      stad.get("track"),
      `Track ${"AB"[which]} from above. ${text} All generations' paths are drawn faintly.`,
    );
    curve.show({
      lines: [
        line(run.worst, "#999999"),
        line(run.best, stad.COLORS.orange),
        line(run.mean, stad.COLORS.blue),
        { points: validation, color: stad.COLORS.green },
      ],
      marks: [{ x: generation, text: `generation ${generation}` }],
    });
    const shown = generation ? run.mean[generation - 1] : null;
    const [first, last] = [run.mean[0], run.mean.at(-1)].map((points) => points.toFixed(0));
    stad.describe(
      stad.get("learning"),
      `Return over ${count} generations. The average candidate's rises from ${first} to ${last}.` +
        (shown === null ? "" : ` In generation ${generation}: ${shown.toFixed(0)}.`),
    );
    drawTrack();
  }

  /** The dot goes to the start; who wants no motion sees the whole path at once. */
  function rewind() {
    moment = stad.prefersStill() ? Infinity : 0;
  }

  let timer = 0;
  function choose(number) {
    chosen = Math.min(last, Math.max(0, number));
    rewind();
    beginDream();
    show();
  }
  function stop() {
    clearInterval(timer);
    timer = 0;
    stad.get("play").textContent = "Play generations";
  }
  const setDream = (on) => {
    if (on) clock.play();
    else clock.pause();
    stad.get("dream-play").textContent = on ? "Pause driving" : "Go on driving";
  };

  slider.max = last;
  slider.addEventListener("input", () => {
    stop();
    choose(Number(slider.value));
  });
  stad.get("which").addEventListener("change", (event) => {
    which = Number(event.target.value);
    rewind();
    show();
  });
  stad.get("play").addEventListener("click", () => {
    if (timer) return stop();
    stad.get("play").textContent = "Pause generations";
    setDream(!stad.prefersStill());
    if (chosen === last) choose(0);
    timer = setInterval(() => (chosen === last ? stop() : choose(chosen + 1)), 2500);
  });
  stad.get("dream-play").addEventListener("click", () => setDream(!clock.running));
  stad.get("dream-again").addEventListener("click", nextDream);
  new ResizeObserver(drawTrack).observe(stad.get("track"));
  choose(generations.indexOf(5));
  setDream(!stad.prefersStill());
});
