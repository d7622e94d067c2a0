"""A ball-screw axis with an encoder on the motor and one at the table, in metres of travel.

The screw's diameter d makes it stiff and heavy to turn, its lead r makes the motor's inertia count
for less. x = [motor, table]; the inertia J of motor and screw counts as J (2π/lead)².
"""

import casadi as ca

STEEL, DENSITY = 210e9, 7850.0  # N/m², kg/m³
LENGTH, MOTOR, TABLE = 0.9, 2.0e-3, 120.0  # m of screw, kg m², kg

SENSORS = {
    "both": ca.DM([[1.0, 0.0], [0.0, 1.0]]),
    "motor": ca.DM([[1.0, 0.0]]),
    "table": ca.DM([[0.0, 1.0]]),
}


def axis(theta, damping_ratio=0.02, sensor="both", table=TABLE, length=LENGTH):
    d, lead = 1e-3 * theta["diameter"], 1e-3 * theta["lead"]
    core, gear = 0.85 * d, 2.0 * ca.pi / lead
    turned = (MOTOR + DENSITY * ca.pi * d**4 / 32.0 * LENGTH) * gear**2  # kg
    screw, nut, bearing = STEEL * ca.pi * core**2 / 4.0 / length, 1.2e10 * d, 3.0e8
    k = 1.0 / (1.0 / screw + 1.0 / nut + 1.0 / bearing)  # N/m
    return {
        "mass": ca.diag(ca.vertcat(turned, table)),
        "damping_ratio": damping_ratio,
        "stiffness": k * ca.DM([[1.0, -1.0], [-1.0, 1.0]]),
        "input": ca.DM([1.0, 0.0]),
        "output": SENSORS[sensor],
        "hardware_cost": (turned + table) / 1000.0,  # t, what the motor accelerates
        "constraints": {},
    }
