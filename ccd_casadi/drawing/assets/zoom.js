// Drag over a figure to enlarge that part of it, double-click to see the whole again. What is drawn
// over the axes moves and stretches, lines and words keep their size, the scales are written anew.
"use strict";
(() => {
  const NS = "http://www.w3.org/2000/svg";
  const DRAWN = ["curve", "band", "area", "level", "mark"].map((n) => `g[id*="-${n}"]`).join();
  const LEAST = 8;  // pt: a shorter way is not meant for this axis
  const MOST = 1000;  // times
  const made = (name, attributes, parent, before = null) => {
    const found = document.createElementNS(NS, name);
    for (const [key, to] of Object.entries(attributes)) found.setAttribute(key, to);
    return parent.insertBefore(found, before);
  };
  const set = (part, key, to) => (to ? part.setAttribute(key, to) : part.removeAttribute(key));
  const raised = (n) => [...String(n)].map((c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]).join("");
  const written = (v, step) => {
    const n = v ? Math.floor(Math.log10(Math.abs(v))) : 0, to = Math.floor(Math.log10(step) + 1e-9);
    if (n > 4 || n < -3) return `${(v / 10 ** n).toFixed(Math.max(0, n - to))}·10${raised(n)}`;
    return v.toFixed(Math.max(0, -to));
  };

  function ticks(low, high, log) {  // [value, words]
    const out = [];
    if (log && high / low > 20) {
      for (let n = Math.floor(Math.log10(low)); n <= Math.log10(high); n++)
        for (const lead of high / low > 150 ? [1] : [1, 2, 5]) out.push([lead * 10 ** n, lead * 10 ** n]);
    } else {
      const rough = (high - low) / 5, ten = 10 ** Math.floor(Math.log10(rough));
      const step = ten * [1, 2, 5, 10].find((lead) => lead * ten >= rough);
      for (let k = Math.ceil(low / step); k * step <= high; k++) out.push([k * step, step]);
    }
    return out.filter(([v]) => v >= low && v <= high).map(([v, step]) => [v, written(v, step)]);
  }

  function start(svg) {
    const scales = JSON.parse(svg.dataset.axes).scales;  // [low, high, is log, its pt, their pt]
    const axes = svg.querySelector('g[id$="axes_1"]');
    if (!axes) return null;
    const groups = [...axes.querySelectorAll(DRAWN)], labels = [...axes.querySelectorAll('g[id*="-at:"]')];
    const whole = [...axes.querySelectorAll('g[id*="tick"]')];
    let grid = null, from = null, box = null;
    for (const group of groups)  // the window stays where it is, and what is in it moves
      for (const part of group.querySelectorAll("[clip-path]")) {
        group.setAttribute("clip-path", part.getAttribute("clip-path"));
        part.removeAttribute("clip-path");
      }
    const frame = axes.querySelector("[clip-path]")?.getAttribute("clip-path");
    const free = groups.filter((group) => !group.hasAttribute("clip-path"));  // markers at an edge

    function view(to) {  // of each axis how many times as large, and how far on; null: as drawn
      svg.view = to;
      const [[sx, tx], [sy, ty]] = to ?? [[1, 0], [1, 0]];
      for (const group of free) set(group, "clip-path", to && frame);
      for (const group of groups)
        for (const part of group.querySelectorAll("path, use")) {
          if (part.closest("defs")) continue;
          if (part.localName === "use" && !/Collection|-(band|area|level)/.test(group.id)) {
            part.at ??= ["x", "y"].map((key) => +part.getAttribute(key));
            part.setAttribute("x", sx * part.at[0] + tx);
            part.setAttribute("y", sy * part.at[1] + ty);
          } else {
            set(part, "transform", to && `matrix(${sx} 0 0 ${sy} ${tx} ${ty})`);
            set(part, "vector-effect", to && "non-scaling-stroke");
          }
        }
      for (const label of labels) {
        const at = label.id.split("-at:")[1].split(",").map((v) => (v === "" ? null : +v));
        const put = at.map((v, i) => (v === null ? null : v * [sx, sy][i] + [tx, ty][i]));
        const off = put.some((v, i) => v !== null &&
          (v < Math.min(scales[i][3], scales[i][4]) - 1 || v > Math.max(scales[i][3], scales[i][4]) + 1));
        label.style.display = to && off ? "none" : "";
        const by = put.map((v, i) => (v === null ? 0 : v - at[i]));
        set(label, "transform", to && `translate(${by.join(" ")})`);
      }
      for (const part of whole) part.style.display = to ? "none" : "";
      grid?.remove();
      grid = null;
      if (to) write(to);
    }

    function write(to) {
      grid = made("g", { "class": "scale" }, axes, axes.children[1] ?? null);
      const [X, Y] = scales;
      scales.forEach(([low, high, log, a, b], i) => {
        const value = (at) => {
          const share = ((at - to[i][1]) / to[i][0] - a) / (b - a);
          return log ? low * (high / low) ** share : low + (high - low) * share;
        };
        const place = (v) => to[i][1] + to[i][0] *
          (a + (b - a) * (log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low)));
        for (const [v, words] of ticks(value(a), value(b), log)) {
          const at = place(v);
          made("line", i ? { x1: X[3], x2: X[4], y1: at, y2: at } : { x1: at, x2: at, y1: Y[3], y2: Y[4] }, grid);
          made("text", i ? { x: X[3] - 5, y: at + 3, "text-anchor": "end" }
            : { x: at, y: Y[3] + 14, "text-anchor": "middle" }, grid).textContent = words;
        }
      });
    }

    const place = (event) => {
      const own = svg.getBoundingClientRect(), scale = svg.viewBox.baseVal.width / own.width;
      return [(event.clientX - own.left) * scale, (event.clientY - own.top) * scale];
    };
    const inside = (v, [, , , a, b]) => Math.max(Math.min(a, b), Math.min(Math.max(a, b), v));
    const spans = (event) => place(event).map((v, i) => {  // an axis that is not meant stays whole
      const ends = [from[i], inside(v, scales[i])].sort((p, q) => p - q);
      return ends[1] - ends[0] > LEAST ? ends : null;
    });
    svg.addEventListener("pointerdown", (event) => {
      const at = place(event);
      if (event.pointerType === "touch" || event.button || at.some((v, i) => inside(v, scales[i]) !== v)) return;
      from = at;
      svg.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    svg.addEventListener("pointermove", (event) => {
      if (!from) return;
      const chosen = spans(event);
      box ??= made("rect", { "class": "chosen" }, svg);
      const [x, y] = chosen.map((ends, i) => ends ?? [scales[i][3], scales[i][4]].sort((p, q) => p - q));
      const [width, height] = chosen.some(Boolean) ? [x[1] - x[0], y[1] - y[0]] : [0, 0];
      for (const [key, to] of Object.entries({ x: x[0], y: y[0], width, height })) box.setAttribute(key, to);
    });
    svg.addEventListener("pointerup", (event) => {
      if (!from) return;
      const chosen = spans(event), now = svg.view ?? [[1, 0], [1, 0]];
      box?.remove();
      from = box = null;
      if (!chosen.some(Boolean)) return;
      const to = chosen.map((ends, i) => {
        if (!ends) return now[i];
        const [a, b] = [scales[i][3], scales[i][4]].sort((p, q) => p - q);
        const by = (b - a) / (ends[1] - ends[0]);
        return [by * now[i][0], a + by * (now[i][1] - ends[0])];
      });
      if (to.every(([by]) => by <= MOST)) view(to);
    });
    svg.addEventListener("dblclick", () => view(null));
    return () => svg.view && view(null);
  }

  const backs = [...document.querySelectorAll("svg[data-axes]")].map(start).filter(Boolean);
  addEventListener("beforeprint", () => backs.forEach((back) => back()));
  if (!backs.length || !matchMedia("(hover: hover)").matches) return;
  const hint = document.createElement("p");
  hint.className = "meta hint";
  hint.textContent = "Figures: point at a curve to read its values; drag to enlarge a part; double-click to see the whole.";
  document.querySelector("header")?.append(hint);
})();
