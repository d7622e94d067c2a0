"""The two-mass bench as an uncertain plant."""

import numpy as np

from ccd_casadi.extensions.drives.cascade import Cascade
from ccd_casadi.extensions.drives.drive_data import read_drive
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import given_decoupling, sensors_on_one_actuator
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.text import HZ

RATE = Sampling(rate_hz=8000.0, delay_us=375.0)
SENSORS = given_decoupling(("motor", "load"), [[1, 0], [0, 1]], [[1], [1]])


def uncertain(**box: object) -> UncertainPlant:
    k, none = 0.0771 * (147.0 * HZ) ** 2, np.zeros((0, 2, 2))
    bench = Mechanics(
        np.diag([0.0329, 0.0771]), np.array([[3.2, -2.5], [-2.5, 2.5]]),
        k * np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([[1.0], [0.0]]), np.eye(2), None,
        (none, none, none, np.zeros((0, 2, 1)), none),
    )  # fmt: skip
    return UncertainPlant((bench,), 4e3, **{"resonance_shift": 0.03, **box})  # type: ignore[arg-type]


def bounds(S_max: float = 2.0, **other: object) -> Bounds:
    return Bounds(**{
        "S_max": S_max, "S_low": 0.3, "omega_low": 2.0 * HZ, "shape": 1.1, "error": 1,
        "channels": sensors_on_one_actuator(SENSORS, S_max), **other,
    })  # fmt: skip


def cascade(name: str = "generic", current: int = 1, setpoint: int = 1) -> Cascade:
    drive = read_drive(name)
    slots = (*drive.places("current")[:current], *drive.places("setpoint")[:setpoint])
    return Cascade(drive, RATE.period, slots, 1, 0, 2, filter_gain=3.0)


# Kv, Kp, Tn and two filters: 40 Hz with |S| below 2.5 everywhere on the set
SLOW = np.array([220.0, 22.0, 0.1, 1000.0, 0.7, 1100.0, 0.7, 400.0, 0.7, 420.0, 0.7])
