"""The requirements on the loops of a set, as constraints on logarithms of gains over their bounds.

    S_max   ln|S| - ln S_max                    every local peak
    level   ln|S| + ½ ln 2 - ln x               every local peak on ω <= ω_b, and ω_b itself
    shape   ln|S| + ½ ln 2 - ln(shape x - (shape - 1)/x)    every local peak on ω >= ω_b
    S_low   ln|S(jω_low)| - ln S_low
    KS, T   ln|W_KS KS|, ln|W_T T| - ln weighted_level,   GS   ln|GS| - ln compliance_max

A constraint is c(κ, τ) <= 0 with τ = ln ω_b and x = ω/ω_b; without a shape, or where it ends at
ω_b, the level has no x (`kernels.limits`). Of several channels |M| stands for every singular
value: row number i + kP is the k-th of plant i of P. After those of the whole, p of them, come the
rows that single channels keep within their bounds: uᵀS and wᵀKS, u and w of `ChannelBounds`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds, BrokenAt, ShapeEnd
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.plant_set import PlantSet, pad
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels.loop_point import LoopArrays
from ccd_casadi.kernels.modes import responses
from ccd_casadi.kernels.sections import HALF_POWER, GainOf, Limit, LoopCurve
from ccd_casadi.lti.frequency_grid import root_flanks
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class LoopProblem:
    """The largest bandwidth of a controller on a set of plants within bounds.

    Frequencies are over ω₀ of the plants.

    Attributes
    ----------
    plants, structure, bounds : PlantSet, Structure or ChannelStructure, Bounds
    box : array (2, n)
        Bounds of κ.
    margin : float
        ln: how far inside every bound its searches aim.
    first_tau, per_decade : float, int
        τ = ln(ω_b/ω₀) from which searches start; points of the base grid.
    """

    first_tau: ClassVar[float] = float(np.log(0.1))
    per_decade: ClassVar[int] = 24

    plants: PlantSet
    structure: Structure | ChannelStructure
    bounds: Bounds
    box: Array
    margin: float = 0.0

    def begin(self, kappa: Array) -> float:
        """τ from which a search climbs that starts at κ."""
        return self.first_tau

    @cached_property
    def low(self) -> float:
        """The lowest frequency ω_low over ω₀."""
        return self.bounds.omega_low / self.plants.omega_0

    @cached_property
    def base(self) -> Array:
        """v from far below ω_low and every root to far above, logarithmic; the first is all but
        rest, where gains, or with an integrator |S|/ω, may be largest."""
        sizes = np.abs(self.plants.poles[(self.plants.residues != 0.0).any(axis=(2, 3))])
        sizes = np.append(sizes[sizes > 0.0], 1.0)  # of a free body ω₀
        bottom = 0.03 * min(self.low, float(sizes.min()))
        top = 100.0 * float(sizes.max())
        if self.bounds.weighted_level is not None and self.bounds.weights is not None:
            w = self.bounds.weights  # a K without enough roll-off has its largest W_KS KS there
            top = max(top, 10.0 * max(w.c_K * w.omega_K, w.omega_T / w.A_u) / self.plants.omega_0)
        if self.plants.period is not None:
            top = 100.0 / self.plants.period
        v = np.geomspace(bottom, top, int(self.per_decade * np.log10(top / bottom)))
        return np.append(1e-3 * bottom, v)  # there gains are those at 0 Hz but for 1e-9

    @cached_property
    def fixed(self) -> Array:
        """The base grid and the flanks of every plant's poles and zeros, (P, k)."""
        roots = [np.append(np.linalg.eigvals(G.A), G.zeros()) for G in self.plants.systems]
        found = pad([own[own.imag >= 0.0] for own in roots], np.nan, complex)
        return np.concatenate([np.tile(self.base, (len(found), 1)), add_flanks(found)], axis=1)

    @cached_property
    def answers(self) -> tuple[np.ndarray, np.ndarray]:
        """What the plants answer at `fixed`, to u (P, k, p + z, m) and to disturbing forces."""
        P, v = self.plants, self.fixed
        which = np.repeat(np.arange(P.count), v.shape[1])
        free = P.forced.modes._replace(period=0.0, delay=0.0)
        pairs = ((P.driven.modes, v), (free, P.frequency(v)))
        held, bare = (responses(modes, which, at.ravel())[:, 0] for modes, at in pairs)
        held, bare = (part.reshape(*v.shape, *part.shape[1:]).copy() for part in (held, bare))
        return held, bare

    def __getstate__(self) -> dict[str, object]:
        """Drop what another process computes as fast as it reads it."""
        return {key: value for key, value in vars(self).items() if key != "answers"}

    @cached_property
    def curves(self) -> tuple[LoopCurve, ...]:
        """The curves of which all peaks count."""
        found = [LoopCurve.S_MAX, LoopCurve.LEVEL]
        if self.bounds.shape is not None:
            found.append(LoopCurve.SHAPE)
        if self.bounds.weighted_level is not None:
            found += [LoopCurve.KS, LoopCurve.T]
        if self.bounds.compliance_max is not None:
            found.append(LoopCurve.GS)
        return tuple(found)

    @cached_property
    def short(self) -> np.ndarray:
        """Whether each of the curves is bounded on ω <= ω_b only."""
        ends = self.bounds.shape_ends is ShapeEnd.CROSSING
        return np.isin(self.curves, [LoopCurve.LEVEL, *[LoopCurve.SHAPE] * ends])

    @cached_property
    def late(self) -> np.ndarray:
        """Whether each of the curves is bounded on ω >= ω_b only."""
        return np.isin(self.curves, [LoopCurve.SHAPE] * self.bounds.opens)

    @property
    def first(self) -> int:
        """The number of gains of each matrix that are of the whole; the others are rows of
        channels."""
        return int(self.plants.residues.shape[2])

    @cached_property
    def _factors(self) -> tuple[np.ndarray, np.ndarray]:
        """The factors of K and the channel of every parameter, see `LoopArrays`."""
        structure = self.structure
        factors, channel = [], np.zeros(len(structure.names), np.int64)
        for i, (own, at) in enumerate(zip(structure.structures, structure.slices, strict=True)):
            channel[at] = i
            factors.append(np.insert(own.factors + np.array([0, 0, at.start]), 0, i, axis=1))
        return np.concatenate(factors), channel

    def roots(self, kappa: Array) -> np.ndarray:
        """Zeros and poles of K."""
        return np.concatenate(self.structure.roots(kappa))

    @cached_property
    def resonances(self) -> Array:
        """|p| of the flexible modes of the first plant that the loop sees, the strongest first."""
        p, r = self.plants.poles[0], self.plants.residues[0, :, 0, 0]
        light = (p.imag > 0.0) & (-p.real < 0.2 * np.abs(p))
        strength = np.abs(r) / np.maximum(-p.real, 1e-300)
        order = np.argsort(-strength[light])
        return np.asarray(np.abs(p[light])[order])

    @cached_property
    def antiresonances(self) -> Array:
        """|z| of the light zeros of the first plant, the lightest first."""
        z = self.plants.systems[0].zeros()
        light = z[(z.imag > 0.0) & (np.abs(z.real) < 0.2 * np.abs(z))]
        return np.asarray(np.abs(light)[np.argsort(np.abs(light.real) / np.abs(light))])

    def first_response(self, v: Array) -> np.ndarray:
        """The first entry of the first plant's G (k,) at jv."""
        return self.plants.responses(np.zeros(len(v), int), v)[0][:, 0, 0]

    @cached_property
    def leads(self) -> Array:
        """ln ω_i/ω_b by number."""
        return np.append(np.zeros(self.first), [one.lead for one in self.bounds.channels])

    @cached_property
    def limits(self) -> Array:
        """The limits of the gains without those that depend on ω_b, (Limit.COUNT, numbers); see
        `sections.Limit`."""
        b, w0, force = self.bounds, self.plants.omega_0, self.plants.force
        found = np.zeros((Limit.COUNT, self.first + len(b.channels)))
        found[: len(LoopCurve)] = np.inf
        whole, alone = found[:, : self.first], found[:, self.first :]
        whole[[LoopCurve.S_MAX, LoopCurve.S_LOW]] = np.log([[b.S_max], [b.S_low]])
        whole[[LoopCurve.CROSSING, LoopCurve.LEVEL]] = -HALF_POWER
        found[Limit.LEAST] = 0.0 if self.structure.integrates(b.error) else self.low
        found[Limit.OPENS] = float(b.opens)
        if b.shape is not None:
            whole[LoopCurve.SHAPE] = np.log(b.shape) - HALF_POWER
        if b.compliance_max is not None:
            whole[LoopCurve.GS] = np.log(b.compliance_max * force)
        if b.weights is not None and b.weighted_level is not None:
            w, level = b.weights, np.log(b.weighted_level)
            whole[LoopCurve.KS] = level - np.log(w.c_K / w.M_K * force)
            whole[LoopCurve.T] = level + np.log(w.A_u)
            ends = (w.omega_K, w.c_K * w.omega_K, w.omega_T / w.A_l, w.omega_T / w.A_u)
            found[Limit.KS_ZERO : Limit.BANDWIDTH] = np.array(ends)[:, None] / w0
        for i, one in enumerate(b.channels):
            if one.S_max is not None:
                alone[LoopCurve.S_MAX, i] = np.log(one.S_max)
            if one.M_K is not None and b.weights is not None:
                alone[LoopCurve.KS, i] = whole[LoopCurve.KS, 0] + np.log(one.M_K / b.weights.M_K)
            if one.lead > 0.0:
                for curve in (LoopCurve.CROSSING, LoopCurve.LEVEL, LoopCurve.SHAPE):
                    alone[curve, i] = whole[curve, 0]
        if b.error is not None:  # |S| is that of one sensor, not a norm over sensors
            own = [curve for curve in LoopCurve if curve not in (LoopCurve.S_MAX, LoopCurve.KS)]
            alone[own, b.error] = whole[own, 0]
            force = whole[LoopCurve.KS, 0]  # of all references together
            whole[: len(LoopCurve)] = np.inf
            whole[LoopCurve.KS, 0] = force
        return found

    @cached_property
    def _rows(self) -> Array:
        """uᵀ and wᵀ of the channels in the plants' coordinates, and r, (3, channels, m or p)."""
        channels, into = self.bounds.channels, self.plants.into
        count, width = len(channels), max(len(into), self.first)
        found = np.zeros((3, count, width))
        if self.bounds.error is not None:
            found[0, :-1, : self.first] = self.plants.out
            found[1, :, 0] = 1.0
            for i, one in enumerate(channels[:-1]):
                found[2, i, : self.first] = one.reference
            found[2, -1, 0] = 1.0
            return found
        found[0, :, : self.first] = self.plants.out[:count]
        found[1, :, : len(into)] = np.linalg.inv(into)[:count]
        return found

    @cached_property
    def _kinds(self) -> np.ndarray:
        """Kinds of the channels' own gains, as the kernels have them."""
        kinds = dict(zip(BrokenAt, GainOf, strict=True))
        return np.array([kinds[one.place] for one in self.bounds.channels], np.int64)

    def plants_of(self, constraints: "RowPlaces") -> np.ndarray:
        """The number of the plant that each row is of: several rows of a plant are numbered on."""
        return constraints.plant % self.plants.count

    def gains_of(self, constraints: "Constraints") -> np.ndarray:
        """Return the part of the problem that each row is of, and which gain of a plant's matrix,
        (M, 2)."""
        number = constraints.plant // self.plants.count
        return np.column_stack([np.zeros_like(number), number])

    def kinds_of(self, constraints: "Constraints") -> list[str]:
        """The name of each row's bound; of one that is a channel's own `S_MAX of z`."""
        return [LoopCurve(int(code)).name for code in constraints.curve]

    def inverse_square(self, at: "RowPlaces", tau: float) -> Array:
        """(ω_i/ω)² at rows (M,) of a shape whose room opens from ω_b on; 0 of others."""
        lead = self.leads[at.plant // self.plants.count]
        x = self.plants.frequency(at.v) * np.exp(-tau - lead)
        own = self.bounds.opens & (at.curve == LoopCurve.SHAPE)
        return np.where(own, 1.0 / np.maximum(x, 1.0) ** 2, 0.0)

    def closed_share(self, at: "RowPlaces", tau: float) -> Array:
        """The share of shape ω/ω_i that is not open yet at rows (M,)."""
        return (1.0 - 1.0 / (self.bounds.shape or 1.0)) * self.inverse_square(at, tau)

    def to_tau(self, at: "RowPlaces", tau: float) -> Array:
        """∂c/∂τ of rows at a fixed frequency (M,)."""
        opens, shape = self.bounds.opens, at.curve == LoopCurve.SHAPE
        found = np.where(shape | (opens & (at.curve == LoopCurve.LEVEL)), 1.0, 0.0)
        closed = self.closed_share(at, tau)
        return np.asarray(found + 2.0 * closed / (1.0 - closed))

    def loop(self, kappa: Array, tau: float) -> LoopArrays:
        """Return the arrays that the kernels take at κ and τ."""
        limits = self.limits.copy()
        limits[Limit.BANDWIDTH] = np.exp(tau + self.leads)
        plants = self.plants
        factors, channel = self._factors
        return LoopArrays(factors, np.exp(kappa), channel, plants.into, plants.out,
                          *plants.driven.modes, limits, self._rows, self._kinds,
                          plants.forced.modes[:2], plants.lever)  # fmt: skip


@dataclass(frozen=True)
class Problem(LoopProblem):
    """The problem of one channel.

    Attributes
    ----------
    structure : Structure
    """

    structure: Structure


class Columns:
    """Arrays with a row of each for one thing."""

    def only(self, chosen: np.ndarray | slice) -> Self:
        """Some rows, by mask, index or slice."""
        return type(self)(*(part[chosen] for part in vars(self).values()))

    def and_those(self, *others: Self) -> Self:
        """These rows, then those of others."""
        parts = zip(*(vars(one).values() for one in (self, *others)), strict=True)
        return type(self)(*map(np.concatenate, parts))


@dataclass(frozen=True)
class RowPlaces(Columns):
    """Places of M constraints.

    Attributes
    ----------
    curve, plant : array (M,)
        LoopCurve, and number of the plant.
    v : array (M,)
        Frequency over ω₀.
    """

    curve: np.ndarray
    plant: np.ndarray
    v: Array


@dataclass(frozen=True)
class Constraints(RowPlaces):
    """Constraints c = ln(gain over bound) + margin <= 0 at M places.

    Attributes
    ----------
    value, to_tau : array (M,)
        c, and ∂c/∂τ.
    to_kappa : array (M, n)
        ∂c/∂κ.
    """

    value: Array
    to_kappa: Array
    to_tau: Array


@dataclass(frozen=True)
class Assessment:
    """One controller on all plants.

    Attributes
    ----------
    stable, poles : bool, array (P, n)
        Of every loop, in w.
    peaks : Constraints or None
        Of local peaks, exact; None where a loop is unstable.
    near : RowPlaces or None
        Points of the base grid near a bound, which describe the curves between the peaks: only
        steps from here need their derivatives.
    """

    stable: bool
    poles: np.ndarray
    peaks: Constraints | None
    near: RowPlaces | None

    @property
    def violation(self) -> float:
        """The largest c above 0; infinite for an unstable loop."""
        if self.peaks is None:
            return np.inf
        return max(0.0, float(self.peaks.value.max()))


def add_flanks(values: np.ndarray) -> Array:
    """Frequencies around roots (P, n): the imaginary part with flanks, and the size."""
    return np.concatenate([root_flanks(values), np.abs(values)], axis=1)
