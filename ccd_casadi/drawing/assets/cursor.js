// Reads values off the drawn curves, one cursor across all figures of one axis: numbers come from
// the paths as drawn and the ends of the axes, to about a thousandth of an axis, so that a page
// carries none twice. Without it, and on paper, figures stand as they are.
"use strict";
(() => {
  const NS = "http://www.w3.org/2000/svg";
  const panels = [...document.querySelectorAll("svg[data-axes]")].map((svg) => {
    const d = JSON.parse(svg.dataset.axes);
    const value = ([low, high, log, a, b], at) => {
      const share = (at - a) / (b - a);
      return log ? low * (high / low) ** share : low + (high - low) * share;
    };
    const place = ([low, high, log, a, b], v) =>
      a + (b - a) * (log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low));
    const [line, words] = ["line", "text"].map((name) =>
      svg.appendChild(document.createElementNS(NS, name)));
    line.setAttribute("class", "cursor");
    words.setAttribute("class", "readout");
    return { svg, d, value, place, line, words, curves: null };
  });

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

  function show(kind, v) {
    for (const p of panels) {
      const [X, Y] = p.d.scales, x = p.d.x === kind ? p.place(X, v) : NaN;
      const on = x >= X[3] && x <= X[4];
      p.line.style.display = p.words.style.display = on ? "" : "none";
      if (!on) continue;
      p.curves ??= curves(p);
      for (const [key, to] of Object.entries({ x1: x, x2: x, y1: Y[3], y2: Y[4] }))
        p.line.setAttribute(key, to);
      const found = p.curves.map(([name, points]) => {
        const y = at(points, x);
        return y === null ? "" : `${name || p.d.y.replace(/ \(.*/, "")} ${short(p.value(Y, y))}${unit(p.d.y)}`;
      });
      p.words.textContent = [short(v) + unit(kind), ...found.filter(Boolean)].join(" · ");
      const left = x < (X[3] + X[4]) / 2;
      p.words.setAttribute("x", left ? X[4] : X[3] + 2);
      p.words.setAttribute("text-anchor", left ? "end" : "start");
      p.words.setAttribute("y", Y[4] - 3);
    }
  }

  for (const p of panels) {
    p.svg.addEventListener("pointermove", (event) => {
      const box = p.svg.getBoundingClientRect(), wide = p.svg.viewBox.baseVal.width;
      show(p.d.x, p.value(p.d.scales[0], (event.clientX - box.left) * wide / box.width));
    });
    p.svg.addEventListener("pointerleave", () => show(null, 0));
  }
})();
