"use strict";
// A small line chart on a canvas, in the colours of the theme.
globalThis.stad ??= {};

stad.Chart = class {
  /**
   * @param {HTMLCanvasElement} canvas its size on the page is given by the style sheet
   * @param {{xMax: number, yMax: number, xLabel: string, yLabel: string}} axes both begin at 0
   */
  constructor(canvas, axes) {
    [this.canvas, this.axes] = [canvas, axes];
    this.content = { lines: [], levels: [], marks: [] };
    new ResizeObserver(() => this.draw()).observe(canvas);
    stad.onTheme(() => this.draw());
  }

  /**
   * Show other content.
   * @param {{lines?: {points: [number, number][], color: string, dash?: number[]}[],
   *          levels?: {y: number, text: string}[], marks?: {x: number, text: string}[]}} content
   */
  show(content) {
    this.content = { lines: [], levels: [], marks: [], ...content };
    this.draw();
  }

  draw() {
    const { axes } = this;
    const cleared = stad.clearCanvas(this.canvas);
    if (!cleared) return; // folded away
    const { context, width, height } = cleared;
    const [ink, faint] = ["--color-foreground-primary", "--color-background-border"].map(
      stad.color,
    );
    const [left, right, top, bottom] = [36, width - 16, 22, height - 34];
    this.x = (value) => left + ((right - left) * value) / axes.xMax;
    this.y = (value) => bottom - ((bottom - top) * Math.min(value, axes.yMax)) / axes.yMax;

    const across = (y, color) => {
      const line = [left, right].map((x) => [x, this.y(y)]);
      stad.strokeLine(context, line, color, 1);
    };
    const text = (words, x, y, align) => {
      context.textAlign = align;
      context.fillText(words, x, y);
    };
    context.fillStyle = ink;
    for (const value of ticks(axes.yMax, 3)) {
      across(value, faint);
      text(String(value), left - 6, this.y(value) + 4, "right");
    }
    const wanted = Math.max(2, Math.floor(width / 90));
    for (const value of ticks(axes.xMax, wanted))
      text(String(value), this.x(value), bottom + 15, "center");
    text(axes.yLabel, 4, 12, "left");
    text(axes.xLabel, right, height - 4, "right");

    for (const { y, text: words } of this.content.levels) {
      context.setLineDash([2, 3]);
      across(y, ink);
      text(words, right, this.y(y) - 4, "right");
    }
    for (const { points, color, dash = [] } of this.content.lines) {
      context.setLineDash(dash);
      const places = points.map(([x, y]) => [this.x(x), this.y(y)]);
      stad.strokeLine(context, places, color, 2);
    }
    context.setLineDash([]);
    for (const { x, text: words } of this.content.marks) {
      const line = [top, bottom].map((y) => [this.x(x), y]);
      stad.strokeLine(context, line, stad.COLORS.red, 2);
      const early = this.x(x) < (left + right) / 2;
      text(words, this.x(x) + (early ? 5 : -5), top + 10, early ? "left" : "right");
    }

    /** About so many round numbers from 0 to a largest one. */
    function ticks(largest, count) {
      const rough = largest / count;
      const power = 10 ** Math.floor(Math.log10(rough));
      const step = [1, 2, 5, 10].map((digit) => digit * power).find((size) => size >= rough);
      const found = [];
      for (let n = 0; n * step <= largest * 1.0001; n++) found.push(Number((n * step).toFixed(6)));
      return found;
    }
  }
};
