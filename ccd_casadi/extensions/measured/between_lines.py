"""What a loop may do between the lines of a measured response.

Between two lines L = GK is taken to lie within r of the chord,

    r = 2 h²/8 max|L''|,   L'' by the second differences at both ends and one line further:

twice the error of linear interpolation over h = Δ ln f, where L bends between two lines as around
them. A resonance that fits between two lines is not seen. Where measurements were repeated, their
spread Δ adds ‖Δ |K|‖ to r at the lines. σ_min is 1-Lipschitz, so that
σ_max(S) = 1/σ_min(I + L) <= 1/(least σ_min(I + L) on the chord - r); where L is large the same of
L⁻¹ = (GK)⁻¹, which is nearly straight there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ccd_casadi.lti.state_space import sigma_max
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class InterpolationErrorOptions:
    """Numbers of the error between two lines."""

    safety: float = 2.0  # factor on the error of linear interpolation
    deviations: float = 3.0  # standard deviations up to which a second difference may be noise
    strides: tuple[int, ...] = (2, 4, 8)  # lines, over which it is then taken
    window: int = 15  # lines, over which the noise is estimated; odd
    places: int = 9  # on a chord, of several channels


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

    A second difference 1, -2, 1 of values with noise σ has the deviation √(1 + 4 + 1) σ, whatever
    h: L'' = difference/h² is the surer the further its lines are apart. So where that of neighbours
    does not exceed its noise, those over `strides` count, with their noise added.
    """
    x = np.log(hz)
    noise = options.deviations * np.sqrt(6.0) * _noise(x, L, options.window)
    around = _curvature(x, L, 1)
    step = _half_width(x, 1)
    for stride in options.strides:
        if len(x) > 2 * stride and noise.max() > 0.0:
            wide = _curvature(x, L, stride) + noise / _half_width(x, stride) ** 2
            around = np.where(around * step**2 < noise, np.minimum(around, wide), around)
    largest = sliding_window_view(np.pad(around, 1), 4).max(axis=1)
    return np.asarray(options.safety * np.diff(x) ** 2 / 8.0 * largest)


def _curvature(x: Array, L: np.ndarray, stride: int) -> Array:
    """σ_max of the second derivative at each line (k,), by lines that are `stride` apart."""
    a, b, c = x[: -2 * stride], x[stride:-stride], x[2 * stride :]
    rises = [(L[stride:][: len(a)] - L[: len(a)]) / (b - a)[:, None, None],
             (L[2 * stride :] - L[stride:-stride]) / (c - b)[:, None, None]]  # fmt: skip
    second = sigma_max(2.0 * (rises[1] - rises[0]) / (c - a)[:, None, None])
    return np.pad(second, stride, mode="edge")


def _half_width(x: Array, stride: int) -> Array:
    """h (k,) of the second difference at each line, the mean of its two steps in ln f."""
    return np.pad(0.5 * (x[2 * stride :] - x[: -2 * stride]), stride, mode="edge")


