"use strict";
// "Close its eyes": three dreams branch off one drive. And who stays on the dreamed road longer?

{
  const NAME = "input_output";
  const [TRACK, BEGIN] = [7, 80]; // on a straight before a bend
  const SAME = 0.15; // share of pixels that show road in one picture only
  const LASTING = 10; // frames in a row
  const ROWS = 54; // above the indicator bar

  const isRoad = (frame, p) => frame[p + 1] - frame[p] < 0.18; // grass is green

  /** How much two pictures disagree on where the road is: a share of their pixels. */
  function disagreement(first, second) {
    let count = 0;
    const end = 3 * ROWS * stad.FRAME_SIZE;
    for (let p = 0; p < end; p += 3) count += Number(isRoad(first, p) !== isRoad(second, p));
    return (3 * count) / end;
  }

  /** The driver, its V and M, and everything at the instant when the eyes close. */
  async function loadInstant() {
    const [agent, engine] = await Promise.all([stad.loadDriver(NAME), stad.loadEngine()]);
    const [car, { vae, mdnRnn }] = [engine.makeCar(), agent];
    const track = engine.makeTrack(TRACK);
    let instant = null;

    /** Drive the real car up to the instant, and keep it there. */
    async function approach() {
      car.reset(track);
      agent.reset();
      await stad.inBackground(() => {
        car.step(agent.act(car.frame()));
        return car.frames < BEGIN;
      });
      agent.see(car.frame());
      instant = { z: agent.z, state: agent.state };
    }

    const dreamOf = (seed) =>
      new stad.Dream(mdnRnn, instant.z, instant.state, new stad.Random(seed));
    const act = (dream) => stad.control(agent.parameters, dream.z, dream.state.h);
    return { car, agent, vae, approach, dreamOf, act };
  }

  stad.figure("dream", async (part) => {
    const { car, agent, vae, approach, dreamOf, act } = await loadInstant();
    const canvases = [1, 2, 3].map((i) => part(`dream-${i}`));
    const BOUNDS = [50, 150]; // frames between the three answers
    const LONGEST = 400; // frames of a dream
    let [dreams, seed, wanted, over] = [[], 1, true, false];
    let [bet, driving] = [null, false]; // driving: the car is on its way to the instant

    const clock = new stad.Clock(step, draw);

    async function restart() {
      clock.pause();
      driving = true;
      await approach();
      driving = false;
      dreams = canvases.map(() => ({ dream: dreamOf(seed++), apart: null, diverged: null }));
      for (const { dream } of dreams) dream.temperature = Number(part("temperature").value);
      over = false;
      draw();
    }

    async function again() {
      if (driving) return; // there is one car
      part("answer").textContent = "";
      await restart();
      wanted = true;
      clock.play();
      showPlay();
    }

    /** One frame of the real car, from a picture that the agent has seen to the next one. */
    function drive() {
      const action = agent.control();
      agent.remember(action);
      car.step(action);
      agent.see(car.frame());
    }

    function step() {
      for (const { dream } of dreams) dream.step(act(dream));
      if (!car.over) drive();
      if (dreams[0].dream.frames >= LONGEST || car.over) {
        over = true;
        clock.pause();
        showPlay();
      }
    }

    function draw() {
      const real = stad.scaleFrame(car.frame());
      stad.paintFrame(part("real"), real);
      dreams.forEach((one, i) => {
        const { frame } = vae.decode(one.dream.z);
        stad.paintFrame(canvases[i], frame);
        const now = one.dream.frames;
        if (now === 0 || one.diverged !== null) return;
        if (disagreement(frame, real) <= SAME) one.apart = null;
        else one.apart ??= now; // a slow device draws fewer frames than it dreams
        if (one.apart !== null && now - one.apart >= LASTING - 1) one.diverged = one.apart;
      });
      const told = dreams.map(({ diverged }) =>
        diverged === null ? "still together" : `diverged after ${stad.seconds(diverged)} s`,
      );
      told.forEach((text, i) => stad.setText(part(`told-${i + 1}`), text));
      const time = stad.seconds(dreams[0].dream.frames);
      part("time").textContent = `${time} s with closed eyes`;
      stad.describe(part("real"), `the real road, ${time} seconds after the eyes closed`);
      canvases.forEach((canvas, i) => stad.describe(canvas, `dream ${i + 1}, ${told[i]}`));
      const known = dreams.filter(({ diverged }) => diverged !== null).length > 1;
      if (bet && (known || over)) settle();
    }

    /** The bet is on the middle one of three dreams, so it is known when two have diverged. */
    function settle() {
      const middle = dreams.map(({ diverged }) => diverged ?? Infinity).sort((a, b) => a - b)[1];
      const answer = BOUNDS.filter((bound) => middle > bound).length;
      const end = stad.seconds(dreams[0].dream.frames);
      const told =
        middle < Infinity
          ? `the middle one of the three diverged after ${stad.seconds(middle)} seconds.`
          : `two of the three were still together after ${end} seconds, when they ended.`;
      const text = `${bet.choice === answer ? "Right" : "No"}: ${told}`;
      part("answer").textContent = text;
      stad.announce(text);
      bet = null;
    }

    const names = ["Within a second", "One to three seconds", "Later"];
    const box = part("bets");
    box.replaceChildren(
      ...names.map((name, choice) => {
        const button = document.createElement("button");
        [button.type, button.textContent] = ["button", name];
        button.addEventListener("click", () => {
          if (!part("after").hidden) return; // the first bet counts
          bet = { choice };
          button.setAttribute("aria-pressed", "true");
          for (const one of box.children) one.setAttribute("aria-disabled", "true");
          part("after").hidden = false;
          again();
        });
        return button;
      }),
    );
    part("again").addEventListener("click", again);
    function showPlay() {
      part("play").textContent = clock.running ? "Pause" : over ? "Again" : "Go on";
    }
    part("play").addEventListener("click", () => {
      if (driving) return; // the dream begins by itself
      if (over) return again();
      wanted = !clock.running;
      if (wanted) clock.play();
      else clock.pause();
      showPlay();
    });
    part("temperature").addEventListener("input", ({ target }) => {
      part("temperature-value").textContent = Number(target.value).toFixed(1);
      for (const { dream } of dreams) dream.temperature = Number(target.value);
    });
    await restart();
    const begun = () => !part("after").hidden;
    return {
      run(on) {
        if (on && wanted && begun() && !over && !driving) clock.play();
        else clock.pause();
        showPlay();
      },
    };
  });

  stad.figure("wheel", async (part) => {
    const { vae, approach, dreamOf, act } = await loadInstant();
    const LOST = 25; // frames in a row without a road under the car
    const TAKE_OVER = 75; // frames that C drives for the reader at first
    const REST = 1500; // milliseconds after the end in which no key begins again
    const hand = new stad.Hand();
    const best = { you: 0, agent: 0 };
    let [dream, who, over, endedAt, seed] = [null, null, true, -Infinity, 1];
    let [off, seen] = [0, 0]; // frames off the road, up to the frame that was drawn last
    const clock = new stad.Clock(step, draw, 30); // slower than the car, so that one can react
    await approach();
    const own = () => who === "you" && dream.frames >= TAKE_OVER;

    function begin(driver) {
      [dream, who, over, off, seen] = [dreamOf(seed++), driver, false, 0, 0];
      hand.action.fill(0);
      part("answer").textContent = "";
      for (const name of ["you", "agent"]) part(name).setAttribute("aria-pressed", name === who);
      clock.play();
      if (driver === "you") part("seat").focus({ preventScroll: true });
    }

    function step() {
      const action = own() ? hand.act() : act(dream);
      hand.action.set(action);
      dream.step(action);
      const longest = stad.LONGEST + (who === "you" ? TAKE_OVER : 0); // as many for each
      if (dream.frames >= longest) finish("stayed on it to the end.");
    }

    function draw() {
      const { frame } = vae.decode(dream.z);
      stad.paintFrame(part("view"), frame);
      if (over) return;
      off = onRoad(frame) ? 0 : off + dream.frames - seen;
      seen = dream.frames;
      if (who === "you" && !own()) {
        part("seconds").textContent =
          `Take over in ${Math.ceil((TAKE_OVER - dream.frames) / 30)} ...`;
        off = 0;
        return;
      }
      part("seconds").textContent = `${lasted()} s`;
      if (off >= LOST) finish(`left the dreamed road after ${lasted()} seconds.`);
    }

    /** Seconds on the road, at the car's own pace. */
    function lasted() {
      return stad.seconds(Math.max(0, dream.frames - off - (who === "you" ? TAKE_OVER : 0)));
    }

    /** Whether some road lies just beside the car, which is drawn at the bottom middle. */
    function onRoad(frame) {
      let count = 0;
      for (let y = 40; y < 52; y++)
        for (let x = 26; x < 38; x++) count += Number(isRoad(frame, 3 * (64 * y + x)));
      return count > 144 / 3;
    }

    function finish(text) {
      [over, endedAt] = [true, performance.now()];
      clock.pause();
      best[who] = Math.max(best[who], Number(lasted()));
      part("seconds").textContent = `${lasted()} s`;
      part(`best-${who}`).textContent = `${best[who].toFixed(1)} s`;
      const name = who === "you" ? "You" : "The driver (C)";
      part("answer").textContent = `${name} ${text}`;
      stad.announce(`${name} ${text}`);
    }

    part("you").addEventListener("click", () => begin("you"));
    part("agent").addEventListener("click", () => begin("agent"));
    const driving = () => clock.running && who === "you";
    const sits = () => part("seat").contains(document.activeElement);
    const take = () => over && performance.now() - endedAt > REST && begin("you"); // not by chance
    stad.listenToPedals(hand, part("seat"), take, driving);
    // Esc, or to scroll on, gives the arrow keys back to the page.
    document.addEventListener("keydown", ({ key }) => {
      if (key !== "Escape" || !(driving() || sits())) return;
      document.activeElement.blur();
      if (!over) finish(`stopped after ${lasted()} seconds.`);
    });
    dream = dreamOf(seed);
    draw();
    return {
      run(on) {
        if (on && !over) clock.play();
        else clock.pause();
        if (!on && sits()) document.activeElement.blur();
      },
    };
  });
}
