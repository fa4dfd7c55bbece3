// Runs before viser's client: reads the page's configuration, and replaces viser's scripts by calls of named functions.
(() => {
  "use strict";

  window.cartsConfiguration = JSON.parse(document.currentScript.dataset.configuration);

  // The token is no longer needed, and would be copied with the address.
  const address = new URL(location.href);
  address.searchParams.delete("token");
  // viser connects to this address without a slash at its end, which proxies in front of a folder redirect.
  if (address.pathname !== "/" && address.pathname.endsWith("/")) address.pathname += "index.html";
  history.replaceState(null, "", address);

  // In a frame of another site, such as a notebook, a browser may deny storage; values then last as long as the page.
  for (const name of ["localStorage", "sessionStorage"]) {
    try {
      void window[name];
    } catch {
      const kept = new Map();
      Object.defineProperty(window, name, {
        value: {
          getItem: (key) => kept.get(key) ?? null,
          setItem: (key, value) => void kept.set(key, String(value)),
          removeItem: (key) => void kept.delete(key),
        },
      });
    }
  }

  /** An element with attributes and children; strings are inserted as text, never as HTML. */
  window.cartsElement = (tag, attributes = {}, ...children) => {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
  };

  /** An icon of the set that viser's widgets use, by its name. */
  window.cartsIcon = (name) => {
    const path = window.cartsConfiguration.icons?.[name] ?? "";
    const svg = `<svg xmlns="http://www.w3.org/2000/svg" class="carts-icon" viewBox="0 0 24 24" aria-hidden="true">${path}</svg>`;
    return document.importNode(new DOMParser().parseFromString(svg, "image/svg+xml").documentElement, true);
  };

  /** Insert the icons that elements name in `data-icon`. */
  window.cartsIcons = (parent) => {
    for (const element of parent.querySelectorAll("[data-icon]")) element.append(window.cartsIcon(element.dataset.icon));
  };

  /** Call a function of `window.carts`; unknown names are ignored. */
  function call({ name, args }) {
    if (Object.hasOwn(window.carts ?? {}, name)) window.carts[name](...args);
  }

  // viser's client runs `Function(source)()` for a RunJavascriptMessage, which would need `unsafe-eval` in the policy. The
  // server sends the name of a function and its arguments as JSON instead (`call` in transport/page.py). Any other source does
  // nothing: viser's sorter of Gaussian splats, which is not used here, prepares some when it is loaded.
  const inert = () => inert;
  const receive = (source) => {
    if (!String(source).startsWith("{")) return inert;
    const message = JSON.parse(source);
    return () => call(message);
  };
  window.Function = new Proxy(Function, {
    apply: (_, __, sources) => receive(sources.at(-1)),
    construct: (_, sources) => receive(sources.at(-1)),
  });
})();
