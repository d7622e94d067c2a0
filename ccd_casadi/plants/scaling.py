"""The scaled plant and its separate channels: time, force and state units in which every loop
looks alike."""

from dataclasses import dataclass

import numpy as np
import scipy

from ccd_casadi.kernels.gamma import plant_gain
from ccd_casadi.lti.state_space import (
    StateSpace,
    balanced,
    frequency_grid,
    root_flanks,
    strictly_proper,
)
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

EXACT = 1e-10  # share of a residue that may lie off the blocks and count as rounding
MIXTURES = 8
CERTAIN = 1e-13  # share of the strongest drive or reading under which a mode has none


@dataclass(frozen=True)
class Channel:
    """One block: its modes, and orthonormal directions of outputs (p, k) and inputs (m, k)."""

    modes: np.ndarray
    outputs: Array
    inputs: Array


def find_channels(K: Array, D: Array, B: Array, C: Array) -> tuple[Channel, ...]:
    """The blocks of q̈ + D q̇ + K q = B u, y = C q; one, the plant itself, where it has no more.

    Modes that are not driven, or not seen, are in no channel. Only square plants are split.
    """
    n, m = B.shape
    p = C.shape[0]
    whole = (Channel(np.arange(n), np.eye(p), np.eye(m)),)
    if p != m or p == 1:
        return whole
    b, c = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    live = (b > CERTAIN * b.max()) & (c > CERTAIN * c.max())
    coupled = _components(np.abs(K) + np.abs(D) > 0.0)
    kept = [group for group in coupled if live[group].any()]
    residues = []
    for group in kept:
        scale = max(float(np.outer(c[group], b[group]).max()), 1e-300)
        residues += [
            np.outer(C[:, i], B[j]) / scale
            for i in group
            for j in group
            if c[i] * b[j] > CERTAIN * scale
        ]
    U, s, Vt = _singular_vectors(np.array(residues))
    if s[-1] <= EXACT * s[0]:
        return whole
    turned = [np.abs(U.T @ residue @ Vt.T) for residue in residues]
    share = np.max([t / max(t.max(), 1e-300) for t in turned], axis=0)
    blocks = _components(np.maximum(share, share.T) > EXACT)
    if len(blocks) < 2:
        return whole
    found = []
    for block in blocks:
        out, into = U[:, block], Vt[block].T
        modes = [g for g in kept if np.linalg.norm(out.T @ C[:, g]) > EXACT * c[g].max()]
        found.append(Channel(np.sort(np.concatenate(modes)), out, into))
    together = np.concatenate([channel.modes for channel in found])
    if len(np.unique(together)) < len(together):  # a group of coupled modes spans two blocks
        return whole
    return tuple(found)


def _singular_vectors(residues: Array) -> tuple[Array, Array, Array]:
    """Those of the mixture, of some, whose singular values lie furthest apart.

    Any mixture will do but for rounding, which grows as two of them meet; the seed is fixed, so
    that the same plant has the same channels.
    """
    rng = np.random.default_rng(0)
    found = [
        np.linalg.svd(np.tensordot(rng.uniform(0.5, 1.5, len(residues)), residues, 1))
        for _ in range(MIXTURES)
    ]
    return max(found, key=lambda parts: -np.diff(parts[1]).max())


def _components(linked: np.ndarray) -> list[np.ndarray]:
    """Connected components of a symmetric relation, each sorted, in order of their first."""
    count, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    return [np.flatnonzero(label == i) for i in range(count)]


ROUNDING = 1e-13  # relative: of C Aⁿ B
ON_AXIS = 1e-9  # |Re p| over |p| up to which no frequency is put on p
ASIDE = 1e-10  # relative: but so far beside it
FLANKS = np.array([-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0])  # in half widths of a root


@dataclass(frozen=True)
class ScaledChannel:
    """One block of a block-diagonal plant: Uᵀ G V = C(s - A)⁻¹B, its grid and least gain there.

    `states` are those of the whole plant; U = `outputs` (p, k), V = `inputs` (m, k).
    """

    A: Array
    B: Array
    C: Array
    grid: Array
    gain: Array
    states: np.ndarray
    outputs: Array
    inputs: Array


