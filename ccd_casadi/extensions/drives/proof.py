"""A proof that a rounded cascade keeps its bounds on a whole box of plants, by branch and bound.

With K_j = P_j/(Q(1 - 1/z)), Q without the integrator, and the plant by `SampledModel`,

    Δ = D Q(1 - 1/z) + z⁻ᵈ Σ_j N_j P_j,   S_u = D Q(1 - 1/z)/Δ,   S_i = 1 - z⁻ᵈ N_i P_i/Δ

are fractions of polynomials in z and w, finite everywhere: at 0 Hz, too, where free bodies and the
integrator are infinite. Where Δ has no zero on the circle for a connected set of plants, of which
one is stable, all are.

The sampled plant is in polynomials of its uncertain parameters, whose error is bounded. With
w = (z - 1)/T and the hold and delay of the loop, modes M q̈ + D q̇ + K q = B f have

    G_j(z) = z⁻ᵈ (N_j(w) + N'_j(w)/z)/D(w),   D(w) = det(w - (e^{AT} - 1)/T)

of coefficients that are entire functions of the uncertain parameters: damping may couple the modes,
and brake a free body. On a box they are interpolated at Chebyshev points. On the ellipse with foci
±1 and half axes' sum ρ norms bound them by M, so that interpolation of degree m in one parameter
is off by less than 4Mρ⁻ᵐ/(ρ - 1) (Trefethen 2013, theorem 8.2); parameters are interpolated one
after the other, each adding that much times the Lebesgue constants of those before it.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import comb

import numpy as np
from scipy.linalg import expm

from ccd_casadi.extensions.drives.cascade import Cascade, Polynomials
from ccd_casadi.fixed_structure.affine import Affine, exponential, inverse, variable
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import BoxProofOptions, Proof, ProofOutcome, divide
from ccd_casadi.fixed_structure.boxes import Boxes
from ccd_casadi.fixed_structure.enclosure import Enclosures, LoopFamily
from ccd_casadi.fixed_structure.uncertainty import ModalSum, UncertainPlant
from ccd_casadi.lti.loop import Loop, Sampling, delay_parts
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class ModelOptions:
    """Numbers of the interpolation."""

    degree: int = 10  # m of each parameter
    ellipse: float = 16.0  # ρ
    lebesgue: float = 2.6  # not below the constant of m + 1 Chebyshev points (2/π ln(m + 1) + 1)
    dropped: float = 1e-12  # relative: terms below it count as part of the error
    rounding: float = 1e-12  # over the largest value: what a coefficient loses in double precision
    most_parameters: int = 3  # more are not interpolated
    alike: float = 1e-8  # relative: by how much responses may differ from the plant's own


@dataclass(frozen=True)
class SampledModel:
    """One option of an uncertain plant, time in 1/`unit`."""

    uncertain: UncertainPlant
    option: int
    sampling: Sampling
    unit: float  # rad/s
    options: ModelOptions = field(default_factory=ModelOptions)

    @cached_property
    def period(self) -> float:
        """The period T in 1/unit."""
        return self.sampling.period * self.unit

    @property
    def delay(self) -> tuple[int, float]:
        """Whole periods d, and the rest in 1/unit."""
        return delay_parts(self.period, self.sampling.delay * self.unit)

    def _matrices(self, values: Array, size: bool = False) -> tuple[Array, Array, Array]:
        """A, B and C at values of the parameters; `size`: not below their entries' sizes for
        parameters of these sizes."""
        modal, system = self.uncertain.modal(self.option), self.uncertain.options[self.option]
        system.with_mass("[drive]")
        p = dict(zip(self.uncertain.names, values.tolist(), strict=True))
        n, one = len(modal.K), 1.0
        r, number = np.ones(n), {at: i + 1 for i, at in enumerate(modal.numbered)}
        for i in range(n):
            if not modal.rigid[i]:
                own = p.get(f"mode_shift {number[i]}", 0.0)
                r[i] = (one + p.get("resonance_shift", 0.0)) * (one + own)
        K = modal.K * r[:, None] * r
        shifted = np.diag(2.0 * float(system.damping_ratio or 0.0) * modal.natural)
        D = modal.D - shifted + shifted * r
        D = D * p.get("damping", 1.0)
        B = modal.B * (one + p.get("gain", 0.0))
        if size:
            given = np.abs(modal.D - shifted) + np.abs(shifted) * r
            D = given * max(1.0, p.get("damping", 1.0))
            K, B = np.abs(K), np.abs(B)
        zero, eye = np.zeros((n, n)), np.eye(n)
        sign = 1.0 if size else -1.0
        A = np.block([[zero, eye], [sign * K / self.unit**2, sign * D / self.unit]])
        C = np.hstack([modal.C, np.zeros_like(modal.C)])
        return A, np.vstack([0.0 * B, B / self.unit**2]), C

    @property
    def faithful(self) -> bool:
        """Whether this is the plant that is designed for, at corners of its box."""
        if not self.applies:
            return False
        s = 1j * self.unit * np.geomspace(1e-3, 1.0, 7)
        for values in (self.uncertain.nominal, *self.uncertain.box):
            A, B, C = self._matrices(values)
            own = StateSpace(A, B, C, np.zeros((len(C), 1))).at(s / self.unit)
            given = self.uncertain.plant(values, self.option).plant_si().at(s)
            # an absolute measure per frequency: of all sensors the largest
            off = np.abs(own - given).max(axis=(1, 2)) / np.abs(given).max(axis=(1, 2))
            if not off.max() <= self.options.alike:
                return False
        return True

    @property
    def applies(self) -> bool:
        """Whether its parameters are few, and those that are known here; of one input."""
        names, system = self.uncertain.names, self.uncertain.options[self.option]
        if len(names) > self.options.most_parameters or self.uncertain.ranges:
            return False
        wired = system.wiring.poles(len(system.C), system.B.shape[1])
        return system.B.shape[1] == 1 and wired is not None and not len(wired)

    def values(self, at: Array) -> Array:
        """Coefficients (1 + 2p, n + 1): of D, then of N and N' of each sensor, of wⁿ first."""
        A, B, C = self._matrices(at)
        n, T, rest = len(A), self.period, self.delay[1]
        joint = np.zeros((n + 1, n + 1))
        joint[:n, :n], joint[:n, n:] = A, B
        late, early = expm(joint * (T - rest))[:n], expm(joint * rest)[:n]
        # e^{AT} - 1 without the loss of the difference: T times the integral of e^{At}, times A
        square = np.zeros((2 * n, 2 * n))
        square[:n, :n], square[:n, n:] = A, np.eye(n)
        step = A @ expm(square * T)[:n, n:] / T
        gains = np.hstack([late[:, n:], late[:, :n] @ early[:, n:]]) / T
        found = np.zeros((1 + 2 * len(C), n + 1))
        found[0, 0], adjoint = 1.0, np.eye(n)
        for k in range(1, n + 1):
            found[1:, k] = (C @ adjoint @ gains).T.ravel()
            moved = step @ adjoint
            found[0, k] = -np.trace(moved) / k
            adjoint = moved + found[0, k] * np.eye(n)
        return found

    def _largest(self) -> Array:
        """M of every coefficient: not below its size anywhere on the ellipses."""
        low, high = self.uncertain.box
        wide = 0.5 * (self.options.ellipse + 1.0 / self.options.ellipse)
        A, B, C = self._matrices(np.abs(low + high) / 2.0 + (high - low) / 2.0 * wide, size=True)
        n, T = len(A), self.period
        grown = np.exp(np.linalg.norm(A, 2) * T)
        step = np.expm1(np.linalg.norm(A, 2) * T) / T
        gain = grown * float(np.linalg.norm(B)) * grown
        found = np.zeros((1 + 2 * len(C), n + 1))
        found[0] = [comb(n, k) * step**k for k in range(n + 1)]
        rows = np.tile(np.linalg.norm(C, axis=1), 2)
        for k in range(1, n + 1):
            adjoint = sum(found[0, j] * step ** (k - 1 - j) for j in range(k))
            found[1:, k] = rows * adjoint * gain
        return found

    @cached_property
    def polynomials(self) -> tuple[Array, Array]:
        """Coefficients' own (m + 1, ..., 1 + 2p, n + 1) in powers of t, the parameters over their
        half widths about the middle, and bounds (1 + 2p, n + 1) of the error."""
        o, (low, high) = self.options, self.uncertain.box
        m, count = o.degree, len(low)
        t = np.cos(np.pi * (np.arange(m + 1) + 0.5) / (m + 1))
        centre, half = 0.5 * (low + high), 0.5 * (high - low)
        nodes = itertools.product(t, repeat=count)
        found = np.array([self.values(centre + half * np.array(node)) for node in nodes])
        size = np.abs(found).max(axis=0)
        found = found.reshape((m + 1,) * count + found.shape[1:])
        inverse = np.linalg.inv(np.vander(t, increasing=True))
        for axis in range(count):
            found = np.moveaxis(np.tensordot(inverse, found, (1, axis)), 0, axis)
        one = 4.0 * self._largest() * o.ellipse**-m / (o.ellipse - 1.0)
        error = sum(one * o.lebesgue**i for i in range(count)) + o.rounding * size
        small = np.abs(found) < o.dropped * size
        error = error + np.where(small, np.abs(found), 0.0).sum(axis=tuple(range(count)))
        return np.where(small, 0.0, found), np.asarray(error)

    def over(self, t: list[Affine], like: Affine) -> list[list[Affine]]:
        """Every coefficient over boxes of t, as forms of the variables of `like`."""
        powers, error = self.polynomials
        zero = Affine(0.0 * like.centre, 0.0 * like.slope, 0.0 * like.rest)
        return [[_form(powers[..., i, k], float(error[i, k]), t, zero)
                 for k in range(error.shape[1])] for i in range(len(error))]  # fmt: skip


