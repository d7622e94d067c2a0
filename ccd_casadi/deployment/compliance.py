"""What a force moves with the controller as it runs: |GS| of the sampled loop in m/N.

A sinusoidal force f beside the held one acts on the plant without a break, the loop answers at the
instants: the outputs there are S(e^{jωT}) G(jω) f, ω up to π/T. What faster forces leave (aliased)
is not in it.
"""

import numpy as np
from scipy.optimize import minimize_scalar

from ccd_casadi.deployment.sampled import DiscreteStateSpace
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.arrays import Array

PER_DECADE = 60
DECADES = 6  # below the Nyquist frequency
CLOSE = 0.1  # relative: local maxima this close to the largest are followed to their tops


def sampled_compliance(plant: StateSpace, S: DiscreteStateSpace) -> float:
    """max over ω of σ_max(S(e^{jωT}) G(jω)), m/N; the plant in SI without hold and delay.

    S is stable (`sensitivity_loop`). Points on a logarithmic grid and at every resonance of plant
    and loop, the largest local maxima climbed.
    """
    end = np.pi / S.period
    poles = np.linalg.eigvals(S.A)
    roots = np.concatenate([np.abs(np.angle(poles)) / S.period, np.abs(np.linalg.eigvals(plant.A))])
    near = (roots[:, None] * np.array([0.98, 0.995, 1.0, 1.005, 1.02])).ravel()
    grid = np.geomspace(end * 10.0**-DECADES, end, DECADES * PER_DECADE)
    rest = 1e-2 * grid[:1]  # a constant force, but for a plant without suspension
    omega = np.unique(np.concatenate([rest, grid, near[(near > grid[0]) & (near < end)]]))

    def gain(at: Array) -> Array:
        s = 1j * at[:, None, None]
        G = plant.C @ np.linalg.solve(s * np.eye(len(plant.A)) - plant.A, plant.B + 0j) + plant.D
        return np.asarray(np.linalg.norm(S.response(at) @ G, 2, axis=(1, 2)), dtype=float)

    found = gain(omega)
    best = float(found.max())
    inner = np.flatnonzero((found[1:-1] >= found[:-2]) & (found[1:-1] >= found[2:])) + 1
    for i in inner[found[inner] >= (1.0 - CLOSE) * best]:
        top = minimize_scalar(
            lambda x: -float(gain(np.exp([x]))[0]),
            bounds=(float(np.log(omega[i - 1])), float(np.log(omega[i + 1]))),
            method="bounded", options={"xatol": 1e-9},
        )  # fmt: skip
        best = max(best, -float(top.fun))
    return best
