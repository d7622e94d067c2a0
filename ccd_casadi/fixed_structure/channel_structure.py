"""One structure for each channel: K(s) = V diag(K_1(s), …, K_c(s)) Uᵀ, κ one after the other.

Channels may share their parameters, as tip and tilt of a square stage do: a load to one side asks
of one what the same load to the other asks of the other.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from ccd_casadi.fixed_structure.decoupling import Decoupling
from ccd_casadi.fixed_structure.structure import Kind, Structure
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class ChannelStructure:
    """The channels and the structure of each; a parameter of channel z is named `z: gain`.

    `owners`: the number of the channel whose parameters each one has; empty: each its own.
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

    def owner(self, number: int) -> int:
        """The channel whose parameters a channel has."""
        return self.owners[number] if self.owners else number

    @cached_property
    def free(self) -> tuple[int, ...]:
        """The channels with parameters of their own, in the order of κ."""
        return tuple(i for i in range(len(self.structures)) if self.owner(i) == i)

    @cached_property
    def apart(self) -> "ChannelStructure":
        """The same with parameters of its own for each channel."""
        return replace(self, owners=())

    @cached_property
    def places(self) -> np.ndarray:
        """Where in κ each parameter of `apart` is."""
        return np.concatenate([np.arange(own.start, own.stop) for own in self.slices])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters in the order of κ."""
        pairs = ((self.decoupling.names[i], self.structures[i]) for i in self.free)
        return tuple(f"{channel}: {name}" for channel, own in pairs for name in own.names)

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """The kind of each parameter."""
        return tuple(kind for i in self.free for kind in self.structures[i].kinds)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each channel's parameters are in κ."""
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

    def bounds(self, frequencies: tuple[float, float], gains: tuple[float, float]) -> Array:
        """Lower and upper bounds (2, n) of κ for frequencies and gains within these."""
        return np.hstack([self.structures[i].bounds(frequencies, gains) for i in self.free])

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
