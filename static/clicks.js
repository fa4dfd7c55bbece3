// Marks of clicked points over the image (`.mark` in a document): they follow the image, and are moved by dragging or with
// arrow keys. Needs document.js.
(() => {
  "use strict";

  const STEP = 0.5; // of an arrow key [px of the image]
  const SLOP = 2; // motion that begins a drag [CSS px]
  let drag = null;
  let nudge = null; // mark that is being moved by arrow keys

  const marks = () => document.querySelectorAll(".carts-document .mark");
  const place = (mark) => mark.dataset.at.split(" ").map(Number);
  const within = (value) => Math.min(Math.max(value, 0), 1);
  const report = (name, mark, u, v) => window.carts.report("Chosen", { name: `${name} ${mark.dataset.point}`, value: `${u} ${v}` });

  /** Report the motion by arrow keys since the first one was pressed; documents wait until then. */
  function endNudge() {
    if (!nudge) return;
    const { mark, start } = nudge;
    const [u, v] = place(mark);
    nudge = null;
    report("shift-point", mark, u - start[0], v - start[1]);
    window.carts.holdDocument(false);
  }

  function placeMarks() {
    const box = marks().length ? window.carts.imageBox() : null;
    for (const mark of marks()) {
      const [u, v] = place(mark);
      const [x, y] = box ? [box.left + u * box.width, box.top + v * box.height] : [0, 0];
      const seen = box && x > box.frame.left && x < box.frame.right && y > box.frame.top && y < box.frame.bottom;
      Object.assign(mark.style, { left: `${x}px`, top: `${y}px`, visibility: seen ? "visible" : "hidden" });
    }
  }

  window.addEventListener("pointerdown", (event) => {
    const mark = event.button === 0 && event.target instanceof Element ? event.target.closest(".mark") : null;
    if (!mark) return;
    drag = { mark, from: [event.clientX, event.clientY], start: place(mark), moved: false };
    mark.setPointerCapture(event.pointerId);
  }, { capture: true });
  window.addEventListener("pointermove", (event) => {
    const box = drag && window.carts.imageBox();
    if (!box) return;
    const [x, y] = [event.clientX - drag.from[0], event.clientY - drag.from[1]];
    drag.moved ||= Math.hypot(x, y) > SLOP;
    const [u, v] = drag.start;
    if (drag.moved) drag.mark.dataset.at = `${within(u + x / box.width)} ${within(v + y / box.height)}`;
  }, { capture: true });
  for (const kind of ["pointerup", "pointercancel"]) {
    window.addEventListener(kind, () => {
      if (drag?.moved && kind === "pointerup") report("move-point", drag.mark, ...place(drag.mark));
      else if (drag) drag.mark.dataset.at = drag.start.join(" ");
      drag = null;
    }, { capture: true });
  }
  window.addEventListener("keydown", (event) => {
    const mark = event.target instanceof Element ? event.target.closest(".mark") : null;
    if (!mark) return;
    const [x, y] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] ?? [];
    if (x !== undefined) {
      if (nudge?.mark !== mark) endNudge();
      nudge ??= { mark, start: place(mark) };
      window.carts.holdDocument(true);
      const [[u, v], [width, height]] = [place(mark), mark.dataset.size.split(" ").map(Number)];
      mark.dataset.at = `${within(u + x * STEP / width)} ${within(v + y * STEP / height)}`;
    } else if (["Delete", "Backspace"].includes(event.key)) {
      endNudge();
      if (!event.repeat) window.carts.report("Chosen", { name: "remove-point", value: mark.dataset.point });
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }, { capture: true });
  window.addEventListener("keyup", endNudge, { capture: true });
  window.addEventListener("blur", endNudge);
  (function everyFrame() {
    requestAnimationFrame(everyFrame);
    placeMarks();
  })();

  window.carts.placeMarks = placeMarks;
})();
