"""One controller on plants off their model: poles, responses and the largest peak of S.

A loop is continuous, or sampled behind a hold and a delay, both exact; K then by Tustin's rule.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ccd_casadi.lti.closed_loop import closed_loop, largest, sensitivity
from ccd_casadi.lti.grid import around, frequency_grid
from ccd_casadi.lti.hold import Sampling, sampled, transfer, tustin
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import ModalPlant, Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array

PER_DECADE = 40
FLANKS = np.array([-3.0, -1.5, -0.7, -0.3, 0.0, 0.3, 0.7, 1.5, 3.0])
ZOOMS = 8  # each time eleven points between a maximum's neighbours: the spacing over 5
STEP = 0.3  # of the distance to a shift at which a pole of G meets a pole or zero of K
WIDEST = 0.03  # of the frequency: step of a shift far from all of these
WEAK = 1e-3  # gain at a resonance below which its mode does nothing to the loop


class Controller:
    """K in SI, e in and u out, and K(jω) by its eigenvectors where these are sound.

    `given` is K(s), which runs by Tustin's rule where there is a `sampling`, or K(z) itself.
    """

    def __init__(self, given: StateSpace, sampling: Sampling | None = None) -> None:
        self.given, self.sampling = given, sampling
        self.state = given
        if sampling is not None and not given.period:
            self.state = tustin(given, sampling.period)

    def __call__(self, omega: Array) -> np.ndarray:
        """K(jω) (k, m, p) at frequencies in rad/s."""
        return self.state.swept(omega)

    @cached_property
    def roots(self) -> np.ndarray:
        """Poles and finite zeros in 1/s, as the loop sees them; one of each conjugate pair."""
        size = float(np.abs(self.state.poles).max(initial=0.0))
        s = np.concatenate([self.state.rates, self.state.rates_of(self.state.zeros(size))])
        return s[(s.imag >= 0.0) & np.isfinite(s)]


@dataclass(frozen=True)
class Loop:
    """q̈ + D q̇ + K q = B u, y = C q with u = -K(s) y, in modal coordinates of the model."""

    plant: ModalPlant
    controller: Controller

    @cached_property
    def state(self) -> StateSpace:
        """The plant; velocities in units in which a mode's energy is even."""
        p, n = self.plant, len(self.plant.K)
        scale = np.sqrt(np.maximum(np.diag(p.K), 1e-12))
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:], A[n:, :n], A[n:, n:] = np.diag(scale), -p.K / scale, -p.D
        B = np.vstack([np.zeros_like(p.B), p.B])
        C = np.hstack([p.C / scale, np.zeros_like(p.C)])
        return StateSpace(A, B, C, np.zeros((len(C), B.shape[1])))

    @cached_property
    def poles(self) -> np.ndarray:
        """Closed-loop poles in 1/s; of a sampled loop ln z/T."""
        G, K, sampling = self.state, self.controller.state, self.controller.sampling
        if sampling is not None:
            G = sampled(G, sampling.period, sampling.delay)
        return closed_loop(G, K).S.rates

    @property
    def growth(self) -> float:
        """The largest real part of a pole over its size: below 0 where the loop is stable."""
        return float((self.poles.real / np.maximum(np.abs(self.poles), 1e-300)).max())

    @property
    def stable(self) -> bool:
        """Whether all poles lie in the open left half plane."""
        return self.growth < 0.0

    @cached_property
    def grid(self) -> Array:
        """Frequencies in rad/s, logarithmic and through the roots of plant, K and loop."""
        roots = np.concatenate([self.poles, self.state.poles, self.controller.roots])
        roots = roots[np.isfinite(roots) & (np.abs(roots) > 0.0)]
        sizes = np.abs(roots)
        low, high = 0.03 * sizes[sizes > 1e-9 * sizes.max()].min(), 30.0 * sizes.max()
        if self.controller.sampling is not None:
            high = np.pi / self.controller.sampling.period
        points = int(PER_DECADE * np.log10(high / low))
        near = around(roots[roots.imag > 0.0], FLANKS)
        return frequency_grid(low, high, points, near, apart=1e-9)

    def respond(self, omega: Array) -> np.ndarray:
        """G(jω) (k, p, m), behind hold and delay where there are any."""
        p, sampling = self.plant, self.controller.sampling
        if sampling is not None:
            poles, V = np.linalg.eig(self.state.A)
            f, _ = transfer(poles, omega, sampling.period, sampling.delay)
            drive = np.linalg.solve(V, self.state.B + 0j)
            return np.asarray((self.state.C @ V) @ (f[:, :, None] * drive))
        k, d = np.diag(p.K), np.diag(p.D)
        w = omega[:, None]
        if not (np.diag(d) - p.D).any():
            return np.asarray(p.C @ (p.B / (k - w**2 + 1j * w * d)[:, :, None]))
        shape = -(w[:, :, None] ** 2) * np.eye(len(k)) + p.K
        return np.asarray(p.C @ np.linalg.solve(shape + 1j * w[:, :, None] * p.D, p.B + 0j))

    def responses(self, omega: Array) -> tuple[np.ndarray, np.ndarray]:
        """G (k, p, m) and K (k, m, p)."""
        return self.respond(omega), self.controller(omega)

    def sensitivity(self, omega: Array) -> Array:
        """σ_max of S(jω)."""
        L = self.respond(omega) @ self.controller(omega)
        if L.shape[1] == 1:
            return np.asarray(1.0 / np.abs(1.0 + L[:, 0, 0]))
        return largest(sensitivity(L))

    @cached_property
    def peak(self) -> float:
        """‖S‖∞ of a stable loop: every local maximum on the grid near the largest closed in on."""
        grid = self.grid
        S = self.sensitivity(grid)
        top = float(S.max())
        at = np.flatnonzero((S[1:-1] >= S[:-2]) & (S[1:-1] >= S[2:])) + 1
        at = at[S[at] > 0.9 * top]
        low, high, rows = grid[at - 1], grid[at + 1], np.arange(len(at))
        for _ in range(ZOOMS if len(at) else 0):
            points = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 11)
            found = self.sensitivity(points.ravel()).reshape(points.shape)
            i = found.argmax(axis=1)
            top = max(top, float(found.max()))
            low, high = points[rows, np.maximum(i - 1, 0)], points[rows, np.minimum(i + 1, 10)]
        return top


