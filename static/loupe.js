// The loupe: magnified pixels around the pointer with coordinates and colour. It reads the page's textures and sends no
// requests to the server. Needs page.js and keys.js.
(() => {
  "use strict";

  const SIDE = 15; // pixels across, an odd number: the one in the middle is under the pointer
  const SCALE = 10; // size of a magnified pixel [CSS px]
  const AWAY = 26; // distance from the pointer [CSS px]
  const HELD = 350; // a key pressed for longer is held, and its release hides the loupe [ms]
  const sources = new Map(); // name of a node -> { uuid, context } of its texture
  let box = null;
  let pinned = false; // selected in the palette
  let pressedAt = null;
  let pointer = null;

  const isOn = () => pinned || pressedAt !== null;

  function textureOf(name) {
    let texture = null;
    window.__viserMutable?.nodeRefFromName[name]?.traverse((child) => { texture ??= child.material?.map ?? null; });
    return texture?.image?.width ? texture : null;
  }

  /** A drawing context that contains the pixels of a node's picture; null if there is none. */
  function pixelsOf(name) {
    const texture = textureOf(name);
    if (!texture) return null;
    const known = sources.get(name);
    if (known?.uuid === texture.uuid) return known.context;
    const { width, height } = texture.image;
    const context = Object.assign(document.createElement("canvas"), { width, height })
      .getContext("2d", { willReadFrequently: true });
    context.drawImage(texture.image, 0, 0);
    sources.set(name, { uuid: texture.uuid, context });
    return context;
  }

  function build() {
    const [make, side] = [window.cartsElement, SIDE * SCALE];
    box = make("div", { class: "carts-loupe" }, make("canvas", { width: side, height: side }), make("div"), make("div"));
    document.body.append(box);
  }

  function magnify(context, sources_, column, row) {
    context.imageSmoothingEnabled = false;
    context.fillStyle = "#202426";
    context.fillRect(0, 0, SIDE * SCALE, SIDE * SCALE);
    const [left, top] = [column - (SIDE - 1) / 2, row - (SIDE - 1) / 2];
    for (const source of sources_) {
      if (source) context.drawImage(source.canvas, left, top, SIDE, SIDE, 0, 0, SIDE * SCALE, SIDE * SCALE);
    }
    const middle = ((SIDE - 1) / 2) * SCALE;
    for (const [color, wider] of [["rgba(0, 0, 0, 0.8)", 1], ["#fff", 0]]) {
      context.strokeStyle = color;
      context.strokeRect(middle - wider - 0.5, middle - wider - 0.5, SCALE + 2 * wider + 1, SCALE + 2 * wider + 1);
    }
  }

  /** Show the pixels under the pointer, or nothing outside of the images. */
  function draw() {
    const at = isOn() && pointer && window.carts.view.endoscope ? window.carts.imageAt(pointer) : null;
    if (!box && !at) return;
    if (!box) build();
    const shown = window.carts.shown();
    const root = at && at[0] !== shown.active ? `/others/${at[0]}` : "";
    const picture = at && pixelsOf(`${root}/frame`);
    box.hidden = !picture;
    if (!picture) return;
    const { width, height } = picture.canvas;
    const [u, v] = [at[1] * width, at[2] * height];
    const [column, row] = [Math.floor(u), Math.floor(v)];
    const [red, green, blue] = picture.getImageData(column, row, 1, 1).data;
    magnify(box.firstChild.getContext("2d"), [picture, pixelsOf(`${root}/overlay`)], column, row);
    const [place, color] = box.querySelectorAll("div");
    place.textContent = `u ${u.toFixed(1)}  v ${v.toFixed(1)}`;
    color.textContent = `RGB ${red} ${green} ${blue}`;
    color.style.setProperty("--color", `rgb(${red}, ${green}, ${blue})`);
    Object.assign(box.dataset, { u, v, camera: shown.names[at[0]], rgb: `${red} ${green} ${blue}` });
    const [wide, high] = [box.offsetWidth, box.offsetHeight];
    const x = pointer.clientX + AWAY + wide > innerWidth ? pointer.clientX - AWAY - wide : pointer.clientX + AWAY;
    const y = pointer.clientY + AWAY + high > innerHeight ? pointer.clientY - AWAY - high : pointer.clientY + AWAY;
    box.style.transform = `translate(${Math.round(x)}px, ${Math.round(y)}px)`;
  }

  window.addEventListener("pointermove", (event) => {
    // A pointer over a panel or a bar is not in an image.
    const over = event.target instanceof Element && event.target.matches("canvas");
    pointer = over ? { clientX: event.clientX, clientY: event.clientY } : null;
  }, { capture: true });
  window.carts.onKey("loupe",
    () => { pressedAt = performance.now(); },
    () => {
      const on = performance.now() - pressedAt > HELD ? false : !pinned;
      pressedAt = null;
      if (on !== pinned) window.carts.report("ShowLoupe", { on });
    });
  Object.assign(window.carts, { setLoupe(on) { pinned = on; draw(); } });
  (function everyFrame() {
    requestAnimationFrame(everyFrame);
    if (window.carts) draw();
  })();
})();
