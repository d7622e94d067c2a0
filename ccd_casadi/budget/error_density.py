"""The densities of error and force over frequency, and their integrals.

    S_e(f) = ‖H_e(f)‖² S(f),   σ² = ∫ S_e df

with H of `sources`. In a sampled loop S, T and K are those of z = e^{jωT} and the disturbed G is
the continuous one: S_e is then the density of the samples before it is folded to below half the
rate, and its integral over all f their variance, aliases included.

Integrals are over ln f, in which responses are smooth, by Gauss and Kronrod's rules of 7 and 15
points on panels that are bisected where needed; the difference of the two, which bounds the error
with much to spare, is what is reported (Piessens et al. 1983, QUADPACK).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.budget.noise_process import FORCES, process
from ccd_casadi.budget.sources import ErrorSource, SourceKind
from ccd_casadi.lti.frequency_grid import frequency_grid, root_flanks
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.ports import Ports
from ccd_casadi.lti.state_space import sensitivity, strictly_proper
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ

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
class QuadratureOptions:
    """Numbers of the adaptive quadrature.

    Attributes
    ----------
    tolerance : float
        Relative error of the whole that ends the bisections.
    rounds : int
        Largest number of bisections of a panel.
    most_evaluations : int
        Nodes after which no panel is bisected any more.
    trusted : float
        Relative difference of Lyapunov's equation beyond which the integral counts: states far
        apart in scale, as of a gain of 1e11 N/m, leave the equation no digits.
    """

    tolerance: float = 1e-9
    rounds: int = 40
    most_evaluations: int = 200_000
    trusted: float = 1e-3


def has_lost_digits(disagreement: float, options: QuadratureOptions = QuadratureOptions()) -> bool:
    """Whether Lyapunov's equation has lost its digits, so that the integral counts."""
    return options.trusted < disagreement < np.inf


@dataclass(frozen=True)
class Integral:
    """Values (rows,) with error estimates; `ends` (k + 1,) of panels, their parts (rows, k)."""

    value: Array
    error: Array
    ends: Array
    parts: Array

    def cumulative(self) -> Array:
        """The integral from the lowest frequency to each of `ends`, (rows, k + 1)."""
        return np.pad(np.cumsum(self.parts, axis=1), ((0, 0), (1, 0)))


def integrate(
    f: Callable[[Array], Array],
    ends: Array,
    counted: int | None = None,
    *,
    options: QuadratureOptions = QuadratureOptions(),
) -> Integral:
    """Rows f(x) (rows, len(x)) over the panels between `ends`, rising and above 0.

    Panels are halved until the first `counted` rows, or all, are as exact as required: further
    rows, such as derivatives of the first, are summed on the same nodes.
    """
    low, high = np.log(ends[:-1]), np.log(ends[1:])
    done: list[Array] = []  # low, high, shares and errors of panels, by column
    spent = 0
    for turn in range(options.rounds):
        x, weights = _points(low, high)
        value = f(x.ravel())
        value = value.reshape(len(value), *x.shape) * weights
        spent += x.size
        part, rows = value @ KRONROD, len(value)
        error = np.abs(value @ (KRONROD - GAUSS))
        total = part.sum(1) + sum(item[2 : 2 + rows].sum(1) for item in done)
        allowed = options.tolerance * np.abs(total)[:, None] / (4 * len(ends))
        wide = (error > np.maximum(allowed, 1e-15 * np.abs(part)))[:counted].any(0)
        if turn == options.rounds - 1 or spent > options.most_evaluations:
            wide[:] = False
        done.append(np.vstack([low, high, part, error])[:, ~wide])
        if not wide.any():
            break
        middle = 0.5 * (low + high)[wide]
        low, high = np.concatenate([low[wide], middle]), np.concatenate([middle, high[wide]])
    found = np.hstack(done)
    low, high, *both = found[:, np.argsort(found[0])]
    part, error = np.split(np.array(both), 2)
    return Integral(part.sum(1), error.sum(1), np.exp(np.append(low, high[-1])), part)


def _points(low: Array, high: Array) -> tuple[Array, Array]:
    """Nodes x (k, 15) of the panels, and dx of each over its weight."""
    middle, half = 0.5 * (low + high)[:, None], 0.5 * (high - low)[:, None]
    x = np.exp(middle + half * NODES)
    return x, half * x


@dataclass(frozen=True)
class PanelOptions:
    """Numbers of the panels of the quadrature over frequency."""

    lowest: float = 1e-9  # end of a white spectrum, over the slowest pole
    highest: float = 1e4  # its other end, over the fastest
    per_decade: int = 6  # panels at least, as a curve is drawn through their ends
    flanks: tuple[float, ...] = (-10.0, -3.0, -1.0, 1.0, 3.0, 10.0)  # in half widths of a root


