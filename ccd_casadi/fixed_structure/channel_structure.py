"""One structure for each channel: K(s) = V diag(K_1(s), …, K_c(s)) Uᵀ, and how V and U decouple a
plant."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import scipy

from ccd_casadi.fixed_structure.bounds import BrokenAt, ChannelBounds
from ccd_casadi.fixed_structure.structure import ParameterKind, Structure
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant, singular_vectors
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


@dataclass(frozen=True)
class Decoupling:
    """Channels of a plant with p outputs and m inputs.

    Attributes
    ----------
    names : tuple of str
        c channels.
    outputs, inputs : array (p, c), (m, c)
        Unit directions U and V.
    """

    names: tuple[str, ...]
    outputs: Array
    inputs: Array

    @property
    def orthogonal(self) -> bool:
        """Whether U and V are orthogonal (to 1e-9), so that channels' coordinates keep norms."""
        eye = np.eye(len(self.names))
        return all(
            M.shape[0] == M.shape[1] and np.abs(M.T @ M - eye).max() <= 1e-9
            for M in (self.outputs, self.inputs)
        )


def find_decoupling(plant: ScaledPlant, *, least_gain: float = 1e-9) -> Decoupling:
    """Find the channels of a square plant: the singular vectors of its static gain.

    Where two of these gains are alike their directions say nothing; those in which the plant is
    diagonal at every frequency are then taken, if there are any.

    Parameters
    ----------
    plant : ScaledPlant
        Free bodies count as suspended; blocks of `plant.channels` are decoupled one by one.
    least_gain : float
        Singular value over the largest below which the plant does not move in a direction.

    Returns
    -------
    Decoupling
        By falling static gain; the largest entry of each direction of outputs is positive.

    Raises
    ------
    PlantError
        The plant is not square, or does not move in some direction.
    """
    plant = plant.design_plant
    p, m = plant.C.shape[0], plant.B.shape[1]
    if p != m:
        words = f"has {p} outputs and {m} inputs; sections need as many of one as of the other"
        raise PlantError(words)
    static = -plant.C @ np.linalg.solve(plant.A, plant.B)
    blocks = [(c.outputs, c.inputs) for c in plant.channels] or [(np.eye(p), np.eye(m))]
    parts = [np.linalg.svd(out.T @ static @ into) for out, into in blocks]
    pairs = [(out @ U, into @ Vt.T) for (out, into), (U, _, Vt) in zip(blocks, parts, strict=True)]
    gain = np.concatenate([s for _, s, _ in parts])
    if not gain.min() > least_gain * gain.max():
        raise PlantError("does not move in every direction of its outputs; leave some of them out")
    found = _sorted_channels(static, *map(np.hstack, zip(*pairs, strict=True)))
    if not plant.channels and not is_decoupled(plant, found):
        real = plant.system.at(np.geomspace(1e-2, 1e2, 9)).real
        U, _, Vt = singular_vectors(real / np.abs(real).max((1, 2), keepdims=True))
        other = _sorted_channels(static, U, Vt.T)
        found = other if is_decoupled(plant, other) else found
    return found


def _sorted_channels(static: Array, U: Array, V: Array) -> Decoupling:
    """Directions by falling static gain, and of both signs that of a positive largest entry."""
    order = np.argsort(-np.abs(np.einsum("pi,pm,mi->i", U, static, V)), kind="stable")
    U, V = U[:, order], V[:, order]
    sign = np.sign(U[np.abs(U).argmax(axis=0), np.arange(len(U))])
    return Decoupling(tuple(str(i + 1) for i in range(len(U))), U * sign, V * sign)


