"use strict";
// The real CarRacing in this page: tracks, physics and pictures.
// All of it is compiled from stad_lab/envs by wasm_build.py; here are only
// the calls, what NumPy does for a seed, and the C library that the compiled code needs.
// This script also runs in a worker, so it touches no document.
globalThis.stad ??= {};

stad.FRAMES_A_SECOND = 50;
stad.seconds = (frames, digits = 1) => (frames / stad.FRAMES_A_SECOND).toFixed(digits);
stad.LONGEST = 1000; // frames of an episode

{
  // --- Random numbers: NumPy's SeedSequence and PCG64 --------------------------------------------

  const MASK32 = 0xffffffffn;
  const MASK128 = (1n << 128n) - 1n;
  const MULTIPLIER = (2549297995355413924n << 64n) + 4865540595714422341n;

  /** The four 64-bit numbers that NumPy's SeedSequence makes of a seed, 0 to 2^53. */
  function seedSequence(seed) {
    const entropy = [];
    for (let rest = BigInt(seed); entropy.length === 0 || rest > 0n; rest >>= 32n)
      entropy.push(Number(rest & MASK32));
    let hash = 0x43b0d7e5;
    const mixed = (value) => {
      value = (value ^ hash) >>> 0;
      hash = Math.imul(hash, 0x931e8875) >>> 0;
      value = Math.imul(value, hash) >>> 0;
      return (value ^ (value >>> 16)) >>> 0;
    };
    const mix = (x, y) => {
      const value = (Math.imul(x, 0xca01f9dd) - Math.imul(y, 0x4973f715)) >>> 0;
      return (value ^ (value >>> 16)) >>> 0;
    };
    const pool = [0, 1, 2, 3].map((i) => mixed(entropy[i] ?? 0));
    for (let from = 0; from < 4; from++)
      for (let to = 0; to < 4; to++) if (from !== to) pool[to] = mix(pool[to], mixed(pool[from]));
    let other = 0x8b51f9dd;
    const words = Array.from({ length: 8 }, (_, i) => {
      let value = (pool[i % 4] ^ other) >>> 0;
      other = Math.imul(other, 0x58f38ded) >>> 0;
      value = Math.imul(value, other) >>> 0;
      return BigInt((value ^ (value >>> 16)) >>> 0);
    });
    return [0, 2, 4, 6].map((i) => words[i] | (words[i + 1] << 32n));
  }

  /** NumPy's default_rng(seed), as far as a track needs it. */
  stad.Generator = class {
    constructor(seed) {
      const [high, low, streamHigh, streamLow] = seedSequence(seed);
      this.increment = ((((streamHigh << 64n) | streamLow) << 1n) | 1n) & MASK128;
      this.state = 0n;
      this.advance();
      this.state = (this.state + ((high << 64n) | low)) & MASK128;
      this.advance();
    }

    advance() {
      this.state = (this.state * MULTIPLIER + this.increment) & MASK128;
    }

    /** Uniform in [0, 1), with 53 bits. */
    random() {
      this.advance();
      const word = (this.state >> 64n) ^ (this.state & ((1n << 64n) - 1n));
      const turn = this.state >> 122n;
      const bits = BigInt.asUintN(64, (word >> turn) | (word << ((64n - turn) & 63n)));
      return Number(bits >> 11n) / 2 ** 53;
    }
  };

  // --- The C library ----------------------------------------------------------------------------

  // sin and cos of float32 as glibc rounds them; those of JavaScript differ in the last bit now and
  // then. Polynomials in double precision after a reduction to a quarter turn.
  // prettier-ignore
  const COSINE = [
    1, -0.49999999725108224, 0.041666623324344516, -0.001388676379437604, 2.4390450703564542e-5,
  ];
  const NEGATIVE = COSINE.map((value) => -value);
  const SINE = [-0.16666654943701084, 0.008332178146138854, -0.00019517298981385725];
  const [PER_TURN, QUARTER] = [10680707.430881744, Math.PI / 2];
  const SIGN = [1, -1, -1, 1];

  function polynomial(x, square, cosine, n) {
    if ((n & 1) === 0) {
      const cube = x * square;
      return Math.fround(x + cube * SINE[0] + cube * square * (SINE[1] + square * SINE[2]));
    }
    const [fourth, c] = [square * square, cosine];
    const high = c[3] + square * c[4];
    return Math.fround(c[0] + square * c[1] + fourth * c[2] + fourth * square * high);
  }

  /** For |y| below 120: no angle of a car is larger. */
  function trigonometry(y, cosine) {
    if (Math.abs(y) < Math.fround(Math.PI / 4)) {
      if (Math.abs(y) < 2 ** -12) return cosine ? 1 : y;
      return polynomial(y, y * y, COSINE, cosine);
    }
    const n = ((Math.trunc(y * PER_TURN) | 0) + 0x800000) >> 24;
    const x = y - n * QUARTER;
    return polynomial(x * SIGN[n & 3], x * x, n & 2 ? NEGATIVE : COSINE, n ^ cosine);
  }

  /** What the compiled code imports: mathematics, and memory that is taken back after each call. */
  function library(memory) {
    const allocate = (size) => memory.take(Number(size));
    return {
      sin: Math.sin,
      cos: Math.cos,
      atan2: Math.atan2,
      log10: Math.log10,
      fmod: (x, y) => x % y,
      expf: (x) => Math.fround(Math.exp(x)),
      tanhf: (x) => Math.fround(Math.tanh(x)),
      sinf: (x) => trigonometry(x, 0),
      cosf: (x) => trigonometry(x, 1),
      // A product of 128 bits, by which NumPy's sizes are checked for an overflow.
      __multi3(to, low, high, otherLow, otherHigh) {
        const wide = (l, h) => (BigInt.asIntN(64, h) << 64n) | BigInt.asUintN(64, l);
        const product = BigInt.asUintN(128, wide(low, high) * wide(otherLow, otherHigh));
        const view = memory.view();
        view.setBigUint64(to, product & ((1n << 64n) - 1n), true);
        view.setBigUint64(to + 8, product >> 64n, true);
      },
      // Numba's record of an array: a counter (64 bits) first, the address of the data at 16.
      NRT_MemInfo_alloc_aligned(size) {
        const at = allocate(64 + Number(size));
        memory.view().setBigInt64(at, 1n, true);
        memory.view().setUint32(at + 16, at + 64, true);
        return at;
      },
      NRT_MemInfo_call_dtor() {},
      NRT_Free() {},
      // All of our arrays lie in one piece, so new strides follow from the new shape.
      numba_attempt_nocopy_reshape(_, __, ___, count, shape, strides, itemsize) {
        const view = memory.view();
        let stride = BigInt(itemsize);
        for (let i = Number(count) - 1; i >= 0; i--) {
          view.setBigInt64(strides + 8 * i, stride, true);
          stride *= view.getBigInt64(shape + 8 * i, true);
        }
        return 1;
      },
    };
  }

  // --- The engine -------------------------------------------------------------------------------

  const SIZES = { observation: 96, frame: 64 };
  const [ROAD, WHITE, RED, GRASS, OUTSIDE] = [8, 12, 16, 4, 20]; // kinds of ground, as picture.py
  const [MOST_TILES, CHECKPOINTS, RADIUS] = [2500, 12, 150];
  const GROUND = [
    ["texels", (n) => n * n],
    ["quarter", (n) => (4 * n * n) / 16],
    ["eighth", (n) => (4 * n * n) / 64],
    ["sixteenth", (n) => (4 * n * n) / 256],
    ["colors", () => 24],
    ["palette", () => 8 * 256],
  ];

  /** Memory of the module: what is taken after noting `top` is given back by setting it again. */
  class Memory {
    constructor() {
      this.instance = null;
    }

    get buffer() {
      return this.instance.exports.memory.buffer;
    }

    view() {
      return new DataView(this.buffer);
    }

    take(bytes) {
      const at = (this.top + 63) & ~63;
      this.top = at + bytes;
      const missing = this.top - this.buffer.byteLength;
      if (missing > 0) this.instance.exports.memory.grow(Math.ceil(missing / 65536) + 64);
      return at;
    }

    /** Copy a typed array, and keep it. */
    put(array) {
      const at = this.take(array.byteLength);
      this.write(at, array);
      return at;
    }

    write(at, array) {
      const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
      new Uint8Array(this.buffer).set(bytes, at);
    }

    read(Kind, at, count) {
      return new Kind(this.buffer, at, count);
    }
  }

  stad.Engine = class {
    /**
     * @param {BufferSource} code engine.wasm
     * @param {object} facts engine.json
     * @param {Uint8Array} tables tables.bin: the car, and the score in two sizes
     */
    static async make(code, facts, tables) {
      const engine = new stad.Engine();
      const memory = (engine.memory = new Memory());
      const known = library(memory);
      const module = await WebAssembly.compile(code);
      const env = {};
      for (const { name } of WebAssembly.Module.imports(module))
        env[name] =
          known[name] ??
          (() => {
            throw new Error(`the engine called ${name}`);
          });
      memory.instance = await WebAssembly.instantiate(module, { env });
      memory.top = memory.instance.exports.__heap_base.value;
      [engine.facts, engine.calls] = [facts, memory.instance.exports];
      let begin = 0;
      engine.tables = facts.tables.map((size) => {
        const at = memory.put(tables.subarray(begin, begin + size));
        begin += size;
        return at;
      });
      engine.first = memory.put(new BigInt64Array([0n])); // number of the only car of a call
      engine.pattern = memory.put(engine.grassPattern());
      return engine;
    }

    /** Call the module, and take back what it has allocated. */
    call(name, ...numbers) {
      const top = this.memory.top;
      try {
        return this.calls[name](...numbers);
      } finally {
        this.memory.top = top;
      }
    }

    grassPattern() {
      const { period } = this.facts.ground;
      const pattern = new Uint8Array(period * period);
      for (let row = 0; row < period / 2; row++)
        pattern.fill(GRASS, row * period, row * period + period / 2);
      return pattern;
    }

    /**
     * The track of a seed, as `env.reset(seed=seed)` makes it.
     * @returns {{seed: number, count: number, path: Float64Array, tiles: Float64Array,
     *   kerbs: Float64Array, kerbTiles: number[]}} for each tile angle, heading, x and y, and four
     *   corners x, y; all in world units
     */
    makeTrack(seed) {
      const { memory } = this;
      const [top, random] = [memory.top, new stad.Generator(seed)];
      const [draws, path] = [memory.take(8 * 24), memory.take(8 * 4 * MOST_TILES)];
      let count = 0;
      while (!count) {
        const numbers = memory.read(Float64Array, draws, 24);
        for (let i = 0; i < CHECKPOINTS; i++) {
          numbers[2 * i] = ((2 * Math.PI) / CHECKPOINTS) * random.random();
          numbers[2 * i + 1] = RADIUS / 3 + (RADIUS - RADIUS / 3) * random.random();
        }
        count = Number(this.call("find_path", draws, path));
      }
      const [tiles, kerbs] = [memory.take(64 * count), memory.take(64 * count)];
      const numbers = memory.take(8 * count);
      const beside = Number(this.call("pave", path, BigInt(count), tiles, kerbs, numbers));
      const copy = (at, length) => memory.read(Float64Array, at, length).slice();
      const kerbTiles = Array.from(memory.read(BigInt64Array, numbers, beside), Number);
      const track = { seed, count, path: copy(path, 4 * count), tiles: copy(tiles, 8 * count) };
      memory.top = top;
      return { ...track, kerbs: copy(kerbs, 8 * beside), kerbTiles };
    }

    /** Memory for a car and its pictures, for many episodes. */
    makeCar() {
      return new stad.Car(this);
    }
  };

  // --- One car ----------------------------------------------------------------------------------

  stad.Car = class {
    constructor(engine) {
      [this.engine, this.memory] = [engine, engine.memory];
      const { memory, facts } = this;
      [this.car, this.road] = [memory.take(facts.car.size), memory.take(facts.road.size)];
      [this.action, this.reward] = [memory.take(24), memory.take(8)];
      [this.path, this.tiles] = [memory.take(32 * MOST_TILES), memory.take(64 * MOST_TILES)];
      this.out = memory.take(3 * SIZES.observation ** 2);
      this.ground = null;
    }

    get facts() {
      return this.engine.facts;
    }

    /** Begin an episode on a track of `makeTrack`. */
    reset(track) {
      const { memory, facts } = this;
      this.track = track;
      memory.read(Uint8Array, this.car, facts.car.size).fill(0);
      memory.read(Uint8Array, this.road, facts.road.size).fill(0);
      memory.write(this.path, track.path);
      memory.write(this.tiles, track.tiles);
      const count = BigInt(track.count);
      this.engine.call("start", this.car, this.road, this.path, this.tiles, count);
      [this.painted, this.score] = [false, 0]; // the return so far
    }

    /** Drive one frame of 1/50 second: steering -1 to 1, gas and brake 0 to 1; the reward. */
    step(action) {
      const { memory, engine } = this;
      memory.read(Float64Array, this.action, 3).set(action);
      engine.call("step", this.car, this.road, engine.first, this.action, this.reward);
      const [reward] = memory.read(Float64Array, this.reward, 1);
      this.score += reward; // the engine's own sum lacks the -100 beyond the field
      return reward;
    }

    field(name, Kind, count) {
      return this.memory.read(Kind, this.car + this.facts.car.fields[name], count);
    }

    /** 0 while it drives, 1 after a lap, 2 if it has left the field. */
    get ending() {
      return this.field("ending", Uint8Array, 1)[0];
    }

    get frames() {
      return this.field("frames", Int32Array, 1)[0];
    }

    get tilesVisited() {
      return this.field("tiles_visited", Int32Array, 1)[0];
    }

    get over() {
      return this.ending !== 0 || this.frames >= stad.LONGEST;
    }

    /** Poses for a drawing, in world units and radians; wheels are x, y, angle and rotation. */
    pose() {
      const [position, angle] = [
        this.field("position", Float32Array, 10),
        this.field("angle", Float32Array, 5),
      ];
      const velocity = this.field("velocity", Float32Array, 3);
      const phase = this.field("phase", Float64Array, 4);
      return {
        x: position[0],
        y: position[1],
        angle: angle[0],
        speed: Math.hypot(velocity[0], velocity[1]),
        wheels: [0, 1, 2, 3].map((i) => [
          position[2 + 2 * i],
          position[3 + 2 * i],
          angle[1 + i],
          phase[i],
        ]),
      };
    }

    /** What the agent sees, 64 x 64 x 3 bytes; without the indicator bar if it is cropped. */
    frame(cropBar = false) {
      return this.draw(SIZES.frame, cropBar);
    }

    /** The observation of Gymnasium, 96 x 96 x 3 bytes. */
    observation() {
      return this.draw(SIZES.observation, false);
    }

    draw(size, cropBar) {
      const { memory, engine } = this;
      if (!this.ground) this.makeGround();
      if (!this.painted) this.paint();
      const places = [...this.ground, engine.pattern];
      const rest = [engine.first, this.car, this.road, this.tiles, cropBar ? 0n : 1n];
      engine.call("draw", ...places, ...engine.tables, this.out, BigInt(size), ...rest);
      return memory.read(Uint8Array, this.out, 3 * size * size).slice();
    }

    /** The field without a track: squares of grass, and black around them. */
    makeGround() {
      const { memory, engine } = this;
      const { size, rim, period, cells } = this.facts.ground;
      const texels = new Uint8Array(size * size).fill(OUTSIDE);
      const pattern = memory.read(Uint8Array, engine.pattern, period * period).slice();
      for (let row = rim; row < size - rim; row++)
        for (let column = rim; column < size - rim; column += period) {
          const line = ((row - rim) % period) * period;
          texels.set(pattern.subarray(line, line + period), row * size + column);
        }
      this.ground = GROUND.map(([, bytes]) => memory.take(bytes(size)));
      this.ground.push(memory.take(cells * cells));
      for (const [i, [, bytes]] of GROUND.entries())
        memory.read(Uint8Array, this.ground[i], bytes(size)).fill(0);
      const [at, flags] = [this.ground[0], this.ground[6]];
      memory.write(at, texels);
      memory.read(Uint8Array, flags, cells * cells).fill(1);
      engine.call("mark_edges", at, flags);
      memory.read(Uint8Array, flags, cells * cells).fill(0);
      // Every track begins on the same flagged pattern.
      const begin = (rim + period) * size + rim + period;
      const field = memory.read(Uint8Array, at, size * size);
      const flagged = new Uint8Array(period * period);
      for (let row = 0; row < period; row++)
        flagged.set(field.subarray(begin + row * size, begin + row * size + period), row * period);
      memory.write(engine.pattern, flagged);
    }

    paint() {
      const { memory, engine, track } = this;
      const { polygons, kinds } = stad.roadPolygons(track);
      const top = memory.top;
      const [road, kind] = [memory.put(polygons), memory.put(kinds)];
      const colors = memory.put(Uint8Array.from(this.facts.colors));
      const places = [...this.ground, engine.pattern];
      engine.call("paint", ...places, road, kind, BigInt(kinds.length), colors);
      memory.top = top;
      const darkened = this.road + this.facts.road.fields.darkened;
      const flags = memory.read(Uint8Array, darkened, MOST_TILES);
      for (let i = 0; i < flags.length; i++) if (flags[i] === 2) flags[i] = 1;
      this.painted = true;
    }
  };

  /** Tiles and kerbs in the order in which Gymnasium draws them: a kerb follows its tile. */
  stad.roadPolygons = (track) => {
    const count = track.count + track.kerbTiles.length;
    const [polygons, kinds] = [new Float64Array(8 * count), new Uint8Array(count)];
    let [place, kerb] = [0, 0];
    for (let tile = 0; tile < track.count; tile++) {
      kinds[place] = ROAD + (tile % 3);
      polygons.set(track.tiles.subarray(8 * tile, 8 * tile + 8), 8 * place++);
      if (track.kerbTiles[kerb] === tile) {
        kinds[place] = tile % 2 ? RED : WHITE;
        polygons.set(track.kerbs.subarray(8 * kerb, 8 * kerb + 8), 8 * place++);
        kerb++;
      }
    }
    return { polygons, kinds };
  };
}