def _form(powers: Array, error: float, t: list[Affine], zero: Affine) -> Affine:
    """A polynomial of several t by Horner's rule, one parameter after the other."""

    def of(c: Array, left: list[Affine]) -> Affine:
        if not left:
            return zero + complex(c)
        last = max((i for i in range(len(c)) if c[i].any()), default=0)
        found = of(c[last], left[1:])
        for i in range(last - 1, -1, -1):
            found = found * left[0] + of(c[i], left[1:])
        return found

    found = of(powers, t)
    return Affine(found.centre, found.slope, found.rest + error)


@dataclass(frozen=True, kw_only=True)
class CascadeFamily(LoopFamily):
    """One option's loops with one cascade; `sensors` are those of position and velocity."""

    model: SampledModel
    controller: Polynomials
    sensors: tuple[int, int]

    @property
    def _integrator(self) -> bool:
        return True

    def enclose(self, boxes: Boxes) -> Enclosures:
        """Enclose every |S| over its bound on every box, as `LoopFamily.enclose` does."""
        n = len(boxes.low)
        f = variable(boxes.low[0], boxes.high[0], 0, n)
        turn, forward = exponential(f * -1j), exponential(f * 1j)
        assert self.period is not None
        w = (forward - 1.0) * (1.0 / self.period)
        away = turn * -1.0 + 1.0
        box, t = self.model.uncertain.box, []
        for k, (low, high) in enumerate(box.T):
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            t.append(variable((boxes.low[k + 1] - middle) / half,
                              (boxes.high[k + 1] - middle) / half, k + 1, n))  # fmt: skip
        coefficients = self.model.over(t, w)
        D, *N = [_horner(row, w) for row in coefficients]
        count = len(N) // 2
        late = turn
        for _ in range(self.model.delay[0] - 1):
            late = late * turn
        if not self.model.delay[0]:
            late = turn * 0.0 + 1.0
        seen = [late * (N[j] + N[count + j] * turn) for j in range(count)]
        P, M, Q = (_product(factors, turn) for factors in self.controller)
        position, velocity = self.sensors
        below = D * Q
        own, other = seen[position] * P, seen[velocity] * M
        # everything over 1 - 1/z but the position's path, which is not zero at 0 Hz
        delta = (below + other) * away + own
        over = inverse(delta)
        error = below if position == velocity else below + other
        S, at_actuator = error * away * over, below * away * over
        found = self._of_S(boxes, (S.size, S.lowest), self.period * (error * over).size)
        inside, figures = self._inside(boxes), {position: S}
        if position != velocity:
            figures[velocity] = (below * away + own) * over
        for number, channel in enumerate(self.bounds.channels):
            figure = figures.get(number, at_actuator)
            limit = (channel.S_max or self.bounds.S_max) * inside
            found.append((f"S_MAX of {channel.name}", figure.size / limit, figure.lowest / limit))
        names, most, least = zip(*found, strict=True)
        good = np.isfinite(over.rest)
        highest = np.where(good & ~np.isnan(most), most, np.inf)
        lowest = np.where(good & np.isfinite(least), least, 0.0)
        parts = (S, at_actuator, *figures.values())
        moved = np.max([part.reaches for part in parts], axis=0)
        size = np.maximum(delta.middle, 1e-300)
        spread = np.where(good, moved, delta.reaches / size)
        rest = np.max([np.where(good, part.rest, 0.0) for part in parts], axis=0)
        spread[0] += np.where(spread.sum(axis=0) > 0.0, 0.0, rest + 1e-300)
        return Enclosures(names, highest, lowest, spread, good)


