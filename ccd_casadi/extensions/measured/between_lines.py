"""What a loop may do between the lines of a measured response.

Between two lines L = GK is taken to lie within r of the chord,

    r = 2 h²/8 max|L''|,   L'' by the second differences at both ends and one line further:

twice the error of linear interpolation, where L bends between two lines as around them. A
resonance that fits between two lines is not seen. Where measurements were repeated, their spread
Δ adds ‖Δ |K|‖ to r at the lines. With it σ_max(S) <= 1/(least σ_min(I + L) on the
chord less r); where L is large the same of L⁻¹ = (GK)⁻¹, which is nearly straight there.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.lti.state_space import sigma_max
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.arrays import Array


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


def gap_of(hz: Array, i: int) -> str:
    """The pair of lines in words."""
    return f"between {hz[i]:.4g} and {hz[i + 1]:.4g} Hz"


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
