"""Feedforward of the setpoint: the plant's inverse at low frequencies, ahead of hold and delay.

    f = Σ_k F_k r^(k),   Σ_k F_k sᵏ = e^{s(τ + T/2)} G(s)⁺ + O(s⁵)

F_0 is the suspension's stiffness, F_1 its damping, F_2 the mass; F_3 (jerk) makes up for the delay
τ and for half a hold T/2, F_4 (snap) for the compliance of the flexible modes (Boerlage, Tousain &
Steinbuch 2004). A setpoint of fourth order has all of these derivatives bounded.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

ORDER = 4  # highest derivative of the setpoint
POINTS = 64  # on the circle of Cauchy's integral
RADIUS = 0.25  # of the nearest singularity of the inverse
ROUNDING = 1e-11  # of the inverse on the circle: what a coefficient has by rounding there is none


def feedforward(plant: StateSpace, period: float, delay: float) -> Array:
    """F (ORDER + 1, m, p) in N per unit of y and s, of a stable plant; T and τ in s.

    Taylor coefficients by Cauchy's integral on a circle within which the inverse is analytic: its
    aliasing error is RADIUS^(POINTS - ORDER). Raises UserError where the plant has a zero at s = 0,
    so that no finite force holds a position. Free bodies have F_0 = 0, without dampers F_1 = 0.
    """
    return feedforward_slopes(plant, (), period, delay)[0]


def feedforward_slopes(
    plant: StateSpace, changes: Sequence[tuple[Array, Array, Array]], period: float, delay: float
) -> tuple[Array, Array]:
    """F, and dF (k, ORDER + 1, m, p) of k changes (dA, dB, dC) of a square plant.

    dG⁻¹ = -G⁻¹ dG G⁻¹
    """
    poles = np.abs(plant.poles)
    zeros = plant.zeros(float(poles.max()))
    nearest = min([*np.abs(zeros), poles.max()])
    if not nearest > 1e-9 * poles.max():
        raise UserError("the plant has a zero at 0 Hz: no feedforward of the setpoint exists")
    late = delay + 0.5 * period
    radius = RADIUS * nearest
    if radius * late > 1.0:  # where exp stays of size one
        radius = 1.0 / late
    s = radius * np.exp(2j * np.pi * np.arange(POINTS) / POINTS)
    X = np.linalg.solve(s[:, None, None] * np.eye(len(poles)) - plant.A, plant.B + 0j)
    G = plant.C @ X + plant.D
    inverse = np.linalg.inv(G) if G.shape[1] == G.shape[2] else np.linalg.pinv(G)
    ahead = np.exp(s * late)[:, None, None]

    def series(values: np.ndarray) -> Array:
        found = np.fft.fft(ahead * values, axis=0).real[: ORDER + 1] / POINTS
        size = np.abs(values).max(axis=0)
        size = np.minimum(size.max(axis=0), size.max(axis=1)[:, None])  # whatever the units
        found[np.abs(found) <= ROUNDING * size] = 0.0
        return np.asarray(found / radius ** np.arange(ORDER + 1)[:, None, None])

    F, dF = series(inverse), np.zeros((len(changes), ORDER + 1, *inverse.shape[1:]))
    for i, (dA, dB, dC) in enumerate(changes):
        whole = s[:, None, None] * np.eye(len(poles)) - plant.A
        dG = dC @ X + plant.C @ np.linalg.solve(whole, dA @ X + dB)
        dF[i] = series(-inverse @ dG @ inverse)
    return F, dF
