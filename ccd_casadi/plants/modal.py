"""Modal form of a plant, its rigid-body suspension and modal damping, with derivatives.

Both are functions of the matrix M⁻¹K: K_s = M h(M⁻¹K) and D_s = M g(M⁻¹K), where h and g act
on the eigenvalues λ = ω². Their derivatives follow from divided differences,

    dh(Λ)_ij = h[λ_i, λ_j] dΛ_ij    (Daleckii and Krein),

which is exact at double eigenvalues too. Rigid is what K does not resist (`as_written`): poles at
zero. A motion that K drives away has λ < 0 and poles ±√-λ; a damping ratio says nothing of it and
damps none. On the axis poles would make the mixed-sensitivity problem singular, so that a synthesis
has a suspension that puts those at zero at (ω_r, ζ_r), and where a flexible mode is not damped all
of them have 2 ζ_u ω less damping: a controller must then damp them, and cannot cancel them. Nothing
is judged with either: every loop has them `free`.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.lti.wiring import UNWIRED, Slopes, Wiring
from ccd_casadi.plants.as_written import driven_and_measured, embed, natural_modes, number_modes
from ccd_casadi.plants.first_order import FirstOrderPlant, first_order
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


@dataclass(frozen=True)
class ModalOptions:
    """Levels of rounding in the modal form, all relative.

    Attributes
    ----------
    undamped : float
        Share of the largest modal damping below which a flexible mode counts as undamped.
    equal_outputs : float
        Difference below which singular values of the outputs of modes of one frequency are equal.
    negligible : float
        Share below which a damping between two modes, or a reading of a mode, is set to zero.
    """

    undamped: float = 1e-12
    equal_outputs: float = 1e-9
    negligible: float = 1e-12


@dataclass(frozen=True)
class Suspension:
    """The soft suspension by which a synthesis moves the rigid-body poles.

    Attributes
    ----------
    frequency_hz : float
        Natural frequency in Hz.
    damping_ratio : float
        Damping ratio.
    rigid_modes : int, optional
        Number of rigid-body modes, where the case states it; see `as_written.natural_modes`.
    undamped : float
        ζ_u, the damping ratio that flexible modes lose where one is not damped.
    """

    frequency_hz: float = 0.1
    damping_ratio: float = 0.7
    rigid_modes: int | None = None
    undamped: float = 1e-3

    @property
    def free(self) -> "Suspension":
        """The same without suspension: poles stay where the machine has them."""
        return replace(self, frequency_hz=0.0, damping_ratio=0.0)


FREE = Suspension(0.0, 0.0)


@dataclass(frozen=True)
class Perturbation:
    """A deviation of a plant from its model; mode shapes stay.

    Attributes
    ----------
    shift : float
        Flexible frequencies are multiplied by 1 + `shift`; a given damping matrix is not changed.
    damping : float
        Factor of the modal damping ratios, or of a given damping matrix.
    modes : tuple of float
        Further relative shifts of single flexible modes, in the order of `numbered`; the modes
        beyond its end are not shifted.
    lost : float
        Damping ratio that every flexible mode loses, after all this.
    """

    shift: float = 0.0
    damping: float = 1.0
    modes: tuple[float, ...] = ()
    lost: float = field(default=0.0, kw_only=True)


NOMINAL = Perturbation()


@dataclass(frozen=True)
class ModalPlant:
    """q̈ + D q̇ + K q = B u, y = C q in mass-normalised modal coordinates at one θ, SI.

    Derivatives to θ are in coordinates frozen at this θ, where M = I but dM is not zero.

    Attributes
    ----------
    K, D, B, C : arrays (n, n), (n, n), (n, m), (p, n)
        Stiffness (rad²/s²), damping (rad/s), input (1/√kg) and output (1/√kg).
    natural : array (n,)
        Natural frequencies in rad/s before the suspension; 0 of what K does not resist.
    rigid : bool array (n,)
        Which modes are rigid-body modes.
    modes : array (N, n)
        Mode shapes as columns.
    dM, dK, dD, dB, dC : arrays
        Derivatives to θ, leading axis θ.
    wiring : Wiring
        What lies before the forces and behind the sensors.
    states : FirstOrderPlant, optional
        The plant itself where its function gives A, B, C; all above then describes its poles.
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
    wiring: Wiring = UNWIRED
    states: FirstOrderPlant | None = None

    @property
    def driven_away(self) -> np.ndarray:
        """Whether each mode (n,) has a negative stiffness: K drives it away."""
        return np.asarray(np.diag(self.K) < 0.0)

    @property
    def numbered(self) -> np.ndarray:
        """The flexible modes in the order of their numbers, see `numbered`."""
        if self.states is not None:
            return self.states.modes().resonances
        return number_modes(self.modes, self.rigid)

    def scale_input(self, gain: float, inputs: int | None = None) -> "ModalPlant":
        """Multiply the first `inputs` columns of B by a factor; None: all."""
        each = np.ones(self.B.shape[1])
        each[:inputs] = gain
        states = self.states and self.states.scale_input(each)
        return replace(self, B=self.B * each, dB=self.dB * each, states=states)

    @property
    def state_space(self) -> StateSpace:
        """[q; q̇] in SI, velocities in units in which a mode's energy is even, as it is wired."""
        if self.states is not None:
            return self.wiring.around(self.states.system)
        n, k = len(self.K), np.abs(np.diag(self.K))
        scale = np.sqrt(np.where(k > 1e-12, k, 1.0))
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:], A[n:, :n], A[n:, n:] = np.diag(scale), -self.K / scale, -self.D
        B = np.vstack([np.zeros_like(self.B), self.B])
        C = np.hstack([self.C / scale, np.zeros_like(self.C)])
        return self.wiring.around(strictly_proper(A, B, C))


