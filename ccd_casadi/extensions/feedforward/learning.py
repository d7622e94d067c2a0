"""Learning on the machine: coefficients from the error of a move that was made.

With the model's responses Ψ to the coefficients F of the feedforward's first tap (columns, all
instants and outputs one below the other) and the controller's error e_j = r̃ - y in move j,

    F_{j+1} = F_j + Ψ⁺ e_j,        F_{j+1} - F* = (I - Ψ⁺ P)(F_j - F*)

where P are the true responses and F* has Ψ⁺ e = 0: the least error that the model can tell from
noise. It converges on a plant whose ρ = max |eig(I - Ψ⁺ P)| is less than 1, whatever the error is.

Source: iterative learning with basis functions, van de Wijdeven and Bosgra, Int. J. Control 83
(2010), 661-675.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.extensions.feedforward.move_responses import MoveResponses, Shape
from ccd_casadi.support.arrays import Array


def learning_gain(model: MoveResponses, shape: Shape) -> Array:
    """Ψ⁺, from the error of a move to what is added to the forces of the coefficients.

    Parameters
    ----------
    model : MoveResponses
        Of the model, with all taps.
    shape : Shape

    Returns
    -------
    (c, N q) array
        For the forces of the first tap.
    """
    psi = _first(model, shape)
    size = np.abs(psi).max(axis=0)  # derivatives of the setpoint differ by many decades
    return np.asarray(np.linalg.pinv(psi / size) / size[:, None])


def learned(x: Array, error: Array, gain: Array, shape: Shape) -> Array:
    """Coefficients after a move with a controller's error (N, q), unit of y."""
    found = x.copy()
    found[shape.taps : shape.taps + len(gain)] += gain @ error.ravel()
    return found


def contraction(plants: Sequence[MoveResponses], gain: Array, shape: Shape) -> float:
    """ρ, the largest of all plants: less than 1 where learning converges on each.

    Parameters
    ----------
    plants : sequence of MoveResponses
        With all taps.
    gain : (c, N q) array
    shape : Shape

    Returns
    -------
    float
    """
    one = np.eye(len(gain))
    return max(float(np.abs(np.linalg.eigvals(one - gain @ _first(plant, shape))).max())
               for plant in plants)  # fmt: skip


def least_error(plant: MoveResponses, x: Array, shape: Shape) -> float:
    """The least RMS of the controller's error that other forces of the first tap leave: what
    learning can reach."""
    psi = _first(plant, shape)
    size = np.abs(psi).max(axis=0)
    left = plant.tracking(x, shape).ravel()
    found = left - psi / size @ np.linalg.lstsq(psi / size, left)[0]
    return float(np.sqrt(np.mean(found**2)))


def _first(plant: MoveResponses, shape: Shape) -> Array:
    """Responses (N q, c) to the forces of the first tap."""
    count = len(shape.orders) * shape.forces
    own = plant.reached[..., shape.taps : shape.taps + count]
    return np.asarray(own.reshape(-1, count))
