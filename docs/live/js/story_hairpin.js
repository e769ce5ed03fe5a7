"use strict";
// "Where it loses": the reader marks a place of the map, then the agent drives there, live.

stad.figure("hairpin", async (part) => {
  const [NAME, TRACK, FAST] = ["input", 19, 6]; // steps of the car for one of the clock
  const [agent, engine] = await Promise.all([stad.loadDriver(NAME), stad.loadEngine()]);
  const [track, car] = [engine.makeTrack(TRACK), engine.makeCar()];
  const line = stad.middleLine(track);
  let [mark, path, lost, over, begun] = [null, [], [], false, false];
  let wanted = false; // whether the reader wants the car to drive
  car.reset(track);
  agent.reset();

  const clock = new stad.Clock(step, draw);

  function step() {
    for (let i = 0; i < FAST && !car.over; i++) {
      car.step(agent.act(car.frame()));
      const { x, y } = car.pose();
      const at = [x, y];
      const { tile, distance } = stad.nearest(line, at);
      path.push(at);
      if (distance > 1.5 * stad.HALF_WIDTH) lost.push({ tile, frame: car.frames, at });
    }
    if (car.over) finish();
  }

  function finish() {
    over = true;
    clock.pause();
    const tile = lost[0]?.tile;
    const apart = tile === undefined ? Infinity : Math.abs(tile - mark);
    const near = Math.min(apart, track.count - apart) < 20;
    const points = `${stad.fixed(car.score)} points.`;
    let text = `It stayed on the road, with ${points}`;
    if (tile !== undefined) {
      const left = `the car first left the road after ${stad.seconds(lost[0].frame)} seconds`;
      text = `${near ? "You found it" : "Elsewhere"}: ${left}, at the first red dot. ${points}`;
    }
    part("answer").textContent = text;
    stad.announce(text);
    part("race").hidden = false;
    showGo();
    draw();
  }

  function draw() {
    const cleared = stad.clearCanvas(part("map"));
    if (!cleared) return;
    const { context, width } = cleared;
    const { place, scale } = stad.projectMap(line, width);
    stad.paintRoad(context, line, place, scale);
    stad.strokeLine(context, line.slice(0, 2).map(place), "white", 2 * stad.HALF_WIDTH * scale);
    stad.strokeLine(context, path.map(place), stad.COLORS.blue, 2);
    for (const { at } of lost) stad.fillDot(context, place(at), 3, stad.COLORS.red);
    if (mark !== null) {
      const [x, y] = place(line[mark]);
      stad.fillDot(context, [x, y], 9, stad.COLORS.orange);
      context.fillStyle = "black";
      context.textAlign = "center";
      context.fillText("?", x, y + 4);
    }
    if (path.length) stad.fillDot(context, place(path.at(-1)), 6, stad.COLORS.blue);
    const points = begun ? `${stad.fixed(car.score)} points` : "";
    const state = over ? part("answer").textContent : points;
    const marked = mark === null ? "no place is marked" : `your mark is at tile ${mark}`;
    stad.describe(part("map"), `track 19 with ${track.count} tiles; ${marked}. ${state}`);
  }

  /** Put the mark on a tile, as long as the car has not started. */
  function put(tile) {
    if (begun) return;
    mark = (tile + track.count) % track.count;
    part("go").disabled = false;
    draw();
  }

  part("map").addEventListener("click", ({ clientX, clientY }) => {
    const { left, top, width } = part("map").getBoundingClientRect();
    const { place } = stad.projectMap(line, width);
    put(stad.nearest(line.map(place), [clientX - left, clientY - top]).tile);
  });
  part("map").addEventListener("keydown", (event) => {
    const way = { ArrowLeft: -5, ArrowRight: 5 }[event.key];
    if (!way || event.ctrlKey || event.altKey || event.metaKey) return; // Alt+Left goes back
    event.preventDefault();
    put((mark ?? 0) + way);
    stad.announce(`The mark is at tile ${mark}.`);
  });
  part("go").addEventListener("click", () => {
    if (over) {
      [path, lost, over] = [[], [], false];
      car.reset(track);
      agent.reset();
    }
    begun = true;
    wanted = !clock.running;
    if (wanted) clock.play();
    else clock.pause();
    showGo();
  });
  function showGo() {
    const idle = begun && !over ? "Go on" : begun ? "Let it drive again" : "Let it drive";
    part("go").textContent = clock.running ? "Pause" : idle;
  }
  new ResizeObserver(draw).observe(part("map"));
  draw();
  return {
    run(on) {
      if (on && wanted && !over) clock.play();
      else clock.pause();
      showGo();
    },
  };
});
