"""Bode plots of plant, controller and loop, resonances and anti-resonances marked."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.analysis.loop_view import LoopView, phase_deg
from ccd_casadi.deployment.channels import Channel
from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Mark, Panel, Table
from ccd_casadi.drawing.svg import BLACK, CYCLE
from ccd_casadi.reporting.loops import bandwidth_level, over_hz
from ccd_casadi.reporting.tables import over_frequency
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import number

ZERO = 1e-6  # of a direction's entry that counts as none
MOST_MARKS = 8  # resonances, and as many anti-resonances, marked in the plot


def bode(loop: LoopView, channels: Sequence[Channel] = ()) -> Figure:
    """The Bode plot of one design with its words and numbers."""
    return Figure(_bode(loop, channels), _caption(loop, channels), (_table(loop),))


def _bode(loop: LoopView, channels: Sequence[Channel]) -> Lines:
    """Plant, controller and L = GK: magnitude and phase, of every one of several scalar channels.

    All singular values, and no phase, of a loop that does not fall apart into such channels.
    """
    parts = scalar_parts(loop, channels)
    G, K = _singular_values(loop.plant), _singular_values(loop.controller)
    at = (bandwidth_level(loop.bandwidth_hz),)

    def panel(label: str, values: Mapping[str, Array], **more: Any) -> Panel:
        drawn = tuple(
            Curve(loop.hz, v, name if len(values) > 1 else "", CYCLE[i % len(CYCLE)])
            for i, (name, v) in enumerate(values.items())
        )
        return over_hz(label, drawn, loop.ends, **{"log_y": False, **more})

    gap = (float(G.min()) / 10.0, float(G.max()) * 10.0)  # room for the marks' words
    title = "Bode plot of the plant, the controller and the loop"
    if not parts:
        sigma = [{f"σ{i + 1}": s[:, i] for i in range(s.shape[1])} for s in (G, K)]
        marks = tuple(_marks(loop, G))
        top = (
            panel("plant σ(G) (m/N)", sigma[0], log_y=True, marks=marks, y_range=gap),
            panel("controller σ(K) (N/m)", sigma[1], log_y=True, levels=at),
        )
        return Lines((top,), title, (3.4,))
    several = len(parts) > 1  # whose resonances are not marked: the words would meet
    marks = () if several else tuple(_marks(loop, G))
    look: dict[str, dict[str, Any]] = {
        "G": {"marks": marks} | ({} if several else {"y_range": gap}),
        "K": {"levels": at, "legend": None},  # the colours are those of G
        "L": {"levels": (Level(1.0, "1"),), "legend": None},
    }
    sizes: list[Panel] = []
    phases: list[Panel] = []
    for k, (name, unit) in enumerate((("G", "m/N"), ("K", "N/m"), ("L", "–"))):
        values = {channel: part[k] for channel, part in parts.items()}
        size = {channel: np.abs(v) for channel, v in values.items()}
        sizes.append(panel(f"|{name}| ({unit})", size, log_y=True, **look[name]))
        angle = {channel: phase_deg(v) for channel, v in values.items()}
        phases.append(panel(f"phase of {name} (deg)", angle, y_step=90.0, legend=None))
    return Lines((tuple(sizes), tuple(phases)), title, (2.9, 2.3))


def scalar_parts(loop: LoopView, channels: Sequence[Channel]) -> dict[str, tuple[np.ndarray, ...]]:
    """g, k and their product of every scalar channel, by a name that says which outputs it moves.

    Empty where the loop is no scalar one and does not fall apart into such channels.
    """
    if loop.plant.shape[1:] == (1, 1):
        g, k = loop.plant[:, 0, 0], loop.controller[:, 0, 0]
        return {"": (g, k, g * k)}
    if len(channels) < 2:
        return {}
    found: dict[str, tuple[np.ndarray, ...]] = {}
    for channel in channels:
        u, v = channel.outputs[:, 0], channel.inputs[:, 0]
        g, k = u @ loop.plant @ v, v @ loop.controller @ u
        u = u * np.sign(u[np.abs(u).argmax()])
        signs = "".join("0" if abs(x) < ZERO else "+" if x > 0.0 else "−" for x in u)
        found[f"channel {channel.name}, outputs {signs}"] = (g, k, g * k)
    return found


def _marks(loop: LoopView, gains: Array) -> list[Mark]:
    """Resonances above the largest gain, anti-resonances below the least one."""
    found = []
    groups = (
        (loop.resonances_hz, gains[:, 0], "^", 8.0),
        (loop.antiresonances_hz, gains[:, -1], "v", -8.0),
    )
    for places, gain, marker, dy in groups:
        inside = [hz for hz in places if loop.hz[0] <= hz <= loop.hz[-1]]
        for hz in inside[:MOST_MARKS]:
            y = float(gain[np.abs(loop.hz - hz).argmin()])
            few = len(inside) <= 3
            text = f"{number(hz, 4)} Hz" if few else ""
            found.append(Mark(hz, y, text, marker, BLACK, (0.0, dy)))
    return found


def _caption(loop: LoopView, channels: Sequence[Channel]) -> str:
    scalar = loop.plant.shape[1:] == (1, 1)
    what = "" if scalar else (
        "Every channel by itself; the signs are those of the outputs that it moves together. "
        if len(channels) > 1
        else "All singular values of plant and controller. "
    )  # fmt: skip
    poles, zeros = (_list(p) for p in (loop.resonances_hz, loop.antiresonances_hz))
    up, down = (" (▲)", " (▼)") if len(channels) < 2 else ("", "")
    words = f"{what}Resonances{up} of the plant: {poles}; anti-resonances{down}: {zeros}."
    gain = float(np.linalg.norm(loop.controller[0], 2))
    K = np.linalg.norm(loop.controller, 2, axis=(1, 2))
    i = int(K.argmax())
    words += (
        f" The controller's gain is {number(gain, 3)} N/m at {number(float(loop.hz[0]), 3)} Hz and "
        f"at most {number(float(K[i]), 3)} N/m, at {number(float(loop.hz[i]), 4)} Hz."
    )
    below = [hz for hz in loop.antiresonances_hz if hz > loop.bandwidth_hz]
    if below:
        ratio = loop.bandwidth_hz / below[0]
        words += f" The bandwidth is {100.0 * ratio:.0f} % of the first anti-resonance above it."
    return words


def _table(loop: LoopView) -> Table:
    """Magnitudes, and phases of a scalar loop, at some frequencies."""
    special = [*loop.resonances_hz, *loop.antiresonances_hz, loop.bandwidth_hz]
    if loop.plant.shape[1:] == (1, 1):
        head: tuple[str, ...] = ("Hz", "|G| m/N", "phase deg", "|K| N/m", "phase deg")
        G, K = np.abs(loop.plant[:, 0, 0]), np.abs(loop.controller[:, 0, 0])
        phases = [phase_deg(part[:, 0, 0]) for part in (loop.plant, loop.controller)]
        columns = [G, phases[0], K, phases[1]]
    else:
        G, K = _singular_values(loop.plant), _singular_values(loop.controller)
        head = (
            "Hz",
            *(f"σ{i + 1}(G) m/N" for i in range(G.shape[1])),
            *(f"σ{i + 1}(K) N/m" for i in range(K.shape[1])),
        )
        columns = [*G.T, *K.T]
    return over_frequency(head, loop.hz, *columns, special=special)


def _singular_values(response: NDArray[np.complex128]) -> Array:
    return np.asarray(np.linalg.svd(response, compute_uv=False), dtype=float)


def _list(places: Sequence[float]) -> str:
    if not places:
        return "none"
    shown = ", ".join(number(hz, 4) for hz in places[:12])
    return f"{shown}{' …' if len(places) > 12 else ''} Hz"
