"""Which way the phase of a response runs: a causal stable plant's falls, its conjugate's rises.

G = G₀ · allpass with G₀ of least phase by |G| (Bode) and an allpass whose phase falls, of zeros in
the right half plane and delay. Each unstable pole lets the angle rise by half a turn above that
of G₀. In conj(G), written with e^{-jωt}, all poles are unstable and delay is a lead.

At a light resonance G ~ (a + bω + cω²)/(ω - p) locally with Im p > 0 for a stable pole, whatever
zeros and delay there are.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq

from ccd_casadi.plants.response_table import least_phase
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class DirectionOptions:
    """Numbers of the direction of a phase.

    Attributes
    ----------
    places : int
        Points over ln f at which the phase is compared with the least one.
    lasting : int
        Of these, how many a rise of the difference must last, and what is before it: both turn
        sharply at a resonance.
    compared : int
        The same, where the rise of the conjugate is compared.
    unclear : float
        Angle in rad between two lines beyond which its sign is not known.
    coarse : float
        Angle beyond which a rise may be one of too few lines.
    beside : tuple of int
        Lines on either side of a peak to which a pole is fitted.
    rounds : int
        Of the weights of such a fit.
    misfit : float
        Of it, relative, at most.
    sure : float
        Standard deviations that Im p is away from 0 at least.
    away : float
        Largest distance of Re p from the peak, over the width of its lines.
    risen : float
        Half turns by which the angle rises beside those of unstable poles, from which it counts.
    turned : float
        The same without unstable poles, where that of the conjugate is small.
    as_much : float
        Share of it up to which the conjugate's is small.
    """

    places: int = 200
    lasting: int = 20
    compared: int = 10
    unclear: float = 2.0
    coarse: float = 1.0
    beside: tuple[int, ...] = (4, 8, 16)
    rounds: int = 4
    misfit: float = 0.1
    sure: float = 6.0
    away: float = 0.5
    risen: float = 0.6
    turned: float = 0.4
    as_much: float = 0.5


@dataclass(frozen=True)
class Rise:
    """The rise of an angle above that of a stable G of this size.

    `half_turns`, from and to Hz, and the first and last Hz between which lines in it are too far
    apart to show which way it turns: NaN where none are.
    """

    half_turns: float
    first: float
    last: float
    coarse_first: float = np.nan
    coarse_last: float = np.nan


def rise_of(hz: Array, F: np.ndarray, options: DirectionOptions = DirectionOptions()) -> Rise:
    """Find the largest lasting rise of the angle of F (k,), G of one channel or det G, above its
    least.
    """
    if not F.all():
        return Rise(0.0, np.nan, np.nan)
    places, turns, angle, least = _follow(hz, F, options)
    found, first, last = _largest_rise(angle - least, options.lasting)
    low, high = (float(at) for at in np.exp(places[[first, last]]))
    apart = (np.abs(turns) > options.coarse) & (hz[1:] >= low) & (hz[:-1] <= high)
    pairs = np.flatnonzero(apart)
    ends = (float(hz[pairs[0]]), float(hz[pairs[-1] + 1])) if len(pairs) else (np.nan, np.nan)
    return Rise(found, low, high, *ends)


def _follow(
    hz: Array, F: np.ndarray, options: DirectionOptions
) -> tuple[Array, Array, Array, Array]:
    """Places over ln f, the turns from line to line, and at the places the angle and the least."""
    x = np.log(hz)
    places = np.linspace(x[0], x[-1], options.places)
    turns = np.angle(F[1:] / F[:-1])
    followed = np.append(0.0, np.cumsum(_sharp_fall(turns, options)))
    least = least_phase(np.log(np.abs(F)), x, places)
    return places, turns, np.interp(places, x, followed), least


def _sharp_fall(turns: Array, options: DirectionOptions) -> Array:
    """Count every turn that is unclear as a fall."""
    return np.where(np.abs(turns) > options.unclear, -np.abs(turns), turns)


def _largest_rise(above: Array, lasting: int) -> tuple[float, int, int]:
    """Find the largest rise in half turns, and the places from which and at which it is reached."""
    windows = np.lib.stride_tricks.sliding_window_view(above, lasting)
    before, after = windows.max(axis=1), windows.min(axis=1)
    rises = after[lasting:] - np.minimum.accumulate(before)[:-lasting]
    j = int(rises.argmax())
    i = int(before[: j + 1].argmin())
    return max(0.0, float(rises[j]) / np.pi), i + lasting - 1, j + lasting


def poles_at_peaks(
    hz: Array, G: np.ndarray, peaks: np.ndarray, options: DirectionOptions = DirectionOptions()
) -> Iterator[tuple[float, bool]]:
    """The resonances whose direction the lines show: Hz, and whether the phase rises there, as at a
    pole in the right half plane. G is (k, p, m), `peaks` the lines of the peaks of |G|.
    """
    for peak in peaks.tolist():
        entry = np.unravel_index(np.abs(G[peak]).argmax(), G[peak].shape)
        fits = [_fit(hz, G[(slice(None), *entry)], peak, many, options)
                for many in options.beside]  # fmt: skip
        good = [fit for fit in fits if fit is not None]
        if good:
            yield float(hz[peak]), min(good)[1] < 0.0


def _fit(
    hz: Array, G: np.ndarray, peak: int, many: int, options: DirectionOptions
) -> tuple[float, float] | None:
    """Misfit and Im p of the pole at a peak; None where it is not sure."""
    used = slice(max(0, peak - many), peak + many + 1)
    lines = hz[used]
    if len(lines) <= 2 * options.beside[0]:
        return None
    x, g = (lines - hz[peak]) / (lines[-1] - lines[0]), G[used] / np.abs(G[peak])
    M = np.stack([np.ones_like(x), x, x * x, g], axis=1)
    weight = np.ones_like(x)
    for _ in range(options.rounds):
        found = lstsq(M * weight[:, None], g * x * weight)[0]
        p = complex(found[3])
        used_weight, weight = weight, 1.0 / np.maximum(np.abs(x - p), np.finfo(float).eps)
    A = M * used_weight[:, None]
    left = A @ found - g * x * used_weight
    variance = float(np.vdot(left, left).real) / (2 * (len(x) - M.shape[1]))
    scatter = np.sqrt(variance * np.linalg.pinv(A.conj().T @ A)[3, 3].real)
    misfit = float(np.linalg.norm((M[:, :3] @ found[:3]) * weight - g * (x - p) * weight)
                   / np.linalg.norm(g))  # fmt: skip
    fits = misfit < options.misfit and abs(p.real) < options.away
    return (misfit, p.imag) if fits and abs(p.imag) > options.sure * scatter else None


def turned_words(
    hz: Array, G: np.ndarray, peaks: np.ndarray, unstable_poles: int,
    options: DirectionOptions = DirectionOptions(),
) -> str:  # fmt: skip
    """Where the phase of a response rises as of no stable causal plant, in words; empty where it
    does not.

    G is (k, p, m), `peaks` the lines of the peaks of |G|, the unstable poles those that are stated.
    """
    found = list(poles_at_peaks(hz, G, peaks, options))
    rising = sorted(at for at, rises in found if rises)
    falling = len(found) - len(rising)
    if len(rising) > falling and 2 * len(rising) > unstable_poles:
        if len(rising) > 1:
            return f"through {len(rising)} resonances, the first at {rising[0]:.4g} Hz"
        return f"through the resonance at {rising[0]:.4g} Hz"
    if falling or G.shape[1] != G.shape[2]:
        return ""
    F = np.linalg.det(G)
    if not F.all():
        return ""
    places, turns, angle, least = _follow(hz, F, options)
    turned = np.interp(places, np.log(hz), np.append(0.0, np.cumsum(_sharp_fall(-turns, options))))
    own, first, last = _largest_rise(angle - least, options.compared)
    allowed = unstable_poles + options.risen if unstable_poles else options.turned
    if own <= allowed or (
        _largest_rise(turned - least, options.compared)[0] > options.as_much * own
    ):
        return ""
    low, high = np.exp(places[[first, last]])
    return (
        f"by {180.0 * own:.0f} deg from {low:.4g} to {high:.4g} Hz beside that of a stable plant "
        "of its size"
    )
