"""The scaled plant and its separate channels: time, force and state units in which every loop
looks alike."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ccd_casadi.kernels.gamma import plant_gain
from ccd_casadi.lti.frequency_grid import frequency_grid, root_flanks
from ccd_casadi.lti.state_space import (
    StateSpace,
    balance_system,
    leading_term,
    state_scales,
    strictly_proper,
)
from ccd_casadi.lti.wiring import UNWIRED, ForcedPlant, OwnPorts, Slopes
from ccd_casadi.plants.first_order import FirstOrderPlant
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


@dataclass(frozen=True)
class ChannelSplitOptions:
    """Numbers of the split into separate channels.

    Attributes
    ----------
    exact : float
        Share of a residue that may lie off the blocks and count as rounding.
    mixtures : int
        Random mixtures of residues from which the best-separated one is taken.
    driven : float
        Share of the strongest drive or reading below which a mode has none.
    """

    exact: float = 1e-10
    mixtures: int = 8
    driven: float = 1e-13


@dataclass(frozen=True)
class Channel:
    """One block of a block-diagonal plant.

    Attributes
    ----------
    modes : int array
        Numbers of its modes.
    outputs, inputs : arrays (p, k), (m, k)
        Orthonormal directions of outputs and inputs.
    """

    modes: np.ndarray
    outputs: Array
    inputs: Array


def find_channels(
    K: Array, D: Array, B: Array, C: Array, *, options: ChannelSplitOptions = ChannelSplitOptions()
) -> tuple[Channel, ...]:
    """The blocks of q̈ + D q̇ + K q = B u, y = C q; one, the plant itself, where it has no more.

    Modes that are not driven, or not seen, are in no channel. Only square plants are split.
    """
    n, m = B.shape
    p = C.shape[0]
    whole = (Channel(np.arange(n), np.eye(p), np.eye(m)),)
    if p != m or p == 1:
        return whole
    b, c = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    live = (b > options.driven * b.max()) & (c > options.driven * c.max())
    coupled = _components(np.abs(K) + np.abs(D) > 0.0)
    kept = [group for group in coupled if live[group].any()]
    residues = []
    for group in kept:
        scale = max(float(np.outer(c[group], b[group]).max()), 1e-300)
        residues += [
            np.outer(C[:, i], B[j]) / scale
            for i in group
            for j in group
            if c[i] * b[j] > options.driven * scale
        ]
    U, s, Vt = singular_vectors(np.array(residues), options.mixtures)
    if s[-1] <= options.exact * s[0]:
        return whole
    turned = [np.abs(U.T @ residue @ Vt.T) for residue in residues]
    share = np.max([t / max(t.max(), 1e-300) for t in turned], axis=0)
    blocks = _components(np.maximum(share, share.T) > options.exact)
    if len(blocks) < 2:
        return whole
    found = []
    for block in blocks:
        out, into = U[:, block], Vt[block].T
        modes = [g for g in kept if np.linalg.norm(out.T @ C[:, g]) > options.exact * c[g].max()]
        found.append(Channel(np.sort(np.concatenate(modes)), out, into))
    together = np.concatenate([channel.modes for channel in found])
    if len(np.unique(together)) < len(together):  # a group of coupled modes spans two blocks
        return whole
    return tuple(found)


def singular_vectors(
    residues: Array, mixtures: int = ChannelSplitOptions.mixtures
) -> tuple[Array, Array, Array]:
    """Find the directions in which matrices are diagonal together, where they are in any.

    Those of the mixture of them, of some, whose singular values lie furthest apart. Any mixture
    will do but for rounding, which grows as two values meet; the seed is fixed, so that the same
    plant has the same channels.

    Parameters
    ----------
    residues : array (k, p, m)
    mixtures : int

    Returns
    -------
    U (p, p), s, Vᵀ (m, m)
    """
    rng = np.random.default_rng(0)
    found = [
        np.linalg.svd(np.tensordot(rng.uniform(0.5, 1.5, len(residues)), residues, 1))
        for _ in range(mixtures)
    ]
    return max(found, key=lambda parts: -np.diff(parts[1]).max())


def _components(linked: np.ndarray) -> list[np.ndarray]:
    """Connected components of a symmetric relation, each sorted, in order of their first."""
    count, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    return [np.flatnonzero(label == i) for i in range(count)]


@dataclass(frozen=True)
class ScalingOptions:
    """Numbers of a scaled plant's frequency grid.

    Attributes
    ----------
    lowest, highest : float
        Ends of the grid over ω₀.
    points : int
        Points of the grid, evenly spread over ln ω, besides those around roots.
    flanks : tuple of float
        Points around each resonance and anti-resonance, in half widths of the root.
    on_axis : float
        |Re p|/|p| of a pole up to which no frequency is put on p.
    beside : float
        Relative distance of the frequency that takes its place.
    """

    lowest: float = 1e-5
    highest: float = 1e5
    points: int = 121
    flanks: tuple[float, ...] = (-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0)
    on_axis: float = 1e-9
    beside: float = 1e-10


@dataclass(frozen=True)
class ScaledChannel:
    """One block of a block-diagonal plant: Uᵀ G V = C(s - A)⁻¹B.

    Attributes
    ----------
    A, B, C : arrays (n, n), (n, k), (k, n)
        Scaled state space, time in 1/ω₀.
    grid, gain : arrays (g,)
        Frequencies over ω₀ and the least singular value there.
    states : int array (n,)
        Numbers of its states in the whole plant.
    outputs, inputs : arrays (p, k), (m, k)
        U and V.
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
    """State space (A, B, C) of M_K G(jω₀ω), its frequency grid, and the way back to SI.

    With a `family` one synthesis serves all its plants, all with the ω₀, the force and the drive of
    this one, and the peak of S is the largest on this one and on those after the first.

    Attributes
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
        Time in 1/ω₀, force in units of `force`.
    omega_0 : float
        Unit of frequency, rad/s.
    force : float
        M_K in N/m: the unit of force over that of displacement.
    grid, gain : arrays (g,)
        Frequencies over ω₀ that resolve every resonance and transmission zero, and the least
        singular value of the scaled plant there.
    natural : array (r,)
        Natural frequencies in rad/s.
    dA, dB, dC : arrays
        Derivatives to θ, leading axis θ, with ω₀ and the coordinates frozen.
    channels : tuple of ScaledChannel
        Blocks of an exactly block-diagonal plant, empty where it is not.
    family : tuple of ScaledPlant
        The plant that a controller is designed on (free bodies: on their suspension), then those on
        which it must meet the bounds, too.
    mechanics, counted : ScaledPlant, optional
        As a `ForcedPlant` has them, where disturbing forces move it otherwise than u does.
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
    mechanics: "ScaledPlant | None" = None
    counted: "ScaledPlant | None" = None

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
        found = strictly_proper(w0 * self.A, w0 / self.force * self.B, self.C.copy())
        own, counted = self.mechanics, self.counted
        if own is None:
            return found
        driven = None if counted is None else counted.plant_si()
        return ForcedPlant.of(found, own.plant_si(), driven)

    def with_slopes_times(self, factors: Array) -> "ScaledPlant":
        """Multiply each of its derivatives by a factor (n_θ, 1, 1)."""
        found = replace(self, dA=factors * self.dA, dB=factors * self.dB, dC=factors * self.dC)
        return found.forced_as(lambda own: own.with_slopes_times(factors))

    @property
    def held_compliance(self) -> float:
        """σ_max of what a force at rest moves where the error counts while u holds the sensors
        still, m/N.

            A x + B u + E d = 0,   C x = 0,   z = F x

        Every controller with an integrator leaves that. 0: the sensors are where the error counts;
        NaN: u cannot hold them at rest.
        """
        own, counted = self.mechanics, self.counted
        if own is None or counted is None:
            return 0.0
        n, p = len(self.A), len(self.C)
        held = np.block([[self.A, counted.B], [self.C, np.zeros((p, counted.B.shape[1]))]])
        rows = np.abs(held).max(axis=1, keepdims=True)
        columns = np.abs(held / rows).max(axis=0)
        held = held / rows / columns
        if not np.linalg.cond(held) < np.finfo(float).eps ** -0.75:  # a zero at rest
            return np.nan
        force = np.vstack([own.B, np.zeros((p, own.B.shape[1]))]) / rows
        x = -np.linalg.solve(held, force)[:n] / columns[:n, None]
        return float(np.linalg.norm(own.C[p:] @ x, 2)) / self.force

    def forced_as(self, changed: "Callable[[ScaledPlant], ScaledPlant]") -> "ScaledPlant":
        """With what disturbing forces move, and what counts, `changed`."""
        both = self.mechanics, self.counted
        mechanics, counted = (own and changed(own) for own in both)
        return replace(self, mechanics=mechanics, counted=counted)

    def changes_si(self) -> list[tuple[Array, Array, Array]]:
        """∂A, ∂B and ∂C of `plant_si` to each parameter."""
        w0 = self.omega_0
        return [(w0 * dA, w0 / self.force * dB, dC)
                for dA, dB, dC in zip(self.dA, self.dB, self.dC, strict=True)]  # fmt: skip

    def controller_si(self, A: Array, B: Array, C: Array) -> StateSpace:
        """A controller of the scaled plant, error in to force out, time in s."""
        return strictly_proper(self.omega_0 * A, self.omega_0 * B, self.force * C)


def scale_plant(modal: ModalPlant, M_K: float, *, bare: bool = False) -> ScaledPlant:
    """Scale a modal plant for weights with this M_K.

        ω₀² = M_K ‖b‖ ‖c‖,   b and c the sizes of the rows of B and the columns of C

    Parameters
    ----------
    modal : ModalPlant
    M_K : float
        Force over displacement, N/m.
    bare : bool
        Without the grid, the gains and the channels, which only a synthesis needs.

    Returns
    -------
    ScaledPlant

    Raises
    ------
    PlantError
        No mode is both driven and measured.
    """
    if modal.wiring:
        found = _scale(modal, M_K, bare)
        return replace(found, mechanics=_scale(replace(modal, wiring=UNWIRED), M_K, True))
    return _scale(modal, M_K, bare)


def scale_at_ports(modal: ModalPlant, M_K: float, own: OwnPorts) -> ScaledPlant:
    """Scale a plant that says where forces act or what counts.

    Parameters
    ----------
    modal : ModalPlant
        With further inputs and outputs.
    M_K : float
        N/m.
    own : OwnPorts
        Which are its actuators' and sensors'.

    Returns
    -------
    ScaledPlant
        Of these, in their unit of frequency, with what disturbing forces move beside it; without
        the grid, the gains and the channels.
    """
    wide = _scale(modal, M_K, True)
    B, C = own.drives(modal.B)[0], own.readings(modal.C)[0]
    leading = 2, np.array([[np.linalg.norm(B) * np.linalg.norm(C)]])
    if (states := modal.states) is not None:
        order, term = states.leading
        leading = order, term[: own.outputs, : own.inputs]
        if not leading[1].any():
            A, B, C = states.system.A, states.system.B, states.system.C
            leading = leading_term(A, own.drives(B)[0], own.readings(C)[0])
    omega_0 = _unit_of_frequency(leading, M_K)
    if not omega_0 > 0.0:
        raise PlantError("input or output is zero: no mode is both driven and measured")
    time = wide.omega_0 / omega_0
    wide = replace(wide, A=time * wide.A, B=time * wide.B, dA=time * wide.dA, dB=time * wide.dB,
                   omega_0=omega_0)  # fmt: skip
    (B, E), (C, whole) = own.drives(wide.B), own.readings(wide.C)
    (dB, dE), (dC, dwhole) = own.drives(wide.dB), own.readings(wide.dC)
    moved = replace(wide, B=E, C=whole, dB=dE, dC=dwhole)
    counted = replace(moved, B=B, dB=dB) if own.counted else None
    return replace(wide, B=B, C=C, dB=dB, dC=dC, mechanics=moved, counted=counted)


def _scale(modal: ModalPlant, M_K: float, bare: bool) -> ScaledPlant:
    if modal.states is not None:
        return _scaled_states(modal, modal.states, M_K, bare)
    b = np.linalg.norm(modal.B, axis=1)
    c = np.linalg.norm(modal.C, axis=0)
    omega_0 = float(np.sqrt(M_K * np.linalg.norm(b) * np.linalg.norm(c)))
    if not omega_0 > 0.0:
        raise PlantError("input or output is zero: no mode is both driven and measured")
    K, D = modal.K / omega_0**2, modal.D / omega_0
    drive = M_K / omega_0**2
    # Stretch x1 = s q so that ẋ1 = s x2 and ẋ2 = -(K/s) x1 weigh alike; mode sizes by a, so
    # that each mode is driven as strongly as it is measured.
    s = np.maximum(np.sqrt(np.abs(np.diag(K))), 1.0)
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
    if modal.wiring:
        plant, slopes = strictly_proper(A, B, C), Slopes(dA, dB, dC)
        plant, (dA, dB, dC) = modal.wiring.states(plant, slopes, omega_0, M_K)
        A, B, C = plant.A, plant.B, plant.C
    if bare:
        none = np.empty(0)
        return ScaledPlant(A, B, C, omega_0, M_K, none, none, modal.natural, dA, dB, dC)
    grid, gain = _gains(A, B, C)
    apart = () if modal.wiring else find_channels(modal.K, modal.D, modal.B, modal.C)
    channels = _scaled_channels(apart, A, B, C)
    return ScaledPlant(A, B, C, omega_0, M_K, grid, gain, modal.natural, dA, dB, dC, channels)


def _scaled_states(
    modal: ModalPlant, states: FirstOrderPlant, M_K: float, bare: bool
) -> ScaledPlant:
    """A plant of first order; ω₀ as `scale_state_space` has it, free bodies alike."""
    system, n, r = states.system, states.bodies, states.at_rest
    omega_0 = _unit_of_frequency(states.leading, M_K)
    A, B, C = system.A / omega_0, system.B * (M_K / omega_0), system.C
    t = np.append(np.ones(r), state_scales(A[r:, r:], B[r:], C[:, r:]))
    t[:r] /= np.linalg.norm(C[:, :r]) or 1.0
    t[n : 2 * n] *= omega_0
    dA, dB, dC = states.slopes
    slopes = Slopes(
        dA / omega_0 * t / t[:, None], dB * (M_K / omega_0) / t[:, None], dC * t
    )  # fmt: skip
    plant = strictly_proper(A * t / t[:, None], B / t[:, None], C * t)
    if modal.wiring:
        plant, slopes = modal.wiring.states(plant, slopes, omega_0, M_K)
    parts = (np.empty(0), np.empty(0)) if bare else _gains(plant.A, plant.B, plant.C)
    return ScaledPlant(
        plant.A, plant.B, plant.C, omega_0, M_K, *parts, modal.natural, *slopes
    )  # fmt: skip


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
    omega_0 = _unit_of_frequency(leading_term(system.A, system.B, system.C), M_K)
    A, B, C = balance_system(system.A / omega_0, system.B * (M_K / omega_0), system.C)
    grid, gain = _gains(A, B, C)
    poles = np.linalg.eigvals(system.A)
    natural = np.sort(np.abs(poles[poles.imag >= 0.0]))
    none = (np.zeros((0, n, n)), np.zeros((0, n, m)), np.zeros((0, p, n)))
    return ScaledPlant(A, B, C, omega_0, M_K, grid, gain, natural, *none)


def _unit_of_frequency(leading: tuple[int, Array], M_K: float) -> float:
    """ω₀ in rad/s; see `scale_state_space`."""
    order, term = leading
    if not order:
        raise PlantError("C Aⁿ B is zero for every n: no force accelerates what is measured")
    return float((M_K * np.linalg.norm(term, 2)) ** (1.0 / order))


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


def _gains(
    A: Array, B: Array, C: Array, *, options: ScalingOptions = ScalingOptions()
) -> tuple[Array, Array]:
    """A logarithmic grid with points crowded around lightly damped poles and zeros, and the least
    singular value of the plant on it."""
    system = strictly_proper(A, B, C)
    roots = np.concatenate([system.poles, system.zeros()])
    low, high, size = options.lowest, options.highest, np.abs(roots)
    roots = roots[(roots.imag > 0.0) & (size > low) & (size < high)]
    wide = np.maximum(np.abs(roots.real), 1e-9 * roots.imag) + 1j * roots.imag
    grid = frequency_grid(low, high, options.points, root_flanks(wide, options.flanks))
    poles, beside = system.poles, options.beside
    axis = poles[np.abs(poles.real) < options.on_axis * np.abs(poles)].imag
    on_pole = (np.abs(grid[:, None] - np.abs(axis)) < beside * grid[:, None]).any(axis=1)
    grid = np.ascontiguousarray(np.where(on_pole, (1.0 + beside) * grid, grid))
    return grid, plant_gain(A, B, C, grid)
