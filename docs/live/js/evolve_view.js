"use strict";
// What the page "Evolve a driver" shows after a generation: curves, a plane of two weights, words.
globalThis.stad ??= {};

{
  const get = stad.get;
  const LATENTS = 32; // numbers of z
  const { orange, green, blue, red } = stad.COLORS;
  const OTHERS = "#8c8c8c";

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
      const color = rank === 0 ? orange : rank < order.length / 2 ? blue : OTHERS;
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
  const best = (values) => Math.max(...values);
  const worst = (values) => Math.max(0, Math.min(...values)); // the chart begins at 0

  stad.EvolveView = class {
    constructor() {
      this.map = new stad.EvolveMap(get("map"));
      const axes = { xMax: 20, xLabel: "generation" };
      this.curve = new stad.Chart(get("learning"), { ...axes, yMax: 1000, yLabel: "points" });
      this.steps = new stad.Chart(get("steps"), { ...axes, yMax: 0.2, yLabel: "σ" });
      new ResizeObserver(() => this.drawPlane()).observe(get("plane"));
      stad.onTheme(() => this.drawPlane());
    }

    /** So many cars drive on a track next. */
    begin(track, count, name) {
      this.map.begin(track, count);
      get("which").textContent = name;
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
      const line = (values, color, first = 1) => ({
        points: values.map((value, i) => [i + first, value]),
        color,
      });
      const sigmas = states.map(({ sigma }) => sigma);
      this.curve.axes.xMax = this.steps.axes.xMax = Math.max(20, log.length);
      this.steps.axes.yMax = 1.3 * Math.max(...sigmas);
      this.steps.show({ lines: [line(sigmas, red, 0)] });
      const lines = [
        line(rows.map(worst), "#999999"),
        line(rows.map(best), orange),
        line(rows.map(average), blue),
        line(log.map((entry) => average(entry.mean)), green),
      ]; // prettier-ignore
      this.curve.show({ lines, marks: lap ? [{ x: lap, text: "first lap" }] : [] });
    }

    showWords(rows) {
      const { log, states, lap, bet, settings } = this.shown;
      const [number, last, sigma] = [log.length, log.at(-1), states.at(-1).sigma.toFixed(3)];
      const total = (name, count) => log.slice(0, count).reduce((sum, one) => sum + one[name], 0);
      const points = (f) => f(rows.at(-1)).toFixed(0);
      const text = number
        ? `Generation ${number}: best ${points(best)} points, average ${points(average)}, ` +
          `mean driver ${average(last.mean).toFixed(0)}. ` +
          `Complete laps: ${last.laps} of ${settings.population}. σ ${sigma}.`
        : "Nobody has driven yet.";
      get("summary").textContent = text;
      const time = (count) => `${total("seconds", count).toFixed(1)} seconds`;
      const driven = `${total("frames").toLocaleString("en")} frames in ${time()}.`;
      get("driven").textContent = number ? driven : "";
      const said = bet ? `You said ${bet}: the` : "The";
      get("answer").textContent = lap
        ? `${said} first complete lap came in generation ${lap}, after ${time(lap)}.`
        : "";
      stad.describe(get("map"), `A track from above, with all candidates. ${text}`);
      stad.describe(get("learning"), `Points of ${number} generations. ${text}`);
      stad.describe(get("steps"), `The step size of each generation, now ${sigma}.`);
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
