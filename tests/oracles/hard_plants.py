"""Plants that others reported as hard, from the published data: standard plants with their source.

`gamma` is the published optimum where there is one, `digits` its rounding or search tolerance.
`irregular`: D12 or D21 without full rank, or a zero on the axis; Riccati solvers may have neither.
"""

from dataclasses import dataclass, replace

import control
import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.extensions.cross_check.backends import (
    StandardPlant,
    balance,
    mixed_sensitivity,
    solve_slicot,
)
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.synthesis import synthesise
from ccd_casadi.synthesis.weights import Weights

Rows = list[list[float]]


@dataclass(frozen=True)
class HardPlant:
    source: str
    plant: StandardPlant
    gamma: float | None = None
    digits: float = 0.0
    irregular: bool = False


def from_parts(
    A: Array, B: Array, C: Array, D: Array, measured: int, controls: int
) -> StandardPlant:
    """Partition a state space: the last `measured` outputs and last `controls` inputs."""
    A, B, C, D = (np.array(part, dtype=float, ndmin=2) for part in (A, B, C, D))
    w, z = B.shape[1] - controls, C.shape[0] - measured
    return StandardPlant(
        A, B[:, :w], B[:, w:], C[:z], C[z:], D[:z, :w], D[:z, w:], D[z:, :w], D[z:, w:]
    )


def close(plant: StandardPlant, K: StateSpace) -> StateSpace:
    """The loop from w to z, by python-control."""
    P, controller = (control.ss(*vars(part).values()) for part in (plant.whole(), K))
    loop = P.lft(controller)
    return StateSpace(*(np.asarray(M) for M in (loop.A, loop.B, loop.C, loop.D)))


def regularised(plant: StandardPlant, size: float) -> StandardPlant:
    """The plant with small disturbances of every state and measurement, and small costs of them.

    Its loop contains the given one: a controller that keeps its norm below γ keeps the other's
    too. `size` is relative to B1, C1 and to D12, D21.
    """
    n, m, p = len(plant.A), plant.B2.shape[1], plant.C2.shape[0]
    z, w = plant.D11.shape
    b = size * (np.linalg.norm(plant.B1, 2) or 1.0)
    c = size * (np.linalg.norm(plant.C1, 2) or 1.0)
    d12, d21 = (size * (np.linalg.norm(part, 2) or 1.0) for part in (plant.D12, plant.D21))
    return StandardPlant(
        A=plant.A,
        B1=np.hstack([plant.B1, b * np.eye(n), np.zeros((n, p))]),
        B2=plant.B2,
        C1=np.vstack([plant.C1, c * np.eye(n), np.zeros((m, n))]),
        C2=plant.C2,
        D11=np.block([[plant.D11, np.zeros((z, n + p))], [np.zeros((n + m, w + n + p))]]),
        D12=np.vstack([plant.D12, np.zeros((n, m)), d12 * np.eye(m)]),
        D21=np.hstack([plant.D21, np.zeros((p, n)), d21 * np.eye(p)]),
        D22=plant.D22,
    )


def given(
    A: Rows, B: Rows, C: Rows, D: Rows, measured: int = 1, controls: int = 1
) -> StandardPlant:
    return from_parts(*(np.array(M, float) for M in (A, B, C, D)), measured, controls)


def augmented(G: control.StateSpace, W: control.StateSpace, effort: bool) -> StandardPlant:
    """z = (W e, u) or W e alone, y = e = w - G u. (control.augw warns of what it is made with.)"""
    p, m, n, z = G.noutputs, G.ninputs, len(G.A), W.noutputs
    A = block_diag(G.A, W.A)
    A[n:, :n] = -W.B @ G.C
    B = np.vstack([np.hstack([np.zeros((n, p)), G.B]), np.hstack([W.B, -W.B @ G.D])])
    Wz = [np.hstack([-W.D @ G.C, W.C]), np.hstack([W.D, -W.D @ G.D])]
    u = [np.zeros((m, len(A))), np.hstack([np.zeros((m, p)), np.eye(m)])]
    e = [np.hstack([-G.C, np.zeros((p, len(A) - n))]), np.hstack([np.eye(p), -G.D])]
    rows = [Wz, u, e] if effort else [Wz, e]
    C, D = (np.vstack([row[i] for row in rows]) for i in (0, 1))
    assert C.shape[0] == z + effort * m + p
    return from_parts(A, B, C, D, p, m)


def performance_weight(bandwidth: float, peak: float, low: float) -> control.StateSpace:
    return control.ss(control.tf([1.0 / peak, bandwidth], [1.0, bandwidth * low]))


