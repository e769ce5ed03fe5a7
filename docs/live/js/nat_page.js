"use strict";
// The page "The KL weight": what V reconstructs along the rate-distortion curve.

stad.start(async () => {
  const { networks: found, frames } = await stad.load("nat"); // in order of their KL weights
  const sheet = await stad.readPicture(await stad.load("nat_picture"));
  const size = stad.FRAME_SIZE;
  const rows = [
    { name: "frames", row: 0, original: true },
    { name: "frames reconstructed from z", row: 0 },
    { name: "difference images", row: 1, original: true },
    { name: "difference images reconstructed from z", row: 1 },
  ];
  let chosen = found.findIndex((one) => one.kl_weight === 0.25);

  // The sheet has two lines of pictures for each frame: frames and difference images. The first
  // column has the originals, each other one the reconstructions of one V.
  const strip = stad.get("strip");
  strip.style.gridTemplateColumns = `repeat(${frames}, minmax(0, 1fr))`;
  const canvases = rows.map(({ name }) => {
    const title = document.createElement("p");
    [title.className, title.textContent] = ["row-name", name];
    strip.append(title);
    return Array.from({ length: frames }, () => {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height, canvas.className] = [size, size, "pixels"];
      canvas.setAttribute("role", "img");
      const figure = document.createElement("figure");
      figure.append(canvas);
      strip.append(figure);
      return canvas;
    });
  });

  const distortion = (one) => one.frame_error + one.difference_error;
  const points = found.map((one) => [one.kl, distortion(one)]);
  const largest = (values) => Math.ceil(Math.max(...values) / 10) * 10;
  const curve = new (class extends stad.Chart {
    draw() {
      super.draw();
      if (!this.x) return; // folded away
      const context = this.canvas.getContext("2d");
      points.forEach(([rate, error], number) => {
        const [radius, color] = number === chosen ? [7, "red"] : [4, "blue"];
        stad.fillDot(context, [this.x(rate), this.y(error)], radius, stad.COLORS[color]);
      });
    }
  })(stad.get("curve"), {
    xMax: largest(points.map(([rate]) => rate)),
    yMax: largest(points.map(([, error]) => error)),
    xLabel: "rate: KL of z, nats",
    yLabel: "distortion: squared error",
  });

  function drawBars() {
    const cleared = stad.clearCanvas(stad.get("bars"));
    if (!cleared) return;
    const { context, width, height } = cleared;
    const kl = sorted(found[chosen]);
    const top = Math.max(...found.flatMap((one) => one.kl_of_latents));
    const [left, bottom] = [30, height - 8];
    const step = (width - left) / kl.length;
    context.fillStyle = stad.color("--color-foreground-primary");
    const faint = stad.color("--color-background-border");
    context.fillText("nats", 2, 12);
    for (let value = 0; value <= top; value += 2) {
      const y = bottom - ((bottom - 20) * value) / top;
      context.fillText(String(value), 8, y + 4);
      stad.strokeLine(
        context,
        [
          [left, y],
          [width, y],
        ],
        faint,
        1,
      );
    }
    kl.forEach((value, i) => {
      const tall = Math.max(2, ((bottom - 20) * value) / top); // a collapsed latent stays visible
      context.fillStyle = value > ACTIVE ? stad.COLORS.blue : stad.COLORS.red;
      context.fillRect(left + i * step + 1, bottom - tall, Math.max(1, step - 2), tall);
    });
  }

  const ACTIVE = 0.05; // nats, as in stad_lab/evaluation/metrics.py
  const sorted = (one) => [...one.kl_of_latents].sort((a, b) => b - a);

  function show() {
    const one = found[chosen];
    stad.get("weight").value = chosen;
    stad.get("weight").setAttribute("aria-valuetext", String(one.kl_weight));
    stad.get("weight-value").textContent = one.kl_weight;
    // Not `disabled`: the button would lose the focus of who uses the keyboard.
    stad.get("less").setAttribute("aria-disabled", chosen === 0);
    stad.get("more").setAttribute("aria-disabled", chosen === last);
    canvases.forEach((line, number) =>
      line.forEach((canvas, frame) => {
        const { name, row, original } = rows[number];
        const column = original ? 0 : chosen + 1;
        const from = [column * size, (2 * frame + row) * size, size, size];
        const context = canvas.getContext("2d");
        context.drawImage(sheet.canvas, ...from, 0, 0, size, size);
        const label = `${name}, frame ${frame + 1}`;
        stad.describe(canvas, original ? label : `${label}, KL weight ${one.kl_weight}`);
      }),
    );
    const active = one.kl_of_latents.filter((value) => value > ACTIVE).length;
    const latents = one.kl_of_latents.length;
    const [nats, bits] = [one.kl.toFixed(1), (one.kl / Math.LN2).toFixed(1)];
    const error = distortion(one).toFixed(0);
    const text =
      `KL of z: ${nats} nats (${bits} bits) for a frame, ` +
      `${active} of ${latents} latents active. Squared error: ${error}.`;
    stad.get("summary").textContent = text;
    stad.announce(`KL weight ${one.kl_weight}: ${text}`);
    curve.show({ lines: [{ points, color: stad.COLORS.blue }] });
    stad.describe(
      stad.get("curve"),
      `Rate against distortion. At KL weight ${one.kl_weight}: ${nats} nats and error ${error}. ` +
        "The error falls steeply up to some 10 nats, and not beyond 50.",
    );
    const [first] = sorted(one);
    stad.describe(
      stad.get("bars"),
      `KL of each latent: ${active} are active, ${latents - active} have collapsed. ` +
        `The largest has ${first.toFixed(1)} nats.`,
    );
    drawBars();
  }

  const last = found.length - 1;
  let timer = 0;
  function choose(number) {
    chosen = Math.min(last, Math.max(0, number));
    show();
  }
  function stop() {
    clearInterval(timer);
    timer = 0;
    stad.get("play").textContent = "Play";
  }
  stad.get("weight").max = last;
  stad.get("weight").addEventListener("input", (event) => {
    stop();
    choose(Number(event.target.value));
  });
  stad.get("less").addEventListener("click", () => [stop(), choose(chosen - 1)]);
  stad.get("more").addEventListener("click", () => [stop(), choose(chosen + 1)]);
  stad.get("play").addEventListener("click", () => {
    if (timer) return stop();
    stad.get("play").textContent = "Pause";
    if (chosen === last) choose(0);
    timer = setInterval(() => (chosen === last ? stop() : choose(chosen + 1)), 1200);
  });
  new ResizeObserver(drawBars).observe(stad.get("bars"));
  stad.onTheme(drawBars);
  show();
});
