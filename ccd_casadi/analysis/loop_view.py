"""One controller on its plants over frequency: what pages and the explorer draw of a loop."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import (
    frequency_grid,
    local_maxima,
    refine_peak,
    resonant,
    responses_of,
    root_flanks,
    sigma_max,
    thinned,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import ClassicalMargins, least_margins

POINTS = 500  # of the frequency grid, besides those around lightly damped poles and zeros
# In half widths of a resonance, in even steps of its phase: its circle in a Nyquist plot is round.
FLANKS = np.tan(np.radians(np.linspace(-86.0, 86.0, 27)))
END = 0.98  # of half the sampling rate
SAME = 1e-9  # relative distance of two frequencies below which they are one
FINE = 0.1  # of the least damping ratio: width of what one frequency of the other plants stands for
NAMES = ("S", "KS", "T")


@dataclass(frozen=True)
class Bounded:
    """What a loop has to keep: S_max, S_low up to `low_hz`, and bounds of S, KS, T over Hz.

    `over` gives (3, k) at frequencies (k,), NaN where nothing is asked; `words` say what they are;
    `compliance_max` (m/N) is for GS. `asked`: the case asks for them; else they are what came out.
    """

    S_max: float
    S_low: float
    low_hz: float
    over: Callable[[Array], Array]
    words: tuple[str, str, str]
    compliance_max: float | None = None
    asked: bool = True


@dataclass(frozen=True)
class LoopView:
    """σ_max of S, KS (N/m), T and GS (m/N) of every plant, the model first, (4, P, k) over Hz.

    G (k, p, m), K (k, m, p) as they run and `peaks`, local maxima of σ_max(S) above 1 as
    (Hz, gain), are the model's; `open` is L = GK of every plant (P, k, p, p), of several channels
    of the model alone. `bounds` (3, k) of S, KS, T: NaN where nothing is asked.
    """

    label: str
    loops: tuple[Loop, ...]
    hz: Array
    plant: np.ndarray
    controller: np.ndarray
    sizes: Array
    open: np.ndarray
    bounds: Array
    bounded: Bounded
    bandwidth_hz: float
    peaks: tuple[tuple[float, float], ...]
    resonances_hz: tuple[float, ...]
    antiresonances_hz: tuple[float, ...]

    @property
    def loop(self) -> Loop:
        """The model's."""
        return self.loops[0]

    @property
    def gains(self) -> Array:
        """σ_max of S, KS and T (3, k) on the model."""
        return self.sizes[:3, 0]

    @property
    def scalar(self) -> bool:
        """Whether the loop has one channel."""
        return self.plant.shape[1:] == (1, 1)

    @property
    def ends(self) -> tuple[float, float]:
        """The least and the largest frequency, Hz."""
        return float(self.hz[0]), float(self.hz[-1])

    def named(self, name: str) -> str:
        """`|S|`, or of several channels the largest singular value."""
        return f"|{name}|" if self.scalar else f"σ_max({name})"

    @cached_property
    def margins(self) -> ClassicalMargins:
        """The least on the model, of its loops broken one at a time at the plant's inputs."""
        return least_margins(self.loop.responses, HZ * self.hz)

    @cached_property
    def shares(self) -> Array:
        """The largest gain of any plant over its bound (3, k); γ/|W| bounds the model's alone."""
        sizes = self.sizes[:3].max(axis=1) if self.bounded.asked else self.gains
        return np.asarray(sizes / self.bounds)