def modal_plant(
    system: Mechanics,
    suspension: Suspension,
    perturbation: Perturbation = NOMINAL,
    *,
    options: ModalOptions = ModalOptions(),
) -> ModalPlant:
    """Transform a plant to mass-normalised modal coordinates, with suspension and modal damping.

    Parameters
    ----------
    system : Mechanics
        M, D, K, B, C and their derivatives, SI.
    suspension : Suspension
        Replaces the zero frequency and damping of rigid-body modes.
    perturbation : Perturbation
        Deviation from the model.
    options : ModalOptions

    Returns
    -------
    ModalPlant

    Raises
    ------
    PlantError
        It is not known whether K resists a motion.
    """
    if system.first_order:
        return _of_states(system, suspension, perturbation)
    lam, modes, rigid = natural_modes(system.K, system.M, suspension.rigid_modes)
    w_r = 2.0 * np.pi * suspension.frequency_hz
    modes = _align(modes, lam, system.C, options.equal_outputs)
    root, driven_away = np.sqrt(np.abs(lam)), lam < 0.0
    own = np.zeros(rigid.size)
    shifted = number_modes(modes, rigid)[: len(perturbation.modes)]
    own[shifted] = perturbation.modes[: len(shifted)]
    ratio = (1.0 + perturbation.shift) * (1.0 + own)
    h = np.where(rigid, w_r**2, ratio**2 * lam)
    model = system.damping_ratio or 0.0
    # of the model's own root: g is a function of λ
    zeta = (model * perturbation.damping - perturbation.lost) * ratio
    zeta = np.where(driven_away, 0.0, zeta)  # of an ω: a motion that K drives away has none
    g = np.where(rigid, 2.0 * suspension.damping_ratio * w_r, 2.0 * zeta * root)

    def to_modal(matrix: Array) -> Array:
        return modes.T @ matrix @ modes

    D_given = perturbation.damping * to_modal(system.D)
    size = np.sqrt(np.einsum("ij,ik,kj->j", np.abs(modes), np.abs(system.D), np.abs(modes)))
    apart = np.abs(D_given) <= options.negligible * perturbation.damping * np.outer(size, size)
    D_given[apart] = 0.0  # of modes that no damper connects, and of a body that none brakes
    dM, dD, dK, dB, dC = system.derivatives
    dM, dK = to_modal(dM), to_modal(dK)
    dA = dK - dM * lam  # M⁻¹K moves by dK - dM Λ where M = I
    dh = dM * h + _divided_differences(lam, h, rigid, ratio**2) * dA
    slope_g = np.divide(zeta, root, out=np.zeros_like(root), where=~rigid)
    dg = dM * g + _divided_differences(lam, g, rigid, slope_g) * dA
    C = system.C @ modes
    seen = np.linalg.norm(C, axis=0)
    C[:, seen <= options.negligible * seen.max()] = 0.0
    return ModalPlant(
        K=np.diag(h),
        D=D_given + np.diag(g),
        B=modes.T @ system.B,
        C=C,
        natural=np.where(driven_away, 0.0, ratio * root),
        rigid=rigid,
        modes=modes,
        dM=dM,
        dK=dh,
        dD=perturbation.damping * to_modal(dD) + dg,
        dB=modes.T @ dB,
        dC=dC @ modes,
        wiring=system.wiring,
    )


def _of_states(system: Mechanics, held: Suspension, off: Perturbation) -> ModalPlant:
    """A plant of first order, with its poles as modes without derivatives."""
    _, _, dK, dB, dC = system.derivatives
    states = first_order(-system.K, system.B, system.C, Slopes(-dK, dB, dC))
    states = states.off(off.shift, off.damping, off.modes, off.lost)
    if held.frequency_hz:
        states = states.suspend(2.0 * np.pi * held.frequency_hz, held.damping_ratio)
    k, d, B, C, rigid, _ = states.modes()
    n, none = len(k), np.zeros((len(dK), len(k), len(k)))
    if not n:
        raise PlantError("A has no pole but single ones at 0; add what the force accelerates")
    return ModalPlant(
        np.diag(k), np.diag(d), B, C, np.sqrt(np.maximum(k, 0.0)), rigid, np.eye(n), none, none,
        none, np.zeros((len(dK), *B.shape)), np.zeros((len(dK), *C.shape)), system.wiring, states,
    )  # fmt: skip


