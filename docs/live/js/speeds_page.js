"use strict";
// The page "The three speeds": the reader bets on the speed, from one frame or with a difference
// image, and sees one place at all three speeds.

stad.start(async () => {
  const { places, speeds: moving, strides, frameOf: recorded } = await stad.loadSpeeds();
  const speeds = [0, ...moving];
  const names = ["It is parked", `It drives at ${moving[0]}`, `It races at ${moving[1]}`];
  const score = { frame: { right: 0, all: 0 }, difference: { right: 0, all: 0 } };
  const round = { place: 4, truth: 0, bet: null, sight: "frame" };
  let stride = 2; // its number in `strides`

  /** A frame of a place: the present one, or that of a speed some frames ago. */
  const frameOf = (place, speed = 0) => recorded(place, speed, stride);

  const differenceOf = (speed) =>
    stad.differenceImage(frameOf(round.place), frameOf(round.place, speed));
  const meanChange = (difference) =>
    difference.reduce((sum, value) => sum + Math.abs(value), 0) / difference.length;

  const buttons = names.map((name, speed) => {
    const button = document.createElement("button");
    [button.type, button.textContent] = ["button", name];
    button.addEventListener("click", () => bet(speed));
    stad.get("bets").append(button);
    return button;
  });
  const figures = speeds.map((speed) => {
    const column = document.createElement("div");
    const title = speed ? `speed ${speed}` : "parked";
    column.innerHTML =
      `<h3>${title}</h3>` + ["frame", "earlier", "difference"].map(picture).join("");
    stad.get("three").append(column);
    return Object.fromEntries(
      ["frame", "earlier", "difference"].map((kind) => [kind, column.querySelector(`.${kind}`)]),
    );
  });

  function picture(kind) {
    const canvas = `<canvas class="pixels" width="64" height="64" role="img"></canvas>`;
    return `<figure class="${kind}">${canvas}<figcaption></figcaption></figure>`;
  }

  function nextRound() {
    const step = 1 + Math.floor(Math.random() * (places - 1)); // always another place
    round.place = (round.place + step) % places;
    round.truth = Math.floor(Math.random() * speeds.length);
    round.bet = null;
    show();
  }

  function bet(speed) {
    if (round.bet !== null) return; // a second click on the same car
    round.bet = speed;
    const count = score[round.sight];
    count.all += 1;
    count.right += Number(speed === round.truth);
    show();
    stad.get("next-car").focus({ preventScroll: true });
    stad.announce(stad.get("answer").textContent);
  }

  function show() {
    const done = round.bet !== null;
    const seen = done || round.sight === "difference";
    const difference = differenceOf(round.truth);
    stad.paintFrame(stad.get("frame"), frameOf(round.place));
    stad.describe(stad.get("frame"), `Frame of place ${round.place + 1}: a road seen from above.`);
    stad.paintDifference(stad.get("difference"), seen ? difference : difference.fill(0));
    const size = meanChange(difference).toFixed(3);
    stad.describe(
      stad.get("difference"),
      seen ? `Difference image; mean change ${size}.` : "The difference image is hidden.",
    );
    stad.get("veil").hidden = seen;
    buttons.forEach((button, speed) => {
      button.disabled = done;
      button.classList.toggle("right", done && speed === round.truth);
      button.classList.toggle("wrong", done && speed === round.bet && speed !== round.truth);
    });
    stad.get("next-car").hidden = !done;
    stad.get("answer").textContent = done ? verdict() : "";
    for (const sight of ["frame", "difference"])
      for (const part of ["right", "all"])
        stad.get(`${part}-${sight}`).textContent = score[sight][part];
    showAll();
  }

  function verdict() {
    const truth = names[round.truth].replace("It", "it");
    return round.bet === round.truth ? `Right: ${truth}.` : `No: ${truth}.`;
  }

  function showAll() {
    if (!stad.get("all-three").open) return;
    for (const output of document.querySelectorAll("output.stride"))
      output.textContent = strides[stride];
    stad.get("stride").setAttribute("aria-valuetext", `${strides[stride]} frames`);
    speeds.forEach((speed, number) => {
      const difference = differenceOf(number);
      const car = speed ? `a car at speed ${speed}` : "a parked car";
      const change = meanChange(difference).toFixed(3);
      fill(figures[number].frame, stad.paintFrame, frameOf(round.place), "now", `Frame of ${car}.`);
      fill(
        figures[number].earlier,
        stad.paintFrame,
        frameOf(round.place, number),
        `${strides[stride]} frames ago`,
        `Frame of ${car}, ${strides[stride]} frames ago.`,
      );
      fill(
        figures[number].difference,
        stad.paintDifference,
        difference,
        `difference, mean ${change}`,
        `Difference image of ${car}, mean change ${change}.`,
      );
    });
  }

  function fill(figure, paint, pixels, caption, description) {
    const canvas = figure.querySelector("canvas");
    paint(canvas, pixels);
    figure.querySelector("figcaption").textContent = caption;
    stad.describe(canvas, description);
  }

  stad.get("next-car").addEventListener("click", () => {
    nextRound();
    buttons[0].focus({ preventScroll: true });
  });
  stad.get("all-three").addEventListener("toggle", showAll);
  stad.get("stride").addEventListener("input", (event) => {
    stride = Number(event.target.value);
    show();
  });
  for (const radio of document.querySelectorAll("[name=sight]"))
    radio.addEventListener("change", () => {
      round.sight = radio.value;
      nextRound(); // another car: the difference image of this one may have been seen
    });
  nextRound();
});
