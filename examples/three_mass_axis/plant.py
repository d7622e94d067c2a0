"""A positioning axis of three masses in a row, driven at one and measured at the next.

A linear motor (m1) pushes a carriage (m2) through a steel rod of diameter `d`; the tool (m3) stands
on the carriage on an aluminium arm of thickness `b`. The encoder reads the carriage.
"""

import casadi as ca

MOTOR, CARRIAGE, TOOL = 0.6, 0.8, 0.15  # kg
ROD, ARM, WIDTH = 0.25, 0.08, 0.03  # m: lengths of rod and arm, width of the arm
STEEL, ALUMINIUM = (210e9, 7850.0), (69e9, 2700.0)  # Pa, kg/m³


def axis(theta, zeta=0.01, least_tool_stiffness=2e5):
    """θ: d, b in m; u in N on the motor, y in m at the carriage; f is the moving mass in kg."""
    d, b = theta["d"], theta["b"]
    area = 0.25 * ca.pi * d**2
    rod = STEEL[0] * area / ROD
    arm = 3.0 * ALUMINIUM[0] * (WIDTH * b**3 / 12.0) / ARM**3
    rod_mass, arm_mass = STEEL[1] * area * ROD, ALUMINIUM[1] * WIDTH * b * ARM
    # half of the rod moves with either end, 33/140 of a cantilever with its tip
    m1 = MOTOR + 0.5 * rod_mass
    m2 = CARRIAGE + 0.5 * rod_mass + 107.0 / 140.0 * arm_mass
    m3 = TOOL + 33.0 / 140.0 * arm_mass
    return {
        "mass": ca.diag(ca.vertcat(m1, m2, m3)),
        "stiffness": rod * ca.DM([[1, -1, 0], [-1, 1, 0], [0, 0, 0]])
        + arm * ca.DM([[0, 0, 0], [0, 1, -1], [0, -1, 1]]),
        "damping_ratio": zeta,
        "input": ca.DM([1, 0, 0]),
        "output": ca.DM([[0, 1, 0]]),
        "hardware_cost": m1 + m2 + m3,
        "constraints": {"tool stiffness": 1.0 - arm / least_tool_stiffness},
    }
