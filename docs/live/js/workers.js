"use strict";
// Workers with the compiled engine, for pages that may have been opened from the disk.
globalThis.stad ??= {};

/** What this browser lacks for the engine, as a sentence; null if nothing. */
stad.whatIsMissing = () => {
  if (typeof WebAssembly !== "object") return "It needs WebAssembly: please update your browser.";
  if (typeof Worker === "undefined") return "It needs workers: please update your browser.";
  if (typeof DecompressionStream === "undefined")
    return "It needs a newer browser: please update yours.";
  // A module with one SIMD instruction.
  const simd = [
    0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253,
    15, 253, 98, 11,
  ];
  if (!WebAssembly.validate(Uint8Array.from(simd)))
    return "It needs WebAssembly SIMD: please update your browser.";
  return null;
};

/**
 * Workers from the text that the page has: a page from the disk cannot give them a file.
 * @param {"race" | "evolve"} name which source
 * @param {number} count
 * @returns {Promise<{workers: Worker[], engine: object}>} `engine` is what they are to load
 */
stad.startWorkers = async (name, count) => {
  const { code, tables, facts, sources } = await stad.load("engine");
  const url = URL.createObjectURL(new Blob([sources[name]], { type: "text/javascript" }));
  const workers = Array.from({ length: count }, () => new Worker(url));
  for (const worker of workers)
    worker.addEventListener("error", (event) => stad.fail(new Error(event.message)));
  const [module, rest] = await Promise.all([code, tables].map(stad.unpack));
  return { workers, engine: { code: module, facts, tables: rest } };
};
