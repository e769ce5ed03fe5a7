"use strict";
// The page "A recorded evolution", lower part: CMA-ES in two dimensions, step by step.

{
  const plane = stad.get("plane");
  const choices = ["landscape", "population", "sigma"].map(stad.get);
  const [landscapeBox, populationBox, sigmaBox] = choices;
  for (const [id, { name }] of Object.entries(stad.landscapes))
    landscapeBox.append(new Option(name, id));
  landscapeBox.value = "rosenbrock";

  const random = new stad.Random(Date.now());
  let landscape = stad.landscapes[landscapeBox.value];
  let start = [-0.6, 0.75]; // as shares of the map's half width
  let [strategy, sample, fitness, history, relief] = [null, [], [], [], null];

  const toPixels = ([x, y], width) => [
    (width / 2) * (1 + x / landscape.reach),
    (width / 2) * (1 - y / landscape.reach),
  ];

  /** Begin at the start, with the chosen landscape, population and step size. */
  function restart() {
    landscape = stad.landscapes[landscapeBox.value];
    const mean = start.map((share) => share * landscape.reach);
    const sigma = Number(sigmaBox.value);
    strategy = new stad.CMAES(mean, sigma, Number(populationBox.value));
    [sample, fitness] = [[], []];
    history = [{ mean, best: landscape.f(...mean), sigma }];
    show();
  }

  /** One generation: sample points, rank them, move the distribution. */
  function step() {
    if (finished()) return stop();
    const normals = Array.from({ length: strategy.population }, () => [
      random.normal(),
      random.normal(),
    ]);
    sample = strategy.ask(normals);
    fitness = sample.map((point) => landscape.f(...point));
    strategy.tell(sample, fitness);
    const best = Math.min(history.at(-1).best, ...fitness);
    history.push({ mean: [...strategy.mean], best, sigma: strategy.sigma });
    const runs = timer !== 0;
    show();
    if (runs && finished()) stad.announce(stad.get("state").textContent);
  }

  /** Whether the points hardly differ any more. */
  const finished = () => strategy.ellipse().long < 1e-7 || strategy.generation >= 300;

  /** Where the mean is, in words. */
  const place = () => strategy.mean.map((value) => stad.fixed(value, 2)).join(", ");

  function show() {
    drawPlane();
    drawProgress();
    const { best, sigma } = history.at(-1);
    const { long, short } = strategy.ellipse();
    const text =
      `Generation ${strategy.generation}: lowest value ${short3(best)}, σ ${short3(sigma)}, ` +
      `ellipse ${short3(long)} by ${short3(short)}.` +
      (finished() ? ` Finished${atMinimum()}.` : "");
    stad.get("state").textContent = text;
    stad.describe(plane, `${landscape.name}, from above. ${text} The mean is at ${place()}.`);
    stad.get("step").setAttribute("aria-disabled", finished()); // not `disabled`: the focus stays
    if (finished()) stop();
  }

  const short3 = (value) =>
    value !== 0 && (Math.abs(value) < 0.001 || Math.abs(value) >= 10000)
      ? value.toExponential(1)
      : value.toPrecision(3);

  function atMinimum() {
    return history.at(-1).best < 1e-8 ? " at the lowest point" : " in a local minimum";
  }

  /** Paint the landscape, dark where it is low, on a scale of ranks: as CMA-ES sees it. */
  function paintRelief() {
    const size = 128; // pixels
    const values = new Float64Array(size * size);
    for (let row = 0; row < size; row++)
      for (let column = 0; column < size; column++) {
        const at = (k) => landscape.reach * ((2 * (k + 0.5)) / size - 1);
        values[row * size + column] = landscape.f(at(column), -at(row));
      }
    const ordered = Float64Array.from(values).sort();
    const levels = 24; // of equal area, so that steps look like contour lines
    const bounds = Array.from(
      { length: levels - 1 },
      (_, i) => ordered[Math.floor(((i + 1) * ordered.length) / levels)],
    );
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [size, size];
    const context = canvas.getContext("2d");
    const image = context.createImageData(size, size);
    values.forEach((value, p) => {
      let level = 0;
      while (level < bounds.length && value >= bounds[level]) level += 1;
      const share = level / (levels - 1);
      image.data[4 * p] = 38 + 190 * share;
      image.data[4 * p + 1] = 52 + 175 * share;
      image.data[4 * p + 2] = 92 + 125 * share;
      image.data[4 * p + 3] = 255;
    });
    context.putImageData(image, 0, 0);
    return canvas;
  }

  function drawPlane() {
    const cleared = stad.clearCanvas(plane);
    if (!cleared) return;
    const { context, width } = cleared;
    if (relief?.landscape !== landscape) relief = { landscape, canvas: paintRelief() };
    context.drawImage(relief.canvas, 0, 0, width, width);
    for (const minimum of landscape.minima)
      drawCross(context, toPixels(minimum, width), 5, "white");
    const begin = history[0].mean;
    drawCross(context, toPixels(begin, width), 8, "#222");
    const path = history.map(({ mean }) => toPixels(mean, width));
    stad.strokeLine(context, path, stad.COLORS.green, 2);
    const order = sample.map((_, i) => i).sort((a, b) => fitness[a] - fitness[b]);
    const better = strategy.constants.better;
    order.forEach((i, rank) => {
      const place = toPixels(sample[i], width);
      stad.fillDot(context, place, 4, "#222");
      stad.fillDot(context, place, 3, rank < better ? stad.COLORS.sky : "#bbbbbb");
    });
    const { long, short, angle } = strategy.ellipse();
    const [x, y] = toPixels(strategy.mean, width);
    const scale = width / (2 * landscape.reach);
    context.strokeStyle = stad.COLORS.red;
    context.lineWidth = 2.5;
    context.beginPath();
    context.ellipse(x, y, Math.max(1, long * scale), Math.max(1, short * scale), -angle, 0, 7);
    context.stroke();
    stad.fillDot(context, [x, y], 4, stad.COLORS.red);
  }

  function drawCross(context, [x, y], size, color) {
    for (const down of [size, -size]) {
      const [from, to] = [
        [x - size, y - down],
        [x + size, y + down],
      ];
      stad.strokeLine(context, [from, to], color, 2);
    }
  }

  /** Lowest value and sigma over the generations, on a logarithmic scale. */
  function drawProgress() {
    const canvas = stad.get("progress");
    const cleared = stad.clearCanvas(canvas);
    if (!cleared) return;
    const { context, width, height } = cleared;
    const [low, high, left, right, top, bottom] = [-10, 4, 40, width - 8, 10, height - 22];
    const longest = Math.max(30, history.length - 1);
    const place = (generation, value) => {
      const power = Math.min(high, Math.max(low, Math.log10(value)));
      return [
        left + ((right - left) * generation) / longest,
        bottom - ((bottom - top) * (power - low)) / (high - low),
      ];
    };
    context.fillStyle = stad.color("--color-foreground-primary");
    const faint = stad.color("--color-background-border");
    for (let power = low + 2; power <= high; power += 4) {
      const [, y] = place(0, 10 ** power);
      const [from, to] = [left, right].map((x) => [x, y]);
      stad.strokeLine(context, [from, to], faint, 1);
      context.fillText(`1e${power}`, 4, y + 4);
    }
    context.fillText(`${longest} generations`, right - 90, height - 6);
    const line = (value) => history.map((entry, i) => place(i, Math.max(value(entry), 1e-10)));
    stad.strokeLine(
      context,
      line((entry) => entry.best),
      stad.COLORS.blue,
    );
    stad.strokeLine(
      context,
      line((entry) => entry.sigma),
      stad.COLORS.orange,
    );
    const { best, sigma } = history.at(-1);
    stad.describe(
      canvas,
      `Lowest value ${short3(best)} and step size ${short3(sigma)}, on a logarithmic scale.`,
    );
  }

  let timer = 0;
  function stop() {
    clearInterval(timer);
    timer = 0;
    stad.get("run").textContent = "Run";
  }
  function run() {
    if (timer) return stop();
    if (finished()) restart();
    stad.get("run").textContent = "Pause";
    timer = setInterval(step, 350);
    step();
  }

  function begin(x, y) {
    stop();
    start = [x, y].map((share) => Math.min(1, Math.max(-1, share)));
    restart();
  }

  function stepAloud() {
    stop();
    step();
    stad.announce(stad.get("state").textContent);
  }

  plane.addEventListener("click", (event) => {
    const { left, top, width, height } = plane.getBoundingClientRect();
    begin((2 * (event.clientX - left)) / width - 1, 1 - (2 * (event.clientY - top)) / height);
  });
  plane.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return; // Alt+Left goes back
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const move = moves[event.key];
    if (move) {
      begin(start[0] + 0.05 * move[0], start[1] + 0.05 * move[1]);
      stad.announce(`The start is at ${place()}.`);
    } else if (event.key === "Enter" || event.key === " ") stepAloud();
    else return;
    event.preventDefault(); // arrow keys and the space bar would move the page
  });
  for (const box of choices)
    box.addEventListener("input", () => {
      stad.get("sigma-value").textContent = Number(sigmaBox.value).toFixed(1);
      stop();
      restart();
    });
  stad.get("step").addEventListener("click", stepAloud);
  stad.get("run").addEventListener("click", run);
  stad.get("restart").addEventListener("click", () => {
    stop();
    restart();
  });
  new ResizeObserver(() => [drawPlane(), drawProgress()]).observe(plane);
  stad.onTheme(() => [drawPlane(), drawProgress()]);
  restart();
}
