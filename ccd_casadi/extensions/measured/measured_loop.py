"""A controller judged on the lines of a measured response.

Bounds are held on every line, with a spread Δ for every plant within it: there

    σ_max(S) <= σ_max(S₀)/ρ,   ρ = 1 - σ_max(K S₀) ‖Δ‖,

for (I + (G + E) K)⁻¹ = S₀ (I + E K S₀)⁻¹ and |E| <= Δ entry by entry. While ρ > 0 the winding is
that of G. Of one channel 1/|S| >= |1 + GK| - |K| Δ. Between two lines see `between_lines`.

Stability is the winding of F = det(I + GK). Over all ω > 0 its angle grows by

    Δ = (π/2)(q + 2P - 2Z)

with Z poles of the closed loop and P of GK in the right half plane, and q of GK at 0. P is given.
The angle below the first line is that of the known K and of a G that is taken to go on as its first
lines rise, R (jω)^-n: stable poles far below, where |GK| >> 1, count as poles at 0. Above the last
line |GK| is taken to stay below 1. What of this the data can show is examined: `sure`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from ccd_casadi.extensions.measured.between_lines import bound_between_lines, gap_of, hidden_damping
from ccd_casadi.fixed_structure.bounds import Bounds, LoopPeaks, ShapeEnd
from ccd_casadi.kernels.sections import HALF_POWER
from ccd_casadi.lti.loop import tustin
from ccd_casadi.lti.state_space import StateSpace, responses_of, sensitivity, sigma_max
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.plants.phase_direction import DirectionOptions
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class WindingOptions:
    """Limits beyond which the data leave the winding in doubt."""

    gap: float = 0.25 * np.pi  # rad: of G's angle at the first line to its asymptote
    large: float = 2.0  # |L| at the first line at least
    small: float = 0.5  # |L| at the last line at most
    risen: float = DirectionOptions.risen  # half turns beside those of unstable poles
    hidden: float = 0.05  # |GK| beside a resonance between lines, where it may reach 1


@dataclass(frozen=True)
class MeasuredFigures(LoopPeaks):
    """A loop on its lines; NaN where it is not stable.

    `right_half_plane`: Z. `sure`: whether the
    assumptions that the data can show hold. `S_between` bounds |S| on and between the lines by r,
    infinite where I + L may be singular on the curve, and `S_between_frequency` (rad/s) is where it
    is largest; `bandwidth` is the largest that the shape allows on the lines.
    """

    stable: bool
    sure: bool
    right_half_plane: int
    words: str
    S_between: float = np.nan
    S_between_frequency: float = np.nan


def controller_response(K: StateSpace, hz: Array, period: float | None = None) -> np.ndarray:
    """Evaluate a continuous controller (k, m, p) on lines in Hz; with a period in s by Tustin's
    rule, without prewarping.
    """
    runs = K if period is None else tustin(K, period)
    return runs.response(HZ * np.asarray(hz, float))


def judge(
    measured: MeasuredResponse | Sequence[MeasuredResponse],
    K: StateSpace,
    bounds: Bounds,
    *,
    period: float | None = None,
    integrator: bool = True,
) -> MeasuredFigures:
    """The figures of an SI controller (e in, u out) on the lines; of several responses the worst.

    `period` in s: K is sampled, and G was measured as the controller sees it, hold and delay in it.
    `integrator` of K: then the shape counts from 0 on, else from ω_low.
    """
    if not isinstance(measured, MeasuredResponse):
        return _worst([judge(one, K, bounds, period=period, integrator=integrator)
                       for one in measured])  # fmt: skip
    if period is not None and measured.hz[-1] > 0.5 / period:
        raise UserError("the lines reach beyond half the sampling rate; drop those above")
    whole, hz, G = measured.followed, measured.hz, measured.matrix
    k = controller_response(K, whole.hz, period)
    joint = whole.G @ k
    Z, doubts = winding(measured, joint, int(integrator))
    first = len(whole.hz) - len(hz)
    reach = bound_between_lines(measured, joint[first:], k[first:])
    if not measured.modelled and not np.isfinite(reach).all():
        pairs = np.flatnonzero(np.isinf(reach))
        doubts.append(f"between {len(pairs)} pairs of lines GK may pass -1, the first "
                      f"{gap_of(hz, pairs[0])}: measure more lines there")  # fmt: skip
    assumption = _hidden(measured, joint[first:], k[first:], doubts)
    head = "stable" if Z == 0 else f"unstable, {Z} poles in the right half plane"
    of = "1 + GK" if len(G[0]) == 1 else "det(I + GK)"
    as_low = f"as (jω)^-{measured.slope}" if measured.slope else "constant"
    assumed = (
        f"{head} by the winding of {of}, with {measured.unstable_poles} unstable poles of G, and G "
        f"{as_low} below {hz[0]:.4g} Hz and |GK| < 1 above {hz[-1]:.4g} Hz; {assumption}"
    )
    words, sure = "; ".join([assumed, *doubts]), measured.modelled or not doubts
    if Z != 0:
        return MeasuredFigures(False, sure, Z, words)
    omega, low = HZ * hz, bounds.omega_low / HZ
    size = {name: sigma_max(M) for name, M in responses_of(G, k[first:]).items()}
    room = 1.0 - size["KS"] * measured.unsure
    if room.min() < 1.0:
        words += "; every bound on S is that of all plants within the spread"
    with np.errstate(divide="ignore"):
        size["S"] = np.where(room > 0.0, size["S"] / np.maximum(room, 0.0), np.inf)
    most = {name: float(size[name].max()) for name in ("KS", "T", "GS")}
    if bounds.weights is not None:
        W = np.abs(bounds.weights.responses(omega))
        most["weighted_KS"] = float((W[1] * size["KS"]).max())
        most["weighted_T"] = float((W[2] * size["T"]).max())
    L_low = measured.at(low) @ controller_response(K, np.array([low]), period)
    return MeasuredFigures(
        stable=True,
        sure=sure,
        right_half_plane=0,
        words=words,
        S_peak=float(size["S"].max()),
        S_peak_frequency=float(omega[np.argmax(size["S"])]),
        S_between=float(reach.max()),
        S_between_frequency=float(
            np.sqrt(np.prod(omega[[worst := int(reach.argmax()), worst + 1]]))
        ),
        S_low=float(sigma_max(sensitivity(L_low))[0]),
        bandwidth=bandwidth_within(omega, np.log(size["S"]), bounds, integrator),
        **most,
    )


def _worst(each: Sequence[MeasuredFigures]) -> MeasuredFigures:
    if len(each) == 1:
        return each[0]
    words = "; ".join(f"response {i}: {one.words}" for i, one in enumerate(each, 1))
    stable, sure = all(one.stable for one in each), all(one.sure for one in each)
    unstable = max(one.right_half_plane for one in each)
    if not stable:
        return MeasuredFigures(False, sure, unstable, words)
    names = [*(field.name for field in fields(LoopPeaks)), "S_between"]
    # NumPy keeps a NaN, whatever the order: an unknown figure is not the smaller one.
    worst = {name: float(np.max([getattr(one, name) for one in each])) for name in names}
    worst["bandwidth"] = float(np.min([one.bandwidth for one in each]))
    worst["S_peak_frequency"] = max(each, key=lambda one: one.S_peak).S_peak_frequency
    most = max(each, key=lambda one: one.S_between)
    worst["S_between_frequency"] = most.S_between_frequency
    return MeasuredFigures(True, sure, unstable, words, **worst)


def _hidden(measured: MeasuredResponse, L: np.ndarray, k: np.ndarray, doubts: list[str]) -> str:
    """State what is assumed of a resonance between two lines; a doubt where the lines do not show
    it."""
    if measured.modelled:
        return "a model is behind the lines"
    hz, most, least = measured.hz, hidden_damping(measured, L, k), measured.least_damping
    open_ = np.flatnonzero(most > least)
    if len(open_):
        worst = int(most.argmax())
        doubts.append(
            f"a resonance of damping up to {most[worst]:.2g} may hide {gap_of(hz, worst)} and make "
            f"the loop unstable, and {len(open_)} pairs of lines from {hz[open_[0]]:.4g} to "
            f"{hz[open_[-1] + 1]:.4g} Hz do not exclude one of {least:g}: measure more lines there"
            ", or state the least damping of the plant (--least-damping, least_damping)"
        )  # fmt: skip
    return f"a resonance that hides between two lines has a damping of {least:g} at least"


def winding(
    measured: MeasuredResponse, L: np.ndarray, integrators: int = 0,
    options: WindingOptions = WindingOptions(),
) -> tuple[int, list[str]]:  # fmt: skip
    """Z of L = GK (k, p, p), with `integrators` of every channel of K, on the lines of
    `measured.followed`; and what the data leave open."""
    channels = L.shape[1]
    F = np.linalg.det(np.eye(channels) + L)
    q = (measured.slope + integrators) * channels
    begins = float(np.angle(F[0]))
    asymptotes = -0.5 * np.pi * q + np.pi * np.arange(-4 * channels, 4 * channels + 1)
    first = float(asymptotes[np.argmin(np.abs(begins - asymptotes))])
    grown = begins - first + float(_turns(measured, F).sum() - np.angle(F[-1]))
    Z = round(measured.unstable_poles + 0.5 * q - grown / np.pi)
    hz = measured.hz
    own = L[len(L) - len(hz) :]
    doubts = []
    if len(set(measured.undamped_hz)) < len(measured.undamped_hz):
        doubts.append("G has two undamped modes at one frequency")
    large = np.flatnonzero(np.linalg.norm(own, 2, axis=(1, 2)) > options.small)
    if not measured.modelled and len(large):
        seen = measured.rise(hz[large[-1]])
        if seen.half_turns > measured.unstable_poles + options.risen:
            words = f"the angle of G rises by {180.0 * seen.half_turns:.0f} deg "
            words += "more than that of a stable G of its size"
            apart = f"{seen.coarse_first:.4g} to {seen.coarse_last:.4g} Hz: measure there"
            doubts.append(
                f"{words}: state its unstable poles (--unstable-poles, unstable_poles)"
                if np.isnan(seen.coarse_first)
                else f"{words}, where lines are too far apart from {apart}"
            )
    if measured.gap > options.gap:
        doubts.append(f"at the first line, {hz[0]:.4g} Hz, the angle of G is not that of its slope")
    if q > 0 and np.linalg.norm(own[0], -2) < options.large:
        doubts.append(f"at the first line, {hz[0]:.4g} Hz, |GK| is not large: measure below it")
    if np.linalg.norm(own[-1], 2) > options.small:
        doubts.append(f"at the last line, {hz[-1]:.4g} Hz, |GK| is not small: measure above it")
    own = np.einsum("kii->ki", own)
    wide = np.diff(hz) > 2.0 * measured.least_damping * hz[1:]
    falls = (np.angle(own[1:] / own[:-1]) < -0.5 * np.pi) & wide[:, None]
    hidden = np.flatnonzero((falls & (np.abs(own[1:]) > options.hidden)).any(axis=1))
    if len(hidden):
        where = f"between {hz[hidden[0]]:.4g} and {hz[hidden[0] + 1]:.4g} Hz"
        doubts.append(f"{where} GK turns by more than 90 deg: a resonance narrower than the lines")
    return Z, doubts


def _turns(measured: MeasuredResponse, F: np.ndarray) -> Array:
    """Compute how far the angle of F (k,) grows from line to line.

    Past a pole on the axis F ~ a + b/(ω - ω₀): out along b, half a turn back (the contour passes
    right of the pole, which then counts as stable), and in again.
    """
    turns = np.angle(F[1:] / F[:-1])
    hz = measured.followed.hz
    for pole in measured.undamped_hz:
        i = int(np.searchsorted(hz, pole)) - 1
        if 0 <= i < len(turns):
            b = (F[i] - F[i + 1]) / (1.0 / (hz[i] - pole) - 1.0 / (hz[i + 1] - pole))
            turns[i] = np.angle(-b / F[i]) - np.pi + np.angle(F[i + 1] / b)
    return np.asarray(turns)


def bandwidth_within(omega: Array, ln_S: Array, bounds: Bounds, integrator: bool) -> float:
    """Find the largest ω_b with |S| <= 1/√2 on the lines below it and |S| within the shape.

    `omega` is in rad/s, `ln_S` ln σ_max(S) there. The shape counts from 0 on with an integrator,
    else from ω_low. It is 0 where |S| > 1/√2 on the first line.
    """
    level = -HALF_POWER
    above = np.flatnonzero(ln_S > level)
    crossing = float(omega[-1])
    if len(above):
        i = int(above[0])
        if i == 0:
            return 0.0
        share = (level - ln_S[i - 1]) / (ln_S[i] - ln_S[i - 1])
        crossing = float(np.exp(np.log(omega[i - 1]) + share * np.log(omega[i] / omega[i - 1])))
    if bounds.shape is None:
        return crossing
    counted = omega if integrator else np.maximum(omega, bounds.omega_low)
    allowed = counted / bounds.reached(np.exp(ln_S - level))
    if bounds.shape_ends is ShapeEnd.CROSSING:
        allowed = allowed[omega <= crossing]
    return float(min(crossing, allowed.min()))
