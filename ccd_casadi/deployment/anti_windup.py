"""Back-calculation while a controller saturates, and a start without a jump.

The controller watches the force that it could apply, not the one that it asked for:

    v_k = C x_k + D e_k + f_k,   u_k = clip(v_k),   x_{k+1} = A x_k + B e_k + L (u_k - v_k).

Between the limits nothing changes. Beyond them the states follow A - L C instead of A: the
integrator is led back (back-calculation, Åström & Wittenmark 1997, 3.5), and poles of K outside the
unit circle are held too. L is the gain of the stationary Kalman filter that estimates the
controller's states from its own force, the errors e being white of the size that asks for the whole
limit at ω_b, and the force being off by a share of the limit, `TRUSTS`: A - L C is stable wherever
K has no unobservable unstable state. As the share goes to 0 its poles go to K's zeros inside the
circle (the conditioning technique, Hanus, Kinnaert & Henrotte 1987), as it grows to K's own poles.

A controller that takes over from another begins at x₀ = X [e₀; u₀]: its first force is u₀, and of
all such states it is the one that changes least in the first sample, min ‖(A - I) x + B e‖ (with
an integrator: not at all, where e₀ = 0).
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import lstsq, null_space, solve_discrete_are

from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

# Error of the force, as the filter sees it, over the limit. On rigid stages with PID, 0.01 to 0.1
# settle alike and sooner than 1; the others are tried where the Riccati equation fails.
TRUSTS = (0.1, 0.01, 1.0)


def with_anti_windup(realisation: Realisation, bandwidth: float) -> Realisation:
    """The same with back-calculation where it has a saturation; ω_b in rad/s."""
    if realisation.saturation is None:
        return realisation
    L = back_calculation(realisation.system, realisation.saturation, bandwidth)
    return replace(realisation, back_calculation=L)


def back_calculation(K: StateSpace, limit: float, bandwidth: float) -> Array:
    """L (n, m) for a limit in N and ω_b in rad/s; raises UserError where K has no such gain."""
    n, m = K.B.shape[0], K.C.shape[0]
    if not n:
        return np.zeros((0, m))
    gain = np.abs(K.response(np.array([bandwidth]))[0]).max()
    noise = K.B / gain  # in units of the limit, as all forces here: L does not depend on it
    for trust in TRUSTS:
        weight = trust**2 * np.eye(m)
        try:
            P = solve_discrete_are(K.A.T, (K.C / limit).T, noise @ noise.T, weight)
        except np.linalg.LinAlgError:
            continue
        spread = K.C @ P @ K.C.T / limit**2 + weight
        L = np.linalg.solve(spread, K.C @ P @ K.A.T).T / limit**2
        if np.abs(np.linalg.eigvals(K.A - L @ K.C)).max() < 1.0:
            return np.asarray(L)
    if np.abs(np.linalg.eigvals(K.A)).max() < 1.0:
        return np.zeros((n, m))  # its states need no help to come back
    raise UserError(
        "no anti-windup gain was found: the controller may have an unstable mode that its force "
        "does not show; deploy without --saturation"
    )


def takeover(K: StateSpace) -> Array:
    """X (n, p + m): the state [e₀; u₀] -> x₀ from which the first force is u₀ and least moves on.

    min ‖(A - I) x + B e‖ subject to C x = u - D e; where C has dependent rows (no state can make
    two forces apart) the force is met in the least squares.
    """
    n, p = K.B.shape
    m = len(K.C)
    if not n:
        return np.zeros((0, p + m))
    wanted = np.hstack([-K.D, np.eye(m)])  # C x for unit [e; u]
    particular = np.asarray(lstsq(K.C, wanted)[0])
    free = null_space(K.C)
    if not free.size:
        return particular
    moved = (K.A - np.eye(n)) @ particular + np.hstack([K.B, np.zeros((n, m))])
    return particular - free @ np.asarray(lstsq((K.A - np.eye(n)) @ free, moved)[0])
