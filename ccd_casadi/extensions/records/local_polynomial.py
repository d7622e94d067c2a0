"""The local polynomial method: responses of several signals to one excitation, with their noise.

Around each line k of the discrete Fourier transform the spectra of N samples are

    Z(k + m) = G(k + m) R(k + m) + T(k + m) + V(k + m),   |m| <= n,

with R the excitation, G the responses of the signals Z to it, T what the ends of the record leave
(leakage, drift, settling) and V noise. G and T are smooth and are polynomials of m in the window;
R is rough, which separates them. Least squares give G(k), and what they leave gives the covariance
of V (Pintelon and Schoukens, System Identification, 2nd ed., 2012, section 7.2.2).

The window is as wide as the data permit: at each line it grows until the answer moves by more than
noise explains (Lepski's rule), as at a resonance that is too narrow for it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class WindowOptions:
    """Numbers of the local polynomials.

    Attributes
    ----------
    half_widths : tuple of int
        Lines on each side of a line, rising: windows that are tried.
    order, transient_order : int
        Of the polynomials of G and of T.
    moved : float
        Standard deviations by which the answer may move as the window grows, in the mean over the
        `averaged` lines around; one line counts `most` at most.
    averaged, most : int, float
    relative : float
        Widest half window over the line's frequency; the narrowest window is exempt.
    periodic_lines : int
        Lines without excitation from which the noise of a periodic record is taken.
    at_once : int
        Lines that are solved in one call.
    conditioned : float
        Least ratio of the diagonal of the triangular factor: below it G and T do not come apart.
    """

    half_widths: tuple[int, ...] = (7, 10, 14, 20, 28, 40, 56)
    order: int = 2
    transient_order: int = 2
    moved: float = 0.8
    relative: float = 0.15
    averaged: int = 21
    most: float = 16.0
    periodic_lines: int = 14
    at_once: int = 2048
    conditioned: float = 1e-3


@dataclass(frozen=True)
class LocalFit:
    """Responses of q signals to the excitation at some lines."""

    G: np.ndarray  # (k, q)
    covariance: np.ndarray  # (k, q, q) E[e eᴴ] of the error e of G
    degrees: Array  # (k,) of freedom behind the covariance, complex
    coherence: Array  # (k, q) share of a signal's power that the excitation explains, beside T
    transient: Array  # (k, q) share of a signal's power that T alone explains
    width: Array  # (k,) lines of the window


def fit_locally(
    Z: np.ndarray, R: np.ndarray, lines: np.ndarray, period_lines: int = 1,
    options: WindowOptions = WindowOptions(),
) -> LocalFit:  # fmt: skip
    """Fit local polynomials about some lines of a transform.

    `Z` (M, q, K) and `R` (M, K) are spectra of the signals and of the excitation in M records, line
    0 first; G is one for all. `period_lines` is the number of whole periods in the record: only
    each such line is then excited, and the lines between give T and the noise; 1: it is not
    periodic.
    """
    if period_lines > 1:
        return _periodic(Z, R, lines, period_lines, options)
    widths = [n for n in options.half_widths if 2 * n + 1 <= R.shape[1] - 1]
    parts = [_widest(Z, R, part, widths, options) for part in _blocks(lines, options.at_once)]
    return LocalFit(*(np.concatenate(own) for own in zip(*parts, strict=True)))


Parts = tuple[np.ndarray, np.ndarray, Array, Array, Array, Array]


def _blocks(lines: np.ndarray, size: int) -> Iterator[np.ndarray]:
    for start in range(0, len(lines), size):
        yield lines[start : start + size]


def _widest(
    Z: np.ndarray, R: np.ndarray, lines: np.ndarray, widths: list[int], options: WindowOptions
) -> Parts:
    """Choose at each line the fit in the widest window that agrees with all narrower ones."""
    fits = []
    for n in widths:
        first = np.clip(lines - n, 1, R.shape[1] - 2 * n - 1)
        window = first[:, None] + np.arange(2 * n + 1)
        fits.append(_solve(Z, R, lines, window, n, options.order, options.transient_order,
                            options.conditioned))  # fmt: skip
    chosen, growing = np.zeros(len(lines), int), np.ones(len(lines), bool)
    size = [np.einsum("kqq->kq", fit[1]).real for fit in fits]
    for i in range(1, len(fits)):
        worst = np.zeros(len(lines))
        for j in range(i):
            known = np.isfinite(size[j]) & np.isfinite(size[i])
            with np.errstate(invalid="ignore"):
                ratio = np.abs(fits[i][0] - fits[j][0]) ** 2 / (size[i] + size[j])
            ratio = np.minimum(np.where(known, ratio, 0.0).max(axis=1), options.most)
            worst = np.maximum(worst, uniform_filter1d(ratio, options.averaged, mode="nearest"))
        wide = widths[i] > options.relative * lines
        growing &= (worst <= options.moved**2) & ~wide
        chosen[growing] = i
    every = np.arange(len(lines))
    return tuple(np.stack([fit[part] for fit in fits])[chosen, every]
                 for part in range(6))  # type: ignore[return-value]  # fmt: skip


def _periodic(
    Z: np.ndarray, R: np.ndarray, lines: np.ndarray, period_lines: int, options: WindowOptions
) -> LocalFit:
    """G = (Z - T)/R at an excited line, T and the noise from the lines without excitation beside
    it."""
    every = np.arange(1, R.shape[1])
    quiet = every[every % period_lines > 0]
    count = min(options.periodic_lines, len(quiet))
    start = np.clip(np.searchsorted(quiet, lines) - count // 2, 0, len(quiet) - count)
    window = np.hstack([lines[:, None], quiet[start[:, None] + np.arange(count)]])
    reach = int(np.abs(window - lines[:, None]).max())
    blocks = _blocks(np.arange(len(lines)), options.at_once)
    parts = [
        _solve(Z, R, lines[at], window[at], reach, 0, options.transient_order, options.conditioned)
        for at in blocks
    ]
    return LocalFit(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def _solve(
    Z: np.ndarray, R: np.ndarray, lines: np.ndarray, window: np.ndarray, n: int, order: int,
    transient_order: int, conditioned: float,
) -> Parts:  # fmt: skip
    """Least squares in each window (k, w) about its line, by orthogonal factors."""
    m = (window - lines[:, None]) / n
    basis = np.linalg.qr(m[..., None] ** np.arange(transient_order + 1)).Q  # of T, in each record

    def without_T(own: np.ndarray) -> np.ndarray:
        return np.asarray(own - basis[None] @ (basis.swapaxes(1, 2)[None] @ own))

    excited = R[:, window]
    scale = np.sqrt((np.abs(excited) ** 2).mean(axis=(0, 2)))
    scale = np.where(scale > 0.0, scale, 1.0)
    of_G = (excited / scale[:, None])[..., None] * m[..., None] ** np.arange(order + 1)
    signals = Z[:, :, window].transpose(0, 2, 3, 1)
    kept = without_T(signals)
    by_T = (np.abs(signals) ** 2).sum(axis=(0, 2)) - (np.abs(kept) ** 2).sum(axis=(0, 2))
    A, kept = (np.concatenate(list(own), axis=1) for own in (without_T(of_G), kept))
    Q, upper = np.linalg.qr(A)
    columns = order + 1
    diagonal = np.abs(np.einsum("kii->ki", upper))
    bad = diagonal.min(axis=1) < conditioned * np.sqrt(A.shape[1])
    upper = np.where(bad[:, None, None], np.eye(columns), upper)
    inverse = np.linalg.inv(upper)
    of_Q = Q.conj().swapaxes(1, 2) @ kept
    rest = kept - Q @ of_Q
    degrees = A.shape[1] - columns - len(R) * (transient_order + 1)
    noise = (rest.swapaxes(1, 2) @ rest.conj()) / degrees
    G = (inverse[:, :1, :] @ of_Q)[:, 0, :] / scale[:, None]
    gain = (np.abs(inverse[:, 0, :]) ** 2).sum(axis=1) / scale**2
    explained = (np.abs(of_Q) ** 2).sum(axis=1)
    left = (np.abs(rest) ** 2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.where(explained > 0.0, explained / (explained + left), 0.0)
        transient = by_T / (by_T + explained + left)
    covariance = noise * gain[:, None, None]
    covariance[bad], coherence[bad] = np.inf, 0.0
    full = np.full(len(lines), float(degrees))
    width = np.full(len(lines), float(window.shape[1]))
    return G, covariance, full, coherence, transient, width
