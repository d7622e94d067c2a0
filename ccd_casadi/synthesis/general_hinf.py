"""H∞ controllers of general plants in python-control's conventions: `hinfsyn` and `mixsyn`.

The plant takes w and u to z and y,

    ẋ = A x + B1 w + B2 u,   z = C1 x + D11 w + D12 u,   y = C2 x + D21 w + D22 u

and u = K y makes the largest gain from w to z as small as it can be. With orthogonal turns of w
and z, and other units of u and y, D12 = [0; I] and D21 = [0 I]. At a level γ two Riccati equations

    X = Ric(A, B, C1, D1•, R),    R  = D1•ᵀD1• - diag(γ² I, 0),   D1• = [D11 D12]
    Y = Ric(Aᵀ, Cᵀ, B1ᵀ, D•1ᵀ, R̃),  R̃ = D•1D•1ᵀ - diag(γ² I, 0),   D•1 = [D11; D21]

have a controller where both exist, X >= 0, Y >= 0 and ρ(XY) < γ². γ is found by bisection. What is
returned is judged on its closed loop alone: its poles, its H∞ norm (`lti.norms`), and the gains of
P and K apart.

References
----------
K. Zhou, J. C. Doyle and K. Glover, Robust and Optimal Control, Prentice Hall 1996, theorem 17.1.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag, svd

from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, balance_system
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError, describe
from ccd_casadi.support.text import HZ
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis.general_levels import (
    GeneralPlant,
    HinfCertificate,
    HinfFailure,
    HinfOptions,
    NoHinfController,
    central_controller,
    largest_apart,
    least_level,
    lower_transformation,
    spectral_norm,
)

if TYPE_CHECKING:
    import control


class HinfDesign(NamedTuple):
    """The result of `control.hinfsyn`, with the certificate in place of `rcond`."""

    K: "control.StateSpace"
    CL: "control.StateSpace"
    gamma: float
    certificate: HinfCertificate


class MixsynDesign(NamedTuple):
    """The result of `control.mixsyn`: `info` is γ and the certificate."""

    K: "control.StateSpace"
    CL: "control.StateSpace"
    info: tuple[float, HinfCertificate]


def hinfsyn(
    P: Any, nmeas: int, ncon: int, *, options: HinfOptions = HinfOptions()
) -> HinfDesign:  # fmt: skip
    """Make the controller u = K y that minimises ‖F_l(P, K)‖∞, and certify its closed loop.

    Parameters
    ----------
    P : control.StateSpace, or what `control.ss` takes
        Continuous; its last `ncon` inputs are u, its last `nmeas` outputs are y. It may be
        unstable, and D11 and D22 may be any matrices.
    nmeas, ncon : int
    options : HinfOptions

    Returns
    -------
    HinfDesign
        K, the closed loop from w to z, γ and its certificate.

    Raises
    ------
    NoHinfController
        An assumption does not hold, named with its remedy, or nothing is certified.
    UserError
        P is in discrete time, or has too few inputs or outputs.

    Examples
    --------
    >>> import control as ct
    >>> P = ct.ss([[1.0]], [[1.0, 0.0, 1.0]], [[1.0], [0.0], [1.0]],
    ...           [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    >>> found = hinfsyn(P, 1, 1)
    >>> round(found.certificate.gamma_opt, 5), found.certificate.max_real_pole < 0.0
    (2.73205, True)
    """
    import control as ct

    system = _state_space(P, "hinfsyn: P")
    if not all(isinstance(number, int | np.integer) for number in (nmeas, ncon)):
        raise UserError("hinfsyn: nmeas and ncon are numbers of signals; give whole numbers")
    if system.isdtime(strict=True):
        raise UserError("hinfsyn: P is in discrete time; map it by the bilinear rule, which keeps "
                        "gains, and K back")  # fmt: skip
    plant = _matrices(system)
    p, m = plant.D.shape
    if not (0 < nmeas < p and 0 < ncon < m):
        raise UserError(f"hinfsyn: P has {p} outputs and {m} inputs; nmeas and ncon are to leave "
                        "at least one z and one w, and to be at least 1")  # fmt: skip
    with one_blas_thread:
        K, CL, certificate = general_synthesis(plant, nmeas, ncon, options)
    made = [ct.ss(each.A, each.B, each.C, each.D) for each in (K, CL)]
    return HinfDesign(made[0], made[1], certificate.gamma, certificate)


def mixsyn(
    g: Any, w1: Any = None, w2: Any = None, w3: Any = None, *,
    options: HinfOptions = HinfOptions(),
) -> MixsynDesign:  # fmt: skip
    """Make the controller that minimises ‖[W1 S; W2 K S; W3 T]‖∞, and certify its closed loop.

    Parameters
    ----------
    g : control.StateSpace or control.TransferFunction
        The plant, from u to y.
    w1, w2, w3 : the same, or None
        Weights of S, K S and T, of one channel or square; at least one. A number is a gain.
    options : HinfOptions

    Returns
    -------
    MixsynDesign
        K takes e = r - y to u, as in `control.mixsyn`.

    Raises
    ------
    NoHinfController
        See `hinfsyn`. Without `w2` every control has to be seen in `w3` T at high frequency.
    """
    import control as ct

    if w1 is None and w2 is None and w3 is None:
        raise UserError("mixsyn: no weight is given; give w1, w2 or w3")
    plant = _state_space(g, "mixsyn: g")
    weights = [None if w is None else _state_space(w, f"mixsyn: w{i}")
               for i, w in enumerate((w1, w2, w3), 1)]  # fmt: skip
    if any(each is not None and each.isdtime(strict=True) for each in (plant, *weights)):
        raise UserError("mixsyn: the plant or a weight is in discrete time; see hinfsyn")
    p, m = plant.noutputs, plant.ninputs
    systems = [None if w is None else _square(w, size, f"w{i}")
               for i, (w, size) in enumerate(zip(weights, (p, m, p), strict=True), 1)]  # fmt: skip
    P = weighted_plant(_matrices(plant), systems)
    found = hinfsyn(ct.ss(P.A, P.B, P.C, P.D), p, m, options=options)
    return MixsynDesign(found.K, found.CL, (found.gamma, found.certificate))


def _state_space(system: Any, name: str) -> "control.StateSpace":
    """A system as python-control has it; UserError where it is none, or is not finite."""
    import control as ct

    if isinstance(system, int | float | np.number):  # a gain
        system = ct.ss([], [], [], [[float(system)]])
    try:
        made = system if isinstance(system, ct.StateSpace) else ct.ss(system)
    except (TypeError, ValueError, NotImplementedError) as error:
        raise UserError(
            f"{name} is no proper system of python-control ({describe(error)}); give a "
            "StateSpace or a proper TransferFunction"
        ) from None
    if not all(np.isfinite(part).all() for part in (made.A, made.B, made.C, made.D)):
        raise UserError(f"{name} has an entry that is not finite")
    return made


def _matrices(system: "control.StateSpace") -> StateSpace:
    parts = (system.A, system.B, system.C, system.D)
    return StateSpace(*(np.asarray(part, float) for part in parts))


def _square(weight: "control.StateSpace", size: int, name: str) -> StateSpace:
    """A weight of `size` channels; one of a single channel is repeated."""
    own = _matrices(weight)
    rows, columns = own.D.shape
    if columns == size:
        return own
    if (rows, columns) != (1, 1):
        raise UserError(f"mixsyn: {name} has {columns} inputs for {size} channels; give it {size}, "
                        "or a weight of one channel")  # fmt: skip
    parts = (block_diag(*[part] * size) for part in (own.A, own.B, own.C, own.D))
    return StateSpace(*parts)


def weighted_plant(G: StateSpace, weights: Sequence[StateSpace | None]) -> StateSpace:
    """The general plant of mixed sensitivity, z = (W1 e, W2 u, W3 G u), y = e = r - G u.

    Inputs are (r, u), outputs (z, y); states those of G, then of the weights W1, W2, W3.
    """
    (p, m), n = G.D.shape, len(G.A)
    of = (  # what drives each weight: of the states of G, of r and of u
        (-G.C, np.eye(p), -G.D), (np.zeros((m, n)), np.zeros((m, p)), np.eye(m)),
        (G.C, np.zeros((p, p)), G.D),
    )  # fmt: skip
    A, B = [[G.A]], [np.hstack([np.zeros((n, p)), G.B])]
    C, D = [], []
    given = [(W, *drive) for W, drive in zip(weights, of, strict=True) if W is not None]
    orders = [len(W.A) for W, *_ in given]
    for i, (W, x, r, u) in enumerate(given):
        before, after = sum(orders[:i]), sum(orders[i + 1 :])
        A.append([W.B @ x, np.zeros((orders[i], before)), W.A, np.zeros((orders[i], after))])
        B.append(np.hstack([W.B @ r, W.B @ u]))
        rows = len(W.C)
        C.append(np.hstack([W.D @ x, np.zeros((rows, before)), W.C, np.zeros((rows, after))]))
        D.append(np.hstack([W.D @ r, W.D @ u]))
    rest = np.zeros((n, sum(orders)))
    A[0].append(rest)
    C.append(np.hstack([-G.C, np.zeros((p, sum(orders)))]))
    D.append(np.hstack([np.eye(p), -G.D]))
    return StateSpace(
        np.vstack([np.hstack(row) for row in A]), np.vstack(B), np.vstack(C), np.vstack(D)
    )


def general_synthesis(
    P: StateSpace, nmeas: int, ncon: int, options: HinfOptions = HinfOptions()
) -> tuple[StateSpace, StateSpace, HinfCertificate]:
    """The controller, the closed loop from w to z and its certificate; see `hinfsyn`.

    Parameters
    ----------
    P : StateSpace
    nmeas, ncon : int
    options : HinfOptions

    Returns
    -------
    K, CL : StateSpace
    certificate : HinfCertificate

    Raises
    ------
    NoHinfController
    """
    A, B, C = balance_system(P.A, P.B, P.C) if len(P.A) else (P.A, P.B, P.C)
    p1, m1 = P.D.shape[0] - nmeas, P.D.shape[1] - ncon
    D12, D21, D22 = P.D[:p1, m1:], P.D[p1:, :m1], P.D[p1:, m1:]
    require_assumptions(A, B[:, :m1], B[:, m1:], C[:p1], C[p1:], D12, D21, options)
    U, s, Vt = svd(D12)
    turn_z = np.hstack([U[:, ncon:], U[:, :ncon]])
    unit_u = s[:, None] * Vt
    U, s, Vt = svd(D21)
    turn_w = np.vstack([Vt[nmeas:], Vt[:nmeas]]).T
    unit_y = U * s
    gp = GeneralPlant(
        A, B[:, :m1] @ turn_w, B[:, m1:] @ np.linalg.inv(unit_u), turn_z.T @ C[:p1],
        np.linalg.solve(unit_y, C[p1:]), turn_z.T @ P.D[:p1, :m1] @ turn_w, unit_u, unit_y,
    )  # fmt: skip
    gamma, below, why = least_level(gp, options)
    for step in range(options.tries):
        level = gamma * (1.0 + options.above * options.wider**step)
        made = central_controller(gp, level, options)
        if isinstance(made, str):
            continue
        K = _with_feedthrough(made, D22)
        if len(K.A):
            K = StateSpace(*balance_system(K.A, K.B, K.C), K.D)
        CL = lower_transformation(P, K, nmeas, ncon)
        slowest = float(np.linalg.eigvals(CL.A).real.max(initial=-np.inf))
        norm, _ = hinf_norm(CL)  # infinite where it is not stable
        apart, rounding = largest_apart(P, K, CL)
        bound = max(level, norm, apart) * (1.0 + options.room) + options.guard * rounding
        if bound <= level * (1.0 + options.lost):  # no more than what rounding may add
            return K, CL, HinfCertificate(bound, norm, gamma, slowest, below, why)
    raise NoHinfController(
        HinfFailure.NOT_CERTIFIED,
        f"at γ = {gamma:.6g} and up to {options.tries} levels above it the closed loop is not "
        "stable with a gain below γ in double precision; scale the plant, or move weights' poles "
        "and zeros closer together",
    )


def require_assumptions(
    A: Array, B1: Array, B2: Array, C1: Array, C2: Array, D12: Array, D21: Array,
    options: HinfOptions = HinfOptions(),
) -> None:  # fmt: skip
    """Raise NoHinfController for the first assumption that does not hold.

    (A, B2) is stabilisable and (C2, A) detectable; D12 has full column and D21 full row rank;
    [A - jω B2; C1 D12] has full column and [A - jω B1; C2 D21] full row rank at every ω. With D12
    of full column rank the former loses rank at jω where (A - B2 D12⁺C1, (1 - D12 D12⁺)C1) does.
    """
    rows = (
        (A, B2, HinfFailure.NOT_STABILISABLE, "u does not move"),
        (A.T, C2.T, HinfFailure.NOT_DETECTABLE, "y does not see"),
    )
    for M, N, reason, what in rows:
        lost = _lost(M, N, lambda pole, size: pole.real >= -options.axis * size, options)
        if lost is not None:
            raise NoHinfController(
                reason, f"{what} the mode at {_place(lost)}; no controller stabilises it"
            )
    if D12.shape[0] < D12.shape[1] or _rank(D12, options) < D12.shape[1]:
        raise NoHinfController(
            HinfFailure.CONTROL_FREE,
            "D12 has not full column rank: some control costs nothing at high frequency; give w2, "
            "or a row of z with a share of u in it",
        )
    if D21.shape[1] < D21.shape[0] or _rank(D21, options) < D21.shape[0]:
        raise NoHinfController(
            HinfFailure.MEASUREMENT_EXACT,
            "D21 has not full row rank: some measurement is free of w at high frequency; add noise "
            "to it, a column of w with a share in y",
        )
    pairs = (
        (A, B2, C1, D12, HinfFailure.ZERO_OF_P12, "a weight, or a row of z"),
        (A.T, C2.T, B1.T, D21.T, HinfFailure.ZERO_OF_P21, "a disturbance, or a column of w"),
    )
    for M, B, C, D, reason, remedy in pairs:
        back = np.linalg.pinv(D)
        rest = (np.eye(len(D)) - D @ back) @ C
        inside = M - B @ back @ C
        lost = _lost(inside.T, rest.T, lambda pole, size: abs(pole.real) <= options.axis * size,
                     options)  # fmt: skip
        if lost is not None:
            raise NoHinfController(
                reason,
                f"at {_place(lost)}; move the pole or zero there off the axis, or add {remedy} "
                "that sees it (an integrator in a weight: s + 1e-3 of its corner for s)",
            )


def _lost(
    A: Array, B: Array, counts: Callable[[complex, float], bool], options: HinfOptions
) -> complex | None:
    """The first eigenvalue that counts at which [A - λ, B] has not full row rank."""
    scale = max(spectral_norm(A), 1e-300)
    for pole in np.linalg.eigvals(A) if len(A) else ():
        if counts(complex(pole), scale):
            pencil = np.hstack(
                [A - pole * np.eye(len(A)), B / max(spectral_norm(B), 1e-300) * scale]
            )
            if svd(pencil, compute_uv=False)[-1] <= options.uncontrolled * scale:
                return complex(pole)
    return None


def _place(pole: complex) -> str:
    if abs(pole.imag) <= 1e-12 * max(abs(pole), 1e-300):
        return f"s = {pole.real:.4g} rad/s"
    return f"{abs(pole.imag) / HZ:.4g} Hz (s = {pole.real:.3g} +- {abs(pole.imag):.4g}j rad/s)"


def _with_feedthrough(K: StateSpace, D22: Array) -> StateSpace:
    """The controller for y + D22 u: u = (1 + K D22)⁻¹ K y."""
    left = np.linalg.inv(np.eye(len(K.C)) + K.D @ D22)
    right = np.eye(len(D22)) - D22 @ left @ K.D
    return StateSpace(
        K.A - K.B @ D22 @ left @ K.C, K.B @ right, left @ K.C, left @ K.D
    )  # fmt: skip


def _rank(M: Array, options: HinfOptions) -> int:
    s = svd(M, compute_uv=False)
    return int((s > options.rank * max(s[0], 1e-300)).sum())
