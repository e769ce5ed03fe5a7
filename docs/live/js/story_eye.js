"use strict";
// "32 numbers": what is left of a frame, and three latents to move.

stad.figure("eye", async (part) => {
  const NAME = "input_output";
  const [RIGHT, REACH] = [1, 4]; // the right answer; how far a slider goes
  const [descriptions, agent] = await Promise.all([stad.load("latents"), stad.loadDriver(NAME)]);
  const { vae } = agent;
  const pictures = await drive();
  let [place, z, guessed] = [0, null, false];

  /** Frames of the agent's own episode on a track, with z of each. */
  async function drive() {
    const [TRACK, FIRST, EVERY, LAST] = [7, 90, 60, 480];
    const engine = await stad.loadEngine();
    const car = engine.makeCar();
    const found = [];
    car.reset(engine.makeTrack(TRACK));
    agent.reset();
    await stad.inBackground(() => {
      const frame = car.frame();
      car.step(agent.act(frame));
      if (car.frames >= FIRST && car.frames % EVERY === 0)
        found.push({ frame: stad.scaleFrame(frame), z: agent.z.slice() });
      return car.frames < LAST && !car.over;
    });
    return found;
  }

  /** For each of three quantities the latent that follows it most. */
  const chosen = ["road offset", "wheel angle", "yaw rate"].map((quantity) => {
    const follows = ({ quantity: name, r }) => (name === quantity ? Math.abs(r) : 0);
    const some = descriptions[NAME];
    return some.reduce((best, one, i) => (follows(one) > follows(some[best]) ? i : best), 0);
  });
  const words = [
    "road offset (place across the road)",
    "wheel angle (steering)",
    "yaw rate (turning)",
  ];
  const sliders = chosen.map((latent, i) => {
    const label = document.createElement("label");
    label.className = "wide";
    label.innerHTML = `<span>${words[i]}: <i>z</i>[${latent}]</span><input type="range">`;
    const range = label.querySelector("input");
    Object.assign(range, { min: -REACH, max: REACH, step: 0.05 });
    range.addEventListener("input", () => {
      z[latent] = Number(range.value);
      decode();
    });
    part("sliders").append(label);
    return range;
  });

  function take(number) {
    place = number % pictures.length;
    z = pictures[place].z.slice();
    sliders.forEach((range, i) => (range.value = z[chosen[i]]));
    stad.paintFrame(part("frame"), pictures[place].frame);
    decode();
  }

  function decode() {
    drawBars();
    if (!guessed) return;
    stad.paintFrame(part("decoded"), vae.decode(z).frame);
    const moved = chosen.filter((latent) => z[latent] !== pictures[place].z[latent]).length;
    stad.describe(part("decoded"), `decoded from 32 numbers, ${moved} of them moved`);
  }

  function drawBars() {
    const color = (i) => (chosen.includes(i) ? stad.COLORS.orange : stad.COLORS.sky);
    stad.drawBars(part("bars"), z, REACH, color);
  }

  stad.bet(part("bets"), ["The bend", "The squares in the grass", "The edge of the road"], () => {
    guessed = true;
    part("veil").hidden = true;
    part("after").hidden = false;
    decode();
    const text = "The squares are gone: leaving them out adds the least error.";
    part("answer").textContent = text;
    stad.announce(text);
    return RIGHT;
  });
  part("another").addEventListener("click", () => take(place + 1));
  part("back").addEventListener("click", () => take(place));
  new ResizeObserver(() => z && drawBars()).observe(part("bars"));
  take(0);
});