def balancing_board() -> StandardPlant:
    """A board on wheels (θ, x and rates) with the weights of dkpy #46, of which one has 5e6 rad/s.

    The issue's own A and B were not within our reach: these are of a board of its 0.553 m.
    """
    fall, roll = 26.6, 4.0  # 1/s² and m/s² a rad
    A = np.zeros((5, 5))
    A[0, 2] = A[1, 3] = 1.0
    A[2, 0], A[3, 0] = fall, -roll
    A[4, 4] = -5e6
    force = np.array([0.0, 0.0, -20.0, 8.0])
    B = np.zeros((5, 6))
    B[:4, 0], B[2, 1], B[3, 2] = force, 10.0, 8.0
    B[:4, 5], B[4, 5] = force, 1e3
    B[:, :3] *= 0.0735
    C, D = np.zeros((5, 5)), np.zeros((5, 6))
    C[0, 0], C[1, 1] = 1 / 0.1745, 1 / 0.5
    # W_u = (1e6 s + 5e6)/0.184/(s + 5e6)
    C[2, 4], D[2, 5] = (5e6 - 5e6 * 1e6) / 0.184 / 1e3, 1e6 / 0.184
    C[3, 0], C[4, 1] = 1.0, 1.0
    D[3, 3], D[4, 4] = 0.087266, 0.015
    return from_parts(A, B, C, D, 2, 1)


def skogestad_3_8(first: float, second: float) -> StandardPlant:
    """Skogestad & Postlethwaite, example 3.8: 2 x 2 with a zero at s = 0.5."""
    den = [0.2, 1.2, 1.0]
    G = control.ss(control.tf([[[1.0], [1.0]], [[2.0, 1.0], [2.0]]], [[den, den], [den, den]]))
    W = [performance_weight(w, 1.5, 1e-4) for w in (first, second)]
    return augmented(G, control.append(*W), True)


def skogestad_2_17(order: int) -> StandardPlant:
    """Skogestad & Postlethwaite, example 2.17, with W_P of this order."""
    G = control.ss(
        control.tf([200.0], np.polymul([10.0, 1.0], np.polymul([0.05, 1.0], [0.05, 1.0])))
    )
    W = performance_weight(10.0, 1.5, 1e-4)
    if order == 2:
        root = performance_weight(10.0, 1.5**0.5, 1e-2)
        W = root * root
    return augmented(G, W, True)


def compleib_AC2() -> StandardPlant:
    A = [[0, 0, 1.132, 0, -1], [0, -0.0538, -0.1712, 0, 0.0705], [0, 0, 0, 1, 0],
         [0, 0.0485, 0, -0.8556, -1.013], [0, -0.2909, 0, 1.0532, -0.6859]]  # fmt: skip
    B1 = [[0.03593, 0, 0.01672], [0, 0.00989, 0], [0, -0.07548, 0], [0, 0, 0.05635],
          [0.00145, 0, 0.06743]]  # fmt: skip
    B2 = [[0, 0, 0], [-0.12, 1, 0], [0, 0, 0], [4.419, 0, -1.665], [1.575, 0, -0.0732]]
    C1, D = np.zeros((5, 5)), np.zeros((8, 6))
    C1[0, 1] = C1[1, 2] = 0.5**0.5
    D[2:5, 3:] = 0.5**0.5 * np.eye(3)
    return given(A, np.hstack([B1, B2]), np.vstack([C1, np.eye(3, 5)]), D, 3, 3)


def compleib_HE5() -> StandardPlant:
    A = np.array([
        [0, 0, 0, 0.99857378005981, 0.05338427424431, 0, 0, 0],
        [0, 0, 1.0, -0.0031822193414, 0.0595246553421, 0, 0, 0],
        [0, 0, -11.5704956054688, -2.54463768005371, -0.0636026263237, 0.10678052902222,
         -0.09491866827011, 0.00710757449269],
        [0, 0, 0.43935656547546, -1.99818229675293, 0, 0.01665188372135, 0.01846204698086,
         -0.00118747074157],
        [0, 0, -2.04089546203613, -0.4589991569519, -0.73502779006958, 0.01925575733185,
         -0.00459562242031, 0.00212036073208],
        [-32.1036071777344, 0, -0.50335502624512, 2.29785919189453, 0, -0.0212158113718,
         -0.02116791903973, 0.01581159234047],
        [0.10216116905212, 32.0578308105469, -2.34721755981445, -0.50361156463623,
         0.83494758605957, 0.02122657001019, -0.0378797352314, 0.00035400385968],
        [-1.91097259521484, 1.71382904052734, -0.00400543212891, -0.05741119384766, 0,
         0.01398963481188, -0.00090675335377, -0.29051351547241],
    ])  # fmt: skip
    B2 = np.array([
        [0, 0, 0, 0], [0, 0, 0, 0],
        [0.12433505058289, 0.08278584480286, -2.75247764587402, -0.01788876950741],
        [-0.03635892271996, 0.47509527206421, 0.01429074257612, 0],
        [0.30449151992798, 0.01495801657438, -0.49651837348938, -0.20674192905426],
        [0.28773546218872, -0.54450607299805, -0.01637935638428, 0],
        [-0.01907348632812, 0.01636743545532, -0.54453611373901, 0.23484230041504],
        [-4.82063293457031, -0.00038146972656, 0, 0],
    ])  # fmt: skip
    B1, C, D = np.zeros((8, 3)), np.zeros((6, 8)), np.zeros((6, 7))
    B1[2:5] = np.eye(3)
    C[0, 5:] = 0.0595, 0.05329, -0.9968
    C[1, 0] = C[2, 1] = C[3, 4] = C[4, 2] = C[5, 3] = 1.0
    C[3, 3] = -0.05348
    D[:4, 3:] = np.eye(4)
    D[4, 0] = D[5, 1] = 0.01
    return given(A, np.hstack([B1, B2]), C, D, 2, 4)


