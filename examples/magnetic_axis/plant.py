"""One axis on a pair of electromagnets, linearised about the middle of the gap.

Two magnets in differential drive, bias i0 and air gap s0 each, pull by

    f(i, x) = k ((i0 + i)²/(s0 - x)² - (i0 - i)²/(s0 + x)²) = k_i i - k_s x + ...,
    k_i = 4 k i0/s0²,   k_s = -4 k i0²/s0³,

so that the stiffness is negative: the axis falls to one side without a controller.
"""

MAGNET = 6e-6  # k, N m²/A²
COIL = 2.0  # resistance of both coils, ohm


def axis(theta, acceleration=40.0):
    mass, gap, bias = theta["mass"], 1e-3 * theta["gap"], theta["bias"]
    force_per_current = 4.0 * MAGNET * bias / gap**2
    return {
        "mass": mass,
        "damping": 0.0,
        "stiffness": -4.0 * MAGNET * bias**2 / gap**3,
        "input": force_per_current,
        "output": 1.0,
        "hardware_cost": COIL * bias**2,  # W
        "constraints": {
            # at i = i0 one magnet is off: the largest force of the linear range
            "too weak": mass * acceleration - force_per_current * bias
        },
    }
