"use strict";
// The page "Move a latent".

stad.start(async () => {
  const [LARGE, REACH, TILES] = [6, 4, 7]; // sliders on top; of a slider; tiles along the map
  const get = stad.get;
  const vaes = new Map();
  const [drive, descriptions] = await Promise.all([stad.Drive.load(), stad.load("latents")]);
  let [variant, t, vae, z] = ["input_output", 120, null, null];
  let [choice, tiling, waiting] = [0, 0, 0]; // numbers of the newest V and map, and a timer
  let axes = [0, 1]; // the latents of the map
  const sliders = new Map(); // latent -> its slider and number
  const random = new stad.Random(1);

  // The first slider moves by itself until the reader takes over.
  let phase = 0;
  const wave = new stad.Clock(() => (phase += 1 / 50), drawWave);

  function drawWave() {
    const [first] = order();
    set(first, vae.mu[first] + 2 * Math.sin(1.6 * phase));
    show();
  }

  function stopWave() {
    if (wave.running) renewMap(); // the first latent has moved
    wave.pause();
    get("wave").textContent = "Move the slider";
  }

  /** The latents, those with the largest KL first. */
  function order() {
    return descriptions[variant].map((_, i) => i).sort((a, b) => kl(b) - kl(a));
  }

  function kl(i) {
    return descriptions[variant][i].kl;
  }

  async function choose(name) {
    const mine = ++choice;
    if (!vaes.has(name)) vaes.set(name, stad.VAE.load(name));
    let loaded;
    try {
      loaded = await vaes.get(name);
    } catch (error) {
      vaes.delete(name);
      if (mine !== choice) return;
      throw error;
    }
    if (mine !== choice) return; // the reader has chosen another one meanwhile
    [variant, vae] = [name, loaded];
    buildSliders();
    encode();
    stad.announce(`V is now ${name}.`);
    stad.recover();
  }

  function buildSliders() {
    sliders.clear();
    const sorted = order();
    axes = sorted.slice(0, 2);
    for (const [id, some] of [
      ["large", sorted.slice(0, LARGE)],
      ["rest", sorted.slice(LARGE)],
    ]) {
      get(id).replaceChildren(...some.map(slider));
    }
    for (const [id, place] of [
      ["across", 0],
      ["up", 1],
    ]) {
      get(id).replaceChildren(
        ...sorted.map((i) => new Option(`z[${i}], ${kl(i).toFixed(2)} nats`, i)),
      );
      get(id).value = axes[place];
    }
    const [sees, decodes] = [vae.seesDifference, vae.reconstructsDifference];
    get("sees-frame").textContent = "seen by V";
    get("sees-difference").textContent = sees ? "seen by V" : "not seen by this V";
    get("decodes-difference").lastChild.textContent = decodes
      ? "Decoded difference"
      : "This V decodes no difference image.";
    get("decoded-difference").style.opacity = decodes ? 1 : 0.25;
  }

  function slider(i) {
    const { quantity, r } = descriptions[variant][i];
    const label = document.createElement("label");
    const [name, range, value] = ["span", "input", "output"].map((tag) =>
      document.createElement(tag),
    );
    value.setAttribute("aria-live", "off"); // it changes while the first latent moves by itself
    const meaning = Math.abs(r) >= 0.5 ? `<b>${quantity}</b> (r = ${r.toFixed(2)}): ` : "";
    name.innerHTML = `${meaning}z[${i}], ${kl(i).toFixed(2)} nats`;
    Object.assign(range, { type: "range", min: -REACH, max: REACH, step: 0.05 });
    range.addEventListener("input", () => {
      stopWave();
      set(i, Number(range.value));
      show();
      renewMap();
    });
    label.append(name, range, value);
    sliders.set(i, { range, value });
    return label;
  }

  /** Change one latent, and its slider. */
  function set(i, value) {
    z[i] = value;
    const { range, value: number } = sliders.get(i);
    range.value = value;
    number.textContent = stad.fixed(value, 2);
  }

  /** Encode the present frame, and take its z. */
  function encode() {
    const mu = vae.encodeMean(drive.bytes(t), drive.bytes(drive.earlier(t)));
    vae.mu = mu;
    take(mu);
    stad.paintFrame(get("frame"), drive.frame(t));
    stad.paintDifference(get("difference"), drive.difference(t));
    stad.describe(get("frame"), `recorded frame ${t}`);
    stad.describe(get("difference"), `difference image of frame ${t}`);
    get("scrub-value").textContent = t;
  }

  /** Take these 32 numbers. */
  function take(values) {
    z = Float32Array.from(values);
    z.forEach((value, i) => set(i, value));
    show();
    renewMap();
  }

  function show() {
    const decoded = vae.decode(z);
    stad.paintFrame(get("decoded"), decoded.frame);
    const blank = () => decoded.frame.map(() => 0);
    stad.paintDifference(get("decoded-difference"), decoded.difference ?? blank());
    const error = stad.rmsDistance(decoded.frame, drive.frame(t)).toFixed(3);
    get("error").textContent = `RMS error ${error}`;
    placePoint();
    const moved = z.reduce((count, one, i) => count + (Math.abs(one - vae.mu[i]) > 0.026), 0);
    const state = moved ? `${moved} of 32 latents moved` : "no latent moved";
    stad.describe(get("decoded"), `frame decoded by V ${variant}, ${state}, RMS error ${error}`);
    stad.describe(
      get("decoded-difference"),
      decoded.difference ? `difference image decoded, ${state}` : "no decoded difference image",
    );
  }

  // The map
  const toValue = (share) => REACH * (2 * share - 1);

  function placePoint() {
    const share = (i) => Math.min(1, Math.max(0, (z[i] / REACH + 1) / 2));
    get("point").style.left = `${100 * share(axes[0])}%`;
    get("point").style.top = `${100 * (1 - share(axes[1]))}%`;
  }

  /** Decode the tiles again when the reader has rested for a moment. */
  function renewMap() {
    clearTimeout(waiting);
    tiling += 1; // stops the map in progress
    waiting = setTimeout(drawMap, 200);
  }

  async function drawMap() {
    const mine = ++tiling;
    const context = get("tiles").getContext("2d");
    const tile = document.createElement("canvas");
    tile.width = tile.height = stad.FRAME_SIZE;
    const place = (number) => [number % TILES, Math.floor(number / TILES)];
    const far = (number) => {
      const [x, y] = place(number);
      return Math.hypot(x - (TILES - 1) / 2, y - (TILES - 1) / 2);
    };
    const left = Array.from({ length: TILES ** 2 }, (_, n) => n).sort((a, b) => far(a) - far(b));
    await stad.inBackground(() => {
      if (mine !== tiling || !left.length) return false;
      const [x, y] = place(left.shift());
      const there = Float32Array.from(z);
      there[axes[0]] = toValue((x + 0.5) / TILES);
      there[axes[1]] = toValue(1 - (y + 0.5) / TILES);
      stad.paintFrame(tile, vae.decode(there).frame);
      context.drawImage(tile, x * stad.FRAME_SIZE, y * stad.FRAME_SIZE);
      return true;
    });
    const text = `${TILES} x ${TILES} decoded frames: z[${axes[0]}] to the right, z[${axes[1]}] up`;
    stad.describe(get("tiles"), text);
  }

  function moveTo(across, up) {
    const bound = (value) => Math.min(REACH, Math.max(-REACH, value));
    stopWave();
    set(axes[0], bound(across));
    set(axes[1], bound(up));
    show();
    stad.announce(axes.map((i) => `z[${i}] ${stad.fixed(z[i], 2)}`).join(", "));
  }

  const map = get("map");
  const drag = (event) => {
    const box = map.getBoundingClientRect();
    const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    moveTo(toValue(x), toValue(1 - y));
  };
  map.addEventListener("pointerdown", (event) => {
    map.setPointerCapture(event.pointerId);
    drag(event);
  });
  map.addEventListener("pointermove", (event) => {
    if (map.hasPointerCapture(event.pointerId)) drag(event);
  });
  map.addEventListener("keydown", (event) => {
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const way = ways[event.key];
    if (!way || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    const size = event.shiftKey ? 1 : 0.2;
    moveTo(z[axes[0]] + size * way[0], z[axes[1]] + size * way[1]);
  });

  // Controls
  get("variant").addEventListener("change", ({ target }) => {
    stopWave();
    choose(target.value).catch(stad.fail);
  });
  get("scrub").addEventListener("input", ({ target }) => {
    stopWave();
    t = Number(target.value);
    encode();
  });
  get("reset").addEventListener("click", () => {
    stopWave();
    take(vae.mu);
    stad.announce(`All latents are those of frame ${t}.`);
  });
  get("random").addEventListener("click", () => {
    stopWave();
    take(Float32Array.from(z, () => random.normal()));
    stad.announce("All latents are random numbers of a normal distribution.");
  });
  get("wave").addEventListener("click", () => {
    if (wave.running) return stopWave();
    wave.play();
    get("wave").textContent = "Stop the slider";
  });
  for (const [id, place] of [
    ["across", 0],
    ["up", 1],
  ])
    get(id).addEventListener("change", ({ target }) => {
      stopWave();
      const other = get(id === "up" ? "across" : "up");
      if (target.value === other.value) other.value = axes[1 - place] = axes[place]; // they swap
      axes[place] = Number(target.value);
      show();
      renewMap();
    });

  await choose(variant);
  if (stad.prefersStill()) stopWave();
  else wave.play();
  stad.page = { drive, vaes, wave, latents: () => z }; // for the tests
});
