"""Figures of S: peak, bandwidth, level at ω_low, by level tests confirmed on the response."""

from enum import IntEnum

import numpy as np

from ccd_casadi.kernels.compiled import compiled, inlined
from ccd_casadi.kernels.frequency import response, response_and_slope, responses
from ccd_casadi.kernels.generalized_plant import add, place, place_transposed, transpose
from ccd_casadi.kernels.linear_algebra import eigenvalues, invert, largest_singular, multiply


class Code(IntEnum):
    """The end of a design; only CERTIFIED may be used."""

    CERTIFIED = 0
    GAMMA_NOT_CONVERGED = 1
    RICCATI_FAILED = 2
    NOT_FINITE = 3
    UNSTABLE_LOOP = 4
    NORM_EXCEEDED = 5
    LEVEL_TEST_FAILED = 6
    NO_BANDWIDTH = 7
    EIGENVALUES_FAILED = 8
    PEAK_NOT_CONFIRMED = 9
    FILTER_FAILED = 10


class Column(IntEnum):
    """Columns of a row of figures; frequencies and poles over ω₀.

    Attributes
    ----------
    CODE
        How the design ended, a `Code`.
    BALANCED
        1 where the synthesis needed balanced coordinates.
    GAMMA_ERROR
        Relative, what rounding and search may leave in γ_opt; infinite where unknown.
    COUNT
        The number of columns.
    """

    CODE = 0
    GAMMA_OPT = 1
    GAMMA_LOWER_BOUND = 2
    GAMMA = 3
    LIMITED_BY_BOUND = 4
    SCHUR_FORMS = 5
    BANDWIDTH = 6
    PEAK = 7
    PEAK_FREQUENCY = 8
    LOW = 9
    MAX_REAL_POLE = 10
    NORM = 11
    NORM_FREQUENCY = 12
    BALANCED = 13
    GAMMA_ERROR = 14
    COUNT = 15


HALF_POWER = 1.0 / np.sqrt(2.0)


@compiled
def axis_frequencies(A, B, C, D, level):
    """Find ω > 0 where σ(C(jω-A)⁻¹B + D) = level may hold: |Re λ| <= 1e-3 |λ|.

    The tolerance is generous on purpose: a spurious candidate costs one evaluation, a missed
    one a wrong answer.

    Parameters
    ----------
    A, B, C, D : arrays (n, n), (n, m), (p, n), (p, m)
    level : float

    Returns
    -------
    omega : array
        Sorted.
    info : int
        Of LAPACK; 0: success.
    """
    n, m = B.shape
    Dt = transpose(D)
    R = np.zeros((m, m))
    for i in range(m):
        R[i, i] = level**2
    add(R, 0, 0, -1.0, Dt @ D)
    DC = Dt @ C
    if m == 1:
        R[0, 0] = 1.0 / R[0, 0]
    else:
        R = np.ascontiguousarray(np.linalg.inv(R))
    RDC = R @ DC
    F, H = A.copy(), np.empty((2 * n, 2 * n))
    add(F, 0, 0, 1.0, B @ RDC)
    place(H, 0, 0, 1.0, F)
    place(H, 0, n, 1.0, (B @ R) @ transpose(B))
    place(H, n, 0, -1.0, transpose(C) @ C)
    add(H, n, 0, -1.0, transpose(DC) @ RDC)
    place_transposed(H, n, n, -1.0, F)
    wr, wi, info = eigenvalues(H)
    found = np.empty(2 * n)
    count = 0
    for i in range(2 * n):
        if wi[i] > 0.0 and abs(wr[i]) <= 1e-3 * np.hypot(wr[i], wi[i]):
            found[count] = wi[i]
            count += 1
    return np.sort(found[:count]), info


@inlined
def _gain(g, k, Dk):
    """σ_max((I + G K)⁻¹) from the two responses at one frequency."""
    p = g.shape[0]
    if p == 1:
        T = 1.0 + 0.0j
        for i in range(k.shape[0]):
            T += g[0, i] * (k[i, 0] + Dk[i, 0])
        return 1.0 / abs(T)
    add(k, 0, 0, 1.0, Dk)
    L = multiply(g, k)
    for i in range(p):
        L[i, i] += 1.0
    return largest_singular(invert(L))


@compiled
def sensitivity_gain(G, K, Dk, ω):
    """Evaluate σ_max(S(jω)).

    Parameters
    ----------
    G, K : tuples
        Plant and controller as `prepare` returns them.
    Dk : array (m, p)
        Feedthrough of the controller.
    ω : float

    Returns
    -------
    float
    """
    return _gain(response(G, ω), response(K, ω), Dk)


@compiled
def sensitivity_gains(G, K, Dk, ω):
    """Evaluate σ_max(S(jω)) over an array.

    Parameters
    ----------
    G, K, Dk
        As in `sensitivity_gain`.
    ω : array (k,)

    Returns
    -------
    array (k,)
    """
    g, k = responses(G, ω), responses(K, ω)
    out = np.empty(ω.size)
    for i in range(ω.size):
        out[i] = _gain(g[i], k[i], Dk)
    return out


