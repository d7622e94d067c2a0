"""What `deploy` prints of a move, against a simulation that shares no code with it.

    python benchmarks/feedforward_moves.py [CASES]

Chains of masses at random: free or held by a spring, with dampers between them and to the ground,
the sensor on the driven mass or on the last; a PID behind hold and delay, by coefficients. Theirs:
the words of the move with feedforward, from the plant as the tool models it. Ours: M, D and K, the
setpoint and the sampled loop written anew in NumPy and SciPy. It fails where the largest error or
the settling time differs by more than 5 % (and two digits of what is printed), or a free body is
given a force for its position, or, without a damper to the ground, for its velocity.
"""

import re
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.linalg import eigh, expm

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.deployment.on_hardware import on_hardware
from ccd_casadi.deployment.realisation import realised
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.reporting.moves import way_words

CHAIN = """
import casadi as ca

def chain(theta, masses, springs, dampers, ground, sensor):
    n = len(masses)
    K, D = ca.DM.zeros(n, n), ca.DM.zeros(n, n)
    K[0, 0], D[0, 0] = ground
    for i in range(n - 1):
        tie = ca.DM([[1, -1], [-1, 1]])
        K[i:i + 2, i:i + 2] += springs[i] * tie
        D[i:i + 2, i:i + 2] += dampers[i] * tie
    B, C = ca.DM.zeros(n, 1), ca.DM.zeros(1, n)
    B[0], C[sensor] = 1, 1
    M = ca.diag(ca.DM(masses) * theta["m"])
    return {"mass": M, "stiffness": K, "damping": D, "input": B, "output": C,
            "hardware_cost": theta["m"]}
"""
CASE = """[plant]
function = "chain.py:chain"
masses = {masses}
springs = {springs}
dampers = {dampers}
ground = {ground}
sensor = {sensor}
[theta.m]
lower = 0.5
upper = 2.0
start = 1.0
[objective]
w1 = 1.0
w2 = -1.0
[weights]
M_S = 2.0
A_S = 1e-4
c_K = 1e4
omega_K_hz = 100.0
M_K = {M_K}
A_l = 1.0
A_u = 1e-2
[inner]
S_max = 2.0
S_low = 0.5
omega_low_hz = 0.01
omega_S_hz = [0.1, 1800.0]
omega_T_hz = [0.1, 1000.0]
"""
UNITS = {"m": 1.0, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "nm": 1e-9, "pm": 1e-12,
         "s": 1.0, "ms": 1e-3, "µs": 1e-6, "us": 1e-6}  # fmt: skip


# ---- ours -----------------------------------------------------------------------------------


def profile(p: float, v: float, a: float, j: float, s: float) -> list[tuple[float, float]]:
    """(time, snap) of the shortest symmetric move within the bounds, by bisection."""

    def reached(t4: float, t3: float, t2: float, t1: float) -> np.ndarray:
        jerk = s * t4
        acceleration = jerk * (t4 + t3)
        velocity = acceleration * (2 * t4 + t3 + t2)
        return np.array([velocity * (4 * t4 + 2 * t3 + t2 + t1), velocity, acceleration, jerk])

    times = [0.0, 0.0, 0.0, 0.0]
    for i in range(4):
        low, high = 0.0, 1e3
        for _ in range(200):
            times[i] = 0.5 * (low + high)
            kept = (reached(*times) <= np.array([p, v, a, j]) * (1.0 + 1e-14)).all()
            low, high = (times[i], high) if kept else (low, times[i])
        times[i] = low
    t4, t3, t2, t1 = times
    up = [(t4, s), (t3, 0.0), (t4, -s), (t2, 0.0), (t4, -s), (t3, 0.0), (t4, s)]
    return [*up, (t1, 0.0), *((t, -x) for t, x in up)]


def setpoint_at(segments: list[tuple[float, float]], times: np.ndarray) -> np.ndarray:
    """r and its four derivatives (5, k)."""
    found, start, state = np.zeros((5, len(times))), 0.0, np.zeros(4)
    for span, snap in segments:
        inside = (times >= start) & (times < start + span)
        chain = np.diag([1.0, 1.0, 1.0, 1.0], 1)
        for k in np.flatnonzero(inside):
            found[:, k] = expm(chain * (times[k] - start)) @ np.append(state, snap)
        state = (expm(chain * span) @ np.append(state, snap))[:4]
        start += span
    found[0, times >= start] = state[0]
    return found


