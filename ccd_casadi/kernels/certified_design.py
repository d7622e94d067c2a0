"""One design from end to end: γ_opt, controller, certificate, closed-loop figures; and sweeps."""

from dataclasses import dataclass
from math import exp, isnan, log, nan

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.generalized_plant import generalized_plant, place
from ccd_casadi.kernels.linear_algebra import eigenvalues
from ccd_casadi.kernels.loop_certificate import (
    level_test,
    loop_matrices,
    pole_rounding,
    reachable_loop,
    stack_norm,
    weighted_loop,
)
from ccd_casadi.kernels.riccati import lqr_hamiltonian
from ccd_casadi.kernels.riccati_synthesis import central_controller, synthesise
from ccd_casadi.kernels.sensitivity import Code, Column, bandwidth, peak, sensitivity_gain

_COUNT, _CODE, _GAMMA_OPT = int(Column.COUNT), int(Column.CODE), int(Column.GAMMA_OPT)
_BALANCED = int(Column.BALANCED)


@dataclass(frozen=True)
class CertifiedDesignOptions:
    """Relative tolerances of the certificate.

    Attributes
    ----------
    freed : float
        What free bodies in the place of suspended ones may add to the norm.
    level : float
        How far above the largest gain found a norm is certified.
    """

    freed: float = 0.01
    level: float = 1e-6


@inlined
def certificate_grid(wr, wi):
    """Frequencies for the norm: 12 a decade beyond the poles, and every pole with its flanks, more
    of a light one: beside an undamped mode of the plant two peaks share its width."""
    low, high = np.inf, 0.0
    n = wr.size
    for i in range(n):
        size = np.hypot(wr[i], wi[i])
        low, high = min(low, size), max(high, size)
    low, high = np.log10(0.01 * low), np.log10(10.0 * high)
    count = int(np.ceil(12.0 * (high - low))) + 1
    grid = np.empty(count + 9 * n)
    for i in range(count):
        grid[i] = 10.0 ** (low + (high - low) * i / (count - 1))
    k = count
    for i in range(n):
        if wi[i] > 0.0:
            half = min(abs(wr[i]), 0.5 * wi[i])
            grid[k], grid[k + 1], grid[k + 2] = wi[i] - half, wi[i], wi[i] + half
            k += 3
            if half < 0.02 * wi[i]:
                for far in (0.5, 2.0, 4.0):
                    grid[k], grid[k + 1] = wi[i] - far * half, wi[i] + far * half
                    k += 2
    return np.sort(grid[:k])


@inlined
def _close(A, B, C, Ak, Bk, Ck, Dk, row):
    """Evaluate the loop's poles into `row`; return its matrices r to e, plant and controller
    prepared, a grid."""
    As, Bs, Cs = loop_matrices(A, B, C, Ak, Bk, Ck, Dk)
    wr, wi, info = eigenvalues(As)
    row[Column.MAX_REAL_POLE] = wr.max()
    code = Code.CERTIFIED.value
    if info != 0:
        code = Code.EIGENVALUES_FAILED.value
    elif not wr.max() < -pole_rounding(As):
        code = Code.UNSTABLE_LOOP.value
    return code, (As, Bs, Cs), wr, wi, prepare(A, B, C), prepare(Ak, Bk, Ck)


@inlined
def _stack_proof(G, K, Dk, w, delta, grid, gamma, matrices, loop):
    """The norm, where, whether it and the Hamiltonian stay below γ, and the least r to e."""
    A, B, C, Ak, Bk, Ck = matrices
    norm, at = stack_norm(G, K, Dk, w, delta, grid)
    if not norm <= gamma:
        return norm, at, False, loop
    whole = weighted_loop(A, B, C, Ak, Bk, Ck, Dk, w, delta)
    if not delta > 0.0:
        whole, smaller = reachable_loop(whole, A.shape[0], Ak.shape[0])
        if smaller:
            # x = x̂ as seen from r, so the controller's own states carry S as well
            Cs = np.zeros((C.shape[0], Ak.shape[0]))
            place(Cs, 0, 0, -1.0, C)
            loop = (whole[0], whole[1], Cs)
    return norm, at, level_test(G, K, Dk, w, delta, whole, gamma), loop


@inlined
def _measure(G, K, Dk, omega_low, loop, wr, wi, row):
    """Measure the figures of S into `row`."""
    As, Bs, Cs = loop
    row[Column.LOW] = sensitivity_gain(G, K, Dk, omega_low)
    value, at, confirmed = peak(G, K, Dk, As, Bs, Cs, wr, wi)
    row[Column.PEAK], row[Column.PEAK_FREQUENCY] = value, at
    if not confirmed:
        return Code.PEAK_NOT_CONFIRMED.value
    row[Column.BANDWIDTH], info = bandwidth(G, K, Dk, As, Bs, Cs)
    if info != 0:
        return Code.EIGENVALUES_FAILED.value
    return Code.CERTIFIED.value if np.isfinite(row[Column.BANDWIDTH]) else Code.NO_BANDWIDTH.value


