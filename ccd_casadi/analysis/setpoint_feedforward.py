"""Feedforward of a setpoint: the force that moves a plant without its controller.

u = F_0 r + Σ_i F_i r^(i), of the Taylor coefficients of the inverse of the plant behind hold and
delay. A force that is held for a period takes the mean of each derivative over that period.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.ports import BreakPoint, course
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class FeedforwardOptions:
    """Numbers of the feedforward.

    Attributes
    ----------
    order : int
        Highest derivative of the setpoint.
    points : int
        On the circle of Cauchy's integral.
    radius : float
        Of the circle, over the nearest singularity of the inverse.
    rounding : float
        Of the inverse on the circle: a coefficient that is less there is 0.
    zero : float
        Over the fastest pole: a zero of the plant that is nearer to s = 0 counts as there.
    slow : float
        Over the slowest pole: where inputs are shared among more of them than outputs.
    """

    order: int = 4
    points: int = 64
    radius: float = 0.25
    rounding: float = 1e-11
    zero: float = 1e-9
    slow: float = 1e-3


def feedforward(plant: StateSpace, period: float, delay: float) -> Array:
    """Gains of the feedforward of a setpoint, u = F_0 r + Σ_i F_i mean r^(i), as `forward_force`.

    A force that is held for a period has to be the mean of what is needed over it, which a jerk or
    snap that jumps inside makes of the means of the derivatives. With x = sT/2 the hold is
    (1 - e^(-sT))/(sT) = e^(-sT/2) sinh(x)/x, and the mean of s^i r over a period about the instant
    s^i sinh(x)/x r. So y = r at the instants up to s⁴, behind a delay τ, where

        F_0 + Σ_i F_i s^i sinh(x)/x = e^(s(τ + T/2)) x/sinh(x) G(s)⁻¹:

    F_0 is the right side at s = 0, and F_i the Taylor coefficients of x/sinh(x) (right side - F_0).
    They are Cauchy's integrals on a circle within which these are analytic: its aliasing error is
    radius^(points - order). Free bodies have F_0 = 0, without dampers F_1 = 0.

    Parameters
    ----------
    plant : StateSpace
        m inputs and p <= m outputs, SI.
    period, delay : float
        s.

    Returns
    -------
    (order + 1, m, p) array
        N per unit of y and s.

    Raises
    ------
    UserError
        The plant has a zero at s = 0: no finite force holds a position; or more outputs than
        inputs.
    """
    share = _allocation(plant)
    square = replace(plant, B=plant.B @ share, D=plant.D @ share)
    return np.asarray(share @ feedforward_slopes(square, (), period, delay)[0])


def _allocation(plant: StateSpace, options: FeedforwardOptions = FeedforwardOptions()) -> Array:
    """The inputs (m, p) that move each output alone when slow, with the least forces: G(0)⁺, or of
    free bodies its limit but for a factor. Constants, so that the inverse of what they leave is
    analytic."""
    (_, m), p = plant.B.shape, len(plant.C)
    if p > m:
        raise UserError(f"the plant has {p} outputs and {m} inputs: no feedforward moves one alone")
    if p == m:
        return np.eye(m)
    poles = np.abs(plant.poles)
    moving = poles[poles > options.rounding * poles.max()]
    slow = options.slow * moving.min(initial=np.inf)
    return np.linalg.pinv(plant.response(np.array([slow if moving.size else 1.0]))[0].real)


def feedforward_slopes(
    plant: StateSpace,
    changes: Sequence[tuple[Array, Array, Array]],
    period: float,
    delay: float,
    options: FeedforwardOptions = FeedforwardOptions(),
) -> tuple[Array, Array]:
    """F, and dF (k, order + 1, m, p) of k changes (dA, dB, dC) of a square plant; its D stays.

    They are linear in G⁻¹, and with X = (s - A)⁻¹B

        dG⁻¹ = -G⁻¹ dG G⁻¹,   dG = dC X + C (s - A)⁻¹ (dA X + dB).
    """
    count, terms = options.points, options.order + 1
    poles = np.abs(plant.poles)
    fastest = float(poles.max())  # 0 of masses alone, whose inverse is analytic everywhere
    # The inverse is singular at zeros of the plant; without any the fastest pole is a scale.
    nearest = min([*np.abs(plant.zeros(fastest or 1.0)), fastest or np.inf])
    if not nearest > options.zero * fastest:
        raise UserError("the plant has a zero at 0 Hz: no feedforward of the setpoint exists")
    late = delay + 0.5 * period
    stays = 1.0 / late if late > 0.0 else max(fastest, 1.0)  # where exp stays of size one
    radius = min(options.radius * nearest, stays)
    s = radius * np.exp(2j * np.pi * np.arange(count) / count)
    s_A = s[:, None, None] * np.eye(len(poles)) - plant.A
    X = np.linalg.solve(s_A, plant.B + 0j)
    inverse = np.linalg.inv(plant.C @ X + plant.D)
    x = 0.5 * period * s
    unheld = (x / np.sinh(x) if period else np.ones_like(s))[:, None, None]
    ahead = unheld * np.exp(s * late)[:, None, None]

    def coefficients(values: np.ndarray) -> Array:
        """Taylor coefficients by the mean over the circle, from values (count, m, p) of G⁻¹."""
        at_rest = (ahead * values).mean(axis=0)  # F_0, of r itself, which is not a mean
        found = np.fft.fft(unheld * (ahead * values - at_rest), axis=0).real[:terms] / count
        found[0] += at_rest.real
        size = np.abs(values).max(axis=0)
        size = np.minimum(size.max(axis=0), size.max(axis=1)[:, None])  # whatever the units
        found[np.abs(found) <= options.rounding * size] = 0.0
        return np.asarray(found / radius ** np.arange(terms)[:, None, None])

    dF = np.zeros((len(changes), terms, *inverse.shape[1:]))
    for i, (dA, dB, dC) in enumerate(changes):
        dG = dC @ X + plant.C @ np.linalg.solve(s_A, dA @ X + dB)
        dF[i] = coefficients(-inverse @ dG @ inverse)
    return coefficients(inverse), dF


def forward_of(
    plant: StateSpace, period: float, delay: float, places: Sequence[BreakPoint]
) -> Array:
    """Compute `feedforward` of a plant that may have several sensors on its actuator.

    Parameters
    ----------
    plant : StateSpace
        SI.
    period, delay : float
        s.
    places : sequence of BreakPoint
        Of several sensors on one actuator; else empty.

    Returns
    -------
    array (5, m, p)
        F of `feedforward`; of several sensors that of the output that counts, in the column of each
        sensor times its share in that.
    """
    if not places:
        return feedforward(plant, period, delay)
    row = np.array([places[0].output])
    return feedforward(replace(plant, C=row @ plant.C, D=row @ plant.D), period, delay) * row


def forward_gains(
    forward: Array | None, inputs: int, reference: Array, axis: int,
    places: Sequence[BreakPoint] = (),
) -> Array:  # fmt: skip
    """Select the feedforward of one output.

    Parameters
    ----------
    forward : array (5, m, p) or None
        Of `forward_of`; None: there is none.
    inputs : int
        m.
    reference : array (p,)
        As of `course`.
    axis : int
        The output, from 0.
    places : sequence of BreakPoint
        Of several sensors on one actuator; else empty.

    Returns
    -------
    array (5, m)
        F of `forward_force`, 0 without any.
    """
    if forward is None:
        return np.zeros((5, inputs))
    return np.asarray(forward @ reference if places else forward[:, :, axis])


def feedforward_of(loop: Loop, axis: int) -> Array | None:
    """Compute the feedforward of one output of a loop as it runs, that of `solve` and `deploy`.

    Parameters
    ----------
    loop : Loop
        SI.
    axis : int
        The output, from 0.

    Returns
    -------
    array (5, m) or None
        F of `forward_force`; None where the plant has none.
    """
    run = loop.sampling
    hold = (0.0, 0.0) if run is None else (run.period, run.delay)
    try:
        forward = forward_of(loop.plant, *hold, loop.at)
    except UserError:
        return None
    reference = course(loop.plant, axis, loop.at)[1]
    return forward_gains(forward, loop.plant.B.shape[1], reference, axis, loop.at)


def held_setpoint(profile: Setpoint, time: Array, period: float) -> Array:
    """Sample r and four derivatives as `feedforward` takes them, for a force that is held.

    Of each derivative the mean over a period about the instant, (r^(i-1)(t + T/2) -
    r^(i-1)(t - T/2))/T: a snap that jumps between two instants is felt in its share.

    Parameters
    ----------
    profile : Setpoint
    time : array (N,)
        s.
    period : float
        T in s, above 0.

    Returns
    -------
    array (5, N)
        r in m and its derivatives in m/s^i.
    """
    r, half = profile.at(time), 0.5 * period
    r[1:] = (profile.at(time + half)[:4] - profile.at(time - half)[:4]) / period
    return r


def forward_force(
    profile: Setpoint, forward: Array, time: Array, period: float
) -> tuple[Array, Array]:
    """Compute the setpoint and the force ahead that is held for a period from each instant on.

    Parameters
    ----------
    profile : Setpoint
    forward : array (5, m)
        F of `feedforward`, N per unit of y and s.
    time : array (N,)
        s.
    period : float
        s.

    Returns
    -------
    r : array (N,)
        In the unit of y.
    force : array (N, m)
        F_0 r + Σ_i F_i mean r^(i), N.
    """
    r = held_setpoint(profile, time, period)
    return r[0], r.T @ forward