def simulated(M, D, K, sensor, controller, F, T, delay, limits) -> tuple[float, float, float]:  # type: ignore[no-untyped-def]
    """The largest error at the instants, when it is last outside the window; the one between."""
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    b = np.zeros(2 * n)
    b[n] = 1.0 / M[0, 0]

    def steps(span: float) -> tuple[np.ndarray, np.ndarray]:
        whole = expm(span * np.block([[A, b[:, None]], [np.zeros((1, 2 * n + 1))]]))
        return whole[:-1, :-1], whole[:-1, -1]

    late = int(delay / T + 1e-9)
    rest = max(delay - late * T, 0.0)
    first, middle, second = steps(rest), steps(0.5 * (T - rest)), steps(0.5 * (T - rest))
    segments = profile(*limits)
    duration = sum(t for t, _ in segments)
    count = int(np.ceil(4.0 * duration / T))
    r = setpoint_at(segments, T * np.arange(count))
    half = setpoint_at(segments, T * np.arange(count) + rest + 0.5 * (T - rest))[0]
    x, z, queue = np.zeros(2 * n), np.zeros(len(controller[0])), [0.0] * (late + 1)
    errors, between = np.zeros(count), 0.0
    Ak, Bk, Ck, Dk = controller
    for k in range(count):
        e = errors[k] = r[0, k] - x[sensor]
        u = float(Ck @ z + Dk[0, 0] * e + F[:, 0, 0] @ r[:, k])
        z = Ak @ z + Bk[:, 0] * e
        queue.append(u)
        old, now = queue[-2 - late], queue[-1 - late]
        x = first[0] @ x + first[1] * old
        x = middle[0] @ x + middle[1] * now
        between = max(between, abs(half[k] - x[sensor]))
        x = second[0] @ x + second[1] * now
    outside = np.flatnonzero(np.abs(errors) > limits[0] * 1e-4)
    settled = T * (outside[-1] + 1) if len(outside) else 0.0
    if len(outside) and outside[-1] + 1 == count:
        settled = np.inf
    return float(np.abs(errors).max()), float(settled), between


