// All frames as a table or a gallery in a sheet: sorted, filtered, chosen, and reviewed together. Needs page.js and timeline.js.
(() => {
  "use strict";

  const make = window.cartsElement;
  const LISTED = 500; // maximum number of frames that are drawn
  const VERDICTS = ["not checked", "good", "doubtful", "failed"];
  const COLUMNS = [
    ["name", "Frame"], ["picture", ""], ["verdict", "Verdict"], ["failure", "Failure"], ["loss", "Loss"], ["dice", "Dice"],
    ["review", "Review"], ["who", "Who"], ["note", "Note"],
  ];
  const REVIEWS = { Accept: "accepted", "Needs work": "needs work", Reject: "rejected", Clear: "untouched" };

  let sheet = null;
  let rows = []; // one object per frame, see `receive`
  let order = { by: "worst", down: false };
  let gallery = localStorage.getItem("carts-frames") === "gallery";
  let chosen = new Set();
  let last = null; // frame chosen last, from which Shift extends

  function build() {
    sheet = make("dialog", { class: "carts-sheet carts-frames", "aria-label": "Frames" });
    const button = (name, label, about = label) => make("button", { type: "button", "data-do": name, title: about }, label);
    const choice = (name, options) => make("select", { "data-by": name, "aria-label": name }, ...options.map((one) => new Option(one, one)));
    sheet.append(
      make("header", {}, make("b", {}, "Frames"), make("output", {}), make("button", { "aria-label": "Close" }, "×")),
      make("div", { class: "carts-frames-tools" },
        make("input", { type: "search", placeholder: "Filter by name, note, person", "aria-label": "Filter" }),
        choice("Verdict", ["Any verdict", ...VERDICTS]), choice("Review", ["Any review", ...window.carts.reviewNames]),
        make("span", {}, button("view", "Gallery"), button("all", "Choose all"), ...Object.keys(REVIEWS).map((name) => button(name, name)))),
      make("div", { class: "carts-frames-list", tabindex: "0", role: "group", "aria-label": "List of frames" }));
    sheet.addEventListener("click", onClick);
    sheet.addEventListener("input", draw);
    sheet.addEventListener("close", () => { window.carts.report("Pressed", { key: "frames-closed" }); });
    sheet.addEventListener("keydown", (event) => {
      event.stopPropagation();
      if (event.key === "Enter" && last !== null && event.target.matches(".carts-frames-list")) open(last);
    });
    document.body.append(sheet);
  }

  const field = (name) => sheet.querySelector(`[data-by=${name}]`).value;

  function found() {
    const text = sheet.querySelector("input").value.toLowerCase();
    const [verdict, review] = [field("Verdict"), field("Review")];
    const kept = rows.filter((row) => (verdict === "Any verdict" || row.verdict === verdict)
      && (review === "Any review" || row.review === review)
      && (!text || `${row.name} ${row.note} ${row.who}`.toLowerCase().includes(text)));
    const value = (row) => row[order.by];
    const none = (one) => one === null || one === "";
    return kept.sort((a, b) => {
      const [one, other] = [value(a), value(b)];
      if (none(one) || none(other)) return none(one) - none(other) || a.index - b.index;
      const by = typeof one === "number" ? one - other : String(one).localeCompare(String(other));
      return (order.down ? -by : by) || a.index - b.index;
    });
  }

  const number = (value, digits) => (value === null ? "" : value.toFixed(digits));

  function cells(row) {
    return {
      name: row.name, verdict: chip(row.verdict), failure: row.failure === null ? "" : `${number(100 * row.failure, 0)} %`,
      loss: row.loss === null ? "" : Number(row.loss.toPrecision(3)).toString(), dice: number(row.dice, 3), review: row.review,
      who: row.who, note: row.note, picture: make("img", { src: window.carts.thumbnailOf(row.index, row.pose), alt: "", loading: "lazy" }),
    };
  }

  function chip(verdict) {
    const style = { good: "carts-chip", doubtful: "carts-chip doubtful", failed: "carts-chip failed" }[verdict];
    return style ? make("span", { class: style }, verdict) : verdict;
  }

  function draw() {
    const shown = found();
    const list = sheet.querySelector(".carts-frames-list");
    const drawn = shown.slice(0, LISTED);
    const here = window.carts.timeline().here;
    const marks = (row) => ({ "data-row": row.index, "aria-selected": String(chosen.has(row.index)), ...(row.index === here ? { "aria-current": "true" } : {}) });
    if (gallery) {
      list.replaceChildren(make("div", { class: "carts-gallery", role: "listbox", "aria-label": "Frames", "aria-multiselectable": "true" }, ...drawn.map((row) => {
        const { picture, verdict } = cells(row);
        return make("div", { role: "option", ...marks(row) }, picture, make("b", {}, row.name), " ", verdict, make("small", {}, [row.review, row.note].filter(Boolean).join(" · ")));
      })));
    } else {
      const head = COLUMNS.map(([name, label]) => make(label ? "th" : "td", { ...(label ? { scope: "col" } : {}), ...(order.by === name ? { "aria-sort": order.down ? "descending" : "ascending" } : {}) },
        ...(label ? [make("button", { type: "button", "data-sort": name }, label)] : [])));
      const body = drawn.map((row) => { const all = cells(row); return make("tr", marks(row), ...COLUMNS.map(([name]) => make("td", {}, all[name]))); });
      list.replaceChildren(make("table", { role: "grid", "aria-label": "Frames", "aria-multiselectable": "true" }, make("thead", {}, make("tr", {}, ...head)), make("tbody", {}, ...body)));
    }
    const more = shown.length > LISTED ? `, the first ${LISTED} listed` : "";
    const rank = rows[here]?.worst;
    const place = rank === null || rank === undefined ? "" : ` · shown frame: worst ${rank} of ${rows.filter((row) => row.worst !== null).length}`;
    sheet.querySelector("output").textContent = `${shown.length} of ${rows.length}${more} · ${chosen.size} chosen${place}`;
    sheet.querySelector("[data-do=view]").textContent = gallery ? "Table" : "Gallery";
    for (const name of Object.keys(REVIEWS)) sheet.querySelector(`[data-do="${name}"]`).disabled = !chosen.size;
  }

  function onClick(event) {
    const target = event.target;
    if (target === sheet || target.closest("[aria-label=Close]")) { sheet.close(); return; }
    const sort = target.closest("[data-sort]")?.dataset.sort;
    const row = target.closest("[data-row]");
    const action = target.closest("[data-do]")?.dataset.do;
    if (sort) order = { by: sort, down: order.by === sort && !order.down };
    else if (action === "view") { gallery = !gallery; localStorage.setItem("carts-frames", gallery ? "gallery" : "table"); }
    else if (action === "all") { const all = found(); chosen = new Set(all.every((one) => chosen.has(one.index)) ? [] : all.map((one) => one.index)); }
    else if (action) window.carts.report("ReviewFrames", { frames: [...chosen], state: REVIEWS[action] });
    else if (row && event.detail === 2) { open(Number(row.dataset.row)); return; } // the first click drew a new row
    else if (row) choose(Number(row.dataset.row), event);
    else return;
    draw();
  }

  /** Choose a frame; Shift extends the choice in the order of the list, Ctrl adds or removes one. */
  function choose(index, event) {
    if (event.shiftKey && last !== null) {
      const listed = found().map((row) => row.index);
      const [from, to] = [listed.indexOf(last), listed.indexOf(index)].sort((a, b) => a - b);
      for (const one of listed.slice(Math.max(from, 0), to + 1)) chosen.add(one);
    } else if (event.ctrlKey || event.metaKey) {
      if (!chosen.delete(index)) chosen.add(index);
    } else {
      chosen = new Set([index]);
    }
    last = index;
  }

  function open(index) {
    sheet.close();
    window.carts.report("ShowFrame", { index });
  }

  Object.assign(window.carts, {
    /** Ask the server for the frames, which it sends again with every change until the sheet is closed. */
    openFrames() { window.carts.report("Pressed", { key: "frames" }); },
    /** Values of frames with a record: [loss, Dice, probability of failure, note, place from the worst], by index; people by frame; numbers of poses, -1 for frames without a record. */
    setFrames({ values, who, poses }) {
      rows = Array.from({ length: window.carts.timeline().frames }, (_, index) => {
        const [loss, dice, failure, note, worst] = values[index] ?? [null, null, null, "", null];
        const code = window.carts.timeline().code(index) ?? 0;
        return {
          index, loss, dice, failure, note, worst, pose: poses[index] ?? poses[-1], who: who[index] ?? "", name: window.carts.nameOf(index),
          verdict: VERDICTS[(code >> 3) & 3], review: window.carts.reviewNames[code & 7],
        };
      });
      if (!sheet) build();
      draw();
      if (!sheet.open) sheet.showModal();
    },
  });
})();
