"""Linear algebra of the kernels: LAPACK wrappers, and loops for complex matrices of a few rows.

LAPACK counts by columns: a C array A.T.copy() is A to it, and what it leaves is read transposed.
"""

from typing import NamedTuple

import llvmlite.binding as llvm
import numpy as np
from numba import types
from numba.extending import get_cython_function_address

from ccd_casadi.kernels.compiled import compiled, inlined

_F = types.CPointer(types.float64)
_I = types.CPointer(types.int32)
_C = types.CPointer(types.uint8)
_N, _S, _T, _V = b"NSTV"  # LAPACK's letters: no, scale, transposed, vectors


class JacobiOptions(NamedTuple):
    """Numbers of the singular values by Jacobi's rotations.

    Attributes
    ----------
    cosine : float
        Between columns that count as orthogonal.
    sweeps : int
        Over all pairs of columns, at most; they converge quadratically.
    """

    cosine: float = 1e-14
    sweeps: int = 30


JACOBI = JacobiOptions()


def _external(name: str, *args: types.Type) -> types.ExternalFunction:
    symbol = "ccd_casadi_" + name
    llvm.add_symbol(symbol, get_cython_function_address("scipy.linalg.cython_lapack", name))
    return types.ExternalFunction(symbol, types.void(*args))


# n nrhs a lda ipiv b ldb info
_dgesv = _external("dgesv", _I, _I, _F, _I, _I, _F, _I, _I)
# job n a lda ilo ihi scale info
_dgebal = _external("dgebal", _C, _I, _F, _I, _I, _I, _F, _I)
# jobvs sort select n a lda sdim wr wi vs ldvs work lwork bwork info
_dgees = _external("dgees", _C, _C, _I, _I, _F, _I, _I, _F, _F, _F, _I, _F, _I, _I, _I)
# job compq select n t ldt q ldq wr wi m s sep work lwork iwork liwork info
_dtrsen = _external(
    "dtrsen", _C, _C, _I, _I, _F, _I, _F, _I, _F, _F, _I, _F, _F, _F, _I, _I, _I, _I
)
# trana tranb isgn m n a lda b ldb c ldc scale info
_dtrsyl = _external("dtrsyl", _C, _C, _I, _I, _I, _F, _I, _F, _I, _F, _I, _F, _I)
# jobvl jobvr n a lda wr wi vl ldvl vr ldvr work lwork info
_dgeev = _external("dgeev", _C, _C, _I, _F, _I, _F, _F, _F, _I, _F, _I, _F, _I, _I)


@compiled
def _int(value):
    return np.full(1, value, np.int32)


@compiled
def _char(value):
    return np.full(1, value, np.uint8)


@compiled
def _schur(F):
    """dgees in place: F is A to LAPACK and leaves as Tᵀ; with Qᵀ. Eigenvalues are not sorted."""
    n = F.shape[0]
    V = np.empty((n, n))
    wr, wi = np.empty(n), np.empty(n)
    lwork = 32 * n + 4224  # blocks of 32 for n columns, and dgehrd's 65 x 64
    work = np.empty(lwork)
    info, sdim, logical = _int(0), _int(0), np.zeros(max(1, n), np.int32)
    N = _int(n)
    _dgees(
        _char(_V).ctypes, _char(_N).ctypes, logical.ctypes, N.ctypes, F.ctypes, N.ctypes,
        sdim.ctypes, wr.ctypes, wi.ctypes, V.ctypes, N.ctypes, work.ctypes,
        _int(lwork).ctypes, logical.ctypes, info.ctypes,
    )  # fmt: skip
    return V, wr, wi, info[0]


@inlined
def schur(A):
    """Real Schur form A = Q T Qᵀ (dgees). Returns T, Q, wr, wi, info."""
    F = A.T.copy()
    V, wr, wi, info = _schur(F)
    return F.T.copy(), V.T.copy(), wr, wi, info


@inlined
def balance(A):
    """D⁻¹ A D with rows and columns of one size, and D's diagonal, powers of the radix (dgebal)."""
    F = A.T.copy()
    n = F.shape[0]
    N, low, high, info, scale = _int(n), _int(0), _int(0), _int(0), np.ones(n)
    _dgebal(
        _char(_S).ctypes, N.ctypes, F.ctypes, N.ctypes, low.ctypes, high.ctypes, scale.ctypes,
        info.ctypes,
    )  # fmt: skip
    return F.T.copy(), scale


