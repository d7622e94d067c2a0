"""What limits the bandwidth at a design: S, effort or T, and the resonance and zero next to it.

A mixed-sensitivity design at γ has |W_S S|² + |W_KS KS|² + |W_T T|² of about γ² wherever it is
pressed; the largest of the three shares at a frequency is what holds it there.
"""

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.drawing.content import Block, Table, Words
from ccd_casadi.support.units import number

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
    order = np.argsort(found)[::-1]
    first, second = (f"{PARTS[i]} is at {100 * found[i]:.0f} %" for i in order[:2])
    words = [
        f"At ω_b = {number(loop.bandwidth_hz, 4)} Hz {first} of its bound γ/|W|, and limits "
        f"the loop; {second} of its own."
    ]
    tops = [peak for peak in loop.peaks if peak[1] > 1.05]
    if tops:
        hz, gain = max(tops, key=lambda peak: peak[1])
        kinds = {"resonance": loop.resonances_hz, "transmission zero": loop.antiresonances_hz}
        near = [
            f"the plant's nearest {kind} is at {number(nearest, 4)} Hz"
            for kind, places in kinds.items()
            for nearest in sorted(places, key=lambda f: abs(np.log(f / hz)))[:1]
        ]
        top = f"S is largest, {number(gain, 4)}, at {number(hz, 4)} Hz"
        words.append("; ".join(filter(None, (top, " and ".join(near)))) + ".")
    below = [f for f in loop.resonances_hz if f < loop.bandwidth_hz]
    close = [f for f in loop.resonances_hz if loop.bandwidth_hz <= f < 2.0 * loop.bandwidth_hz]
    if below or close:
        listed = ", ".join(number(f, 4) for f in (*below, *close))
        words.append(f"Controlled resonances, below twice the bandwidth: {listed} Hz.")
    return words


def limit_blocks(loop: LoopView, *more: str) -> tuple[Block, ...]:
    """The sentences, `more` of them, and the table."""
    return (*map(Words, (*limit_sentences(loop), *more)), table_limits(loop))
