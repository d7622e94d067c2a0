"""Enclosures of S, KS, T and GS over a range of frequencies and a box of uncertain parameters.

With s = y/x, every factor of K and of a mode is a polynomial of x and y, so that frequencies from 0
to infinity are no special case: x = 1, y = jω below a unit, x = 1/ω, y = j above it; sampled
x = cos(ωT/2), y = (2j/T) sin(ωT/2), which is w, and z = e^{jωT}. One pole p of the plant, the
nearest, is multiplied out, the other modes and their conjugates make up R:

    G = R + N/D,   K = U/(y^i P),   d = y^i P D + U (R D + N)
    S = y^i P D/d,   KS = U D/d,   T = U (R D + N)/d,   GS = y^i P (R D + N)/d

so that nothing is singular at a resonance, where L is large and S is not. All are affine forms
(`affine`) of frequency and parameters. D = s - p, N the residue; sampled D = z - e^{pT} and N the
answer of the mode to hold and delay. Where d ≠ 0 on the whole axis for all of a connected set of
plants, no pole crosses it: they are all stable or none is (zero exclusion).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, exponential, inverse, phi, variable
from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.kernels.sections import INTEGRATOR, REAL
from ccd_casadi.lti.hold import INSTANT
from ccd_casadi.support.arrays import Array


class Chart(IntEnum):
    """What the first coordinate of a box is."""

    LOW = 0  # ω over the unit
    HIGH = 1  # the unit over ω
    SAMPLED = 2  # ωT
    POINT = 3  # as LOW or SAMPLED, at ω_low: only S_low counts there


@dataclass(frozen=True)
class Boxes:
    """N boxes: chart (N,), ends (1 + n_p, N) of the frequency coordinate and the parameters."""

    chart: np.ndarray
    low: Array
    high: Array

    def only(self, chosen: np.ndarray) -> "Boxes":
        """Some of them, by mask or index."""
        return Boxes(self.chart[chosen], self.low[:, chosen], self.high[:, chosen])


@dataclass(frozen=True)
class Enclosures:
    """Per bound (M, N): not below the figure over its bound on a box, and not above it somewhere.

    `spread` (1 + n_p, N) says how much each coordinate moves the loop over the box. `bounded`
    where the loop has no pole on the axis and the plant none right of it.
    """

    names: tuple[str, ...]
    highest: Array
    somewhere: Array
    spread: Array
    bounded: np.ndarray


@dataclass(frozen=True)
class LoopFamily:
    """One option's loops with a controller κ over the box of `names`; time in 1/`unit`.

    `plant`, `kappa`, `period` and `delay` in that time, gain in N/m; `bandwidth` in rad/s.
    """

    plant: ModalSum
    names: tuple[str, ...]
    structure: Structure
    kappa: Array
    bounds: Bounds
    bandwidth: float
    unit: float
    period: float | None
    delay: float

    def enclose(self, boxes: Boxes) -> Enclosures:
        """All bounds on all boxes."""
        b = self.bounds
        x, y, s, turn = self._axis(boxes)
        modes, damped = self.plant.poles(self.names, boxes.low[1:], boxes.high[1:])
        factors = [self._factor(p, r, x, y, turn) for p, r in modes]
        risk = [np.abs(D.centre) / (1e-3 * np.abs(D.centre) + D.reach) for D, _ in factors]
        nearest = np.argmin(risk, axis=0)
        D, N = _picked(factors, nearest)
        R = _others(factors, nearest)
        U, P = (part.of(len(boxes.low)) for part in self._controller(x, y))
        open_ = P * y.of(len(boxes.low)) if self.structure.integrator else P
        through = R * D + N
        denominator = open_ * D + U * through
        over = inverse(denominator)
        above = open_ * D
        S = above * over
        point = boxes.chart == Chart.POINT
        inside = np.where(point, np.inf, 1.0)
        low, high = self._omega(boxes)
        below = np.where(~point & (high <= self.bandwidth * (1.0 + 1e-12)), 1.0, np.inf)
        found = [
            ("S_MAX", S, b.S_max * inside),
            ("S_LOW", S, np.where(point, b.S_low, np.inf)),
            ("LEVEL", S, np.sqrt(0.5) * below),
        ]
        if b.shape is not None:
            counts = below if self.shape_ends_early else inside
            counts = np.where(low >= self.corner * (1.0 - 1e-12), np.inf, counts)
            found.append(("SHAPE", *self._risen(S, P * D * over, x, y, low, high, counts)))
        if b.weighted_level is not None and b.weights is not None:
            w, level = b.weights, b.weighted_level * inside
            a, c = (y, x) if self.period is None else (s, 1.0)
            u = self.unit
            W_KS = _weight(a, c, w.omega_K / u, w.c_K * w.omega_K / u).of(len(boxes.low))
            W_T = _weight(a, c, w.omega_T / w.A_l / u, w.omega_T / w.A_u / u).of(len(boxes.low))
            found.append(("KS", U * D * over * W_KS, level * w.M_K / w.c_K))
            found.append(("T", U * through * over * W_T, level * w.A_u))
        if b.compliance_max is not None:
            free = through if self.period is None else self._free(modes, nearest, D, s)
            found.append(("GS", open_ * free * over, b.compliance_max * inside))
        bounded = damped & (denominator.lowest > 0.0)
        highest = np.array([form.highest / limit for _, form, limit in found])
        highest = np.where(bounded & ~np.isnan(highest), highest, np.inf)
        somewhere = np.array([form.at_centre / limit for _, form, limit in found])
        somewhere = np.where(bounded & np.isfinite(somewhere), somewhere, 0.0)
        spread = np.abs(denominator.slope) + np.abs(above.slope)
        return Enclosures(tuple(name for name, _, _ in found), highest, somewhere, spread, bounded)

    def _omega(self, boxes: Boxes) -> tuple[Array, Array]:
        """The ends of ω in rad/s."""
        low, high = boxes.low[0], boxes.high[0]
        if self.period is not None:
            return low / self.period * self.unit, high / self.period * self.unit
        upper = boxes.chart == Chart.HIGH
        with np.errstate(divide="ignore"):
            return np.where(upper, 1.0 / high, low) * self.unit, np.where(
                upper, 1.0 / low, high
            ) * self.unit

    def _axis(self, boxes: Boxes) -> tuple[Affine, Affine, Affine, Affine]:
        """x, y, s and e^{-sT}; the last two count in sampled loops only."""
        f = variable(boxes.low[0], boxes.high[0], 0, 1)
        if self.period is None:
            upper = boxes.chart == Chart.HIGH
            one = Affine(np.ones(len(f.centre)), np.zeros_like(f.slope), np.zeros(len(f.centre)))
            x, y = _either(upper, f, one), _either(upper, one, f) * 1j
            return x, y, y, one
        half = exponential(f * 0.5j)
        back = exponential(f * -0.5j)
        x, y = (half + back) * 0.5, (half - back) * (1.0 / self.period)
        return x, y, f * (1j / self.period), back * back

    def _factor(
        self, p: Affine, residue: Affine, x: Affine, y: Affine, back: Affine
    ) -> tuple[Affine, Affine]:
        """D and N of a pole; both vanish together nowhere."""
        n = len(p.slope)
        if self.period is None:
            return y.of(n) - p * x.of(n), residue * x.of(n)
        T, turn = self.period, back.of(n)
        whole = np.floor(self.delay / T + INSTANT)
        rest = max(self.delay - whole * T, 0.0)
        h = T - rest
        N = phi(p * h) * h
        if rest > 0.0:
            N = N + exponential(p * h) * phi(p * rest) * rest * turn
        for _ in range(int(whole)):
            N = N * turn
        # both times 1/z, of size one on the axis
        return -(exponential(p * T) * turn) + 1.0, residue * N * turn

    def _free(
        self, modes: list[tuple[Affine, Affine]], nearest: np.ndarray, D: Affine, s: Affine
    ) -> Affine:
        """G(s) D of the continuous plant with the D of a sampled one: (1 - e^{(p-s)T})/(s - p)."""
        assert self.period is not None
        s = s.of(len(D.slope))
        p, residue = _picked(modes, nearest)
        own = residue * phi((p - s) * self.period) * self.period
        return _others([(s - q, r) for q, r in modes], nearest) * D + own

    def _controller(self, x: Affine, y: Affine) -> tuple[Affine, Affine]:
        """U and P of K = U/(y^i P)."""
        S, values = self.structure, np.exp(self.kappa)
        above: list[Affine] = []
        below: list[Affine] = []
        for kind, sign, at in S.factors[1:].tolist():
            u = y * (1.0 / values[at])
            if kind == INTEGRATOR:
                part = y + x * values[at]
            else:
                part = x + u if kind == REAL else x * x + x * u * (2.0 * values[at + 1]) + u * u
            (above if sign > 0 else below).append(part)
        one = Affine(np.ones(len(x.centre)), np.zeros_like(x.slope), np.zeros(len(x.centre)))
        U, P = one * values[0], one
        for part in above + [x] * S.roll_off:
            U = U * part
        for part in below:
            P = P * part
        return U, P

    def _risen(
        self,
        S: Affine,
        without: Affine,
        x: Affine,
        y: Affine,
        low: Array,
        high: Array,
        counts: Array,
    ) -> tuple[Affine, Array]:
        """|S| x/y and its limit, shape ω/(√2 ω_b v); |S| and the box's lowest limit where ω counts
        as ω_low, and near half the sampling rate, where x is 0.
        """
        assert self.bounds.shape is not None
        n = len(S.slope)
        v = np.ones(len(low))
        if self.period is not None:  # ω/v, the least of the box
            angle = 0.5 * np.minimum(high, 0.5 * np.pi * self.unit / self.period)
            angle *= self.period / self.unit
            v = np.where(angle > 0.0, angle / np.tan(np.maximum(angle, 1e-300)), 1.0)
        top = self.bounds.shape * np.sqrt(0.5) / self.bandwidth
        late = v < 0.5
        if self.structure.integrator:
            limit = np.where(late, top * low, top * self.unit * v)
            return _either(late, S, without * x.of(n)), limit * counts
        omega_low = self.bounds.omega_low
        level = late | (high <= omega_low * (1.0 + 1e-12))
        rising = S * x.of(n) * inverse(_either(level, x, y)).of(n)
        limit = np.where(level, top * np.maximum(low, omega_low), top * self.unit * v)
        return _either(level, S, rising), limit * counts

    @property
    def shape_ends_early(self) -> bool:
        """Whether the shape counts below ω_b only."""
        return self.bounds.shape_ends is ShapeEnd.CROSSING

    @property
    def corner(self) -> float:
        """The ω in rad/s from which on the shape is above S_max; infinite without a shape."""
        b = self.bounds
        return np.inf if b.shape is None else b.S_max * np.sqrt(2.0) / b.shape * self.bandwidth


def _weight(y: Affine, x: Affine | float, zero: float, pole: float) -> Affine:
    """(s + zero)/(s + pole) at s = y/x."""
    return (y + x * zero) * inverse(y + x * pole)


def _either(chosen: np.ndarray, first: Affine, second: Affine) -> Affine:
    return Affine(np.where(chosen, first.centre, second.centre),
                  np.where(chosen, first.slope, second.slope),
                  np.where(chosen, first.rest, second.rest))  # fmt: skip


def _picked(pairs: list[tuple[Affine, Affine]], which: np.ndarray) -> tuple[Affine, Affine]:
    first, second = pairs[0]
    for i, (a, b) in enumerate(pairs[1:], 1):
        first, second = _either(which == i, a, first), _either(which == i, b, second)
    return first, second


def _others(pairs: list[tuple[Affine, Affine]], which: np.ndarray) -> Affine:
    """Σ N/D without the pair that is picked."""
    m = len(which)
    total = Affine(np.zeros(m), np.zeros_like(pairs[0][0].slope), np.zeros(m))
    for i, (D, N) in enumerate(pairs):
        term = N * inverse(D)
        total = _either(which == i, total, total + term)
    return total
