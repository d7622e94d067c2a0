"""A guided beam in the domain of Delissen, van Keulen and Langelaar (2023), of two heights.

Their second case is a block of 300 x 100 x 300 mm aluminium (E = 65 GPa, ν = 0.3, 2700 kg/m³, plane
strain) of which topology optimisation leaves 30 %; its left edge is guided and driven, the sensor
is at the tip's upper corner. Here the material is a beam whose height falls linearly, in ten
bending modes (Euler and Bernoulli; Ritz with ξ² P_k(2ξ - 1)), and the rigid body.
"""

import casadi as ca
import numpy as np
from numpy.polynomial import Legendre, Polynomial

LENGTH, DEPTH, ENVELOPE = 0.3, 0.3, 0.1  # m; the last is the height of their domain
MODULUS, DENSITY = 65e9 / (1.0 - 0.3**2), 2700.0  # Pa in plane strain, kg/m³
MODES = 10


def shapes() -> list[Polynomial]:
    """The rigid motion, then functions of ξ = x/L with no slope at the guide."""
    square = Polynomial([0.0, 0.0, 1.0])
    return [Polynomial([1.0])] + [
        square * Legendre.basis(k, domain=[0.0, 1.0]).convert(kind=Polynomial) for k in range(MODES)
    ]


def beam(theta, zeta=0.01, volume=0.3):
    """θ: height at the guide and at the tip in m; u in N, y in m, f is the mass in kg."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    xi, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    height = theta["guide"] + (theta["tip"] - theta["guide"]) * ca.DM(xi)
    found = shapes()
    value = ca.DM(np.array([shape(xi) for shape in found]))
    bending = ca.DM(np.array([shape.deriv(2)(xi) for shape in found]))
    line = DENSITY * DEPTH * LENGTH * height * ca.DM(weights)
    stiff = MODULUS * DEPTH / 12.0 / LENGTH**3 * height**3 * ca.DM(weights)
    mean = 0.5 * (theta["guide"] + theta["tip"])
    return {
        "mass": value @ ca.diag(line) @ value.T,
        "stiffness": bending @ ca.diag(stiff) @ bending.T,
        "damping_ratio": zeta,
        "input": ca.DM([shape(0.0) for shape in found]),
        "output": ca.DM([[shape(1.0) for shape in found]]),
        "hardware_cost": DENSITY * DEPTH * LENGTH * mean,
        "constraints": {"volume": mean / (volume * ENVELOPE) - 1.0},
    }
