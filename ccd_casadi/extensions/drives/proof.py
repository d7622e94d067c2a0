"""A proof that a rounded cascade keeps its bounds on a whole box of plants, by branch and bound.

With K_j = P_j/(Q(1 - 1/z)), Q without the integrator, and the plant by `sampled_model`,

    Δ = D Q(1 - 1/z) + z⁻ᵈ Σ_j N_j P_j,   S_u = D Q(1 - 1/z)/Δ,   S_i = 1 - z⁻ᵈ N_i P_i/Δ

are fractions of polynomials in z and w, finite everywhere: at 0 Hz, too, where free bodies and the
integrator are infinite. Where Δ has no zero on the circle for a connected set of plants, of which
one is stable, all are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.extensions.drives.cascade import Cascade, Polynomials
from ccd_casadi.extensions.drives.sampled_model import SampledModel
from ccd_casadi.fixed_structure.affine import Affine, exponential, inverse, variable
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import BoxProofOptions, Proof, ProofOutcome, divide
from ccd_casadi.fixed_structure.boxes import Boxes
from ccd_casadi.fixed_structure.enclosure import Enclosures, LoopFamily
from ccd_casadi.fixed_structure.uncertainty import ModalSum, UncertainPlant
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.support.arrays import Array


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
    """Σ row_k w^(n-k)."""
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
