"use strict";
// "Breed a driver": the recorded run of a shipped agent, and a bet on its first lap.

stad.figure("breed", async (part) => {
  const [run, tensors] = await Promise.all([
    stad.load("evolution"),
    stad.loadTensors("evolution_tensors"),
  ]);
  const { generations } = run;
  const [facts] = run.tracks;
  const [road, paths] = stad.readPaths(tensors, 0, facts.points);
  const first = facts.laps.indexOf(true);
  let [moment, planted, wanted] = [0, false, !stad.prefersStill()];
  const chosen = () => Number(part("flag").value);

  const clock = new stad.Clock(
    () => {
      moment += 1;
      if (moment > Math.max(...facts.points) + 30) moment = 0;
    },
    draw,
    40, // points a second, four times as fast as the car
  );

  function draw() {
    const cleared = stad.clearCanvas(part("map"));
    if (!cleared) return;
    const { context, width } = cleared;
    const { place, scale } = stad.projectMap(road, width);
    stad.paintRoad(context, road, place, scale);
    const at = (i) => paths[i][Math.min(moment, paths[i].length - 1)];
    for (let i = 0; i < paths.length; i++)
      if (i !== chosen()) stad.fillDot(context, place(at(i)), 3.5, shade(i));
    const driven = paths[chosen()].slice(0, moment + 1).map(place);
    stad.strokeLine(context, driven, stad.COLORS.blue, 2);
    stad.fillDot(context, place(at(chosen())), 8, "white");
    stad.fillDot(context, place(at(chosen())), 6, stad.COLORS.blue);
    const frames = moment * run.every; // a path has a point every so many
    part("time").textContent = `${Math.min(20, frames / stad.FRAMES_A_SECOND).toFixed(0)} s`;
  }

  /** Pale for early generations, dark for late ones. */
  const shade = (i) => `hsl(28 ${40 + (50 * i) / paths.length}% ${78 - (45 * i) / paths.length}%)`;

  function show() {
    const i = chosen();
    part("flag-value").textContent = generations[i];
    part("flag").setAttribute("aria-valuetext", `generation ${generations[i]}`);
    const points = planted ? `, ${facts.returns[i].toFixed(0)} points` : "";
    const lap = planted ? (facts.laps[i] ? ", a complete lap" : ", no complete lap") : "";
    const told = `${generations[i]}${points}${lap}`;
    const drives = "recorded episodes of the start and 24 generations";
    stad.describe(part("map"), `${drives}; generation ${told}`);
    if (planted) part("summary").textContent = `Generation ${told}.`;
    draw();
  }

  part("flag").max = generations.length - 1;
  part("flag").addEventListener("input", show);
  part("plant").addEventListener("click", () => {
    if (planted) return;
    planted = true;
    const guess = generations[chosen()];
    const lap = `the first complete lap on this track is in generation ${generations[first]}`;
    const text = `You said ${guess}: ${lap}.`;
    part("answer").textContent = text;
    part("plant").setAttribute("aria-disabled", "true");
    part("play").disabled = false;
    stad.announce(text);
    moment = 0;
    if (wanted) clock.play();
    showPlay();
    show();
  });
  const showPlay = () => (part("play").textContent = clock.running ? "Pause" : "Play");
  part("play").addEventListener("click", () => {
    wanted = !clock.running;
    if (wanted && planted) clock.play();
    else clock.pause();
    showPlay();
  });
  new ResizeObserver(draw).observe(part("map"));
  show();
  return {
    run(on) {
      if (on && wanted && planted)
        clock.play(); // it would give the answer away
      else clock.pause();
      showPlay();
    },
  };
});
