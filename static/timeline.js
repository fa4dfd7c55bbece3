// The strip below the image: all frames with review state, fit and source; it can be zoomed, dragged and clicked.
// Its lowest line is the whole sequence. Needs page.js and lanes.js.
(() => {
  "use strict";

  const make = window.cartsElement;
  const NAMES = ["untouched", "optimized", "needs work", "accepted", "rejected", "moved by hand", "solved together"];
  const FIT = ["#7d8a93", "#22a352", "#e0a106", "#ef5350"]; // unknown, good, doubtful, failed; 3:1 in either theme
  const MARKS = { 2: "!", 3: "✓", 4: "✕" }; // of reviewed frames
  const VERDICTS = ["", "good", "doubtful", "failed"];
  const [TICKS, BARS, REVIEWS, WHOLE] = [13, 20, 13, 8]; // heights [px]
  const [PICTURES, CURVE] = [38, 36]; // heights of the parts omitted in low windows [px]
  const TALL = 560; // minimum height of a window that shows them [px]
  const LEAST = 8; // minimum number of visible frames
  const CONFIRMED_WITHIN = 1000; // time after which the server's range applies even if it differs from the reported range [ms]
  const GRIP = 7; // distance within which an end of the range can be grabbed [px]

  let strip = null;
  let canvas = null;
  let readout = null;
  let tip = null; // the readout for the frame under the pointer
  let picker = null;
  let frames = 0;
  let ids = null;
  let codes = new Uint32Array(0); // per frame: review + 8 fit + 32 source + 128 kept + 256 badness
  // + 65536 (1 + undetermined joints, 0 if unknown)
  let here = 0;
  let solving = null;
  let fps = 0;
  let known = { domains: [], cameras: [], aspects: [] };
  let shown = { names: [], active: 0, domain: "", range: null };
  let range = null; // first and last frame that are played, solved and optimized
  let view = [0, 1]; // first and last visible frame
  let dragging = null; // "scrub", "whole" or "range"
  let anchor = 0; // frame at which the marking of a range started
  let hover = null; // frame under the pointer
  let pointer = 0; // column of the pointer on the canvas [px]
  let dirty = true;
  let wanted = null;
  let open = localStorage.getItem("carts-lanes") !== "closed";

  function build() {
    const below = window.__viserMutable?.canvas;
    if (!below || strip?.isConnected) return;
    strip = document.createElement("div");
    strip.className = "carts-strip";
    strip.innerHTML = `<div class="carts-strip-head">
        <button data-do="first" aria-label="Start the range" data-key="MarkRange False" title="Start the range at this frame; the range limits playback, solving, optimizing and exporting" data-icon="brackets-contain-start"></button>
        <button data-do="last" aria-label="End the range" data-key="MarkRange True" title="End the range at this frame" data-icon="brackets-contain-end"></button>
        <span class="carts-range"></span>
        <button data-do="whole" title="Remove the range" aria-label="Remove the range" data-icon="x"></button>
        <select aria-label="Curve" title="Draw a curve over all frames: a joint, the loss, Dice or the probability of failure"></select>
        <button data-do="frames" title="All frames as a table or a gallery" aria-label="Frames" data-icon="table"></button>
        <button data-do="lanes" title="Show or hide thumbnails and curve" aria-label="Thumbnails and curve"></button>
        <output></output>
      </div>
      <canvas role="slider" tabindex="0" aria-label="Timeline" aria-valuemin="1" aria-valuemax="1" aria-valuenow="1"></canvas>`;
    window.cartsIcons(strip);
    window.carts.nameKeys(strip);
    tip = document.createElement("div");
    tip.className = "carts-tip";
    tip.hidden = true;
    strip.append(tip);
    [canvas, readout, picker] = ["canvas", "output", "select"].map((name) => strip.querySelector(name));
    for (const kind of ["pointerdown", "pointermove", "pointerup", "wheel", "dblclick"]) {
      strip.addEventListener(kind, (event) => event.stopPropagation());
    }
    canvas.addEventListener("pointerdown", press);
    canvas.addEventListener("pointermove", move);
    canvas.addEventListener("pointerup", () => { dragging = null; tellRange(); });
    canvas.addEventListener("pointerleave", () => { hover = null; dirty = true; });
    canvas.addEventListener("wheel", zoom, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const to = { ArrowLeft: here - 1, ArrowRight: here + 1, Home: 0, End: frames - 1 }[event.key];
      if (to === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
      window.carts.report("ShowFrame", { index: clamped(to) });
      event.preventDefault();
      event.stopPropagation();
    });
    canvas.addEventListener("dblclick", () => { view = [0, frames]; dirty = true; });
    const actions = {
      first: () => window.carts.report("Pressed", { key: "MarkRange False" }), last: () => window.carts.report("Pressed", { key: "MarkRange True" }),
      whole: () => window.carts.report("SetRange", { frames: null }),
      frames: () => window.carts.openFrames(),
      lanes: () => { open = !open; localStorage.setItem("carts-lanes", open ? "open" : "closed"); dirty = true; },
    };
    strip.addEventListener("click", (event) => actions[event.target.closest("button")?.dataset.do]?.());
    picker.addEventListener("change", () => { window.carts.lanes.choose(picker.value); picker.blur(); });
    window.carts.lanes.onChange(() => { dirty = true; });
    fillPicker();
    below.parentElement.append(strip);
    dirty = true;
  }

  function fillPicker() {
    if (!picker) return;
    picker.replaceChildren(...["", ...(known.traces ?? [])].map((name) => new Option(name || "No curve", name)));
    picker.value = window.carts.lanes.chosen();
    if (known.traces && picker.selectedIndex < 0) { picker.value = ""; window.carts.lanes.choose(""); }
  }

  const tall = () => open && innerHeight >= TALL && !document.body.classList.contains("carts-small");
  const picturesHigh = () => (tall() ? PICTURES : 0);
  const curveHigh = () => (tall() && window.carts.lanes.chosen() ? CURVE : 0);
  const barsAt = () => TICKS + picturesHigh();
  const curveAt = () => barsAt() + BARS + REVIEWS + 2;
  const wholeAt = () => curveAt() + curveHigh();
  const high = () => wholeAt() + 6 + WHOLE;

  const width = () => canvas.clientWidth;
  const frameAt = (x) => view[0] + (x / width()) * (view[1] - view[0]);
  const xOf = (frame) => ((frame - view[0]) / (view[1] - view[0])) * width();
  const clamped = (frame) => Math.min(Math.max(Math.floor(frame), 0), frames - 1);

  /** Show these frames, clamped to the sequence. */
  function show(first, count) {
    const shown = Math.min(Math.max(count, Math.min(LEAST, frames)), frames);
    const start = Math.min(Math.max(first, 0), frames - shown);
    view = [start, start + shown];
    dirty = true;
  }

  function go(frame) {
    if (frame === wanted) return;
    if (wanted === null) setTimeout(() => { window.carts.report("ShowFrame", { index: wanted }); wanted = null; }, 33);
    wanted = frame;
  }

  /** The opposite end of the range if the pointer is at one of its ends. */
  function gripped(x) {
    if (!range) return null;
    if (Math.abs(x - xOf(range[0])) <= GRIP) return range[1];
    return Math.abs(x - xOf(range[1] + 1)) <= GRIP ? range[0] : null;
  }

  function press(event) {
    canvas.setPointerCapture(event.pointerId);
    const other = event.offsetY < barsAt() ? gripped(event.offsetX) : null;
    dragging = event.offsetY >= wholeAt() ? "whole" : event.shiftKey || other !== null ? "range" : "scrub";
    anchor = other ?? clamped(frameAt(event.offsetX));
    move(event);
  }

  let rangeTimer = null;
  let unconfirmed = null; // timer while the server's range may be older than the reported one
  function mark(first, last) {
    range = [Math.min(first, last), Math.max(first, last)];
    rangeTimer ??= setTimeout(tellRange, 40);
  }

  /** Apply the server's range, except during a drag and until the server has confirmed the reported range. */
  function takeRange() {
    if (dragging === "range" || unconfirmed !== null) return;
    range = shown.range;
    dirty = true;
  }

  /** Report a changed range: at once on release, so that it cannot override later changes. */
  function tellRange() {
    if (rangeTimer === null) return;
    clearTimeout(rangeTimer);
    rangeTimer = null;
    window.carts.report("SetRange", { frames: range });
    clearTimeout(unconfirmed);
    unconfirmed = setTimeout(() => { unconfirmed = null; takeRange(); }, CONFIRMED_WITHIN);
  }

  function move(event) {
    const inWhole = event.offsetY >= wholeAt();
    pointer = event.offsetX;
    hover = clamped(inWhole && dragging !== "scrub" ? (event.offsetX / width()) * frames : frameAt(event.offsetX));
    dirty = true;
    canvas.style.cursor = event.offsetY < barsAt() && gripped(event.offsetX) !== null ? "ew-resize" : "";
    if (dragging === "scrub") go(clamped(frameAt(event.offsetX)));
    else if (dragging === "range") mark(anchor, clamped(frameAt(event.offsetX)));
    else if (dragging === "whole" && view[1] - view[0] < frames) {
      const count = view[1] - view[0];
      show((event.offsetX / width()) * frames - count / 2, count);
    } else if (dragging === "whole") go(hover);
  }

  function zoom(event) {
    event.preventDefault();
    const count = view[1] - view[0];
    const by = Math.exp((Math.abs(event.deltaX) > Math.abs(event.deltaY) ? 0 : event.deltaY) * 0.002);
    const at = event.offsetX / width();
    const next = Math.min(Math.max(count * by, Math.min(LEAST, frames)), frames);
    show(frameAt(event.offsetX) - at * next + (event.deltaX / width()) * count, next);
  }

  /** For every column of pixels: code of the worst frame, and review state of the first reviewed frame. */
  function columns(first, last, count) {
    const found = [];
    for (let column = 0; column < count; column += 1) {
      const from = Math.floor(first + ((last - first) * column) / count);
      const to = Math.max(Math.floor(first + ((last - first) * (column + 1)) / count), from + 1);
      let [worst, review] = [0, 0];
      for (let frame = from; frame < to && frame < frames; frame += 1) {
        const code = codes[frame];
        if ((code & 0xffff00) >= (worst & 0xffff00)) worst = code || worst;
        if (MARKS[code & 7]) review ||= code & 7;
      }
      found.push([worst, review]);
    }
    return found;
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    canvas.style.height = `${high()}px`;
    document.documentElement.style.setProperty("--carts-strip", `${strip.offsetHeight}px`);
    const [w, h] = [width(), high()];
    if (!w) return;
    [canvas.width, canvas.height] = [Math.round(w * ratio), Math.round(h * ratio)];
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const light = document.documentElement.dataset.mantineColorScheme === "light";
    const ink = light ? "#374151" : "#b4c0c0";
    drawTicks(context, ink, w);
    const lane = { view, frames, xOf, light, ink, w, here };
    if (picturesHigh()) {
      const domain = Math.max(known.domains.indexOf(shown.domain), 0);
      const camera = shown.active ?? 0;
      window.carts.lanes.drawThumbnails(
        context, { ...lane, top: TICKS, height: PICTURES - 2 }, { camera, domain, aspect: known.aspects[camera] ?? 4 / 3 });
    }
    drawBars(context, ink, w);
    const curve = { ...lane, top: curveAt() + 1, height: CURVE - 3 };
    if (curveHigh()) window.carts.lanes.drawCurve(context, curve);
    if (solving) {
      context.fillStyle = light ? "rgba(15, 118, 110, 0.18)" : "rgba(45, 212, 167, 0.18)";
      context.fillRect(xOf(solving[0]), barsAt(), xOf(solving[0] + solving[1]) - xOf(solving[0]), BARS);
    }
    drawRange(context, light, w);
    if (curveHigh()) window.carts.lanes.drawCurveLabels(context, curve);
    drawWhole(context, w, h, light);
    drawHere(context, light);
    say();
  }

  /** Fits as bars, whose height is the misfit and whose colour is the verdict, above the marks of reviewed frames. */
  function drawBars(context, ink, w) {
    const top = barsAt();
    const cells = Math.min(Math.ceil(view[1] - view[0]), Math.floor(w));
    const wide = w / cells;
    context.font = "600 10px system-ui, sans-serif";
    context.textAlign = "center";
    columns(view[0], view[1], cells).forEach(([code, review], number) => {
      const x = number * wide;
      const thick = Math.max(wide - (wide > 3 ? 1 : 0), 1);
      if (code) {
        const tallness = Math.max(3, (((code >> 8) & 255) / 255) * BARS);
        context.fillStyle = FIT[(code >> 3) & 3];
        context.fillRect(x, top + BARS - tallness, thick, tallness);
      }
      if (!review) return;
      context.fillStyle = ink;
      if (wide >= 9) context.fillText(MARKS[review], x + wide / 2, top + BARS + REVIEWS - 3);
      else context.fillRect(x, top + BARS + 4, thick, review === 3 ? 2 : 5); // no room for a sign: low if accepted
    });
    context.textAlign = "start";
  }

  /** Dim the frames outside of the range, and draw its ends, which can be dragged in the upper part. */
  function drawRange(context, light, w) {
    if (!range) return;
    const [left, right] = [xOf(range[0]), xOf(range[1] + 1)];
    context.fillStyle = light ? "rgba(248, 250, 252, 0.72)" : "rgba(10, 12, 13, 0.66)";
    context.fillRect(0, TICKS, Math.max(left, 0), wholeAt() - TICKS);
    context.fillRect(right, TICKS, Math.max(w - right, 0), wholeAt() - TICKS);
    context.fillStyle = "#f59e0b";
    context.fillRect(left, 0, 2, wholeAt());
    context.fillRect(right - 2, 0, 2, wholeAt());
    context.fillRect(left, 0, 6, 2);
    context.fillRect(right - 6, 0, 6, 2);
  }

  function drawHere(context, light) {
    const x = xOf(here);
    context.fillStyle = light ? "#0f766e" : "#2dd4a7";
    context.fillRect(x, TICKS - 3, Math.max(xOf(here + 1) - x, 2), 3);
    context.globalAlpha = 0.3;
    context.fillRect(x, TICKS, Math.max(xOf(here + 1) - x, 2), wholeAt() - TICKS - 1);
    context.globalAlpha = 1;
  }

  /** Description of a frame, with the number of its undetermined joints if `whole`. */
  function described(frame, whole = true) {
    const code = codes[frame] ?? 0;
    const said = NAMES[code & 7];
    const open = (code >> 16) - 1;
    const joints = open < 0 ? "" : open ? `, ${open} joint${open === 1 ? "" : "s"} not determined` : ", all joints determined";
    const fit = VERDICTS[(code >> 3) & 3] && ` · mask ${VERDICTS[(code >> 3) & 3]}${whole ? joints : ""}`;
    const value = curveHigh() ? window.carts.lanes.valueAt(frame) : "";
    return `${name(frame)} of ${frames} · ${said}${fit}${code & 128 ? " · kept" : ""}${value}`;
  }

  function say() {
    readout.textContent = described(here, false);
    const value = { "aria-valuemax": frames, "aria-valuenow": here + 1, "aria-valuetext": described(here) };
    for (const [name, now] of Object.entries(value)) canvas.setAttribute(name, String(now));
    readout.title = described(here);
    tip.hidden = hover === null;
    if (hover !== null) {
      tip.textContent = described(hover);
      tip.style.left = `${Math.min(Math.max(pointer - tip.offsetWidth / 2, 4), width() - tip.offsetWidth - 4)}px`;
    }
    strip.querySelector(".carts-range").textContent = range ? `${name(range[0])} – ${name(range[1])}` : "";
    strip.querySelector("[data-do=whole]").hidden = !range;
    const lanes = strip.querySelector("[data-do=lanes]");
    if (lanes.dataset.open !== String(open)) {
      lanes.dataset.open = String(open);
      lanes.replaceChildren(window.cartsIcon(open ? "chevron-down" : "chevron-up"));
      lanes.setAttribute("aria-expanded", String(open));
    }
  }

  const name = (frame) => (ids && ids[frame] !== undefined ? ids[frame] : String(frame + 1));

  function drawTicks(context, ink, w) {
    const count = view[1] - view[0];
    const least = (count / w) * 62;
    const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000, 50000].find((one) => one >= least) ?? 1e5;
    context.fillStyle = ink;
    context.font = "11px system-ui, sans-serif";
    for (let frame = Math.ceil(view[0] / step) * step; frame < view[1]; frame += step) {
      const x = xOf(frame);
      context.fillRect(x, 0, 1, TICKS - 4);
      const seconds = fps ? frame / fps : null;
      const time = seconds === null || seconds < 1 ? "" : ` ${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
      context.fillText(`${frame + 1}${time}`, x + 3, 9);
    }
  }

  function drawWhole(context, w, h, light) {
    const top = h - WHOLE;
    context.fillStyle = light ? "#e5e7eb" : "#23282b";
    context.fillRect(0, top, w, WHOLE);
    const cells = Math.min(frames, Math.floor(w));
    columns(0, frames, cells).forEach(([code], number) => {
      if (!code) return;
      context.fillStyle = FIT[(code >> 3) & 3];
      context.fillRect((number * w) / cells, top + 2, Math.max(w / cells, 1), WHOLE - 4);
    });
    if (range) {
      context.fillStyle = "#f59e0b";
      context.fillRect((range[0] / frames) * w, top, Math.max(((range[1] + 1 - range[0]) / frames) * w, 1), 2);
    }
    context.strokeStyle = light ? "#0f766e" : "#2dd4a7";
    context.strokeRect((view[0] / frames) * w + 0.5, top + 0.5, ((view[1] - view[0]) / frames) * w - 1, WHOLE - 1);
    context.fillStyle = context.strokeStyle;
    context.fillRect((here / frames) * w, top, 2, WHOLE);
  }

  function everyFrame() {
    requestAnimationFrame(everyFrame);
    build();
    if (!canvas || !frames) return;
    const size = `${canvas.clientWidth} ${high()} ${document.documentElement.dataset.mantineColorScheme}`;
    if (size !== everyFrame.size) { everyFrame.size = size; dirty = true; }
    if (!dirty) return;
    dirty = false;
    draw();
  }

  document.addEventListener("carts-page", ({ detail }) => {
    dirty = true;
    shown = detail;
    if (unconfirmed !== null && String(range) === String(detail.range)) {
      clearTimeout(unconfirmed);
      unconfirmed = null;
    }
    takeRange();
    if (detail.frame === here) return;
    here = detail.frame;
    const count = view[1] - view[0];
    // The view follows the frame, except during a drag.
    if (dragging === null && (here < view[0] || here >= view[1])) show(here - count / 2, count);
  });
  Object.assign(window.carts, {
    /** Set all codes, or only changed codes if not `whole`: a flat list of alternating frames and codes. */
    setTimeline(message) {
      if (message.whole) {
        const other = frames !== message.frames;
        [frames, fps, ids, known] = [message.frames, message.fps, message.ids, message];
        codes = new Uint32Array(frames);
        if (other) view = [0, frames];
        fillPicker();
      }
      for (let place = 0; place < message.codes.length; place += 2) codes[message.codes[place]] = message.codes[place + 1];
      solving = message.solving;
      if (message.whole || message.traced) window.carts.lanes.forget();
      dirty = true;
    },
    timeline: () => ({ view, frames, here, range, solving, code: (frame) => codes[frame], x: (frame) => xOf(frame + 0.5) }),
    showFrames: show,
    reviewNames: NAMES,
    nameOf: (frame) => name(frame),
    thumbnailOf: (frame, pose) => `thumbnail/${shown.active ?? 0}/${Math.max(known.domains.indexOf(shown.domain), 0)}/${frame}-${pose}.jpg`,
  });
  everyFrame();
})();
