"""The densities of error and force over frequency, and their integrals.

    S_e(f) = ‖H_e(f)‖² S(f),   σ² = ∫ S_e df

with H of `sources`. In a sampled loop S, T and K are those of z = e^{jωT} and the disturbed G is
the continuous one: S_e is then the density of the samples before it is folded to below half the
rate, and its integral over all f their variance, aliases included.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ccd_casadi.budget.loops import FORCES, process
from ccd_casadi.budget.quadrature import Integral, integrate
from ccd_casadi.budget.sources import Kind, Source
from ccd_casadi.lti.closed_loop import sensitivity
from ccd_casadi.lti.grid import around, frequency_grid
from ccd_casadi.lti.loop import Loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

LOWEST, HIGHEST = 1e-9, 1e4  # of what is white: over the slowest and the fastest pole
PER_DECADE = 6  # panels at least, so that a curve is drawn through their ends
FLANKS = np.array([-10.0, -3.0, -1.0, 1.0, 3.0, 10.0])  # in half widths of a root


@dataclass(frozen=True)
class Responses:
    """G and K as in the loop, the disturbed G, S = (1 + GK)⁻¹ and (1 + KG)⁻¹, (k, ·, ·)."""

    G: np.ndarray
    K: np.ndarray
    free: np.ndarray
    S: np.ndarray

    def seen(self, kind: Kind) -> np.ndarray:
        """What of a source the controller reads."""
        if kind in FORCES:
            return -self.S @ self.free
        return self.S if kind is Kind.SETPOINT else -self.S

    def of(self, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
        """H_e and H_u of a source."""
        seen = self.seen(kind)
        true = np.eye(seen.shape[1]) + seen if kind is Kind.SENSOR_NOISE else seen
        return true, self.K @ seen


def responses(loop: Loop, hz: Array) -> Responses:
    """The loop at frequencies in Hz."""
    omega = HZ * np.asarray(hz, float)
    G, K = (part.response(omega) for part in loop.as_run)
    free = G if loop.sampling is None else loop.plant.response(omega)
    return Responses(G, K, free, sensitivity(G @ K))


def densities(loop: Loop, source: Source) -> Callable[[Array], Array]:
    """f in Hz -> (S_e, S_u) as rows, of all channels together; one-sided, m²/Hz and N²/Hz."""
    if loop.sampling is not None and source.shaped:
        return _folded(loop, source, loop.sampling.period)

    def at(hz: Array) -> Array:
        found = responses(loop, hz).of(source.kind)
        gains = np.array([(np.abs(H) ** 2).sum((1, 2)) for H in found])
        return np.asarray(gains * source.density(hz))

    return at


def _folded(loop: Loop, source: Source, T: float) -> Callable[[Array], Array]:
    """The densities of the samples below half the rate, with all that is folded into them."""
    model = process(loop, source).balanced()

    def at(hz: Array) -> Array:
        z = np.expm1(1j * HZ * hz * T)
        resolvent = np.linalg.inv(z[:, None, None] * np.eye(len(model.A)) - model.A)
        found = []
        for out, direct in ((model.C, 0.0 * (model.C @ model.E)), (model.F, model.V)):
            H = out @ resolvent
            white = H @ model.E + direct
            both = np.einsum("kij,jl,kil->k", H, model.Q, H.conj(), optimize=True).real
            found.append(2.0 * T * (both + (np.abs(white) ** 2).sum((1, 2))))
        return np.array(found)

    return at


def panels(loop: Loop, source: Source) -> Array:
    """Rising frequencies in Hz between which the densities are smooth, from end to end.

    A table's own range. What is white goes on from far below the slowest to far above the fastest
    pole, in a sampled loop to half the rate, beyond which the noise of samples is not counted.
    """
    roots = np.concatenate([loop.poles, loop.plant.poles, loop.controller.poles])
    sizes = np.abs(roots[np.abs(roots) > 1e-9 * np.abs(roots).max()])
    corners = source.corners()
    if source.shaped:
        bends = np.concatenate([sizes, corners])
        low, high = LOWEST * bends.min(), HIGHEST * bends.max()
        if loop.sampling is not None:
            high = np.pi / loop.sampling.period
            low = min(low, 1e-6 * high)
    else:
        low, high = corners[0], corners[-1]
    points = 2 + int(PER_DECADE * np.log10(high / low))
    special = (corners, sizes, around(roots, FLANKS))
    return np.asarray(frequency_grid(low, high, points, *special, apart=1e-9) / HZ)


def integrated(loop: Loop, source: Source, weight: Callable[[Array], Array]) -> Integral:
    """∫ w(f) S_e df and ∫ S_u df; rows S_e, S_u and w S_e. In Hz, m² and N²."""
    both = densities(loop, source)

    def rows(hz: Array) -> Array:
        error, force = both(hz)
        return np.array([error, force, weight(hz) * error])

    return integrate(rows, panels(loop, source))
