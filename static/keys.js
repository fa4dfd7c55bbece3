// Keys of actions, which a user may change, and the sheet that lists them. Needs page.js.
(() => {
  "use strict";

  const make = window.cartsElement;
  const { groups = [], fixed = [], taken = {} } = window.cartsConfiguration.keys ?? {};
  const labels = new Map(); // name of an action -> label
  const defaults = new Map(); // name of an action -> its default key
  for (const [, rows] of groups) for (const [name, key, label] of rows) { labels.set(name, label); defaults.set(name, key); }
  const local = {}; // name of an action of a script -> { down, up }
  let changed = {}; // name of an action -> the key that the user has chosen

  const keyOf = (name) => changed[name] ?? defaults.get(name) ?? "";

  /** Name of the pressed key: `N`, `Shift+N`, `Ctrl+Z`, `ArrowLeft`, `(`; null for a modifier alone. */
  function nameOf(event) {
    if (["Shift", "Control", "Alt", "Meta", "AltGraph", "Dead", "Unidentified"].includes(event.key)) return null;
    const third = event.getModifierState?.("AltGraph"); // a third level of the keyboard, such as [ on many layouts
    const key = event.key === " " ? "Space" : event.key.length === 1 ? event.key.toUpperCase() : event.key;
    const shift = event.shiftKey && (key.length > 1 || key.toLowerCase() !== key.toUpperCase());
    const held = [[(event.ctrlKey || event.metaKey) && !third, "Ctrl"], [event.altKey && !third, "Alt"], [shift, "Shift"]];
    return [...held.filter(([on]) => on).map(([, name]) => name), key].join("+");
  }

  const FIELDS = "input:not([readonly]), textarea, select, [contenteditable], dialog[open], [role=dialog]";
  const WIDGETS = "button, a, summary, input, [role], [tabindex]"; // which have functions for some keys themselves
  const OF_WIDGETS = /^(Space|Enter|Home|End|Arrow.*)$/;

  /** The action of a key, if the page handles it now. */
  function actionOf(event) {
    const key = nameOf(event);
    const name = [...defaults.keys()].find((one) => keyOf(one) === key);
    const target = event.target instanceof Element ? event.target : document.body;
    if (!name || target.closest(FIELDS) || document.querySelector("dialog[open], body.carts-touring")) return null;
    if (OF_WIDGETS.test(key) && target.checkVisibility() && target.closest(WIDGETS)) return null;
    if (key.startsWith("Arrow") && !window.carts.view.endoscope) return null; // moves the camera of the 3D view
    if (name === "NextObject" && window.carts.brush().tool !== "prompt") return null;
    return name;
  }

  // Actions that a held key repeats; all others need a look at their result, such as accepting a frame.
  const REPEATED = /^(MoveFrame|ShowWorst|ShowUnreviewed|Nudge|ScaleBrush|Undo|Redo)\b/;
  let held = null; // the action whose key is down, and the key

  function press(event) {
    if (asked) {
      choose(event);
      return;
    }
    const name = actionOf(event);
    if (!name) return;
    event.preventDefault();
    event.stopPropagation();
    if (event.repeat && !REPEATED.test(name)) return;
    if (name === "SetTool Select" && closeSomething()) return;
    if (local[name]) {
      held = [name, event.code];
      local[name].down();
    } else window.carts.report("Pressed", { key: name });
  }

  function release(event) {
    if (!held || event.code !== held[1]) return;
    const [name] = held;
    held = null;
    local[name].up?.();
  }

  /** Close what only this page shows: an error, or the reason of a verdict. */
  function closeSomething() {
    const reason = document.querySelector(".carts-verdict details[open]");
    reason?.removeAttribute("open");
    return Boolean(reason) || window.carts.closeError();
  }

  window.addEventListener("keydown", press, { capture: true });
  window.addEventListener("keyup", release, { capture: true });
  window.addEventListener("blur", () => { if (held) local[held[0]].up?.(); held = null; });

  // ---- Keys in hints of buttons ----------------------------------------------------------------------------------------

  /** Add the current key to the hint of each button that names its action in `data-key`. */
  function nameKeys(parent) {
    for (const one of parent.querySelectorAll("[data-key]")) {
      one.dataset.hint ??= one.title;
      const key = keyOf(one.dataset.key);
      one.title = key ? `${one.dataset.hint} (${key})` : one.dataset.hint;
      if (key) one.setAttribute("aria-keyshortcuts", key.replace("Ctrl", "Control"));
    }
  }

  document.addEventListener("carts-page", ({ detail }) => {
    if (JSON.stringify(detail.settings.keys) === JSON.stringify(changed)) return;
    changed = detail.settings.keys;
    nameKeys(document);
    if (sheet) fill();
  });

  // ---- The sheet -------------------------------------------------------------------------------------------------------

  let sheet = null;
  let asked = null; // the action whose key is being chosen

  const row = (name, key, label) => make("tr", {},
    make("td", {}, name ? make("button", { type: "button", "data-name": name, "aria-label": `${label}: ${key}. Change the key` }, make("kbd", {}, key)) : make("kbd", {}, key)),
    make("td", {}, label));
  const section = (title, rows) => make("section", {}, make("h3", {}, title), make("table", {}, ...rows));

  function fill() {
    const shown = groups.map(([title, rows]) => section(title, rows.map(([name, , label]) => row(name, keyOf(name), label))));
    shown.push(section("Fixed", fixed.map(([key, label]) => row(null, key, label))));
    sheet.querySelector(".carts-columns").replaceChildren(...shown);
    sheet.querySelector("[data-do=reset]").disabled = !Object.keys(changed).length;
  }

  function say(text, problem = false) {
    const line = sheet.querySelector("output");
    line.textContent = text;
    line.classList.toggle("carts-unsure", problem);
  }

  function ask(name) {
    stopAsking();
    asked = name;
    sheet.querySelector(`[data-name="${name}"] kbd`).textContent = "…";
    say(`Press the new key of “${labels.get(name)}”; Escape keeps the old one.`);
  }

  function stopAsking() {
    if (!asked) return;
    sheet.querySelector(`[data-name="${asked}"] kbd`).textContent = keyOf(asked);
    asked = null;
    say("");
  }

  /** Give the pressed key to the chosen action, unless it has another function. */
  function choose(event) {
    const key = nameOf(event);
    if (!key) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    const name = asked;
    stopAsking();
    sheet.querySelector(`[data-name="${name}"]`).focus();
    if (key === "Escape" || key === keyOf(name)) return;
    const holder = [...defaults.keys()].find((one) => one !== name && keyOf(one) === key);
    const reason = holder ? `is the key of “${labels.get(holder)}”` : taken[key];
    if (reason) {
      say(`${key} ${reason}. Choose another key.`, true);
      return;
    }
    window.carts.report("SetKeys", { keys: { ...changed, [name]: key } });
    say(`${key}: ${labels.get(name)}`);
  }

  function build() {
    sheet = make("dialog", { class: "carts-sheet carts-keys", "aria-label": "Keys" },
      make("header", {}, make("b", {}, "Keys"), make("output", {}), make("button", { "data-do": "reset", title: "Reset all keys" }, "Reset"),
        make("button", { "data-do": "guide" }, "Guide"), make("button", { "data-do": "tour" }, "Take the tour"), make("button", { "aria-label": "Close" }, "×")),
      make("div", { class: "carts-columns" }));
    const actions = {
      reset: () => { window.carts.report("SetKeys", { keys: {} }); say("All keys were reset."); },
      guide: () => { showSheet(false); window.carts.report("Pressed", { key: "guide" }); },
      tour: () => { showSheet(false); window.carts.startTour(); },
    };
    sheet.addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (event.target === sheet || button?.getAttribute("aria-label") === "Close") showSheet(false);
      else if (button?.dataset.name) ask(button.dataset.name);
      else if (button) { stopAsking(); actions[button.dataset.do](); }
    });
    sheet.addEventListener("keydown", (event) => {
      if (![keyOf("sheet"), "Escape"].includes(nameOf(event))) return;
      event.preventDefault();
      showSheet(false);
    }, { capture: true });
    sheet.addEventListener("cancel", (event) => { if (asked) event.preventDefault(); });
    sheet.addEventListener("close", stopAsking);
    document.body.append(sheet);
    fill();
  }

  function showSheet(open) {
    if (!sheet) build();
    if (open && !sheet.open) { say("Click a key to change it."); sheet.showModal(); }
    if (!open && sheet.open) sheet.close();
  }

  Object.assign(window.carts, {
    keyOf, nameKeys,
    /** Handle the key of an action in this page. */
    onKey(name, down, up) { local[name] = { down, up }; },
    showSheet: () => showSheet(true),
  });
  window.carts.onKey("sheet", () => showSheet(true));
  window.carts.onKey("view", () => window.carts.toggleView());
})();
