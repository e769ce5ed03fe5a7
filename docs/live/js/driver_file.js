"use strict";
// A driver that leaves the page: as a file for Python, and in the address of the race.
globalThis.stad ??= {};

/**
 * A file of a controller, as stad_lab/io/weights.py writes it.
 * @param {Float64Array} parameters of a C for z and h
 * @param {Object<string, string | number>} metadata
 * @returns {Promise<Blob>} safetensors
 */
stad.controllerFile = async (parameters, metadata) => {
  if (!globalThis.isSecureContext)
    throw new Error("A download needs an address with https, or the page on your disk.");
  const encode = (text) => new TextEncoder().encode(text);
  const entry = ([name, value]) => `${JSON.stringify(name)}: ${JSON.stringify(value)}`;
  const json = (values) => `{${Object.entries(values).map(entry).join(", ")}}`; // as Python's
  const said = { kind: "controller", ...metadata };
  const facts = `parameters torch.float64 (${parameters.length},)`;
  const checked = await new Blob([encode(json(said) + facts), parameters]).arrayBuffer();
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", checked));
  const checksum = Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
  const shape = { dtype: "F64", shape: [parameters.length] };
  let header = JSON.stringify({
    __metadata__: { stad_lab: json({ ...said, checksum }) },
    parameters: { ...shape, data_offsets: [0, parameters.byteLength] },
  });
  header = encode(header.padEnd(Math.ceil(encode(header).length / 8) * 8));
  const length = new BigUint64Array([BigInt(header.length)]);
  return new Blob([length, header, parameters], { type: "application/octet-stream" });
};

/** The metadata of a safetensors file of ours. */
stad.readMetadata = (bytes) => {
  const length = Number(new DataView(bytes.buffer, bytes.byteOffset).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + length)));
  return JSON.parse(header.__metadata__.stad_lab);
};

/** Parameters of C as text for an address. */
stad.packDriver = (point) => {
  const bytes = new Uint8Array(Float64Array.from(point).buffer);
  const text = Array.from(bytes, (byte) => String.fromCharCode(byte)).join("");
  return btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
};

/** What `packDriver` made of the parameters; null unless it is one of a C for z, h or both. */
stad.unpackDriver = (text, z, h) => {
  try {
    const bytes = Uint8Array.from(atob(text.replaceAll("-", "+").replaceAll("_", "/")), (one) =>
      one.charCodeAt(0),
    );
    const point = new Float64Array(bytes.buffer);
    const known = [z, h, z + h].some((inputs) => point.length === 3 * inputs + 3);
    return known && point.every(Number.isFinite) ? point : null;
  } catch {
    return null; // cut off, or not made by us
  }
};
