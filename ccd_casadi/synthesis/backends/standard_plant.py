"""The standard plant of H∞ control, its loop with a controller, and what makes it solvable.

ẋ = A x + B1 w + B2 u,   z = C1 x + D11 w + D12 u,   y = C2 x + D21 w + D22 u,   u = K y
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.kernels.generalized_plant import first_order_weights, generalized_plant
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace, balanced
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.norms import hinf_norm
from ccd_casadi.synthesis.synthesis import Certificate
from ccd_casadi.synthesis.weights import Weights

RANK = 1e-9  # relative: a singular value below it is zero
ON_AXIS = 1e-9  # |Re λ| over the largest |λ| of a pole that counts as on the axis


@dataclass(frozen=True)
class StandardPlant:
    """(A, [B1 B2], [C1; C2], [D11 D12; D21 D22]), partitioned."""

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    D11: Array
    D12: Array
    D21: Array
    D22: Array

    @classmethod
    def from_parts(
        cls, A: Array, B: Array, C: Array, D: Array, measured: int, controls: int
    ) -> "StandardPlant":
        """Partition a state space: the last `measured` outputs and last `controls` inputs."""
        A, B, C, D = (np.array(part, dtype=float, ndmin=2) for part in (A, B, C, D))
        w, z = B.shape[1] - controls, C.shape[0] - measured
        return cls(
            A, B[:, :w], B[:, w:], C[:z], C[z:],
            D[:z, :w], D[:z, w:], D[z:, :w], D[z:, w:],
        )  # fmt: skip

    def whole(self) -> StateSpace:
        """The plant as one state space."""
        return StateSpace(
            self.A,
            np.hstack([self.B1, self.B2]),
            np.vstack([self.C1, self.C2]),
            np.block([[self.D11, self.D12], [self.D21, self.D22]]),
        )


def mixed_sensitivity(plant: ScaledPlant, weights: Weights) -> StandardPlant:
    """[W_S S; W_KS KS; W_T T] as r to z, with y = e = r - Gu, in the plant's scaled units.

    With `weights.disturbance` the four blocks, (r, d) to [W_S e; W_KS u; W_T u].
    """
    if weights.delta:
        return _four_block(plant, weights)
    A, B1, B2, C1, C2, d1, d2 = generalized_plant(
        plant.A, plant.B, plant.C, weights.scaled(plant.omega_0)
    )
    p, m = C2.shape[0], B2.shape[1]
    D11, D12 = np.zeros((2 * p + m, p)), np.zeros((2 * p + m, m))
    D11[:p], D12[p : p + m] = d1 * np.eye(p), d2 * np.eye(m)
    return StandardPlant(A, B1, B2, C1, C2, D11, D12, np.eye(p), np.zeros((p, m)))


def _four_block(plant: ScaledPlant, weights: Weights) -> StandardPlant:
    """Reference and input disturbance in; states [plant; W_S; W_KS; W_T]."""
    A, B, C = plant.A, plant.B, plant.C
    n, m, p = len(A), B.shape[1], len(C)
    f = first_order_weights(weights.scaled(plant.omega_0))
    of_S, of_u = slice(n, n + p), slice(n + p, n + p + 2 * m)
    N, channels = of_u.stop, [p, m, m]
    pole, into, out, direct = (np.repeat(f[:, k], channels) for k in range(4))
    Ag, B1, B2 = np.zeros((N, N)), np.zeros((N, p + m)), np.zeros((N, m))
    Ag[:n, :n], Ag[n:, n:], Ag[of_S, :n] = A, -np.diag(pole), -f[0, 1] * C
    B1[:n, p:], B1[of_S, :p], B2[:n] = weights.delta * B, f[0, 1] * np.eye(p), B
    twice = np.vstack([np.eye(m), np.eye(m)])
    B2[of_u] = into[p:, None] * twice
    C1, D11, D12 = np.zeros((p + 2 * m, N)), np.zeros((p + 2 * m, p + m)), np.zeros((p + 2 * m, m))
    C1[:, n:], C1[:p, :n] = np.diag(out), -f[0, 3] * C
    D11[:p, :p], D12[p:] = f[0, 3] * np.eye(p), direct[p:, None] * twice
    C2, D21 = np.hstack([-C, np.zeros((p, N - n))]), np.eye(p, p + m)
    return StandardPlant(Ag, B1, B2, C1, C2, D11, D12, D21, np.zeros((p, m)))


def balance(plant: StandardPlant) -> StandardPlant:
    """The same plant in balanced coordinates of its state."""
    whole = plant.whole()
    A, B, C = balanced(whole.A, whole.B, whole.C)
    return StandardPlant.from_parts(A, B, C, whole.D, plant.C2.shape[0], plant.B2.shape[1])


def regularised(plant: StandardPlant, size: float) -> StandardPlant:
    """The plant with small disturbances of every state and measurement, and small costs of them.

    Its loop contains the given one: a controller that keeps its norm below γ keeps the other's
    too. Poles and zeros on the axis, D12 and D21 without full rank do it no harm. `size` is
    relative to B1, C1 and to D12, D21.
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


