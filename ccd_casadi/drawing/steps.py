"""One of several pictures at a time, chosen by a slider.

Without the script, and on paper, the one that is shown stands alone.
"""

from collections.abc import Sequence

from ccd_casadi.drawing.page import escape


def steps_html(steps: Sequence[tuple[str, str]], first: int, label: str) -> str:
    """Pairs of words and HTML behind a slider, the `first` one shown."""
    shown = "".join(
        f'\n<div class="step"{"" if i == first else " hidden"}><p>{escape(words)}</p>{body}</div>'
        for i, (words, body) in enumerate(steps)
    )
    slider = f'<input type="range" min="0" max="{len(steps) - 1}" value="{first}">'
    return f'<div class="steps"><label hidden>{escape(label)} {slider}</label>{shown}\n</div>'
