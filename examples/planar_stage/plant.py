"""A planar x-y-θz stage: a plate on air bearings that carries a payload on a flexible mount.

Coordinates are (x, y, φ) of the plate and of the payload. One motor pushes along x, two along y
at ±`arm`; three gauges read the payload, so the plant is 3 x 3 and not collocated. The payload sits
off the centre, which couples all three axes, and its mount makes three resonances.
"""

import casadi as ca

DENSITY = 2700.0  # kg/m³, aluminium
YOUNG, POISSON = 70e9, 0.33  # Pa, –
SIDE = 0.30  # m, of the square plate
PAYLOAD = 3.0  # kg
PAYLOAD_RADIUS = 0.06  # m, of gyration
OFFSET = (0.02, 0.03)  # m, of the payload from the plate's centre
LEG_STIFFNESS = 2.0e7  # N/m of the mount for legs of 1 mm; it grows with the cube
LEG_ARM = 0.08  # m, from the payload's centre to a leg
LEG_MASS = 600.0  # kg/m: of all legs, by their thickness
LEAST_BENDING = 600.0  # Hz: the plate counts as rigid below it


def stage(theta, arm=0.12, damping=0.01):
    """θ: `plate` thickness in m, `leg` thickness of the mount in m."""
    plate = DENSITY * SIDE**2 * theta["plate"]
    legs = LEG_MASS * theta["leg"]
    inertia = plate * SIDE**2 / 6.0
    payload = PAYLOAD + 0.5 * legs
    mass = ca.diag(
        ca.vertcat(
            plate + 0.5 * legs,
            plate + 0.5 * legs,
            inertia,
            payload,
            payload,
            payload * PAYLOAD_RADIUS**2,
        )
    )
    lateral = LEG_STIFFNESS * (theta["leg"] / 1e-3) ** 3
    springs = ca.diag(ca.vertcat(lateral, 0.8 * lateral, lateral * LEG_ARM**2))
    ex, ey = OFFSET
    # how far the plate carries the mount's foot along: its rotation moves an offset point
    foot = ca.DM([[1, 0, -ey], [0, 1, ex], [0, 0, 1]])
    stretch = ca.horzcat(-foot, ca.DM.eye(3))
    motors = ca.DM([[1, 0, 0], [0, 1, 1], [0, -arm, arm]])
    # first bending of a free square plate, 13.47/(2π L²) √(E h²/(12 (1 - ν²) ρ)), in Hz
    speed = (YOUNG / (12.0 * (1.0 - POISSON**2) * DENSITY)) ** 0.5
    bending = 13.47 / (2.0 * ca.pi * SIDE**2) * speed * theta["plate"]
    return {
        "mass": mass,
        "stiffness": ca.mtimes([stretch.T, springs, stretch]),
        "damping_ratio": damping,
        "input": ca.vertcat(motors, ca.DM.zeros(3, 3)),
        "output": ca.horzcat(ca.DM.zeros(3, 3), motors.T),  # in line with the motors
        "hardware_cost": plate + legs,
        "constraints": {"plate bending": 1.0 - bending / LEAST_BENDING},
    }
