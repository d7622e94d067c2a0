"""What a finished loop survives, computed in every solve: cheap figures from the loop itself.

Ranges of a common shift of all flexible resonances and of a factor of their damping in which the
loop stays stable (closed-loop eigenvalues) and |S| within S_max (frequency responses), classical
margins, right-half-plane poles of the controller, and what a static force moves (`statics`). The
`robustness` command looks closer; this is what no verdict should be without.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.modal import ModalPlant, Perturbation, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import StateSpace, scale_plant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.classical_margins import ClassicalMargins, classical_margins
from ccd_casadi.synthesis.statics import Statics, statics

REACH = 0.5  # of the frequency: how far a shift is followed
FACTORS = (0.1, 10.0)  # of the damping
PLACES = np.geomspace(1e-4, 1.0, 25)  # of the reach, where a range is probed; then bisected
BISECTIONS = 12
PEAK = 1e-4  # relative: what S_max may be passed by within its range; the grid resolves no less
POINTS = 300  # of the frequency grid, besides those around the loop's poles
FLANKS = np.array([0.0, 0.3, 0.7, 1.5])


@dataclass(frozen=True)
class Survival:
    """Ranges as (low, high) around the model; relative shifts, factors of damping.

    A range that ends at `REACH` or `FACTORS` was not followed further. Margins are the least of
    all loops broken one at a time at the plant's inputs: `gain` up and down as factors,
    `phase_deg`, `delay` in s, and `modulus` = 1/‖S‖∞ on the grid. `unstable_poles_hz`: |p|/2π of
    the controller's poles in the right half plane.
    """

    stable_shift: tuple[float, float]
    S_max_shift: tuple[float, float]
    stable_damping: tuple[float, float]
    gain: tuple[float, float]
    phase_deg: float
    delay: float
    modulus: float
    unstable_poles_hz: tuple[float, ...]
    statics: Statics


def survival(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace, bandwidth: float
) -> Survival:
    """The figures of a stable loop at θ; the controller in SI (e in, u out), ω_b in rad/s."""
    system = mechanics(plant_of(problem), theta)

    def modal(perturbation: Perturbation) -> ModalPlant:
        return modal_plant(system, problem.suspension, perturbation)

    # Both matrices are known functions of shift and damping: no need to ask the model again.
    plant = modal(Perturbation())
    per_shift = (modal(Perturbation(shift=0.5)).D - plant.D) / 0.5
    per_damping = modal(Perturbation(damping=2.0)).D - plant.D
    flexible = np.where(plant.rigid, 0.0, np.diag(plant.K))

    def shifted(s: float) -> _Loop:
        K = plant.K + np.diag(((1.0 + s) ** 2 - 1.0) * flexible)
        return _Loop(K, plant.D + s * per_shift, plant.B, plant.C, controller)

    def damped(d: float) -> _Loop:
        return _Loop(plant.K, plant.D + (d - 1.0) * per_damping, plant.B, plant.C, controller)

    nominal = shifted(0.0)
    grid = nominal.grid()
    respond = _ControllerResponse(controller)
    S = nominal.sensitivity(grid, respond)
    S_max = max(problem.inner.S_max, float(_largest(S).max())) * (1.0 + PEAK)

    def within(loop: _Loop) -> bool:
        if not loop.stable():
            return False
        return float(_largest(loop.sensitivity(loop.grid(), respond)).max()) <= S_max

    def shifts(good: Callable[[_Loop], bool], places: Array) -> tuple[float, float]:
        def end(sign: float) -> float:
            return sign * _reach(lambda r: good(shifted(sign * r)), REACH * places)

        return end(-1.0), end(1.0)

    def factor(end: float) -> float:
        size = abs(math.log(end))
        sign = math.copysign(1.0, math.log(end))
        return math.exp(
            sign * _reach(lambda r: damped(math.exp(sign * r)).stable(), size * PLACES[8:])
        )

    stable = shifts(_Loop.stable, PLACES)
    margins = _margins(nominal, respond, grid)
    poles = np.linalg.eigvals(controller.A)
    unstable = poles[(poles.real > 1e-9 * np.abs(poles)) & (poles.imag >= 0.0)]
    return Survival(
        stable_shift=stable,
        S_max_shift=shifts(within, PLACES[::2]),
        stable_damping=(factor(FACTORS[0]), factor(FACTORS[1])),
        gain=(max(m.gain_down for m in margins), min(m.gain_up for m in margins)),
        phase_deg=min(m.phase_deg for m in margins),
        delay=min(m.delay for m in margins),
        modulus=float(1.0 / _largest(S).max()),
        unstable_poles_hz=tuple(sorted(float(abs(p)) / HZ for p in unstable)),
        statics=statics(
            scale_plant(plant, problem.weights.M_K).plant_si(),
            controller,
            bandwidth=bandwidth,
            omega_low=problem.inner.omega_low,
        ),
    )


@dataclass(frozen=True)
class _Loop:
    """q̈ + D q̇ + K q = B u, y = C q with u = -K(s) y."""

    K: Array
    D: Array
    B: Array
    C: Array
    controller: StateSpace

    def poles(self) -> np.ndarray:
        """Closed-loop poles, 1/s; velocities in units in which a mode's energy is even."""
        c, n = self.controller, len(self.K)
        scale = np.sqrt(np.maximum(np.diag(self.K), 1e-12))
        A = np.zeros((2 * n + len(c.A), 2 * n + len(c.A)))
        A[:n, n : 2 * n] = np.diag(scale)
        A[n : 2 * n, :n] = -(self.K + self.B @ c.D @ self.C) / scale
        A[n : 2 * n, n : 2 * n] = -self.D
        A[n : 2 * n, 2 * n :] = self.B @ c.C
        A[2 * n :, :n] = -(c.B @ self.C) / scale
        A[2 * n :, 2 * n :] = c.A
        return np.linalg.eigvals(A)

    def stable(self) -> bool:
        """Whether all poles lie in the open left half plane."""
        return bool(self.poles().real.max() < 0.0)

    def grid(self) -> Array:
        """Frequencies in rad/s over the loop's poles, with points on their flanks."""
        poles = self.poles()
        poles = poles[(poles.imag > 0.0) & np.isfinite(poles)]
        sizes = np.abs(poles)
        ends = (0.03 * sizes.min(), 30.0 * np.quantile(sizes, 0.9))
        pieces = [np.geomspace(*ends, POINTS)]
        for sign in (1.0, -1.0):
            pieces += [poles.imag + sign * np.abs(poles.real) * flank for flank in FLANKS]
        grid = np.unique(np.concatenate(pieces))
        return grid[(grid >= ends[0]) & (grid <= ends[1])]

    def respond(self, omega: Array) -> np.ndarray:
        """G(jω) (k, p, m)."""
        shape = -(omega[:, None, None] ** 2) * np.eye(len(self.K)) + self.K
        return self.C @ np.linalg.solve(shape + 1j * omega[:, None, None] * self.D, self.B + 0j)

    def sensitivity(self, omega: Array, controller: "_ControllerResponse") -> np.ndarray:
        """S(jω) (k, p, p)."""
        L = self.respond(omega) @ controller(omega)
        return np.linalg.inv(np.eye(L.shape[1]) + L)


