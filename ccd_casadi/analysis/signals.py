"""A loop over time: its poles, a step of the reference, a move."""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.analysis.move import Move, free_plant, mass_feedforward, moves
from ccd_casadi.analysis.move_limits import LIMITS, WINDOW
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.lti.loop import Loop, constant_drive
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.support.arrays import Array

STEP_POINTS = 240
STEP_PERIODS = 5.0  # of the bandwidth
WATCHED = 2.0  # durations of the move that are shown
NONE = np.zeros(0)
AT_REST = Move(NONE, NONE, NONE, NONE, np.zeros((0, 1)), False, 0.0, WINDOW)


@dataclass(frozen=True)
class Signals:
    """Poles of the closed loop in rad/s; y of the first output (s) after a step of its reference.

    Of a sampled loop the poles are ln(z)/T. An unstable one has no step and no move (`AT_REST`).
    """

    poles: np.ndarray
    step_time: Array
    step: Array
    move: Move


def step_response(
    loop: Loop, direction: Array, seconds: float, points: int
) -> tuple[Array, Array]:
    """Times (k,) in s and y (k, p) after a unit step of the reference in `direction` (p,).

    Exact at the instants: those of a sampled loop, or `points` of a continuous one.
    """
    steps = loop.over_a_step(seconds / (points - 1))
    count = points if loop.sampling is None else int(np.ceil(seconds / steps.period)) + 1
    y = constant_drive(steps, steps.B_r @ direction, count)
    return np.asarray(np.arange(count) * steps.period), y.T


def signals_of(loop: Loop, modal: ModalPlant, bandwidth_hz: float) -> Signals:
    """Of a loop on a plant; `modal` is that plant without its suspension, for the move."""
    if not loop.stable:
        return Signals(loop.poles, NONE, NONE, AT_REST)
    first = np.eye(len(loop.plant.C))[0]
    time, y = step_response(loop, first, STEP_PERIODS / bandwidth_hz, STEP_POINTS)
    free = Loop(free_plant(modal), loop.controller, loop.sampling)
    ((made,),) = moves(
        [loop], [free], [mass_feedforward(modal, 0)], setpoint(LIMITS), axis=0, window=WINDOW,
        bandwidth_hz=bandwidth_hz, doublings=1,
    )  # fmt: skip
    return Signals(loop.poles, time, y[:, 0], made.until(WATCHED * made.duration))
