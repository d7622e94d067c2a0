"""Channels of a plant with several inputs and outputs: K(s) = V diag(K_1(s), …, K_c(s)) Uᵀ.

Where U and V are orthogonal, S, KS, T and GS are Uᵀ S U and so forth in other coordinates, with the
same singular values. Where Uᵀ G V is diagonal besides, the loop falls apart: every bound holds for
the whole exactly if it holds for each channel. The blocks of an exactly block-diagonal plant are
those of `plants.channels`; within a block U and V are the singular vectors of its static gain, for
a stage on a soft suspension the directions in which its rigid body moves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy

from ccd_casadi.fixed_structure.bounds import ChannelBounds
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

ORTHOGONAL = 1e-9  # of UᵀU - I: with more, singular values differ between the coordinates
PROBES = np.geomspace(1e-3, 1e3, 19)  # over ω₀
DIAGONAL = 1e-7  # |G_ij| over the mean of |G_ii| and |G_jj| that counts as no coupling
NOTHING = 1e-12  # the same by which no part of a plant couples channels, at its resonance either
ABSENT = 1e-8  # share of the strongest drive or reading under which a mode is in no channel
LEAST_GAIN = 1e-9  # of static gains, relative: a channel below it is none


@dataclass(frozen=True)
class Decoupling:
    """Names of the channels and their unit directions U (p, c) of outputs, V (m, c) of inputs."""

    names: tuple[str, ...]
    outputs: Array
    inputs: Array

    @property
    def orthogonal(self) -> bool:
        """Whether U and V are orthogonal, so that the coordinates of channels keep all norms."""
        eye = np.eye(len(self.names))
        return all(
            M.shape[0] == M.shape[1] and np.abs(M.T @ M - eye).max() <= ORTHOGONAL
            for M in (self.outputs, self.inputs)
        )


def find_decoupling(plant: ScaledPlant) -> Decoupling:
    """The channels of a square plant, numbered by falling static gain, free bodies suspended.

    Raises PlantError where the plant is not square or cannot be moved in some direction.
    """
    plant = plant.design_plant
    p, m = plant.C.shape[0], plant.B.shape[1]
    if p != m:
        words = f"has {p} outputs and {m} inputs; sections need as many of one as of the other"
        raise PlantError(words)
    static = -plant.C @ np.linalg.solve(plant.A, plant.B)
    blocks = [(c.outputs, c.inputs) for c in plant.channels] or [(np.eye(p), np.eye(m))]
    outputs, inputs, gains = [], [], []
    for out, into in blocks:
        U, s, Vt = np.linalg.svd(out.T @ static @ into)
        outputs.append(out @ U)
        inputs.append(into @ Vt.T)
        gains.append(s)
    gain = np.concatenate(gains)
    if not gain.min() > LEAST_GAIN * gain.max():
        raise PlantError("does not move in every direction of its outputs; leave some of them out")
    order = np.argsort(-gain, kind="stable")
    U, V = np.hstack(outputs)[:, order], np.hstack(inputs)[:, order]
    # One sign of two: the largest entry of a direction is positive.
    sign = np.sign(U[np.abs(U).argmax(axis=0), np.arange(p)])
    return Decoupling(tuple(str(i + 1) for i in range(p)), U * sign, V * sign)


def given_decoupling(
    names: Sequence[str], outputs: Sequence[Sequence[float]], inputs: Sequence[Sequence[float]]
) -> Decoupling:
    """The channels that a case gives by directions, which are brought to length 1.

    There may be fewer outputs than channels (several actuators on one sensor: `[[1], [1]]`). Raises
    PlantError where directions are zero, not of one length, or do not span all outputs and inputs.
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
    decoupling: Decoupling, given: Mapping[str, Mapping[str, float]]
) -> tuple[ChannelBounds, ...]:
    """`channels` of `Bounds`: by a channel's name what it keeps for itself, in keywords.

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


def in_channels(plant: ScaledPlant, decoupling: Decoupling) -> ScaledPlant:
    """Uᵀ G V, the same states."""
    U, V = decoupling.outputs, decoupling.inputs
    return replace(plant, B=plant.B @ V, C=U.T @ plant.C, dB=plant.dB @ V,
                   dC=U.T @ plant.dC, channels=())  # fmt: skip


def channel_plant(plant: ScaledPlant, decoupling: Decoupling, number: int) -> ScaledPlant:
    """The SISO plant u_iᵀ G v_i, with the states that take part in it or may as θ moves."""
    whole = in_channels(plant, decoupling)
    b, c = whole.B[:, [number]], whole.C[[number]]
    count, group = _apart((whole.A != 0.0).tobytes(), len(whole.A))
    drive, reading = np.zeros(count), np.zeros(count)
    np.maximum.at(drive, group, np.abs(b[:, 0]))
    np.maximum.at(reading, group, np.abs(c[0]))
    live = (drive > ABSENT * drive.max()) | (reading > ABSENT * reading.max())
    at = np.flatnonzero(live[group])
    dA, dB, dC = whole.dA, whole.dB[:, :, [number]], whole.dC[:, [number]]
    return replace(
        whole, A=whole.A[np.ix_(at, at)], B=b[at], C=c[:, at], dA=dA[:, at][:, :, at], dB=dB[:, at],
        dC=dC[:, :, at], grid=np.empty(0), gain=np.empty(0),
    )  # fmt: skip


@lru_cache(maxsize=64)  # plants of a set are alike
def _apart(coupled: bytes, states: int) -> tuple[int, np.ndarray]:
    """How many parts of A have no entry between each other, and which one each state is of."""
    pattern = np.frombuffer(coupled, bool).reshape(states, states)
    count, group = scipy.sparse.csgraph.connected_components(pattern, directed=False)
    return int(count), group


def is_decoupled(plant: ScaledPlant, decoupling: Decoupling) -> bool:
    """Whether Uᵀ G V is diagonal, at every resonance and between; U and V have to be orthogonal."""
    if not decoupling.orthogonal:
        return False
    whole = in_channels(plant, decoupling)
    count, group = _apart((whole.A != 0.0).tobytes(), len(whole.A))
    taken = np.zeros((count, len(whole.C)))
    for part in (np.abs(whole.B), np.abs(whole.C.T)):
        np.maximum.at(taken, group, part / part.max(axis=0))
    if ((taken > NOTHING).sum(axis=1) <= 1).all():
        return True
    if _coupled(whole, PROBES[::6]) or _coupled(whole, PROBES):
        return False
    poles = np.linalg.eigvals(whole.A)
    return not _coupled(whole, np.abs(poles[poles.imag >= 0.0]))


def _coupled(whole: ScaledPlant, omega: Array) -> bool:
    """Whether G is more than diagonal at some of these frequencies over ω₀."""
    G = np.abs(whole.system.response(omega))
    own = np.sqrt(np.einsum("kii->ki", G))
    coupling = G / np.maximum(own[:, :, None] * own[:, None, :], 1e-300)
    coupling[:, range(len(own[0])), range(len(own[0]))] = 0.0
    return bool(coupling.max() > DIAGONAL)


def in_units_of(plant: ScaledPlant, first: ScaledPlant) -> ScaledPlant:
    """The same plant with time and force counted as those of another one."""
    time = plant.omega_0 / first.omega_0
    drive = time * first.force / plant.force
    return replace(
        plant, A=time * plant.A, B=drive * plant.B, dA=time * plant.dA, dB=drive * plant.dB,
        omega_0=first.omega_0, force=first.force, channels=(), family=(),
    )  # fmt: skip
