"""How fast p may change: a bound by a Lyapunov function that moves with p (Desoer 1969).

In a part the sampled loop is x⁺ = A(p) x, with x of the plant as written and of the controller.
V = xᵀP(p)x, P linear between N positions, decays by m per second at every rate |dp/dt| <= r where

    A(p)ᵀP(p') A(p) <= exp(-m T) P(p)      at the positions, for all |p' - p| <= r T.

P is of the modes X of A, P = X⁻ᴴX⁻¹, or solves Stein's equation for A/σ, σ = ρ(A)ˢ, s < 1: (A/σ)ᵀ
P(A/σ) - P = -Q; the kind that allows the highest rate is taken. A handover, x⁺ = E x, multiplies V
by at most μ = λ_max(EᵀP₂E, P₁); a part that is held for ln μ/m before has made up for it. Over
the range, forth and back, a part is held for its way between two handovers over r: the highest r
for which that is long enough is the allowed rate. Who turns back sooner waits for ln μ/m.

A(p) between the positions is not covered, nor are plants off the model, nor forces of p's motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import eigh, solve_discrete_lyapunov

from ccd_casadi.extensions.schedule.handover import (
    controllers_of,
    handovers,
    part_at,
    sampled_plants,
)
from ccd_casadi.extensions.schedule.segments import Segment
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.state_space import closed_loop, state_scales
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class RateBoundOptions:
    """Numbers of the bound.

    Attributes
    ----------
    positions : int
        N of each part.
    shares : tuple of float
        s: decay of A/σ that is left out, over the loop's own.
    halvings : int
        Of the interval of rates.
    """

    positions: int = 101
    shares: tuple[float, ...] = (0.5, 0.8, 0.95)
    halvings: int = 30


@dataclass(frozen=True)
class Decay:
    """V of a part.

    Attributes
    ----------
    loops, P : arrays (N, n, n)
        A and P at the positions.
    fastest : float
        One position each period: no rate above is examined (unit of p per second).
    period : float
        T, s.
    """

    loops: Array
    P: Array
    fastest: float
    period: float

    @cached_property
    def _seen(self) -> tuple[Array, Array, float]:
        """AᵀPA at each position and its change to each neighbour, where P = 1; λ_max at rest."""
        k = np.arange(len(self.P))
        at, to = np.append(k[:-1], k[1:]), np.append(k[1:], k[:-1])
        onto = self.loops[at] @ np.linalg.inv(np.linalg.cholesky(self.P)).mT[at]
        rest, moved = (onto.mT @ P @ onto for P in (self.P[at], self.P[to] - self.P[at]))
        return rest, moved, float(np.linalg.eigvalsh(rest)[:, -1].max())

    def at(self, rate: float) -> float:
        """m, 1/s: V decays by it at least, at every rate up to this one; negative: V may rise."""
        rest, moved, most = self._seen  # λ_max is convex in the rate: its ends are examined
        worst = np.linalg.eigvalsh(rest + rate / self.fastest * moved)[:, -1].max()
        return -float(np.log(max(worst, most))) / self.period


def lyapunov_functions(
    loops: Array, options: RateBoundOptions = RateBoundOptions()
) -> dict[str, Array]:
    """P of each kind at the positions of a part: `modes`, and `decay s` of Stein's equation.

    Parameters
    ----------
    loops : array (N, n, n)
        A(p), each stable, in states of even scales.
    options : RateBoundOptions

    Returns
    -------
    dict of str to array (N, n, n)
    """
    values, X = np.linalg.eig(loops)
    Y = np.linalg.inv(X)
    Y = Y * np.sqrt(np.linalg.norm(X, axis=1) / np.linalg.norm(Y, axis=2))[..., None]
    found = {"modes": (Y.conj().mT @ Y).real}
    for share in options.shares:
        sigma = np.abs(values).max(axis=1) ** share
        found[f"decay {share:g}"] = np.array([
            solve_discrete_lyapunov(A.T / s, np.eye(len(A)))
            for A, s in zip(loops, sigma.tolist(), strict=True)
        ])  # fmt: skip
    return {kind: 0.5 * (P + P.mT) for kind, P in found.items()}


@dataclass(frozen=True)
class Border:
    """A handover at p = `at` from part `first` to part `then`.

    Attributes
    ----------
    first, then : int
        From 0.
    at, way : float
        p there, and how far p has moved in the first part since it took over.
    """

    first: int
    then: int
    at: float
    way: float


def borders(segments: Sequence[Segment]) -> list[Border]:
    """The handovers of the way over the whole range, forth and back."""
    low, high = segments[0].low, segments[-1].high
    now, found = 0, []
    while segments[now].high < high:
        at = segments[now].high
        then = part_at(segments, now, float(np.nextafter(at, np.inf)))
        found.append((now, then, at, at - low))
        now = then
    while segments[now].low > low:
        at = segments[now].low
        then = part_at(segments, now, float(np.nextafter(at, -np.inf)))
        found.append((now, then, at, 2.0 * high - low - at))
        now = then
    moved = np.array([s for *_, s in found])
    ways = np.diff(moved, prepend=moved[-1:] - 2.0 * (high - low))
    return [Border(first, then, at, float(way))
            for (first, then, at, _), way in zip(found, ways, strict=True)]  # fmt: skip


@dataclass(frozen=True)
class RateBound:
    """The allowed rate of p.

    Attributes
    ----------
    rate : float
        r, unit of p per second; 0: none.
    kind, positions : str, int
        Of P; N.
    part : int
        That sets it, from 0.
    at : float or None
        The handover that sets it; None: V stops falling inside the part.
    waits : tuple of float
        ln μ/m of each part at this rate, s: from one handover to the next at least.
    """

    rate: float
    kind: str
    positions: int
    part: int
    at: float | None
    waits: tuple[float, ...]


def rate_bound(
    loops: Sequence[Array], E: Array, segments: Sequence[Segment], period: float,
    options: RateBoundOptions = RateBoundOptions(),
) -> RateBound:  # fmt: skip
    """The highest rate of p at which V falls over the range, forth and back.

    Parameters
    ----------
    loops : sequence of array (N, n, n)
        A of each part at positions evenly from its low to its high end.
    E : array (parts, parts, n, n)
        x of the second part from x of the first.
    segments : sequence of Segment
    period : float
        T, s.
    options : RateBoundOptions

    Returns
    -------
    RateBound
        The best of the kinds of P.
    """
    way = borders(segments)
    steps = [(one.high - one.low) / (len(A) - 1) / period
             for one, A in zip(segments, loops, strict=True)]  # fmt: skip
    every = [lyapunov_functions(A, options) for A in loops]
    found = []
    for kind in every[0]:
        decays = [Decay(A, own[kind], step, period)
                  for A, own, step in zip(loops, every, steps, strict=True)]  # fmt: skip
        found.append(_highest(decays, way, _jumps(decays, way, E, segments), kind, options))
    return max(found, key=lambda one: one.rate)


def _jumps(
    decays: Sequence[Decay], way: Sequence[Border], E: Array, segments: Sequence[Segment]
) -> Array:
    """ln μ of each border, P scaled so that it is alike for both directions."""
    found, rows = [], np.zeros((len(way), len(decays)))
    for row, border in zip(rows, way, strict=True):
        first, then = border.first, border.then
        row[first], row[then] = -1.0, 1.0
        before = decays[first].P[-1 if border.at == segments[first].high else 0]
        own, P, onto = segments[then], decays[then].P, E[first, then]
        k = (border.at - own.low) / (own.high - own.low) * (len(P) - 1)
        found.append(max(
            eigh(onto.T @ after @ onto, before, eigvals_only=True)[-1]
            for after in P[int(k) : int(k) + 2]
        ))  # fmt: skip
    jumps = np.log(np.maximum(found, 1e-300))
    # of all scales the mean square of ln mu is least: alike to both sides where there are two
    return jumps - rows @ np.linalg.lstsq(rows, jumps)[0]


def _highest(
    decays: Sequence[Decay], way: Sequence[Border], jumps: Array, kind: str,
    options: RateBoundOptions,
) -> RateBound:  # fmt: skip
    def fails(rate: float) -> tuple[int, float | None] | None:
        falls = [decay.at(rate) for decay in decays]
        if min(falls) <= 0.0:
            return int(np.argmin(falls)), None
        late = [rate * jump - falls[border.first] * border.way
                for border, jump in zip(way, jumps.tolist(), strict=True)]  # fmt: skip
        k = int(np.argmax([0.0, *late]))
        return (way[k - 1].first, way[k - 1].at) if k else None

    low, high = 0.0, min(decay.fastest for decay in decays)
    part, at = int(np.argmin([decay.fastest for decay in decays])), None
    for _ in range(options.halvings):
        rate = 0.5 * (low + high)
        failed = fails(rate)
        if failed is None:
            low = rate
        else:
            high, (part, at) = rate, failed
    waits = np.zeros(len(decays))
    for border, jump in zip(way, jumps.tolist(), strict=True):
        waits[border.first] = max(waits[border.first], jump / decays[border.first].at(low))
    return RateBound(low, kind, len(decays[0].P), part, at, tuple(waits.tolist()))


def rate_bound_of(
    problem: CoDesignProblem, theta: Sequence[float], name: str, segments: Sequence[Segment],
    options: RateBoundOptions = RateBoundOptions(),
) -> RateBound:  # fmt: skip
    """`rate_bound` of a schedule, for the model, in states of even scales."""
    sampling = structured_of(problem).sampling
    assert sampling is not None
    K, loops, scales = controllers_of(segments, sampling), [], np.empty(0)
    for one, own in zip(segments, K, strict=True):
        places = np.linspace(one.low, one.high, options.positions).tolist()
        closed = [closed_loop(G, own) for G in sampled_plants(problem, theta, name, places)]
        if not len(scales):
            scales = state_scales(closed[0].A, closed[0].B_d, closed[0].C_y)
        loops.append(np.array([loop.A for loop in closed]) * scales / scales[:, None])
    onwards = handovers(K)
    E = np.broadcast_to(np.eye(len(scales)), (len(K), len(K), len(scales), len(scales))).copy()
    E[..., -onwards.shape[-1] :, -onwards.shape[-1] :] = onwards
    return rate_bound(loops, E * scales / scales[:, None], segments, sampling.period, options)
