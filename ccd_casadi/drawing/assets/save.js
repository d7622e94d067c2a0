// Saves a figure as SVG, in the colours of the page, and its curves as CSV: all points as they are
// drawn, to about a thousandth of an axis; of a figure without curves its tables. Without it, and
// on paper, a figure has no buttons.
"use strict";
(() => {
  const NS = "http://www.w3.org/2000/svg";
  const value = ([low, high, log, a, b], at) => {
    const share = (at - a) / (b - a);
    return log ? low * (high / low) ** share : low + (high - low) * share;
  };
  const cell = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);

  function save(name, type, text) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type }));
    link.download = name;
    link.click();
    URL.revokeObjectURL(link.href);
  }

  function colours() {  // of the theme that is shown
    const names = document.querySelector("style").textContent.match(/--[a-z-]+(?=:)/g);
    const root = getComputedStyle(document.documentElement);
    return [...new Set(names)].map((name) => `${name}:${root.getPropertyValue(name)}`).join(";");
  }

  function svg(figure) {
    const drawn = [...figure.querySelectorAll(".drawing svg")].filter((one) => one.clientWidth);
    const whole = document.createElementNS(NS, "svg");
    const around = figure.querySelector(".drawing").getBoundingClientRect();
    whole.setAttribute("xmlns", NS);
    whole.setAttribute("viewBox", `0 0 ${around.width} ${around.height}`);
    const words = getComputedStyle(document.body).fontFamily.replaceAll('"', "'");
    const style = whole.appendChild(document.createElementNS(NS, "style"));
    style.textContent = `svg{${colours()};background:var(--paper)}
      text{font-family:${words};fill:var(--ink)}`;
    for (const one of drawn) {
      const place = one.getBoundingClientRect(), copy = one.cloneNode(true);
      for (const part of copy.querySelectorAll(".cursor, .reached, .readout")) part.remove();
      for (const [key, to] of Object.entries({ x: place.x - around.x, y: place.y - around.y,
        width: place.width, height: place.height })) copy.setAttribute(key, to);
      whole.append(copy);
    }
    return new XMLSerializer().serializeToString(whole);
  }

  function csv(figure) {
    const rows = [["x axis", "y axis", "curve", "x", "y"]];
    for (const one of figure.querySelectorAll(".drawing svg[data-axes]")) {
      if (!one.clientWidth) continue;  // the same for another width of the page
      const d = JSON.parse(one.dataset.axes);
      for (const [i, name] of Object.entries(d.names)) {
        const path = one.querySelector(`[id$="-curve${i}"] path`)?.getAttribute("d") ?? "";
        for (const [, x, y] of path.matchAll(/[ML]\s*(\S+)\s+(\S+)/g))
          rows.push([d.x, d.y, name, ...[x, y].map((at, k) =>
            value(d.scales[k], +at).toPrecision(5))]);
      }
    }
    if (rows.length === 1)
      for (const row of figure.querySelectorAll("details tr"))
        rows.push([...row.cells].map((one) => one.textContent));
    return rows.map((row) => row.map(cell).join(",")).join("\r\n");
  }

  document.querySelectorAll("figure").forEach((figure, i) => {
    const title = figure.closest("section")?.querySelector("h2")?.textContent ?? "figure";
    const name = `${title.toLowerCase().replace(/[^a-z0-9]+/g, "-")}-${i + 1}`;
    const line = figure.querySelector(".save");
    for (const [kind, type, make] of [["SVG", "image/svg+xml", svg], ["CSV", "text/csv", csv]]) {
      const button = line.appendChild(document.createElement("button"));
      button.textContent = kind;
      button.setAttribute("aria-label", `Save this figure as ${kind}`);
      button.addEventListener("click", () =>
        save(`${name}.${kind.toLowerCase()}`, type, make(figure)));
    }
  });
})();