@dataclass(frozen=True)
class ScaledPlant:
    """State space (A, B, C) of M_K G(jω₀ω), what its kernels need, and the way back to SI.

    `grid` are frequencies over ω₀ that resolve every resonance and transmission zero, `gain`
    the least singular value of the scaled plant there. `dA`, `dB`, `dC` are derivatives to θ
    with ω₀ and the coordinates frozen. `channels` are the blocks of an exactly block-diagonal
    plant (see `channels`), empty where it is not. With a `family`, the plant that a controller is
    designed on (of free bodies, on their suspension) and those that it has to hold on, all with the
    ω₀, the force and the drive of this one, a synthesis is one for all, and the peak of S the
    largest on any of these and this one.
    """

    A: Array
    B: Array
    C: Array
    omega_0: float
    force: float
    grid: Array
    gain: Array
    natural: Array
    dA: Array
    dB: Array
    dC: Array
    channels: tuple[ScaledChannel, ...] = ()
    family: "tuple[ScaledPlant, ...]" = ()

    @property
    def free(self) -> bool:
        """Whether some of its bodies are free: a state that no state reads but as a rate."""
        return bool((~self.A.any(axis=0)).any())

    @property
    def design_plant(self) -> "ScaledPlant":
        """The plant that a design is made on: itself, or that of its family."""
        return self.family[0] if self.family else self

    @property
    def members(self) -> "tuple[ScaledPlant, ...]":
        """The plants that a design on it is judged on: itself, and those of its family."""
        return (self, *self.family[1:])

    @property
    def system(self) -> StateSpace:
        """The scaled plant, time in 1/ω₀."""
        return strictly_proper(self.A, self.B, self.C)

    def plant_si(self) -> StateSpace:
        """The plant, force to displacement, time in s."""
        w0 = self.omega_0
        return strictly_proper(w0 * self.A, w0 / self.force * self.B, self.C.copy())

    def changes_si(self) -> list[tuple[Array, Array, Array]]:
        """∂A, ∂B and ∂C of `plant_si` to each parameter."""
        w0 = self.omega_0
        return [(w0 * dA, w0 / self.force * dB, dC)
                for dA, dB, dC in zip(self.dA, self.dB, self.dC, strict=True)]  # fmt: skip

    def controller_si(self, A: Array, B: Array, C: Array) -> StateSpace:
        """A controller of the scaled plant, error in to force out, time in s."""
        return strictly_proper(self.omega_0 * A, self.omega_0 * B, self.force * C)


def scale_plant(modal: ModalPlant, M_K: float, *, bare: bool = False) -> ScaledPlant:
    """Scale a modal plant for weights with this M_K; M_K in N/m (force over displacement).

    `bare`: without the grid, the gains and the channels, which a synthesis needs and no loop does.
    Raises PlantError where no mode is both driven and measured.
    """
    b = np.linalg.norm(modal.B, axis=1)
    c = np.linalg.norm(modal.C, axis=0)
    omega_0 = float(np.sqrt(M_K * np.linalg.norm(b) * np.linalg.norm(c)))
    if not omega_0 > 0.0:
        raise PlantError("input or output is zero: no mode is both driven and measured")
    K, D = modal.K / omega_0**2, modal.D / omega_0
    drive = M_K / omega_0**2
    # Stretch x1 = s q so that ẋ1 = s x2 and ẋ2 = -(K/s) x1 weigh alike; mode sizes by a, so
    # that each mode is driven as strongly as it is measured.
    s = np.maximum(np.sqrt(np.diag(K)), 1.0)
    both = (b > 1e-12 * b.max()) & (c > 1e-12 * c.max())
    a = np.sqrt(np.divide(drive * b * s, c, out=np.ones_like(b), where=both))
    n, m, p = K.shape[0], modal.B.shape[1], modal.C.shape[0]
    left, right = 1.0 / a, a

    def lower(M: Array) -> Array:
        return left[:, None] * M * right

    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.diag(s)
    A[n:, :n] = -lower(K) / s
    A[n:, n:] = -lower(D)
    B = np.vstack([np.zeros((n, m)), left[:, None] * drive * modal.B])
    C = np.hstack([modal.C * right / s, np.zeros((p, n))])
    count = modal.dM.shape[0]
    dA, dB = np.zeros((count, 2 * n, 2 * n)), np.zeros((count, 2 * n, m))
    dC = np.zeros((count, p, 2 * n))
    dA[:, n:, :n] = -lower(modal.dK / omega_0**2 - modal.dM @ K) / s
    dA[:, n:, n:] = -lower(modal.dD / omega_0 - modal.dM @ D)
    dB[:, n:] = left[:, None] * drive * (modal.dB - modal.dM @ modal.B)
    dC[:, :, :n] = modal.dC * right / s
    if bare:
        none = np.empty(0)
        return ScaledPlant(A, B, C, omega_0, M_K, none, none, modal.natural, dA, dB, dC)
    grid, gain = _gains(A, B, C)
    channels = _scaled_channels(find_channels(modal.K, modal.D, modal.B, modal.C), A, B, C)
    return ScaledPlant(A, B, C, omega_0, M_K, grid, gain, modal.natural, dA, dB, dC, channels)


