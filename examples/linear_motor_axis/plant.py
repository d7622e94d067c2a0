"""A linear-motor axis: a carriage on the forcer, and the tool on an arm; force and encoder at the
carriage, which the tool follows."""

import math

E, RHO = 70e9, 2700.0  # aluminium
LENGTH, WIDTH = 0.2, 0.12  # m, of the arm
TOOL = 1.2  # kg at its end


def axis(theta, *, zeta, plate=2.0):
    """Parameter h (m), the thickness of the arm; `plate` (kg) is the carriage without its motor."""
    h = theta["h"]
    arm = RHO * LENGTH * WIDTH * h
    stiffness = 3.0 * E * WIDTH * h**3 / 12.0 / LENGTH**3
    tip = TOOL + 33.0 / 140.0 * arm
    carriage = plate + 107.0 / 140.0 * arm
    return {
        "mass": [[carriage, 0.0], [0.0, tip]],
        "stiffness": [[stiffness, -stiffness], [-stiffness, stiffness]],
        "damping_ratio": zeta,
        "input": [[1.0], [0.0]],
        "output": [[1.0, 0.0]],
        "hardware_cost": carriage + tip,
    }
