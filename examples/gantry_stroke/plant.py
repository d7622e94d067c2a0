"""An H-drive gantry: a beam on two motors moves along y, a carriage runs along the beam.

Where the carriage stands changes the inertia about the vertical, the beam's modes and where the
tool is: `at` is a parameter of the plant, and the case lets it vary over the stroke.
"""

import casadi as ca
import numpy as np
from numpy.polynomial import legendre

LENGTH, WIDTH = 0.9, 0.06  # m, of the beam between its motors; its width is vertical
YOUNG, DENSITY = 69e9, 2700.0  # aluminium
MOTOR, CARRIAGE = 2.5, 4.0  # kg
GUIDE = 5.0e6  # N m/rad, of the guides against yaw
DEGREE = 8  # of the polynomials that the beam's deflection is made of


def gantry(theta, damping=0.01):
    """θ in m: `h` of the beam's box along y, its `wall`, and `at` of the carriage, 0 the middle.

    Both motors push alike; the tool on the carriage is measured. y(x) = Σ q_k P_k(2x/LENGTH).
    """
    h, wall, at = theta["h"], theta["wall"], theta["at"]
    area = WIDTH * h - (WIDTH - 2.0 * wall) * (h - 2.0 * wall)
    bending = YOUNG * (WIDTH * h**3 - (WIDTH - 2.0 * wall) * (h - 2.0 * wall) ** 3) / 12.0
    z, weight = legendre.leggauss(DEGREE + 1)
    eye = np.eye(DEGREE + 1)
    P, curved = legendre.legval(z, eye), legendre.legval(z, legendre.legder(eye, 2))
    ends = legendre.legval(np.array([-1.0, 1.0]), eye)
    tool = polynomials(2.0 * at / LENGTH)
    yaw = np.eye(DEGREE + 1)[1] * 2.0 / LENGTH  # of the beam's mean line
    mass = DENSITY * area * LENGTH / 2.0 * ca.DM((P * weight) @ P.T)
    mass += MOTOR * ca.DM(ends @ ends.T) + CARRIAGE * ca.mtimes(tool, tool.T)
    stiffness = bending * (2.0 / LENGTH) ** 3 * ca.DM((curved * weight) @ curved.T)
    return {
        "mass": mass,
        "stiffness": stiffness + GUIDE * ca.DM(np.outer(yaw, yaw)),
        "damping_ratio": damping,
        "input": ca.DM(0.5 * ends.sum(axis=1)),
        "output": tool.T,
        "hardware_cost": DENSITY * area * LENGTH,
    }


def polynomials(z):
    """P_0 to P_DEGREE at z, a number or a symbol, by Bonnet's recursion."""
    found = [1.0, z]
    for k in range(1, DEGREE):
        found.append(((2 * k + 1) * z * found[k] - k * found[k - 1]) / (k + 1))
    return ca.vertcat(*found)
