"""The problem of a controller on measured lines: the same constraints as on models, without one.

Each line is a plant of its own: one mode whose response at that line is the one that was measured.
The rows, their slopes and their curvature are so those of every other set (`kernels.loop_rows`), at
frequencies that do not move. ω_b lies between two lines,
where ln σ(S) is a straight line over ln v. Stability is the winding of det(I + GK). Where a
response has a spread, S is that of all plants within it (`measured_loop`): ln σ(S) - ln ρ.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from ccd_casadi.extensions.measured.measured_loop import winding
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.figures import assess, constraints, hessians
from ccd_casadi.fixed_structure.loop_problem import (
    Assessment,
    Constraints,
    LoopCurve,
    LoopProblem,
    RowPlaces,
)
from ccd_casadi.fixed_structure.plant_set import PlantSet
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels import modes
from ccd_casadi.kernels.loop_grid import NONE, second
from ccd_casadi.kernels.loop_point import LoopArrays, levels, rows
from ccd_casadi.kernels.sections import Limit
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class LinePlants(PlantSet):
    """The lines as plants, each of one pole and its conjugate; `omega` (N,) over ω₀.

    A sampled loop sees what was measured, and a disturbing force is taken to see the same: with
    z = α + βs at a line and its conjugate, f = β/(z - α - βp) is 1/(s - p) there.
    """

    omega: Array = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def modes(self) -> modes.Plants:
        """The modes in the form of the kernels."""
        p, r = self.poles, self.residues
        residues = np.stack([r.real, r.imag], axis=2)
        if self.period is None:
            return modes.Plants(np.stack([p] * 4, axis=-1), residues, 0.0, 0.0)
        turn = (self.omega * self.period)[:, None]
        slope = np.sin(turn) / self.omega[:, None]
        grown = np.cos(turn) + slope * p
        terms = np.stack([p, slope.astype(complex), np.zeros_like(p), grown], axis=-1)
        return modes.Plants(terms, residues, self.period, 0.0)


@dataclass(frozen=True)
class LineProblem(LoopProblem):
    """`responses` as they were measured; `starts`: index of the first line of each, and the end.

    `effort` bounds |KS| by that many times 1/|G| about ω_b. `unsure` (lines,): ‖Δ‖ of the spread in
    the unit of G. The last plants of the set are the responses at ω_low, one each.
    """

    responses: tuple[MeasuredResponse, ...] = ()
    v: Array = field(default_factory=lambda: np.zeros(0))
    starts: tuple[int, ...] = ()
    effort: float | None = None
    unsure: Array = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def spreads(self) -> bool:
        """Whether any line has a spread."""
        return bool(self.unsure.any())

    def _loop_of_KS(self, kappa: Array, tau: float) -> LoopArrays:
        """The loop with |KS| held against 1."""
        loop = super().loop(kappa, tau)
        loop.limits[[LoopCurve.KS, Limit.KS_ZERO, Limit.KS_POLE]] = 0.0
        return loop

    def losses(self, kappa: Array, tau: float) -> Array:
        """-ln ρ of every line."""
        lines = len(self.unsure)
        if not self.spreads:
            return np.zeros(lines)
        codes = np.full((lines, 1), LoopCurve.KS, np.int64)
        size = levels(codes, np.arange(lines), self.v[:lines, None],
                      self._loop_of_KS(kappa, tau), -np.inf, NONE)[:, 0, 0, 0]  # fmt: skip
        return self._lost(np.exp(size) * self.unsure)[0]

    def losses_at(self, kappa: Array, tau: float, lines: np.ndarray) -> tuple[Array, np.ndarray]:
        """-ln ρ of some lines (M,), and their derivatives to κ (M, n)."""
        value = np.zeros(len(lines))
        to_kappa = np.zeros((len(lines), len(kappa)))
        unsure = np.append(self.unsure, np.zeros(self.plants.count - len(self.unsure)))[lines]
        known = unsure > 0.0
        if known.any():
            at = lines[known]
            code = np.full(len(at), LoopCurve.KS)
            size, _, slopes, *_ = rows(code, np.zeros(len(at), np.int64), at, self.v[at],
                                       self._loop_of_KS(kappa, tau))  # fmt: skip
            share = np.exp(size) * unsure[known]
            value[known], rate = self._lost(share)
            to_kappa[known] = (rate * share)[:, None] * slopes
        return value, to_kappa

    def _lost(self, share: Array, *, least: float = 0.05) -> tuple[Array, Array]:
        """-ln ρ with ρ = 1 - share, and its slope to the share; straight for ρ below `least`, as a
        start may have plants that reach -1."""
        room = 1.0 - share
        held = np.maximum(room, least)
        return -np.log(held) + (held - room) / held, 1.0 / held

    @cached_property
    def curves(self) -> tuple[LoopCurve, ...]:
        """KS too where the effort is bounded."""
        found = super().curves
        return found if self.effort is None or LoopCurve.KS in found else (*found, LoopCurve.KS)

    def loop(self, kappa: Array, tau: float) -> LoopArrays:
        """Return the loop with the bound of |KS| at this ω_b."""
        loop = super().loop(kappa, tau)
        loop.limits[LoopCurve.KS, : self.first] = np.minimum(
            loop.limits[LoopCurve.KS, : self.first], self.ceiling(tau)[0]
        )
        return loop

    def ceiling(self, tau: float, *, step: float = 1e-5) -> tuple[float, float]:
        """ln of effort times the mean of 1/σ_min(G) over the two octaves about ω_b, of the response
        where that is largest, and its slope to τ by differences; infinite without an effort."""
        if self.effort is None:
            return np.inf, 0.0
        octaves = np.log(2.0) * np.linspace(-1.0, 1.0, 33)
        places = tau + np.array([[0.0], [-step], [step]]) + octaves
        means = [np.interp(places, x, y).mean(axis=1) for x, y in self._inverses]
        value, before, after = max(means, key=lambda mean: float(mean[0]))
        return float(np.log(self.effort) + value), float(after - before) / (2.0 * step)

    @cached_property
    def _inverses(self) -> list[tuple[Array, Array]]:
        """ln ω/ω₀ and ln 1/σ_min(G) of every response."""
        return [(np.log(HZ * one.followed.hz / self.plants.omega_0),
                 -np.log(self.plants.force * np.linalg.norm(one.followed.G, -2, axis=(1, 2))))
                for one in self.responses]  # fmt: skip

    @cached_property
    def base(self) -> Array:
        """The lines of the first response."""
        return self.v[: self.starts[1]]

    def begin(self, kappa: Array) -> float:
        """Half the first crossover of the first response's first entry, ω₀/10 at most."""
        measured, L = next(self._open(kappa))
        measured = measured.followed
        beyond = HZ * measured.hz[np.argmax(np.abs(L[:, 0, 0]) < 1.0)] / self.plants.omega_0
        return float(np.clip(np.log(0.5 * beyond), np.log(2.0 * self.base[0]), self.first_tau))

    def stable(self, kappa: Array) -> bool:
        """Whether the winding on every response is that of a stable loop."""
        integrators = int(self.structure.integrator)
        return all(winding(measured, L, integrators)[0] == 0 for measured, L in self._open(kappa))

    def _open(self, kappa: Array) -> Iterator[tuple[MeasuredResponse, np.ndarray]]:
        """L on the followed lines of every response."""
        plants, parts = self.plants, [*self.structure.split(kappa)]
        for measured in self.responses:
            whole = measured.followed
            s = 1j * plants.variable(HZ * whole.hz / plants.omega_0)
            k = np.stack([own.response(part, s) for own, part in parts], axis=-1)
            yield measured, plants.force * whole.G @ (plants.into * k[:, None, :]) @ plants.out

    @cached_property
    def resonances(self) -> Array:
        """v at the peaks of the first response, the strongest first."""
        return self.base[self.responses[0].resonances]

    @cached_property
    def antiresonances(self) -> Array:
        """v at the dips of the first response, the deepest first."""
        return self.base[self.responses[0].antiresonances]

    def first_response(self, v: Array) -> np.ndarray:
        """G (k,) of the first response's first entry, at the lines next to v."""
        at = np.clip(np.searchsorted(self.base, v), 0, len(self.base) - 1)
        return self.plants.responses(at, self.base[at])[0][:, 0, 0]


