"""Writes modes.csv: a gantry beam on two linear motors, by Euler-Bernoulli finite elements.

The case file knows nothing of this model: it reads the table, as it would one exported from a
finite-element program. `python examples/modal_table/gantry.py` writes it anew.
"""

from pathlib import Path

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.extensions.imported.modal_table import ModalTable, write_modal_table

LENGTH, WIDTH, ELEMENTS = 0.8, 0.06, 24  # m; the tube is WIDTH across the motion
YOUNG, DENSITY = 69e9, 2700.0  # aluminium
MOTOR, CARRIAGE, AT = 1.5, 3.0, 14  # kg, and the carriage's node: off the middle
DAMPING, MODES = 0.01, 7


def matrices(h: float, t: float) -> tuple[np.ndarray, np.ndarray, float]:
    """M, K and the tube's mass; h: its height along the motion, t: its wall, in m."""
    area = WIDTH * h - (WIDTH - 2 * t) * (h - 2 * t)
    inertia = (WIDTH * h**3 - (WIDTH - 2 * t) * (h - 2 * t) ** 3) / 12.0
    a = LENGTH / ELEMENTS
    stiffness = (YOUNG * inertia / a**3) * np.array(
        [[12, 6 * a, -12, 6 * a], [6 * a, 4 * a**2, -6 * a, 2 * a**2],
         [-12, -6 * a, 12, -6 * a], [6 * a, 2 * a**2, -6 * a, 4 * a**2]]
    )  # fmt: skip
    mass = (DENSITY * area * a / 420.0) * np.array(
        [[156, 22 * a, 54, -13 * a], [22 * a, 4 * a**2, 13 * a, -3 * a**2],
         [54, 13 * a, 156, -22 * a], [-13 * a, -3 * a**2, -22 * a, 4 * a**2]]
    )  # fmt: skip
    n = 2 * (ELEMENTS + 1)
    M, K = np.zeros((n, n)), np.zeros((n, n))
    for e in range(ELEMENTS):
        rows = slice(2 * e, 2 * e + 4)
        M[rows, rows] += mass
        K[rows, rows] += stiffness
    for node, own in ((0, MOTOR), (ELEMENTS, MOTOR), (AT, CARRIAGE)):
        M[2 * node, 2 * node] += own
    return M, K, DENSITY * area * LENGTH


def modes(h: float, t: float) -> tuple[np.ndarray, np.ndarray, float]:
    """ω (r,) in rad/s, mass-normalised displacements of every node (r, nodes), the tube's mass."""
    M, K, tube = matrices(h, t)
    lam, shapes = eigh(K, M, subset_by_index=(0, MODES - 1))
    lam[:2] = 0.0  # the beam is free: lift and turn
    return np.sqrt(lam), shapes[::2].T, tube


def table() -> ModalTable:
    """25 samples: heights of 20 to 50 mm, walls of 1 to 3 mm."""
    theta = [(h, t) for h in np.linspace(0.02, 0.05, 5) for t in np.linspace(1e-3, 3e-3, 5)]
    found = [modes(h, t) for h, t in theta]
    shapes = np.array([item[1] for item in found])
    ends = shapes[:, :, [0, -1]]  # both motors push where both encoders read
    return ModalTable(
        names=("h", "t"),
        input_names=("left", "right"),
        output_names=("left", "right"),
        constraint_names=(),
        theta=np.array(theta),
        omega=np.array([item[0] for item in found]),
        zeta=np.full((25, MODES), DAMPING),
        inputs=ends,
        outputs=ends,
        shapes=shapes[:, :, [6, 12, 18]],
        cost=np.array([item[2] for item in found]),
        constraints=np.zeros((25, 0)),
    )


if __name__ == "__main__":
    write_modal_table(Path(__file__).with_name("modes.csv"), table())
