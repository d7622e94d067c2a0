"""One controller on plants off their model: poles, responses and the largest peak of S.

A loop is continuous, or sampled behind a hold and a delay, both exact; K then by Tustin's rule.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import eig

from ccd_casadi.budget.holding import tustin
from ccd_casadi.fixed_structure.hold_and_delay import Sampling, sampled, transfer
from ccd_casadi.plants.modal import ModalPlant, Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.arrays import Array

PER_DECADE = 40
FLANKS = np.array([0.0, 0.3, 0.7, 1.5, 3.0])
ZOOMS = 8  # each time eleven points between a maximum's neighbours: the spacing over 5
STEP = 0.3  # of the distance to a shift at which a pole of G meets a pole or zero of K
WIDEST = 0.03  # of the frequency: step of a shift far from all of these
WEAK = 1e-3  # gain at a resonance below which its mode does nothing to the loop


class Controller:
    """K in SI, e in and u out, and K(jω) by its eigenvectors where these are sound."""

    def __init__(self, continuous: StateSpace, sampling: Sampling | None = None) -> None:
        self.continuous, self.sampling = continuous, sampling
        self.state = continuous if sampling is None else tustin(continuous, sampling.period)
        self._poles, V = np.linalg.eig(self.state.A)
        self._sound = bool(not V.size or np.linalg.cond(V) < 1e8)
        if self._sound:
            right = np.linalg.solve(V, self.state.B + 0j)
            self._left, self._right = self.state.C @ V, right

    def __call__(self, omega: Array) -> np.ndarray:
        """K(jω) (k, m, p) at frequencies in rad/s."""
        c, s = self.state, 1j * np.asarray(omega, float)
        if self.sampling is not None:
            s = np.exp(s * self.sampling.period)
        if self._sound:
            parts = self._right[None] / (s[:, None] - self._poles)[:, :, None]
            return np.asarray(self._left @ parts + c.D)
        shape = s[:, None, None] * np.eye(len(c.A)) - c.A
        return np.asarray(c.C @ np.linalg.solve(shape, c.B + 0j) + c.D)

    @cached_property
    def roots(self) -> np.ndarray:
        """Poles and finite zeros in 1/s, as the loop sees them; one of each conjugate pair."""
        c = self.continuous
        n, m = c.B.shape
        found = [np.linalg.eigvals(c.A)]
        if len(c.C) == m and n:
            size = np.abs(found[0]).max()
            gain = max(float(np.linalg.norm(c.C) * np.linalg.norm(c.B)), 1e-300) / size
            system = np.block([[c.A / size, c.B / size], [c.C / gain, c.D / gain]])
            shape = np.zeros_like(system)
            shape[:n, :n] = np.eye(n)
            zeros = eig(system, shape, right=False)
            found.append(size * zeros[np.isfinite(zeros) & (np.abs(zeros) < 1e5)])
        s = np.concatenate(found)
        if self.sampling is not None:
            half = 0.5 * self.sampling.period * s
            s = np.log((1.0 + half) / (1.0 - half)) / self.sampling.period
        return s[(s.imag >= 0.0) & np.isfinite(s)]


@dataclass(frozen=True)
class Loop:
    """q̈ + D q̇ + K q = B u, y = C q with u = -K(s) y, in modal coordinates of the model."""

    plant: ModalPlant
    controller: Controller

    @cached_property
    def state(self) -> tuple[Array, Array, Array]:
        """(A, B, C) of the plant; velocities in units in which a mode's energy is even."""
        p, n = self.plant, len(self.plant.K)
        scale = np.sqrt(np.maximum(np.diag(p.K), 1e-12))
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:], A[n:, :n], A[n:, n:] = np.diag(scale), -p.K / scale, -p.D
        B = np.vstack([np.zeros_like(p.B), p.B])
        return A, B, np.hstack([p.C / scale, np.zeros_like(p.C)])

    @cached_property
    def poles(self) -> np.ndarray:
        """Closed-loop poles in 1/s; of a sampled loop ln z/T."""
        (A, B, C), K, sampling = self.state, self.controller.state, self.controller.sampling
        if sampling is not None:
            A, B, C = sampled(A, B, C, sampling.period, sampling.delay)
        joint = np.block([[A - B @ K.D @ C, B @ K.C], [-K.B @ C, K.A]])
        found = np.linalg.eigvals(joint).astype(complex)
        if sampling is not None:  # z = 0 is a delay
            found = np.log(found[np.abs(found) > 1e-12]) / sampling.period
        return np.asarray(found)

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
        own = np.linalg.eigvals(self.state[0])
        roots = np.concatenate([self.poles, own, self.controller.roots])
        roots = roots[np.isfinite(roots) & (np.abs(roots) > 0.0)]
        sizes = np.abs(roots)
        low, high = 0.03 * sizes[sizes > 1e-9 * sizes.max()].min(), 30.0 * sizes.max()
        if self.controller.sampling is not None:
            high = np.pi / self.controller.sampling.period
        roots = roots[roots.imag > 0.0]
        pieces = [np.geomspace(low, high, int(PER_DECADE * np.log10(high / low)))]
        for sign in (1.0, -1.0):
            pieces += [roots.imag + sign * np.abs(roots.real) * flank for flank in FLANKS]
        grid = np.unique(np.concatenate(pieces))
        grid = grid[(grid >= low) & (grid <= high)]
        return grid[np.append(True, np.diff(grid) > 1e-9 * grid[1:])]

    def respond(self, omega: Array) -> np.ndarray:
        """G(jω) (k, p, m), behind hold and delay where there are any."""
        p, sampling = self.plant, self.controller.sampling
        if sampling is not None:
            A, B, C = self.state
            poles, V = np.linalg.eig(A)
            f, _ = transfer(poles, omega, sampling.period, sampling.delay)
            return np.asarray((C @ V) @ (f[:, :, None] * np.linalg.solve(V, B + 0j)))
        k, d = np.diag(p.K), np.diag(p.D)
        w = omega[:, None]
        if not (np.diag(d) - p.D).any():
            return np.asarray(p.C @ (p.B / (k - w**2 + 1j * w * d)[:, :, None]))
        shape = -(w[:, :, None] ** 2) * np.eye(len(k)) + p.K
        return np.asarray(p.C @ np.linalg.solve(shape + 1j * w[:, :, None] * p.D, p.B + 0j))

    def sensitivity(self, omega: Array) -> Array:
        """σ_max of S(jω)."""
        L = self.respond(omega) @ self.controller(omega)
        if L.shape[1] == 1:
            return np.asarray(1.0 / np.abs(1.0 + L[:, 0, 0]))
        return np.linalg.norm(np.linalg.inv(np.eye(L.shape[1]) + L), 2, axis=(1, 2))

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
