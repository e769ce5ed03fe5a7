"use strict";
// What the figures of the story share. A figure is set up when it comes near, and only the one in
// the middle of the window moves.
globalThis.stad ??= {};

{
  const figures = new Map(); // element -> { run: (on) => void } once it is ready
  let middle = null; // the element whose figure moves

  /**
   * Set up the figure `[data-figure=NAME]` when it comes near; its controls work from then on.
   * @param {string} name
   * @param {(part: (name: string) => HTMLElement) => Promise<{run?: (on: boolean) => void}>} make
   *   is given a function that finds the figure's elements `[data-part=NAME]`
   */
  stad.figure = (name, make) => {
    const root = document.querySelector(`[data-figure=${name}]`);
    if (!root) return;
    const part = (id) => root.querySelector(`[data-part=${id}]`);
    const near = new IntersectionObserver(async (entries) => {
      if (!entries.at(-1).isIntersecting) return; // the newest: several may have been waiting
      near.disconnect();
      stad.forget(root);
      stad.quieten(root);
      try {
        figures.set(root, (await make(part)) ?? {});
        root.querySelector("fieldset").disabled = false;
        root.dataset.state = "ready";
        part("message").hidden = true;
        if (root === middle) setRunning(root, true);
      } catch (error) {
        part("message").textContent = `This figure does not work. ${error.message}`;
        root.dataset.state = "failed";
        console.error(error);
      }
    }, { rootMargin: "100% 0px" }); // prettier-ignore
    near.observe(root);
    central.observe(root);
  };

  function setRunning(root, on) {
    figures.get(root)?.run?.(on && !document.hidden);
  }

  // A band in the middle of the window holds at most one figure for most of the time.
  const central = new IntersectionObserver((seen) => {
    for (const { target, isIntersecting } of seen) {
      if (isIntersecting && middle !== target) {
        setRunning(middle, false);
        middle = target;
        setRunning(middle, true);
      } else if (!isIntersecting && middle === target) {
        setRunning(middle, false);
        middle = null;
      }
    }
  }, { rootMargin: "-45% 0px -45% 0px" }); // prettier-ignore
  document.addEventListener("visibilitychange", () => setRunning(middle, true));

  /**
   * Buttons for a bet: the first click counts, and shows which answer is right.
   * @param {HTMLElement} box where they are put
   * @param {string[]} names
   * @param {(choice: number) => number} judge returns the number of the right answer
   * @returns {() => void} allows another bet
   */
  stad.bet = (box, names, judge) => {
    let done = false;
    const buttons = names.map((name, number) => {
      const button = document.createElement("button");
      [button.type, button.textContent] = ["button", name];
      button.addEventListener("click", () => {
        if (done) return;
        done = true;
        const right = judge(number);
        buttons.forEach((one, i) => {
          one.setAttribute("aria-disabled", "true"); // not `disabled`: the focus stays
          one.classList.toggle("right", i === right);
          one.classList.toggle("wrong", i === number && i !== right);
        });
      });
      return button;
    });
    box.replaceChildren(...buttons);
    return () => {
      done = false;
      for (const one of buttons) {
        one.removeAttribute("aria-disabled");
        one.classList.remove("right", "wrong");
      }
    };
  };

  const drivers = new Map();

  /** A shipped agent in this page's own thread; its V and M are loaded once. */
  stad.loadDriver = async (name) => {
    if (!drivers.has(name)) {
      const parts = [stad.VAE.load(name), stad.MDNRNN.load(name), stad.loadController(name)];
      drivers.set(name, Promise.all(parts));
      drivers.get(name).catch(() => drivers.delete(name)); // another attempt may succeed
    }
    const [vae, mdnRnn, parameters] = await drivers.get(name);
    return new stad.Agent(vae, mdnRnn, Float64Array.from(parameters));
  };
}
