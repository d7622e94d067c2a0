"""A free steel beam with two collocated pairs of actuators and sensors, at its ends.

Euler and Bernoulli elements; θ are height and width of the cross-section in m.
"""

import casadi as ca
import numpy as np

ELEMENTS = 10
YOUNG, DENSITY = 210e9, 7850.0  # steel, Pa and kg/m³


def beam(theta, length=0.5, zeta=0.005):
    """M, K, B, C of the beam; deflection and slope at every node."""
    h, b = theta["h"], theta["b"]
    e = length / ELEMENTS
    k = np.array(
        [[12, 6 * e, -12, 6 * e], [6 * e, 4 * e**2, -6 * e, 2 * e**2],
         [-12, -6 * e, 12, -6 * e], [6 * e, 2 * e**2, -6 * e, 4 * e**2]]
    ) / e**3  # fmt: skip
    m = np.array(
        [[156, 22 * e, 54, -13 * e], [22 * e, 4 * e**2, 13 * e, -3 * e**2],
         [54, 13 * e, 156, -22 * e], [-13 * e, -3 * e**2, -22 * e, 4 * e**2]]
    ) * e / 420  # fmt: skip
    n = 2 * (ELEMENTS + 1)
    K, M = np.zeros((n, n)), np.zeros((n, n))
    for first in range(0, n - 2, 2):
        here = slice(first, first + 4)
        K[here, here] += k
        M[here, here] += m
    B = np.zeros((n, 2))
    B[0, 0] = B[n - 2, 1] = 1.0
    return {
        "mass": DENSITY * b * h * ca.DM(M),
        "stiffness": YOUNG * b * h**3 / 12 * ca.DM(K),
        "input": B,
        "output": B.T,
        "damping_ratio": zeta,
        "hardware_cost": DENSITY * b * h * length,
    }
