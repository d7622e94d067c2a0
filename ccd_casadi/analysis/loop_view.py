"""One controller on its plants over frequency: what pages and the explorer draw of a loop."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ccd_casadi.lti.frequency_grid import (
    frequency_grid,
    local_maxima,
    refine_peak,
    resonant,
    root_flanks,
    thin,
)
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import responses_of, sigma_max
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import ClassicalMargins, least_margins

NAMES = ("S", "KS", "T")


@dataclass(frozen=True)
class ViewOptions:
    """Numbers of the frequency grid of a view."""

    points: int = 500  # besides those around lightly damped poles and zeros
    rate_share: float = 0.98  # of half the sampling rate, where it ends
    same: float = 1e-9  # relative distance of two frequencies below which they are one
    other_plants: float = 0.1  # of their least damping ratio: how far apart frequencies are

    @property
    def flanks(self) -> Array:
        """Places in half widths of a resonance, in even steps of its phase: its circle in a Nyquist
        plot is round."""
        return np.asarray(np.tan(np.radians(np.linspace(-86.0, 86.0, 27))))


@dataclass(frozen=True)
class Bounded:
    """The bounds that a loop has to keep.

    Attributes
    ----------
    S_max, S_low, low_hz : float
        Of |S| everywhere, and up to a frequency in Hz.
    over : function of (k,) array
        Bounds of S, KS, T (3, k) at frequencies in Hz; NaN where there is none.
    words : tuple of str
        What these bounds are.
    compliance_max : float or None
        Of |GS|, m/N.
    asked : bool
        Whether the case has these bounds; else they are what was reached.
    """

    S_max: float
    S_low: float
    low_hz: float
    over: Callable[[Array], Array]
    words: tuple[str, str, str]
    compliance_max: float | None = None
    required: bool = True


@dataclass(frozen=True)
class LoopView:
    """One controller on P plants over frequency, the model first.

    Attributes
    ----------
    label : str
        Of the controller.
    loops : tuple of Loop
        SI.
    hz : (k,) array
        Hz.
    plant, controller : (k, p, m), (k, m, p) array
        G and K of the model, as they run.
    sizes : (4, P, k) array
        σ_max of S, KS (N/m), T and GS (m/N).
    open : (P, k, p, p) array
        L = GK; of several channels of the model alone.
    bounds : (3, k) array
        Of S, KS, T; NaN where there is none.
    bounded, bandwidth_hz : Bounded, float
        What the loop has to keep, and ω_b in Hz.
    peaks : tuple of (Hz, gain)
        Local maxima of σ_max(S) above 1 on the model.
    resonances_hz, antiresonances_hz : tuple of float
        Of the model, Hz.
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
        """The loop of the model."""
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

    def name_gain(self, name: str) -> str:
        """`|S|`, or of several channels the largest singular value."""
        return f"|{name}|" if self.scalar else f"σ_max({name})"

    @cached_property
    def margins(self) -> ClassicalMargins:
        """The least on the model, of its loops broken one at a time at the plant's inputs."""
        return least_margins(self.loop.responses, HZ * self.hz)

    @cached_property
    def shares(self) -> Array:
        """The largest gain of any plant over its bound (3, k); γ/|W| bounds the model's alone."""
        sizes = self.sizes[:3].max(axis=1) if self.bounded.required else self.gains
        return np.asarray(sizes / self.bounds)


