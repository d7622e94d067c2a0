"""What a force moves with the controller as it runs: |GS| of the sampled loop in m/N.

A sinusoidal force f beside the held one acts on the plant without a break, the loop answers at the
instants: the outputs there are S(e^{jωT}) G(jω) f, ω up to π/T. What faster forces leave (aliased)
is not in it.
"""

import numpy as np

from ccd_casadi.lti.closed_loop import largest
from ccd_casadi.lti.grid import climbed, frequency_grid, local_maxima
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

PER_DECADE = 60
DECADES = 6  # below the Nyquist frequency
CLOSE = 0.1  # relative: local maxima this close to the largest are followed to their tops


def sampled_compliance(plant: StateSpace, S: StateSpace) -> float:
    """max over ω of σ_max(S(e^{jωT}) G(jω)), m/N; the plant in SI without hold and delay.

    S is stable. Points on a logarithmic grid and at every resonance of plant
    and loop, the largest local maxima climbed.
    """
    end = np.pi / S.period
    poles = S.poles
    roots = np.concatenate([np.abs(np.angle(poles)) / S.period, np.abs(plant.poles)])
    near = (roots[:, None] * np.array([0.98, 0.995, 1.0, 1.005, 1.02])).ravel()
    low = end * 10.0**-DECADES
    grid = frequency_grid(low, end, DECADES * PER_DECADE, near)
    omega = np.append(1e-2 * low, grid)  # a constant force, but for a plant without suspension

    def gain(at: Array) -> Array:
        return largest(S.response(at) @ plant.response(at))

    found = gain(omega)
    best = float(found.max())
    for i in local_maxima(found):
        if found[i] >= (1.0 - CLOSE) * best:
            ends = float(omega[i - 1]), float(omega[i + 1])
            best = max(best, climbed(lambda w: float(gain(np.array([w]))[0]), *ends, 1e-9)[1])
    return best