def given_decoupling(
    names: Sequence[str], outputs: Sequence[Sequence[float]], inputs: Sequence[Sequence[float]]
) -> Decoupling:
    """Make the channels that a case gives by directions, which are brought to length 1.

    There may be fewer outputs than channels (several actuators on one sensor: `[[1], [1]]`), or one
    input for all channels (several sensors on one actuator: `[[1], [1]]` again).

    Parameters
    ----------
    names : sequence of str
        c channels.
    outputs, inputs : sequence of sequences of float
        c directions of p and of m entries.

    Returns
    -------
    Decoupling

    Raises
    ------
    PlantError
        Directions are zero, not of one length, or do not span all outputs and inputs.
    """
    found = []
    for word, rows in (("outputs", outputs), ("inputs", inputs)):
        count, most = len(rows[0]), len(names)
        for name, row in zip(names, rows, strict=True):
            if len(row) != count or not row:
                words = f"channel {name} is a direction of {len(row)} {word}, {names[0]} of {count}"
                raise PlantError(f"{words}; give a number for each of the plant's {word}")
        if count > most:
            words = f"{count} {word} need a channel each, and {most} of these are given; add"
            raise PlantError(f"{words} {count - most} more, or drop {word} of the plant")
        if count == 1 and word == "inputs" and len(outputs[0]) == most:
            found.append(np.ones((1, most)))
            continue
        if count < most and word == "inputs":
            words = f"{count} {word} drive as many channels, and {most} of these are given; drop"
            raise PlantError(f"{words} {most - count}, or give the plant more {word}")
        M = np.array(rows, float).T
        length = np.linalg.norm(M, axis=0)
        if not (length > 0.0).all() or np.linalg.cond(M / length) > 1e6:
            raise PlantError(f"the channels' directions of {word} are not independent; change them")
        found.append(M / length)
    return Decoupling(tuple(names), found[0], found[1])


def channel_bounds(
    decoupling: Decoupling, given: Mapping[str, Mapping[str, Any]]
) -> tuple[ChannelBounds, ...]:
    """Make the `channels` of `Bounds` from the bounds of single channels.

    Parameters
    ----------
    decoupling : Decoupling
    given : mapping
        By a channel's name the keywords of `ChannelBounds`; other channels have none.

    Returns
    -------
    tuple of ChannelBounds
        One for each channel, in their order.

    Examples
    --------
    >>> channels = given_decoupling(("z", "tilt"), [[1, 1], [1, -1]], [[1, 1], [1, -1]])
    >>> own = channel_bounds(channels, {"tilt": {"S_max": 1.5, "bandwidth_ratio": 2.0}})
    >>> [(one.name, one.S_max, one.bandwidth_ratio) for one in own]
    [('z', None, 1.0), ('tilt', 1.5, 2.0)]
    """
    force = np.linalg.inv(decoupling.inputs)
    return tuple(
        ChannelBounds(name, tuple(map(float, decoupling.outputs[:, i])),
                      tuple(map(float, force[i])), **given.get(name, {}))
        for i, name in enumerate(decoupling.names)
    )  # fmt: skip


def sensors_on_one_actuator(
    decoupling: Decoupling, S_max: float, own: Mapping[str, float] | None = None
) -> tuple[ChannelBounds, ...]:
    """Make the `channels` of `Bounds` where all channels drive one actuator.

        S_i = 1/(1 + L_i) = (1 + Σ_{j≠i} G_j K_j)/(1 + Σ_j G_j K_j)   broken at sensor i alone
        S_u = 1/(1 + Σ_j G_j K_j)                                      broken at the actuator

    Parameters
    ----------
    decoupling : Decoupling
        V = (1 ... 1).
    S_max : float
        Bound at every place.
    own : mapping
        By name of a channel or "actuator" a lower one.

    Returns
    -------
    tuple of ChannelBounds
        Of every sensor, in the channels' order, then of the actuator.
    """
    own = own or {}
    references = np.linalg.inv(decoupling.outputs).T  # rᵢᵀuⱼ is 1 for i = j, else 0
    places = [
        ChannelBounds(name, tuple(map(float, decoupling.outputs[:, i])), (1.0,),
                      S_max=own.get(name, S_max), place=BrokenAt.SENSOR,
                      reference=tuple(map(float, references[:, i])))
        for i, name in enumerate(decoupling.names)
    ]  # fmt: skip
    last = ChannelBounds("actuator", (0.0,) * len(decoupling.outputs), (1.0,),
                         S_max=own.get("actuator", S_max), place=BrokenAt.ACTUATOR)  # fmt: skip
    return (*places, last)