def _horner(row: Sequence[Affine | float], w: Affine) -> Affine:
    """Evaluate Σ row_k w^(n-k) by Horner's rule."""
    found = w * 0.0 + row[0]
    for part in row[1:]:
        found = found * w + part
    return found


def _product(factors: tuple[Array, ...], turn: Affine) -> Affine:
    """Π Σ c_k turn^k of exact coefficients."""
    found = turn * 0.0 + 1.0
    for c in factors:
        found = found * _horner(c[::-1].tolist(), turn)
    return found


def prove_cascade(
    cascade: Cascade, values: Array, bandwidth: float, uncertain: UncertainPlant, bounds: Bounds,
    sampling: Sampling, options: BoxProofOptions | None = None,
) -> Proof:  # fmt: skip
    """Prove bounds and stability of rounded values (SI) at ω_b in rad/s on the whole box."""
    options = options or BoxProofOptions()
    K, names = cascade.state_space(values), uncertain.names
    slack, families = options.slack, []
    for option in range(len(uncertain.options)):
        model = uncertain.plant(uncertain.nominal, option).plant_si()
        if not Loop(model, K, sampling).stable:
            return Proof(ProofOutcome.UNSTABLE, slack, names)
        fastest = float(np.abs(model.rates).max())
        unit = options.unit_frequency * max(bandwidth, fastest, bounds.omega_low)
        sampled = SampledModel(uncertain, option, sampling, unit)
        if not sampled.faithful:
            outcome = ProofOutcome.VARIES if uncertain.ranges else ProofOutcome.AS_RUN
            return Proof(outcome, slack, names)
        p, none = len(model.C), np.zeros(0)
        families.append(CascadeFamily(
            ModalSum(none, none.astype(bool), none, 0.0, none, none, none.astype(bool)), names, (),
            np.eye(p), np.ones((1, p)), bounds, bandwidth, unit, sampling.period * unit,
            sampling.delay * unit, model=sampled, controller=cascade.polynomials(values),
            sensors=(cascade.position, cascade.velocity),
        ))  # fmt: skip
    share = options.most_boxes // len(families)
    return divide([*families], uncertain.box, slack, share, None, None, options)
