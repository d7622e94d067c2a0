"""∫ f(x) dx over panels by Gauss and Kronrod's rules of 7 and 15 points, bisected where needed.

In ln x, in which the responses of loops are smooth over a panel. The difference of the two rules
bounds the error with much to spare; it is what is reported. (Piessens et al. 1983, QUADPACK.)
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ccd_casadi.support.arrays import Array

RELATIVE = 1e-9  # error of the whole that ends the bisections
ROUNDS = 40
MOST = 200_000  # evaluations
# Nodes and weights of Kronrod's rule, and those of Gauss's within it (QUADPACK's QK15).
_X = np.array([0.991455371120812639, 0.949107912342758524,
               0.864864423359769072, 0.741531185599394439,
               0.586087235467691130, 0.405845151377397166,
               0.207784955007898467, 0.0])  # fmt: skip
_W = np.array([0.022935322010529224, 0.063092092629978553,
               0.104790010322250183, 0.140653259715525918,
               0.169004726639267902, 0.190350578064785409,
               0.204432940075298892, 0.209482141084727828])  # fmt: skip
_G = np.array([0.129484966168869693, 0.279705391489276667,
               0.381830050505118944, 0.417959183673469387])  # fmt: skip
NODES = np.concatenate([-_X[:-1], _X[::-1]])
KRONROD = np.concatenate([_W[:-1], _W[::-1]])
GAUSS = np.zeros(15)
GAUSS[1::2] = np.concatenate([_G[:-1], _G[::-1]])


@dataclass(frozen=True)
class Integral:
    """Values (rows,) with error estimates; `ends` (k + 1,) of the panels, their shares (rows, k).

    `nodes` and `weights` (N,) make the same sums of any other integrand as smooth.
    """

    value: Array
    error: Array
    ends: Array
    parts: Array
    nodes: Array
    weights: Array

    def cumulative(self) -> Array:
        """The integral from the lowest frequency to each of `ends`, (rows, k + 1)."""
        return np.concatenate(
            [np.zeros((len(self.parts), 1)), np.cumsum(self.parts, axis=1)], axis=1
        )


def integrate(f: Callable[[Array], Array], ends: Array, *, relative: float = RELATIVE) -> Integral:
    """Rows f(x) (rows, len(x)) over the panels between `ends`, rising and above 0."""
    low, high = np.log(ends[:-1]), np.log(ends[1:])
    done: list[Array] = []  # low, high, shares and errors of panels, by column
    spent = 0
    for turn in range(ROUNDS):
        x, weights = _points(low, high)
        value = f(x.ravel())
        value = value.reshape(len(value), *x.shape) * weights
        spent += x.size
        part, rows = value @ KRONROD, len(value)
        error = np.abs(value @ (KRONROD - GAUSS))
        total = part.sum(1) + sum(item[2 : 2 + rows].sum(1) for item in done)
        allowed = relative * np.abs(total)[:, None] / (4 * len(ends))
        wide = (error > np.maximum(allowed, 1e-15 * np.abs(part))).any(0)
        if turn == ROUNDS - 1 or spent > MOST:
            wide[:] = False
        done.append(np.vstack([low, high, part, error])[:, ~wide])
        if not wide.any():
            break
        middle = 0.5 * (low + high)[wide]
        low, high = np.concatenate([low[wide], middle]), np.concatenate([middle, high[wide]])
    found = np.hstack(done)
    low, high, *both = found[:, np.argsort(found[0])]
    part, error = np.split(np.array(both), 2)
    x, weights = _points(low, high)
    return Integral(
        part.sum(1), error.sum(1), np.exp(np.append(low, high[-1])), part, x.ravel(),
        (weights * KRONROD).ravel(),
    )  # fmt: skip


def _points(low: Array, high: Array) -> tuple[Array, Array]:
    """Nodes x (k, 15) of the panels, and dx of each over its weight."""
    middle, half = 0.5 * (low + high)[:, None], 0.5 * (high - low)[:, None]
    x = np.exp(middle + half * NODES)
    return x, half * x
