// Brush, eraser and polygon. A stroke is drawn here at once, sent when it is finished, and removed as soon as the
// server's overlay shows it. Needs page.js.
(() => {
  "use strict";

  const SPACING = 0.7; // minimum distance between stored points [px of the image]
  const MAX_POINTS = 15000; // then another stroke begins, since the server accepts at most 20,000 points
  const BOX = 6; // minimum motion of the pointer that draws a box [px of the screen]
  const NEAR = 9; // distance to the first corner within which a click closes the polygon [px of the screen]
  const SHOWN_BY_NOW = 250; // [ms] after the server's acknowledgement, if no new overlay is detected
  const FORGOTTEN = 60000; // [ms] after which an unacknowledged stroke is dropped

  let brush = { tool: "select" }; // state of the tool from the server
  let picture = {}; // frame, camera and image size [px] of the shown picture
  let canvas = null;
  let drawing = null; // the current stroke, or the open polygon
  let pending = []; // sent strokes that no overlay shows yet
  let count = 0;
  let pointer = null; // its position in the image [px]
  let shift = false;
  let drawn = "";
  let dirty = true;

  const active = () => ["brush", "polygon", "eraser", "prompt"].includes(brush.tool) && window.carts?.view.endoscope;
  const place = () => window.carts?.imageOnScreen();

  function inImage(event) {
    const image = place();
    if (!image) return null;
    const box = canvas.getBoundingClientRect();
    return [
      ((event.clientX - box.left - image.left) / image.width) * picture.width,
      ((event.clientY - box.top - image.top) / image.height) * picture.height,
    ];
  }

  /** Distance on the screen between two points of the image [px]. */
  function apart(a, b) {
    const image = place();
    return Math.hypot(((a[0] - b[0]) * image.width) / picture.width, ((a[1] - b[1]) * image.height) / picture.height);
  }

  function begin(point) {
    const { frame, camera } = picture;
    const { target, label, diameter, tool, colors } = brush;
    drawing = {
      frame, camera, target, label, diameter, polygon: tool === "polygon", prompt: tool === "prompt",
      erase: (tool === "eraser") !== shift,
      points: [point], colors,
    };
  }

  function add(point) {
    if (drawing.prompt) {
      // A click, or a box from the first point to the pointer.
      drawing.points = apart(drawing.points[0], point) > BOX ? [drawing.points[0], point] : [drawing.points[0]];
      dirty = true;
      return;
    }
    const last = drawing.points[drawing.points.length - 1];
    if (Math.hypot(point[0] - last[0], point[1] - last[1]) < SPACING) return;
    drawing.points.push(point);
    if (drawing.points.length >= MAX_POINTS && !drawing.polygon) {
      finish();
      begin(point);
    }
  }

  /** Send the finished stroke. */
  function finish() {
    const stroke = drawing;
    drawing = null;
    dirty = true;
    if (!stroke) return;
    if (stroke.polygon) {
      if (stroke.points.length < 3) return;
      stroke.erase = shift;
    }
    stroke.number = ++count;
    stroke.sent = performance.now();
    pending.push(stroke);
    const { number, frame, camera, target, label, erase, polygon, prompt, diameter } = stroke;
    const points = stroke.points.map((point) => point.map((value) => Math.round(value * 10) / 10));
    window.carts.report("Painted", { number, frame, camera, target, label, erase, polygon, prompt, diameter, points });
  }

  function drop() {
    drawing = null;
    dirty = true;
  }

  /** End the stroke, which belongs to the frame and tool with which it was started; an unfinished polygon is dropped. */
  function stop() {
    if (drawing?.polygon) drop();
    else finish();
  }

  // ---- Pointer and keys --------------------------------------------------------------------------------------------

  function press(event) {
    if (event.button !== 0) return;
    const point = inImage(event);
    if (!point) return;
    const at = window.carts.imageAt(event);
    if (!drawing && at && at[0] !== window.carts.shown().active) {
      window.carts.activate(at[0]);
      return;
    }
    event.preventDefault();
    document.activeElement?.blur?.();
    shift = event.shiftKey || (event.altKey && brush.tool === "prompt");
    if (brush.tool !== "polygon") {
      canvas.setPointerCapture(event.pointerId);
      begin(point);
    } else if (!drawing) {
      begin(point);
    } else if (drawing.points.length > 2 && apart(point, drawing.points[0]) < NEAR) {
      finish();
    } else if (apart(point, drawing.points[drawing.points.length - 1]) > 3) {
      add(point);
    }
    dirty = true;
  }

  function move(event) {
    pointer = inImage(event);
    if (!drawing?.prompt) shift = event.shiftKey;
    dirty = true;
    if (!drawing || drawing.polygon) return;
    const moves = event.getCoalescedEvents?.() ?? [];
    for (const one of moves.length ? moves : [event]) {
      const point = inImage(one);
      if (point) add(point); // null while the picture is replaced
    }
  }

  function release(event) {
    if (event.button === 0 && drawing && !drawing.polygon) finish();
  }

  function onKey(event) {
    const typing = event.target instanceof Element && event.target.closest("input, textarea, [role=dialog]");
    if (event.key === "Shift") { shift = event.type === "keydown"; dirty = true; }
    if (event.type !== "keydown" || typing || event.ctrlKey || event.metaKey) return;
    if (!drawing || !["Escape", "Enter", "Backspace"].includes(event.key)) return;
    if (event.key === "Escape") drop();
    else if (event.key === "Enter" && drawing.polygon) finish();
    else if (event.key === "Backspace" && drawing.polygon && drawing.points.pop() && !drawing.points.length) drop();
    dirty = true;
    event.preventDefault();
    event.stopImmediatePropagation(); // keys.js does not see these keys
  }

  // ---- Drawing -----------------------------------------------------------------------------------------------------

  function build() {
    const below = window.__viserMutable?.canvas;
    if (!below || canvas?.isConnected) return;
    canvas = document.createElement("canvas");
    canvas.className = "carts-paint";
    canvas.addEventListener("pointerdown", press);
    canvas.addEventListener("pointermove", move);
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", finish);
    canvas.addEventListener("pointerleave", () => { pointer = null; dirty = true; });
    canvas.addEventListener("dblclick", () => { if (drawing?.polygon) finish(); });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    below.parentElement.append(canvas);
  }

  function path(context, stroke, image, closed) {
    const [x, y] = [image.width / picture.width, image.height / picture.height];
    context.beginPath();
    // A single point is repeated, so that the round ends of the line draw it.
    const points = stroke.points.length === 1 ? [...stroke.points, ...stroke.points] : stroke.points;
    for (const [u, v] of points) context.lineTo(u * x, v * y);
    if (closed) context.closePath();
    return x;
  }

  function paint(context, stroke, image, finished) {
    const color = stroke.erase ? stroke.colors.erase : stroke.colors.add;
    context.globalAlpha = 0.55;
    context.fillStyle = context.strokeStyle = color;
    context.lineCap = context.lineJoin = "round";
    if (stroke.prompt) {
      paintPrompt(context, stroke, image);
      return;
    }
    const scale = path(context, stroke, image, stroke.polygon && finished);
    if (!stroke.polygon) {
      context.lineWidth = stroke.diameter * scale;
      context.stroke();
      return;
    }
    context.fill();
    if (finished) return;
    context.globalAlpha = 1;
    context.lineWidth = 1.5;
    context.stroke();
    const [u, v] = stroke.points[0];
    ring(context, u * scale, (v * image.height) / picture.height, 4);
  }

  /** Draw a prompt: a dot, or a box. */
  function paintPrompt(context, stroke, image) {
    const [x, y] = [image.width / picture.width, image.height / picture.height];
    const [first, last] = [stroke.points[0], stroke.points[stroke.points.length - 1]];
    context.globalAlpha = 1;
    if (stroke.points.length === 1) {
      context.beginPath();
      context.arc(first[0] * x, first[1] * y, 5, 0, 2 * Math.PI);
      context.fill();
      ring(context, first[0] * x, first[1] * y, 5);
      return;
    }
    for (const [color, width] of [["rgba(0, 0, 0, 0.7)", 3.5], [context.fillStyle, 1.75]]) {
      context.strokeStyle = color;
      context.lineWidth = width;
      context.strokeRect(first[0] * x, first[1] * y, (last[0] - first[0]) * x, (last[1] - first[1]) * y);
    }
  }

  function ring(context, x, y, radius) {
    context.globalAlpha = 1;
    for (const [color, width] of [["rgba(0, 0, 0, 0.7)", 3], ["white", 1.25]]) {
      context.strokeStyle = color;
      context.lineWidth = width;
      context.beginPath();
      context.arc(x, y, Math.max(radius, 1), 0, 2 * Math.PI);
      context.stroke();
    }
  }

  function redraw(image) {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    if (!image || !picture.width) return;
    context.translate(image.left, image.top);
    context.save();
    context.beginPath();
    context.rect(0, 0, image.width, image.height);
    context.clip();
    for (const stroke of pending) {
      if (stroke.frame === picture.frame && stroke.camera === picture.camera) paint(context, stroke, image, true);
    }
    if (drawing) {
      const towards = drawing.polygon && pointer ? [...drawing.points, pointer] : drawing.points;
      paint(context, { ...drawing, points: towards, erase: drawing.polygon ? shift : drawing.erase }, image, false);
    }
    context.restore();
    if (pointer && active() && !["polygon", "prompt"].includes(brush.tool)) {
      const scale = image.width / picture.width;
      ring(context, pointer[0] * scale, (pointer[1] * image.height) / picture.height, (brush.diameter / 2) * scale);
    }
  }

  /** The canvas receives pointer events if a tool is selected; otherwise the pointer pans the image. */
  function takePointer(on) {
    canvas.style.pointerEvents = on ? "auto" : "none";
  }

  function everyFrame() {
    requestAnimationFrame(everyFrame);
    build();
    if (!canvas) return;
    const image = window.carts.imageOnScreen();
    const on = active();
    takePointer(on);
    const now = performance.now();
    const texture = window.carts.drawnOverlay();
    const left = pending.filter((stroke) => {
      if (!stroke.done) return now - stroke.sent < FORGOTTEN;
      return texture === stroke.texture && now - stroke.done < SHOWN_BY_NOW;
    });
    const where = JSON.stringify([image, on, canvas.clientWidth, canvas.clientHeight, window.devicePixelRatio]);
    if (left.length !== pending.length || where !== drawn) dirty = true;
    pending = left;
    if (!dirty) return;
    [dirty, drawn] = [false, where];
    redraw(image);
  }

  window.addEventListener("keydown", onKey, { capture: true });
  window.addEventListener("keyup", onKey, { capture: true });
  Object.assign(window.carts, {
    /** Set the frame and camera of the picture, and the size of its image [px]; it comes with the picture. */
    setPicture(frame, camera, width, height) {
      stop();
      picture = { frame, camera, width, height };
      dirty = true;
    },
    /** Set the selected tool. */
    setBrush(message) {
      if (message.tool !== brush.tool) stop();
      brush = message;
      dirty = true;
      if (canvas) takePointer(active());
      document.dispatchEvent(new CustomEvent("carts-brush"));
    },
    /** The server has applied all strokes up to this one, and sent an overlay that shows them. */
    painted(number) {
      for (const stroke of pending) {
        if (stroke.number <= number) {
          stroke.done ??= performance.now();
          stroke.texture ??= window.carts.drawnOverlay();
        }
      }
    },
    brush: () => brush,
    pendingStrokes: () => pending.length,
  });
  everyFrame();
})();