class _ControllerResponse:
    """K(jω) on a grid, by its eigenvectors where these are sound."""

    def __init__(self, controller: StateSpace) -> None:
        self._c = controller
        self._poles, V = np.linalg.eig(controller.A)
        self._sound = bool(np.linalg.cond(V) < 1e8)
        if self._sound:
            self._left, self._right = controller.C @ V, np.linalg.solve(V, controller.B + 0j)

    def __call__(self, omega: Array) -> np.ndarray:
        s = 1j * np.asarray(omega, float)
        if self._sound:
            parts = self._right[None] / (s[:, None] - self._poles)[:, :, None]
            return self._left @ parts + self._c.D
        shape = s[:, None, None] * np.eye(len(self._c.A)) - self._c.A
        return self._c.C @ np.linalg.solve(shape, self._c.B + 0j) + self._c.D


def _largest(S: np.ndarray) -> Array:
    return np.linalg.norm(S, 2, axis=(1, 2)) if S.shape[1] > 1 else np.abs(S[:, 0, 0])


def _reach(good: Callable[[float], bool], places: Array) -> float:
    """The last place from the model outwards that is good; the first loss found is bisected."""
    inside = 0.0
    for place in places:
        if not good(float(place)):
            outside = float(place)
            for _ in range(BISECTIONS):
                middle = 0.5 * (inside + outside)
                inside, outside = (middle, outside) if good(middle) else (inside, middle)
            return inside
        inside = float(place)
    return inside


def _margins(loop: _Loop, controller: _ControllerResponse, omega: Array) -> list[ClassicalMargins]:
    """Of each loop broken alone at the plant's inputs."""

    def broken(i: int, w: Array) -> np.ndarray:
        L = controller(w) @ loop.respond(w)
        S = np.linalg.inv(np.eye(L.shape[1]) + L)
        return np.asarray(1.0 / S[:, i, i] - 1.0)

    return [classical_margins(partial(broken, i), omega) for i in range(loop.B.shape[1])]