SLICOT_DOCUMENTED = given(
    [[-1, 0, 4, 5, -3, -2], [-2, 4, -7, -2, 0, 3], [-6, 9, -5, 0, 2, -1], [-8, 4, 7, -1, -3, 0],
     [2, 5, 8, -9, 1, -4], [3, -5, 8, 0, 2, -6]],
    [[-3, -4, -2, 1, 0], [2, 0, 1, -5, 2], [-5, -7, 0, 7, -2], [4, -6, 1, 1, -2], [-3, 9, -8, 0, 5],
     [1, -2, 3, -6, -2]],
    [[1, -1, 2, -4, 0, -3], [-3, 0, 5, -1, 1, 1], [-7, 5, 0, -8, 2, -2], [9, -3, 4, 0, 3, 7],
     [0, 1, -2, 1, -6, -2]],
    [[1, -2, -3, 0, 0], [0, 4, 0, 1, 0], [5, -3, -4, 0, 1], [0, 1, 0, 1, -3], [0, 0, 1, 7, 1]],
    2, 2,
)  # fmt: skip

HARD = {
    item.source: item
    for item in (
        HardPlant(
            "python-control #152",
            given([[-0.01, -0.992], [0, -0.75]], [[0.992, 0], [0, 1]], [[1, -0.8], [0, -1]],
                  [[0.8, 0], [1, 0]]),
            irregular=True,
        ),
        HardPlant(
            "python-control #367",
            given([[-1, 0, 0], [0, -12, -5], [0, 4, 0]], [[2, 0], [0, 0.5], [0, 0]],
                  [[-0.5, 0, -0.5], [0, 0, 0], [-0.5, 0, -0.5]], [[0, 0], [0, 1], [0, 0]]),
            irregular=True,
        ),
        HardPlant(
            "python-control #973",
            augmented(control.ss(control.tf([1, 1], [1, 0.5, 4])),
                      control.ss(control.tf([2, -2.2, 1], [3, 0.2, 0.01])), False),
            irregular=True,
        ),
        HardPlant(
            "python-control #895 (Scherer 1997)",
            given([[0, 10, 2], [-1, 1, 0], [0, 2, -5]], [[1, 0], [0, 1], [1, 0]],
                  [[1, 0, 0], [0, 0, 0], [0, 1, 0]], [[0, 0], [0, 1], [2, 0]]),
        ),
        HardPlant(
            "pkg-control #14",  # z = x and W_u u, W_u = 10(s + 1)/(s + 100)
            given([[0, 1, 0], [0, 0, 0], [0, 0, -100]], [[0, 0], [1, 1], [0, 1]],
                  [[1, 0, 0], [0, 0, -990], [1, 0, 0]], [[0, 0], [0, 10], [0, 0]]),
            irregular=True,
        ),
        HardPlant("dkpy #46 (its weights)", balancing_board()),
        HardPlant(
            "RobustAndOptimalControl 1",
            given(-np.eye(2), [[0, 0, 1], [0, 1, 1]], [[1, 0], [0, 1], [1, 1]],
                  [[0.5, 0, 0], [0, 0.5, 1], [0, 1, 0]]),
            gamma=0.806, digits=1e-3,
        ),
        HardPlant(
            "RobustAndOptimalControl 2",
            given([[0, 1, 0], [-1.2000000000000002e-6, -0.12000999999999999, 0], [-11.2, 0, -2e-7]],
                  [[0, 0], [0, 1], [1, 0]],
                  [[-7.466666666666666, 0, 19.999999866666666], [0, 0, 0], [-11.2, 0, 0]],
                  [[0.6666666666666666, 0], [0, 1], [1, 0]]),
            gamma=4.4825150, digits=2e-2,
        ),
        HardPlant("SLICOT SB10FD", SLICOT_DOCUMENTED),
        HardPlant("Slycot SB10AD", given([[-1]], [[1, 1]], [[1], [1]], [[0, 1], [1, 0]])),
        HardPlant("Skogestad 3.8, 0.25 and 0.25", skogestad_3_8(0.25, 0.25), 2.80, 5e-3),
        HardPlant("Skogestad 3.8, 0.25 and 25", skogestad_3_8(0.25, 25.0), 2.92, 5e-3),
        HardPlant("Skogestad 3.8, 25 and 0.25", skogestad_3_8(25.0, 0.25), 6.73, 1e-2),
        HardPlant("Skogestad 2.17, design 1", skogestad_2_17(1), 1.37, 5e-3),
        HardPlant("Skogestad 2.17, design 2", skogestad_2_17(2), 2.19, 1e-2),
        HardPlant("COMPleib AC2", compleib_AC2(), 0.1115, 5e-5, irregular=True),
        HardPlant(
            "COMPleib AC4",
            given([[-0.876, 1, -0.1209, 0], [8.9117, 0, -130.75, 0], [0, 0, -150, 0],
                   [-1, 0, 0, -0.05]],
                  [[0, 0, 0], [0, 0, 0], [0, 0, 150], [0, 1, 0]],
                  [[-0.25, 0, 0, 3.487], [0, 0, -3, 0], [-1, 0, 0, 0], [0, -1, 0, 0]],
                  [[0, 0.25, 0], [0, 0, 3], [0, 1, 0], [0.01, 0, 0]], 2, 1),
            gamma=0.5573, digits=5e-4,
        ),
        HardPlant("COMPleib HE5", compleib_HE5()),
    )
}  # fmt: skip


