"""A carriage on a linear motor, with a tool on an arm; force and encoder at the carriage."""

import casadi as ca

ALUMINIUM = (70e9, 2700.0)  # Pa, kg/m³
LENGTH, WIDTH = 0.2, 0.12  # m, of the arm
TOOL = 1.2  # kg at its end


def axis(theta, zeta=0.01, carriage=2.0):
    """θ: h in m, the thickness of the arm; `carriage` in kg, without the motor's moving part."""
    h = theta["h"]
    arm = ALUMINIUM[1] * LENGTH * WIDTH * h
    stiffness = 3.0 * ALUMINIUM[0] * (WIDTH * h**3 / 12.0) / LENGTH**3
    # 33/140 of a cantilever moves with its tip
    base, tip = carriage + 107.0 / 140.0 * arm, TOOL + 33.0 / 140.0 * arm
    return {
        "mass": ca.diag(ca.vertcat(base, tip)),
        "stiffness": stiffness * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": zeta,
        "input": ca.DM([1, 0]),
        "output": ca.DM([[1, 0]]),
        "hardware_cost": base + tip,
    }