def loop_view(
    loops: Sequence[Loop],
    bounded: Bounded,
    *,
    bandwidth_hz: float,
    label: str = "",
    points: int = POINTS,
    peaks: tuple[tuple[float, float], ...] | None = None,
) -> LoopView:
    """The loops of one controller on plants in SI, the model first, on one grid.

    It reaches from below ω_low and ω_b to beyond the modes, of a sampled loop to half its rate,
    and is fine around light poles and zeros of every plant and of K, with `peaks`: local maxima of
    σ_max(S) on the model that are known; by default they are searched.
    """
    model = loops[0]
    poles, zeros = (_hz(of) for of in (model.plant.poles, model.plant.zeros(_unit(model))))
    found = peaks_of(model) if peaks is None else peaks
    tops = [hz for hz, gain in found if gain > 1.05]
    low = min(bounded.low_hz, bandwidth_hz / 10.0) / 5.0
    high = max([20.0 * bandwidth_hz, *(3.0 * hz for hz in (*poles[:12], *tops))])
    if model.sampling is not None:
        high = END * 0.5 / model.sampling.period
    light = (model.plant.poles, model.controller.rates, model.plant.zeros(_unit(model)))
    near = root_flanks(np.concatenate([resonant(roots) for roots in light]), FLANKS) / HZ
    worst = [max(peaks_of(loop), key=lambda peak: peak[1], default=(bandwidth_hz, 0.0))[0]
             for loop in loops[1:]]  # fmt: skip
    places = np.array([*poles, *zeros, bandwidth_hz, *(hz for hz, _ in found), *worst])
    others = _of_others([resonant(loop.plant.poles) for loop in loops[1:]])
    hz = frequency_grid(low, high, points, near, places, others, apart=SAME)
    G, K = model.responses(HZ * hz)
    sizes, opened = np.empty((1 + len(NAMES), len(loops), len(hz))), []
    for i, loop in enumerate(loops):  # of one plant at a time: responses are large
        pair = loop.responses(HZ * hz) if i else (G, K)
        made = responses_of(*pair)
        sizes[:, i] = [sigma_max(made[name]) for name in (*NAMES, "GS")]
        if i == 0 or made["S"].shape[1:] == (1, 1):
            opened.append(pair[0] @ pair[1])
    return LoopView(
        label, tuple(loops), hz, G, K, sizes, np.array(opened), np.asarray(bounded.over(hz)),
        bounded, bandwidth_hz, found, poles, zeros,
    )  # fmt: skip


def _of_others(roots: Sequence[np.ndarray]) -> Array:
    """Frequencies in Hz on the flanks of resonances of plants that are much alike: one of those
    that differ by a tenth of a half width."""
    every = np.concatenate([*roots, np.empty(0, complex)])
    least = np.min(np.abs(every.real / every), initial=1.0)
    return thinned(root_flanks(every, FLANKS) / HZ, max(FINE * float(least), SAME))


def peaks_of(loop: Loop) -> tuple[tuple[float, float], ...]:
    """Local maxima of σ_max(S) above 1 as (Hz, gain), ascending."""

    def gain(omega: Array) -> Array:
        return sigma_max(loop.sensitivity(omega))

    grid = loop.grid()
    values = gain(grid)
    tops = [i for i in local_maxima(values) if values[i] > 1.0]
    found = [refine_peak(lambda w: float(gain(np.array([w]))[0]), grid[i - 1], grid[i + 1])
             for i in tops]  # fmt: skip
    return tuple((omega / HZ, height) for omega, height in found)


def _unit(loop: Loop) -> float:
    return float(np.abs(loop.plant.poles).max())


def _hz(roots: np.ndarray) -> tuple[float, ...]:
    """Frequencies in Hz of lightly damped pairs, ascending."""
    return tuple(float(value) for value in np.abs(resonant(roots)) / HZ)


def frequency_and_damping(poles: np.ndarray) -> tuple[Array, Array]:
    """|p| and -Re p/|p|, a conjugate pair once, in rising order."""
    upper = poles[poles.imag >= 0.0]
    upper = upper[np.argsort(np.abs(upper))]
    size = np.abs(upper)
    return size, -upper.real / np.maximum(size, np.finfo(float).tiny)


def phase_deg(response: np.ndarray) -> Array:
    """Without jumps along the first axis, from within ±180° on."""
    phase = np.degrees(np.unwrap(np.angle(response), axis=0))
    return phase - 360.0 * np.round(phase[0] / 360.0)
