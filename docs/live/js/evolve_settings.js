"use strict";
// What the reader of "Evolve a driver" has chosen: in the controls, in the address, and kept.
globalThis.stad ??= {};

stad.evolveSettings = {
  KEY: "stad-evolve", // in the browser's storage
  LATEST: 3, // evolutions that are kept, each with settings of its own
  SEED: /^\d{1,9}$/,
  NAMES: ["population", "sigma", "decay", "tracks", "sees", "agent", "seed"],

  /** Settings from texts by their names, with the page's own for what is missing or wrong. */
  parse(texts) {
    const found = {};
    for (const name of this.NAMES) {
      const { options, dataset } = stad.get(name);
      const text = texts.get(name) ?? "";
      const valid = options ? [...options].some((one) => one.value === text) : this.SEED.test(text);
      const value = valid ? text : dataset.first;
      found[name] = name === "sees" || name === "agent" ? value : Number(value);
    }
    return found;
  },

  fromControls() {
    return this.parse(new Map(this.NAMES.map((name) => [name, stad.get(name).value])));
  },

  /** What an address asks for in vain; "" if there is nothing. */
  ignored(hash) {
    const asked = new URLSearchParams(hash.slice(1));
    const found = this.parse(asked);
    const vain = this.NAMES.filter(
      (name) => asked.has(name) && asked.get(name) !== `${found[name]}`,
    );
    const told = vain.map((name) => `${name}=${asked.get(name)}`);
    return told.length ? `Ignored in the address: ${told.join(", ")}.` : "";
  },

  /** What is wrong with the seed, the one setting that is typed; null if nothing is. */
  wrong() {
    const { value } = stad.get("seed");
    if (this.SEED.test(value)) return null;
    return `Seed ${value || "(empty)"}: give a whole number from 0 to 999999999.`;
  },

  /** Whether the address names settings, and not just a place on the page. */
  get asked() {
    const asked = new URLSearchParams(location.hash.slice(1));
    return this.NAMES.some((name) => asked.has(name));
  },

  fromAddress() {
    return this.parse(new URLSearchParams(location.hash.slice(1)));
  },

  /** Show settings in the controls and in the address, which leads others to the same evolution. */
  show(settings) {
    for (const name of this.NAMES) stad.get(name).value = settings[name];
    history.replaceState(null, "", `#${new URLSearchParams(settings)}`);
  },

  equal(one, other) {
    return this.NAMES.every((name) => one[name] === other?.[name]);
  },

  /** The evolutions that were kept, the latest one first. */
  get all() {
    try {
      return [JSON.parse(localStorage.getItem(this.KEY)) ?? []].flat(); // once it was a single one
    } catch {
      return [];
    }
  },

  /** The kept evolution with these settings, and the others. */
  split(settings) {
    const same = (one) => this.equal(settings, one.settings);
    return [this.all.find(same), this.all.filter((one) => !same(one))];
  },

  /** Keep an evolution in the place of one with the same settings. */
  keep(state) {
    const [before, others] = this.split(state.settings);
    const count = state.log.length;
    const ahead = // in another tab
      before?.log.length > count && before.log[count - 1]?.checksum === state.log.at(-1)?.checksum;
    this.store([ahead ? before : state, ...others]);
  },

  /** Forget the evolution with these settings. */
  drop(settings) {
    this.store(this.split(settings)[1]);
  },

  /** Keep the first of these; when the storage is full, fewer, and without it none. */
  store(evolutions) {
    for (let count = this.LATEST; count > 0; count--)
      try {
        return localStorage.setItem(this.KEY, JSON.stringify(evolutions.slice(0, count)));
      } catch {
        // try with fewer
      }
  },

  /** The evolution that was kept with the settings in the address, or the latest one. */
  kept() {
    if (!this.asked) return this.all[0];
    return this.split(this.fromAddress())[0];
  },
};
