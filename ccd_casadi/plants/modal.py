"""Modal form of a plant, its rigid-body suspension and modal damping, with derivatives.

Both are functions of the matrix M⁻¹K: K_s = M h(M⁻¹K) and D_s = M g(M⁻¹K), where h and g act
on the eigenvalues λ = ω². Their derivatives follow from divided differences,

    dh(Λ)_ij = h[λ_i, λ_j] dΛ_ij    (Daleckii and Krein),

which is exact at double eigenvalues too. Rigid is what K does not resist (`rigid_modes`): poles at
zero. On the axis they would make the mixed-sensitivity problem singular, so that a synthesis has a
suspension that puts them at (ω_r, ζ_r). Nothing is judged with it: every loop has them `free`.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.rigid_modes import driven_and_measured, natural_modes, numbered, placed
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

UNDAMPED = 1e-12  # of the largest modal damping: what is below is rounding of none
ALIKE = 1e-9  # relative: singular values of outputs
NONE = 1e-12  # relative: what is below is rounding of no force, no reading or no damping


@dataclass(frozen=True)
class Suspension:
    """Where a synthesis puts the rigid-body poles: frequency in Hz and damping ratio.

    `rigid_modes`: how many there are, where the case states it; see `rigid_modes.natural_modes`.
    """

    frequency_hz: float = 0.1
    damping_ratio: float = 0.7
    rigid_modes: int | None = None

    @property
    def free(self) -> "Suspension":
        """None: rigid-body poles stay at zero, as the machine has them."""
        return replace(self, frequency_hz=0.0, damping_ratio=0.0)


FREE = Suspension(0.0, 0.0)


@dataclass(frozen=True)
class Perturbation:
    """A plant off its model: flexible frequencies times 1 + `shift`, damping times `damping`.

    Mode shapes stay. Modal damping ratios are multiplied by `damping`, or a given damping matrix,
    which a shift leaves alone. `modes` shift single flexible modes besides, as `numbered` has them;
    those that it does not reach stay.
    """

    shift: float = 0.0
    damping: float = 1.0
    modes: tuple[float, ...] = ()


NOMINAL = Perturbation()


@dataclass(frozen=True)
class ModalPlant:
    """q̈ + D q̇ + K q = B u, y = C q in mass-normalised modal coordinates at one θ, SI.

    `natural` holds the natural frequencies in rad/s before the suspension, `rigid` marks the
    rigid-body modes, `modes` the mode shapes as columns. The `d…` arrays are derivatives to θ,
    leading axis θ, in coordinates frozen at this θ, where M = I but dM is not zero.
    """

    K: Array
    D: Array
    B: Array
    C: Array
    natural: Array
    rigid: np.ndarray
    modes: Array
    dM: Array
    dK: Array
    dD: Array
    dB: Array
    dC: Array

    @property
    def numbered(self) -> np.ndarray:
        """The flexible modes in the order of their numbers, see `numbered`."""
        return numbered(self.modes, self.rigid)

    @property
    def state_space(self) -> StateSpace:
        """[q; q̇] in SI, velocities in units in which a mode's energy is even."""
        n, k = len(self.K), np.diag(self.K)
        scale = np.sqrt(np.where(k > 1e-12, k, 1.0))
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:], A[n:, :n], A[n:, n:] = np.diag(scale), -self.K / scale, -self.D
        B = np.vstack([np.zeros_like(self.B), self.B])
        C = np.hstack([self.C / scale, np.zeros_like(self.C)])
        return strictly_proper(A, B, C)


def modal_plant(
    system: Mechanics, suspension: Suspension, perturbation: Perturbation = NOMINAL
) -> ModalPlant:
    """Mass-normalised modal coordinates, with suspension and modal damping.

    Raises PlantError where a stiffness is negative, and where it is not known whether K resists a
    motion.
    """
    lam, modes, rigid = natural_modes(system.K, system.M, suspension.rigid_modes)
    w_r = 2.0 * np.pi * suspension.frequency_hz
    modes = _aligned(modes, lam, system.C)
    root = np.sqrt(lam)
    own = np.zeros(rigid.size)
    shifted = numbered(modes, rigid)[: len(perturbation.modes)]
    own[shifted] = perturbation.modes[: len(shifted)]
    ratio = (1.0 + perturbation.shift) * (1.0 + own)
    h = np.where(rigid, w_r**2, ratio**2 * lam)
    model = system.damping_ratio or 0.0
    zeta = model * perturbation.damping * ratio  # of the model's own root: g is a function of λ
    g = np.where(rigid, 2.0 * suspension.damping_ratio * w_r, 2.0 * zeta * root)

    def to_modal(matrix: Array) -> Array:
        return modes.T @ matrix @ modes

    D_given = perturbation.damping * to_modal(system.D)
    size = np.sqrt(np.einsum("ij,ik,kj->j", np.abs(modes), np.abs(system.D), np.abs(modes)))
    apart = np.abs(D_given) <= NONE * perturbation.damping * np.outer(size, size)
    D_given[apart] = 0.0  # of modes that no damper connects, and of a body that none brakes
    dM, dD, dK, dB, dC = system.derivatives
    dM, dK = to_modal(dM), to_modal(dK)
    dA = dK - dM * lam  # M⁻¹K moves by dK - dM Λ where M = I
    dh = dM * h + _divided_differences(lam, h, rigid, ratio**2) * dA
    slope_g = np.divide(zeta, root, out=np.zeros_like(root), where=~rigid)
    dg = dM * g + _divided_differences(lam, g, rigid, slope_g) * dA
    C = system.C @ modes
    seen = np.linalg.norm(C, axis=0)
    C[:, seen <= NONE * seen.max()] = 0.0
    return ModalPlant(
        K=np.diag(h),
        D=D_given + np.diag(g),
        B=modes.T @ system.B,
        C=C,
        natural=ratio * root,
        rigid=rigid,
        modes=modes,
        dM=dM,
        dK=dh,
        dD=perturbation.damping * to_modal(dD) + dg,
        dB=modes.T @ dB,
        dC=dC @ modes,
    )