def in_channels(plant: ScaledPlant, decoupling: Decoupling) -> ScaledPlant:
    """Uᵀ G V, the same states."""
    U, V = decoupling.outputs, decoupling.inputs
    found = replace(plant, B=plant.B @ V, C=U.T @ plant.C, dB=plant.dB @ V, dC=U.T @ plant.dC,
                    channels=())  # fmt: skip
    return found.forced_as(lambda own: in_channels(own, decoupling))


def sensor_levels(plant: ScaledPlant, decoupling: Decoupling) -> Array:
    """ln of the median |G_i| of each channel of a plant, over two decades below ω₀.

    Raises PlantError for a channel that reads nothing.
    """
    G = in_channels(plant, decoupling).system.response(np.geomspace(0.01, 1.0, 49))
    own = np.median(np.abs(G).max(axis=2), axis=0)
    for name, level in zip(decoupling.names, own, strict=True):
        if not level > 0.0:
            words = "reads nothing that the actuator moves; correct its row of output, or leave"
            raise PlantError(f"the sensor of channel {name} {words} it out")
    return np.asarray(np.log(own))


def channel_plant(
    plant: ScaledPlant, decoupling: Decoupling, number: int, *, absent: float = 1e-8
) -> ScaledPlant:
    """Take the SISO plant u_iᵀ G v_i of a channel.

    Parameters
    ----------
    plant, decoupling, number : ScaledPlant, Decoupling, int
        i is `number`.
    absent : float
        Share of the strongest drive or reading below which a part of the plant is left out.

    Returns
    -------
    ScaledPlant
        With the states that take part in it or may as θ moves.
    """
    whole = in_channels(plant, decoupling)
    b, c = whole.B[:, [number]], whole.C[[number]]
    count, group = _apart((whole.A != 0.0).tobytes(), len(whole.A))
    drive, reading = np.zeros(count), np.zeros(count)
    np.maximum.at(drive, group, np.abs(b[:, 0]))
    np.maximum.at(reading, group, np.abs(c[0]))
    live = (drive > absent * drive.max()) | (reading > absent * reading.max())
    at = np.flatnonzero(live[group])
    dA, dB, dC = whole.dA, whole.dB[:, :, [number]], whole.dC[:, [number]]
    own = plant.mechanics
    return replace(
        whole, A=whole.A[np.ix_(at, at)], B=b[at], C=c[:, at], dA=dA[:, at][:, :, at], dB=dB[:, at],
        dC=dC[:, :, at], grid=np.empty(0), gain=np.empty(0),
        mechanics=own and channel_plant(own, decoupling, number, absent=absent),
    )  # fmt: skip


@lru_cache(maxsize=64)  # plants of a set are alike
def _apart(coupled: bytes, states: int) -> tuple[int, np.ndarray]:
    """Count the parts of A that have no entry between each other, and find the part of each
    state."""
    pattern = np.frombuffer(coupled, bool).reshape(states, states)
    count, group = scipy.sparse.csgraph.connected_components(pattern, directed=False)
    return int(count), group


