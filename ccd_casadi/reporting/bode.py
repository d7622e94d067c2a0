"""Bode plots of plant and controller, resonances and anti-resonances marked."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.reporting.lines import Curve, Level, Mark, Panel, figure_lines
from ccd_casadi.reporting.loops import shown_rows
from ccd_casadi.reporting.page import Table, number
from ccd_casadi.reporting.svg import BLACK, BLUE, ORANGE
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.loop_responses import Loop

MOST_MARKS = 8  # resonances, and as many anti-resonances, marked in the plot


def figure_bode(loop: Loop, *, key: str = "bode") -> str:
    """Plant and controller: magnitude and phase, or all singular values where there are several."""
    scalar = loop.plant.shape[1:] == (1, 1)
    G, K = _singular_values(loop.plant), _singular_values(loop.controller)
    x_range = (float(loop.hz[0]), float(loop.hz[-1]))
    top = [
        Panel(
            "frequency (Hz)",
            f"plant {'|G|' if scalar else 'σ(G)'} (m/N)",
            tuple(Curve(loop.hz, G[:, i]) for i in range(G.shape[1])),
            marks=tuple(_marks(loop, G)),
            log_x=True,
            log_y=True,
            x_range=x_range,
            y_range=(float(G.min()) / 10.0, float(G.max()) * 10.0),  # room for the marks' words
        ),
        Panel(
            "frequency (Hz)",
            f"controller {'|K|' if scalar else 'σ(K)'} (N/m)",
            tuple(Curve(loop.hz, K[:, i], colour=ORANGE) for i in range(K.shape[1])),
            levels=(Level(loop.bandwidth_hz, f"ω_b {number(loop.bandwidth_hz, 4)} Hz", True),),
            log_x=True,
            log_y=True,
            x_range=x_range,
        ),
    ]
    title = "Bode plot of the plant and the controller"
    if not scalar:
        return figure_lines([top], key=key, title=title, heights=(3.4,))
    phases = [
        Panel(
            "frequency (Hz)",
            f"phase of {name} (deg)",
            (Curve(loop.hz, _phase(part), colour=colour),),
            log_x=True,
            x_range=x_range,
            y_step=90.0,
        )
        for name, part, colour in (("G", loop.plant, BLUE), ("K", loop.controller, ORANGE))
    ]
    return figure_lines([top, phases], key=key, title=title, heights=(3.0, 2.1))


def _marks(loop: Loop, gains: Array) -> list[Mark]:
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


def caption_bode(loop: Loop) -> str:
    """What to see in the Bode plot of one design."""
    scalar = loop.plant.shape[1:] == (1, 1)
    what = "" if scalar else "All singular values of plant and controller. "
    poles, zeros = (_list(p) for p in (loop.resonances_hz, loop.antiresonances_hz))
    words = f"{what}Resonances (▲) of the plant: {poles}; anti-resonances (▼): {zeros}."
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


def table_bode(loop: Loop) -> Table:
    """Magnitudes, and phases of a scalar loop, at some frequencies."""
    rows = shown_rows(loop.hz, [*loop.resonances_hz, *loop.antiresonances_hz, loop.bandwidth_hz])
    if loop.plant.shape[1:] == (1, 1):
        head: tuple[str, ...] = ("Hz", "|G| m/N", "phase deg", "|K| N/m", "phase deg")
        G, K = np.abs(loop.plant[:, 0, 0]), np.abs(loop.controller[:, 0, 0])
        columns = [loop.hz, G, _phase(loop.plant), K, _phase(loop.controller)]
    else:
        G, K = _singular_values(loop.plant), _singular_values(loop.controller)
        head = (
            "Hz",
            *(f"σ{i + 1}(G) m/N" for i in range(G.shape[1])),
            *(f"σ{i + 1}(K) N/m" for i in range(K.shape[1])),
        )
        columns = [loop.hz, *G.T, *K.T]
    return Table(head, tuple(tuple(float(c[i]) for c in columns) for i in rows))


def _singular_values(response: NDArray[np.complex128]) -> Array:
    return np.asarray(np.linalg.svd(response, compute_uv=False), dtype=float)


def _phase(response: NDArray[np.complex128]) -> Array:
    phase = np.degrees(np.unwrap(np.angle(response[:, 0, 0])))
    return phase - 360.0 * np.round(phase[0] / 360.0)


def _list(places: Sequence[float]) -> str:
    if not places:
        return "none"
    shown = ", ".join(number(hz, 4) for hz in places[:12])
    return f"{shown}{' …' if len(places) > 12 else ''} Hz"