@dataclass(frozen=True)
class LoopsOffModel:
    """The loops of one controller on a plant whose resonances and damping are not the model's.

    D is `rest` + damping (`matrix` + shift `grows`), a known function of both: the model is not
    asked again.
    """

    plant: ModalPlant
    controller: Controller
    rest: Array
    matrix: Array
    grows: Array
    given: bool  # damping by a matrix
    known: dict[Perturbation, Loop] = field(default_factory=dict, compare=False)

    @property
    def other(self) -> "LoopsOffModel":
        """With damping as it is not taken under a shift: of ratios the matrix is kept, of a
        matrix the ratios."""
        flexible = ~self.plant.rigid
        own = np.where(flexible[:, None] & flexible, self.matrix, 0.0)
        return replace(self, grows=own if self.given else np.zeros_like(own), known={})

    def modal(self, off: Perturbation) -> ModalPlant:
        """The plant itself; single modes are not shifted."""
        flexible = np.where(self.plant.rigid, 0.0, np.diag(self.plant.K))
        K = self.plant.K + np.diag(((1.0 + off.shift) ** 2 - 1.0) * flexible)
        D = self.rest + off.damping * (self.matrix + off.shift * self.grows)
        return replace(self.plant, K=K, D=D)

    def at(self, off: Perturbation) -> Loop:
        """The loop on a perturbed plant."""
        if off not in self.known:
            self.known[off] = Loop(self.modal(off), self.controller)
        return self.known[off]

    @cached_property
    def _meetings(self) -> tuple[Array, Array]:
        """Shifts at which a resonance meets a pole or zero of K, and how wide such a meeting is.

        Along a resonance S changes as K does there: the distance to a root of K in the complex
        plane, over the frequency, is how far it is analytic in the shift.
        """
        k, d = np.diag(self.plant.K), np.diag(self.plant.D)
        strength = np.linalg.norm(self.plant.B, axis=1) * np.linalg.norm(self.plant.C, axis=0)
        natural = np.sqrt(k)
        gain = np.linalg.norm(self.controller(natural), axis=(1, 2))
        gain = gain * strength / np.maximum(natural * d, 1e-300)
        modes = np.flatnonzero(~self.plant.rigid & (gain > WEAK))
        roots, omega = self.controller.roots[:, None], natural[modes]
        at = np.abs(roots.imag) / omega - 1.0
        width = np.abs(roots.real) / omega + (0.5 * d[modes] / omega) * (1.0 + at)
        return at.ravel(), width.ravel()

    def step(self, shift: float) -> float:
        """How far the next shift may lie: of the way to what is nearest in the complex plane."""
        at, width = self._meetings
        near = float(np.hypot(at - shift, width).min(initial=np.inf))
        return min(WIDEST, STEP * max(near, 1e-4))


def loops_off_model(
    system: Mechanics, suspension: Suspension, controller: Controller
) -> LoopsOffModel:
    """Of a plant's matrices at one θ."""

    def D(off: Perturbation) -> Array:
        return modal_plant(system, suspension, off).D

    plant = modal_plant(system, suspension)
    matrix = D(Perturbation(damping=2.0)) - plant.D
    grows = (D(Perturbation(shift=0.5)) - plant.D) / 0.5
    given = system.damping_ratio is None
    return LoopsOffModel(plant, controller, plant.D - matrix, matrix, grows, given)
