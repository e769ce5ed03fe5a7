"use strict";
// "How fast?": three bets on one frame, three with the difference image, then the reader's own.

stad.figure("speed", async (part) => {
  const { places, speeds, strides, frameOf: recorded } = await stad.loadSpeeds();
  const [BLIND, ALL] = [3, 6]; // bets on one frame, and all bets
  const names = ["It is parked", ...speeds.map((speed) => `Speed ${speed}`)];
  const right = [0, 0]; // bets won: on one frame, and with the difference image
  let [round, stride, truth] = [0, 2, 0];

  const frameOf = (speed) => recorded(round % places, speed, stride);
  const again = stad.bet(part("bets"), names, (choice) => {
    const kind = round < BLIND ? 0 : 1;
    right[kind] += Number(choice === truth);
    part("next").hidden = false;
    part("next").textContent = round === ALL - 1 ? "Now change it yourself" : "Next car";
    show(true);
    say(`${choice === truth ? "Right" : "No"}: ${names[truth].toLowerCase()}. ${score()}`);
    part("next").focus({ preventScroll: true });
    return truth;
  });

  const score = () => {
    const done = Math.min(round + 1, ALL);
    const [first, second] = [Math.min(done, BLIND), Math.max(0, done - BLIND)];
    const told = `One frame: ${right[0]} of ${first} right`;
    return second ? `${told}, with the difference image ${right[1]} of ${second}.` : `${told}.`;
  };
  const say = (text) => {
    part("answer").textContent = text;
    stad.announce(text);
  };

  function show(revealed) {
    const open = revealed || round >= BLIND;
    const difference = stad.differenceImage(frameOf(0), frameOf(truth));
    stad.paintFrame(part("frame"), frameOf(0));
    stad.paintDifference(part("difference"), open ? difference : difference.fill(0));
    part("veil").hidden = open;
    const seen = open ? `difference image of a car: ${names[truth].toLowerCase()}` : "hidden";
    stad.describe(part("difference"), round < ALL && !revealed && open ? "difference image" : seen);
  }

  part("next").addEventListener("click", () => {
    round += 1;
    part("next").hidden = true;
    if (round === ALL) return begin();
    truth = Math.floor(Math.random() * names.length);
    again();
    part("answer").textContent = round === BLIND ? "Now you also see what changed." : "";
    show(false);
    part("bets").firstChild.focus({ preventScroll: true });
  });

  /** After the bets the buttons set the speed. */
  function begin() {
    part("own").hidden = false;
    const buttons = names.map((name, speed) => {
      const button = document.createElement("button");
      [button.type, button.textContent] = ["button", name];
      button.addEventListener("click", () => choose(speed));
      return button;
    });
    const choose = (speed) => {
      truth = speed;
      buttons.forEach((one, i) => one.setAttribute("aria-pressed", String(i === speed)));
      show(true);
    };
    part("answer").textContent = score();
    part("bets").replaceChildren(...buttons);
    choose(2);
    buttons[2].focus({ preventScroll: true });
  }
  part("stride").addEventListener("input", ({ target }) => {
    stride = Number(target.value);
    part("stride-value").textContent = strides[stride];
    target.setAttribute("aria-valuetext", `${strides[stride]} frames`);
    show(true);
  });

  truth = Math.floor(Math.random() * names.length);
  show(false);
});
