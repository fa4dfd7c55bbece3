// A guided tour of the page: each step frames and explains an element. It is offered until it is started or declined, can
// be left at any time, and can be started again from the key sheet. Needs page.js and shell.js.
(() => {
  "use strict";

  const SEEN = "carts-tour";
  const STEPS = [
    ["canvas", "The picture", "The recorded image with the arm rendered at its joint positions. Wheel: zoom; drag: pan; " +
      "a click chooses a camera."],
    [".carts-verdict", "The verdict", "The reliability of the fit: good, doubtful or failed, with a reason and a remedy. " +
      "The verdict refers to the mask, and is derived from the images, not from the solver. The tab Values marks joints that the " +
      "images hardly determine."],
    ["Run", "Run", "The optimizer moves the joints until the rendered arm and the images agree. The curves below show its progress."],
    [".carts-tools", "Tools", "Drag links, place keypoints, paint masks and regions to ignore. Escape returns to Select."],
    ["Joints", "Joints", "Move joints by hand, or drag links and place keypoints with the tools beside the image."],
    [".carts-strip", "The timeline", "All frames: a high bar is a bad fit in the colour of its verdict; ✓, ! and ✕ are reviews. Drag to scrub, wheel to zoom, " +
      "Shift+drag for a range."],
    ["Review", "Review", "Accept + next shows the next unreviewed frame. The tab also has keyframes, Solve between, " +
      "search and history."],
    ["Jobs", "Jobs", "Long tasks run here while you continue: many frames, calibrations, exports."],
    ["Export", "Export", "Masks, keypoints and kinematics for other tools. Every edit is saved at once and can be undone."],
    [".carts-review-bar", "Review", "The verdict, and your review of the frame; accepting shows the next unreviewed frame."],
    [".carts-review-bar [data-do=controls]", "All controls", "This button shows all other controls, in tabs: fit, review, values, jobs, export, help."],
    [".carts-bar [data-do=help]", "More", "This button lists all keys, which can be changed there. Every control has a hint, shown when the pointer " +
      "rests on it."],
  ];
  let steps = []; // steps whose element is visible, fewer on a small screen
  let place = -1;
  let frame = null;
  let card = null;
  const scrolled = new Map(); // element scrolled by the tour -> its previous position

  /** Element of a step, by selector or by the text of a button, tab or folder; null if it is not visible. */
  function target(name) {
    const visible = (one) => one && one.getClientRects().length > 0;
    const direct = /^[A-Z]/.test(name) ? null : document.querySelector(name);
    if (direct) return visible(direct) ? direct : null;
    const named = [...document.querySelectorAll("button, [role=tab], .mantine-Paper-root *")];
    const found = named.find((one) => one.textContent.trim() === name && visible(one)) ?? null;
    // The name of a folder means the whole folder.
    return found?.closest("button, [role=tab]") ? found : found?.parentElement.closest(".mantine-Paper-root") ?? null;
  }

  /** Scroll panels to the element of a step. */
  function reveal(about) {
    for (let around = about.parentElement; around; around = around.parentElement) {
      if (!scrolled.has(around) && around.scrollHeight > around.clientHeight) scrolled.set(around, around.scrollTop);
    }
    about.scrollIntoView({ block: "center" });
  }

  function build() {
    frame = document.createElement("div");
    frame.className = "carts-tour-frame";
    card = document.createElement("div");
    card.className = "carts-tour";
    card.setAttribute("role", "dialog");
    card.setAttribute("aria-label", "Tour");
    document.body.append(frame, card);
  }

  /** Frame the element of this step, and put the card beside the element, inside the window. */
  function draw() {
    if (place < 0) return;
    const [name, title, text] = steps[place];
    const about = target(name);
    if (about) reveal(about);
    const box = about?.getBoundingClientRect();
    frame.style.display = box ? "" : "none";
    if (box) {
      const [left, top] = [Math.max(box.left - 4, 2), Math.max(box.top - 4, 2)];
      Object.assign(frame.style, {
        left: `${left}px`, top: `${top}px`, width: `${Math.min(box.right + 4, innerWidth - 2) - left}px`,
        height: `${Math.min(box.bottom + 4, innerHeight - 2) - top}px`,
      });
    }
    const make = window.cartsElement;
    card.replaceChildren(make("b", {}, title), make("p", {}, text), make("footer", {},
      make("span", {}, `${place + 1} of ${steps.length}`), make("button", { "data-do": "leave" }, "Leave"),
      make("button", { "data-do": "back", ...(place ? {} : { disabled: "" }) }, "Back"),
      make("button", { "data-do": "next", class: "main" }, place + 1 < steps.length ? "Next" : "Done")));
    const actions = { leave: end, back: () => go(place - 1), next: () => go(place + 1) };
    for (const button of card.querySelectorAll("button")) button.onclick = actions[button.dataset.do];
    const around = box ?? { left: innerWidth / 2, right: innerWidth / 2, top: innerHeight / 2, bottom: innerHeight / 2 };
    const beside = around.right + card.offsetWidth + 16 < innerWidth ? around.right + 12 : around.left - card.offsetWidth - 12;
    const inside = (value, size, room) => Math.min(Math.max(value, 8), room - size - 8);
    const large = around.right - around.left > innerWidth / 2 || (beside < 8 && around.right > innerWidth - card.offsetWidth);
    const x = large ? (around.left + around.right - card.offsetWidth) / 2 : beside;
    const y = large && around.top > innerHeight / 2 ? around.top - card.offsetHeight - 12 : around.top + (large ? 80 : 0);
    card.style.left = `${inside(x, card.offsetWidth, innerWidth)}px`;
    card.style.top = `${inside(y, card.offsetHeight, innerHeight)}px`;
    card.querySelector(".main").focus();
  }

  function go(step) {
    if (step >= steps.length) { end(); return; }
    place = Math.max(step, 0);
    draw();
  }

  function start() {
    localStorage.setItem(SEEN, "begun");
    document.querySelector(".carts-offer")?.remove();
    if (!card) build();
    steps = STEPS.filter(([name]) => target(name));
    document.body.classList.add("carts-touring");
    go(0);
  }

  function end() {
    place = -1;
    card?.remove();
    frame?.remove();
    card = frame = null;
    for (const [around, top] of scrolled) around.scrollTop = top;
    scrolled.clear();
    document.body.classList.remove("carts-touring");
  }

  /** Offer the tour at every visit until it is started or declined, if a recording is open. */
  function offer() {
    const answered = !["offered", null].includes(localStorage.getItem(SEEN)); // older versions stored "offered"
    if (answered || !document.querySelector(".carts-strip") || document.querySelector(".carts-offer")) return;
    const note = document.createElement("div");
    note.className = "carts-note carts-offer";
    note.setAttribute("role", "status");
    note.innerHTML = `New here? <button data-do="start">Take the tour</button><button data-do="close" aria-label="No tour">×</button>`;
    note.querySelector("[data-do=start]").onclick = start;
    note.querySelector("[data-do=close]").onclick = () => { localStorage.setItem(SEEN, "declined"); note.remove(); };
    document.body.append(note);
  }

  document.addEventListener("carts-page", () => setTimeout(offer, 1500), { once: true });
  window.addEventListener("resize", draw);
  window.addEventListener("keydown", (event) => {
    if (place < 0) return;
    const step = { Escape: end, ArrowRight: () => go(place + 1), ArrowLeft: () => go(place - 1) }[event.key];
    if (!step) return;
    step();
    event.preventDefault();
    event.stopImmediatePropagation();
  }, { capture: true });
  Object.assign(window.carts, { startTour: start, offerTour: offer });
})();