def close(plant: StandardPlant, K: StateSpace) -> StateSpace:
    """The loop from w to z. Raises LinAlgError where it is not well posed."""
    p, m = plant.C2.shape[0], plant.B2.shape[1]
    E = np.linalg.inv(np.eye(m) - K.D @ plant.D22)
    F = np.linalg.inv(np.eye(p) - plant.D22 @ K.D)
    DC, DD = E @ K.D @ plant.C2, E @ K.D @ plant.D21  # u = DC x + E C_K x_K + DD w
    EC = E @ K.C
    A = np.block([
        [plant.A + plant.B2 @ DC, plant.B2 @ EC],
        [K.B @ F @ plant.C2, K.A + K.B @ F @ plant.D22 @ K.C],
    ])  # fmt: skip
    B = np.vstack([plant.B1 + plant.B2 @ DD, K.B @ F @ plant.D21])
    C = np.hstack([plant.C1 + plant.D12 @ DC, plant.D12 @ EC])
    return StateSpace(A, B, C, plant.D11 + plant.D12 @ DD)


def certify(plant: StandardPlant, K: StateSpace, gamma: float) -> Certificate:
    """Rebuild the loop and prove it: its eigenvalues, and its norm against `gamma`.

    For plants that are no mixed-sensitivity problem; for those `closed_loop.measure` judges.
    """
    failed = Certificate(False, np.nan, np.nan, gamma, False)
    if not all(np.isfinite(part).all() for part in vars(K).values()):
        return failed
    try:
        loop = close(plant, K)
        A, B, C = balanced(loop.A, loop.B, loop.C)
        right = float(np.linalg.eigvals(A).real.max())
        norm = hinf_norm(StateSpace(A, B, C, loop.D))[0] if right < 0.0 else np.nan
    except np.linalg.LinAlgError:
        return failed
    return Certificate(right < 0.0, right, norm, gamma, bool(right < 0.0 and norm <= gamma))


# ---- what makes a plant solvable --------------------------------------------------------------


def obstacles(plant: StandardPlant) -> tuple[str, ...]:
    """Why no controller stabilises the plant; empty where one does. (Hautus's rank tests.)"""
    found = []
    poles = np.linalg.eigvals(plant.A)
    scale = max(float(np.abs(poles).max(initial=0.0)), 1e-300)
    for pole in poles[(poles.real >= -ON_AXIS * scale) & (poles.imag >= 0.0)]:
        if _deficient(plant.A, plant.B2, pole):
            found.append(f"no control reaches the unstable mode at s = {_number(pole)}")
        if _deficient(plant.A.T, plant.C2.T, pole):
            found.append(f"no measurement sees the unstable mode at s = {_number(pole)}")
    return tuple(dict.fromkeys(found))


def irregularities(plant: StandardPlant) -> tuple[str, ...]:
    """What a Riccati solver may not have: D12, D21 without full rank, zeros on the axis."""
    found = []
    if np.linalg.matrix_rank(plant.D12) < plant.D12.shape[1]:
        found.append("D12 has not full column rank: a control costs nothing at high frequency")
    elif _zero_on_axis(plant.A, plant.B2, plant.C1, plant.D12):
        found.append("(A, B2, C1, D12) has a zero on the imaginary axis")
    if np.linalg.matrix_rank(plant.D21) < plant.D21.shape[0]:
        found.append("D21 has not full row rank: a measurement has no noise at high frequency")
    elif _zero_on_axis(plant.A.T, plant.C2.T, plant.B1.T, plant.D21.T):
        found.append("(A, B1, C2, D21) has a zero on the imaginary axis")
    return tuple(found)


def _deficient(A: Array, B: Array, pole: complex) -> bool:
    values = np.linalg.svd(np.hstack([A - pole * np.eye(len(A)), B]), compute_uv=False)
    return bool(values[-1] <= RANK * values[0])


def _zero_on_axis(A: Array, B: Array, C: Array, D: Array) -> bool:
    """Where D has full column rank the zeros are the modes of A - BD⁺C that (I - DD⁺)C misses."""
    inverse = np.linalg.pinv(D)
    F, seen = A - B @ inverse @ C, C - D @ inverse @ C
    values = np.linalg.eigvals(F)
    scale = max(float(np.abs(values).max(initial=0.0)), 1e-300)
    on_axis = values[np.abs(values.real) <= ON_AXIS * scale]
    return any(_deficient(F.T, seen.T, value) for value in on_axis)


def _number(s: complex) -> str:
    return f"{s.real:.3g}" if abs(s.imag) <= ON_AXIS * abs(s) else f"{s.real:.3g} ± {s.imag:.3g}j"


def without_d22(plant: StandardPlant) -> StandardPlant:
    """The plant with D22 = 0; `with_d22` turns its controller into one of the plant itself."""
    return replace(plant, D22=np.zeros_like(plant.D22))


def with_d22(K: StateSpace, D22: Array) -> StateSpace:
    """K (I + D22 K)⁻¹: what `K` has to be where y carries D22 u as well."""
    E = np.linalg.inv(np.eye(D22.shape[0]) + D22 @ K.D)
    DE = K.D @ E
    return StateSpace(K.A - K.B @ E @ D22 @ K.C, K.B @ E, K.C - DE @ D22 @ K.C, DE)