def is_decoupled(plant: ScaledPlant, decoupling: Decoupling) -> bool:
    """Whether Uᵀ G V is diagonal, at every resonance and between; U and V have to be orthogonal.

    A part of the plant couples no channels where but one of them drives or reads it by more than
    1e-12 of the strongest; else responses decide.
    """
    if not decoupling.orthogonal:
        return False
    whole = in_channels(plant, decoupling)
    count, group = _apart((whole.A != 0.0).tobytes(), len(whole.A))
    taken = np.zeros((count, len(whole.C)))
    for part in (np.abs(whole.B), np.abs(whole.C.T)):
        np.maximum.at(taken, group, part / part.max(axis=0))
    if ((taken > 1e-12).sum(axis=1) <= 1).all():
        return True
    omega = np.geomspace(1e-3, 1e3, 19)  # over ω₀
    if _find_coupled(whole, omega[::6]) or _find_coupled(whole, omega):
        return False
    poles = np.linalg.eigvals(whole.A)
    return not _find_coupled(whole, np.abs(poles[poles.imag >= 0.0]))


def _find_coupled(whole: ScaledPlant, omega: Array, *, diagonal: float = 1e-7) -> bool:
    """Whether |G_ij| is above `diagonal` of the mean of |G_ii| and |G_jj| at some ω over ω₀."""
    G = np.abs(whole.system.response(whole.system.off_poles(omega[omega > 0.0])))
    own = np.sqrt(np.einsum("kii->ki", G))
    coupling = G / np.maximum(own[:, :, None] * own[:, None, :], 1e-300)
    coupling[:, range(len(own[0])), range(len(own[0]))] = 0.0
    return bool(coupling.max() > diagonal)


def in_units_of(plant: ScaledPlant, first: ScaledPlant) -> ScaledPlant:
    """Count the time and the force of a plant as those of another one.

    Parameters
    ----------
    plant, first : ScaledPlant
        `first` has the units.

    Returns
    -------
    ScaledPlant
        The same plant, with the ω₀ and the force of `first`.
    """
    time = plant.omega_0 / first.omega_0
    drive = time * first.force / plant.force
    found = replace(
        plant, A=time * plant.A, B=drive * plant.B, dA=time * plant.dA, dB=drive * plant.dB,
        omega_0=first.omega_0, force=first.force, channels=(), family=(),
    )  # fmt: skip
    return found.forced_as(lambda own: in_units_of(own, first))