@inlined
def _judge(A, B, C, Ak, Bk, Ck, Dk, w, delta, gamma, omega_low, row):
    """Judge the design and return its code."""
    row[Column.GAMMA] = gamma
    if not (np.isfinite(Ak).all() and np.isfinite(Bk).all() and np.isfinite(Ck).all()):
        return Code.NOT_FINITE.value
    code, loop, wr, wi, G, K = _close(A, B, C, Ak, Bk, Ck, Dk, row)
    if code != Code.CERTIFIED.value:
        return code
    grid = certificate_grid(wr, wi)
    matrices = (A, B, C, Ak, Bk, Ck)
    norm, at, held, loop = _stack_proof(G, K, Dk, w, delta, grid, gamma, matrices, loop)
    row[Column.NORM], row[Column.NORM_FREQUENCY] = norm, at
    if not held:
        return Code.LEVEL_TEST_FAILED.value if norm <= gamma else Code.NORM_EXCEEDED.value
    return _measure(G, K, Dk, omega_low, loop, wr, wi, row)


@compiled
def judge(A, B, C, Ak, Bk, Ck, Dk, w, delta, gamma, omega_low, row):
    """Certify a controller against `gamma` and fill in its closed-loop figures as far as it comes.

    Parameters
    ----------
    A, B, C, Ak, Bk, Ck, Dk : arrays
        Scaled plant and controller.
    w : array (8,)
        Scaled weights.
    delta : float
        Above 0 the norm is that of the four blocks [W1 I; W2 K; W3 K] S [I δG].
    gamma : float
    omega_low : float
        Frequency of `Column.LOW`, over ω₀.
    row : array (Column.COUNT,)
        Filled in place.
    """
    row[Column.CODE] = _judge(A, B, C, Ak, Bk, Ck, Dk, w, delta, gamma, omega_low, row)


# Numba optimises a kernel anew inside every kernel that calls it. What follows only strings
# compiled kernels together: 2 % slower in Python, and half the time to compile.


def design(
    A, B, C, w, grid, sigma, backoff, omega_low, guess, channels=(), delta=0.0, judged_on=(),
    options=CertifiedDesignOptions(),
):  # fmt: skip
    """Synthesise at backoff·γ_opt, certify and measure.

    With `channels` the synthesis is done on these blocks; the certificate is the whole loop's. A
    synthesis that fails is repeated in balanced coordinates, whole, and then counts if it passes.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
        Scaled plant.
    w : array (8,)
        Scaled weights.
    grid, sigma : arrays (g,)
        Frequencies over ω₀, and the least gain of the plant there.
    backoff : float
        γ/γ_opt.
    omega_low : float
        Frequency of `Column.LOW`, over ω₀.
    guess : float
        Of γ_opt; 0: none.
    channels : sequence of ScaledChannel
    delta : float
        Above 0 it is the four-block problem with a disturbance, which is solved whole.
    judged_on : A, B, C
        Of the plant on which the loop is closed, with free bodies in the place of suspended ones.
        Its norm may be above γ by `freed`; above that it is certified at its value, or where the
        level test finds more than that, at `freed` above it.
    options : CertifiedDesignOptions

    Returns
    -------
    row : array (Column.COUNT,)
    A_K, B_K, C_K : arrays
        Scaled controller.
    """
    first = None
    for balanced in (False, True):
        try:
            made = None
            if channels and not (balanced or delta):
                made = _synthesise_channels(A, B, C, w, channels, backoff, guess)
            if made is None:
                made = synthesise(A, B, C, w, grid, sigma, backoff, guess, balanced, delta)
            row, Ak, Bk, Ck = made
            row[_BALANCED] = balanced
            if row[_CODE] == 0.0:
                Dk = np.zeros((Ck.shape[0], Bk.shape[1]))
                gamma = backoff * row[_GAMMA_OPT] * (1.0 + options.freed if judged_on else 1.0)
                loop = (*(judged_on or (A, B, C)), Ak, Bk, Ck, Dk, w, delta)
                judge(*loop, gamma, omega_low, row)
                for room in (options.level, options.freed):  # above a peak beside those found
                    if judged_on and row[_CODE] in (Code.NORM_EXCEEDED, Code.LEVEL_TEST_FAILED):
                        judge(*loop, (1.0 + room) * row[Column.NORM], omega_low, row)
        except np.linalg.LinAlgError:  # an infinite or undefined number on the way
            made = failed_row(), *[np.full((1, 1), nan)] * 3
        if made[0][_CODE] in _PASSED:
            return made
        first = first or made
    return first


_PASSED = (Code.CERTIFIED, Code.NO_BANDWIDTH)  # the certificate holds; no crossing in the second