def loop_view(
    loops: Sequence[Loop],
    bounded: Bounded,
    *,
    bandwidth_hz: float,
    label: str = "",
    points: int | None = None,
    peaks: tuple[tuple[float, float], ...] | None = None,
    options: ViewOptions = ViewOptions(),
) -> LoopView:
    """Evaluate the loops of one controller on one frequency grid.

    It reaches from below ω_low and ω_b to beyond the modes, of a sampled loop to half its rate,
    and is fine around light poles and zeros of every plant and of K.

    Parameters
    ----------
    loops : sequence of Loop
        One for each plant, the model first, SI.
    bounded : Bounded
        What they have to keep.
    bandwidth_hz : float
        Hz.
    label : str
        Of the controller.
    points : int
        Of the grid; None: those of the options.
    peaks : tuple of (Hz, gain)
        Local maxima of σ_max(S) on the model; None: they are searched.
    options : ViewOptions
        Numbers of the method.

    Returns
    -------
    LoopView
        On the grid.
    """
    model, points = loops[0], options.points if points is None else points
    poles, zeros = (_hz(of) for of in (model.plant.poles, model.plant.zeros(_unit(model))))
    found = peaks_of(model) if peaks is None else peaks
    tops = [hz for hz, gain in found if gain > 1.05]
    low = min(bounded.low_hz, bandwidth_hz / 10.0) / 5.0
    high = max([20.0 * bandwidth_hz, *(3.0 * hz for hz in (*poles[:12], *tops))])
    if model.sampling is not None:
        high = options.rate_share * 0.5 / model.sampling.period
    light = (model.plant.poles, model.controller.rates, model.plant.zeros(_unit(model)))
    near = root_flanks(np.concatenate([resonant(roots) for roots in light]), options.flanks) / HZ
    worst = [max(peaks_of(loop), key=lambda peak: peak[1], default=(bandwidth_hz, 0.0))[0]
             for loop in loops[1:]]  # fmt: skip
    places = np.array([*poles, *zeros, bandwidth_hz, *(hz for hz, _ in found), *worst])
    others = _of_others([resonant(loop.plant.poles) for loop in loops[1:]], options)
    hz = frequency_grid(low, high, points, near, places, others, apart=options.same)
    G, K = model.responses(HZ * hz)
    sizes, opened = np.empty((1 + len(NAMES), len(loops), len(hz))), []
    for i, loop in enumerate(loops):  # of one plant at a time: responses are large
        pair = loop.responses(HZ * hz) if i else (G, K)
        made = loop.curves(HZ * hz) if loop.at or loop.ported else responses_of(*pair)
        sizes[:, i] = [sigma_max(made[name]) for name in (*NAMES, "GS")]
        if i == 0 or made["S"].shape[1:] == (1, 1):
            opened.append(pair[0] @ pair[1])
    return LoopView(
        label, tuple(loops), hz, G, K, sizes, np.array(opened), np.asarray(bounded.over(hz)),
        bounded, bandwidth_hz, found, poles, zeros,
    )  # fmt: skip


def _of_others(roots: Sequence[np.ndarray], options: ViewOptions) -> Array:
    """Frequencies in Hz on the flanks of resonances of plants that are much alike: one of those
    that differ by a tenth of a half width."""
    every = np.concatenate([*roots, np.empty(0, complex)])
    least = np.min(np.abs(every.real / every), initial=1.0)
    apart = max(options.other_plants * float(least), options.same)
    return thin(root_flanks(every, options.flanks) / HZ, apart)


def peaks_of(loop: Loop) -> tuple[tuple[float, float], ...]:
    """Local maxima of σ_max(S) above 1.

    Parameters
    ----------
    loop : Loop
        Closed.

    Returns
    -------
    tuple of (Hz, gain)
        Ascending.
    """

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
    """Natural frequency |p| and damping ratio -Re p/|p| of poles, a conjugate pair once.

    Parameters
    ----------
    poles : (n,) array
        rad/s.

    Returns
    -------
    frequency, damping : (k,) array
        rad/s, ascending, and ratios.
    """
    upper = poles[poles.imag >= 0.0]
    upper = upper[np.argsort(np.abs(upper))]
    size = np.abs(upper)
    return size, -upper.real / np.maximum(size, np.finfo(float).tiny)


def phase_deg(response: np.ndarray) -> Array:
    """The phase of a response, without jumps along the first axis, from within ±180° on.

    Parameters
    ----------
    response : (k, ...) array
        Complex.

    Returns
    -------
    (k, ...) array
        Degrees.
    """
    phase = np.degrees(np.unwrap(np.angle(response), axis=0))
    return phase - 360.0 * np.round(phase[0] / 360.0)