@dataclass(frozen=True)
class ChannelStructure:
    """A controller of several channels, K(s) = V diag(K_1(s), …, K_c(s)) Uᵀ.

    A parameter of channel z is named `z: gain`.

    Attributes
    ----------
    decoupling : Decoupling
        U (p, c) and V (m, c).
    structures : tuple of Structure
        One for each channel.
    owners : tuple of int
        The number of the channel whose parameters each one has; empty: each its own.
    """

    decoupling: Decoupling
    structures: tuple[Structure, ...]
    owners: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if len(self.structures) != len(self.decoupling.names):
            words = f"{len(self.structures)} structures for {len(self.decoupling.names)} channels"
            raise ValueError(f"{words}; give one for each")
        for i, owner in enumerate(self.owners):
            if self.owners[owner] != owner or self.structures[owner] != self.structures[i]:
                words = f"channel {self.decoupling.names[i]} is like one of another structure"
                raise ValueError(f"{words}, or like one that is like another; name the first")

    @property
    def order(self) -> int:
        """The number of states of K."""
        return sum(structure.order for structure in self.structures)

    @property
    def integrator(self) -> bool:
        """Whether every channel has one."""
        return all(structure.integrator for structure in self.structures)

    def integrates(self, error: int | None) -> bool:
        """Whether S falls to zero towards 0 Hz, that of the channel whose `error` counts."""
        return self.integrator if error is None else self.structures[error].integrator

    def owner(self, number: int) -> int:
        """The channel whose parameters a channel has."""
        return self.owners[number] if self.owners else number

    @cached_property
    def free(self) -> tuple[int, ...]:
        """The channels with parameters of their own, in the order of κ."""
        return tuple(i for i in range(len(self.structures)) if self.owner(i) == i)

    @cached_property
    def apart(self) -> "ChannelStructure":
        """The same with separate parameters for each channel."""
        return replace(self, owners=())

    @cached_property
    def places(self) -> np.ndarray:
        """The place in κ of each parameter of `apart`."""
        return np.concatenate([np.arange(own.start, own.stop) for own in self.slices])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters in the order of κ."""
        pairs = ((self.decoupling.names[i], self.structures[i]) for i in self.free)
        return tuple(f"{channel}: {name}" for channel, own in pairs for name in own.names)

    @cached_property
    def kinds(self) -> tuple[ParameterKind, ...]:
        """The kind of each parameter."""
        return tuple(kind for i in self.free for kind in self.structures[i].kinds)

    @cached_property
    def gains(self) -> np.ndarray:
        """Whether each parameter is a gain, (n,)."""
        return np.array([kind is ParameterKind.GAIN for kind in self.kinds])

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """The slice of κ with each channel's parameters."""
        ends = np.cumsum([0, *(len(self.structures[i].names) for i in self.free)]).tolist()
        own = dict(zip(self.free, (slice(a, b) for a, b in pairwise(ends)), strict=True))
        return tuple(own[self.owner(i)] for i in range(len(self.structures)))

    @property
    def directions(self) -> tuple[Array, Array]:
        """U (p, c) of outputs and V (m, c) of inputs of its channels."""
        return self.decoupling.outputs, self.decoupling.inputs

    def split(self, kappa: Array) -> Iterator[tuple[Structure, Array]]:
        """The structure and the parameters (..., n) of each channel."""
        for own, place in zip(self.structures, self.slices, strict=True):
            yield own, kappa[..., place]

    def bounds(
        self, frequencies: tuple[float, float], gains: tuple[float, float], omega_0: float
    ) -> Array:
        """Lower and upper bounds (2, n) of κ for frequencies and gains within these; frequencies
        in units of `omega_0` (rad/s)."""
        own = (self.structures[i] for i in self.free)
        return np.hstack([one.bounds(frequencies, gains, omega_0) for one in own])

    def in_units(self, kappa: Array, frequency: float, gain: float) -> Array:
        """κ with frequencies times `frequency` and gains times `gain`."""
        own = ((self.structures[i], kappa[self.slices[i]]) for i in self.free)
        return np.concatenate([one.in_units(part, frequency, gain) for one, part in own])

    def state_space(self, kappa: Array) -> StateSpace:
        """K, outputs of the plant to its inputs."""
        A, B, C, D = (part[0] for part in self.state_spaces(np.asarray(kappa, float)[None]))
        U, V = self.directions
        return StateSpace(A, B @ U.T, V @ C, V @ D @ U.T)

    def state_spaces(self, kappa: Array) -> tuple[Array, Array, Array, Array]:
        """diag(K_1, …, K_c) alone of many parameters κ (N, n), as `Structure` has them."""
        parts = zip(*(own.state_spaces(part) for own, part in self.split(kappa)), strict=True)
        A, B, C, D = map(_diagonal, parts)
        return A, B, C, D

    def roots(self, kappa: Array) -> tuple[np.ndarray, np.ndarray]:
        """Zeros and poles of all channels."""
        zeros, poles = zip(*(own.roots(part) for own, part in self.split(kappa)), strict=True)
        return np.concatenate(zeros), np.concatenate(poles)


def _diagonal(blocks: Sequence[Array]) -> Array:
    """Blocks (N, p_i, m_i) as block-diagonal matrices (N, Σ p_i, Σ m_i)."""
    shapes = np.array([block.shape[1:] for block in blocks])
    out = np.zeros((len(blocks[0]), *shapes.sum(axis=0)), np.result_type(*blocks))
    for (i, j), block in zip(np.cumsum(shapes, axis=0) - shapes, blocks, strict=True):
        out[:, i : i + block.shape[1], j : j + block.shape[2]] = block
    return out
