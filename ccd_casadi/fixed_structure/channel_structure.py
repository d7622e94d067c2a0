"""One structure for each channel: K(s) = V diag(K_1(s), …, K_c(s)) Uᵀ, κ one after the other."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.fixed_structure.decoupling import Decoupling
from ccd_casadi.fixed_structure.structure import Kind, Structure, roots, state_space
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class ChannelStructure:
    """The channels and the structure of each; a parameter of channel z is named `z: gain`."""

    decoupling: Decoupling
    structures: tuple[Structure, ...]

    def __post_init__(self) -> None:
        if len(self.structures) != len(self.decoupling.names):
            words = f"{len(self.structures)} structures for {len(self.decoupling.names)} channels"
            raise ValueError(f"{words}; give one for each")

    @property
    def order(self) -> int:
        """The number of states of K."""
        return sum(structure.order for structure in self.structures)

    @property
    def integrator(self) -> bool:
        """Whether every channel has one."""
        return all(structure.integrator for structure in self.structures)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters in the order of κ."""
        pairs = zip(self.decoupling.names, self.structures, strict=True)
        return tuple(f"{channel}: {name}" for channel, own in pairs for name in own.names)

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """The kind of each parameter."""
        return tuple(kind for own in self.structures for kind in own.kinds)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each channel's parameters are in κ."""
        ends = np.cumsum([0, *(len(own.names) for own in self.structures)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    def split(self, kappa: Array) -> Iterator[tuple[Structure, Array]]:
        """The structure and the parameters of each channel."""
        for own, place in zip(self.structures, self.slices, strict=True):
            yield own, kappa[place]

    def bounds(self, frequencies: tuple[float, float], gains: tuple[float, float]) -> Array:
        """Lower and upper bounds (2, n) of κ for frequencies and gains within these."""
        return np.hstack([own.bounds(frequencies, gains) for own in self.structures])

    def in_units(self, kappa: Array, frequency: float, gain: float) -> Array:
        """κ with frequencies times `frequency` and gains times `gain`."""
        parts = [own.in_units(part, frequency, gain) for own, part in self.split(kappa)]
        return np.concatenate(parts)

    def state_space(self, kappa: Array) -> StateSpace:
        """K, outputs of the plant to its inputs."""
        system = self.diagonal(kappa)
        U, V = self.decoupling.outputs, self.decoupling.inputs
        return StateSpace(system.A, system.B @ U.T, V @ system.C, V @ system.D @ U.T)

    def diagonal(self, kappa: Array) -> StateSpace:
        """diag(K_1, …, K_c) alone."""
        parts = [state_space(own, part) for own, part in self.split(np.asarray(kappa, float))]
        A, B, C, D = (block_diag(*(getattr(part, name) for part in parts)) for name in "ABCD")
        return StateSpace(A, B, C, D)

    def roots(self, kappa: Array) -> tuple[np.ndarray, np.ndarray]:
        """Zeros and poles of all channels."""
        zeros, poles = zip(*(roots(own, part) for own, part in self.split(kappa)), strict=True)
        return np.concatenate(zeros), np.concatenate(poles)


def controller_of(structure: Structure | ChannelStructure, kappa: Array) -> StateSpace:
    """K of either kind, in the units of κ."""
    if isinstance(structure, ChannelStructure):
        return structure.state_space(kappa)
    return state_space(structure, kappa)
