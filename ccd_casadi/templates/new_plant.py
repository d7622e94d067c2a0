"""A carriage on a linear motor with a chuck on four ribs: a stage to change into your own."""

import casadi as ca


def stage(theta, damping=0.01):
    """M, D, K, B, C of the stage in SI units, from θ: `rib` and `plate` in mm.

    θ comes as CasADi symbols, so that derivatives are exact: `**` and `ca.sqrt`, no `if` on a θ.
    """
    ribs = 0.05 * theta["rib"]  # kg
    carriage = 2.0 + 0.4 * theta["plate"] + 0.5 * ribs  # kg
    chuck = 1.5 + 0.5 * ribs  # kg
    stiffness = 2.0e6 * (theta["rib"] / 10.0) ** 3  # N/m, bending of the ribs
    return {
        "mass": ca.diag(ca.vertcat(carriage, chuck)),
        "stiffness": stiffness * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": damping,  # of every flexible mode; or "damping": a matrix
        "input": ca.DM([1, 0]),  # the motor pushes the carriage
        "output": ca.DM([[0.3, 0.7]]),  # the encoder sits between the two
        "hardware_cost": carriage + chuck,  # what is to be small: here the mass in kg
        "constraints": {"plate too thin for the motor": 6.0 - theta["plate"]},  # met where <= 0
    }
