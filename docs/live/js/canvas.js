"use strict";
// Drawings in CSS pixels, sharp on every screen.
globalThis.stad ??= {};

/**
 * Clear a canvas and fit it to its size on the page.
 * @param {HTMLCanvasElement} canvas
 * @returns {{context: CanvasRenderingContext2D, width: number, height: number} | null} in CSS
 *   pixels; null while the canvas has no size
 */
stad.clearCanvas = (canvas) => {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!width || !height) return null;
  const ratio = devicePixelRatio || 1;
  const size = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "12px system-ui, sans-serif";
  return { context, width, height };
};

/** Draw a line through points [x, y]. */
stad.strokeLine = (context, points, color, width = 2) => {
  context.strokeStyle = color;
  context.lineWidth = width;
  context.beginPath();
  for (const [x, y] of points) context.lineTo(x, y);
  context.stroke();
};

/** Fill a circle. */
stad.fillDot = (context, [x, y], radius, color) => {
  context.fillStyle = color;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
};

/**
 * Draw numbers as bars, up and down from the middle.
 * @param {HTMLCanvasElement} canvas
 * @param {Float32Array} values
 * @param {number} reach the value that fills half the height
 * @param {(i: number) => string} color of the bar of number i
 */
stad.drawBars = (canvas, values, reach, color) => {
  const cleared = stad.clearCanvas(canvas);
  if (!cleared) return;
  const { context, width, height } = cleared;
  const step = width / values.length;
  values.forEach((value, i) => {
    const tall = Math.max(-1, Math.min(1, value / reach)) * (height / 2 - 2);
    context.fillStyle = color(i);
    context.fillRect(i * step + 1, height / 2, Math.max(1, step - 2), -tall || 1);
  });
};

/** A function from world units to pixels of a square map that holds all of these points. */
stad.projectMap = (points, width, margin = 14) => {
  const [xs, ys] = [0, 1].map((axis) => points.map((point) => point[axis]));
  const [left, right] = [Math.min(...xs), Math.max(...xs)];
  const [low, high] = [Math.min(...ys), Math.max(...ys)];
  const scale = (width - 2 * margin) / Math.max(right - left, high - low);
  const place = ([x, y]) => [
    width / 2 + (x - (left + right) / 2) * scale,
    width / 2 - (y - (low + high) / 2) * scale,
  ];
  return { place, scale };
};

stad.HALF_WIDTH = 20 / 3; // of the road, world units

/** Paint a road as one grey line through its tiles; `place` and `scale` are those of a map. */
stad.paintRoad = (context, line, place, scale) => {
  context.lineJoin = "round";
  stad.strokeLine(context, [...line, line[0]].map(place), "#8a8a8a", 2 * stad.HALF_WIDTH * scale);
};

/** A recorded road, and the paths on it: each has as many points as `counts` says. */
stad.readPaths = (tensors, number, counts) => {
  const [road, all] = ["road", "paths"].map((name) => {
    const { data } = tensors[`${name}.${number}`];
    return Array.from({ length: data.length / 2 }, (_, i) => [data[2 * i], data[2 * i + 1]]);
  });
  let begin = 0;
  return [road, counts.map((count) => all.slice(begin, (begin += count)))];
};

/** The middle of each tile of a track. */
stad.middleLine = (track) =>
  Array.from({ length: track.count }, (_, i) => [track.path[4 * i + 2], track.path[4 * i + 3]]);

/** The point of a line that is nearest to a place: its number, and how far away it is. */
stad.nearest = (line, [x, y]) => {
  const distances = line.map(([a, b]) => Math.hypot(a - x, b - y));
  const distance = Math.min(...distances);
  return { tile: distances.indexOf(distance), distance };
};
