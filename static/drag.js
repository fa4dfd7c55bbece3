// Dragging a link of an arm with the tool Drag link, or with Ctrl (or Cmd). Every message contains the start and the current position of the pointer, so
// that lost messages do not matter. Needs page.js.
(() => {
  "use strict";

  const PAUSE = 33; // between two messages [ms]
  const isPicture = (event) => window.carts?.view.endoscope && event.target === window.__viserMutable?.canvas;
  let held = null;

  function send() {
    if (!held) return;
    held.waiting = false;
    const { gesture, camera, start, end } = held;
    window.carts.report("Dragged", { gesture, camera, start, end });
  }

  setInterval(send, 2000); // keep the gesture alive while the pointer rests with its button down

  const cursor = (name) => window.carts.setCursor(name);
  const wanted = (event) => event.ctrlKey || event.metaKey || (window.carts?.brush().tool === "drag link" && !event.shiftKey);

  window.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || !wanted(event) || !isPicture(event)) return;
    const at = window.carts.imageAt(event);
    if (!at) return;
    held = { gesture: Date.now(), camera: at[0], start: [at[1], at[2]], end: [at[1], at[2]], waiting: false };
    cursor("grabbing");
    send();
  }, { capture: true });
  window.addEventListener("pointermove", (event) => {
    const at = held && window.carts.imageAt(event, held.camera);
    if (!at) return;
    held.end = [at[1], at[2]];
    if (!held.waiting) {
      held.waiting = true;
      setTimeout(send, PAUSE);
    }
  }, { capture: true });
  window.addEventListener("pointerup", () => {
    if (!held) return;
    send();
    held = null;
    cursor("");
    window.carts.released();
  }, { capture: true });
  for (const kind of ["keydown", "keyup"]) {
    window.addEventListener(kind, (event) => {
      if (!held && ["Control", "Meta"].includes(event.key)) cursor(kind === "keydown" ? "grab" : "");
    }, { capture: true });
  }
  window.addEventListener("blur", () => { if (!held) cursor(""); });
})();
