"""One controller on plants off their model: the loops, and how far apart these are to be asked.

A loop is continuous, or sampled behind a hold and a delay, both exact; K then by Tustin's rule.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ccd_casadi.lti.hold import Sampling, tustin
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import (
    FREE,
    ModalPlant,
    Perturbation,
    Suspension,
    modal_plant,
    without_hidden_rigid_modes,
)
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array

STEP = 0.3  # of the distance to a shift at which a pole of G meets a pole or zero of K
WIDEST = 0.03  # of the frequency: step of a shift far from all of these
WEAK = 1e-3  # gain at a resonance below which its mode does nothing to the loop


@dataclass(frozen=True)
class LoopsOffModel:
    """The loops of one controller on a plant whose resonances and damping are not the model's.

    `controller`, e in and u out in SI, is K(s), which runs by Tustin's rule where there is a
    `sampling`, or K(z) itself. D is `rest` + damping (`matrix` + shift `grows`), a known function
    of both: the model is not asked again.
    """

    plant: ModalPlant
    controller: StateSpace
    sampling: Sampling | None
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
            self.known[off] = Loop(self.modal(off).state_space, self.run, self.sampling)
        return self.known[off]

    @cached_property
    def run(self) -> StateSpace:
        """The controller as it runs."""
        K = self.controller
        return K if self.sampling is None or K.period else tustin(K, self.sampling.period)

    @cached_property
    def _meetings(self) -> tuple[Array, Array]:
        """Shifts at which a resonance meets a pole or zero of K, and how wide such a meeting is.

        Along a resonance S changes as K does there: the distance to a root of K in the complex
        plane, over the frequency, is how far it is analytic in the shift.
        """
        k, d = np.diag(self.plant.K), np.diag(self.plant.D)
        strength = np.linalg.norm(self.plant.B, axis=1) * np.linalg.norm(self.plant.C, axis=0)
        flexible = np.flatnonzero(~self.plant.rigid)
        natural = np.sqrt(k)
        gain = np.linalg.norm(self.run.swept(natural[flexible]), axis=(1, 2))
        gain *= strength[flexible] / np.maximum((natural * d)[flexible], 1e-300)
        modes = flexible[gain > WEAK]
        zeros = self.run.zeros(float(np.abs(self.run.poles).max(initial=0.0)))
        roots = np.concatenate([self.run.rates, self.run.rates_of(zeros)])
        roots, omega = roots[(roots.imag >= 0.0) & np.isfinite(roots), None], natural[modes]
        at = np.abs(roots.imag) / omega - 1.0
        width = np.abs(roots.real) / omega + (0.5 * d[modes] / omega) * (1.0 + at)
        return at.ravel(), width.ravel()

    def step(self, shift: float) -> float:
        """How far the next shift may lie: of the way to what is nearest in the complex plane."""
        at, width = self._meetings
        near = float(np.hypot(at - shift, width).min(initial=np.inf))
        return min(WIDEST, STEP * max(near, 1e-4))


def loops_off_model(
    system: Mechanics,
    controller: StateSpace,
    sampling: Sampling | None = None,
    suspension: Suspension = FREE,
) -> LoopsOffModel:
    """Of a plant's matrices at one θ, whose free bodies are free but for a `suspension`."""

    def modal(off: Perturbation) -> ModalPlant:
        return without_hidden_rigid_modes(modal_plant(system, suspension, off))

    def D(off: Perturbation) -> Array:
        return modal(off).D

    plant = modal(Perturbation())
    matrix = D(Perturbation(damping=2.0)) - plant.D
    grows = (D(Perturbation(shift=0.5)) - plant.D) / 0.5
    given = system.damping_ratio is None
    rest = plant.D - matrix
    return LoopsOffModel(plant, controller, sampling, rest, matrix, grows, given)
