"use strict";
// "Does looking at change help?": a bet, then the twelve pairs and the intervals of study 1.

stad.figure("study", async (part) => {
  const { rows, margin, paper } = await stad.load("study");
  const [LOW, HIGH] = [-115, 130]; // points
  let shown = false;

  function draw() {
    const cleared = stad.clearCanvas(part("chart"));
    if (!cleared) return;
    const { context, width, height } = cleared;
    const ink = stad.color("--color-foreground-primary");
    const x = (points) => 8 + ((width - 16) * (points - LOW)) / (HIGH - LOW);
    context.fillStyle = "rgba(128, 128, 128, 0.28)"; // seen in both themes
    context.fillRect(x(-margin), 0, x(margin) - x(-margin), height - 22);
    const mark = (points, colour) => {
      const line = [0, height - 22].map((y) => [x(points), y]);
      stad.strokeLine(context, line, colour, 1);
    };
    mark(-margin, "#8a8a8a");
    mark(margin, "#8a8a8a");
    mark(0, ink);
    if (shown) {
      context.setLineDash([5, 4]);
      mark(paper, ink);
      context.setLineDash([]);
    }
    context.fillStyle = ink;
    context.textAlign = "center";
    for (const points of [-100, -50, 0, 50, 100]) context.fillText(points, x(points), height - 6);
    context.textAlign = "left";
    rows.forEach(({ name, difference, interval, pairs }, i) => {
      const y = 46 + i * 76;
      context.fillStyle = ink;
      context.font = "600 14px system-ui, sans-serif";
      context.fillText(name, 8, y - 24);
      if (!shown) return;
      for (const one of pairs) stad.fillDot(context, [x(one), y + 16], 3.5, "#8a8a8a");
      const ends = interval.map((end) => [x(end), y]);
      stad.strokeLine(context, ends, stad.COLORS.blue, 4);
      stad.fillDot(context, [x(difference), y], 7, stad.COLORS.blue);
    });
  }

  const names = ["Hardly any", "About 30", "About 75"];
  stad.bet(part("bets"), names, () => {
    shown = true;
    draw();
    const told = rows.map(({ name, difference, interval }) => {
      const [low, high] = interval.map((end) => end.toFixed(1));
      return `${name}: ${difference.toFixed(1)} points (95% interval ${low} to ${high})`;
    });
    const text = `${told.join(". ")}. The paper: ${paper} points`;
    part("answer").textContent =
      "Hardly any, on average. More if the driver sees z alone: open What we found.";
    stad.describe(part("chart"), text);
    stad.announce(text);
    part("after").hidden = part("paper").hidden = false;
    return 0;
  });
  new ResizeObserver(draw).observe(part("chart"));
  stad.onTheme(draw);
  draw();
});