def line_problem(
    responses: Sequence[MeasuredResponse],
    structure: Structure | ChannelStructure,
    bounds: Bounds,
    period: float | None = None,
    margin: float = 0.0,
    effort: float | None = None,
) -> LineProblem:
    """The problem on all lines; `period` (s) as in `measured_loop.judge`."""
    hz = [one.hz for one in responses]
    low = bounds.omega_low / HZ
    every = np.concatenate([*hz, np.full(len(hz), low)])
    G = np.concatenate([one.matrix for one in responses] + [one.at(low)[None] for one in responses])
    size = np.linalg.norm(G, axis=(1, 2))
    # Searches start from ω_b = 0.1 ω₀: inside the lines.
    omega_0 = HZ * max(0.3 * min(one[-1] for one in hz), 12.0 * max(one[0] for one in hz))
    force = 1.0 / float(np.exp(np.log(size).mean()))
    omega, T = HZ * every / omega_0, None if period is None else period * omega_0
    U, V = structure.directions
    out, into = (np.ascontiguousarray(M, float) for M in (U.T, V))
    poles, residues = _modes(omega, force * G, T)
    plants = LinePlants((), omega_0, force, T, 0.0, poles, residues, out, into, omega=omega)
    fastest = 3.0 * HZ * max(one[-1] for one in hz) / omega_0
    if plants.period is not None:
        fastest = min(fastest, 2.0 / plants.period)
    slowest = 0.1 * HZ * min(one[0] for one in hz) / omega_0
    gains = (1e-3 / (force * float(size.max())), 1e3 / (force * float(size.min())))
    box = structure.bounds((slowest, fastest), gains, omega_0)
    v = plants.variable(omega)
    starts = (0, *np.cumsum([len(one) for one in hz]).tolist())
    unsure = force * np.concatenate([one.unsure for one in responses])
    return LineProblem(plants, structure, bounds, box, margin, tuple(responses), v, starts,
                       effort, unsure)  # fmt: skip


