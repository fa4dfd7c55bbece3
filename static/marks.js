// Marks over the images, of constant size at any zoom: the cameras' names and verdicts, a border around the active
// camera's image, keypoints with their names, and clicks. Needs page.js.
(() => {
  "use strict";

  const SVG = "http://www.w3.org/2000/svg";
  const NEAR = 34; // distance to the pointer within which a mark fades [px]
  let layer = null;
  let page = { cameras: [], active: 0 };
  let pointer = [-1e4, -1e4];
  let drawn = "";

  function element(parent, name, attributes, text) {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    parent.append(made);
    return made;
  }

  function build() {
    const below = window.__viserMutable?.canvas;
    if (!below || layer?.isConnected) return;
    layer = document.createElementNS(SVG, "svg");
    layer.setAttribute("class", "carts-marks");
    below.parentElement.append(layer);
    drawn = "";
  }

  /** A keypoint: an open ring, which leaves the image below visible, and its name. */
  function drawPoint(group, label, x, y, line, chosen) {
    const near = Math.hypot(x - pointer[0], y - pointer[1]) < NEAR;
    const mark = element(group, "g", { class: `carts-point${chosen ? " chosen" : ""}${near ? " near" : ""}` });
    element(mark, "circle", { cx: x, cy: y, r: 7, class: "edge" });
    element(mark, "circle", { cx: x, cy: y, r: 7 });
    if (line > y + 20) element(mark, "path", { d: `M${x + 3} ${y + 7}L${x + 11} ${line - 5}` });
    element(mark, "text", { x: x + 12, y: line }, label.replace(/ joint$/, ""));
  }

  function drawPin(group, label, x, y) {
    const mark = element(group, "g", { class: "carts-pin" });
    for (const kind of ["edge", ""]) {
      element(mark, "path", { d: `M${x - 6} ${y - 6}l12 12M${x + 6} ${y - 6}l-12 12`, class: kind });
    }
    element(mark, "title", {}, label);
  }

  function drawCamera(camera, place, several) {
    const group = element(layer, "g", { "data-camera": camera.name });
    if (several) {
      const active = camera.index === page.active;
      element(group, "rect", {
        x: place.left, y: place.top, width: place.width, height: place.height,
        class: `carts-cell${active ? " active" : ""}`,
      });
      // The visible part of an image that extends beyond the window; its upper end is below the tool bar.
      const left = Math.max(place.left, 0);
      const top = place.top < 0 ? Math.min(46, place.top + place.height - 28) : place.top;
      const label = element(group, "text", { x: left + 24, y: top + 19, class: "carts-cell-label" });
      const dice = camera.dice === null ? [] : [`Dice ${camera.dice.toFixed(3)}`];
      // Narrow images get shorter labels; the circle's colour shows the verdict, too.
      for (const texts of [[...(camera.fit ? [camera.fit] : []), ...dice], dice, []]) {
        label.textContent = [camera.name, ...texts].join(" · ");
        if (label.getComputedTextLength() < place.left + place.width - left - 30) break;
      }
      element(group, "circle", {
        cx: left + 13, cy: top + 14, r: 5, class: `carts-fit ${camera.fit ?? "unknown"}`,
      });
    }
    let lowest = -1e4; // lowest label so far; labels must not overlap
    const at = ([, u, v]) => [place.left + u * place.width, place.top + v * place.height];
    const rings = camera.points.map(at);
    for (const point of [...camera.points].sort((one, other) => one[2] - other[2])) {
      const [x, y] = at(point);
      lowest = Math.max(y + 4, lowest + 12);
      const right = x + 12 + 6 * point[0].length;
      const covered = ([u, v]) => u + 8 > x + 12 && u - 8 < right && v + 8 > lowest - 9 && v - 8 < lowest + 3;
      for (let tries = 0; tries < 8 && rings.some(covered); tries += 1) lowest += 6;
      drawPoint(group, point[0], x, y, lowest, point[0] === page.chosen);
    }
    for (const pin of camera.pins) drawPin(group, pin[0], ...at(pin));
  }

  function everyFrame() {
    requestAnimationFrame(everyFrame);
    build();
    if (!layer || !window.carts) return;
    const places = page.cameras.map((camera) => window.carts.imageOnScreen(camera.index));
    const marked = page.cameras.some((camera) => camera.points.length);
    const now = JSON.stringify([places, page, marked ? pointer.map((value) => Math.round(value / 4)) : 0]);
    if (now === drawn) return;
    drawn = now;
    layer.replaceChildren();
    const several = page.cameras.length > 1;
    page.cameras.forEach((camera, number) => { if (places[number]) drawCamera(camera, places[number], several); });
  }

  document.addEventListener("carts-page", (event) => { page = event.detail; });
  window.addEventListener("pointermove", (event) => {
    const box = window.__viserMutable?.canvas?.getBoundingClientRect();
    if (box) pointer = [event.clientX - box.left, event.clientY - box.top];
  }, { capture: true });
  everyFrame();
})();
