"""Writes modes.csv and nodes.csv: a free carrier plate with a payload, by Ritz's method.

The case file knows nothing of this model: it reads the tables, as it would those of a
finite-element program. `python examples/placed_motors/plate.py` writes them anew.
"""

import csv
from pathlib import Path

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh

from ccd_casadi.extensions.imported.modal_table import ModalTable, write_modal_table

LENGTH, WIDTH = 0.36, 0.24  # m
YOUNG, POISSON, DENSITY = 70e9, 0.33, 2700.0  # aluminium
PAYLOAD, AT = 0.6, (0.0, 0.0)  # kg, and where it is bolted on
DAMPING, MODES = 0.01, 16
DEGREE = 12  # of the polynomials along either axis
THICKNESS = np.linspace(6e-3, 12e-3, 5)
NODES = [(x, y) for x in np.linspace(-0.18, 0.18, 11) for y in np.linspace(-0.12, 0.12, 9)]


def matrices(t: float) -> tuple[np.ndarray, np.ndarray]:
    """M, K of w = Σ q_ij P_i(2x/LENGTH) P_j(2y/WIDTH), without the payload; Kirchhoff's plate."""
    z, weight = legendre.leggauss(DEGREE + 2)
    eye = np.eye(DEGREE + 1)
    P = [legendre.legval(z, legendre.legder(eye, k) if k else eye) for k in range(3)]

    def along(size: float) -> dict[tuple[int, int], np.ndarray]:
        """∫ of products of a'th and b'th derivatives."""
        scale = 2.0 / size
        return {
            (a, b): (P[a] * weight) @ P[b].T * scale ** (a + b) / scale
            for a in range(3)
            for b in range(3)
        }

    X, Y = along(LENGTH), along(WIDTH)
    D = YOUNG * t**3 / (12.0 * (1.0 - POISSON**2))
    cross = np.kron(X[2, 0], Y[0, 2])
    K = (
        np.kron(X[2, 2], Y[0, 0])
        + np.kron(X[0, 0], Y[2, 2])
        + POISSON * (cross + cross.T)
        + 2.0 * (1.0 - POISSON) * np.kron(X[1, 1], Y[1, 1])
    )
    return DENSITY * t * np.kron(X[0, 0], Y[0, 0]), D * K


def shape(x: float, y: float) -> np.ndarray:
    """The values of all functions at a point."""
    eye = np.eye(DEGREE + 1)
    return np.kron(legendre.legval(2.0 * x / LENGTH, eye), legendre.legval(2.0 * y / WIDTH, eye))


def modes(t: float, masses: tuple[tuple[float, float, float], ...] = (), count: int = MODES):
    """ω (r,) in rad/s and q (r, n), mass-normalised; `masses` (x, y, kg) besides the payload."""
    M, K = matrices(t)
    for x, y, kg in ((*AT, PAYLOAD), *masses):
        M = M + kg * np.outer(shape(x, y), shape(x, y))
    lam, q = eigh(K, M, subset_by_index=(0, count - 1))
    lam[:3] = 0.0  # lift, pitch, roll
    return np.sqrt(np.maximum(lam, 0.0)), q.T


def table() -> ModalTable:
    """Five thicknesses; forces and sensors at every node."""
    at = np.array([shape(*node) for node in NODES])
    found = [modes(t) for t in THICKNESS]
    shown = np.array([q @ at.T for _, q in found])
    names = tuple(f"n{i + 1}" for i in range(len(NODES)))
    return ModalTable(
        names=("t",),
        input_names=names,
        output_names=names[:1],
        constraint_names=(),
        theta=THICKNESS[:, None],
        omega=np.array([omega for omega, _ in found]),
        zeta=np.full((len(found), MODES), DAMPING),
        inputs=shown,
        outputs=shown[:, :, :1],
        shapes=np.zeros((len(found), MODES, 0)),
        cost=DENSITY * LENGTH * WIDTH * THICKNESS,
        constraints=np.zeros((len(found), 0)),
    )


if __name__ == "__main__":
    here = Path(__file__)
    write_modal_table(here.with_name("modes.csv"), table())
    with here.with_name("nodes.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([("x", "y"), *NODES])
