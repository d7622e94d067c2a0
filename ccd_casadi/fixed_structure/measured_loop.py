"""A controller judged on the lines of a measured response.

Bounds are held on every line. Between two lines L = GK is taken to lie within r of the chord,

    r = 2 h²/8 max|L''|,   L'' by the second differences at both ends and one line further:

twice the error of linear interpolation, where L bends between two lines as around them. A
resonance that fits between two lines is not seen. Where measurements were repeated, their spread
Δ adds ‖Δ |K|‖ to r at the lines. With it σ_max(S) <= 1/(least σ_min(I + L) on the
chord less r); where L is large the same of L⁻¹ = (GK)⁻¹, which is nearly straight there.

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

from ccd_casadi.fixed_structure.bounds import Bounds, LoopPeaks, ShapeEnd
from ccd_casadi.kernels.sections import HALF_POWER
from ccd_casadi.lti.loop import tustin
from ccd_casadi.lti.state_space import StateSpace, responses_of, sensitivity, sigma_max
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class WindingOptions:
    """Limits beyond which the data leave the winding in doubt."""

    gap: float = 0.25 * np.pi  # rad: of G's angle at the first line to its asymptote
    large: float = 2.0  # |L| at the first line at least
    small: float = 0.5  # |L| at the last line at most
    risen: float = 0.6  # half turns of G's angle beside those of its unstable poles
    hidden: float = 0.05  # |GK| beside a resonance between lines, where it may reach 1


@dataclass(frozen=True)
class InterpolationErrorOptions:
    """Numbers of the error between two lines."""

    safety: float = 2.0  # factor on the error of linear interpolation
    deviations: float = 3.0  # standard deviations up to which a second difference may be noise
    strides: tuple[int, ...] = (2, 4, 8)  # lines, over which it is then taken
    window: int = 15  # lines, over which the noise is estimated
    places: int = 9  # on a chord


@dataclass(frozen=True)
class HiddenResonanceOptions:
    """Numbers of the search for resonances that fit between two lines."""

    safety: float = 2.0  # factor on the room that the lines leave for one
    fitted: int = 6  # lines that a parabola over a pole is fitted to
    near: float = 1.0  # over the distance of two lines: such a pole lies between them
    places: int = 5  # of a resonance between two lines


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
    """Evaluate a controller on lines.

    Parameters
    ----------
    K, hz : StateSpace, array (k,)
        Continuous; frequencies in Hz.
    period : float, optional
        s: K is discretised by Tustin's rule, without prewarping.

    Returns
    -------
    array (k, m, p)
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
    reach = between(measured, joint[first:], k[first:])
    if not np.isfinite(reach).all():
        pairs = np.flatnonzero(np.isinf(reach))
        doubts.append(f"between {len(pairs)} pairs of lines GK may pass -1, the first "
                      f"{_span(hz, pairs[0])}: measure more lines there")  # fmt: skip
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


def interpolation_errors(
    hz: Array, L: np.ndarray, options: InterpolationErrorOptions = InterpolationErrorOptions()
) -> Array:
    """r between neighbouring lines (k - 1,) of L (k, p, p), by second differences over ln f.

    Where those of neighbouring lines do not stand out of the noise, of lines further apart.
    """
    x = np.log(hz)
    noise = options.deviations * np.sqrt(6.0) * _noise(x, L, options.window)
    around = _curvature(x, L, 1)
    step = _half_width(x, 1)
    for stride in options.strides:
        if len(x) > 2 * stride and noise.max() > 0.0:
            wide = _curvature(x, L, stride) + noise / _half_width(x, stride) ** 2
            around = np.where(around * step**2 < noise, np.minimum(around, wide), around)
    wider = np.maximum(np.append(around[1:], 0.0), np.insert(around[:-1], 0, 0.0))
    each = np.maximum(around, wider)
    return np.asarray(options.safety * np.diff(x) ** 2 / 8.0 * np.maximum(each[:-1], each[1:]))


def _curvature(x: Array, L: np.ndarray, stride: int) -> Array:
    """σ_max of the second derivative at each line (k,), by lines that are `stride` apart."""
    a, b, c = x[: -2 * stride], x[stride:-stride], x[2 * stride :]
    rises = [(L[stride:][: len(a)] - L[: len(a)]) / (b - a)[:, None, None],
             (L[2 * stride :] - L[stride:-stride]) / (c - b)[:, None, None]]  # fmt: skip
    second = sigma_max(2.0 * (rises[1] - rises[0]) / (c - a)[:, None, None])
    return np.pad(second, stride, mode="edge")


def _half_width(x: Array, stride: int) -> Array:
    return np.pad(0.5 * (x[2 * stride :] - x[: -2 * stride]), stride, mode="edge")