def _modes(omega: Array, G: np.ndarray, period: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Pole and residue of each line with G (N, p, m) there: Re r and Im r solve G = r f + r̄ f̃."""
    count, p, m = G.shape
    # below |p|T = 0.01 digits of z - e^{pT} are lost
    pole = (-1.0 + 1.0j) * np.maximum(omega, 0.0 if period is None else 0.01 / period)
    f, other = 1.0 / (1j * omega - pole), 1.0 / (1j * omega - pole.conj())
    both, apart = f + other, 1j * (f - other)
    basis = np.array([[both.real, apart.real], [both.imag, apart.imag]]).transpose(2, 0, 1)
    parts = np.linalg.solve(basis, np.stack([G.real, G.imag], axis=1).reshape(count, 2, p * m))
    return pole[:, None], (parts[:, 0] + 1j * parts[:, 1]).reshape(count, 1, p, m)


WITHOUT_S = (LoopCurve.KS, LoopCurve.T, LoopCurve.GS)
_of_loops = constraints.dispatch(LoopProblem)


@constraints.register
def _(problem: LineProblem, kappa: Array, tau: float, at: RowPlaces) -> Constraints:
    """Rows of S with -ln ρ of their lines."""
    found = _of_loops(problem, kappa, tau, at)
    if problem.spreads:
        own = np.flatnonzero(~np.isin(at.curve, WITHOUT_S))
        lost, slopes = problem.losses_at(kappa, tau, problem.plants_of(at)[own])
        found.value[own] += lost
        found.to_kappa[own] += slopes
    return found


@assess.register
def _(
    problem: LineProblem,
    kappa: Array,
    tau: float,
    *,
    depth: float | None = None,
    each: bool = False,
    relevant: float = -1.0,
) -> Assessment:
    """Every line whose ln of a gain over its bound is above `relevant`, the two next to ω_b, and
    |S| at ω_low."""
    plants, starts, P = problem.plants, problem.starts, problem.plants.count
    v, lines = problem.v, problem.starts[-1]
    crossing = plants.variable(np.exp(tau + problem.leads))
    inside = all(v[a] < crossing.min() and crossing.max() < v[b - 1]
                 for a, b in pairwise(starts))  # fmt: skip
    if not inside or not problem.stable(kappa):
        return Assessment(False, np.zeros(0), None, None)
    loop = problem.loop(kappa, tau)
    codes = np.array(problem.curves, np.int64)
    every = np.arange(lines)
    value = levels(np.tile(codes, (lines, 1)), every, v[:lines, None], loop, relevant, NONE)[:, 0]
    beyond = v[:lines, None, None] > crossing
    idle = np.where(beyond, problem.short[:, None], problem.late[:, None])
    value = value + ~np.isin(codes, WITHOUT_S)[:, None] * problem.losses(kappa, tau)[:, None, None]
    value = np.where(idle, -np.inf, value)
    i, c, k = np.nonzero(value > relevant)
    at_low = np.flatnonzero(np.isfinite(problem.limits[LoopCurve.S_LOW]))
    low = (at_low[:, None] * P + np.arange(lines, P)).ravel()
    curve = np.concatenate([codes[c], np.full(len(low), LoopCurve.S_LOW)])
    row = np.concatenate([i + k * P, low])
    found = constraints(problem, kappa, tau, RowPlaces(curve, row, v[row % P]))
    found.to_tau[curve == LoopCurve.KS] = -problem.ceiling(tau)[1]
    none = np.zeros(0, np.int64)
    peaks = found.and_those(_ends(problem, kappa, tau, loop, crossing))
    return Assessment(True, np.zeros(0), peaks, RowPlaces(none, none, np.zeros(0)))


def _ends(
    problem: LineProblem, kappa: Array, tau: float, loop: object, crossing: Array
) -> Constraints:
    """ln|S(jω_b)| + ½ ln 2 of every response and number."""
    P, v, found = problem.plants.count, problem.v, []
    numbers = np.flatnonzero(np.isfinite(problem.limits[LoopCurve.CROSSING]))
    for number in numbers:
        place = crossing[number]
        for a, b in pairwise(problem.starts):
            i = a + int(np.clip(np.searchsorted(v[a:b], place), 1, b - a - 1))
            which, at = np.array([i - 1, i]), v[[i - 1, i]]
            code = np.full(2, LoopCurve.CROSSING)
            value, _, to_kappa, *_ = rows(code, np.full(2, number), which, at, loop)
            if problem.spreads:
                lost, slopes = problem.losses_at(kappa, tau, which)
                value, to_kappa = value + lost, to_kappa + slopes
            width = np.log(at[1] / at[0])
            share = np.log(place / at[0]) / width
            mean = np.array([1.0 - share, share])
            slope = (value[1] - value[0]) / width / problem.plants.chain(np.array(place))
            level = mean @ value + problem.margin
            found.append((code[0], number * P + i, at[1], level, mean @ to_kappa, slope))
    return Constraints(*map(np.array, zip(*found, strict=True)))


@hessians.register
def _(problem: LineProblem, kappa: Array, tau: float, constraints: Constraints) -> Array:
    """Compute the Hessians at fixed lines."""
    n = len(kappa)
    out = np.zeros((len(constraints.v), n + 1, n + 1))
    number, i = np.divmod(constraints.plant, problem.plants.count)
    loop = problem.loop(kappa, tau)
    out[:, :n, :n] = second(constraints.curve, number, i, constraints.v, loop)
    return out
