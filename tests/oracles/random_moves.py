"""Moves of random loops against a simulation of its own, sample by sample: settled when?

    python benchmarks/oracle.py random_moves [COUNT] [--run FOLDER]

Each case draws a two-mass plant whose rigid body is free, a lead with integrator and roll-off at
a random crossover, hold, delay, window and a motor's move. The judge here knows nothing of the
package's loops: it steps the plant from event to event with the matrix exponential and the
controller by its difference equation. Printed: how many settle at the same sample, the largest
difference of the error over the window, and by how much the smooth time lies above the exact one.

With --run: how many of COUNT fresh random plants of the finished run settle later than it states,
by the same judge. The plants are drawn and put together here, from M and K at its θ.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.linalg import eigh, expm

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.analysis.driven_plant import MotionAt, motion_at
from ccd_casadi.analysis.motor import Motion, Motor
from ccd_casadi.analysis.move import simulate
from ccd_casadi.analysis.move_time import MoveTime
from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Plant, build_plant, mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant

STRUCTURE = Structure(lead=1, biquads=0, roll_off=2)
NAMES = ("carriage", "stiffness")


def axis(theta, tool=3.0, zeta=0.02):
    """Carriage and tool with a spring between them; force and encoder at the carriage."""
    carriage, k = theta["carriage"], theta["stiffness"]
    return {
        "mass": ca.diag(ca.vertcat(carriage, tool)), "stiffness": k * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": zeta, "input": ca.DM([1, 0]), "output": ca.DM([[1, 0]]),
        "hardware_cost": carriage,
    }  # fmt: skip


def free(plant: Plant, theta: np.ndarray, shift: float = 0.0) -> ScaledPlant:
    """The plant with its rigid body free, its flexible mode moved by so much."""
    modal = modal_plant(mechanics(plant, theta), Suspension(0.0, 0.0), Perturbation(shift))
    return scale_plant(modal, 1e5, bare=True)


@dataclass(frozen=True)
class MoveCase:
    """A plant's parameters, a loop and a move."""

    plant: Plant
    theta: np.ndarray
    hold: Sampling
    kappa: np.ndarray
    motion: Motion
    shift: float

    def at(self, theta: np.ndarray) -> MotionAt:
        return motion_at(self.motion, free(self.plant, theta), 0.0, None, self.hold)

    def goal(self, theta: np.ndarray | None = None) -> MoveTime:
        """On the model and on the plant off it."""
        theta = self.theta if theta is None else theta
        plants = (free(self.plant, theta), free(self.plant, theta, self.shift))
        return MoveTime(plants, STRUCTURE, self.hold, self.at(theta))


def drawn(rng: np.random.Generator) -> MoveCase:
    """A stable one."""
    while True:
        carriage, tool = rng.uniform(1.0, 8.0, 2)
        hz, crossover = rng.uniform(80.0, 250.0), 2.0 * np.pi * rng.uniform(25.0, 70.0)
        k = (2.0 * np.pi * hz) ** 2 * tool * carriage / (tool + carriage)
        plant = build_plant(axis, NAMES, {"tool": tool, "zeta": rng.uniform(0.01, 0.05)})
        hold = Sampling(rng.uniform(4e3, 1e4), rng.uniform(0.0, 300.0))
        kappa = np.log([(carriage + tool) * crossover**2 / 3.0, crossover / rng.uniform(5.0, 20.0),
                        crossover / 3.0, 3.0 * crossover, 10.0 * crossover, 0.7])  # fmt: skip
        limits = MoveLimits(rng.uniform(0.01, 0.2), rng.uniform(0.3, 2.0), np.inf,
                        10.0 ** rng.uniform(2.5, 4.0), 10.0 ** rng.uniform(5.0, 6.5))  # fmt: skip
        window, dwell = 10.0 ** rng.uniform(-7.5, -5.5), rng.uniform(0.0, 0.2)
        motor = Motor(
            (rng.uniform(20.0, 80.0),), (4.0,), (9.0,), rms_power=rng.uniform(20.0, 200.0)
        )
        motion = Motion(limits, window, dwell, motor=motor)
        theta, shift = np.array([carriage, k]), rng.uniform(-0.05, 0.05)
        case = MoveCase(plant, theta, hold, kappa, motion, shift)
        if np.isfinite(case.goal().at(kappa)[0]):
            return case


