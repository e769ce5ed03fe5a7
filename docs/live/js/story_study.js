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
    for (const end of [-margin, margin])
      stad.strokeLine(context, [[x(end), 0], [x(end), height - 22]], "#8a8a8a", 1); // prettier-ignore
    stad.strokeLine(context, [[x(0), 0], [x(0), height - 22]], ink, 1); // prettier-ignore
    if (shown) {
      context.setLineDash([5, 4]);
      stad.strokeLine(context, [[x(paper), 0], [x(paper), height - 22]], ink, 1); // prettier-ignore
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
      stad.strokeLine(context, interval.map((end) => [x(end), y]), stad.COLORS.blue, 4); // prettier-ignore
      stad.fillDot(context, [x(difference), y], 7, stad.COLORS.blue);
    });
  }

  const names = ["Hardly any", "About 30", "About 75"];
  stad.bet(part("bets"), names, () => {
    shown = true;
    draw();
    const found = rows.map(({ name, difference, interval }) => `${name}: ${difference.toFixed(1)} points (95% interval ${interval.map((end) => end.toFixed(1)).join(" to ")})`).join(". "); // prettier-ignore
    const text = `${found}. The paper: ${paper} points`;
    part("answer").textContent =
      "Hardly any, on average. If it sees z alone it is more: see below.";
    stad.describe(part("chart"), text);
    stad.announce(text);
    part("after").hidden = part("paper").hidden = false;
    return 0;
  });
  new ResizeObserver(draw).observe(part("chart"));
  stad.onTheme(draw);
  draw();
});
