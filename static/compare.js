// The line between two compared states over the image, which can be dragged, their names, and the legend of outlines. The
// server draws the states (`picture/comparison.py`). Needs page.js.
(() => {
  "use strict";

  const make = window.cartsElement;
  const PAUSE = 33; // between two messages [ms]
  const STEP = 0.02; // of an arrow key, as a share of the image's width
  let compare = { sides: null, legend: [], share: 0.5 }; // state from the server
  let line = null;
  let legend = null;
  let share = 0.5;
  let dragging = false;
  let waiting = false;
  let written = "";

  function send(value) {
    share = Math.min(Math.max(value, 0), 1);
    if (waiting) return;
    waiting = true;
    setTimeout(() => { waiting = false; window.carts.report("SetSwipe", { share }); }, PAUSE);
  }

  function build() {
    const below = window.__viserMutable?.canvas;
    if (!below || line?.isConnected) return;
    line = make("div", { class: "carts-swipe", role: "slider", tabindex: "0", "aria-valuemin": "0", "aria-valuemax": "100", hidden: "" },
      make("span", {}), make("i", {}), make("span", {}));
    legend = make("ul", { class: "carts-lines", "aria-label": "Compared states", hidden: "" });
    for (const kind of ["pointerdown", "pointermove", "pointerup", "wheel", "dblclick"]) {
      line.addEventListener(kind, (event) => event.stopPropagation());
    }
    line.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      dragging = true;
      line.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    line.addEventListener("pointermove", (event) => {
      const on = dragging && window.carts.imageOnScreen();
      if (on) send((event.clientX - below.getBoundingClientRect().left - on.left) / on.width);
    });
    for (const kind of ["pointerup", "pointercancel"]) line.addEventListener(kind, () => { dragging = false; });
    line.addEventListener("keydown", (event) => {
      const to = { ArrowLeft: share - STEP, ArrowRight: share + STEP, Home: 0, End: 1 }[event.key];
      if (to === undefined) return;
      send(to);
      event.preventDefault();
      event.stopPropagation();
    });
    below.parentElement.append(line, legend);
    written = "";
  }

  /** A sample of a line, or of filled pixels. */
  function sample({ color, dash, striped }) {
    const box = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    box.setAttribute("class", "carts-sample");
    if (!dash) {
      box.style.background = striped ? `repeating-linear-gradient(135deg, ${color} 0 3px, transparent 3px 6px)` : color;
      return box;
    }
    for (const [stroke, width] of [["black", 5], [color, 3]]) {
      const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
      path.setAttribute("d", "M1 6H35");
      path.setAttribute("stroke", stroke);
      path.setAttribute("stroke-width", width);
      if (dash[0]) path.setAttribute("stroke-dasharray", dash.map((one) => 3 * one).join(" "));
      box.append(path);
    }
    return box;
  }

  function write() {
    const now = JSON.stringify([compare.sides, compare.legend]);
    if (now === written) return;
    written = now;
    const [left, , right] = line.children;
    [left.textContent, right.textContent] = compare.sides ?? ["", ""];
    line.setAttribute("aria-label", compare.sides ? `${compare.sides[0]} | ${compare.sides[1]}` : "Compare");
    legend.replaceChildren(...compare.legend.map((one) => make("li", {}, sample(one), one.name)));
    legend.hidden = !compare.legend.length;
  }

  function everyFrame() {
    requestAnimationFrame(everyFrame);
    build();
    if (!line || !window.carts.view) return;
    write();
    const on = compare.sides || compare.legend.length ? window.carts.imageOnScreen() : null;
    legend.hidden = !on || !compare.legend.length;
    const canvas = window.__viserMutable.canvas;
    const x = on && compare.sides ? on.left + share * on.width : -1;
    line.hidden = x < 0 || x > canvas.clientWidth;
    if (on) {
      const [top, bottom] = [Math.max(on.top, 0), Math.min(on.top + on.height, canvas.clientHeight)];
      Object.assign(line.style, { left: `${x}px`, top: `${top}px`, height: `${bottom - top}px` });
      Object.assign(legend.style, { left: `${Math.max(on.left, 0) + 8}px`, top: `${bottom - legend.offsetHeight - 8}px` });
    }
    const value = String(Math.round(100 * share));
    if (line.getAttribute("aria-valuenow") !== value) line.setAttribute("aria-valuenow", value);
  }

  document.addEventListener("carts-page", ({ detail }) => {
    compare = detail.compare;
    if (!dragging && !waiting) share = compare.share;
  });
  everyFrame();
})();
