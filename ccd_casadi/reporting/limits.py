"""What limits the bandwidth at a design: S, effort or T, and the resonance and zero next to it.

A mixed-sensitivity design at γ has |W_S S|² + |W_KS KS|² + |W_T T|² of about γ² wherever it is
pressed; the largest of the three shares at a frequency is what holds it there.
"""

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.drawing.content import Block, Table, Words
from ccd_casadi.reporting.facts import paragraphs

PARTS = ("|S|", "|KS|", "|T|")


def shares(loop: LoopView, hz: float) -> np.ndarray:
    """(3,) |W_S S|, |W_KS KS|, |W_T T| over γ at a frequency in Hz."""
    i = int(np.abs(np.log(loop.hz / hz)).argmin())
    return np.asarray(loop.gains[:, i] / loop.bounds[:, i])


def table_limits(loop: LoopView) -> Table:
    """Shares of γ where it matters: below, at and above the bandwidth, and at the peaks of S."""
    places = [
        ("half the bandwidth", 0.5 * loop.bandwidth_hz),
        ("bandwidth ω_b", loop.bandwidth_hz),
        ("twice the bandwidth", 2.0 * loop.bandwidth_hz),
        *(("peak of S", hz) for hz, gain in loop.peaks if gain > 1.05),
    ]
    rows = []
    for name, hz in sorted(places, key=lambda place: place[1]):
        found = shares(loop, hz)
        percent = (float(f"{100.0 * share:.3g}") for share in found)
        rows.append((name, hz, *percent, PARTS[int(found.argmax())]))
    heads = (f"{part}, % of its bound" for part in PARTS)
    return Table(("where", "Hz", *heads, "closest"), tuple(rows))


def limit_sentences(loop: LoopView) -> list[str]:
    """What holds ω_b, and what stands where S is largest."""
    found = shares(loop, loop.bandwidth_hz)
    held = [(PARTS[i], found[i]) for i in np.argsort(found)[::-1]]
    top = max(
        (peak for peak in loop.peaks if peak[1] > 1.05), key=lambda peak: peak[1], default=None
    )
    near = []
    if top is not None:
        kinds = {"resonance": loop.resonances_hz, "transmission zero": loop.antiresonances_hz}
        near = [
            (kind, min(places, key=lambda f: abs(np.log(f / top[0]))))
            for kind, places in kinds.items() if places
        ]  # fmt: skip
    controlled = [f for f in loop.resonances_hz if f < 2.0 * loop.bandwidth_hz]
    return paragraphs("report.limits", loop, held, top, near, controlled)


def limit_blocks(loop: LoopView, *more: str) -> tuple[Block, ...]:
    """The sentences, `more` of them, and the table."""
    return (*map(Words, (*limit_sentences(loop), *more)), table_limits(loop))
