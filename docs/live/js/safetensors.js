"use strict";
// Weights and data: scripts that carry base64, and the tensors in it.
//
// A page that is opened from the disk may load scripts but not read files, so the site's build
// wraps every file into a script `data/NAME.js`, which fills `stad.data.NAME`.
globalThis.stad ??= {};
stad.data ??= {};

{
  const folder = new URL("../data/", document.currentScript.src);
  const loading = new Map();

  /**
   * Load `data/NAME.js` once.
   * @param {string} name
   * @returns {Promise<any>} the value of `stad.data.NAME`
   */
  stad.load = (name) => {
    if (!loading.has(name)) {
      loading.set(
        name,
        new Promise((done, fail) => {
          const script = document.createElement("script");
          script.src = new URL(`${name}.js`, folder).href;
          script.onload = () => done(stad.data[name]);
          script.onerror = () => {
            loading.delete(name); // another attempt may succeed
            const cure = "Reload the page (or, in your own copy, build the site again).";
            fail(new Error(`data/${name}.js did not arrive. ${cure}`));
          };
          document.head.append(script);
        }),
      );
    }
    return loading.get(name);
  };

  /** Let the browser handle input and draw, then continue. */
  stad.pause = () => {
    return new Promise((done) => {
      const channel = new MessageChannel(); // a timer would wait at least 4 ms
      channel.port1.onmessage = () => {
        channel.port1.close(); // an open port keeps the page in memory
        done();
      };
      channel.port2.postMessage(null);
    });
  };

  const PIECE = 1 << 17; // characters that are decoded at once; a multiple of 4

  /**
   * Decode base64, with pauses: a megabyte at once would block the page.
   * @param {string} base64
   * @returns {Promise<Uint8Array>}
   */
  stad.decodeBase64 = async (base64) => {
    const padding = base64.endsWith("==") ? 2 : base64.endsWith("=") ? 1 : 0;
    const bytes = new Uint8Array((base64.length / 4) * 3 - padding);
    for (let start = 0, end = 0; start < base64.length; start += PIECE) {
      const text = atob(base64.slice(start, start + PIECE));
      for (let i = 0; i < text.length; i++) bytes[end++] = text.charCodeAt(i);
      await stad.pause();
    }
    return bytes;
  };

  /** Bytes of a gzip file in base64. */
  stad.unpack = async (base64) => {
    const packed = new Blob([await stad.decodeBase64(base64)]).stream();
    const stream = packed.pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };

  /**
   * The tensors of a safetensors file: a header in JSON, and then the numbers.
   * @param {Uint8Array} bytes
   * @returns {Object<string, {shape: number[], data: Float32Array | Float64Array}>}
   */
  stad.readSafetensors = (bytes) => {
    const length = Number(new DataView(bytes.buffer, bytes.byteOffset).getBigUint64(0, true));
    const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + length)));
    const tensors = {};
    for (const [name, { dtype, shape, data_offsets: offsets }] of Object.entries(header)) {
      if (name === "__metadata__") continue;
      const [begin, end] = offsets.map((offset) => 8 + length + offset);
      tensors[name] = { shape, data: numbers(dtype, bytes.slice(begin, end).buffer, name) };
    }
    return tensors;
  };

  function numbers(dtype, buffer, name) {
    if (dtype === "F16") return halves(new Uint16Array(buffer));
    if (dtype === "F32") return new Float32Array(buffer);
    if (dtype === "F64") return new Float64Array(buffer);
    throw new Error(`tensor ${name} has dtype ${dtype}: expected F16, F32 or F64`);
  }

  /** Half precision (1 bit sign, 5 exponent, 10 fraction) as single precision, without rounding. */
  function halves(bits) {
    // Exponent 0 is for numbers below 2^-14, without the leading 1. 31 (infinity) is not used.
    const scale = Float64Array.from({ length: 32 }, (_, exponent) => 2 ** (exponent - 25));
    scale[0] = scale[1];
    const values = new Float32Array(bits.length);
    for (let i = 0; i < bits.length; i++) {
      const exponent = (bits[i] >> 10) & 31;
      const fraction = (bits[i] & 1023) + (exponent ? 1024 : 0);
      values[i] = bits[i] >> 15 ? -fraction * scale[exponent] : fraction * scale[exponent];
    }
    return values;
  }

  /** The tensors of `data/NAME.js`. */
  stad.loadTensors = async (name) => {
    const bytes = await stad.decodeBase64(await stad.load(name));
    const tensors = stad.readSafetensors(bytes);
    await stad.pause();
    return tensors;
  };

  let engine = null;

  /** The compiled engine in this page's own thread, loaded once. */
  stad.loadEngine = () => {
    engine ??= (async () => {
      const { code, tables, facts } = await stad.load("engine");
      const [module, rest] = await Promise.all([code, tables].map(stad.unpack));
      return stad.Engine.make(module, facts, rest);
    })();
    engine.catch(() => (engine = null)); // another attempt may succeed
    return engine;
  };
}