def drawn(rng: np.random.Generator, number: int) -> dict[str, object]:
    """A chain: free or held, collocated or not, with dampers, by the number's bits."""
    n = int(rng.integers(2, 4))
    masses = np.exp(rng.uniform(np.log(0.5), np.log(20.0), n))
    omega = 2 * np.pi * np.exp(rng.uniform(np.log(50.0), np.log(400.0), n - 1))
    springs = omega**2 * masses[1:]
    held = number % 2
    stiffness = held * masses.sum() * (2 * np.pi * rng.uniform(1.0, 8.0)) ** 2
    damper = (number // 2) % 2 * masses.sum() * rng.uniform(0.2, 3.0)
    return {
        "masses": masses,
        "springs": springs,
        "dampers": 2 * 0.01 * omega * masses[1:],
        "ground": np.array([stiffness, damper]),
        "sensor": (number // 4) % 2 * (n - 1),
    }


def matrices(one: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    M, n = np.diag(one["masses"]), len(one["masses"])
    K, D = np.zeros((n, n)), np.zeros((n, n))
    K[0, 0], D[0, 0] = one["ground"]
    for i in range(n - 1):
        e = np.zeros(n)
        e[i : i + 2] = 1.0, -1.0
        K += one["springs"][i] * np.outer(e, e)
        D += one["dampers"][i] * np.outer(e, e)
    return M, D, K


def pid(M, D, K, sensor, rng) -> tuple[StateSpace, float, float, float]:  # type: ignore[no-untyped-def]
    """A PID by Tustin's rule that holds the plant behind a delay: K(z), T, τ and the crossover."""
    n = len(M)
    lam = eigh(K, M, eigvals_only=True)
    flexible = np.sqrt(lam[lam > 1e-6 * lam[-1]])
    crossover = 0.3 * flexible[-1 if len(flexible) < n - 1 else -(n - 1)]
    share, by = rng.uniform(0.0, 1.6), rng.uniform(30.0, 60.0)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    b = np.zeros((2 * n, 1))
    b[n] = 1.0 / M[0, 0]
    for _ in range(40):
        w, T = crossover, 2 * np.pi / (by * crossover)
        gain = abs(M.sum() * w**2) / 3.0
        parts = [([[0.0]], [[w / 8.0]], [[1.0]], [[1.0]]),
                 ([[-3.0 * w]], [[3.0 * w]], [[-8.0]], [[9.0]]),
                 ([[-10.0 * w]], [[10.0 * w]], [[1.0]], [[0.0]])]  # fmt: skip
        system = StateSpace(*(np.array(x) for x in parts[0]))
        for part in parts[1:]:
            system = system.series(StateSpace(*(np.array(x) for x in part)))
        one, half = np.eye(len(system.A)), 0.5 * T
        inverse = np.linalg.inv(one - half * system.A)
        C = gain * system.C @ inverse
        Kz = StateSpace(inverse @ (one + half * system.A), T * system.B, C,
                        gain * system.D + half * C @ system.B, period=T)  # fmt: skip
        delay = share * T
        late, rest = int(share + 1e-9), delay - int(share + 1e-9) * T
        joint = np.zeros((2 * n + 1, 2 * n + 1))
        joint[: 2 * n] = np.hstack([A, b])
        first, second = expm(joint * rest), expm(joint * (T - rest))
        m = 2 * n + late + 1
        loop = np.zeros((m + len(Kz.A), m + len(Kz.A)))
        loop[: 2 * n, : 2 * n] = second[:-1, :-1] @ first[:-1, :-1]
        loop[: 2 * n, 2 * n + late] = second[:-1, :-1] @ first[:-1, -1]
        u = np.zeros(m + len(Kz.A))
        u[sensor], u[m:] = -Kz.D[0, 0], Kz.C[0]
        if late:
            loop[: 2 * n, 2 * n + late - 1] += second[:-1, -1]
        else:
            loop[: 2 * n] += np.outer(second[:-1, -1], u)
        loop[2 * n] = u
        for i in range(late):
            loop[2 * n + 1 + i, 2 * n + i] = 1.0
        loop[m:, m:] = Kz.A
        loop[m:, sensor] -= Kz.B[:, 0]
        if np.abs(np.linalg.eigvals(loop)).max() < 1.0 - 0.02 * w * T:
            return Kz, T, delay, w
        crossover *= 0.8
    return None


# ---- theirs ---------------------------------------------------------------------------------


def printed(one: dict, Kz: StateSpace, delay: float, w: float, limits: tuple) -> tuple:  # type: ignore[type-arg]
    """What is printed of the move with feedforward: largest error, settling; and F, K(z)."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "chain.py").write_text(CHAIN)
        listed = {k: np.asarray(v).tolist() for k, v in one.items()}
        text = CASE.format(**listed, M_K=float(np.sum(one["masses"])) * w**2)
        (Path(folder) / "case.toml").write_text(text)
        problem = problem_of(load_case(Path(folder) / "case.toml"))
        plant = scaled_plant(problem, problem.start).plant_si()
    runs = realised(Kz)
    found = on_hardware(plant, runs, delay, w, limits=MoveLimits(*limits), window=limits[0] * 1e-4)
    words = way_words("with feedforward", [found.ways["with feedforward"]])
    found_in = re.findall(r"([\d.e+-]+) ([mµunp]?[ms])\b", words)
    numbers = [float(x) * UNITS[unit] for x, unit in found_in]
    settled = numbers[0] if "settled after" in words else np.inf if "not settle" in words else 0.0
    return numbers[-1], settled, found.forward, runs.system


def main(count: int = 30) -> int:
    failed = 0
    print(
        " #  free damper sensor | error: printed    simulated      between | settled: printed  ours"
    )
    for number in range(count):
        rng = np.random.default_rng(number)
        loop = None
        while loop is None:  # not every chain is held by a PID
            one = drawn(rng, number)
            M, D, K = matrices(one)
            loop = pid(M, D, K, one["sensor"], rng)
        Kz, T, delay, w = loop
        stroke = 10.0 ** rng.uniform(-4.0, -1.0)
        speed = 0.1 * w
        limits = tuple(stroke * (x * speed) ** k for k, x in enumerate((1.0, 1.0, 1.5, 2.5, 4.0)))
        peak, settled, F, system = printed(one, Kz, delay, w, limits)
        controller = (system.A, system.B, system.C[0], system.D)
        ours, ours_settled, between = simulated(
            M, D, K, one["sensor"], controller, F, T, delay, limits
        )
        free, damped = one["ground"][0] == 0.0, one["ground"][1] > 0.0  # type: ignore[index]
        wrong = abs(peak / ours - 1.0) > 0.05 or not (
            settled == ours_settled or abs(settled - ours_settled) <= 0.05 * ours_settled + T
        )
        zero = not free or (F[0, 0, 0] == 0.0 and (damped or F[1, 0, 0] == 0.0))
        failed += wrong or not zero
        kind = ("free" if free else "held", "yes" if damped else "no",
                "driven" if one["sensor"] == 0 else "last")  # fmt: skip
        remark = "" if zero else f"F0 = {F[0, 0, 0]:.2g}, F1 = {F[1, 0, 0]:.2g}"
        print(f"{number:2d} {kind[0]:>5s} {kind[1]:>5s} {kind[2]:>7s} | "
              f"{peak:12.3e} {ours:12.3e} {between:12.3e} | {settled:9.4f} {ours_settled:9.4f} "
              f"{remark}{'  DIFFERS' if wrong else ''}", flush=True)  # fmt: skip
    print(f"{failed} of {count} differ")
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main(*map(int, sys.argv[1:])))