def drawn_weights(rng: np.random.Generator, w0: float, disturbed: bool = False) -> Weights:
    """Weights about ω₀ in rad/s, of M_K = 1."""
    return Weights(
        M_S=rng.uniform(1.2, 3.0), A_S=10.0 ** rng.uniform(-3.0, -1.0),
        omega_S=w0 * 10.0 ** rng.uniform(-1.5, 0.5), c_K=10.0 ** rng.uniform(1.0, 3.0),
        omega_K=w0 * 10.0 ** rng.uniform(0.0, 1.5), M_K=1.0, A_l=rng.uniform(0.8, 1.5),
        A_u=10.0 ** rng.uniform(-2.0, -0.5), omega_T=w0 * 10.0 ** rng.uniform(0.0, 1.5),
        disturbance=10.0 ** rng.uniform(-1.0, 1.0) if disturbed else 0.0,
    )  # fmt: skip


def distance_to_sb10ad(own: ScaledPlant, weights: Weights, gamma: float) -> float:
    """The relative distance of γ_opt from SB10AD's; NaN where that is useless or makes no claim.

    Of its two claims, with z in two units, the nearest counts: by chance none is within 1e-6.
    """
    standard, found = balance(mixed_sensitivity(own, weights)), [np.inf]
    if gamma > 1e3:  # zeros beside unstable poles: rounding decides
        return np.nan
    for s in (1.0, 300.0 / gamma):  # it searches to absolute tolerances, and loses digits
        scaled = {name: s * getattr(standard, name) for name in ("C1", "D11", "D12")}
        found.append(abs(solve_slicot(replace(standard, **scaled)).gamma_opt / s / gamma - 1.0))
    least = float(np.nanmin(found))
    return least if np.isfinite(least) else np.nan


def far_from_sb10ad(plant: ScaledPlant, own: ScaledPlant, weights: Weights) -> float:
    """The distance of the γ_opt of a plant from SB10AD's of `own`, on which its controller is
    judged too; NaN where it is useless or the bound limits it."""
    w0 = own.omega_0
    done = synthesise(plant, weights, omega_low=1e-2 * w0)
    figures = done.figures
    if figures.gamma_opt > 1e3:
        return np.nan
    assert figures.certificate.passed, figures.outcome
    outputs, inputs = len(plant.C), plant.B.shape[1]
    assert len(done.controller.A) == len(plant.A) + 2 * outputs + inputs  # as of a stable plant
    standard, K = balance(mixed_sensitivity(own, weights)), done.controller
    norm = hinf_norm(close(standard, StateSpace(K.A / w0, K.B / w0, K.C, K.D)))[0]
    assert norm <= figures.certificate.norm_bound * (1.0 + 1e-8)
    # what the bound limits SB10AD decides by rounding
    limited = figures.limited_by_bound
    return np.nan if limited else distance_to_sb10ad(own, weights, figures.gamma_opt)
