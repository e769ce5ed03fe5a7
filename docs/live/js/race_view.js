"use strict";
// The picture of the race: the road around one car, the other car, the map, and what to touch.
globalThis.stad ??= {};

{
  const { orange: ORANGE, blue: BLUE } = stad.COLORS;
  const [FIELD, VIEW] = [333, 62]; // world units: half the field, and the height of the picture
  const LOW = 0.72; // where the car is: this share of the height from above
  const PIECE = 20; // tiles
  const LARGE = "600 17px system-ui, sans-serif";

  /** The track with its road in pieces, a path for each shade, and as a line for the map. */
  stad.prepareRoad = (track) => {
    const polygon = (path, corners, i) => {
      path.moveTo(corners[8 * i], corners[8 * i + 1]);
      for (let k = 1; k < 4; k++) path.lineTo(corners[8 * i + 2 * k], corners[8 * i + 2 * k + 1]);
      path.closePath();
    };
    const colors = ["#666", "#696969", "#6b6b6b", "#fff", "#e8342c"]; // the last two are kerbs
    const pieces = [];
    for (let first = 0; first < track.count; first += PIECE) {
      const middle = 4 * Math.min(first + PIECE / 2, track.count - 1);
      const layers = colors.map((color) => ({ color, path: new Path2D() }));
      pieces.push({ x: track.path[middle + 2], y: track.path[middle + 3], layers });
    }
    const layersOf = (tile) => pieces[Math.floor(tile / PIECE)].layers;
    for (let i = 0; i < track.count; i++) polygon(layersOf(i)[i % 3].path, track.tiles, i);
    track.kerbTiles.forEach((tile, i) =>
      polygon(layersOf(tile)[3 + (tile % 2)].path, track.kerbs, i),
    );
    const line = stad.middleLine(track);
    const [xs, ys] = [line.map(([x]) => x), line.map(([, y]) => y)];
    const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
    return { ...track, pieces, line, box };
  };

  /** A pose between the last two, so that the picture moves at the screen's rate. */
  stad.poseBetween = (was, now, share) => {
    if (!was || Math.hypot(now.x - was.x, now.y - was.y) > 10) return now; // a new episode
    const mix = (a, b) => a + (b - a) * share;
    const wheels = now.wheels.map((one, i) => one.map((value, k) => mix(was.wheels[i][k], value)));
    const [x, y, angle] = ["x", "y", "angle"].map((part) => mix(was[part], now[part]));
    return { x, y, angle, wheels, speed: now.speed };
  };

  /**
   * Draw the race.
   * @param {HTMLCanvasElement} canvas
   * @param {object} scene
   * @param {object} scene.track as `prepareRoad` returns it
   * @param {{you: object, rival: object}} scene.cars poses
   * @param {boolean} scene.alone whether the rival drives alone
   * @param {string | null} scene.lost what a reader is told beside the arrow to the road; null: no
   *   arrow
   * @param {{steers: Set<string>, hint: boolean} | null} scene.fingers the sides that are held, and
   *   whether to say what a finger does; null without a finger
   */
  stad.drawRace = (canvas, scene) => {
    const cleared = stad.clearCanvas(canvas);
    if (!cleared) return;
    const { track, cars, alone, lost, fingers } = scene;
    const { context, width, height } = cleared;
    const shown = alone ? cars.rival : cars.you;
    drawWorld(cleared, scene, shown);
    if (lost !== null) drawWayBack(cleared, track.line, shown, lost);
    drawMap(cleared, track, alone ? { rival: cars.rival } : cars);
    drawSpeed(context, height, shown.speed);
    if (fingers) drawPads(cleared, fingers.steers);
    if (fingers?.hint) drawHint(context, width, height);
  };

  /** Field, road and cars as one car sees them, its front upwards. */
  function drawWorld({ context, width, height }, { track, cars, alone }, shown) {
    const scale = height / VIEW;
    context.save();
    context.fillStyle = "#333"; // beyond the field
    context.fillRect(0, 0, width, height);
    context.translate(width / 2, height * LOW);
    context.scale(scale, -scale);
    context.rotate(-shown.angle);
    context.translate(-shown.x, -shown.y);
    drawGrass(context, shown, width / scale);
    const reach = Math.max(VIEW, width / scale) + 2 * PIECE; // a piece is less than 4 * PIECE long
    for (const { x, y, layers } of track.pieces) {
      if (Math.hypot(x - shown.x, y - shown.y) > reach) continue;
      for (const { color, path } of layers) {
        context.fillStyle = color;
        context.fill(path);
      }
    }
    const corners = track.tiles;
    const start = [0, 2].map((i) => [corners[i], corners[i + 1]]);
    stad.strokeLine(context, start, "#fff", 0.8);
    drawCar(context, cars.rival, BLUE, alone ? 1 : 0.65);
    if (!alone) drawCar(context, cars.you, ORANGE, 1);
    context.restore();
  }

  function drawGrass(context, { x, y }, wide) {
    const [square, reach] = [FIELD / 10, Math.max(VIEW, wide)];
    context.fillStyle = "#5fae57";
    context.fillRect(-FIELD, -FIELD, 2 * FIELD, 2 * FIELD);
    context.fillStyle = "#56a44e";
    const within = (value) => Math.max(-FIELD, Math.min(FIELD, value));
    const first = (value) => Math.floor(within(value - reach) / (2 * square)) * 2 * square;
    for (let left = first(x); left < within(x + reach); left += 2 * square)
      for (let low = first(y); low < within(y + reach); low += 2 * square)
        context.fillRect(left, low, square, square);
  }

  // The car of Gymnasium, in world units.
  const HULL = [
    [-1.2, 2.6, 1.2, 2.6, 1.2, 2.2, -1.2, 2.2],
    [-0.3, 2.4, 0.3, 2.4, 1, 0.4, -1, 0.4],
    [0.5, 0.5, 1, 0.2, 1, -1, 0.4, -1.8, -0.4, -1.8, -1, -1, -1, 0.2, -0.5, 0.5],
    [-1, -2.4, 1, -2.4, 1, -1.8, -1, -1.8],
  ];

  function drawCar(context, { x, y, angle, wheels }, color, alpha) {
    context.globalAlpha = alpha;
    for (const [wheelX, wheelY, turn, phase] of wheels) {
      context.save();
      context.translate(wheelX, wheelY);
      context.rotate(turn);
      context.fillStyle = "#111";
      context.fillRect(-0.28, -0.54, 0.56, 1.08);
      const place = 0.54 * Math.sin(phase);
      context.fillStyle = "#999";
      if (Math.cos(phase) > 0) context.fillRect(-0.28, place - 0.08, 0.56, 0.16);
      context.restore();
    }
    context.save();
    context.translate(x, y);
    context.rotate(angle);
    context.fillStyle = color;
    for (const corners of HULL) {
      context.beginPath();
      for (let i = 0; i < corners.length; i += 2) context.lineTo(corners[i], corners[i + 1]);
      context.fill();
    }
    context.restore();
    context.globalAlpha = 1;
  }

  // An arrow to the right, in world units.
  const ARROW = [
    [0, -0.6],
    [3, -0.6],
    [3, -1.8],
    [6, 0],
    [3, 1.8],
    [3, 0.6],
    [0, 0.6],
  ];

  /** An arrow to the road, for a car that has left it. */
  function drawWayBack({ context, width, height }, line, { x, y, angle }, told) {
    const { tile, distance } = stad.nearest(line, [x, y]);
    if (distance < 2 * stad.HALF_WIDTH) return;
    const [a, b] = line[tile];
    const scale = height / VIEW;
    context.save();
    context.translate(width / 2, height * LOW);
    context.rotate(angle - Math.atan2(b - y, a - x)); // the picture turns with the car
    context.translate(7 * scale, 0);
    context.scale(scale, scale);
    context.fillStyle = "#fff";
    context.beginPath();
    for (const [right, down] of ARROW) context.lineTo(right, down);
    context.fill();
    context.restore();
    context.fillStyle = "#fff";
    context.font = LARGE;
    context.textAlign = "center";
    context.fillText(told, width / 2, 0.24 * height);
  }

  function drawMap({ context, width, height }, { line, box }, cars) {
    const side = Math.min(150, 0.3 * width);
    const [left, low, right, high] = box;
    const scale = (side - 16) / Math.max(right - left, high - low);
    const tall = (high - low) * scale + 16;
    const top = width < 500 ? height - tall - 8 : 8; // on a phone the scores are above
    const within = (value, size) => Math.max(5, Math.min(size - 5, value)); // off the road, too
    const place = ([x, y]) => [
      width - side - 8 + within(8 + (x - left) * scale, side),
      top + within(8 + (high - y) * scale, tall),
    ];
    context.fillStyle = "#fffd";
    fillBox(context, width - side - 8, top, side, tall, 8);
    stad.strokeLine(context, [...line, line[0]].map(place), "#777", 3);
    stad.fillDot(context, place([cars.rival.x, cars.rival.y]), 5, BLUE);
    if (cars.you) stad.fillDot(context, place([cars.you.x, cars.you.y]), 5, ORANGE);
  }

  /** Fill a box with round corners; browsers before 2022 draw none. */
  function fillBox(context, ...sizes) {
    context.beginPath();
    (context.roundRect ?? context.rect).apply(context, sizes);
    context.fill();
  }

  function drawSpeed(context, height, speed) {
    context.fillStyle = "#000a";
    fillBox(context, 8, height - 44, 132, 36, 8);
    context.fillStyle = "#fff";
    context.font = "600 15px system-ui, sans-serif";
    context.textAlign = "left";
    context.fillText(`speed ${Math.round(speed)}`, 18, height - 28);
    context.fillStyle = speed > 70 ? "#ff8a5c" : "#9fd49a";
    context.fillRect(18, height - 22, Math.min(1, speed / 100) * 112, 6);
  }

  /** Where a finger steers. */
  function drawPads({ context, width, height }, steers) {
    context.font = "600 44px system-ui, sans-serif";
    context.textAlign = "center";
    for (const [side, x, sign] of [
      ["left", 40, "\u25c0"],
      ["right", width - 40, "\u25b6"],
    ]) {
      context.fillStyle = steers.has(side) ? "#fff" : "#fff9";
      context.fillText(sign, x, height / 2);
    }
  }

  /** What a finger does, until it has done it. */
  function drawHint(context, width, height) {
    context.font = LARGE;
    context.textAlign = "center";
    context.fillStyle = "#000b";
    fillBox(context, width / 2 - 130, 0.4 * height - 25, 260, 62, 10);
    context.fillStyle = "#fff";
    context.fillText("Hold a side to steer.", width / 2, 0.4 * height);
    context.fillText("Gas comes by itself.", width / 2, 0.4 * height + 24);
  }
}
