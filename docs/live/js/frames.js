"use strict";
// Frames, difference images and recorded episodes. As stad_lab/envs/frames.py.
globalThis.stad ??= {};

stad.FRAME_SIZE ??= 64; // pixels, width and height of a frame
stad.STRIDE ??= 4; // k of the shipped V: frames between the two pictures of a difference image

/** Bytes of a frame as numbers in [0, 1]. */
stad.scaleFrame = (bytes) => Float32Array.from(bytes, (value) => value / 255);

/** d = frame - earlier, for frames in [0, 1]. */
stad.differenceImage = (frame, earlier) => frame.map((value, i) => value - earlier[i]);

/** Root mean square difference of two frames: 0 if equal, 1 at most. */
stad.rmsDistance = (first, second) => {
  let sum = 0;
  for (let i = 0; i < first.length; i++) sum += (first[i] - second[i]) ** 2;
  return Math.sqrt(sum / first.length);
};

/**
 * Read a picture from a data URL.
 * @returns {Promise<CanvasRenderingContext2D>} whose getImageData gives the pixels
 */
stad.readPicture = async (url) => {
  const picture = new Image();
  picture.src = url;
  try {
    await picture.decode(); // outside the page's own thread
  } catch {
    throw new Error("This browser cannot read WebP pictures. Please update it.");
  }
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [picture.width, picture.height];
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  return context;
};

/** A recorded episode: all frames, and the action on each. */
stad.Drive = class {
  /**
   * @param {CanvasRenderingContext2D} sheet all frames side by side
   * @param {{frames: number, columns: number}} facts
   * @param {Float32Array} actions (frames, 3)
   */
  constructor(sheet, facts, actions) {
    [this.sheet, this.actions] = [sheet, actions];
    [this.length, this.columns] = [facts.frames, facts.columns];
    this.kept = new Map();
  }

  /** Frame t as bytes, 64 x 64 x 3. */
  bytes(t) {
    if (!this.kept.has(t)) {
      const [x, y] = [t % this.columns, Math.floor(t / this.columns)];
      const size = stad.FRAME_SIZE;
      const { data } = this.sheet.getImageData(x * size, y * size, size, size);
      const frame = new Uint8Array(3 * size * size);
      for (let p = 0, q = 0; p < frame.length; p += 3, q += 4)
        for (let c = 0; c < 3; c++) frame[p + c] = data[q + c];
      this.kept.set(t, frame);
    }
    return this.kept.get(t);
  }

  /** Frame t in [0, 1], 64 x 64 x 3. */
  frame(t) {
    return stad.scaleFrame(this.bytes(t));
  }

  /** The frame from which the difference image of frame t is taken: in the first ones, itself. */
  earlier(t) {
    return t >= stad.STRIDE ? t - stad.STRIDE : t;
  }

  /** The difference image of frame t, in [-1, 1]. */
  difference(t) {
    return stad.differenceImage(this.frame(t), this.frame(this.earlier(t)));
  }

  /** The recorded action on frame t. */
  action(t) {
    return this.actions.subarray(3 * t, 3 * t + 3);
  }

  /** Load the recorded drive. */
  static async load() {
    const [facts, url] = await Promise.all([stad.load("drive"), stad.load("drive_picture")]);
    const bytes = await stad.decodeBase64(facts.actions);
    return new stad.Drive(await stad.readPicture(url), facts, new Float32Array(bytes.buffer));
  }
};

/** Recorded places; `frameOf(place, speed, stride)`: now if the speed is 0, or some frames ago. */
stad.loadSpeeds = async () => {
  const { places, speeds, strides } = await stad.load("speeds");
  const sheet = await stad.readPicture(await stad.load("speeds_picture"));
  const columns = 1 + speeds.length * strides.length; // of the picture; a row for each place
  const film = new stad.Drive(sheet, { frames: places * columns, columns }, new Float32Array(0));
  const column = (speed, stride) => (speed === 0 ? 0 : 1 + (speed - 1) * strides.length + stride);
  const frameOf = (place, speed, stride) => film.frame(place * columns + column(speed, stride));
  return { places, speeds, strides, frameOf };
};

{
  const size = stad.FRAME_SIZE;
  // Orange for lighter than before, purple for darker: matplotlib's PuOr_r, thinned out.
  // prettier-ignore
  const COLORS = [
    [45, 0, 75], [84, 39, 136], [128, 115, 172], [178, 171, 210], [216, 218, 235], [247, 247, 247],
    [254, 224, 182], [253, 184, 99], [224, 130, 20], [179, 88, 6], [127, 59, 8],
  ];

  function paint(canvas, colour) {
    const context = canvas.getContext("2d");
    const image = context.createImageData(size, size);
    for (let p = 0; p < size * size; p++) {
      colour(image.data, 4 * p, 3 * p);
      image.data[4 * p + 3] = 255;
    }
    context.putImageData(image, 0, 0);
  }

  /** Paint a frame in [0, 1] on a canvas of 64 x 64 pixels. */
  stad.paintFrame = (canvas, frame) =>
    paint(canvas, (data, to, from) => {
      for (let c = 0; c < 3; c++) data[to + c] = 255 * frame[from + c] + 0.5;
    });

  /** Paint a difference image in [-1, 1]: its mean over the colours, saturated beyond 0.15. */
  stad.paintDifference = (canvas, difference) =>
    paint(canvas, (data, to, from) => {
      const mean = (difference[from] + difference[from + 1] + difference[from + 2]) / 3;
      const place = Math.min(1, Math.max(0, mean / 0.3 + 0.5)) * (COLORS.length - 1);
      const low = Math.min(Math.floor(place), COLORS.length - 2);
      for (let c = 0; c < 3; c++)
        data[to + c] = COLORS[low][c] + (place - low) * (COLORS[low + 1][c] - COLORS[low][c]);
    });
}