def _noise(x: Array, L: np.ndarray, window: int) -> Array:
    """Standard deviation of the noise of L at each line (k,): its distance from the cubic through
    the two lines on each side, the median of those around."""
    if len(x) < window:
        return np.zeros(len(x))
    at, near = x[2:-2], [x[:-4], x[1:-3], x[3:-1], x[4:]]
    off = L[2:-2] + 0.0
    spread = np.ones(len(at))
    for i, own in enumerate((L[:-4], L[1:-3], L[3:-1], L[4:])):
        weight = np.prod([(at - other) / (near[i] - other)
                          for j, other in enumerate(near) if j != i], axis=0)  # fmt: skip
        off = off - weight[:, None, None] * own
        spread += weight**2
    size = np.pad(sigma_max(off) / np.sqrt(spread), 2, mode="edge")
    half = window // 2
    return np.median(np.lib.stride_tricks.sliding_window_view(
        np.pad(size, half, mode="reflect"), window), axis=1)  # fmt: skip


def hidden_damping(
    measured: MeasuredResponse, L: np.ndarray, k: np.ndarray,
    options: HiddenResonanceOptions = HiddenResonanceOptions(),
) -> Array:  # fmt: skip
    """The largest damping ratio with which a resonance between neighbouring lines (k - 1,) may make
    I + L singular and yet not show on them.

    It has to be H = σ_min(I + L)/σ_max(K) high at least, and on the lines around it is then
    q/(t - t₀) with q = H ζ/h, t counted in their distance h in ln f. G, its slope removed, leaves
    room for a q beside what it does else, by the smaller of two estimates. Where lines are closer
    than its width 2 ζ a resonance is not hidden either.
    """
    x = np.log(measured.hz)
    h, flat = np.diff(x), (measured.hz / measured.hz[0]) ** measured.slope
    G = measured.matrix * flat[:, None, None]
    slope = np.diff(G, axis=0) / h[:, None, None]
    around = 0.5 * (np.concatenate([slope[1:2], slope[:-1]])
                    + np.concatenate([slope[1:], slope[-2:-1]]))  # fmt: skip
    jump = np.pad(sigma_max(slope - around) * h, 2, mode="edge")
    room = np.lib.stride_tricks.sliding_window_view(jump, 5).max(axis=1) / 4.0
    room = np.minimum(room, _room_beside_a_pole(x, G.reshape(len(x), -1), options))
    eye, middle = np.eye(L.shape[1]), 0.5 * (L[1:] + L[:-1])
    ends, centre = (np.linalg.norm(eye + part, -2, axis=(1, 2)) for part in (L, middle))
    height = flat / sigma_max(k)
    height = np.minimum(height[1:], height[:-1])
    needed = np.minimum(centre, np.minimum(ends[1:], ends[:-1])) * height
    return np.minimum(h * room / needed, 0.5 * h)


