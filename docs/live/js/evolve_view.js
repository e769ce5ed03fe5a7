"use strict";
// The pictures of the page "Evolve a driver": the map with all cars, and the plane of two weights.
globalThis.stad ??= {};

{
  const get = stad.get;
  const HALF_WIDTH = 20 / 3; // of the road, world units
  const LATENTS = 32; // numbers of z
  const { orange, green, blue, red } = stad.COLORS;
  const [CAR, BEST] = [6, 10]; // pixels, lengths of cars

  stad.EvolveMap = class {
    /** @param {HTMLCanvasElement} canvas a square */
    constructor(canvas) {
      [this.canvas, this.cars, this.track, this.layer] = [canvas, [], null, null];
      new ResizeObserver(() => this.draw()).observe(canvas);
      stad.onTheme(() => this.draw());
    }

    /** A track from the engine, and so many cars at its start; the last one is the mean's. */
    begin(track, count) {
      this.track = { ...track, line: stad.middleLine(track) };
      this.cars = Array.from({ length: count }, () => ({ path: [], score: 0, going: true }));
      this.layer = null;
      this.draw();
    }

    /** Where a car is now. */
    move(number, { x, y, angle, score, going }) {
      const car = this.cars[number];
      if (!car) return;
      const last = car.path.at(-1);
      if (!last || Math.hypot(x - last[0], y - last[1]) > 1) {
        car.path.push([x, y]);
        if (this.layer) this.extend(car);
      }
      Object.assign(car, { at: [x, y], angle, score, going });
    }

    /** The candidate with the highest score so far; the mean is none. */
    get best() {
      const candidates = this.cars.slice(0, -1);
      return candidates.reduce((best, car) => (car.score > best.score ? car : best), candidates[0]);
    }

    draw() {
      const cleared = stad.clearCanvas(this.canvas);
      if (!cleared || !this.track) return;
      const { context, width } = cleared;
      const key = [this.canvas.width, stad.color("--color-background-primary")].join();
      if (this.layer?.key !== key) this.paint(key, width);
      context.drawImage(this.layer.picture, 0, 0, width, width);
      const [mean, best] = [this.cars.at(-1), this.best];
      for (const car of this.cars)
        if (car.at && car !== mean && car !== best)
          this.drawCar(context, car, CAR, car.going ? blue : "#8c8c8c");
      for (const [car, color] of [
        [mean, green],
        [best, orange],
      ]) {
        stad.strokeLine(context, car.path.map(this.layer.place), color, 2);
        if (car.at) this.drawCar(context, car, BEST, color, "white");
      }
    }

    /** The road and the paths so far, on a canvas of their own: only new pieces are added to it. */
    paint(key, width) {
      const picture = document.createElement("canvas");
      [picture.width, picture.height] = [this.canvas.width, this.canvas.width];
      const context = picture.getContext("2d");
      context.scale(picture.width / width, picture.width / width);
      const { line } = this.track;
      const { place, scale } = stad.projectMap(line, width, 0.06 * width);
      context.lineJoin = "round";
      const road = [...line, line[0]].map(place);
      stad.strokeLine(context, road, "#8a8a8a", 2 * HALF_WIDTH * scale);
      stad.fillDot(context, road[0], 4, "white");
      this.layer = { key, picture, context, place };
      for (const car of this.cars) this.extend(car, car.path.length);
    }

    /** Add the last piece of a car's path, or all of it. */
    extend(car, count = 2) {
      const { context, place } = this.layer;
      stad.strokeLine(context, car.path.slice(-count).map(place), "rgba(0, 60, 110, 0.3)", 1);
    }

    drawCar(context, { at, angle }, length, color, edge) {
      const [x, y] = this.layer.place(at);
      context.save();
      context.translate(x, y);
      context.rotate(-angle);
      context.beginPath();
      context.moveTo(0, -length);
      context.lineTo(0.6 * length, 0.8 * length);
      context.lineTo(-0.6 * length, 0.8 * length);
      context.closePath();
      context.fillStyle = color;
      context.fill();
      if (edge) {
        context.strokeStyle = edge;
        context.lineWidth = 1.5;
        context.stroke();
      }
      context.restore();
    }
  };

  /** The candidates in the plane of the two weights that the mean had moved most before. */
  function drawPlane(canvas, { states, finished, scores }) {
    const cleared = stad.clearCanvas(canvas);
    if (!cleared) return;
    const { context, width, height } = cleared;
    const { pair, mean, ellipse } = finished?.before ?? states.at(-1);
    const flat = (point) => pair.map((place) => point[place]);
    const [path, points] = [
      states.map((state) => flat(state.mean)),
      finished?.points.map(flat) ?? [],
    ];
    const around = 2 * ellipse.long;
    const edges = [
      ...path,
      ...points,
      ...[around, -around].map((r) => flat(mean).map((v) => v + r)),
    ];
    const [xs, ys] = [0, 1].map((axis) => edges.map((point) => point[axis]));
    const [left, right, low, high] = [
      Math.min(...xs),
      Math.max(...xs),
      Math.min(...ys),
      Math.max(...ys),
    ];
    const scale = 0.92 * Math.min(width / (right - left), height / (high - low));
    const place = ([x, y]) => [
      width / 2 + scale * (x - (left + right) / 2),
      height / 2 - scale * (y - (low + high) / 2),
    ];
    stad.strokeLine(context, path.map(place), green, 2);
    const order = scores.map((_, i) => i).sort((a, b) => scores[b] - scores[a]);
    order.forEach((i, rank) => {
      const color = rank === 0 ? orange : rank < order.length / 2 ? blue : "#8c8c8c";
      if (points[i]) stad.fillDot(context, place(points[i]), 4, color);
    });
    context.strokeStyle = red;
    context.lineWidth = 2.5;
    context.beginPath();
    const [x, y] = place(flat(mean));
    context.ellipse(x, y, ellipse.long * scale, ellipse.short * scale, -ellipse.angle, 0, 7);
    context.stroke();
    stad.fillDot(context, [x, y], 4, red);
    stad.fillDot(context, place(path.at(-1)), 5, green);
  }

  /** What a place in C's parameters means, in words. */
  function nameWeight(place, inputs, sees) {
    const outputs = ["steering", "gas", "brake"];
    if (place >= 3 * inputs) return `bias of the ${outputs[place - 3 * inputs]}`;
    const [output, input] = [Math.floor(place / inputs), place % inputs];
    const ofZ = sees === "z" || (sees === "both" && input < LATENTS);
    const number = ofZ ? `z ${input}` : `h ${sees === "h" ? input : input - LATENTS}`;
    return `${number} to ${outputs[output]}`;
  }

  const average = (values) => values.reduce((total, one) => total + one, 0) / values.length;

  stad.EvolveView = class {
    constructor() {
      this.map = new stad.EvolveMap(get("map"));
      const axes = { xMax: 20, xLabel: "generation" };
      this.curve = new stad.Chart(get("learning"), { ...axes, yMax: 1000, yLabel: "points" });
      this.steps = new stad.Chart(get("steps"), { ...axes, yMax: 0.2, yLabel: "σ" });
      new ResizeObserver(() => this.drawPlane()).observe(get("plane"));
      stad.onTheme(() => this.drawPlane());
    }

    /** A track is driven next by so many; `number` says which of several tracks it is, or 0. */
    begin(track, count, number) {
      this.map.begin(track, count);
      get("which").textContent = number ? ` Track ${number}.` : "";
    }

    /** Show the evolution after a generation: the curves, the plane and the words. */
    show(shown) {
      const rows = shown.log.map(({ scores }) => scores.map(average));
      this.shown = {
        ...shown,
        scores: rows.at(-1) ?? [],
        lap: shown.log.findIndex(({ laps }) => laps) + 1,
      };
      this.showCurves(rows);
      this.showWords(rows);
      this.drawPlane();
      this.map.draw();
    }

    showCurves(rows) {
      const { log, states, lap } = this.shown;
      const line = (values, color) => ({ points: values.map((value, i) => [i + 1, value]), color });
      this.curve.axes.xMax = this.steps.axes.xMax = Math.max(20, log.length);
      this.curve.show({
        lines: [
          line(
            rows.map((row) => Math.max(0, Math.min(...row))),
            "#999999",
          ),
          line(
            rows.map((row) => Math.max(...row)),
            orange,
          ),
          line(rows.map(average), blue),
          line(
            log.map(({ mean }) => average(mean)),
            green,
          ),
        ],
        marks: lap ? [{ x: lap, text: "first lap" }] : [],
      });
      const sigmas = states.map(({ sigma }) => sigma);
      this.steps.axes.yMax = 1.3 * Math.max(...sigmas);
      this.steps.show({ lines: [{ points: sigmas.map((sigma, i) => [i, sigma]), color: red }] });
    }

    showWords(rows) {
      const { log, states, lap, bet, settings, workers } = this.shown;
      const [number, last, sigma] = [log.length, log.at(-1), states.at(-1).sigma.toFixed(3)];
      const total = (name, count) => log.slice(0, count).reduce((sum, one) => sum + one[name], 0);
      const [best, middle] = [Math.max, (...row) => average(row)].map((f) => number && f(...rows.at(-1)).toFixed(0)); // prettier-ignore
      const text = number
        ? `Generation ${number}: best ${best} points, average ${middle}, mean driver ` +
          `${average(last.mean).toFixed(0)}. Whole laps: ${last.laps} of ${settings.population}. σ ${sigma}.`
        : "Nobody has driven yet.";
      get("summary").textContent = text;
      get("driven").textContent = `${total("frames").toLocaleString("en")} frames in ${total("seconds").toFixed(0)} seconds, on ${workers} workers.`; // prettier-ignore
      get("answer").textContent = lap
        ? `You said ${bet}: the first whole lap came in generation ${lap}, after ${total("seconds", lap).toFixed(0)} seconds.`
        : "";
      stad.describe(get("map"), `A track from above, with all candidates. ${text}`);
      stad.describe(get("learning"), `Points of ${number} generations. ${text}`);
      stad.describe(get("steps"), `The step size of each generation, now ${sigma}.`);
      for (const one of document.querySelectorAll("[data-agent]")) one.textContent = settings.agent;
    }

    drawPlane() {
      if (!this.shown) return;
      const { states, finished, inputs, settings } = this.shown;
      drawPlane(get("plane"), this.shown);
      const { pair, mean } = finished?.before ?? states.at(-1);
      const names = pair.map((place) => nameWeight(place, inputs, settings.sees));
      get("axes").textContent = `${names[0]} (across) and ${names[1]} (up)`;
      const at = pair.map((place) => mean[place].toFixed(2)).join(", ");
      stad.describe(get("plane"), `The weights ${names.join(" and ")}: the mean is at ${at}.`);
    }
  };
}
