// Uploads of files or a folder that were dropped on or chosen in a document (`start/uploads.py`). Needs document.js.
(() => {
  "use strict";

  const PART = 512 * 1024; // bytes of a message; the server accepts 1 MiB
  const LISTED = 2000; // files in a message
  const SKIPPED = /(^|\/)(\.[^/]*|Thumbs\.db|desktop\.ini)(\/|$)/;
  let running = null; // socket of the running upload

  const zone = () => document.querySelector(".carts-document [data-drop]");

  function show(text, share = null, problem = false) {
    const output = zone()?.querySelector("output");
    if (!output) return;
    const bar = window.cartsElement("progress", { "aria-label": "Upload", max: 1, value: share ?? 0 });
    output.replaceChildren(...(share === null ? [] : [bar]), text);
    output.classList.toggle("bad", problem);
  }

  /** The next message of the server. */
  const answer = (socket) => new Promise((resolve, reject) => {
    socket.onmessage = (event) => {
      const said = JSON.parse(event.data);
      if (said.error) reject(new Error(said.error)); else resolve(said);
    };
  });

  /** Rejects when the connection is closed. */
  const closed = (socket) => new Promise((_, reject) => {
    socket.onclose = ({ reason }) => reject(new Error(reason || "The connection to the viewer was lost. Upload the files again."));
  });

  async function transfer(socket, files) {
    await new Promise((resolve, reject) => {
      socket.onopen = resolve;
      socket.onerror = () => reject(new Error("The viewer did not accept the upload. Reload the page."));
    });
    const total = files.reduce((sum, { file }) => sum + file.size, 0);
    let said = null;
    for (let first = 0; first < files.length; first += LISTED) {
      const part = files.slice(first, first + LISTED).map(({ path, file }) => [path, file.size]);
      socket.send(JSON.stringify({ files: part, more: first + LISTED < files.length }));
      said = await answer(socket);
    }
    for (const { path, file } of files) {
      for (let start = 0; start < file.size; start += PART) {
        socket.send(await file.slice(start, start + PART).arrayBuffer());
        said = await answer(socket);
        if (!said.folder) show(` ${path}: ${(said.received / 1e6).toFixed(0)} of ${(total / 1e6).toFixed(0)} MB`, said.received / total);
      }
    }
    return said.folder;
  }

  /** Upload files, and open their folder. */
  async function upload(all) {
    const files = all.filter(({ path }) => !SKIPPED.test(path));
    if (running) { show(" An upload is running. Wait until it ends, or cancel it.", 0); return; }
    if (!files.length) { show("Nothing to upload: there are no visible files.", null, true); return; }
    const socket = running = new WebSocket(new URL("upload", location.href.replace(/^http/, "ws")));
    try {
      show(` ${files.length} files`, 0);
      const folder = await Promise.race([transfer(socket, files), closed(socket)]);
      window.carts.report("Chosen", { name: "open-path", value: folder });
    } catch (error) {
      show(error.message, null, true);
    } finally {
      running = null;
      socket.close();
    }
  }

  /** Files of a dropped entry, folders included. */
  async function within(entry, above = "") {
    const path = above + entry.name;
    if (entry.isFile) return [{ path, file: await new Promise((resolve, reject) => entry.file(resolve, reject)) }];
    const reader = entry.createReader();
    const found = [];
    for (;;) {
      const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject)); // at most 100 at a time
      if (!some.length) return found;
      for (const one of some) found.push(...await within(one, `${path}/`));
    }
  }

  function choose(folder) {
    const input = window.cartsElement("input", { type: "file", multiple: "", ...(folder ? { webkitdirectory: "" } : {}) });
    input.addEventListener("change", () => {
      upload([...input.files].map((file) => ({ path: file.webkitRelativePath || file.name, file })));
    });
    input.click();
  }

  window.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("button[data-upload]") : null;
    if (button?.dataset.upload === "cancel") running?.close(1000, "Upload cancelled. Incomplete uploads are not kept.");
    else if (button) choose(button.dataset.upload === "folder");
  });
  for (const kind of ["dragover", "dragleave", "drop"]) {
    window.addEventListener(kind, (event) => {
      const target = zone();
      if (!target || !event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      target.classList.toggle("over", kind === "dragover");
      if (kind !== "drop") return;
      const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry()).filter(Boolean);
      Promise.all(entries.map((entry) => within(entry))).then((found) => upload(found.flat()), (error) => show(String(error), null, true));
    });
  }
})();
