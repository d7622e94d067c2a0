"""One of several pictures at a time, chosen by a slider.

Without the script, and on paper, the one that is shown stands alone.
"""

from collections.abc import Sequence

from ccd_casadi.reporting.page import escape, with_script

CSS = """
.steps > label { display: flex; gap: 10px; align-items: center; }
.steps input { flex: 1; }
@media print { .steps > label { display: none; } }
"""
SCRIPT = """
"use strict";
for (const box of document.querySelectorAll(".steps")) {
  const slider = box.querySelector("input"), steps = [...box.querySelectorAll(".step")];
  slider.closest("label").hidden = false;
  slider.addEventListener("input", () =>
    steps.forEach((step, i) => { step.hidden = i !== Number(slider.value); }));
}
"""


def steps_html(steps: Sequence[tuple[str, str]], first: int, label: str) -> str:
    """Pairs of words and HTML behind a slider, the `first` one shown."""
    shown = "".join(
        f'\n<div class="step"{"" if i == first else " hidden"}><p>{escape(words)}</p>{body}</div>'
        for i, (words, body) in enumerate(steps)
    )
    slider = f'<input type="range" min="0" max="{len(steps) - 1}" value="{first}">'
    return f'<div class="steps"><label hidden>{escape(label)} {slider}</label>{shown}\n</div>'


def with_steps(document: str) -> str:
    """A finished page, with the script if it has such a slider."""
    return with_script(document, SCRIPT, CSS) if '<div class="steps">' in document else document
