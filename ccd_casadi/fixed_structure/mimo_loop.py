"""Plants of several channels in the loop with one controller, as `loop` has those of one.

Everything is in the variable w and in the units of `loop`. u = -K y with K = V diag(K_i) Uᵀ; where
U and V are orthogonal the plants are turned into the coordinates of the channels first. There may
be more inputs than outputs: two actuators on one sensor are U = (1 1), V = I, G K = G_1 K_1 + G_2
K_2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.decoupling import Decoupling, in_channels
from ccd_casadi.fixed_structure.loop import PlantSet, rows_alike
from ccd_casadi.fixed_structure.loop_plant import (
    finite_zeros,
    loop_plants,
    padded_modes,
    padded_states,
)
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


@dataclass(frozen=True)
class MatrixPlantSet(PlantSet):
    """A set of p x m plants, p <= m; `matrices` (P, n, p, m) the residues, `residues` their sizes.

    `out` = Uᵀ and `into` = V in the coordinates of the plants: identities where they are turned.
    """

    matrices: np.ndarray
    out: Array
    into: Array

    def responses(self, which: np.ndarray, v: Array) -> tuple[np.ndarray, np.ndarray]:
        """G (..., p, m) of the plants `which` at jv and ∂G/∂ln v; both indices of one shape."""
        value, slope = self._summed(which, *self.modal_terms(which, v))
        return value, slope

    def free_responses(self, which: np.ndarray, v: Array) -> tuple[np.ndarray, np.ndarray]:
        """The same without hold and delay."""
        value, slope = self._summed(which, *self.modal_terms(which, v, free=True))
        return value, slope

    def values(self, which: np.ndarray, v: Array, *, free: bool = False) -> np.ndarray:
        """G alone; `free` of hold and delay."""
        term = self.modal_values(which, v, free=free)
        rows = rows_alike(which)
        n, p, m = self.matrices.shape[1:]
        if rows.shape == which.shape:
            return self._summed(which, term)[0]
        found = term @ self.matrices[rows[..., 0]].reshape(*rows.shape[:-1], n, p * m)
        return np.asarray(found.reshape(*which.shape, p, m))

    def _summed(self, which: np.ndarray, *terms: np.ndarray) -> tuple[np.ndarray, ...]:
        n, p, m = self.matrices.shape[1:]
        flat = self.matrices.reshape(-1, n, p * m)
        found = []
        for term in terms:
            out = np.empty((*which.shape, p * m), complex)
            for i in np.unique(which):
                at = which == i
                out[at] = term[at] @ flat[i]
            found.append(out.reshape(*which.shape, p, m))
        return tuple(found)


def matrix_plant_set(
    plants: Sequence[ScaledPlant], decoupling: Decoupling, sampling: Sampling | None = None
) -> MatrixPlantSet:
    """The plants in the units of the first, with hold and delay where the loop is sampled.

    Raises PlantError for a plant whose inputs or outputs are not those of the channels, that has
    more outputs than inputs, is not stable, or not diagonalisable.
    """
    asked = (len(decoupling.outputs), len(decoupling.inputs))
    for number, plant in enumerate(plants, 1):
        shape = (plant.C.shape[0], plant.B.shape[1])
        words = f"plant {number} has {shape[0]} outputs and {shape[1]} inputs"
        if shape != asked:
            given = f"the channels' directions have {asked[0]} and {asked[1]} entries"
            raise PlantError(f"{words}, but {given}; give as many of each")
        if shape[0] > min(shape[1], len(decoupling.names)):
            given = f"for {len(decoupling.names)} channels"
            raise PlantError(f"{words} {given}; leave some outputs out, or give more channels")
    out, into = decoupling.outputs.T, decoupling.inputs
    if decoupling.orthogonal:
        plants = [in_channels(plant, decoupling) for plant in plants]
        out = into = np.eye(asked[0])
    found, units = loop_plants(plants, sampling)
    poles, matrices = padded_modes(found)
    sizes = np.linalg.norm(matrices, axis=(2, 3))
    zeros = tuple(finite_zeros(loop) for loop in found)
    return MatrixPlantSet(tuple(found), *units, poles, sizes, zeros, *padded_states(found),
                          matrices, out, into)  # fmt: skip


def whole_closed_loops(
    plants: MatrixPlantSet, structure: ChannelStructure, kappa: Array
) -> np.ndarray:
    """Poles (P, n) in w of every plant's loop with one controller κ; NaN if ill-posed."""
    K = structure.diagonal(kappa)
    b, c = K.B @ plants.out, plants.into @ K.C
    d = plants.into @ K.D @ plants.out
    P, n, k = len(plants.A), plants.A.shape[1], len(K.A)
    A, B, C, D = plants.A, plants.B, plants.C, plants.D
    joint = np.empty((P, n + k, n + k))
    well = np.eye(len(d)) + d @ D
    posed = np.linalg.svd(well, compute_uv=False)[:, -1] > 0.0
    m = np.linalg.inv(np.where(posed[:, None, None], well, np.eye(len(d))))
    joint[:, :n, :n] = A - B @ m @ d @ C
    joint[:, :n, n:] = B @ m @ c
    joint[:, n:, :n] = -b @ (C - D @ m @ d @ C)
    joint[:, n:, n:] = K.A - b @ D @ m @ c
    values = np.linalg.eigvals(joint)
    return np.where(posed[:, None], values, np.nan)
