"""The loop of one controller with every plant of a set, continuous or sampled, in one variable.

Sampled at a rate 1/T, with a zero-order hold and a delay τ, the plant is z⁻ᵈ C f(A) B at the
instants, exactly. It is written in w = (2/T)(z - 1)/(z + 1): the inside of the unit circle becomes
the left half plane, z = e^{jωT} becomes w = jv with v = (2/T) tan(ωT/2), and K(w) is K(z) by
Tustin's rule, without prewarping and without lead, as `deploy` discretises it. So both kinds of
loop are one: poles in the left half plane, responses on jv. Without sampling v = ω. A delay comes
with sampling only: then the loop has finitely many poles, and its stability is decided by them.

u = -K y with K = V diag(K_i) Uᵀ; where U and V are orthogonal the plants are turned into the
coordinates of the channels first. There may be more inputs than outputs: two actuators on one
sensor are U = (1 1), V = I, G K = G_1 K_1 + G_2 K_2; and more outputs on one input: two sensors on
one actuator are U = I, V = (1 1). One channel has U = V = 1.

Free bodies stay free: their poles are exactly 0, of a body that nothing damps twice, q̇ = s v and
v̇ = b u. Such a pair of states is one of N, A = V diag(poles) W + N, N² = 0. Behind an actuator the
force drives q, too, and a sensor reads v.

Time is counted in 1/ω₀ of the first plant, force in its unit (`scaling`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    Decoupling,
    in_channels,
    in_units_of,
)
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels import modes
from ccd_casadi.kernels.modes import PlantSlopes
from ccd_casadi.lti.loop import Sampling, delay_parts, in_w, moment_slopes, moments, with_delays
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.plants.as_written import driven_and_measured, embed
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


@dataclass(frozen=True)
class LoopPlant:
    """One plant as the loop sees it.

    `system` is the continuous plant, `poles` are its, with `drive` = V⁻¹B (n, m) and `reading` =
    CV (p, n) in its eigenvectors V (n, n), W = V⁻¹; `dA` = W ∂A V, `dB` = W ∂B, `dC` = ∂C V,
    leading axis θ. `chains` (k, 2) are the states q, v of free bodies, whose columns of V are those
    of the identity.
    """

    system: StateSpace
    V: np.ndarray
    W: np.ndarray
    poles: np.ndarray
    drive: np.ndarray
    reading: np.ndarray
    dA: np.ndarray
    dB: np.ndarray
    dC: np.ndarray
    chains: np.ndarray

    @property
    def nilpotent(self) -> Array:
        """N (n, n): s from v to q."""
        q, v = self.chains.T
        N = np.zeros_like(self.system.A)
        N[q, v] = self.system.A[q, v]
        return N

    @property
    def wired_bodies(self) -> bool:
        """Whether a force drives the position of a free body, or a sensor reads its velocity."""
        q, v = self.chains.T
        return bool(self.drive[q].any() or self.reading[:, v].any())

    @property
    def free_bodies(self) -> np.ndarray:
        """The matrices of 1/s² of the free bodies, (p, m)."""
        return self.system.C @ self.nilpotent @ self.system.B

    def in_w(self, period: float | None, delay: float) -> StateSpace:
        """Include hold and delay as a rational function of w; itself where nothing is sampled.

        x_{k+1} = V e^{pT} W x_k + V late W B u_{k-d} + V early W B u_{k-d-1}
                  + N (T x_k + h²/2 B u_{k-d} + (T² - h²)/2 B u_{k-d-1})
        """
        if period is None:
            return self.system
        d, *shares = moments(self.poles, period, delay)
        h, N = period - delay_parts(period, delay)[1], self.nilpotent
        coasted = 0.5 * h**2, 0.5 * (period**2 - h**2)
        gains = [((self.V * share) @ self.drive).real + N @ self.system.B * moved
                 for share, moved in zip(shares, coasted, strict=True)]  # fmt: skip
        gains = [np.zeros_like(self.system.B)] * int(d) + gains[: 1 + bool(np.any(shares[1]))]
        step = ((self.V * np.exp(self.poles * period)) @ self.W).real + N * period
        return in_w(with_delays(step, gains, self.system.C, period))


@dataclass(frozen=True)
class PlantSet:
    """All plants, p x m with p <= m or m = 1, in the units of the first; T and τ in 1/ω₀.

    Attributes
    ----------
    plants : tuple of LoopPlant
    omega_0, force : float
        The units, rad/s and N/m.
    period, delay : float or None, float
        In 1/ω₀.
    poles, residues : array (P, n), (P, n, p, m)
        Of the continuous plants, the shorter ones with zeros. At a pole 0 the residue's imaginary
        part is that of 1/s².
    out, into : array (c, p), (m, c)
        Uᵀ and V in the coordinates of the plants: identities where they are turned.
    mechanics, counted : PlantSet, optional
        As a `ForcedPlant` has them; what counts is N x below the outputs y.
    lever : array (P, z, p)
        H of what counts, H y + N x. Free bodies do not move N x: both terms of what a force moves
        are as small as their sum towards 0 Hz. z = 0: the outputs count.
    """

    plants: tuple[LoopPlant, ...]
    omega_0: float
    force: float
    period: float | None
    delay: float
    poles: np.ndarray
    residues: np.ndarray
    out: Array
    into: Array
    mechanics: "PlantSet | None" = None
    counted: "PlantSet | None" = None
    lever: Array = field(default_factory=lambda: np.zeros((0, 0, 1)))

    @property
    def driven(self) -> "PlantSet":
        """What u moves: the outputs, then N x."""
        return self if self.counted is None else self.counted

    @property
    def forced(self) -> "PlantSet":
        """What a disturbing force moves: the outputs, or the positions, then N x."""
        return self if self.mechanics is None else self.mechanics

    @property
    def count(self) -> int:
        """The number of plants."""
        return len(self.poles)

    @cached_property
    def systems(self) -> tuple[StateSpace, ...]:
        """The plants in w."""
        return tuple(plant.in_w(self.period, self.delay) for plant in self.plants)

    @cached_property
    def states(self) -> tuple[Array, Array, Array, Array]:
        """A (P, n, n), B, C and D of these; the shorter ones with stable states that do nothing."""
        A, B, C, D = (pad([getattr(G, name) for G in self.systems]) for name in "ABCD")
        for whole, G in zip(A, self.systems, strict=True):
            rest = np.arange(len(G.A), len(whole))
            whole[rest, rest] = -1.0
        return A, B, C, D

    @cached_property
    def modes(self) -> modes.Plants:
        """Conjugate poles in pairs, as the kernels have them."""
        answers = (self.poles != 0.0) | (self.residues != 0.0).any(axis=(2, 3))
        upper = (self.poles.imag >= 0.0) & answers
        order = np.argsort(~upper, axis=1, kind="stable")[:, : int(upper.sum(axis=1).max())]
        kept = np.take_along_axis(upper, order, axis=1)
        p = np.take_along_axis(self.poles, order, axis=1)
        p.imag = np.abs(p.imag)  # those past the last of a plant have no residue
        r = np.take_along_axis(self.residues, order[..., None, None], axis=1)
        share = np.where(kept, np.where(p.imag == 0.0, 0.5, 1.0), 0.0)[..., None, None]
        both = (share == 1.0) | (p == 0.0)[..., None, None]
        residues = np.stack([share * r.real, np.where(both, r.imag, 0.0)], axis=2)
        if self.period is None:
            return modes.Plants(np.stack([p] * 4, axis=-1), residues, 0.0, 0.0)
        d, late, early = moments(p, self.period, self.delay)
        terms = np.stack([p, late, early, np.exp(p * self.period)], axis=-1)
        return modes.Plants(terms, residues, self.period, d)

    def frequency(self, v: Array) -> Array:
        """ω of v, both over ω₀."""
        if self.period is None:
            return v
        return np.asarray(2.0 / self.period * np.arctan(0.5 * self.period * v))

    def chain(self, v: Array) -> Array:
        """Compute ∂ln ω/∂ln v."""
        T = self.period or 0.0
        return np.asarray(v / self.frequency(v) / (1.0 + (0.5 * T * v) ** 2))

    def variable(self, omega: Array) -> Array:
        """v of ω, both over ω₀; infinite from half the sampling rate on."""
        if self.period is None:
            return omega
        half = np.minimum(0.5 * self.period * omega, 0.5 * np.pi)
        return np.asarray(2.0 / self.period * np.tan(half))

    def responses(self, which: np.ndarray, v: Array) -> tuple[np.ndarray, np.ndarray]:
        """G (..., p, m) of the plants `which` at jv and ∂G/∂ln v; both indices of one shape."""
        v = np.asarray(v, float)
        found = modes.responses(self.modes, np.ravel(which), v.ravel())
        G, slope = (found[:, i].reshape(*v.shape, *found.shape[2:]) for i in (0, 1))
        return G, slope

    @cached_property
    def slopes(self) -> PlantSlopes:
        """The data of the kernels for derivatives to θ; the shorter plants with zeros."""
        C, B, *parts = (pad([getattr(plant, name) for plant in self.plants], dtype=complex)
                        for name in ("reading", "drive", "dA", "dB", "dC"))  # fmt: skip
        poles, kinds = self.poles, np.full(self.poles.shape, modes.SIMPLE, np.int8)
        if any(plant.wired_bodies for plant in self.plants):
            poles, kinds, C, B, parts = self._with_integrators(poles, kinds, C, B, parts)
        for i, plant in enumerate(self.plants):
            q, v = plant.chains.T
            kinds[i, q], kinds[i, v] = modes.POSITION, modes.VELOCITY
            s = plant.system.A[q, v]
            C[i, :, v], C[i, :, q] = s[:, None] * C[i, :, q], 0.0
            B[i, q] = s[:, None] * B[i, v]
        dA, dB, dC = (np.ascontiguousarray(np.moveaxis(part, 1, -1)) for part in parts)
        gap, size = poles[:, :, None] - poles[:, None, :], np.abs(poles)
        # closer ones count as equal: their divided difference is a derivative
        near = np.abs(gap) <= 1e-6 * np.maximum(size[:, :, None], size[:, None, :])
        gaps = np.where(near, 0.0, 1.0 / np.where(near, 1.0, gap))
        terms, d = np.stack([poles] * 6, axis=-1), 0.0
        if self.period is not None:
            T, (d, late, early) = self.period, moments(poles, self.period, self.delay)
            steeper = moment_slopes(poles, T, self.delay)
            terms[..., 1:] = np.stack([late, early, np.exp(poles * T), *steeper], axis=-1)
        both = np.stack([dA.real, dA.imag], axis=3)
        return PlantSlopes(terms, C, B, gaps, both, dB, dC, self.period or 0.0, d, kinds)

    def _with_integrators(
        self, poles: np.ndarray, kinds: np.ndarray, C: np.ndarray, B: np.ndarray,
        parts: list[np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:  # fmt: skip
        """The same with what 1/s adds to 1/s² of bodies behind actuators or sensors, as states.

        The kernels take C(s - A)⁻¹ at v for C_q/s² and (s - A)⁻¹B at q for B_v/s². What is left,
        C_v/s and B_q/s, is of two states with the pole 0: v' has the row of ∂A and ∂B at v, q' the
        column of ∂A and ∂C at q.
        """
        most = max(len(plant.chains) for plant in self.plants)
        width = [(0, 0), (0, 2 * most)]
        poles, kinds = np.pad(poles, width), np.pad(kinds, width, constant_values=modes.SIMPLE)
        C, B = np.pad(C, [(0, 0), *width]), np.pad(B, [*width, (0, 0)])
        dA, dB, dC = parts
        dA = np.pad(dA, [(0, 0), (0, 0), width[1], width[1]])
        dB, dC = (
            np.pad(dB, [(0, 0), (0, 0), width[1], (0, 0)]),
            np.pad(dC, [(0, 0), (0, 0), *width]),
        )
        for i, plant in enumerate(self.plants):
            n, (q, v) = self.poles.shape[1], plant.chains.T
            rate, place = n + np.arange(len(v)), n + most + np.arange(len(q))
            C[i][:, rate], B[i, place] = C[i][:, v], B[i, q]
            dA[i][:, rate], dB[i][:, rate] = dA[i][:, v], dB[i][:, v]
            dA[i][:, :, place], dC[i][:, :, place] = dA[i][:, :, q], dC[i][:, :, q]
        return poles, kinds, C, B, [dA, dB, dC]


def plant_set(
    plants: Sequence[ScaledPlant],
    sampling: Sampling | None = None,
    decoupling: Decoupling | None = None,
    alike: bool = False,
) -> PlantSet:
    """The plants in the units of the first, with hold and delay where the loop is sampled.

    Without a decoupling for one channel. `alike`: they are next to plants of a set, so that their
    poles may be trusted. Raises PlantError for a plant whose inputs or outputs are
    not those of the channels, that has more outputs than inputs, or is not diagonalisable.
    """
    out = into = np.eye(1)
    if decoupling is not None:
        out, into = decoupling.outputs.T, decoupling.inputs
    for number, plant in enumerate(plants, 1):
        shape = (plant.C.shape[0], plant.B.shape[1])
        if decoupling is None and shape != (1, 1):
            raise PlantError(f"plant {number} is not SISO; give one of its channels")
        words = f"plant {number} has {shape[0]} outputs and {shape[1]} inputs"
        if shape != (out.shape[1], len(into)):
            given = f"the channels' directions have {out.shape[1]} and {len(into)} entries"
            raise PlantError(f"{words}, but {given}; give as many of each")
        one_actuator = len(into) == 1 and shape[0] == len(out)
        if shape[0] > min(shape[1], len(out)) and not one_actuator:
            given = f"for {len(out)} channels"
            raise PlantError(f"{words} {given}; leave some outputs out, or give more channels")
    if decoupling is not None and decoupling.orthogonal:
        plants = [in_channels(plant, decoupling) for plant in plants]
        out = into = np.eye(len(out))
    if not plants:
        raise PlantError("there is no plant in the set; give at least one")
    out, into = (np.ascontiguousarray(M, float) for M in (out, into))
    scaled = [in_units_of(plant, plants[0]) for plant in plants]
    found = _set_of(scaled, sampling, (out, into), alike)
    moved = [plant.mechanics for plant in scaled if plant.mechanics]
    driven = [plant.counted for plant in scaled if plant.counted]
    lever = np.zeros((len(plants), 0, len(scaled[0].C)))
    if driven:
        lever = np.array([_lever(one.C, own.A, len(own.C))
                          for one, own in zip(driven, scaled, strict=True)])  # fmt: skip
        moved, driven = ([_without_bodies(*pair) for pair in zip(part, lever, strict=True)]
                         for part in (moved, driven))  # fmt: skip
    both = (_set_of(part, sampling, (out, into), alike) if part else None
            for part in (moved, driven))  # fmt: skip
    mechanics, counted = both
    return replace(found, mechanics=mechanics, counted=counted, lever=lever)


def _lever(C: Array, A: Array, p: int, *, rounding: float = 1e-12) -> Array:
    """H (z, p) of what counts, the rows of C from p on: H y is moved by free bodies as it is."""
    q = free_chains(A)[:, 0]
    y, z = C[:p, q], C[p:, q]
    return np.asarray(z @ np.linalg.pinv(y, rounding)) if y.any() else np.zeros((len(z), p))


def _without_bodies(plant: ScaledPlant, lever: Array, *, rounding: float = 1e-12) -> ScaledPlant:
    """With N x = z - H y in the place of what counts, z; entries of free bodies that are `rounding`
    of it are 0."""
    p = lever.shape[1]
    C, dC = plant.C.copy(), plant.dC.copy()
    q, size = free_chains(plant.A)[:, 0], np.abs(C[p:]) + np.abs(lever) @ np.abs(C[:p])
    C[p:], dC[:, p:] = C[p:] - lever @ C[:p], dC[:, p:] - lever @ dC[:, :p]
    C[p:, q] = np.where(np.abs(C[p:, q]) <= rounding * size[:, q], 0.0, C[p:, q])
    return replace(plant, C=C, dC=dC)


def _set_of(
    scaled: Sequence[ScaledPlant], sampling: Sampling | None, directions: tuple[Array, Array],
    alike: bool,
) -> PlantSet:  # fmt: skip
    """Plants in one unit, of any inputs and outputs."""
    omega_0, force = scaled[0].omega_0, scaled[0].force
    period = None if sampling is None else sampling.period * omega_0
    delay = 0.0 if sampling is None else sampling.delay * omega_0
    found = tuple(_loop_plant(plant, f"plant {i}", alike) for i, plant in enumerate(scaled, 1))
    poles = pad([one.poles for one in found], -1.0, complex)
    residues = pad([np.einsum("pn,nm->npm", one.reading, one.drive) for one in found],
                      dtype=complex)  # fmt: skip
    for own, one in zip(residues, found, strict=True):
        if len(one.chains):
            own[one.chains[0, 0]] += 1j * one.free_bodies
    return PlantSet(found, omega_0, force, period, delay, poles, residues, *directions)


def pad(parts: Sequence[np.ndarray], fill: float = 0.0, dtype: type = float) -> np.ndarray:
    """Arrays of one rank as one, the smaller ones filled up at their ends."""
    sizes = np.max([part.shape for part in parts], axis=0)
    out = np.full((len(parts), *sizes), fill, dtype)
    for whole, part in zip(out, parts, strict=True):
        whole[tuple(map(slice, part.shape))] = part
    return out


def closed_loops(
    plants: PlantSet, structure: Structure | ChannelStructure, kappa: Array
) -> np.ndarray:
    """Poles (N, P, n) in w of every plant's loop with N controllers κ (N, n_κ); NaN if ill-posed.

    An algebraic loop with det(I + D_K D_G) = 0 has a pole at z = -1: it counts as not stable.
    """
    kappa = np.atleast_2d(kappa)
    a, b, c, d = structure.state_spaces(kappa)
    A, B, C, D = plants.states
    a, d = a[:, None], (plants.into @ d @ plants.out)[:, None]
    b, c = (b @ plants.out)[:, None], (plants.into @ c)[:, None]
    well = np.eye(d.shape[-2]) + d @ D
    posed = np.linalg.det(well) != 0.0
    m = np.linalg.inv(np.where(posed[..., None, None], well, np.eye(d.shape[-2])))
    n, k = A.shape[-1], a.shape[-1]
    joint = np.empty((len(a), len(A), n + k, n + k))
    joint[..., :n, :n] = A - B @ (m @ d) @ C
    joint[..., :n, n:] = B @ (m @ c)
    joint[..., n:, :n] = -b @ (C - D @ (m @ d) @ C)
    joint[..., n:, n:] = a - b @ D @ (m @ c)
    # Complex also where all are real: of such a type the kernels take them.
    return np.where(posed[..., None], np.linalg.eigvals(joint), complex(np.nan))


def all_stable(poles: np.ndarray) -> np.ndarray:
    """Whether all poles (..., n) lie in the open left half plane."""
    with np.errstate(invalid="ignore"):
        return np.asarray((poles.real < 0.0).all(-1))


def _loop_plant(
    plant: ScaledPlant, name: str, trusted: bool, *, at_rest: float = 1e-9, error: float = 1e-7
) -> LoopPlant:
    """A plant by its modes. Poles that are slower than `at_rest` of the fastest are 0 but for
    rounding; the modal response has a relative `error` at most, unless that is `trusted`."""
    plant, chains = _with_bodies_seen(plant)
    rest = np.setdiff1d(np.arange(len(plant.A)), chains)
    poles, V = np.zeros(len(plant.A), complex), np.eye(len(plant.A), dtype=complex)
    poles[rest], V[np.ix_(rest, rest)] = np.linalg.eig(plant.A[np.ix_(rest, rest)])
    resting = len(rest) and int((~plant.A[:, rest].any(axis=0)).sum())  # free bodies that D brakes
    slowest = rest[np.argsort(np.abs(poles[rest]))[:resting]]
    if (np.abs(poles[slowest]) <= at_rest * np.abs(poles).max(initial=0.0)).all():
        poles[slowest] = 0.0
    W = np.linalg.inv(V)
    b, c = W @ plant.B, plant.C @ V
    system = strictly_proper(plant.A, plant.B, plant.C)
    if not trusted:
        s = 1j * np.geomspace(1e-2, 1e2, 7)  # over ω₀
        direct = system.at(s)
        modal = np.einsum("pn,kn,nm->kpm", c, 1.0 / (s[:, None] - poles), b)
        q, v = chains.T
        bodies = (plant.C[:, q] * plant.A[q, v]) @ plant.B[v]
        modal += bodies / s[:, None, None] ** 2
        if np.abs(modal - direct).max() > error * np.abs(direct).max():
            words = "has poles that coincide and are coupled; move a damping ratio away from 1"
            raise PlantError(f"{name} {words}")
    return LoopPlant(
        system, V, W, poles, b, c, W @ plant.dA @ V, W @ plant.dB, plant.dC @ V, chains
    )


def _with_bodies_seen(plant: ScaledPlant) -> tuple[ScaledPlant, np.ndarray]:
    """The plant without free bodies that it neither drives nor measures, and its chains.

    One channel of several sees one motion of all bodies.
    """
    chains = free_chains(plant.A)
    q, v = chains.T
    sizes = np.abs(plant.B).max(), np.abs(plant.C).max()
    if not len(chains) or not all(sizes):
        return plant, chains
    T, back = driven_and_measured(plant.B[v] / sizes[0], plant.C[:, q] / sizes[1])
    count = T.shape[1]
    if count == len(chains):
        return plant, chains
    kept = np.setdiff1d(np.arange(len(plant.A)), chains[count:])
    own, both = np.concatenate([q, v]), np.eye(2)
    into, out = (embed(np.asarray(np.kron(both, M)), own, kept) for M in (T, back.T))
    out = out.T
    A, left = out @ plant.A @ into, np.searchsorted(kept, chains[:count])
    A[left.ravel()] = A[:, left.ravel()] = 0.0  # but for rounding, as these states are free
    A[left[:, 0], left[:, 1]] = plant.A[q[0], v[0]]  # one s for all
    moved = replace(plant, A=A, B=out @ plant.B, C=plant.C @ into,
                    dA=out @ plant.dA @ into, dB=out @ plant.dB, dC=plant.dC @ into)  # fmt: skip
    return moved, left


def free_chains(A: Array) -> np.ndarray:
    """States q, v (k, 2) of free bodies: q̇ = s v alone, v̇ from no state, read by no other."""
    moved = A != 0.0
    v = np.flatnonzero(~moved.any(axis=1) & (moved.sum(axis=0) == 1))
    q = moved[:, v].argmax(axis=0)
    alone = (moved[q].sum(axis=1) == 1) & ~moved[:, q].any(axis=0)
    return np.stack([q[alone], v[alone]], axis=1)