def judged(
    G: StateSpace, K: StateSpace, hold: Sampling, motion: MotionAt, count: int
) -> tuple[np.ndarray, float]:
    """The error (count,) of a plant sample by sample, and the instant (s) from which on it stays
    in the window."""
    T, tau, n = hold.period, hold.delay, len(G.A)
    profile = motion.cycle.profile

    def stepped(x: np.ndarray, u: float, span: float) -> np.ndarray:
        joint = np.zeros((n + 1, n + 1))
        joint[:n, :n], joint[:n, n] = G.A, G.B[:, 0] * u
        return expm(joint * span)[:n] @ np.append(x, 1.0)

    whole = int(np.floor(tau / T + 1e-9))
    rest = max(tau - whole * T, 0.0)
    before, after = (np.array([stepped(row, u, span) for row, u in
                               [(e, 0.0) for e in np.eye(n)] + [(np.zeros(n), 1.0)]]).T
                     for span in (rest, T - rest))  # fmt: skip
    # Tustin: w = (2/T)(z - 1)/(z + 1), by the controller's own trapezoids
    half, one = 0.5 * T * K.A, np.eye(len(K.A))
    forget = np.linalg.solve(one - half, one + half)
    take = np.linalg.solve(one - half, 0.5 * T * K.B[:, 0])
    times = np.arange(count) * T
    ends = [profile.at(times + side * T)[:4] for side in (-0.5, 0.5)]
    means = np.vstack([profile.at(times)[:1], (ends[1] - ends[0]) / T])
    ahead = motion.forward[:, 0] @ means
    z, e_old, x, sent = np.zeros(len(K.A)), 0.0, np.zeros(n), [0.0] * (whole + 2)
    errors = np.zeros(count)
    for k in range(count):
        e = errors[k] = means[0, k] - G.C[0] @ x
        z = forget @ z + take * (e + e_old)
        e_old = e
        u = K.C[0] @ z + K.D[0, 0] * e + ahead[k]
        sent = [u, *sent[:-1]]
        x = before @ np.append(x, sent[whole + 1])
        x = after @ np.append(x, sent[whole])
    outside = np.flatnonzero(np.abs(errors) > motion.motion.window)
    return errors, T * (outside[-1] + 1 if outside.size else 0)


def compared(case: MoveCase, which: int) -> tuple[float, float, float, float]:
    """Samples between both settling times, largest difference over the window, exact and smooth
    time."""
    goal, motion = case.goal(), case.at(case.theta)
    loop = Loop(goal.plants[which].plant_si(), STRUCTURE.state_space(case.kappa), case.hold)
    profile = motion.cycle.profile
    move = simulate(loop, profile, axis=0, forces=motion.forward, window=motion.motion.window,
                    bandwidth_hz=10.0 / profile.duration)  # fmt: skip
    own, settled = judged(  # twice as long: whether what follows stays within it
        loop.plant, loop.controller, case.hold, motion, 2 * len(move.time)
    )
    smooth = max(goal.times(case.kappa)[which], motion.cycle.profile.duration)
    return (
        (move.settled - settled) / case.hold.period,
        float(np.abs(own[: len(move.time)] - move.error).max() / motion.motion.window),
        max(move.settled, motion.cycle.profile.duration),
        smooth,
    )


def fresh(problem: CoDesignProblem, theta: np.ndarray, rng: np.random.Generator) -> StateSpace:
    """One plant of the box, its rigid body free: every flexible frequency and damping ratio off the
    model by one factor each, and the gain."""
    own, u = mechanics(plant_of(problem), theta), structured_of(problem).uncertainty
    assert own.damping_ratio is not None
    assert (u.mode_shift, u.options, u.ranges) == (0.0, (), ()), "is not drawn here"
    squares, shapes = eigh(own.K, own.M)
    omega = np.sqrt(np.where(squares > 1e-10 * squares[-1], squares, 0.0))
    omega *= 1.0 + rng.uniform(-u.resonance_shift, u.resonance_shift)
    decay = 2.0 * own.damping_ratio * rng.uniform(*u.damping) * omega
    n = len(omega)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(omega**2), -np.diag(decay)]])
    B = np.vstack([np.zeros((n, 1)), shapes.T @ own.B]) * (1.0 + rng.uniform(-u.gain, u.gain))
    return StateSpace(A, B, np.hstack([own.C @ shapes, np.zeros((1, n))]), np.zeros((1, 1)))


def judge_run(folder: Path, count: int) -> None:
    """Fresh plants of a finished run against the time that it states."""
    run = read_run(folder)
    problem, theta, stated = run.problem, np.array(run.theta), run.result["move_time"]
    assert problem.sampling is not None
    motion, rng = motion_of(problem, run.theta), np.random.default_rng(2026)
    samples = int(2.0 * stated / problem.sampling.period)
    times = np.array([
        judged(fresh(problem, theta, rng), run.controller, problem.sampling, motion, samples)[1]
        for _ in range(count)
    ])  # fmt: skip
    times = np.maximum(times, motion.cycle.profile.duration)
    print(f"stated {1e3 * stated:.3f} ms, setpoint {1e3 * motion.cycle.profile.duration:.3f} ms")
    print(f"{(times > stated).sum()} of {count} fresh plants settle later; ", end="")
    print(f"the latest after {1e3 * times.max():.3f} ms, the median {1e3 * np.median(times):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, nargs="?")
    parser.add_argument("--run", type=Path)
    options = parser.parse_args()
    if options.run is not None:
        judge_run(options.run, options.count or 500)
        return
    count = options.count or 100
    rng = np.random.default_rng(42)
    found = np.array([compared(drawn(rng), i % 2) for i in range(count)])
    apart, error, exact, smooth = found.T
    same, near = ((np.abs(apart) < samples).sum() for samples in (0.5, 1.5))
    print(f"{same} of {count} settle at the same sample, {near} within one")
    print(f"the errors differ by {error.max():.2g} windows at most")
    share = 100.0 * (smooth / exact - 1.0)
    print(f"smooth time above the exact one by {np.median(share):.2g} % (median), ", end="")
    print(f"{share.max():.3g} % at most; below it in {(share < -1e-4).sum()} cases")


if __name__ == "__main__":
    main()
