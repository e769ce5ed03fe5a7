// Keys and pedal buttons of the driving widget. JupyterLab runs this in `element`, a part of it.
// Between "drive" and Esc or P all plain keys belong to the game, wherever the pointer is: in
// JupyterLab's command mode D twice would delete the cell. Elsewhere they do while the pointer
// rests on the picture. While a text field has the focus, keys are text.

(function find() {
  const seat = element.closest(".stad-lab-seat");
  const [picture, wire] = [".stad-lab-pixels", ".stad-lab-wire input"].map((name) => seat?.querySelector(name));
  if (!picture || !wire) return setTimeout(find, 50); // not yet on the page

  const pedals = {
    ArrowLeft: "left", ArrowRight: "right", ArrowUp: "gas", ArrowDown: "brake",
    KeyA: "left", KeyD: "right", KeyW: "gas", KeyS: "brake", Space: "brake",
  };
  const buttons = { KeyP: ".stad-lab-drive", KeyT: ".stad-lab-swap" };
  const held = new Map(); // key or button that is down -> its pedal
  let hovered = false, escaped = false, sent = "";

  const typing = () => document.activeElement?.matches("input, textarea, select, [contenteditable=true]");
  const driving = () => seat.classList.contains("stad-lab-driving") && !escaped;
  const listens = () => seat.isConnected && !typing() && (hovered || driving());

  function send() { // the kernel gets the state, not the events: it may skip some, but ends right
    const value = [...new Set(held.values())].join(" ");
    if (value === sent) return;
    wire.value = sent = value;
    wire.dispatchEvent(new Event("input", { bubbles: true }));
  }
  function hold(source, pedal) { held.set(source, pedal); send(); }
  function release(source) { held.delete(source); send(); }
  function releaseAll() { held.clear(); send(); } // a release elsewhere is not seen
  function update() {
    const had = picture.classList.contains("stad-lab-listening");
    picture.classList.toggle("stad-lab-listening", listens());
    if (had && !listens()) releaseAll();
  }

  window.addEventListener("keydown", (event) => {
    if (!listens() || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === "Escape") {
      [escaped, hovered] = [true, false];
      return update();
    }
    const pedal = pedals[event.code], button = buttons[event.code];
    if (!pedal && event.key.length > 1) return; // Enter or Tab, for example
    event.preventDefault();
    event.stopImmediatePropagation();
    if (pedal) hold(event.code, pedal);
    if (!button || event.repeat) return;
    if (event.code === "KeyP") escaped = true; // until "drive" or the pointer gives the keys back
    seat.querySelector(button).click();
    update();
  }, true); // before JupyterLab, which listens on the document
  window.addEventListener("keyup", (event) => held.has(event.code) && release(event.code), true);
  window.addEventListener("blur", releaseAll);
  for (const kind of ["focusin", "focusout"]) document.addEventListener(kind, () => setTimeout(update));

  picture.addEventListener("mouseenter", () => { [hovered, escaped] = [true, false]; update(); });
  picture.addEventListener("mouseleave", () => { hovered = false; update(); });
  new MutationObserver(() => { escaped = false; update(); })
    .observe(seat, { attributes: true, attributeFilter: ["class"] });

  for (const pedal of Object.values(pedals)) {
    const button = seat.querySelector(`.stad-lab-${pedal}`);
    button.addEventListener("pointerdown", () => hold(button, pedal));
    for (const kind of ["pointerup", "pointerleave", "pointercancel"])
      button.addEventListener(kind, () => release(button));
  }
})();