@compiled
def solve(A, B):
    """X of A X = B, and whether A is regular (dgesv); `numpy.linalg.solve` compiles for 4 s."""
    F, X = A.T.copy(), B.T.copy()
    N, columns, info = _int(A.shape[0]), _int(B.shape[1]), _int(0)
    pivots = np.empty(A.shape[0], np.int32)
    _dgesv(
        N.ctypes, columns.ctypes, F.ctypes, N.ctypes, pivots.ctypes, X.ctypes, N.ctypes, info.ctypes
    )
    return X.T.copy(), info[0] == 0


@compiled
def stable_subspace(H):
    """Schur form of a 2N x 2N Hamiltonian, reordered with its left-half-plane part first.

    X = U2 U1⁻¹ is the stabilising solution of its Riccati equation (Laub, 1979). Returns T11
    (N x N, quasi upper triangular), U1, U2 (N x N) with H [U1; U2] = [U1; U2] T11, the smallest
    |Re λ|/|λ|, how far the spectrum is from the axis, and ok: False where it does not split N to N,
    or LAPACK reports a failure.
    """
    n = H.shape[0]
    half = n // 2
    T = H.T.copy()  # from here on T and Q are held transposed
    Q, wr, wi, info = _schur(T)
    gap = np.inf
    count = 0
    select = np.zeros(n, np.int32)
    for i in range(n):
        size = np.hypot(wr[i], wi[i])
        gap = min(gap, abs(wr[i]) / max(size, 1e-300))
        if wr[i] < 0.0:
            select[i] = 1
            count += 1
    ok = info == 0 and count == half
    if ok:
        N, m, one = _int(n), _int(0), _int(1)
        s, sep, work = np.zeros(1), np.zeros(1), np.empty(max(1, n))
        iwork, lwork, flag = np.zeros(1, np.int32), _int(max(1, n)), _int(0)
        _dtrsen(
            _char(_N).ctypes, _char(_V).ctypes, select.ctypes, N.ctypes, T.ctypes, N.ctypes,
            Q.ctypes, N.ctypes, wr.ctypes, wi.ctypes, m.ctypes, s.ctypes, sep.ctypes,
            work.ctypes, lwork.ctypes, iwork.ctypes, one.ctypes, flag.ctypes,
        )  # fmt: skip
        ok = flag[0] == 0 and m[0] == half
    T11 = T[:half, :half].T.copy()
    U1 = Q[:half, :half].T.copy()
    U2 = Q[:half, half:].T.copy()
    return T11, U1, U2, gap, ok


@compiled
def lyapunov_triangular(T, C, transposed):
    """Z with Tᵀ Z + Z T = C (transposed) or T Z + Z Tᵀ = C, T quasi upper triangular (dtrsyl).

    T is stable, so that no two of its eigenvalues add to 0 and Z is unique.
    """
    n = T.shape[0]
    F = T.T.copy()
    Z = C.T.copy()
    N, scale, info = _int(n), np.ones(1), _int(0)
    first, second = (_T, _N) if transposed else (_N, _T)
    _dtrsyl(
        _char(first).ctypes, _char(second).ctypes, _int(1).ctypes, N.ctypes, N.ctypes,
        F.ctypes, N.ctypes, F.ctypes, N.ctypes, Z.ctypes, N.ctypes, scale.ctypes, info.ctypes,
    )  # fmt: skip
    return Z.T.copy() / scale[0]


@compiled
def eigenvalues(A):
    """Eigenvalues of a real matrix (dgeev, balanced). Returns Re, Im, info."""
    n = A.shape[0]
    F = A.T.copy()
    wr, wi, dummy = np.empty(n), np.empty(n), np.zeros(1)
    lwork = 32 * n + 4224
    work = np.empty(lwork)
    N, one, info = _int(n), _int(1), _int(0)
    _dgeev(
        _char(_N).ctypes, _char(_N).ctypes, N.ctypes, F.ctypes, N.ctypes, wr.ctypes, wi.ctypes,
        dummy.ctypes, one.ctypes, dummy.ctypes, one.ctypes, work.ctypes, _int(lwork).ctypes,
        info.ctypes,
    )  # fmt: skip
    return wr, wi, info[0]


@compiled
def multiply(A, B):
    """Compute A B of matrices of a few rows, real or complex; the product is complex."""
    n, m, count = A.shape[0], B.shape[1], A.shape[1]
    out = np.zeros((n, m), np.complex128)
    for i in range(n):
        for k in range(count):
            factor = A[i, k]
            for j in range(m):
                out[i, j] += factor * B[k, j]
    return out


