// The timeline's thumbnails and curve. Only the visible part is requested: thumbnails two at a time, and the curve as
// minimum and maximum of every column. timeline.js sets their positions. Needs page.js.
(() => {
  "use strict";

  const KEPT = 800; // maximum number of cached pictures
  const AT_ONCE = 2;
  const AGAIN = [4000, 8000, 16000]; // delays before a picture that failed to load is requested again [ms]
  const WAIT = 90; // delay before a curve is requested again during a zoom [ms]
  const COLOURS = ["#8b98a5", "#2dd4a7"]; // of measured and corrected values

  // ---- Thumbnails -----------------------------------------------------------------------------------------------------

  const pictures = new Map(); // address -> image, or null if there is none
  const loading = new Set();
  const failures = new Map(); // address -> number of failed requests
  let waiting = [];
  let drawAgain = () => {};

  function load() {
    while (loading.size < AT_ONCE && waiting.length) {
      const address = waiting.shift();
      const image = new Image();
      const done = (found) => {
        loading.delete(address);
        pictures.set(address, found);
        if (pictures.size > KEPT) pictures.delete(pictures.keys().next().value);
        drawAgain();
        load();
      };
      loading.add(address);
      image.onload = () => { failures.delete(address); done(image); };
      image.onerror = () => { done(null); tryAgain(address); };
      image.src = address;
    }
  }

  /** Forget a failed request after a while, a few times; the server may have been busy, or the connection interrupted. */
  function tryAgain(address) {
    const count = failures.get(address) ?? 0;
    failures.set(address, count + 1);
    if (count < AGAIN.length) setTimeout(() => { pictures.delete(address); drawAgain(); }, AGAIN[count]);
  }

  /** Draw thumbnails of visible frames, spaced so that they do not overlap. */
  function drawThumbnails(context, { view, frames, xOf, top, height, light }, { camera, domain, aspect }) {
    const wide = Math.max(height * aspect, 8);
    const one = xOf(1) - xOf(0);
    const step = one >= wide ? 1 : 2 ** Math.ceil(Math.log2(wide / one));
    const missing = [];
    for (let frame = Math.floor(view[0] / step) * step; frame < Math.min(view[1], frames); frame += step) {
      const address = `thumbnail/${camera}/${domain}/${frame}.jpg`;
      const x = xOf(frame);
      const picture = pictures.get(address);
      if (picture) context.drawImage(picture, x, top, wide - 1, height);
      else {
        context.fillStyle = light ? "#e5e7eb" : "#1f2528";
        context.fillRect(x, top, wide - 1, height);
        if (picture === undefined && !loading.has(address)) missing.push(address);
      }
    }
    // Drop requests for frames that are no longer visible.
    waiting = missing;
    load();
  }

  // ---- The curve ---------------------------------------------------------------------------------------------------------

  let chosen = localStorage.getItem("carts-curve") ?? "";
  let curve = null; // the newest curve from the server
  let asked = "";
  let timer = null;

  /** Request the visible part of the curve, unless already requested. */
  function ask(view, columns) {
    const [first, last] = [Math.floor(view[0]), Math.ceil(view[1])];
    const key = `${chosen} ${first} ${last} ${columns}`;
    if (key === asked) return;
    asked = key;
    clearTimeout(timer);
    timer = setTimeout(() => window.carts.report("Trace", { name: chosen, first, last, columns }), WAIT);
  }

  function limits() {
    const values = curve.curves.flat(2).filter((value) => value !== null);
    if (!values.length) return null;
    const [low, high] = values.reduce(([a, b], value) => [Math.min(a, value), Math.max(b, value)], [Infinity, -Infinity]);
    const room = Math.max((high - low) * 0.08, Math.abs(high) * 1e-4, 1e-6);
    return [low - room, high + room];
  }

  function drawCurve(context, { view, xOf, top, height, ink, w }) {
    ask(view, Math.floor(w));
    context.font = "11px system-ui, sans-serif";
    const ends = curve?.name === chosen ? limits() : null;
    if (!ends) {
      context.fillStyle = ink;
      if (curve?.name === chosen) context.fillText(`${chosen}: no values in these frames`, 4, top + height / 2 + 3);
      return;
    }
    const yOf = (value) => top + height - ((value - ends[0]) / (ends[1] - ends[0])) * height;
    curve.curves.forEach(([lows, highs], number) => {
      context.strokeStyle = COLOURS[curve.curves.length === 1 ? 1 : number];
      context.lineWidth = 1.3;
      context.lineCap = "round";
      context.beginPath();
      let pen = false;
      lows.forEach((low, column) => {
        if (low === null) { pen = false; return; }
        const x = (xOf(curve.edges[column]) + xOf(curve.edges[column + 1])) / 2;
        if (pen) context.lineTo(x, yOf(highs[column]));
        else context.moveTo(x, yOf(highs[column]));
        context.lineTo(x, yOf(low) + 0.01); // draws a single value as a dot
        pen = true;
      });
      context.stroke();
    });
  }

  /** The ends of the curve's axis, and its value at the current frame. */
  function drawCurveLabels(context, { xOf, top, height, ink, w, here }) {
    const ends = curve?.name === chosen ? limits() : null;
    if (!ends) return;
    const yOf = (value) => top + height - ((value - ends[0]) / (ends[1] - ends[0])) * height;
    context.fillStyle = ink;
    context.font = "11px system-ui, sans-serif";
    const right = xOf(here + 0.5) < 110; // the axis is opposite the value
    context.textAlign = right ? "end" : "start";
    const x = right ? w - 4 : 4;
    context.fillText(String(Number(ends[1].toPrecision(4))), x, top + 9);
    context.fillText(String(Number(ends[0].toPrecision(4))), x, top + height - 2);
    context.textAlign = "start";
    drawValue(context, here, { xOf, yOf, ink, w });
  }

  /** Lowest and highest value of the curve in the column of a frame; null if unknown. */
  function rangeAt(frame) {
    if (!curve || curve.name !== chosen) return null;
    const column = curve.edges.findIndex((edge, place) => edge <= frame && frame < curve.edges[place + 1]);
    const found = curve.curves.map((ends) => ends.map((values) => values[column])).findLast(([low]) => (low ?? null) !== null);
    return column < 0 ? null : found ?? null;
  }

  const unit = () => /\[(.*)\]/.exec(chosen)?.[1] ?? "";
  const worded = ([low, high]) => `${low === high ? low : `${low} to ${high}`} ${unit()}`.trimEnd();

  /** A dot on the curve at a frame, with the value beside it. */
  function drawValue(context, frame, { xOf, yOf, ink, w }) {
    const found = rangeAt(frame);
    if (!found) return;
    const [x, y] = [xOf(frame + 0.5), yOf(found[1])];
    context.fillStyle = ink;
    context.beginPath();
    context.arc(x, y, 3, 0, 2 * Math.PI);
    context.fill();
    context.font = "600 11px system-ui, sans-serif";
    const text = worded(found);
    const wide = context.measureText(text).width;
    context.fillText(text, x + wide + 10 < w ? x + 7 : x - wide - 7, y + 4);
  }

  /** The curve's value at a frame as text; empty if unknown. */
  function valueAt(frame) {
    const found = rangeAt(frame);
    return found ? ` · ${worded(found)}` : "";
  }

  Object.assign(window.carts, {
    lanes: {
      drawThumbnails, drawCurve, drawCurveLabels, valueAt,
      onChange: (callback) => { drawAgain = callback; },
      chosen: () => chosen,
      choose(name) { chosen = name; localStorage.setItem("carts-curve", name); asked = ""; drawAgain(); },
      /** Invalidate the curve after a change of its values. */
      forget() { asked = ""; },
      loaded: () => [...pictures].filter(([, picture]) => picture).map(([address]) => address),
      idle: () => !loading.size && !waiting.length,
      curve: () => curve,
    },
    setTrace(message) { curve = message; drawAgain(); },
  });
})();