def scale_state_space(system: StateSpace, M_K: float) -> ScaledPlant:
    """The scaled plant of any strictly proper state space in SI, for weights with this M_K (N/m).

        ω₀² = M_K ‖C A B‖, the inertial compliance being C A B / s²

    Where that is 0, ω₀ⁿ = M_K ‖C Aⁿ⁻¹ B‖ with the first n for which it is not (3 with a lag
    before the force). Coordinates are balanced; there are no derivatives and no channels. Raises
    PlantError for a plant with feedthrough, that is not finite, or whose output no force moves.
    """
    n, m, p = len(system.A), system.B.shape[1], system.C.shape[0]
    if not all(np.isfinite(part).all() for part in (system.A, system.B, system.C)):
        raise PlantError("its state space is not finite")
    if np.any(system.D):
        raise PlantError("it has a direct feedthrough; a plant is force to displacement, D = 0")
    order, inertial = leading_gain(system)
    if not order:
        raise PlantError("C Aⁿ B is zero for every n: no force accelerates what is measured")
    omega_0 = float((M_K * inertial) ** (1.0 / order))
    A, B, C = balanced(system.A / omega_0, system.B * (M_K / omega_0), system.C)
    grid, gain = _gains(A, B, C)
    poles = np.linalg.eigvals(system.A)
    natural = np.sort(np.abs(poles[poles.imag >= 0.0]))
    none = (np.zeros((0, n, n)), np.zeros((0, n, m)), np.zeros((0, p, n)))
    return ScaledPlant(A, B, C, omega_0, M_K, grid, gain, natural, *none)


def leading_gain(system: StateSpace) -> tuple[int, float]:
    """n and ‖C Aⁿ⁻¹ B‖ of the plant's C Aⁿ⁻¹ B / sⁿ at high frequencies: n = 2 where that is not 0,
    else the first; 0 and 0 where the plant is 0."""
    A, B, C = balanced(system.A, system.B, system.C)
    sizes = [float(np.linalg.norm(M, 2)) for M in (C, A, B)]
    found, power = {}, B
    for n in range(1, len(A) + 1):
        size = float(np.linalg.norm(C @ power, 2))
        if size > ROUNDING * sizes[0] * sizes[1] ** (n - 1) * sizes[2]:
            found[n] = size
        power = A @ power
    order = 2 if 2 in found else min(found, default=0)
    return order, found.get(order, 0.0)


def _scaled_channels(
    channels: tuple[Channel, ...], A: Array, B: Array, C: Array
) -> tuple[ScaledChannel, ...]:
    if len(channels) < 2:
        return ()
    found = []
    for channel in channels:
        states = np.concatenate([channel.modes, channel.modes + len(A) // 2])
        a = np.ascontiguousarray(A[np.ix_(states, states)])
        b = np.ascontiguousarray(B[states] @ channel.inputs)
        c = np.ascontiguousarray(channel.outputs.T @ C[:, states])
        found.append(
            ScaledChannel(a, b, c, *_gains(a, b, c), states, channel.outputs, channel.inputs)
        )
    return tuple(found)


def _gains(A: Array, B: Array, C: Array) -> tuple[Array, Array]:
    """A logarithmic grid with points crowded around lightly damped poles and zeros, and the least
    singular value of the plant on it."""
    system = strictly_proper(A, B, C)
    roots = np.concatenate([system.poles, system.zeros()])
    roots = roots[(roots.imag > 0.0) & (np.abs(roots) > 1e-5) & (np.abs(roots) < 1e5)]
    wide = np.maximum(np.abs(roots.real), 1e-9 * roots.imag) + 1j * roots.imag
    grid = frequency_grid(1e-5, 1e5, 121, root_flanks(wide, FLANKS))
    axis = system.poles[np.abs(system.poles.real) < ON_AXIS * np.abs(system.poles)].imag
    on_pole = (np.abs(grid[:, None] - np.abs(axis)) < ASIDE * grid[:, None]).any(axis=1)
    grid = np.ascontiguousarray(np.where(on_pole, (1.0 + ASIDE) * grid, grid))
    return grid, plant_gain(A, B, C, grid)
