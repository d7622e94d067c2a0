// Reads values off the drawn curves, one cursor across all figures of one axis: numbers come from
// the paths as drawn and the ends of the axes, to about a thousandth of an axis, so that a page
// carries none twice. Of a locus they are those of its nearest point, with its frequency. Without
// it, and on paper, figures stand as they are.
"use strict";
(() => {
  const NS = "http://www.w3.org/2000/svg";
  const REACH = 40;  // pt from a locus to the pointer
  const value = ([low, high, log, a, b], at) => {
    const share = (at - a) / (b - a);
    return log ? low * (high / low) ** share : low + (high - low) * share;
  };
  const place = ([low, high, log, a, b], v) =>
    a + (b - a) * (log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low));
  const panels = [...document.querySelectorAll("svg[data-axes]")].map((svg) => {
    const [line, dot, words] = ["line", "circle", "text"].map((name) =>
      svg.appendChild(document.createElementNS(NS, name)));
    line.setAttribute("class", "cursor");
    dot.setAttribute("class", "reached");
    dot.setAttribute("r", 3);
    words.setAttribute("class", "readout");
    return { svg, d: JSON.parse(svg.dataset.axes), line, dot, words, curves: null };
  });
  // from the page's pt to those that the figure was drawn with, and back: zoom.js enlarges a part
  const drawn = (p, i, at) => (at - (p.svg.view?.[i][1] ?? 0)) / (p.svg.view?.[i][0] ?? 1);
  const shown = (p, i, at) => at * (p.svg.view?.[i][0] ?? 1) + (p.svg.view?.[i][1] ?? 0);

  function curves(p) {
    return Object.entries(p.d.names).map(([i, name]) => {
      const path = p.svg.querySelector(`[id$="-curve${i}"] path`);
      const points = [...(path?.getAttribute("d") ?? "").matchAll(/[ML]\s*(\S+)\s+(\S+)/g)];
      return [name, points.map((m) => [+m[1], +m[2]])];
    });
  }

  function at(points, x) {
    let i = points.findIndex((point) => point[0] >= x);
    if (i <= 0) return null;
    const [[a, y], [b, z]] = [points[i - 1], points[i]];
    return b > a ? y + (z - y) * (x - a) / (b - a) : z;
  }

  const raised = (n) => [...String(n)].map((c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]).join("");
  const short = (v) => {  // three digits, which is what is read off
    const n = v ? Math.floor(Math.log10(Math.abs(v))) : 0;
    const digits = (x) => Number(x.toPrecision(3)).toString();
    return n > 4 || n < -3 ? `${digits(v / 10 ** n)}·10${raised(n)}` : digits(v);
  };
  const unit = (label) => {
    const found = label.match(/\(([^)]*)\)$/);
    return found && found[1] !== "–" ? ` ${found[1]}` : "";
  };

  function write(p, parts, left) {
    const [X, Y] = p.d.scales;
    p.words.textContent = parts.filter(Boolean).join(" · ");
    p.words.setAttribute("x", left ? X[4] : X[3] + 2);
    p.words.setAttribute("text-anchor", left ? "end" : "start");
    p.words.setAttribute("y", Y[4] - 3);
  }

  function atPoint(p, point) {  // of a locus: null where there is none
    const [X, Y] = p.d.scales, on = point !== undefined && point !== null;
    p.dot.style.display = p.words.style.display = on ? "" : "none";
    if (!on) return;
    const [x, y, hz] = point, re = value(X, x), im = value(Y, y);
    p.dot.setAttribute("cx", shown(p, 0, x));
    p.dot.setAttribute("cy", shown(p, 1, y));
    write(p, [`${short(hz)} Hz`, `L ${short(re)} ${im < 0 ? "−" : "+"} ${short(Math.abs(im))} i`,
      `${short(Math.hypot(1 + re, im))} from −1`], x < (X[3] + X[4]) / 2);
  }

  function nearest(points, distance) {
    let best = null, least = Infinity;
    for (const point of points) {
      const d = distance(point);
      if (d < least) [best, least] = [point, d];
    }
    return [best, least];
  }

  function show(kind, v) {
    for (const p of panels) {
      if (p.d.locus) {
        const near = /\(Hz\)$/.test(kind ?? "") &&
          nearest(p.d.locus, (point) => Math.abs(Math.log(point[2] / v)));
        atPoint(p, near && near[1] < 0.03 ? near[0] : null);  // elsewhere it is out of the picture
        p.line.style.display = "none";
        continue;
      }
      const [X, Y] = p.d.scales, x = p.d.x === kind ? place(X, v) : NaN;
      const across = shown(p, 0, x), on = across >= X[3] && across <= X[4] && p.d.names;
      p.line.style.display = p.words.style.display = on ? "" : "none";
      p.dot.style.display = "none";
      if (!on) continue;
      p.curves ??= curves(p);
      for (const [key, to] of Object.entries({ x1: across, x2: across, y1: Y[3], y2: Y[4] }))
        p.line.setAttribute(key, to);
      const found = p.curves.map(([name, points]) => {
        const y = at(points, x);
        return y === null ? "" : `${name || p.d.y.replace(/ \(.*/, "")} ${short(value(Y, y))}${unit(p.d.y)}`;
      });
      write(p, [short(v) + unit(kind), ...found], across < (X[3] + X[4]) / 2);
    }
  }

  for (const p of panels) {
    p.svg.addEventListener("pointermove", (event) => {
      const box = p.svg.getBoundingClientRect(), scale = p.svg.viewBox.baseVal.width / box.width;
      const x = drawn(p, 0, (event.clientX - box.left) * scale);
      const y = drawn(p, 1, (event.clientY - box.top) * scale);
      if (!p.d.locus) return show(p.d.x, value(p.d.scales[0], x));
      const [best, away] = nearest(p.d.locus, (point) => Math.hypot(
        shown(p, 0, point[0]) - shown(p, 0, x), shown(p, 1, point[1]) - shown(p, 1, y)));
      if (away > REACH) return show(null, 0);
      show("frequency (Hz)", best[2]);
      atPoint(p, best);
    });
    p.svg.addEventListener("pointerleave", () => show(null, 0));
  }
})();
