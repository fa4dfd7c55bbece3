// State and controls of one browser tab: theme, address and link, and the review buttons of a small screen. Needs page.js
// and keys.js.
(() => {
  "use strict";

  const make = window.cartsElement;
  const remembered = (key) => { try { return JSON.parse(sessionStorage.getItem(key)); } catch { return null; } };
  const wanted = () => localStorage.getItem("carts-theme") ?? "dark"; // images are best judged on a dark background

  // ---- Theme ------------------------------------------------------------------------------------------------------

  // Documents over the page are coloured by this class, everything else by viser's theme.
  const dress = () => document.documentElement.classList.toggle("carts-light", wanted() === "light");
  dress();

  function toggleTheme() {
    const root = document.documentElement;
    const documented = root.classList.contains("carts-documented");
    if (!documented && !window.carts.connected()) return; // the server changes the theme of viser's widgets
    const light = documented ? wanted() === "light" : root.dataset.mantineColorScheme === "light";
    localStorage.setItem("carts-theme", light ? "dark" : "light");
    dress();
    if (!documented) window.carts.report("Theme", { light: wanted() === "light" });
  }

  // ---- Identity and address of the tab -------------------------------------------------------------------------------

  const tabs = () => [...document.querySelectorAll("[role=tab][data-dock-tab]")];

  // Duplicating a tab copies its session storage, so the tab's key is stored there only between unloading and loading.
  const key = sessionStorage.getItem("carts-key") ?? Math.random().toString(36).slice(2) + Date.now().toString(36);
  sessionStorage.removeItem("carts-key");
  window.addEventListener("pagehide", () => sessionStorage.setItem("carts-key", key));
  window.addEventListener("pageshow", () => sessionStorage.removeItem("carts-key"));

  /** Frame, camera and domain in the address, if given; `problem` if the address belongs to another project. */
  function linked() {
    const said = new URL(location.href).searchParams;
    const project = window.cartsConfiguration.project;
    if (said.has("project") && said.get("project") !== project) {
      return { problem: `This link is for ${said.get("project")}, but ${project || "no recording"} is open.` };
    }
    const frame = Number.parseInt(said.get("frame"), 10);
    return {
      frame: Number.isFinite(frame) ? frame - 1 : null, camera: said.get("camera"), domain: said.get("domain"),
    };
  }

  /** Address of the frame, camera and domain that this tab shows. */
  function link(detail) {
    const address = new URL(location.href);
    const place = {
      project: window.cartsConfiguration.project, frame: detail.frame + 1,
      camera: detail.names[detail.active], domain: detail.domain,
    };
    for (const [name, value] of Object.entries(place)) address.searchParams.set(name, value);
    return address.href;
  }

  let welcome = false; // whether the server has assigned a tab to this connection
  let asked = 0;
  function sayHello() {
    if (welcome || !window.cartsConfiguration.project || !window.carts?.connected?.()) return;
    asked += 1;
    if (asked > 20 && asked % 10) return;
    const { problem, ...place } = linked();
    const name = localStorage.getItem("carts-name") ?? "";
    const settings = JSON.parse(localStorage.getItem("carts-settings") ?? "{}");
    window.carts.report("Hello", { tab: key, name, light: wanted() === "light", settings, scene: !window.carts.view.endoscope, ...place });
    if (problem && asked === 1) tell(problem);
  }
  setInterval(sayHello, 150);

  /** Show a short note over the image. */
  function tell(text) {
    const note = document.createElement("div");
    note.className = "carts-note";
    note.setAttribute("role", "status");
    note.textContent = text;
    document.body.append(note);
    setTimeout(() => note.remove(), 8000);
  }

  // ---- The newest error, over the image -----------------------------------------------------------------------------------

  let problem = null;

  /** Show an error until it is dismissed; null hides it. */
  function setError(text) {
    if (!problem?.isConnected) {
      const around = window.__viserMutable?.canvas?.parentElement ?? document.body;
      problem = make("div", { class: "carts-error carts-problem", role: "alert" }, make("span", {}), make("button", { type: "button" }, "Dismiss"));
      problem.lastChild.addEventListener("click", dismiss);
      for (const kind of ["pointerdown", "pointermove", "pointerup", "wheel", "dblclick"]) {
        problem.addEventListener(kind, (event) => event.stopPropagation());
      }
      around.append(problem);
    }
    problem.hidden = text === null;
    problem.firstChild.textContent = text ?? "";
  }

  function dismiss() {
    problem.hidden = true;
    window.carts.report("Pressed", { key: "dismiss" });
  }

  /** Dismiss the shown error; returns whether there was one. */
  function closeError() {
    if (!problem || problem.hidden) return false;
    dismiss();
    return true;
  }

  async function copyLink() {
    if (!latest) return;
    const address = link(latest);
    try {
      await navigator.clipboard.writeText(address);
      tell("The link was copied.");
    } catch {
      window.prompt("The link to this frame:", address); // no clipboard without https
    }
  }

  function chooseTabs(labels) {
    for (const label of labels ?? []) {
      const tab = tabs().find((one) => one.textContent === label && one.getAttribute("aria-selected") !== "true");
      tab?.dispatchEvent(new PointerEvent("pointerdown", { bubbles: true, button: 0 }));
      tab?.dispatchEvent(new PointerEvent("pointerup", { bubbles: true, button: 0 }));
      tab?.click();
    }
  }

  function onPage({ detail }) {
    const first = latest === null;
    if (detail.notice && detail.notice !== latest?.notice) tell(detail.notice);
    welcome = true;
    const before = remembered("carts-tab");
    if (first && before) setTimeout(() => chooseTabs(before.tabs), 400);
    localStorage.setItem("carts-name", detail.name);
    localStorage.setItem("carts-settings", JSON.stringify(detail.settings));
    remember(detail);
    const address = link(detail);
    if (address !== location.href) history.replaceState(null, "", address);
  }

  let latest = null;
  function remember(detail) {
    latest = detail ?? latest;
    if (!latest) return;
    const chosen = tabs().filter((tab) => tab.getAttribute("aria-selected") === "true").map((tab) => tab.textContent);
    const before = remembered("carts-tab");
    sessionStorage.setItem("carts-tab", JSON.stringify({ tabs: chosen.length ? chosen : before?.tabs ?? [] }));
  }

  document.addEventListener("carts-page", onPage);
  window.addEventListener("click", (event) => {
    if (event.target instanceof Element && event.target.closest("[data-dock-tab]")) setTimeout(remember, 50);
  });
  // viser rebuilds its panels after a reconnection.
  let away = false;
  setInterval(() => {
    const on = window.carts?.connected?.() ?? true;
    if (on && away) setTimeout(() => chooseTabs(remembered("carts-tab")?.tabs), 900);
    if (!on) welcome = false;
    away = !on;
  }, 300);

  // ---- Hints of buttons and labels; viser shows those of fields ------------------------------------------------------------

  let hints = {};
  let hintsSetAt = 0;

  function showHints() {
    for (const [id, hint] of Object.entries(hints)) {
      const control = document.getElementById(id);
      const named = control?.closest("button") ?? document.querySelector(`label[for="${id}"]`);
      if (named && named.title !== hint) named.title = hint;
    }
  }

  document.addEventListener("pointerover", () => {
    if (performance.now() - hintsSetAt < 300) return;
    hintsSetAt = performance.now();
    showHints();
  });

  // ---- Names and keys of viser's widgets ---------------------------------------------------------------------------------

  const HEADING = ".mantine-Paper-root[data-with-border] > .mantine-Paper-root:first-child";
  const set = (one, name, value) => { if (one && one.getAttribute(name) !== value) one.setAttribute(name, value); };

  /** Name the parts of sliders and the buttons of the header for screen readers, and let groups be opened by keys. */
  function nameWidgets() {
    for (const label of document.querySelectorAll("label[for]")) {
      // viser's labels do not refer to its fields of text.
      const control = document.getElementById(label.htmlFor) ?? label.closest(".mantine-Flex-root")?.querySelector("input");
      const name = label.textContent.trim();
      if (!control || !name) continue;
      set(control.querySelector("[role=slider]"), "aria-label", name);
      if (control.matches("input")) set(control, "aria-label", name);
      else set(control.nextElementSibling?.querySelector("input"), "aria-label", name);
    }
    for (const heading of document.querySelectorAll(HEADING)) {
      set(heading, "role", "button");
      set(heading, "tabindex", "0");
      set(heading, "aria-expanded", String(heading.nextElementSibling?.getAttribute("aria-hidden") !== "true"));
    }
    set(document.querySelector(".mantine-ActionIcon-root:has(+ .mantine-ActionIcon-root)"), "aria-label", "Find an action (Ctrl+K)");
    set(document.querySelector("[role=dialog]:has(.mantine-Spotlight-search)"), "aria-label", "Actions");
    // Closed panels of a small screen: viser names only the first of their tabs.
    for (const one of document.querySelectorAll("[aria-label^='Expand panel']")) set(one, "aria-label", one.textContent.trim());
  }
  setInterval(() => (window.requestIdleCallback ?? setTimeout)(nameWidgets), 1000);
  window.addEventListener("keydown", (event) => {
    if (!["Enter", " "].includes(event.key) || !(event.target instanceof Element) || !event.target.matches(HEADING)) return;
    event.target.click();
    event.preventDefault();
    event.stopPropagation();
    setTimeout(nameWidgets, 50);
  }, { capture: true });

  // A field beside a slider would clamp a typed number to the slider's ends when it is left; the server instead extends the
  // ends to the number, up to the limits of the joint.
  window.addEventListener("focusout", (event) => {
    const slider = event.target.closest?.(".mantine-Slider-root + *")?.previousElementSibling.querySelector("[role=slider]");
    const typed = Number.parseFloat(event.target.value);
    if (slider && (typed < slider.ariaValueMin || typed > slider.ariaValueMax)) event.stopPropagation();
  }, { capture: true });

  // ---- Show the compared pose while a key is held --------------------------------------------------------------------------

  let peeking = false;
  const peek = (on) => { if (on !== peeking) { peeking = on; window.carts.report("Peek", { on }); } };
  window.carts.onKey("peek", () => peek(true), () => peek(false));

  // ---- A small screen ---------------------------------------------------------------------------------------------------

  const small = matchMedia("(max-width: 36em)");
  let bar = null, tabsOpened = false;
  const ACTIONS = {
    previous: ["MoveFrame", { by: -1 }], next: ["MoveFrame", { by: 1 }], accept: ["AcceptAndNext"],
    work: ["SetReview", { state: "needs work" }], reject: ["SetReview", { state: "rejected" }],
  };

  function buildBar() {
    if (!small.matches || bar || !window.__viserMutable?.canvas) return;
    bar = document.createElement("div");
    bar.className = "carts-review-bar";
    bar.innerHTML = `<div class="carts-review-line"><span class="carts-dot unknown"></span><span></span></div>
      <button data-do="previous" aria-label="Previous frame">‹</button><button data-do="accept">Accept</button>
      <button data-do="work">Needs work</button><button data-do="reject">Reject</button>
      <button data-do="next" aria-label="Next frame">›</button><button data-do="controls" aria-label="All controls">⋯</button>`;
    bar.addEventListener("click", (event) => {
      const name = event.target.closest?.("button")?.dataset.do;
      if (name === "controls" && document.body.classList.toggle("carts-controls")) openTabs();
      if (name in ACTIONS) window.carts.report(...ACTIONS[name]);
    });
    document.body.append(bar);
  }

  /** Open the tabs of the panels, which start collapsed on a small screen, at the first use of the controls. */
  function openTabs() {
    if (tabsOpened) return;
    const collapsed = document.querySelector(".mantine-Tabs-root > [role=button][aria-expanded=false]");
    tabsOpened = collapsed !== null;
    collapsed?.click();
  }

  function drawBar() {
    if (!bar || !latest) return;
    const [dot, line] = bar.querySelectorAll(".carts-review-line span");
    dot.className = `carts-dot ${latest.fit ?? "unknown"}`;
    const text = `Frame ${latest.label} · ${latest.review}${latest.fit ? ` · ${latest.fit}` : ""}`;
    if (line.textContent !== text) line.textContent = text;
  }

  // Between two panels, a narrow window leaves no room for the image, so the left panel starts collapsed.
  let roomMade = !matchMedia("(max-width: 60em)").matches;
  function makeRoom() {
    const collapse = roomMade || small.matches ? null : document.querySelector("[data-dock-region-collapse=left]");
    if (!collapse) return;
    roomMade = true;
    if (collapse.ariaExpanded === "true") collapse.click();
  }

  setInterval(() => {
    document.body.classList.toggle("carts-small", small.matches);
    makeRoom();
    buildBar();
    drawBar();
  }, 300);

  Object.assign(window.carts, {
    copyLink, chooseTabs, closeError, key, setError,
    setHints(message) { hints = message; showHints(); },
    /** Reload if the server was restarted after this page was loaded, since the new server has other widgets. */
    reloadIfServerChanged(name) { if (name !== window.cartsConfiguration.server) location.reload(); },
    /** Reload the page without project, frame, camera and domain in its address. */
    reload() {
      const address = new URL(location.href);
      for (const name of ["project", "frame", "camera", "domain"]) address.searchParams.delete(name);
      history.replaceState(null, "", address);
      location.reload();
    },
    toggleTheme,
  });
})();