@compiled
def invert(A):
    """A⁻¹ by Gauss-Jordan elimination with row exchanges; infinite where A is singular."""
    n = A.shape[0]
    M, X = A.copy(), np.zeros((n, n), np.complex128)
    for i in range(n):
        X[i, i] = 1.0
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(M[i, k]) > abs(M[best, k]):
                best = i
        if M[best, k] == 0.0:
            for i in range(n):
                for j in range(n):
                    X[i, j] = np.inf
            return X
        if best != k:
            for j in range(n):
                M[k, j], M[best, j] = M[best, j], M[k, j]
                X[k, j], X[best, j] = X[best, j], X[k, j]
        pivot = 1.0 / M[k, k]
        for j in range(n):
            M[k, j] *= pivot
            X[k, j] *= pivot
        for i in range(n):
            factor = M[i, k]
            if i != k and factor != 0.0:
                for j in range(n):
                    M[i, j] -= factor * M[k, j]
                    X[i, j] -= factor * X[k, j]
    return X


@compiled
def jacobi_svd(M, rows, columns, V, sigma, vectors):
    """M ← M V with orthogonal columns of the lengths σ, the longest first; V is unitary.

    M is the upper left of an array. One-sided rotations (Hestenes; Golub and Van Loan, Matrix
    Computations, 8.6): small σ come out as exactly as large ones. Of columns x and y with a = ‖x‖²,
    b = ‖y‖², h = xᴴy,

        x' = c x - s̄ y,   y' = s x + c y,   c = 1/√(1 + t²),   s = t c h/|h|,

    are orthogonal if t² + t (b - a)/|h| - 1 = 0; the root of the smaller size turns them by less
    than 45 degrees, so that the sweeps converge. Without `vectors` V is left alone.
    """
    if vectors:
        for i in range(columns):
            for j in range(columns):
                V[i, j] = 1.0 if i == j else 0.0
    turned = columns > 1
    for _ in range(JACOBI.sweeps):
        if not turned:
            break
        turned = False
        for i in range(columns - 1):
            for j in range(i + 1, columns):
                a, b, h = 0.0, 0.0, 0.0j
                for k in range(rows):
                    x, y = M[k, i], M[k, j]
                    a += x.real * x.real + x.imag * x.imag
                    b += y.real * y.real + y.imag * y.imag
                    h += x.conjugate() * y
                square = h.real * h.real + h.imag * h.imag
                if not square > JACOBI.cosine**2 * a * b:
                    continue
                turned = True
                size = np.sqrt(square)
                ratio = (b - a) / (2.0 * size)
                t = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
                if ratio < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c / size * h
                back = s.conjugate()
                for k in range(rows):
                    x, y = M[k, i], M[k, j]
                    M[k, i], M[k, j] = c * x - back * y, s * x + c * y
                if vectors:
                    for k in range(columns):
                        x, y = V[k, i], V[k, j]
                        V[k, i], V[k, j] = c * x - back * y, s * x + c * y
    for i in range(columns):
        length = 0.0
        for k in range(rows):
            length += M[k, i].real ** 2 + M[k, i].imag ** 2
        sigma[i] = np.sqrt(length)
    for i in range(columns - 1):
        best = i
        for j in range(i + 1, columns):
            if sigma[j] > sigma[best]:
                best = j
        if best != i:
            sigma[i], sigma[best] = sigma[best], sigma[i]
            for k in range(rows):
                M[k, i], M[k, best] = M[k, best], M[k, i]
            if vectors:
                for k in range(columns):
                    V[k, i], V[k, best] = V[k, best], V[k, i]


@compiled
def largest_singular(M):
    """σ_max of a matrix, which is overwritten."""
    sigma = np.empty(M.shape[1])
    jacobi_svd(M, M.shape[0], M.shape[1], M, sigma, False)
    return sigma[0]


@inlined
def gain_bound(M, rows, columns):
    """An upper bound of σ_max(M), the root of the largest row sum of |MᴴM|: σ_max² = ρ(MᴴM), and
    no eigenvalue exceeds a norm."""
    sums = np.zeros(columns)
    for i in range(columns):
        for j in range(i + 1):
            h = 0.0j
            for k in range(rows):
                h += M[k, i].conjugate() * M[k, j]
            size = np.sqrt(h.real * h.real + h.imag * h.imag)
            sums[i] += size
            if j < i:
                sums[j] += size
    return np.sqrt(sums.max())
