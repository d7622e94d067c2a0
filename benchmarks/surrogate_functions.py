"""Standard test functions of surrogate modelling in 2 to 10 inputs, with exact gradients.

Source: Surjanovic & Bingham, Virtual Library of Simulation Experiments (2013), whose names,
boxes and constants these are. Written in CasADi, which differentiates them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

PI = np.pi


@dataclass(frozen=True)
class Function:
    """A function of d inputs on a box."""

    name: str
    lower: np.ndarray
    upper: np.ndarray
    expression: Callable[[ca.MX], ca.MX]

    @property
    def inputs(self) -> int:
        """The number d of inputs."""
        return len(self.lower)

    def sample(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, d) at X (n, d)."""
        x = ca.SX.sym("x", self.inputs)
        y = self.expression(x)
        both = ca.Function("f", [x], [y, ca.gradient(y, x)]).map(len(X))
        value, gradient = both(X.T)
        return np.array(value).ravel(), np.array(gradient).T


def branin(x):
    a = x[1] - 5.1 / (4 * PI**2) * x[0] ** 2 + 5 / PI * x[0] - 6
    return a**2 + 10 * (1 - 1 / (8 * PI)) * ca.cos(x[0]) + 10


def ishigami(x):
    return ca.sin(x[0]) + 7 * ca.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * ca.sin(x[0])


def rosenbrock(x):
    terms = range(x.shape[0] - 1)
    return sum(100 * (x[i + 1] - x[i] ** 2) ** 2 + (1 - x[i]) ** 2 for i in terms)


def friedman(x):
    return 10 * ca.sin(PI * x[0] * x[1]) + 20 * (x[2] - 0.5) ** 2 + 10 * x[3] + 5 * x[4]


def hartmann(A, P):
    alpha = np.array([1.0, 1.2, 3.0, 3.2])

    def function(x):
        return -sum(
            alpha[i] * ca.exp(-ca.sum1(ca.DM(A[i]) * (x - ca.DM(1e-4 * P[i])) ** 2))
            for i in range(4)
        )

    return function


def otl_circuit(x):
    b1, b2, f, c1, c2, beta = ca.vertsplit(x)
    v = 12 * b2 / (b1 + b2)
    gain = beta * (c2 + 9)
    return (
        (v + 0.74) * gain / (gain + f)
        + 11.35 * f / (gain + f)
        + 0.74 * f * gain / ((gain + f) * c1)
    )


def piston(x):
    M, S, V0, k, P0, Ta, T0 = ca.vertsplit(x)
    A = P0 * S + 19.62 * M - k * V0 / S
    V = S / (2 * k) * (ca.sqrt(A**2 + 4 * k * P0 * V0 / T0 * Ta) - A)
    return 2 * PI * ca.sqrt(M / (k + S**2 * P0 * V0 / T0 * Ta / V**2))


def borehole(x):
    rw, r, Tu, Hu, Tl, Hl, L, Kw = ca.vertsplit(x)
    log = ca.log(r / rw)
    return 2 * PI * Tu * (Hu - Hl) / (log * (1 + 2 * L * Tu / (log * rw**2 * Kw) + Tu / Tl))


def robot_arm(x):
    u = v = angle = 0
    for i in range(4):
        angle = angle + x[i]
        u, v = u + x[4 + i] * ca.cos(angle), v + x[4 + i] * ca.sin(angle)
    return ca.sqrt(u**2 + v**2)


def wing_weight(x):
    Sw, Wfw, A, sweep, q, taper, tc, Nz, Wdg, Wp = ca.vertsplit(x)
    cos = ca.cos(sweep * PI / 180)
    first = 0.036 * Sw**0.758 * Wfw**0.0035 * (A / cos**2) ** 0.6 * q**0.006 * taper**0.04
    return first * (100 * tc / cos) ** -0.3 * (Nz * Wdg) ** 0.49 + Sw * Wp


HARTMANN3 = hartmann(
    np.array([[3, 10, 30], [0.1, 10, 35], [3, 10, 30], [0.1, 10, 35.0]]),
    np.array([[3689, 1170, 2673], [4699, 4387, 7470], [1091, 8732, 5547], [381, 5743, 8828.0]]),
)
HARTMANN6 = hartmann(
    np.array(
        [
            [10, 3, 17, 3.5, 1.7, 8],
            [0.05, 10, 17, 0.1, 8, 14],
            [3, 3.5, 1.7, 10, 17, 8],
            [17, 8, 0.05, 10, 0.1, 14],
        ]
    ),
    np.array(
        [
            [1312, 1696, 5569, 124, 8283, 5886],
            [2329, 4135, 8307, 3736, 1004, 9991],
            [2348, 1451, 3522, 2883, 3047, 6650],
            [4047, 8828, 8732, 5743, 1091, 381.0],
        ]
    ),
)


def _f(name, lower, upper, expression):
    return Function(name, np.array(lower, dtype=float), np.array(upper, dtype=float), expression)


FUNCTIONS = (
    _f("Branin", [-5, 0], [10, 15], branin),
    _f("Hartmann 3", [0] * 3, [1] * 3, HARTMANN3),
    _f("Ishigami", [-PI] * 3, [PI] * 3, ishigami),
    _f("Rosenbrock", [-2] * 4, [2] * 4, rosenbrock),
    _f("Friedman", [0] * 5, [1] * 5, friedman),
    _f("Hartmann 6", [0] * 6, [1] * 6, HARTMANN6),
    _f("OTL circuit", [50, 25, 0.5, 1.2, 0.25, 50], [150, 70, 3, 2.5, 1.2, 300], otl_circuit),
    _f(
        "Piston",
        [30, 0.005, 0.002, 1000, 90000, 290, 340],
        [60, 0.02, 0.01, 5000, 110000, 296, 360],
        piston,
    ),
    _f(
        "Borehole",
        [0.05, 100, 63070, 990, 63.1, 700, 1120, 9855],
        [0.15, 50000, 115600, 1110, 116, 820, 1680, 12045],
        borehole,
    ),
    _f("Robot arm", [0] * 8, [2 * PI] * 4 + [1] * 4, robot_arm),
    _f(
        "Wing weight",
        [150, 220, 6, -10, 16, 0.5, 0.08, 2.5, 1700, 0.025],
        [200, 300, 10, 10, 45, 1, 0.18, 6, 2500, 0.08],
        wing_weight,
    ),
)
