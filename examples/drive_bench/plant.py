"""A two-mass bench with a linear motor: the motor's encoder and the load's.

Its author's model (pylib_sakata, MIT): 0.11 kg in all, drag 0.7 N s/m, anti-resonance 147 Hz,
resonance 269 Hz, 2.5 N s/m in the coupling.
"""

import casadi as ca

ANTIRESONANCE, DRAG, COUPLING = 147.0, 0.7, 2.5  # Hz, N s/m, N s/m


def bench(theta, motor=0.0329, sensor="both"):
    load = theta["load"]
    k = 0.0771 * (2.0 * ca.pi * ANTIRESONANCE) ** 2  # N/m
    c = COUPLING
    rows = {"both": [[1.0, 0.0], [0.0, 1.0]], "motor": [[1.0, 0.0]], "load": [[0.0, 1.0]]}
    return {
        "mass": ca.diag(ca.vertcat(motor, load)),
        "damping": ca.DM([[c + DRAG, -c], [-c, c]]),
        "stiffness": k * ca.DM([[1.0, -1.0], [-1.0, 1.0]]),
        "input": ca.DM([1.0, 0.0]),
        "output": ca.DM(rows[sensor]),
        "hardware_cost": load,
        "constraints": {},
    }
