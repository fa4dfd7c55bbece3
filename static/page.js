// What runs in the page besides viser's own client: the endoscope view and its tool bar.
//
// The frame is a textured plane '/frame' in front of the origin of viser's world, which is the endoscope's lens.
// In the endoscope view this script replaces the virtual camera's symmetric frustum by the one that shows exactly the
// plane (plus zoom and pan), so an off-centre principal point costs no space and registration holds at any window
// shape. The 3D view is viser's own orbit camera. Each tab chooses for itself.
(() => {
  "use strict";

  const FRAME = "/frame";
  const OVERLAY = "/overlay";
  const SCENE_ONLY = ["/world", "/lens"]; // what the frame covers, or what would only clutter it
  const SCENE_LAYER = 7;
  const MARGIN = 1.02;
  const view = { endoscope: true, zoom: 1, x: 0.5, y: 0.5 }; // x, y: what is in the middle, as a share of the image
  const viser = () => window.__viserMutable;

  /** The image's rectangle on the plane at distance 1 from the lens, or null before the first frame arrived. */
  function imageRectangle() {
    const node = viser()?.nodeRefFromName[FRAME];
    let size = null;
    node?.traverse((child) => { size ??= child.geometry?.parameters?.width ? child.geometry.parameters : null; });
    if (!size || !(node.position.z > 0)) return null;
    const { x, y, z } = node.position;
    return {
      left: (x - size.width / 2) / z, top: (y - size.height / 2) / z,
      width: size.width / z, height: size.height / z, depth: z,
    };
  }

  /** The part of the plane at distance 1 that the canvas shows in the endoscope view. */
  function visibleRectangle(image, aspect) {
    const height = (Math.max(image.height, image.width / aspect) * MARGIN) / view.zoom;
    const width = height * aspect;
    return {
      left: image.left + view.x * image.width - width / 2,
      top: image.top + view.y * image.height - height / 2,
      width, height,
    };
  }

  /** The image's rectangle on the canvas in the endoscope view [CSS px], or null. */
  function imageOnScreen() {
    const image = view.endoscope ? imageRectangle() : null;
    const { camera, canvas } = viser() ?? {};
    if (!image || !camera || !canvas) return null;
    const shown = visibleRectangle(image, camera.aspect);
    const [x, y] = [canvas.clientWidth / shown.width, canvas.clientHeight / shown.height];
    return {
      left: (image.left - shown.left) * x, top: (image.top - shown.top) * y,
      width: image.width * x, height: image.height * y,
    };
  }

  /** Keep the image in view: centred along a side that fits, without a gap along one that does not. */
  function clampPan(image, aspect) {
    const shown = visibleRectangle(image, aspect);
    const clamp = (centre, share) =>
      share >= 1 ? 0.5 : Math.min(Math.max(centre, share / 2 - 0.01), 1.01 - share / 2);
    view.x = clamp(view.x, shown.width / image.width);
    view.y = clamp(view.y, shown.height / image.height);
  }

  /** Give the camera an off-axis frustum; called from inside its own updateProjectionMatrix. */
  function aim(camera) {
    const image = view.endoscope ? imageRectangle() : null;
    if (!image) {
      camera.view = null;
      return;
    }
    clampPan(image, camera.aspect);
    const shown = visibleRectangle(image, camera.aspect);
    const t = Math.tan((camera.fov * Math.PI) / 360) / camera.zoom;
    const a = t * camera.aspect;
    camera.near = 0.5 * image.depth;
    // What lies behind the frame is hidden by it; leaving it out of the frustum saves drawing it.
    camera.far = 1.5 * image.depth;
    camera.view = {
      enabled: true, fullWidth: 1, fullHeight: 1,
      offsetX: (shown.left + a) / (2 * a), offsetY: (shown.top + t) / (2 * t),
      width: shown.width / (2 * a), height: shown.height / (2 * t),
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
    view.endoscope = true;
    Object.assign(view, { zoom: 1, x: 0.5, y: 0.5 });
    viser()?.resetCameraPose?.(false);
    refresh();
  }

  function showScene() {
    const mutable = viser();
    const image = imageRectangle();
    if (!mutable?.cameraControl || !image) return;
    view.endoscope = false;
    mutable.cameraControl.enabled = true;
    Object.assign(mutable.camera, { near: 0.1 * image.depth, far: 2000 * image.depth });
    // From above and behind the lens, looking at where instruments usually are: some frame distances ahead.
    const root = mutable.nodeRefFromName[""];
    const place = (x, y, z) => mutable.camera.position.clone().set(x, y, z)
      .multiplyScalar(image.depth).applyMatrix4(root.matrixWorld);
    const [from, to] = [place(4.4, -2.6, -1.6), place(0, 0.2, 2.6)];
    mutable.cameraControl.setLookAt(from.x, from.y, from.z, to.x, to.y, to.z, true);
    refresh();
  }

  // ---- The tool bar over the picture -------------------------------------------------------------------------------

  let bar, hint;

  function buildBar(canvas) {
    bar = document.createElement("div");
    bar.className = "carts-bar";
    bar.innerHTML = `
      <button data-do="endoscope" title="Look through the endoscope (V)">Endoscope view</button>
      <button data-do="scene" title="Orbit around the arms and the cameras (V)">3D view</button>
      <span class="carts-zoom">
        <button data-do="out" title="Zoom out" aria-label="Zoom out">−</button><output></output>
        <button data-do="in" title="Zoom in (wheel over the picture)" aria-label="Zoom in">+</button>
        <button data-do="fit" title="Show the whole picture (double click)">Fit</button>
      </span>`;
    const actions = {
      endoscope: showEndoscope, scene: showScene, fit: showEndoscope,
      in: () => zoomAt(1.25, 0.5, 0.5), out: () => zoomAt(0.8, 0.5, 0.5),
    };
    for (const button of bar.querySelectorAll("button")) {
      // Not left focused, or the next press of the space bar would press it again.
      button.addEventListener("click", () => { actions[button.dataset.do](); button.blur(); });
    }
    for (const kind of ["pointerdown", "pointermove", "pointerup", "wheel", "dblclick"]) {
      bar.addEventListener(kind, (event) => event.stopPropagation());
    }
    hint = document.createElement("div");
    hint.className = "carts-hint";
    hint.textContent = "Drag to orbit · right-drag to move · wheel to come closer";
    const parent = canvas.parentElement;
    if (getComputedStyle(parent).position === "static") parent.style.position = "relative";
    parent.append(bar, hint);
    drawBar();
  }

  function drawBar() {
    if (!bar) return;
    const press = (name, on) => bar.querySelector(`[data-do=${name}]`).setAttribute("aria-pressed", String(on));
    press("endoscope", view.endoscope);
    press("scene", !view.endoscope);
    bar.querySelector(".carts-zoom").style.display = view.endoscope ? "" : "none";
    bar.querySelector("output").textContent = `${Math.round(view.zoom * 100)} %`;
    hint.style.display = view.endoscope ? "none" : "";
  }

  // ---- Zoom and pan with the mouse ---------------------------------------------------------------------------------

  /** Zoom by a factor, keeping what is at (u, v) of the canvas, as shares, where it is. */
  function zoomAt(factor, u, v) {
    const image = imageRectangle();
    const camera = viser()?.camera;
    if (!image || !camera || !view.endoscope) return;
    const before = visibleRectangle(image, camera.aspect);
    view.zoom = Math.min(Math.max(view.zoom * factor, 1), 40);
    const after = visibleRectangle(image, camera.aspect);
    view.x += ((u - 0.5) * (before.width - after.width)) / image.width;
    view.y += ((v - 0.5) * (before.height - after.height)) / image.height;
    refresh();
  }

  function listen() {
    // paint.js lays its canvas over viser's; the wheel and the other buttons do there what they always do.
    const painting = (event) => event.target instanceof Element && event.target.classList.contains("carts-paint");
    const inPicture = (event) =>
      view.endoscope && viser()?.canvas && (event.target === viser().canvas || painting(event));
    const share = (event) => {
      const box = viser().canvas.getBoundingClientRect();
      return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    };
    let last = null;
    let pointing = false;
    let place = null;
    /** Say where in the image the pointer is, at most 30 times a second, the last place always. */
    const point = (event) => {
      const image = imageRectangle();
      if (!image) return;
      const shown = visibleRectangle(image, viser().camera.aspect);
      const [u, v] = share(event);
      if (!place) setTimeout(() => { report("pointed", place.join(" ")); place = null; }, 33);
      place = [
        (shown.left + u * shown.width - image.left) / image.width,
        (shown.top + v * shown.height - image.top) / image.height,
      ];
    };
    window.addEventListener("wheel", (event) => {
      if (!inPicture(event)) return;
      event.preventDefault();
      event.stopPropagation();
      zoomAt(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)), ...share(event));
    }, { capture: true, passive: false });
    window.addEventListener("pointerdown", (event) => {
      if (!inPicture(event) || (painting(event) && event.button === 0)) return;
      pointing = event.shiftKey && event.button === 0;
      if (pointing) point(event);
      else last = share(event);
    }, { capture: true });
    window.addEventListener("pointermove", (event) => {
      if (pointing) point(event);
      const image = imageRectangle();
      if (!last || !view.endoscope || !image) return;
      const now = share(event);
      const shown = visibleRectangle(image, viser().camera.aspect);
      view.x -= ((now[0] - last[0]) * shown.width) / image.width;
      view.y -= ((now[1] - last[1]) * shown.height) / image.height;
      last = now;
      refresh();
    }, { capture: true });
    window.addEventListener("pointerup", () => {
      if (pointing) { grabbed = true; letGo(); }
      last = null;
      pointing = false;
    }, { capture: true });
    window.addEventListener("click", (event) => {
      const timeline = event.target instanceof Element && event.target.closest(".carts-timeline");
      if (!timeline) return;
      const box = timeline.getBoundingClientRect();
      report("picked", String((event.clientX - box.left) / box.width));
    }, { capture: true });
    window.addEventListener("dblclick", (event) => { if (inPicture(event) && !painting(event)) showEndoscope(); }, { capture: true });
  }

  // ---- Report to the server what has been drawn, and when a drag is over ------------------------------------------------

  const tab = Math.random().toString(36).slice(2);
  let reports = 0;

  /** Put a new text into one of the invisible fields that the server listens to. */
  function report(field, text = "") {
    reports += 1;
    viser()?.sendMessage({
      type: "GuiUpdateMessage", uuid: window.cartsConfiguration[field],
      updates: { value: `${tab} ${reports} ${text}`.trim() },
    });
  }

  const HELD_BACK = 150; // viser holds the last value of a slider back by up to 50 ms; the report must come after it
  const isControl = (event) => event.target instanceof Element && event.target.closest("[role=slider], input");
  let grabbed = false;
  const letGo = () => { if (grabbed) { grabbed = false; setTimeout(() => report("released"), HELD_BACK); } };
  window.addEventListener("pointerdown", (event) => {
    grabbed ||= event.target instanceof Element && event.target.closest(".mantine-Slider-root") !== null;
  }, { capture: true });
  window.addEventListener("pointerup", letGo, { capture: true });
  // With the keyboard, a slider is let go of with its key and a field with Enter.
  window.addEventListener("keyup", (event) => {
    const slider = event.target instanceof Element && event.target.closest("[role=slider]");
    if (slider || (event.key === "Enter" && isControl(event))) { grabbed = true; letGo(); }
  }, { capture: true });
  window.addEventListener("focusout", (event) => { if (isControl(event)) { grabbed = true; letGo(); } });
  let drawnTexture = null;

  /** WebGL drops a picture that a newer one overtakes while it is being decoded, so the server waits for this word. */
  function reportDrawn() {
    let texture = null;
    viser()?.nodeRefFromName[OVERLAY]?.traverse((child) => { texture ??= child.material?.map ?? null; });
    if (texture && texture.uuid !== drawnTexture) {
      drawnTexture = texture.uuid;
      report("drawn");
    }
  }

  // ---- Keep hold of the camera, which viser may replace ------------------------------------------------------------

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
    // viser sets `visible` itself in every frame, so what belongs to the 3D view alone is kept on a layer of its own.
    for (const name of SCENE_ONLY) mutable.nodeRefFromName[name]?.traverse((child) => child.layers.set(SCENE_LAYER));
    if (view.endoscope) mutable.camera.layers.disable(SCENE_LAYER);
    else mutable.camera.layers.enable(SCENE_LAYER);
    // A new camera or image size changes the plane, which three.js does not report.
    const now = JSON.stringify([view.endoscope, imageRectangle()]);
    if (now !== shape) { shape = now; refresh(); }
    reportDrawn();
  }

  listen();
  (function everyFrame() {
    watch();
    requestAnimationFrame(everyFrame);
  })();

  window.carts = {
    view, showEndoscope, showScene,
    toggleView: () => (view.endoscope ? showScene() : showEndoscope()),
    zoomAt, imageOnScreen, report,
    drawnOverlay: () => drawnTexture,
  };
})();
