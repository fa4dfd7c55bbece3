// The endoscope view and its tool bar, on top of viser's client.
//
// The frame is a textured plane '/frame' in front of the origin of viser's world, which is the endoscope's lens.
// In the endoscope view this script replaces the virtual camera's symmetric frustum by the one that shows exactly the
// plane (plus zoom and pan), so an off-centre principal point wastes no space, and the registration is exact at any window
// shape. The 3D view is viser's own orbit camera. Each tab chooses its view.
(() => {
  "use strict";

  const FRAME = "/frame";
  const OVERLAY = "/overlay";
  const OTHERS = "/others"; // frames and overlays of the other cameras, beside those of the shown camera
  const SCENE_ONLY = ["/world", "/lens", "/grid"]; // covered by the frame, or clutter in front of it
  const GHOST = "/world/measured "; // semi-transparent arms as measured, in the 3D view
  const SCENE_LAYER = 7;
  const ENDOSCOPE_LAYER = 8;
  const SWITCHED = { grid: 9, ghost: 10 }; // layers of the 3D view that can be switched off
  const switchedOn = { grid: true, ghost: true };
  const MARGIN = 1.02;
  const view = { endoscope: true, zoom: 1, x: 0.5, y: 0.5 }; // x, y: the view's centre, relative to the image
  const viser = () => window.__viserMutable;

  let shown = { cameras: [], active: 0 }; // state of the cameras from the server, see setPage

  /** Rectangles of the cameras' images on the plane at distance 1 from the lens, with the cameras' indices. */
  function cells() {
    const active = rectangleOf(FRAME);
    if (!active) return [];
    const found = [{ index: shown.active, ...active }];
    for (const { index } of shown.cameras) {
      const cell = index === shown.active ? null : rectangleOf(`${OTHERS}/${index}/frame`);
      if (cell) found.push({ index, ...cell });
    }
    return found;
  }

  /** Arrange the cameras' images as large as this window allows: in one row, in one column, or in a grid. */
  function arrange() {
    const mutable = viser();
    const active = rectangleOf(FRAME);
    const others = shown.cameras.filter((camera) => camera.index !== shown.active);
    if (!active || !others.length || !mutable.canvas) return;
    const count = shown.cameras.length;
    const places = shown.cameras.map((camera) => camera.index).sort((one, other) => one - other);
    const [above, below, beside] = covered();
    const room = [mutable.canvas.clientWidth * (1 - beside), mutable.canvas.clientHeight * (1 - above - below)];
    const scale = (columns) =>
      Math.min(room[0] / (columns * active.width), room[1] / (Math.ceil(count / columns) * active.height));
    const counts = Array.from({ length: count }, (_, number) => number + 1);
    const columns = counts.reduce((best, one) => (scale(one) > scale(best) * 1.001 ? one : best), count);
    const cell = (index) => [places.indexOf(index) % columns, Math.floor(places.indexOf(index) / columns)];
    const [column, row] = cell(shown.active);
    for (const { index } of others) {
      for (const [node, share] of [["frame", 1], ["overlay", 0.99]]) {
        const pose = mutable.nodePoseData?.[`${OTHERS}/${index}/${node}`];
        if (!pose) continue;
        const z = active.depth * share;
        const [right, down] = [cell(index)[0] - column, cell(index)[1] - row];
        const position = [
          (active.left + active.width / 2 + 1.01 * right * active.width) * z,
          (active.top + active.height / 2 + 1.01 * down * active.height) * z, z,
        ];
        if (pose.position.some((value, axis) => Math.abs(value - position[axis]) > 1e-9)) {
          pose.position = position;
          pose.poseUpdateState = "needsUpdate";
          mutable.requestRender();
        }
      }
    }
  }

  /** The rectangle around all images on the plane at distance 1; null before the first frame has arrived. */
  function imageRectangle() {
    const all = cells();
    if (!all.length) return null;
    const left = Math.min(...all.map((cell) => cell.left));
    const top = Math.min(...all.map((cell) => cell.top));
    return {
      left, top, depth: all[0].depth,
      width: Math.max(...all.map((cell) => cell.left + cell.width)) - left,
      height: Math.max(...all.map((cell) => cell.top + cell.height)) - top,
    };
  }

  function rectangleOf(name) {
    const node = viser()?.nodeRefFromName[name];
    let size = null;
    node?.traverse((child) => { size ??= child.geometry?.parameters?.width ? child.geometry.parameters : null; });
    if (!size || !(node.position.z > 0)) return null;
    const { x, y, z } = node.position;
    return {
      left: (x - size.width / 2) / z, top: (y - size.height / 2) / z,
      width: size.width / z, height: size.height / z, depth: z,
    };
  }

  // Elements over the lower part of a small screen.
  const CONTROLS = "body.carts-small.carts-controls .mantine-Paper-root[style*='position: fixed'], body.carts-small .carts-document-side, .carts-document .frames";

  /** Height of the elements over the lower end of the canvas [CSS px]. */
  function bottomBars() {
    const controls = document.querySelector(CONTROLS);
    if (controls) return innerHeight - controls.getBoundingClientRect().top;
    const strip = document.querySelector(".carts-strip");
    const tools = palette();
    const height = tools && !isColumn(tools) ? tools.offsetHeight + 8 : 0;
    return strip ? strip.offsetHeight + height + (parseFloat(getComputedStyle(strip).bottom) || 0) : 0;
  }

  const palette = () => document.querySelector(".carts-tools");
  const isColumn = (tools) => tools.offsetHeight > tools.offsetWidth;

  /** Shares of the canvas that this page's bars and tools cover at its upper, lower and left end. */
  function covered() {
    const { clientHeight: height, clientWidth: width } = viser()?.canvas ?? {};
    const tools = palette();
    const beside = tools && isColumn(tools) ? tools.offsetLeft + tools.offsetWidth + 4 : 0;
    return [46 / (height || 1), bottomBars() / (height || 1), beside / (width || 1)];
  }

  /** The part of the plane at distance 1 that the canvas shows in the endoscope view. */
  function visibleRectangle(image, aspect) {
    const [above, below, beside] = covered();
    const free = Math.max(1 - above - below, 0.2);
    const height = (Math.max(image.height / free, image.width / aspect / (1 - beside)) * MARGIN) / view.zoom;
    const width = height * aspect;
    return {
      left: image.left + view.x * image.width - (width * (1 + beside)) / 2,
      top: image.top + view.y * image.height - height * (above + free / 2),
      width, height,
    };
  }

  /** The rectangle of a camera's image on the canvas in the endoscope view [CSS px]; by default of the shown camera. */
  function imageOnScreen(index = shown.active) {
    const image = view.endoscope ? imageRectangle() : null;
    const { camera, canvas } = viser() ?? {};
    const cell = image && cells().find((one) => one.index === index);
    if (!cell || !camera || !canvas) return null;
    const part = visibleRectangle(image, camera.aspect);
    const [x, y] = [canvas.clientWidth / part.width, canvas.clientHeight / part.height];
    return {
      left: (cell.left - part.left) * x, top: (cell.top - part.top) * y,
      width: cell.width * x, height: cell.height * y,
    };
  }

  /** The camera under the pointer and the relative position in its image: [index, u, v]; null outside of all images. */
  function imageAt(event, index = null) {
    const box = viser().canvas.getBoundingClientRect();
    for (const cell of cells()) {
      const on = imageOnScreen(cell.index);
      if (!on || (index !== null && index !== cell.index)) continue;
      const u = (event.clientX - box.left - on.left) / on.width;
      const v = (event.clientY - box.top - on.top) / on.height;
      if (index !== null || (u >= 0 && u < 1 && v >= 0 && v < 1)) return [cell.index, u, v];
    }
    return null;
  }

  /** Keep the image in view: centred along an axis on which it fits, without a gap along the other. */
  function clampPan(image, aspect) {
    const part = visibleRectangle(image, aspect);
    const [above, below, beside] = covered();
    const clamp = (centre, share) =>
      share >= 1 ? 0.5 : Math.min(Math.max(centre, share / 2 - 0.01), 1.01 - share / 2);
    view.x = clamp(view.x, (part.width * (1 - beside)) / image.width);
    view.y = clamp(view.y, (part.height * (1 - above - below)) / image.height);
  }

  /** Set an off-axis frustum; called from the camera's own updateProjectionMatrix. */
  function aim(camera) {
    const image = view.endoscope ? imageRectangle() : null;
    if (!image) {
      camera.view = null;
      return;
    }
    clampPan(image, camera.aspect);
    const part = visibleRectangle(image, camera.aspect);
    const t = Math.tan((camera.fov * Math.PI) / 360) / camera.zoom;
    const a = t * camera.aspect;
    camera.near = 0.5 * image.depth;
    // The frame hides everything behind it, so the frustum ends there.
    camera.far = 1.5 * image.depth;
    camera.view = {
      enabled: true, fullWidth: 1, fullHeight: 1,
      offsetX: (part.left + a) / (2 * a), offsetY: (part.top + t) / (2 * t),
      width: part.width / (2 * a), height: part.height / (2 * t),
    };
  }

  function refresh() {
    const mutable = viser();
    if (!mutable?.camera) return;
    mutable.camera.updateProjectionMatrix();
    mutable.requestRender();
    drawBar();
  }

  function showEndoscope() {
    if (!view.endoscope) report("SceneShown", { on: false });
    view.endoscope = true;
    Object.assign(view, { zoom: 1, x: 0.5, y: 0.5 });
    viser()?.resetCameraPose?.(false);
    refresh();
  }

  /** A sphere around the lens, its frame and the tips of the arms, in the shown camera's axes [m]. */
  function sceneBounds(depth) {
    const low = [-depth / 2, -depth / 2, 0];
    const high = [depth / 2, depth / 2, depth];
    const root = viser().nodeRefFromName[""];
    const inverse = root.matrixWorld.clone().invert();
    viser().nodeRefFromName["/world"]?.traverse((child) => {
      if (!child.isMesh || !child.geometry?.attributes?.position) return;
      child.geometry.computeBoundingBox?.();
      const box = child.geometry.boundingBox;
      if (!box) return;
      for (const corner of [box.min, box.max]) {
        const at = corner.clone().applyMatrix4(child.matrixWorld).applyMatrix4(inverse).toArray();
        // Shafts are long; corners far behind the image do not count.
        if (Math.hypot(...at) > 14 * depth) continue;
        at.forEach((value, axis) => {
          low[axis] = Math.min(low[axis], value);
          high[axis] = Math.max(high[axis], value);
        });
      }
    });
    const centre = low.map((value, axis) => (value + high[axis]) / 2);
    return { centre, radius: Math.hypot(...high.map((value, axis) => value - low[axis])) / 2 };
  }

  function showScene() {
    const mutable = viser();
    const image = imageRectangle();
    if (!mutable?.cameraControl || !image) return;
    if (view.endoscope) report("SceneShown", { on: true });
    view.endoscope = false;
    mutable.cameraControl.enabled = true;
    Object.assign(mutable.camera, { near: 0.1 * image.depth, far: 2000 * image.depth });
    // From above and beside, far enough to see the lens, its frame and the nearby parts of the arms.
    const root = mutable.nodeRefFromName[""];
    const place = (x, y, z) => mutable.camera.position.clone().set(x, y, z).applyMatrix4(root.matrixWorld);
    const { centre, radius } = sceneBounds(image.depth);
    const aspect = Math.min(mutable.camera.aspect, 1);
    const away = (1.15 * radius) / (Math.tan((mutable.camera.fov * Math.PI) / 360) * aspect);
    const towards = [0.62, -0.48, -0.62].map((value, axis) => centre[axis] + value * away);
    const [from, to] = [place(...towards), place(...centre)];
    mutable.cameraControl.setLookAt(from.x, from.y, from.z, to.x, to.y, to.z, true);
    refresh();
  }

  // ---- The tool bar over the picture -------------------------------------------------------------------------------

  let bar, hint;

  function buildBar(canvas) {
    bar = document.createElement("div");
    bar.className = "carts-bar";
    bar.setAttribute("role", "toolbar");
    bar.setAttribute("aria-label", "View");
    bar.innerHTML = `
      <button data-do="endoscope" data-key="view" title="Look through the endoscope" aria-label="Endoscope view">Endoscope</button>
      <button data-do="scene" data-key="view" title="Orbit around the arms and the cameras" aria-label="3D view">3D</button>
      <span class="carts-zoom">
        <button data-do="out" title="Zoom out" aria-label="Zoom out" data-icon="minus"></button><output aria-label="Zoom"></output>
        <button data-do="in" title="Zoom in (wheel over the image)" aria-label="Zoom in" data-icon="plus"></button>
      </span>
      <button data-do="fit" title="Fit: show the whole image" aria-label="Fit" data-icon="maximize"></button>
      <span class="carts-layers">
        <button data-do="ghost" title="Show the measured arms, semi-transparent">Measured</button>
        <button data-do="grid" title="Show the grid: 1 cm, with strong lines every 5 cm">Grid</button>
      </span>
      <button data-do="theme" title="Light or dark" aria-label="Light or dark" data-icon="contrast"></button>
      <button data-do="help" data-key="sheet" title="Help and keys" aria-label="Keys" data-icon="help"></button>`;
    window.cartsIcons(bar);
    window.carts.nameKeys(bar);
    const actions = {
      endoscope: showEndoscope, scene: showScene, fit: () => (view.endoscope ? showEndoscope() : showScene()),
      grid: () => toggle("grid"), ghost: () => toggle("ghost"),
      theme: () => window.carts.toggleTheme(), help: () => window.carts.showSheet(),
      in: () => zoomAt(1.25, 0.5, 0.5), out: () => zoomAt(0.8, 0.5, 0.5),
    };
    for (const button of bar.querySelectorAll("button")) {
      // A clicked button loses the focus; otherwise, the space bar would press it again.
      button.addEventListener("click", ({ detail }) => { actions[button.dataset.do](); if (detail) button.blur(); });
    }
    for (const kind of ["pointerdown", "pointermove", "pointerup", "wheel", "dblclick"]) {
      bar.addEventListener(kind, (event) => event.stopPropagation());
    }
    hint = document.createElement("div");
    hint.className = "carts-hint";
    hint.textContent = "Drag: orbit · right-drag: move · wheel: zoom · grid 1 cm";
    const parent = canvas.parentElement;
    if (getComputedStyle(parent).position === "static") parent.style.position = "relative";
    parent.classList.add("carts-canvas");
    parent.append(bar, hint);
    drawBar();
  }

  function toggle(name) {
    switchedOn[name] = !switchedOn[name];
    refresh();
  }

  function drawBar() {
    if (!bar) return;
    const press = (name, on) => bar.querySelector(`[data-do=${name}]`).setAttribute("aria-pressed", String(on));
    bar.toggleAttribute("data-endoscope", view.endoscope);
    press("endoscope", view.endoscope);
    press("scene", !view.endoscope);
    bar.querySelector(".carts-zoom").style.display = view.endoscope ? "" : "none";
    bar.querySelector(".carts-layers").style.display = view.endoscope ? "none" : "";
    for (const name of Object.keys(SWITCHED)) press(name, switchedOn[name]);
    bar.querySelector("output").textContent = `${Math.round(view.zoom * 100)} %`;
    hint.style.display = view.endoscope ? "none" : "";
  }

  // ---- Zoom and pan with the mouse ---------------------------------------------------------------------------------

  /** Zoom by a factor about the point (u, v), relative to the size of the canvas. */
  function zoomAt(factor, u, v) {
    const image = imageRectangle();
    const camera = viser()?.camera;
    if (!image || !camera || !view.endoscope) return;
    const [above, below, beside] = covered();
    const before = visibleRectangle(image, camera.aspect);
    view.zoom = Math.min(Math.max(view.zoom * factor, 1), 40);
    const after = visibleRectangle(image, camera.aspect);
    view.x += ((u - (1 + beside) / 2) * (before.width - after.width)) / image.width;
    view.y += ((v - above - (1 - above - below) / 2) * (before.height - after.height)) / image.height;
    refresh();
  }

  function listen() {
    // paint.js lays its canvas over viser's canvas; there, the wheel and the other buttons keep their functions.
    const painting = (event) => event.target instanceof Element && event.target.classList.contains("carts-paint");
    const inPicture = (event) =>
      view.endoscope && viser()?.canvas && (event.target === viser().canvas || painting(event));
    const share = (event) => {
      const box = viser().canvas.getBoundingClientRect();
      return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    };
    let last = null;
    let pointing = null; // index of the camera in whose image a keypoint is dragged
    let place = null; // position to report
    let pressed = null; // position of a press that started no other gesture
    let latest = null; // newest event of the drag
    // A resting pointer whose button is down is reported, too; otherwise, the unfinished edit would be saved.
    setInterval(() => { if (pointing !== null && latest) point(latest); }, 2000);
    /** Report the pointer's position in the image, at most 30 times a second, and always the last position. */
    const point = (event) => {
      const found = imageAt(event, pointing);
      if (!found) return;
      latest = event;
      if (!place) setTimeout(() => { report("Pointed", place); place = null; }, 33);
      place = { camera: found[0], at: [found[1], found[2]] };
    };
    window.addEventListener("wheel", (event) => {
      if (!inPicture(event)) return;
      event.preventDefault();
      event.stopPropagation();
      zoomAt(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)), ...share(event));
    }, { capture: true, passive: false });
    window.addEventListener("pointerdown", (event) => {
      if (!inPicture(event) || (painting(event) && event.button === 0)) return;
      const { tool } = window.carts.brush();
      if (event.button === 0 && (event.ctrlKey || event.metaKey || (tool === "drag link" && !event.shiftKey))) return; // drag.js drags a link
      const at = imageAt(event);
      pointing = (event.shiftKey || tool === "keypoint") && event.button === 0 ? (at?.[0] ?? shown.active) : null;
      pressed = pointing === null && event.button === 0 && at ? [at[0], event.clientX, event.clientY] : null;
      if (pointing !== null) point(event);
      else last = share(event);
    }, { capture: true });
    window.addEventListener("pointermove", (event) => {
      if (pointing !== null) point(event);
      const image = imageRectangle();
      if (!last || !view.endoscope || !image) return;
      const now = share(event);
      const part = visibleRectangle(image, viser().camera.aspect);
      view.x -= ((now[0] - last[0]) * part.width) / image.width;
      view.y -= ((now[1] - last[1]) * part.height) / image.height;
      last = now;
      refresh();
    }, { capture: true });
    window.addEventListener("pointerup", (event) => {
      if (pointing !== null) { grabbed = true; letGo(); }
      // A click on another camera's image chooses that camera.
      if (pressed && Math.hypot(event.clientX - pressed[1], event.clientY - pressed[2]) < 4) activate(pressed[0]);
      last = pressed = pointing = latest = null;
    }, { capture: true });
    window.addEventListener("click", (event) => {
      const target = event.target instanceof Element ? event.target : null;
      const frame = target?.closest("[data-frame]");
      if (!frame) return;
      event.preventDefault();
      report("ShowFrame", { index: Number(frame.dataset.frame) });
    }, { capture: true });
    window.addEventListener("dblclick", (event) => {
      // Clicks that place points do not change the view.
      if (inPicture(event) && !painting(event) && !document.querySelector("[data-click]")) showEndoscope();
    }, { capture: true });
  }

  // ---- Reports to the server: drawn pictures, and the end of drags -------------------------------------------------

  const tab = Math.random().toString(36).slice(2);
  let reports = 0;

  /** Choose the camera for edits. */
  function activate(index) {
    if (index !== shown.active) report("ShowCamera", { camera: shown.names[index] });
  }

  /** Report an event to the server (`transport/events.py`, `app.py`). Two events never have the same text. */
  function report(type, values = {}) {
    reports += 1;
    viser()?.sendMessage({
      type: "GuiUpdateMessage", uuid: window.cartsConfiguration.channel,
      updates: { value: JSON.stringify([tab, reports, { type, ...values }]) },
    });
  }

  const HELD_BACK = 150; // viser delays the last value of a slider by up to 50 ms; the report must come after it
  const isControl = (event) => event.target instanceof Element && event.target.closest("[role=slider], input");
  let grabbed = false;
  let pressing = false; // whether a button of the mouse is down
  // A drag takes the focus from a field. The field's release is reported with the end of the drag, not before.
  let pending = null; // timer of a release that is not reported yet
  const letGo = () => {
    if (!grabbed) return;
    grabbed = false;
    clearTimeout(pending);
    pending = setTimeout(() => { pending = null; if (pressing) grabbed = true; else report("Released"); }, HELD_BACK);
  };
  // Typing into a field begins another edit, which the release of the previous control must not end.
  window.addEventListener("beforeinput", () => {
    if (pending === null) return;
    clearTimeout(pending);
    pending = null;
    report("Released");
  }, { capture: true });
  window.addEventListener("pointerdown", (event) => {
    pressing = true;
    grabbed ||= event.target instanceof Element && event.target.closest(".mantine-Slider-root") !== null;
  }, { capture: true });
  for (const kind of ["pointerup", "pointercancel"]) {
    window.addEventListener(kind, () => { pressing = false; letGo(); }, { capture: true });
  }
  // With the keyboard, a slider is released with its key and a field with Enter.
  window.addEventListener("keyup", (event) => {
    const slider = event.target instanceof Element && event.target.closest("[role=slider]");
    if (slider || (event.key === "Enter" && isControl(event))) { grabbed = true; letGo(); }
  }, { capture: true });
  window.addEventListener("focusout", (event) => { if (isControl(event)) { grabbed = true; letGo(); } });
  let drawnTexture = null;
  let expected = null; // picture that is being drawn: its number, and the textures that it replaces, by node

  function textureOf(node) {
    let texture = null;
    viser()?.nodeRefFromName[node]?.traverse((child) => { texture ??= child.material?.map ?? null; });
    return texture?.uuid ?? null;
  }

  /** Receive the number of the newest picture, and the nodes whose images have changed, before they are loaded. */
  function expectPicture(number, nodes) {
    const changed = Object.fromEntries(nodes.map((node) => [node, textureOf(node)]));
    expected = { number, replaced: { ...expected?.replaced, ...changed } };
  }

  /** Acknowledge a drawn picture. The server waits for this, since an image that is replaced while it is loaded is never drawn. */
  function reportDrawn() {
    drawnTexture = textureOf(OVERLAY) ?? drawnTexture;
    const loaded = ([node, before]) => ![before, null].includes(textureOf(node));
    if (!expected || !Object.entries(expected.replaced).every(loaded)) return;
    report("Drawn", { picture: expected.number });
    expected = null;
  }

  // ---- Return the keyboard to the page after a list, a box or a button was used with the pointer ------------------------
  // A mark of a clicked point keeps it, to be moved by keys.

  let presses = 0;
  window.addEventListener("pointerdown", () => { presses += 1; }, { capture: true });
  window.addEventListener("click", (event) => {
    const used = event.target instanceof Element && event.target.closest("[role=option], button:not(.mark), input[type=checkbox]");
    if (!used || event.detail === 0 || used.closest("dialog, [role=dialog]")) return;
    const list = used.matches("[role=option]"); // its field keeps the focus, though typing has ended
    const end = performance.now() + (list ? 500 : 60); // a list takes the focus back when it closes, possibly late
    const press = presses;
    const leave = () => {
      if (press !== presses) return; // another control is in use
      const focused = document.activeElement;
      if (focused?.matches(list ? "input[aria-haspopup=listbox]" : "button:not(.mark), input[type=checkbox]")) focused.blur();
      if (performance.now() < end) setTimeout(leave, 60);
    };
    setTimeout(leave, 60);
  }, { capture: true });

  // Enter and Escape leave a field, after the field itself has handled the key.
  window.addEventListener("keydown", (event) => {
    const field = event.target instanceof Element ? event.target.closest("input:not([aria-haspopup=listbox])") : null;
    if (!field || !["Enter", "Escape"].includes(event.key) || event.isComposing || field.closest("[role=dialog]")) return;
    setTimeout(() => field.blur(), 0);
  }, { capture: true });

  // ---- Show a lost connection -------------------------------------------------------------------------------------

  /** Whether the tab is connected; if it is not, viser's client replaces `sendMessage` by a function that only logs. */
  const connected = () => !/not connected/i.test(String(viser()?.sendMessage));
  setInterval(() => document.body.classList.toggle("carts-offline", Boolean(viser()?.canvas) && !connected()), 300);

  // ---- Track the camera, which viser may replace --------------------------------------------------------------------

  let held = null;
  let shape = "";

  function watch() {
    const mutable = viser();
    if (!mutable?.camera || !mutable.cameraControl || !mutable.canvas) return;
    if (held !== mutable.camera) {
      held = mutable.camera;
      const original = Object.getPrototypeOf(held).updateProjectionMatrix;
      held.updateProjectionMatrix = function () { aim(this); original.call(this); };
    }
    if (!bar?.isConnected) buildBar(mutable.canvas);
    if (view.endoscope && mutable.cameraControl.enabled) mutable.cameraControl.enabled = false;
    // viser sets `visible` in every frame, so nodes of the 3D view have a separate layer.
    for (const name of SCENE_ONLY) mutable.nodeRefFromName[name]?.traverse((child) => child.layers.set(SCENE_LAYER));
    mutable.nodeRefFromName["/grid"]?.traverse((child) => child.layers.set(SWITCHED.grid));
    for (const [name, node] of Object.entries(mutable.nodeRefFromName)) {
      if (name.startsWith(GHOST)) node?.traverse((child) => child.layers.set(SWITCHED.ghost));
    }
    const seen = (layer, on) => (on ? mutable.camera.layers.enable(layer) : mutable.camera.layers.disable(layer));
    seen(SCENE_LAYER, !view.endoscope);
    for (const [name, layer] of Object.entries(SWITCHED)) seen(layer, !view.endoscope && switchedOn[name]);
    mutable.nodeRefFromName[OTHERS]?.traverse((child) => child.layers.set(ENDOSCOPE_LAYER));
    seen(ENDOSCOPE_LAYER, view.endoscope);
    arrange();
    // A new camera or image size changes the plane, which three.js does not report.
    const now = JSON.stringify([view.endoscope, imageRectangle(), covered()]);
    if (now !== shape) { shape = now; refresh(); }
    reportDrawn();
  }

  listen();
  (function everyFrame() {
    watch();
    requestAnimationFrame(everyFrame);
  })();

  window.carts = {
    view, imageAt, activate, connected, expectPicture,
    shown: () => shown,
    /** Receive the state of cameras, frame and marks from the server, and pass it to the other scripts. */
    setPage(message) {
      shown = message;
      document.dispatchEvent(new CustomEvent("carts-page", { detail: message }));
      refresh();
    },
    showEndoscope, showScene,
    toggleView: () => (view.endoscope ? showScene() : showEndoscope()),
    zoomAt, imageOnScreen, report, switchedOn,
    released: () => { grabbed = true; letGo(); },
    drawnOverlay: () => drawnTexture,
  };
})();