@dataclass(frozen=True)
class Responses:
    """G and K as in the loop, S = (1 + GK)⁻¹, S G of the disturbed G, of what counts but no sensor
    sees the parts of u and of d, and the force that actuators make of u, (k, ·, ·)."""

    G: np.ndarray
    K: np.ndarray
    free: np.ndarray
    S: np.ndarray
    moved: np.ndarray
    ports: Ports
    beyond: tuple[np.ndarray, np.ndarray] | None = None
    given: np.ndarray | None = None

    def respond_to(self, kind: SourceKind) -> np.ndarray:
        """Compute the response of the controller's input to a source."""
        if kind in FORCES:
            return -self.moved
        return self.S @ self.ports.reference if kind is SourceKind.SETPOINT else -self.S

    def of(self, kind: SourceKind) -> tuple[np.ndarray, np.ndarray]:
        """H_e, and H_u of the force that the machine gets, of a source."""
        seen = self.respond_to(kind)
        force = self.K @ seen
        true = np.eye(seen.shape[1]) + seen if kind is SourceKind.SENSOR_NOISE else seen
        true = self.ports.wanted @ self.ports.rows @ true
        if self.beyond is not None:
            of_u, of_d = self.beyond
            true = true - of_u @ force - (of_d if kind in FORCES else 0.0)
        return true, force if self.given is None else self.given @ force


def responses(loop: Loop, hz: Array) -> Responses:
    """Evaluate a loop's responses.

    Parameters
    ----------
    loop : Loop
    hz : array (k,)
        Hz.

    Returns
    -------
    Responses
    """
    omega = HZ * np.asarray(hz, float)
    G, K = loop.run_responses(omega)
    plant, ports = loop.plant, loop.ports
    own = ports.drive is plant.B  # then what is known of the plant serves
    disturbed = plant if own else strictly_proper(plant.A, ports.drive, plant.C)
    free = disturbed.sweep(omega) if loop.sampling or loop.drive is not None else G
    if G.shape[1] == G.shape[2]:
        S = sensitivity(G @ K)
        moved = S @ free
    else:  # of more sensors G K is a product of low rank, and 1 + G K singular to rounding
        inner = np.linalg.inv(np.eye(G.shape[2]) + K @ G)
        S = np.eye(G.shape[1]) - G @ inner @ K
        moved = G @ inner if free is G else free - G @ inner @ K @ free
    found = Responses(G, K, free, S, moved, ports)

    def of_u(rows: Array) -> np.ndarray:
        reading = strictly_proper(plant.A, plant.B, rows)
        return replace(loop, plant=reading).run_responses(omega)[0]

    if ports.force is not None:
        found = replace(found, given=of_u(ports.force))
    if ports.beyond is None:
        return found
    of_d = strictly_proper(plant.A, ports.drive, ports.beyond)
    return replace(found, beyond=(of_u(ports.beyond), of_d.sweep(omega)))


def densities(loop: Loop, source: ErrorSource) -> Callable[[Array], Array]:
    """f in Hz -> (S_e, S_u) as rows, of all channels together; one-sided, m²/Hz and N²/Hz."""
    if loop.sampling is not None and source.shaped:
        return _fold(loop, source, loop.sampling.period)

    def at(hz: Array) -> Array:
        found = responses(loop, hz).of(source.kind)
        gains = np.array([(np.abs(H) ** 2).sum((1, 2)) for H in found])
        return np.asarray(gains * source.density(hz))

    return at


def _fold(loop: Loop, source: ErrorSource, T: float) -> Callable[[Array], Array]:
    """The densities of the samples below half the rate, with all that is folded into them."""
    model = process(loop, source).balance()

    def at(hz: Array) -> Array:
        z = np.expm1(1j * HZ * hz * T)
        resolvent = np.linalg.inv(z[:, None, None] * np.eye(len(model.A)) - model.A)
        found = []
        for out, direct in ((model.C, 0.0 * (model.C @ model.E)), (model.F, model.V)):
            H = out @ resolvent
            white = H @ model.E + direct
            both = np.einsum("kij,jl,kil->k", H, model.Q, H.conj(), optimize=True).real
            found.append(2.0 * T * (both + (np.abs(white) ** 2).sum((1, 2))))
        return np.array(found)

    return at


def panels(loop: Loop, source: ErrorSource, *, options: PanelOptions = PanelOptions()) -> Array:
    """Rising frequencies in Hz between which the densities are smooth, from end to end.

    A table's own range. What is white reaches from far below the slowest to far above the fastest
    pole, in a sampled loop to half the rate, beyond which the noise of samples is not counted.
    """
    roots = np.concatenate([loop.poles, loop.plant.poles, loop.controller.poles])
    sizes = np.abs(roots[np.abs(roots) > 1e-9 * np.abs(roots).max()])
    corners = source.corners()
    if source.shaped:
        bends = np.concatenate([sizes, corners])
        low, high = options.lowest * bends.min(), options.highest * bends.max()
        if loop.sampling is not None:
            high = np.pi / loop.sampling.period
            low = min(low, 1e-6 * high)
    else:
        low, high = corners[0], corners[-1]
    points = 2 + int(options.per_decade * np.log10(high / low))
    special = (corners, sizes, root_flanks(roots, options.flanks))
    return np.asarray(frequency_grid(low, high, points, *special, apart=1e-9) / HZ)


def integrate_densities(
    loop: Loop, source: ErrorSource, weight: Callable[[Array], Array]
) -> Integral:
    """∫ w(f) S_e df and ∫ S_u df; rows S_e, S_u and w S_e. In Hz, m² and N²."""
    both = densities(loop, source)

    def rows(hz: Array) -> Array:
        error, force = both(hz)
        return np.array([error, force, weight(hz) * error])

    return integrate(rows, panels(loop, source))
