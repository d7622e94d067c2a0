"use strict";
for (const box of document.querySelectorAll(".steps")) {
  const slider = box.querySelector("input"), steps = [...box.querySelectorAll(".step")];
  slider.closest("label").hidden = false;
  slider.addEventListener("input", () =>
    steps.forEach((step, i) => { step.hidden = i !== Number(slider.value); }));
}
