"use strict";
// What the live pages share: start, messages, text alternatives, the clock and the theme.
globalThis.stad ??= {};

/** The element with an id. */
stad.get = (id) => document.getElementById(id);

/** Set a text only if it changes, so that a screen reader hears it once. */
stad.setText = (element, text) => {
  if (element.textContent !== text) element.textContent = text;
};

/** Colours that the colour-blind tell apart. */
stad.COLORS = {
  blue: "#0072B2",
  orange: "#E69F00",
  green: "#009E73",
  red: "#D55E00",
  purple: "#CC79A7",
  sky: "#56B4E9",
};

// What a page stumbles over when it lacks a script says nothing to its reader.
addEventListener(
  "error",
  ({ target }) => {
    const waits = target.tagName === "SCRIPT" && stad.get("live")?.dataset.state === "loading";
    if (!waits || !target.src.includes("/js/")) return; // data has a message of its own
    stad.lost = "A script did not arrive. Please reload the page.";
    stad.get("message").textContent = stad.lost;
  },
  true,
);

{
  const SECOND = 1000; // milliseconds between two texts, so that a screen reader keeps up

  /**
   * Start a page: run `main`, then uncover the controls. An error becomes a sentence on the page.
   * The page has elements `live` (all of it), `message` and `news`.
   * @param {() => Promise<void>} main
   */
  stad.start = async (main) => {
    stad.forget(stad.get("live"));
    stad.quieten(stad.get("live"));
    const controls = enclose();
    try {
      await main();
      controls.disabled = controls.inert = false;
      stad.recover();
    } catch (error) {
      stad.fail(error);
    }
  };

  /** Put the page, but for parts that wait for nothing, into a fieldset that takes no input yet. */
  function enclose() {
    const fieldset = document.createElement("fieldset");
    fieldset.setAttribute("role", "presentation");
    fieldset.disabled = fieldset.inert = true;
    const parts = [...stad.get("live").children];
    const apart = parts.find((one) => one.matches("[data-apart]")) ?? null;
    fieldset.append(...parts.filter((one) => !one.matches("#message, #news, [data-apart]")));
    stad.get("live").insertBefore(fieldset, apart);
    return fieldset;
  }

  /** All parts work, maybe again. */
  stad.recover = () => {
    stad.get("message").hidden = true;
    stad.get("live").dataset.state = "ready";
  };

  /** Show an error as a sentence. */
  stad.fail = (error) => {
    stad.get("message").hidden = false;
    stad.get("message").textContent =
      stad.lost ?? `This part of the page does not work. ${error.message}`;
    stad.get("live").dataset.state = "failed";
    console.error(error);
  };

  /** A function that calls `act` at most once a second, in the end with the newest argument. */
  stad.atMostOnceASecond = (act) => {
    let [last, timer] = [-Infinity, 0];
    return (argument) => {
      clearTimeout(timer);
      const run = () => {
        last = performance.now();
        act(argument);
      };
      const wait = last + SECOND - performance.now();
      if (wait <= 0) run();
      else timer = setTimeout(run, wait);
    };
  };

  /** Tell a screen reader what happened, in the polite live region `news`. */
  stad.announce = stad.atMostOnceASecond((text) => {
    stad.get("news").textContent = text;
  });

  const describers = new WeakMap();

  /** Set the text alternative of a canvas, at most once a second. */
  stad.describe = (canvas, text) => {
    if (!describers.has(canvas))
      describers.set(
        canvas,
        stad.atMostOnceASecond((newest) => canvas.setAttribute("aria-label", newest)),
      );
    describers.get(canvas)(text);
  };
}

/** Controls as the page has them: after a reload Firefox keeps values that no script knows. */
stad.forget = (root) => {
  for (const one of root.querySelectorAll("input"))
    [one.value, one.checked] = [one.defaultValue, one.defaultChecked];
  for (const one of root.querySelectorAll("select")) {
    const chosen = [...one.options].findIndex((option) => option.defaultSelected);
    one.selectedIndex = Math.max(0, chosen);
  }
};

/** An output is a live region by itself: one that changes 50 times a second must not be read. */
stad.quieten = (root) => {
  for (const one of root.querySelectorAll("output")) one.setAttribute("aria-live", "off");
};

/** A number with so many decimals, and no negative zero. */
stad.fixed = (value, digits = 0) => value.toFixed(digits).replace(/^-(?=[0.]*$)/, "");

/** Whether the reader has asked the system for less motion: then nothing moves by itself. */
stad.prefersStill = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

/** A colour of the present theme, for example "--color-foreground-primary". */
stad.color = (name) => getComputedStyle(document.body).getPropertyValue(name).trim();

/** Call `act` whenever the reader or the system changes between light and dark. */
stad.onTheme = (act) => {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", act);
  new MutationObserver(act).observe(document.body, { attributeFilter: ["data-theme"] });
};

/** Steps at a fixed rate, and a picture whenever the screen takes one. */
stad.Clock = class {
  /**
   * @param {() => void} step
   * @param {() => void} draw
   * @param {number} rate steps a second; a slow device makes fewer, and never lags behind
   */
  constructor(step, draw, rate = 50) {
    [this.step, this.draw, this.interval] = [step, draw, 1000 / rate];
    this.running = false;
  }

  play() {
    if (this.running) return;
    this.running = true;
    this.due = performance.now();
    this.wait();
  }

  pause() {
    this.running = false;
  }

  /** Ask for the next frame of the screen, once. */
  wait() {
    cancelAnimationFrame(this.request);
    this.request = requestAnimationFrame((now) => this.tick(now));
  }

  tick(now) {
    if (!this.running) return;
    const longest = 3; // steps between two pictures: more would look like a jump
    this.due = Math.max(this.due, now - longest * this.interval);
    let stepped = false;
    const end = performance.now() + 20; // milliseconds, which leave time for input
    while (this.running && this.due <= now && performance.now() < end) {
      this.due += this.interval;
      this.step();
      stepped = true;
    }
    if (stepped) this.draw();
    if (this.running) this.wait();
  }
};

/**
 * Do small pieces of work one after another while the page stays responsive.
 * @param {() => boolean} work one piece; returns false when all is done
 */
stad.inBackground = async (work) => {
  for (let going = true; going;) {
    const end = performance.now() + 8; // milliseconds between two pauses
    while (going && performance.now() < end) going = work();
    await stad.pause();
  }
};