@compiled
def sensitivity_slope(G, K, Dk, ω):
    """σ_max(S(jω)) and dσ_max/dω = Re(u* (dS/dω) v), dS/dω = -S (G'K + GK') S."""
    g, dg = response_and_slope(G, ω)
    k, dk = response_and_slope(K, ω)
    add(k, 0, 0, 1.0, Dk)
    L, dgk, gdk = multiply(g, k), multiply(dg, k), multiply(g, dk)
    p = L.shape[0]
    if p == 1:
        S = 1.0 / (1.0 + L[0, 0])
        gain, dL = abs(S), dgk[0, 0] + gdk[0, 0]
        return gain, (-(S * S) * dL * np.conj(S)).real / gain
    for i in range(p):
        L[i, i] += 1.0
    S = invert(L)
    U, s, Vh = np.linalg.svd(S)
    Sv = np.zeros((p, 1), np.complex128)
    for i in range(p):
        for j in range(p):
            Sv[i, 0] += S[i, j] * np.conj(Vh[0, j])
    a, b = multiply(dgk, Sv), multiply(gdk, Sv)
    for i in range(p):
        a[i, 0] += b[i, 0]
    a = multiply(S, a)
    slope = 0.0
    for i in range(p):
        slope -= (np.conj(U[i, 0]) * a[i, 0]).real
    return s[0], slope


@inlined
def bandwidth(G, K, Dk, As, Bs, Cs):
    """First ω at which σ_max(S) crosses 1/√2 from below; NaN where there is none, and info."""
    p = Bs.shape[1]
    candidates, info = axis_frequencies(As, Bs, Cs, np.eye(p), HALF_POWER)
    n = candidates.size
    if n == 0 or info != 0:
        return np.nan, info
    low = 0.5 * candidates[0]
    f_low = sensitivity_gain(G, K, Dk, low) - HALF_POWER
    if f_low > 0.0:
        return np.nan, info
    for i in range(n):
        high = np.sqrt(candidates[i] * candidates[i + 1]) if i + 1 < n else 2.0 * candidates[i]
        f_high = sensitivity_gain(G, K, Dk, high) - HALF_POWER
        if f_high > 0.0:
            return _level_root(G, K, Dk, low, high, candidates[i]), info
        low = high
    return np.nan, info


@inlined
def _level_root(G, K, Dk, low, high, x):
    """Root of σ_max(S) = 1/√2 in [low, high], Newton from x kept inside the bracket."""
    for _ in range(80):
        gain, slope = sensitivity_slope(G, K, Dk, x)
        f = gain - HALF_POWER
        if f > 0.0:
            high = x
        else:
            low = x
        new = x - f / slope if slope != 0.0 else -1.0
        if not (low < new < high):
            new = 0.5 * (low + high)
        if abs(new - x) <= 1e-14 * x or high - low <= 4e-16 * high:
            return new
        x = new
    return x


@compiled
def _climb(G, K, Dk, start):
    """The local maximum of σ_max(S) uphill of `start`: bracket dσ/dω = 0, then close it."""
    value, slope = sensitivity_slope(G, K, Dk, start)
    a, fa = start, slope
    step = 1.02 if slope > 0.0 else 1.0 / 1.02
    b, fb = a, fa
    for _ in range(60):
        b = a * step
        _, fb = sensitivity_slope(G, K, Dk, b)
        if fa * fb <= 0.0:
            break
        a, fa = b, fb
        step = step**1.6
    if fa * fb > 0.0:
        return start, value
    if a > b:
        a, fa, b, fb = b, fb, a, fa
    x = 0.5 * (a + b)
    side = 0
    for _ in range(100):
        # Illinois false position on the slope, fa > 0 > fb
        x = (a * fb - b * fa) / (fb - fa) if fb != fa else 0.5 * (a + b)
        if not (a < x < b):
            x = 0.5 * (a + b)
        value, fx = sensitivity_slope(G, K, Dk, x)
        if fx == 0.0 or b - a <= 1e-13 * b:
            break
        if fx > 0.0:
            moved = x - a
            a, fa = x, fx
            if side == 1:
                fb *= 0.5
            side = 1
        else:
            moved = b - x
            b, fb = x, fx
            if side == -1:
                fa *= 0.5
            side = -1
        if moved <= 1e-12 * x:
            break
    return x, value


@inlined
def peak(G, K, Dk, As, Bs, Cs, poles_re, poles_im):
    """‖S‖∞, its frequency (0 and inf allowed), and whether the level test confirmed it.

    Starts from the best closed-loop pole frequency, climbs, and tests for a crossing above;
    each round that finds one climbs from there. At most 30 rounds.
    """
    p = Bs.shape[1]
    best, at = 1.0, np.inf
    starts = np.empty(poles_re.size)
    count = 0
    for i in range(poles_re.size):
        if poles_im[i] >= 0.0:
            starts[count] = np.hypot(poles_re[i], poles_im[i])
            count += 1
    gains = sensitivity_gains(G, K, Dk, starts[:count])
    for i in range(count):
        if gains[i] > best:
            best, at = gains[i], starts[i]
    if at < np.inf:
        x, value = _climb(G, K, Dk, at)
        if value >= best:
            best, at = value, x
    for _ in range(30):
        candidates, info = axis_frequencies(As, Bs, Cs, np.eye(p), best * (1.0 + 1e-9))
        if info != 0:
            return best, at, False
        higher, where = best * (1.0 + 1e-9), 0.0
        for i in range(candidates.size):
            for j in range(i, min(i + 2, candidates.size)):  # itself, and between it and the next
                ω = candidates[i] if j == i else np.sqrt(candidates[i] * candidates[j])
                gain = sensitivity_gain(G, K, Dk, ω)
                if gain > higher:
                    higher, where = gain, ω
        if where == 0.0:
            return best, at, True
        x, value = _climb(G, K, Dk, where)
        best, at = (value, x) if value >= higher else (higher, where)
    return best, at, False
