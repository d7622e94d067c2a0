// Turns the pictures of turntable.py; without it, and on paper, those drawn in Python stand.
"use strict";
(() => {
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  const unit = (v) => v.map((c) => c / Math.hypot(...v));

  function start(root) {
    const d = JSON.parse(root.querySelector("script").textContent);
    const light = unit(d.light), n = d.points.length / 3, count = d.quads.length / 4;
    const state = { turn: d.view[0], tilt: d.view[1], amplitude: 100, phase: 1, begun: null };
    const right = new Float64Array(n), up = new Float64Array(n), near = new Float64Array(n);
    const depth = new Float64Array(count), bright = new Float64Array(count);
    const views = [...root.querySelectorAll(".drawn")].map((box, i) => {
      const canvas = document.createElement("canvas");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", box.querySelector("svg").getAttribute("aria-label"));
      box.append(canvas);
      turnable(canvas);
      return { canvas, field: d.fields[i], colour: paint(d.fields[i]) };
    });

    function paint(field) {  // colour of each quad, before the light
      const out = new Float64Array(3 * count);
      for (let q = 0; q < count; q++) {
        let share = 0;
        for (let c = 0; c < 4; c++) {
          const p = 3 * d.quads[4 * q + c];
          share += Math.hypot(field[p], field[p + 1], field[p + 2]) / (4 * d.shares);
        }
        const at = Math.min(share, 1) * (d.stops.length - 1);
        const k = Math.min(Math.floor(at), d.stops.length - 2);
        for (let c = 0; c < 3; c++)
          out[3 * q + c] = d.stops[k][c] + (at - k) * (d.stops[k + 1][c] - d.stops[k][c]);
      }
      return out;
    }

    function draw(view) {
      const box = view.canvas.getBoundingClientRect();
      if (box.bottom < 0 || box.top > innerHeight || !box.width) return;
      const ratio = Math.min(devicePixelRatio || 1, 3);
      const w = Math.round(box.width * ratio), h = Math.round(box.height * ratio);
      if (view.canvas.width !== w || view.canvas.height !== h)
        Object.assign(view.canvas, { width: w, height: h });
      view.canvas.parentElement.classList.add("painted");
      const g = view.canvas.getContext("2d"), f = view.field, p = d.points;
      const a = state.turn * Math.PI / 180, e = state.tilt * Math.PI / 180;
      const ca = Math.cos(a), sa = Math.sin(a), ce = Math.cos(e), se = Math.sin(e);
      const across = Math.hypot(d.size[0], d.size[1]);
      const tall = across * Math.abs(se) + (d.size[2] + 2 * d.reach) * Math.abs(ce);
      const [W, H, margin] = d.frame;
      const fit = Math.min((W - 2 * margin) / across, (H - 2 * margin) / tall) * w / W;
      const move = state.amplitude / 100 * state.phase * d.reach / d.shares;
      for (let i = 0, j = 0; i < n; i++, j += 3) {
        const x = p[j] + move * f[j], y = p[j + 1] + move * f[j + 1];
        const z = p[j + 2] + move * f[j + 2];
        const forth = ca * x + sa * y;
        right[i] = fit * (ca * y - sa * x);
        up[i] = fit * (ce * z - se * forth);
        near[i] = fit * (se * z + ce * forth);
      }
      const front = [], Q = d.quads;
      for (let q = 0, j = 0; q < count; q++, j += 4) {
        const A = Q[j], B = Q[j + 1], C = Q[j + 2], D = Q[j + 3];
        const x1 = right[C] - right[A], y1 = up[C] - up[A], z1 = near[C] - near[A];
        const x2 = right[D] - right[B], y2 = up[D] - up[B], z2 = near[D] - near[B];
        const nx = y1 * z2 - z1 * y2, ny = z1 * x2 - x1 * z2, nz = x1 * y2 - y1 * x2;
        if (nz <= 0) continue;
        const cosine = (nx * light[0] + ny * light[1] + nz * light[2]) / Math.hypot(nx, ny, nz);
        bright[q] = d.shade[0] + d.shade[1] * Math.max(0, cosine);
        depth[q] = near[A] + near[B] + near[C] + near[D];
        front.push(q);
      }
      front.sort((s, t) => depth[s] - depth[t]);
      g.setTransform(1, 0, 0, 1, 0, 0);
      g.clearRect(0, 0, w, h);
      g.setTransform(1, 0, 0, -1, w / 2, h / 2);
      g.lineWidth = 0.5 * w / W;
      g.lineJoin = "round";
      for (const q of front) {
        const c = view.colour, k = 3 * q, b = bright[q], j = 4 * q;
        const [red, green, blue] = [b * c[k], b * c[k + 1], b * c[k + 2]].map(Math.round);
        g.fillStyle = g.strokeStyle = `rgb(${red},${green},${blue})`;
        g.beginPath();
        g.moveTo(right[Q[j]], up[Q[j]]);
        for (let i = 1; i < 4; i++) g.lineTo(right[Q[j + i]], up[Q[j + i]]);
        g.closePath();
        g.fill();
        g.stroke();
      }
    }

    let asked = false;
    function ask() {
      if (!asked) requestAnimationFrame(frame);
      asked = true;
    }
    function frame(now) {
      asked = false;
      state.phase = 1;
      if (state.begun !== null) {
        state.begun = state.begun || now;
        state.phase = Math.cos(2 * Math.PI * (now - state.begun) / 2400);
        ask();
      }
      views.forEach(draw);
    }

    function turnable(canvas) {
      let last = null;
      canvas.addEventListener("pointerdown", (event) => {
        last = [event.clientX, event.clientY];
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener("pointermove", (event) => {
        if (last === null) return;
        const dx = event.clientX - last[0], dy = event.clientY - last[1];
        last = [event.clientX, event.clientY];
        state.turn = (state.turn - 0.6 * dx + 540) % 360 - 180;
        state.tilt = Math.max(-90, Math.min(90, state.tilt + 0.6 * dy));
        show();
      });
      for (const name of ["pointerup", "pointercancel"])
        canvas.addEventListener(name, () => { last = null; });
    }

    const bar = document.createElement("div");
    bar.className = "controls";
    const sliders = [["turn", -180, 180, "°"], ["tilt", -90, 90, "°"],
      ["amplitude", -100, 100, " %"]].map(([name, low, high, mark]) => {
      const label = document.createElement("label"), input = document.createElement("input");
      const output = document.createElement("output");
      Object.assign(input, { type: "range", min: low, max: high, step: 1 });
      input.addEventListener("input", () => { state[name] = Number(input.value); show(); });
      label.append(name, input, output);
      bar.append(label);
      return () => {
        input.value = state[name];
        output.textContent = Math.round(state[name]) + mark;
      };
    });
    function button(kind, words, action) {
      const made = document.createElement("button");
      Object.assign(made, { type: "button", className: kind, textContent: words });
      made.addEventListener("click", () => action(made));
      bar.append(made);
      return made;
    }
    const play = button("play", "Play", () => run(state.begun === null));
    button("reset", "Reset", () => {
      Object.assign(state, { turn: d.view[0], tilt: d.view[1], amplitude: 100 });
      run(false);
    });
    function run(on) {
      state.begun = on ? 0 : null;
      play.textContent = on ? "Pause" : "Play";
      show();
    }
    function show() {
      sliders.forEach((refresh) => refresh());
      ask();
    }
    root.prepend(bar);
    root.classList.add("live");
    calm.addEventListener("change", () => { if (calm.matches) run(false); });
    addEventListener("scroll", ask, { passive: true });
    new ResizeObserver(ask).observe(root);
    show();
  }
  document.querySelectorAll(".turntable").forEach(start);
})();
