"""Random machines as they are wired, as A, B, C: γ_opt beside SB10AD, K and derivatives apart.

    python benchmarks/oracle.py wired_plants [300]

Masses in a chain: driven away, undamped, behind lags and a coil, with two sensors in turn; of
relative degree 1 (a velocity that is read) to 5. Each plant has a process of its own, that is ended
after LIMIT seconds: SB10AD may not end.
"""

import json
import multiprocessing
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np

from ccd_casadi.extensions.cross_check.backends import balance, mixed_sensitivity
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop, strictly_proper
from ccd_casadi.plants.modal import FREE, Perturbation, Suspension, modal_plant, require_damping
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant, scale_state_space
from ccd_casadi.support.errors import PlantError
from ccd_casadi.synthesis.derivatives import sensitivities
from oracles.differences import difference
from oracles.hard_plants import close, distance_to_sb10ad, drawn_weights

KINDS = ("driven away", "undamped", "lags", "two sensors")
LIMIT = 90.0  # s
STEPS = (1e-3, 3e-3, 1e-2)  # of the differences


def first_order_system(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, slopes: tuple[np.ndarray, ...] = ()
) -> Mechanics:
    """With the derivatives of A, B and C to one parameter, or to none."""
    none = tuple(np.zeros((0, *part.shape)) for part in (A, A, A, B, C))
    if slopes:
        none = (0.0 * A[None], 0.0 * A[None], -slopes[0][None], slopes[1][None], slopes[2][None])
    return Mechanics(0.0 * A, np.eye(len(A)), -A, B, C, None, none)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Machine:
    """Masses, springs between them, one to the ground, its damping; rates of what is wired."""

    mass: np.ndarray
    joints: np.ndarray
    ground: float
    damping: float
    rates: np.ndarray
    emf: np.ndarray
    sensors: np.ndarray
    channels: int = 1

    def matrices(self, p: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A, B, C; a parameter p moves the first mass, all springs and what is wired first."""
        mass, joints = self.mass.copy(), np.diff(np.eye(len(self.mass)), axis=0)
        mass[0] *= 1.0 + p
        K = joints.T @ np.diag(self.joints * (1.0 - 0.5 * p)) @ joints
        n, m = len(mass), self.channels
        D, B = self.damping * K, np.eye(n)[:, :m] / mass[:, None]
        K[0, 0] += self.ground
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-K / mass[:, None], -D / mass[:, None]]])
        B, C = np.vstack([0.0 * B, B]), self.sensors
        for k, (rate, emf) in enumerate(zip(self.rates, self.emf, strict=True)):
            w = rate * (1.0 + p * (k == 0))
            A = np.block([[A, B], [-emf * B.T, -w * np.eye(m)]])
            B, C = (
                np.vstack([0.0 * B, w * np.eye(m)]),
                np.hstack([C, np.zeros((len(C), m))]),
            )
        return A, B, C

    @property
    def system(self) -> Mechanics:
        """With its derivatives, by differences."""
        slopes = [difference(lambda p, i=i: self.matrices(p)[i], 1e-3) for i in range(3)]
        return first_order_system(*self.matrices(), tuple(slopes))


def machine(seed: int, kind: str = "", channels: int = 1) -> Machine:
    """Of a kind; without one free, on a spring or driven away."""
    rng = np.random.default_rng(seed)
    n, lags = int(rng.integers(channels, 4)), int(rng.integers(4))
    ground = float(rng.choice([0.0, 1.0, -1.0])) * 10.0 ** rng.uniform(-1.0, 3.0)
    damping = 10.0 ** rng.uniform(-6.0, -4.0)
    if kind == "driven away":
        ground = -abs(ground) or -1.0
    if kind == "undamped":
        damping, lags = 0.0, min(lags, 1)
    if kind == "lags":
        lags = max(lags, 1)
    sensors = np.hstack([np.eye(n)[:channels], np.zeros((channels, n))])
    if kind and rng.random() < 0.25 and ground:  # a velocity: relative degree 1
        sensors, lags = np.roll(sensors, n, axis=1), 0
    if kind == "two sensors":
        sensors = np.hstack([np.eye(n)[[0, -1]], np.zeros((2, n))])
    return Machine(
        10.0 ** rng.uniform(-1.0, 1.0, n), 10.0 ** rng.uniform(0.0, 3.0, n - 1), ground, damping,
        10.0 ** rng.uniform(1.0, 4.0, lags),
        10.0 ** rng.uniform(-1.0, 1.0, lags) * rng.integers(0, 2, lags), sensors, channels,
    )  # fmt: skip


def design_plant(system: Mechanics, lost: float = 1e-3, hz: float = 0.0) -> ScaledPlant:
    """As a case has it: on a suspension (of 1e-3 ω₀, or in Hz) and with less damping where poles
    are on the axis."""

    def scaled(off: Perturbation, held: Suspension = FREE) -> ScaledPlant:
        return scale_plant(modal_plant(system, held, off), 1.0)

    nominal = scaled(Perturbation())
    undamped = require_damping(modal_plant(system, FREE))
    if not (undamped or nominal.free):
        return nominal
    off = Perturbation(lost=lost if undamped else 0.0)
    return replace(nominal, family=(scaled(off, Suspension(hz or 1e-3 * nominal.omega_0)),))


@dataclass(frozen=True)
class Row:
    """What one plant has shown; NaN where it does not apply.

    `slope` is the distance of dγ_opt from the nearest of its differences, `doubt` the least
    distance between two of these, of other steps: their own error.
    """

    kind: str
    ended: str
    gamma: float = np.nan
    far: float = np.nan
    slope: float = np.nan
    doubt: float = np.nan
    optimum: str = ""


def row(seed: int) -> Row:
    """Synthesise, judge by NumPy, differentiate, and compare with SB10AD."""
    kind = KINDS[seed % len(KINDS)]
    own = machine(seed, kind)
    try:
        plant = design_plant(own.system)
    except PlantError as error:
        return Row(kind, f"refused: {error}")
    w0 = plant.omega_0
    weights = drawn_weights(np.random.default_rng(seed), w0)
    done = sensitivities(plant, weights, omega_low=1e-2 * w0)
    figures = done.figures
    if not figures.certificate.passed or done.made is None:
        return Row(kind, f"not certified: {figures.outcome.value}", figures.gamma_opt)
    G, K = strictly_proper(*own.matrices()), plant.controller_si(*done.made.controller)
    whole = close(balance(mixed_sensitivity(scale_state_space(G, 1.0), weights)),
                  StateSpace(K.A / w0, K.B / w0, K.C, K.D))  # fmt: skip
    stable = np.linalg.eigvals(closed_loop(G, K).A).real.max() < 0.0
    if not stable or hinf_norm(whole)[0] > figures.certificate.norm_bound * (1.0 + 1e-6):
        return Row(kind, "REFUTED", figures.gamma_opt)

    def gamma(p: float) -> float:
        moved = design_plant(first_order_system(*own.matrices(p)), hz=1e-3 * w0)
        return sensitivities(moved, weights, omega_low=1e-2 * w0).figures.gamma_opt

    exact, slope, doubt = float(done.to_theta[3, 0]), np.nan, np.nan
    if figures.certified:
        size = max(abs(exact), 1e-2 * figures.gamma_opt)
        found = np.array([difference(gamma, h) for h in STEPS]) / size
        slope = float(np.abs(found - exact / size).min())
        doubt = float(np.abs(np.diff(np.sort(found))).min())
    made_on = plant.design_plant
    theirs = scale_state_space(made_on.plant_si() if plant.family else G, 1.0)
    limited = figures.limited_by_bound  # which SB10AD decides by rounding
    far = np.nan if limited else distance_to_sb10ad(theirs, weights, figures.gamma_opt)
    return Row(kind, "certified", figures.gamma_opt, far, slope, doubt, figures.optimum.name)


def _into(pipe: "multiprocessing.connection.Connection", seed: int) -> None:
    try:
        pipe.send(asdict(row(seed)))
    except Exception as error:  # of whatever the others raise
        pipe.send(asdict(Row(KINDS[seed % len(KINDS)], f"{type(error).__name__}: {error}")))


def alone(work: Callable[..., None], seed: int) -> Row:
    """In a process that is ended after LIMIT seconds."""
    context = multiprocessing.get_context("fork")
    mine, theirs = context.Pipe()
    process = context.Process(target=work, args=(theirs, seed))
    process.start()
    answered = mine.poll(LIMIT)
    found = Row(**mine.recv()) if answered else Row(KINDS[seed % len(KINDS)], "over the limit")
    process.kill()
    process.join()
    return found


def main() -> None:
    """One line a plant, then the table."""
    rows = []
    for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 300):
        rows.append(alone(_into, seed))
        print(seed, json.dumps(asdict(rows[-1])), flush=True)
    for kind in KINDS:
        own = [one for one in rows if one.kind == kind]
        parts = [np.array([getattr(one, name) for one in own]) for name in ("far", "slope")]
        known = [(np.isfinite(part).sum(), (part <= 1e-6).sum()) for part in parts]
        print(kind, dict(Counter(one.ended for one in own)), "known, within 1e-6:", known)


if __name__ == "__main__":
    main()