def failed_row():
    """Make the row of a design whose linear algebra met an infinite or undefined number.

    Returns
    -------
    array (Column.COUNT,)
    """
    row = np.full(_COUNT, nan)
    row[_CODE], row[Column.LIMITED_BY_BOUND], row[_BALANCED] = float(Code.NOT_FINITE), 0.0, 0.0
    return row


def _synthesise_channels(A, B, C, w, channels, backoff, guess):
    """Synthesise as `synthesise` does, from the blocks: γ_opt is their largest, F at one γ is
    theirs together.

    None where a block is not stable: its observer then corrects the plant's states.
    """
    found = [synthesise(c.A, c.B, c.C, w, c.grid, c.gain, backoff, guess, False) for c in channels]
    if any(item[2][: len(c.A)].any() for item, c in zip(found, channels, strict=True)):
        return None
    rows = np.array([item[0] for item in found])
    failed = np.flatnonzero(rows[:, Column.CODE])
    if failed.size:
        return found[failed[0]]
    top = int(rows[:, _GAMMA_OPT].argmax())
    row = rows[top].copy()
    row[Column.GAMMA_LOWER_BOUND] = rows[:, Column.GAMMA_LOWER_BOUND].max()
    row[Column.SCHUR_FORMS] = rows[:, Column.SCHUR_FORMS].sum()
    Ag, B1, B2, _, C2, _, _ = generalized_plant(A, B, C, w)
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    F = np.zeros((m, n + 2 * p + m))
    for i, c in enumerate(channels):
        gain = found[i][3]
        if i != top:
            gp = generalized_plant(c.A, c.B, c.C, w)
            gain, ok = central_controller(gp, lqr_hamiltonian(gp), backoff * row[_GAMMA_OPT])[2:]
            if not ok:
                row[Column.CODE] = Code.RICCATI_FAILED.value
        # filters turn with the signals that they see
        turns = (np.eye(n)[:, c.states], c.outputs, c.inputs, c.outputs)
        first, column = 0, 0
        for turn in turns:
            high, wide = turn.shape
            F[:, first : first + high] += c.inputs @ gain[:, column : column + wide] @ turn.T
            first, column = first + high, column + wide
    return row, Ag + B2 @ F - B1 @ C2, B1, F


def sweep(
    A, B, C, w, omega_S, omega_T, grid, sigma, backoff, omega_low, channels=(), delta=0.0,
    judged_on=(),
):  # fmt: skip
    """Design over a grid of the frequencies of W1 and W3, each warm-started.

    In boustrophedon order: γ_opt is guessed from the certified neighbours.

    Parameters
    ----------
    A, B, C, w, grid, sigma, backoff, omega_low, channels, delta, judged_on
        As in `design`.
    omega_S, omega_T : arrays (n_S,), (n_T,)
        Over ω₀.

    Returns
    -------
    array (n_S, n_T, Column.COUNT)
    """
    rows = np.empty((omega_S.size, omega_T.size, _COUNT))
    found = np.zeros(rows.shape[:2])  # ln γ_opt; NaN where not certified
    weights = w.copy()
    x, y = np.log(omega_S).tolist(), np.log(omega_T).tolist()
    for j in range(omega_T.size):
        weights[7] = omega_T[j]
        side = 1 if j % 2 == 0 else -1
        for step in range(omega_S.size):
            i = step if side == 1 else omega_S.size - 1 - step
            weights[2] = omega_S[i]
            guess = _guess(found, x, y, i, j, side, step)
            numbers = (grid, sigma, backoff, omega_low, guess, channels, delta, judged_on)
            row = design(A, B, C, weights, *numbers)[0]
            rows[i, j] = row
            found[i, j] = log(row[_GAMMA_OPT]) if row[_CODE] == 0.0 else nan
    return rows


def _guess(found, x, y, i, j, side, step):
    """γ_opt at (i, j) from the neighbours that the sweep has behind it; 0 where none serves.

    ln γ is nearly a function of ω_S plus one of ω_T, so the fourth corner of a cell follows from
    the other three; on the first line and at the turns it is extrapolated.
    """
    if step > 0 and j > 0:
        value = found[i - side, j] + found[i, j - 1] - found[i - side, j - 1]
    elif step > 1:
        value = _extrapolate(found[i - 2 * side, j], found[i - side, j], x, i, side)
    elif step == 0 and j > 1:
        value = _extrapolate(found[i, j - 2], found[i, j - 1], y, j, 1)
    else:
        value = nan
    if isnan(value) and step > 0:
        value = found[i - side, j]
    return 0.0 if isnan(value) else exp(value)


def _extrapolate(first, second, x, i, side):
    run = x[i - side] - x[i - 2 * side]
    return second + (second - first) * (x[i] - x[i - side]) / run if run != 0.0 else second
