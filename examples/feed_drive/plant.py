"""A ball-screw feed drive in metres of table travel: encoders at the motor and at the table.

The nut is at a distance `at` from the fixed bearing, with a `load` on the table: both vary. The
cutting force acts at the table. x = [motor, screw, table]; inertias J count as J (2π/lead)².
"""

import casadi as ca

STEEL, SHEAR, DENSITY, LENGTH = 210e9, 80e9, 7850.0, 1.2  # N/m², N/m², kg/m³, m
MOTOR, COUPLING, TABLE = 6.0e-3, 4.0e4, 100.0  # kg m², N m/rad, kg
SENSORS = {"both": [[1, 0, 0], [0, 0, 1]], "table": [[0, 0, 1]]}


def drive(theta, damping_ratio=0.02, sensor="both"):
    d, gear, at = 1e-3 * theta["diameter"], 2e3 * ca.pi / theta["lead"], theta["at"]
    core = 0.85 * d
    screw = STEEL * ca.pi * core**2 / 4.0 / at
    axial = 1.0 / (1.0 / 8.0e8 + 1.0 / (1.75e10 * d) + 1.0 / screw)  # bearing, nut, N/m
    twist = SHEAR * ca.pi * core**4 / 32.0 / at
    turned = gear**2 / (1.0 / twist + 1.0 / COUPLING)
    motor = MOTOR * gear**2
    spindle = DENSITY * ca.pi * d**4 / 32.0 * LENGTH * gear**2
    table = TABLE + theta["load"]
    return {
        "mass": ca.diag(ca.vertcat(motor, spindle, table)),
        "damping_ratio": damping_ratio,
        "stiffness": ca.blockcat([
            [turned, -turned, 0.0], [-turned, turned + axial, -axial], [0.0, -axial, axial],
        ]),
        "input": ca.DM([1.0, 0.0, 0.0]),
        "output": ca.DM(SENSORS[sensor]),
        "disturbance": ca.DM([0.0, 0.0, 1.0]),
        "performance": ca.DM([[0.0, 0.0, 1.0]]),
        "hardware_cost": (motor + spindle + table) / 1000.0,  # t, what the motor accelerates
        "constraints": {"40 m/min at 4000 rpm": 10.0 - theta["lead"]},
    }  # fmt: skip