def without_hidden_rigid_modes(modal: ModalPlant) -> ModalPlant:
    """The plant without rigid-body motions that are neither driven nor measured; see
    `rigid_modes.driven_and_measured`. Derivatives of the plant's response stay what they are."""
    own = np.flatnonzero(modal.rigid)
    sizes = np.linalg.norm(modal.B, 2), np.linalg.norm(modal.C, 2)
    if not own.size or not all(sizes):
        return modal
    T, back = driven_and_measured(modal.B[own] / sizes[0], modal.C[:, own] / sizes[1])
    count = T.shape[1]
    if count == own.size:
        return modal
    kept = np.setdiff1d(np.arange(len(modal.K)), own[count:])
    T, back = placed(T, own, kept), placed(back.T, own, kept).T
    both = {name: back @ getattr(modal, name) @ T for name in ("K", "D", "dM", "dK", "dD")}
    drive = {name: back @ getattr(modal, name) for name in ("B", "dB")}
    shown = {name: getattr(modal, name) @ T for name in ("C", "dC", "modes")}
    left = {name: getattr(modal, name)[kept] for name in ("natural", "rigid")}
    return replace(modal, **both, **drive, **shown, **left)


def require_damping(modal: ModalPlant) -> None:
    """Raise PlantError where a flexible mode is not damped: its gain would be infinite."""
    damping, natural, rigid = np.diag(modal.D), modal.natural, modal.rigid
    least = UNDAMPED * max(float(np.abs(damping[~rigid]).max(initial=0.0)), 1e-300)
    wrong = np.flatnonzero(~rigid & (damping <= least))
    if not wrong.size:
        return
    i = wrong[0]
    words = "is not damped" if damping[i] >= -least else "has a negative damping"
    raise PlantError(
        f"the mode at {natural[i] / (2.0 * np.pi):.5g} Hz {words}: no synthesis holds an infinite "
        "resonance; return a damping matrix that reaches it, or damping_ratio, such as 0.005"
    )


def _aligned(modes: Array, lam: Array, C: Array) -> Array:
    """Rotate modes of one frequency so that what the sensors do not see stands alone.

    Any orthogonal basis of an eigenspace is one of modes. In the singular vectors of its outputs
    a direction that is not measured has c = 0 exactly; spread over several modes it would leave
    the Riccati solution singular in a direction that rounding makes up. Where all are
    measured alike, as tip and tilt of a square stage, there is nothing to part, and they stay.
    """
    modes = modes.copy()
    apart = np.flatnonzero(np.diff(lam) > 1e-9 * lam[1:]) + 1
    for start, end in pairwise([0, *apart, lam.size]):
        if end - start > 1:
            seen, Vh = np.linalg.svd(C @ modes[:, start:end])[1:]
            if len(seen) < end - start or seen[0] - seen[-1] > ALIKE * seen[0]:
                modes[:, start:end] = modes[:, start:end] @ Vh.T
    return modes


def _divided_differences(lam: Array, values: Array, rigid: np.ndarray, slope: Array) -> Array:
    """h[λ_i, λ_j]; among rigid modes zero, since they stay rigid at every θ."""
    gap = lam[:, None] - lam[None, :]
    close = np.abs(gap) <= 1e-9 * np.maximum(lam[:, None], lam[None, :])
    safe = np.where(close, 1.0, gap)
    mean_slope = 0.5 * (slope[:, None] + slope[None, :])
    out = np.where(close, mean_slope, (values[:, None] - values[None, :]) / safe)
    return np.where(rigid[:, None] & rigid[None, :], 0.0, out)
