"use strict";
// The map of the page "Evolve a driver": the track from above, with all cars of a generation.
globalThis.stad ??= {};

{
  const { orange, green, blue } = stad.COLORS;
  const STOPPED = "#8c8c8c";
  const [CAR, BEST] = [6, 10]; // pixels, lengths of cars

  stad.EvolveMap = class {
    /** @param {HTMLCanvasElement} canvas a square */
    constructor(canvas) {
      [this.canvas, this.cars, this.track, this.layer] = [canvas, [], null, null];
      new ResizeObserver(() => this.draw()).observe(canvas);
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
      if (this.layer?.picture.width !== this.canvas.width) this.paint(width);
      context.drawImage(this.layer.picture, 0, 0, width, width);
      const [mean, best] = [this.cars.at(-1), this.best];
      for (const car of this.cars)
        if (car.at && car !== mean && car !== best)
          this.drawCar(context, car, CAR, car.going ? blue : STOPPED);
      for (const [car, color] of [
        [mean, green],
        [best, orange],
      ]) {
        stad.strokeLine(context, car.path.map(this.layer.place), color, 2);
        if (car.at) this.drawCar(context, car, BEST, color, "white");
      }
    }

    /** The road and the paths so far, on a canvas of their own: only new pieces are added to it. */
    paint(width) {
      const picture = document.createElement("canvas");
      [picture.width, picture.height] = [this.canvas.width, this.canvas.width];
      const context = picture.getContext("2d");
      context.scale(picture.width / width, picture.width / width);
      const { line } = this.track;
      const { place, scale } = stad.projectMap(line, width, 0.06 * width);
      stad.paintRoad(context, line, place, scale);
      stad.fillDot(context, place(line[0]), 4, "white");
      this.layer = { picture, context, place };
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
}
