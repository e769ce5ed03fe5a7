"use strict";
// The reader at the wheel, with keys, touch pedals or a gamepad.
globalThis.stad ??= {};

/** Stick and triggers of the first gamepad that is in use: they need no smoothing. */
stad.readGamepad = () => {
  for (const pad of navigator.getGamepads?.() ?? []) {
    if (!pad || pad.axes.length < 1) continue;
    const asked = [pad.axes[0], pad.buttons[7]?.value ?? 0, pad.buttons[6]?.value ?? 0];
    // A worn stick or trigger does not rest at 0.
    const [steering, gas, brake] = asked.map((value) => (Math.abs(value) < 0.1 ? 0 : value));
    if (steering || gas || brake) return [steering, gas, brake];
  }
  return null;
};

/** Pedals as a driver. Keys are binary and steering is continuous, so the action is smoothed. */
stad.Hand = class {
  constructor() {
    this.held = new Map(); // key or button that is down -> its pedal
    this.action = new Float32Array(3); // the last one, which may be C's
    this.gamepad = null;
  }

  /** The next action, one small change from the last one. As stad_course/play/session.py. */
  act() {
    const [full, press, release] = [
      [1, 0.7, 0.8],
      [0.08, 0.04, 0.1],
      [0.16, 0.08, 0.4],
    ];
    const pedals = new Set(this.held.values());
    const down = (pedal) => Number(pedals.has(pedal));
    [down("right") - down("left"), down("gas"), down("brake")].forEach((pressed, i) => {
      const [wanted, now] = [pressed * full[i], this.action[i]];
      const towards = Math.abs(wanted) > Math.abs(now) || wanted * now < 0;
      const step = towards ? press[i] : release[i];
      this.action[i] += Math.max(-step, Math.min(step, wanted - now));
    });
    const gamepad = this.gamepad ?? stad.readGamepad(); // a worker is told what the page has read
    if (gamepad) this.action.set(gamepad);
    return this.action.slice();
  }
};

{
  const KEYS = {
    ArrowLeft: "left",
    ArrowRight: "right",
    ArrowUp: "gas",
    ArrowDown: "brake",
    KeyA: "left",
    KeyD: "right",
    KeyW: "gas",
    KeyS: "brake",
  };
  stad.PEDAL_KEYS = KEYS;

  /**
   * Let keys and buttons drive.
   * @param {stad.Hand} hand
   * @param {Element} seat keys drive while the focus is in it; its buttons have data-pedal
   * @param {() => void} take called when the reader presses a pedal
   * @param {() => boolean} drives whether keys drive outside the seat, too
   */
  stad.listenToPedals = (hand, seat, take, drives) => {
    const hold = (source, pedal) => {
      hand.held.set(source, pedal);
      mark();
      take();
    };
    const release = (source) => {
      if (hand.held.delete(source)) mark();
    };
    const releaseAll = () => {
      hand.held.clear(); // a release elsewhere is not seen
      mark();
    };
    const mark = () => {
      const pedals = new Set(hand.held.values());
      for (const button of buttons)
        button.classList.toggle("held", pedals.has(button.dataset.pedal));
    };
    const buttons = [...seat.querySelectorAll("[data-pedal]")];

    document.addEventListener("keydown", (event) => {
      if (!seat.contains(event.target) && !drives()) return;
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      const pressed = event.key === " " || event.key === "Enter";
      const pedal = KEYS[event.code] ?? (pressed ? event.target.dataset?.pedal : undefined);
      if (!pedal || event.target.matches("input, select, textarea")) return;
      event.preventDefault(); // arrow keys would move the page
      if (!event.repeat) hold(event.code, pedal);
    });
    addEventListener("keyup", (event) => release(event.code));
    addEventListener("blur", releaseAll);
    seat.addEventListener("focusout", (event) => {
      if (!seat.contains(event.relatedTarget)) releaseAll();
    });
    for (const button of buttons) {
      button.addEventListener("pointerdown", (event) => {
        event.preventDefault(); // no selection, and the focus stays
        button.setPointerCapture(event.pointerId);
        hold(event.pointerId, button.dataset.pedal);
      });
      for (const end of ["pointerup", "pointercancel", "lostpointercapture"])
        button.addEventListener(end, (event) => release(event.pointerId));
      button.addEventListener("contextmenu", (event) => event.preventDefault());
    }
  };
}
