// A document over the page: HTML from the server, and the choices made in it. Also reports clicks in the image.
(() => {
  "use strict";

  let box = null;
  let held = false;
  let waiting = null;
  let replacing = false; // Chromium reports a change of a field that is removed, whose text is half typed
  let restored = null; // field whose text was set by `showDocument`, for which leaving it fires no `change`
  let reported = 0; // time of the last report of a slider that is dragged
  const LIVE = 120; // minimum time between such reports [ms]

  function element() {
    if (!box?.isConnected) {
      box = document.createElement("main");
      document.body.append(box, themeButton());
      box.addEventListener("click", (event) => {
        const chosen = event.target.closest("button[data-do]");
        if (chosen && !chosen.disabled) choose(chosen);
      });
      box.addEventListener("change", (event) => {
        const field = event.target.closest("select[data-do], input[data-do]");
        if (!field || replacing) return;
        restored = null;
        say(field.dataset.do, field.type === "checkbox" ? (field.checked ? "1" : "0") : field.value);
      });
      box.addEventListener("focusout", ({ target: field }) => {
        if (field !== restored) return;
        restored = null;
        if (field.value !== field.defaultValue) say(field.dataset.do, field.value);
      });
      box.addEventListener("keydown", (event) => {
        const field = event.target.closest("[data-enter]");
        if (event.key === "Enter" && field) box.querySelector(`button[data-do="${field.dataset.enter}"]`)?.click();
      });
      window.addEventListener("keydown", (event) => {
        if (event.key === "Escape" && !box.hidden) box.querySelector("button[data-escape]:enabled")?.click();
      }, { capture: true });
      // A slider reports while it is dragged; the last value follows by `change`.
      box.addEventListener("input", (event) => {
        const field = event.target.closest("input[data-live]");
        if (!field || performance.now() - reported < LIVE) return;
        reported = performance.now();
        say(field.dataset.do, field.value);
      });
      // Keys typed in the document are not shortcuts of the page below.
      for (const kind of ["keydown", "keyup", "pointerdown", "wheel", "dblclick"]) {
        box.addEventListener(kind, (event) => event.stopPropagation());
      }
      // New content is shown after the release of the pointer, since a button that is replaced before gets no click.
      box.addEventListener("pointerdown", () => holdDocument(true));
      for (const kind of ["pointerup", "pointercancel"]) {
        window.addEventListener(kind, () => setTimeout(() => holdDocument(false)), { capture: true });
      }
    }
    return box;
  }

  /** Report a button: its own value, or that of a field. */
  function choose(button) {
    const { do: name, value, from } = button.dataset;
    say(name, from ? document.getElementById(from).value : value ?? "");
  }

  function themeButton() {
    const button = document.createElement("button");
    Object.assign(button, { className: "carts-theme", title: "Light or dark", textContent: "◐", type: "button" });
    button.setAttribute("aria-label", button.title);
    button.addEventListener("click", () => window.carts.toggleTheme());
    return button;
  }

  // Allowed elements of documents; others are removed.
  const TAGS = new Set(("article b br button caption circle code details div figcaption figure footer g h1 h2 h3 header hr i img input label li line " +
    "ol option output p path polygon polyline progress section select small span summary svg table tbody td text th thead tr ul").split(" "));
  const ATTRIBUTES = /^(alt|checked|class|colspan|cx|cy|d|disabled|fill|for|height|id|max|min|open|placeholder|points|preserveAspectRatio|r|role|scope|selected|spellcheck|src|step|stroke|stroke-[a-z]+|style|tabindex|title|type|value|viewBox|width|x|x1|x2|y|y1|y2|data-[a-z]+|aria-[a-z]+)$/;
  const PICTURES = /^(media\/[0-9a-f]+\.jpg|static\/[a-z]+\.(svg|webp))$/;

  /** The nodes of a document's HTML. */
  function built(content) {
    const { body } = new DOMParser().parseFromString(content, "text/html"); // runs and loads nothing
    for (const one of [...body.querySelectorAll("*")]) {
      if (!TAGS.has(one.localName)) one.remove();
      for (const { name, value } of [...one.attributes]) {
        if (!ATTRIBUTES.test(name) || (name === "src" && !PICTURES.test(value))) one.removeAttribute(name);
      }
    }
    return body.childNodes;
  }

  const say = (name, value) => window.carts.report("Chosen", { name, value });

  /** Let new content wait, or show it. */
  function holdDocument(on) {
    held = on;
    if (!on && waiting) showDocument(...waiting);
  }

  /** Replace the content; focus, text being typed and scroll positions are kept, and a new `data-reveal` is scrolled to. */
  function showDocument(content, place) {
    const target = element();
    waiting = held ? [content, place] : null;
    if (held) return;
    const focused = target.contains(document.activeElement) ? document.activeElement : null;
    const keyOf = ({ do: name, point, value }) => name ? `${name} ${value ?? ""}` : point && `point ${point}`;
    const key = focused?.dataset && keyOf(focused.dataset);
    const typed = focused?.type === "text" && focused.value !== focused.defaultValue
      ? [focused.value, focused.selectionStart, focused.selectionEnd] : null;
    const opened = [...target.querySelectorAll("details[data-keep][open]")].map((part) => part.dataset.keep);
    const scrolled = [...target.querySelectorAll("[data-scroll]")].map((part) => [part.dataset.scroll, part.scrollTop]);
    target.className = content ? `carts-document carts-document-${place}` : "";
    target.hidden = !content;
    const top = target.scrollTop;
    const revealed = Boolean(target.querySelector("[data-reveal]"));
    const nodes = built(content);
    restored = null;
    replacing = true;
    target.replaceChildren(...nodes);
    replacing = false;
    window.carts.placeMarks?.();
    target.scrollTop = top;
    for (const part of target.querySelectorAll("details[data-keep]")) part.open ||= opened.includes(part.dataset.keep);
    for (const [name, position] of scrolled) {
      const part = [...target.querySelectorAll("[data-scroll]")].find((other) => other.dataset.scroll === name);
      if (part) part.scrollTop = position;
    }
    if (key) {
      const again = [...target.querySelectorAll("[data-do], [data-point]")].find((other) => keyOf(other.dataset) === key);
      again?.focus();
      if (typed && again?.type === "text") {
        again.value = typed[0];
        again.setSelectionRange(typed[1], typed[2]);
        restored = again;
      }
    }
    if (!revealed) target.querySelector("[data-reveal]")?.scrollIntoView({ block: "nearest" });
    document.documentElement.classList.toggle("carts-documented", Boolean(content));
    const covered = Boolean(content) && place === "page";
    document.documentElement.classList.toggle("carts-covered", covered);
    const below = document.getElementById("root");
    if (below) below.inert = covered; // the keyboard does not reach the covered view
  }

  // A click in the image is a press without motion; it reports the name (`data-click`) that was shown at the press.
  let pressed = null;
  const canvas = () => window.__viserMutable?.canvas;

  /** Rectangle of the image in the window, and that of the canvas [CSS px]; null if no image is shown. */
  function imageBox() {
    const image = window.carts.imageOnScreen?.();
    const frame = canvas()?.getBoundingClientRect();
    if (!image || !frame) return null;
    return { left: frame.left + image.left, top: frame.top + image.top, width: image.width, height: image.height, frame };
  }

  window.addEventListener("pointerdown", (event) => {
    const name = box?.querySelector("[data-click]")?.dataset.click;
    pressed = name && event.button === 0 && !event.shiftKey && event.target === canvas() ? [event.clientX, event.clientY, name] : null;
  }, { capture: true });
  window.addEventListener("click", (event) => {
    const start = pressed;
    pressed = null;
    if (!start || event.detail > 1) return; // the second click of a double click
    const image = Math.hypot(event.clientX - start[0], event.clientY - start[1]) > 3 ? null : imageBox();
    if (!image) return;
    const u = (event.clientX - image.left) / image.width;
    const v = (event.clientY - image.top) / image.height;
    if (u >= 0 && u <= 1 && v >= 0 && v <= 1) say(start[2], `${u} ${v}`);
  }, { capture: true });

  // A document at the side ends where the canvas begins; viser changes the width of its panel.
  setInterval(() => {
    const left = canvas()?.getBoundingClientRect().left;
    if (left > 200) document.documentElement.style.setProperty("--carts-side", `${left}px`);
  }, 200);

  /** Set the progress bar of the document to a share of 1; replacing the document would close opened lists. */
  function setProgress(share) {
    const bar = box?.querySelector("progress");
    if (bar) bar.value = share;
  }

  Object.assign(window.carts, { showDocument, holdDocument, setProgress, imageBox });
})();