def _room_beside_a_pole(x: Array, G: np.ndarray, options: HiddenResonanceOptions) -> Array:
    """The largest q between neighbouring lines (k - 1,) of x, if G (k, entries) is else a parabola
    over one pole on the lines around: how well that fits them over how badly it fits 1/(t - t₀).
    Infinite where that pole is itself a resonance narrower than the lines."""
    fitted, near = options.fitted, options.near
    if len(x) < fitted:
        return np.full(len(x) - 1, np.inf)
    every = np.arange(len(x) - 1)
    lines = np.clip(every - fitted // 2 + 1, 0, len(x) - fitted)[:, None] + np.arange(fitted)
    t = (x[lines] - 0.5 * (x[1:] + x[:-1])[:, None]) / np.diff(x)[:, None]
    room, inside = np.zeros(len(every)), np.linspace(-0.4, 0.4, options.places)
    for own in G.T:
        g = own[lines]
        basis = np.stack([t**0, t, t**2, -t * g], axis=-1)
        Q = np.linalg.qr(basis).Q

        def beside(v: np.ndarray, Q: np.ndarray = Q) -> np.ndarray:
            return np.asarray(v - (Q @ (Q.conj().swapaxes(1, 2) @ v[..., None]))[..., 0])

        pole = (np.linalg.pinv(basis) @ g[..., None])[:, 3]
        left = np.linalg.norm(beside(g), axis=1)
        tails = [np.linalg.norm(beside((1.0 + pole * t) / (t - at)), axis=1) for at in inside]
        room += (options.safety * left / np.min(tails, axis=0)) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            at = -1.0 / pole[:, 0]
        room[(np.abs(at.real) < near) & (np.abs(at.imag) < near)] = np.inf
    return np.sqrt(room)


def _span(hz: Array, i: int) -> str:
    return f"between {hz[i]:.4g} and {hz[i + 1]:.4g} Hz"


def _hidden(measured: MeasuredResponse, L: np.ndarray, k: np.ndarray, doubts: list[str]) -> str:
    """What of a resonance between two lines is assumed; a doubt where the lines do not show it."""
    if measured.modelled:
        return "a model is behind the lines"
    hz, most, least = measured.hz, hidden_damping(measured, L, k), measured.least_damping
    open_ = np.flatnonzero(most > least)
    if len(open_):
        worst = int(most.argmax())
        doubts.append(
            f"a resonance of damping up to {most[worst]:.2g} may hide {_span(hz, worst)} and make "
            f"the loop unstable, and {len(open_)} pairs of lines from {hz[open_[0]]:.4g} to "
            f"{hz[open_[-1] + 1]:.4g} Hz do not exclude one of {least:g}: measure more lines there"
            ", or state the least damping of the plant (--least-damping, least_damping)"
        )  # fmt: skip
    return f"no resonance of less damping than {least:g} hides between two lines"


def between(measured: MeasuredResponse, L: np.ndarray, k: np.ndarray) -> Array:
    """Bound σ_max(S) between neighbouring lines.

    By L, or where it is large and its inverse the smoother by S = L⁻¹ (I + L⁻¹)⁻¹.
    L = GK at each line is known within u = ‖Δ |K|‖, so L⁻¹ within ‖L⁻¹‖²u/(1 - ‖L⁻¹‖u).

    Parameters
    ----------
    measured, L, k : MeasuredResponse, array (k, p, p), array (k, m, p)
        GK and K on its lines.

    Returns
    -------
    array (k - 1,)
        Infinite where I + L may be singular.
    """
    hz, over, unsure = measured.hz, np.linalg.inv(L), np.zeros(len(L))
    if measured.spread is not None:
        unsure = sigma_max(measured.spread.reshape(measured.matrix.shape) @ np.abs(k))
    far = sigma_max(over) * unsure
    with np.errstate(divide="ignore"):
        of_inverse = np.where(far < 1.0, sigma_max(over) * far / np.maximum(1.0 - far, 0.0), np.inf)
    direct, inverse = _clearances(hz, L, unsure), _clearances(hz, over, of_inverse)
    size = sigma_max(over) + of_inverse
    size = np.maximum(size[1:], size[:-1]) + interpolation_errors(hz, over)
    with np.errstate(divide="ignore"):
        by_L = np.where(direct > 0.0, 1.0 / np.maximum(direct, 0.0), np.inf)
        by_inverse = np.where(inverse > 0.0, size / np.maximum(inverse, 0.0), np.inf)
    return np.minimum(by_L, by_inverse)


def _clearances(
    hz: Array,
    L: np.ndarray,
    unsure: Array,
    options: InterpolationErrorOptions = InterpolationErrorOptions(),
) -> Array:
    """Least σ_min(I + L) between neighbouring lines (k - 1,): on the chord, less r and `unsure`.

    Of several channels that at a place near by, less half the step to the next.
    """
    step = np.diff(L, axis=0)
    if L.shape[1] == 1:
        start, along = 1.0 + L[:-1, 0, 0], step[:, 0, 0]
        size = np.abs(along) ** 2
        share = np.clip(-(start * along.conj()).real / np.where(size == 0.0, 1.0, size), 0.0, 1.0)
        least = np.abs(start + share * along)
    else:
        shares = np.linspace(0.0, 1.0, options.places)
        places = np.eye(L.shape[1]) + L[:-1] + shares[:, None, None, None] * step
        least = np.linalg.svd(places, compute_uv=False)[..., -1].min(axis=0)
        least = least - 0.5 * shares[1] * sigma_max(step)
    error = interpolation_errors(hz, L, options)
    return np.asarray(least - error - np.maximum(unsure[1:], unsure[:-1]))


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
    seen = 0.0 if measured.modelled or not len(large) else measured.excess(hz[large[-1]])
    if seen > measured.unstable_poles + options.risen:
        doubts.append(
            f"the angle of G rises by {180.0 * seen:.0f} deg more than that of a stable G of its "
            "size: state its unstable poles (--unstable-poles, unstable_poles)"
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
    """How far the angle of F (k,) grows from line to line.

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

    Parameters
    ----------
    omega, ln_S : array (k,)
        rad/s; ln σ_max(S) there.
    bounds, integrator : Bounds, bool
        The shape counts from 0 on with an integrator, else from ω_low.

    Returns
    -------
    float
        rad/s; 0 where |S| > 1/√2 on the first line.
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