def without_hidden_rigid_modes(modal: ModalPlant) -> ModalPlant:
    """Remove rigid-body motions that are neither driven nor measured.

    The derivatives of the plant's response do not change; see `as_written.driven_and_measured`.

    Parameters
    ----------
    modal : ModalPlant

    Returns
    -------
    ModalPlant
        The same object where there is no such motion.
    """
    own = np.flatnonzero(modal.rigid)
    sizes = np.linalg.norm(modal.B, 2), np.linalg.norm(modal.C, 2)
    if not own.size or not all(sizes) or modal.states is not None:
        return modal
    T, back = driven_and_measured(modal.B[own] / sizes[0], modal.C[:, own] / sizes[1])
    count = T.shape[1]
    if count == own.size:
        return modal
    kept = np.setdiff1d(np.arange(len(modal.K)), own[count:])
    T, back = embed(T, own, kept), embed(back.T, own, kept).T
    both = {name: back @ getattr(modal, name) @ T for name in ("K", "D", "dM", "dK", "dD")}
    drive = {name: back @ getattr(modal, name) for name in ("B", "dB")}
    shown = {name: getattr(modal, name) @ T for name in ("C", "dC", "modes")}
    left = {name: getattr(modal, name)[kept] for name in ("natural", "rigid")}
    return replace(modal, **both, **drive, **shown, **left)


def require_damping(modal: ModalPlant, *, options: ModalOptions = ModalOptions()) -> bool:
    """Check that every flexible mode is damped, or that a loop may damp it.

    Parameters
    ----------
    modal : ModalPlant
    options : ModalOptions

    Returns
    -------
    bool
        Whether some mode is not damped, which is driven and measured.

    Raises
    ------
    PlantError
        A mode is not damped and the loop does not reach it, or has a negative damping. The message
        names its frequency in Hz and the remedy.
    """
    damping, natural = np.diag(modal.D), modal.natural
    rigid = modal.rigid | modal.driven_away  # neither has a resonance
    least = options.undamped * max(float(np.abs(damping[~rigid]).max(initial=0.0)), 1e-300)
    undamped = ~rigid & (damping <= least)
    sizes = (np.linalg.norm(part, axis=1) for part in (modal.B, modal.C.T))
    seen = np.logical_and(*(size > options.equal_outputs * size.max() for size in sizes))
    wrong = np.flatnonzero(undamped & (~seen | (damping < -least)))
    if not wrong.size:
        return bool(undamped.any())
    i = wrong[0]
    words = "is not damped: the loop does not reach it; return a damping matrix that reaches it"
    if damping[i] < -least:
        words = "has a negative damping; correct the damping, or A"
    where = f"the mode at {natural[i] / (2.0 * np.pi):.5g} Hz"
    raise PlantError(f"{where} {words}, or return damping_ratio, such as 0.005")


def _align(modes: Array, lam: Array, C: Array, equal: float) -> Array:
    """Rotate modes of one frequency so that what the sensors do not see stands alone.

    Any orthogonal basis of an eigenspace is one of modes. In the singular vectors of its outputs
    a direction that is not measured has c = 0 exactly; spread over several modes it would leave
    the Riccati solution singular in a direction that rounding makes up. Where all are
    measured alike, as tip and tilt of a square stage, there is nothing to part, and they stay.
    """
    modes = modes.copy()
    apart = np.flatnonzero(np.abs(np.diff(lam)) > 1e-9 * np.abs(lam[1:])) + 1
    for start, end in pairwise([0, *apart, lam.size]):
        if end - start > 1:
            seen, Vh = np.linalg.svd(C @ modes[:, start:end])[1:]
            if len(seen) < end - start or seen[0] - seen[-1] > equal * seen[0]:
                modes[:, start:end] = modes[:, start:end] @ Vh.T
    return modes


def _divided_differences(lam: Array, values: Array, rigid: np.ndarray, slope: Array) -> Array:
    """h[λ_i, λ_j]; among rigid modes zero, since they stay rigid at every θ."""
    gap = lam[:, None] - lam[None, :]
    close = np.abs(gap) <= 1e-9 * np.maximum(np.abs(lam[:, None]), np.abs(lam[None, :]))
    safe = np.where(close, 1.0, gap)
    mean_slope = 0.5 * (slope[:, None] + slope[None, :])
    out = np.where(close, mean_slope, (values[:, None] - values[None, :]) / safe)
    return np.where(rigid[:, None] & rigid[None, :], 0.0, out)
