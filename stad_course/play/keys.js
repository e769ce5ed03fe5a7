// Keys and pedal buttons of the driving widget. JupyterLab runs this in `element`, a part of it.
// From "drive" to Esc or P all plain keys belong to the game, wherever the pointer is: in
// JupyterLab's command mode D twice would delete the cell. The game pauses when its page loses the
// focus, or when a text field gets it.

(function find() {
  const seat = element.closest(".stad-lab-seat");
  const parts = [".stad-lab-stage", ".stad-lab-pixels", ".stad-lab-wire input", ".stad-lab-drive"];
  const [stage, picture, wire, go] = parts.map((name) => seat?.querySelector(name));
  if (!stage || !picture || !wire || !go) return setTimeout(find, 50); // not yet on the page

  const pedals = {
    ArrowLeft: "left", ArrowRight: "right", ArrowUp: "gas", ArrowDown: "brake",
    KeyA: "left", KeyD: "right", KeyW: "gas", KeyS: "brake", Space: "brake",
  };
  const buttons = { KeyT: ".stad-lab-swap", KeyR: ".stad-lab-again" };
  const held = new Map(); // key or button that is down -> its pedal
  let escaped = false, sent = "";

  const fields = "input, textarea, select, [contenteditable=true]";
  const typing = () => document.activeElement?.matches(fields);
  const running = () => go.classList.contains("mod-active");
  // After an episode, too: a key that is still held is no command of JupyterLab.
  const listens = () =>
    seat.isConnected && seat.classList.contains("stad-lab-driving") && !escaped && !typing();

  function send() { // the kernel gets the state, not the events: it may skip some, but ends right
    const value = [...new Set(held.values())].join(" ");
    if (value === sent) return;
    wire.value = sent = value;
    wire.dispatchEvent(new Event("input", { bubbles: true }));
  }
  function hold(source, pedal) { held.set(source, pedal); send(); }
  function release(source) { held.delete(source); send(); }
  function update() {
    stage.classList.toggle("stad-lab-listening", listens());
    if (listens()) return;
    held.clear(); // a release elsewhere is not seen
    send();
  }
  function pause() { // and give the keys back
    escaped = true;
    if (running()) go.click();
    update();
  }
  function take() { // also from another game, which keeps the keys after its episode
    escaped = false;
    window.dispatchEvent(new CustomEvent("stad-lab-take", { detail: seat }));
    update();
  }
  window.addEventListener("stad-lab-take", ({ detail }) => {
    if (detail === seat) return;
    escaped = true;
    update();
  });

  window.addEventListener("keydown", (event) => {
    if (!listens() || event.ctrlKey || event.altKey || event.metaKey) return;
    const pedal = pedals[event.code], button = buttons[event.code];
    const pauses = event.key === "Escape" || event.code === "KeyP";
    if (!pedal && !pauses && event.key.length > 1) return; // Enter or Tab, for example
    event.preventDefault();
    event.stopImmediatePropagation();
    if (pauses) return pause();
    if (pedal) hold(event.code, pedal);
    if (button && !event.repeat) seat.querySelector(button).click();
  }, true); // before JupyterLab, which listens on the document
  window.addEventListener("keyup", (event) => held.has(event.code) && release(event.code), true);

  window.addEventListener("blur", pause);
  document.addEventListener("visibilitychange", () => document.hidden && pause());
  document.addEventListener("focusin", () => typing() && pause());
  picture.addEventListener("click", () => running() || go.click());
  const drives = ".stad-lab-drive, .stad-lab-again, .stad-lab-begin";
  seat.addEventListener("click", ({ isTrusted, target }) => {
    const pauses = target.closest(".stad-lab-drive") && !running();
    if (isTrusted && target.closest(drives) && !pauses) take();
  });
  picture.addEventListener("click", take);
  const changed = () => (seat.classList.contains("stad-lab-driving") ? take() : update());
  new MutationObserver(changed).observe(seat, { attributes: true, attributeFilter: ["class"] });

  for (const pedal of Object.values(pedals)) {
    const button = seat.querySelector(`.stad-lab-${pedal}`);
    button.addEventListener("pointerdown", () => hold(button, pedal));
    for (const kind of ["pointerup", "pointerleave", "pointercancel"])
      button.addEventListener(kind, () => release(button));
  }
})();