def _noise(x: Array, L: np.ndarray, window: int) -> Array:
    """Standard deviation of the noise of L at each line (k,), the median over a `window` of lines.

    One estimate is the distance of L from the cubic through the two lines on each side: with
    Lagrange's weights w that is ε - Σ w_i ε_i, of the deviation √(1 + Σ w_i²) σ. Too few lines
    count as free of noise.
    """
    if len(x) < window:
        return np.zeros(len(x))
    inner, neighbours = slice(2, -2), (slice(-4), slice(1, -3), slice(3, -1), slice(4, None))
    distance, variance = L[inner].copy(), np.ones(len(x) - 4)
    for own in neighbours:
        weight = np.prod([(x[inner] - x[other]) / (x[own] - x[other])
                          for other in neighbours if other != own], axis=0)  # fmt: skip
        distance -= weight[:, None, None] * L[own]
        variance += weight**2
    deviation = np.pad(sigma_max(distance) / np.sqrt(variance), 2, mode="edge")
    padded = np.pad(deviation, window // 2, mode="reflect")
    return np.median(sliding_window_view(padded, window), axis=1)


def hidden_damping(
    measured: MeasuredResponse, L: np.ndarray, K: np.ndarray,
    options: HiddenResonanceOptions = HiddenResonanceOptions(),
) -> Array:  # fmt: skip
    """The largest damping ratio with which a resonance between neighbouring lines (k - 1,) may make
    I + L singular and yet not show on them.

    To make I + L singular it has to be H = σ_min(I + L)/σ_max(K) high at least. Beyond its width
    H/(1 + j(ω/ω₀ - ω₀/ω)/(2ζ)) is H ζ/(j ln(ω/ω₀)), on the lines around so q/(t - t₀) with
    q = H ζ/h but for its phase, t counted in their distance h in ln f. G, its slope removed, leaves
    room for a q beside what it does else, by the smaller of two estimates:

    - The step of q/(t - t₀) over the pair that t₀ lies between is q/t₀ + q/(1 - t₀) >= 4 q, and
      those of the pairs beside it have the other sign. So q is at most a quarter of what the step
      of G differs from those beside it, here or up to two pairs away.
    - What a fit with another pole leaves, `_room_beside_a_pole`.

    Where lines are closer than its width 2 ζ a resonance is not hidden either.
    """
    x = np.log(measured.hz)
    h, flat = np.diff(x), (measured.hz / measured.hz[0]) ** measured.slope
    G = measured.matrix * flat[:, None, None]
    slope = np.diff(G, axis=0) / h[:, None, None]
    beside = np.pad(slope, ((1, 1), (0, 0), (0, 0)), mode="reflect")
    jump = np.pad(sigma_max(slope - 0.5 * (beside[:-2] + beside[2:])) * h, 2, mode="edge")
    room = sliding_window_view(jump, 5).max(axis=1) / 4.0
    room = np.minimum(room, _room_beside_a_pole(x, G.reshape(len(x), -1), options))
    eye, middle = np.eye(L.shape[1]), 0.5 * (L[1:] + L[:-1])
    ends, centre = (np.linalg.norm(eye + part, -2, axis=(1, 2)) for part in (L, middle))
    height = flat / sigma_max(K)  # of H per σ_min(I + L), in the units of the flattened G
    height = np.minimum(height[1:], height[:-1])
    H = np.minimum(centre, np.minimum(ends[1:], ends[:-1])) * height
    return np.minimum(h * room / H, 0.5 * h)


def _room_beside_a_pole(x: Array, G: np.ndarray, options: HiddenResonanceOptions) -> Array:
    """The largest q between neighbouring lines (k - 1,) of x, if G (k, entries) is else a parabola
    over one pole on the lines around.

    Each entry g = (a + b t + c t²)/(1 + d t) is linear in a, b, c and d, and is fitted by least
    squares: g = a + b t + c t² - d t g. A resonance beside it adds q (1 + d t)/(t - t₀), which the
    basis cannot follow. So q is at most the residual of g over that of (1 + d t)/(t - t₀), times
    `safety`. Infinite where the fitted pole t = -1/d is itself a resonance narrower than the lines.
    """
    fitted, near = options.fitted, options.near
    if len(x) < fitted:
        return np.full(len(x) - 1, np.inf)
    every = np.arange(len(x) - 1)
    lines = np.clip(every - fitted // 2 + 1, 0, len(x) - fitted)[:, None] + np.arange(fitted)
    # t counts from the middle of the pair: its lines are at -1/2 and 1/2
    t = (x[lines] - 0.5 * (x[1:] + x[:-1])[:, None]) / np.diff(x)[:, None]
    squares, inside = np.zeros(len(every)), np.linspace(-0.4, 0.4, options.places)
    for own in G.T:
        g = own[lines]
        basis = np.stack([t**0, t, t**2, -t * g], axis=-1)
        Q = np.linalg.qr(basis).Q

        def residual(v: np.ndarray, Q: np.ndarray = Q) -> Array:
            off = v - (Q @ (Q.conj().swapaxes(1, 2) @ v[..., None]))[..., 0]
            return np.linalg.norm(off, axis=1)

        d = (np.linalg.pinv(basis) @ g[..., None])[:, 3]
        least = np.min([residual((1.0 + d * t) / (t - t0)) for t0 in inside], axis=0)
        squares += (options.safety * residual(g) / least) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            pole = -1.0 / d[:, 0]
        squares[(np.abs(pole.real) < near) & (np.abs(pole.imag) < near)] = np.inf
    return np.sqrt(squares)


def gap_of(hz: Array, i: int) -> str:
    """The pair of lines in words."""
    return f"between {hz[i]:.4g} and {hz[i + 1]:.4g} Hz"


def bound_between_lines(measured: MeasuredResponse, L: np.ndarray, K: np.ndarray) -> Array:
    """Bound σ_max(S) between neighbouring lines.

    By L, or where it is large and its inverse the smoother by S = L⁻¹ (I + L⁻¹)⁻¹. L = GK at each
    line is known within u = ‖Δ |K|‖, so L⁻¹ within ‖L⁻¹‖²u/(1 - ‖L⁻¹‖u), by Neumann's series.

    Parameters
    ----------
    measured, L, K : MeasuredResponse, array (k, p, p), array (k, m, p)
        GK and K on its lines.

    Returns
    -------
    array (k - 1,)
        Infinite where I + L may be singular.
    """
    hz, unsure = measured.hz, np.zeros(len(L))
    if measured.spread is not None:
        unsure = sigma_max(measured.spread.reshape(measured.matrix.shape) @ np.abs(K))
    # Where L is singular, as where K blocks a channel, its inverse is out of all proportion.
    singular = np.linalg.det(L)[:, None, None] == 0.0
    inverse = np.linalg.inv(np.where(singular, 1e-100 * np.eye(L.shape[1]), L))
    size = sigma_max(inverse)
    far = size * unsure
    with np.errstate(divide="ignore"):
        unsure_inverse = np.where(far < 1.0, size * far / np.maximum(1.0 - far, 0.0), np.inf)
    direct = _clearances(hz, L, unsure)
    of_inverse = _clearances(hz, inverse, unsure_inverse)
    size = size + unsure_inverse
    size = np.maximum(size[1:], size[:-1]) + interpolation_errors(hz, inverse)
    with np.errstate(divide="ignore"):
        by_L = np.where(direct > 0.0, 1.0 / np.maximum(direct, 0.0), np.inf)
        by_inverse = np.where(of_inverse > 0.0, size / np.maximum(of_inverse, 0.0), np.inf)
    return np.minimum(by_L, by_inverse)


def _clearances(
    hz: Array,
    L: np.ndarray,
    unsure: Array,
    options: InterpolationErrorOptions = InterpolationErrorOptions(),
) -> Array:
    """Least σ_min(I + L) between neighbouring lines (k - 1,): on the chord, less r and `unsure`.

    Of one channel the distance of -1 from the chord. Of several the least at places on it, less
    half the step from one to the next, since σ_min changes by no more than L.
    """
    step = np.diff(L, axis=0)
    if L.shape[1] == 1:
        start, along = 1.0 + L[:-1, 0, 0], step[:, 0, 0]
        length = np.abs(along) ** 2
        share = -(start * along.conj()).real / np.where(length == 0.0, 1.0, length)
        least = np.abs(start + np.clip(share, 0.0, 1.0) * along)
    else:
        shares = np.linspace(0.0, 1.0, options.places)
        places = np.eye(L.shape[1]) + L[:-1] + shares[:, None, None, None] * step
        least = np.linalg.svd(places, compute_uv=False)[..., -1].min(axis=0)
        least = least - 0.5 * shares[1] * sigma_max(step)
    error = interpolation_errors(hz, L, options)
    return np.asarray(least - error - np.maximum(unsure[1:], unsure[:-1]))
