// The palette of tools over the left edge of the image, the options of the selected tool, and its cursor. The server holds
// the state (`panels/tools.py`). Needs page.js, paint.js and keys.js.
(() => {
  "use strict";

  const make = window.cartsElement;
  const report = (...event) => window.carts.report(...event);
  const ANY = "Any arm";
  const NEAREST = "Nearest to the pointer";
  // Name, icon, action of its key, and use.
  const TOOLS = [
    ["Select", "pointer", "SetTool Select", "drag pans, a click chooses a camera"],
    ["Drag link", "hand-grab", "ToggleTool Drag link", "drag a link of an arm; its joints follow"],
    ["Keypoint", "target", "ToggleTool Keypoint", "click or drag a keypoint to its place in the image; the arm follows"],
    ["Brush", "brush", "ToggleTool Brush", "drag paints, with Shift erases"],
    ["Polygon", "polygon", "ToggleTool Polygon", "click corners; Enter or a double click fills, with Shift erases; Backspace removes a corner"],
    ["Eraser", "eraser", "ToggleTool Eraser", "drag erases, with Shift paints"],
    ["Prompt", "wand", "ToggleTool Prompt", "click an object, or drag a box around it; further clicks refine it, with Shift exclude"],
  ];
  const SWITCHES = [
    ["Ignore", "ban", "SetTarget None", "paint the region that runs ignore, instead of the mask"],
    ["Loupe", "zoom-in-area", "loupe", "magnified pixels, coordinates and colour"],
  ];
  const PAINTING = ["brush", "polygon", "eraser", "prompt"];
  let palette = null;
  let options = null;
  let shown = ""; // the tool and target whose options are built
  let pointer = false; // whether the options were last used with the pointer
  const state = () => window.carts.brush();

  // ---- Palette ---------------------------------------------------------------------------------------------------------

  function build() {
    const below = window.__viserMutable?.canvas;
    if (!below || palette?.isConnected || !state().classes) return;
    const button = ([name, icon, key, use], kind) => make("button", {
      type: "button", "data-tool": name.toLowerCase(), "data-kind": kind, "data-key": key, "data-icon": icon,
      "aria-label": name, title: `${name}: ${use}`, tabindex: "-1",
    });
    palette = make("div", { class: "carts-tools", role: "toolbar", "aria-label": "Tools" },
      ...TOOLS.map((tool) => button(tool, "tool")), make("hr", {}), ...SWITCHES.map((one) => button(one, "switch")));
    options = make("div", { class: "carts-options", role: "group", hidden: "" });
    window.cartsIcons(palette);
    window.carts.nameKeys(palette);
    palette.firstChild.tabIndex = 0;
    palette.addEventListener("click", ({ target }) => { const one = target.closest("button"); if (one) choose(one); });
    palette.addEventListener("keydown", rove);
    options.addEventListener("change", ({ target }) => { if (pointer) target.blur(); });
    for (const one of [palette, options]) {
      for (const kind of ["pointerdown", "pointermove", "pointerup", "wheel", "dblclick"]) {
        one.addEventListener(kind, (event) => { pointer ||= kind === "pointerdown"; event.stopPropagation(); });
      }
    }
    options.addEventListener("keydown", () => { pointer = false; });
    below.parentElement.append(palette, options);
    shown = "";
    draw();
  }

  function choose(button) {
    const name = button.getAttribute("aria-label");
    if (name === "Loupe") report("ShowLoupe");
    else if (name === "Ignore") report("SetTarget");
    else if (button.dataset.tool === state().tool && name !== "Select") options.hidden = !options.hidden;
    else report("SetTool", { tool: name });
  }

  /** Move the focus within the palette; its buttons are one stop of the Tab key. */
  function rove(event) {
    const all = [...palette.querySelectorAll("button")];
    const here = all.indexOf(event.target);
    const last = all.length - 1;
    const to = {
      ArrowDown: here === last ? 0 : here + 1, ArrowRight: here === last ? 0 : here + 1,
      ArrowUp: here ? here - 1 : last, ArrowLeft: here ? here - 1 : last, Home: 0, End: last,
    }[event.key];
    if (to === undefined || here < 0) return;
    for (const [place, one] of all.entries()) one.tabIndex = place === to ? 0 : -1;
    all[to].focus();
    event.preventDefault();
    event.stopPropagation();
  }

  // ---- Options ---------------------------------------------------------------------------------------------------------

  const select = (label, chosen, values, change) => {
    const list = make("select", { "aria-label": label }, ...values.map(([value, text]) => make("option", { value }, text)));
    list.value = chosen;
    list.addEventListener("change", () => change(list.value));
    return make("label", {}, `${label} `, list);
  };
  const act = (name, title, event, icon) => {
    const button = make("button", { type: "button", title, "data-do": name.toLowerCase(), ...(icon ? { "aria-label": name, "data-icon": icon } : {}) }, ...(icon ? [] : [name]));
    button.addEventListener("click", () => report(...event));
    return button;
  };

  /** The controls of the selected tool. */
  function controls(brush) {
    if (brush.tool === "keypoint") {
      const check = make("input", { type: "checkbox" });
      check.addEventListener("change", () => report("ShowKeypoints", { on: check.checked }));
      return [
        select("Keypoint", brush.keypoint ?? "", [["", NEAREST], ...brush.keypoints.map((one) => [one, one])],
          (label) => report("ChooseKeypoint", { label: label || null })),
        make("label", {}, check, " Show all"), make("output", {}),
        act("Clear", "Remove the placed keypoints; the arm keeps its pose", ["RemovePins"], "trash"),
      ];
    }
    if (!PAINTING.includes(brush.tool)) return [];
    const size = make("input", { type: "range", min: 1, max: 300, "aria-label": "Size [px]" });
    size.addEventListener("input", () => report("SetDiameter", { diameter: Number(size.value) }));
    const label = select("Class", brush.label, [[0, ANY], ...brush.classes], (number) => report("SetPaintClass", { number: Number(number) }));
    label.title = "A part of an arm, shown by the layer Parts. Pixels of Any arm belong to the nearest arm";
    return [
      ...(["brush", "eraser"].includes(brush.tool) ? [make("label", { title: `Diameter (${window.carts.keyOf("ScaleBrush 0.8")} ${window.carts.keyOf("ScaleBrush 1.25")})` }, size, make("span", {}))] : []),
      ...(brush.target === "Mask" ? [label] : []), make("output", {}),
      ...(brush.tool === "prompt" ? [act("Next object", `The next click starts another object (${window.carts.keyOf("NextObject")})`, ["NextObject"])] : []),
      act("Clear", "Clear this layer in this frame and camera", ["ClearLayer"], "trash"),
    ];
  }

  function readout(brush) {
    if (brush.tool === "keypoint") return [brush.pins ? `${brush.pins} placed · RMS ${brush.residual.toFixed(1)} px` : ""];
    const swatch = (color) => { const one = make("i", { class: "carts-swatch" }); one.style.background = color; return one; };
    const counts = brush.painted.filter(([, count]) => count);
    const unused = brush.unused ? ["Used only by the Surface maps solvers"] : [];
    return [...unused, ...counts.map(([color, count, name]) => make("span", { class: "carts-key" }, swatch(color), `${count} px ${name}`))];
  }

  function drawOptions(brush) {
    const now = JSON.stringify([brush.tool, brush.target, brush.keypoints.length]);
    if (now !== shown) {
      shown = now;
      const made = controls(brush);
      options.replaceChildren(...made);
      window.cartsIcons(options);
      options.hidden = !made.length;
      options.setAttribute("aria-label", `Options: ${brush.tool}`);
    }
    const set = (selector, write) => { const one = options.querySelector(selector); if (one && one !== document.activeElement) write(one); };
    set("input[type=range]", (one) => { one.value = brush.diameter; });
    set("label span", (one) => { one.textContent = `${brush.diameter} px`; });
    set("select", (one) => { one.value = brush.tool === "keypoint" ? brush.keypoint ?? "" : brush.label; });
    set("input[type=checkbox]", (one) => { one.checked = brush.keypointsShown; });
    set("output", (one) => one.replaceChildren(...readout(brush)));
    set("[data-do=clear]", (one) => { one.disabled = brush.tool === "keypoint" ? !brush.pins : !brush.painted.length; });
  }

  function draw() {
    if (!palette) return;
    const brush = state();
    for (const button of palette.querySelectorAll("button")) {
      const name = button.dataset.tool;
      const on = name === "ignore" ? brush.target !== "Mask" : name === "loupe" ? brush.loupe : name === brush.tool;
      button.setAttribute("aria-pressed", String(on));
    }
    drawOptions(brush);
    window.carts.setLoupe(brush.loupe);
    setCursor();
  }

  // ---- Cursor ----------------------------------------------------------------------------------------------------------

  const cursors = new Map();
  let override = null; // while a modifier key or a button of the mouse is down

  /** A cursor of a cross and the icon of a tool. */
  function cursorOf(icon) {
    if (!cursors.has(icon)) {
      const lines = `<path d="M9 2v4M9 12v4M2 9h4M12 9h4"/><g transform="translate(14 14) scale(.7)">${window.cartsConfiguration.icons[icon]}</g>`;
      const svg = `<svg xmlns="http://www.w3.org/2000/svg" width="32" height="32" fill="none" stroke-linecap="round"><g stroke="black" stroke-width="4" stroke-opacity=".75">${lines}</g><g stroke="white" stroke-width="1.75">${lines}</g></svg>`;
      cursors.set(icon, `url("data:image/svg+xml,${encodeURIComponent(svg)}") 9 9, crosshair`);
    }
    return cursors.get(icon);
  }

  function setCursor(name = override) {
    override = name;
    const { tool } = state();
    const icon = TOOLS.find(([label]) => label.toLowerCase() === tool)?.[1];
    const own = !window.carts.view.endoscope || tool === "select" ? "" : tool === "drag link" ? "grab" : icon ? cursorOf(icon) : "";
    for (const canvas of [window.__viserMutable?.canvas, document.querySelector(".carts-paint")]) {
      if (canvas) canvas.style.cursor = override || own;
    }
  }

  document.addEventListener("carts-brush", draw);
  Object.assign(window.carts, { setCursor });
  setInterval(() => {
    build();
    if (palette) document.body.classList.toggle("carts-scene", !window.carts.view.endoscope);
  }, 200);
})();
