"""Random (plant, weights) syntheses, every certified design checked by other means.

    OPENBLAS_NUM_THREADS=1 nice python benchmarks/random_syntheses.py [--plants 10000] [--out DIR]

Ten weights a plant; 2 to 60 states, one to four channels; stages, other state spaces, and plants
that no stable-plant synthesis can serve. Plant i depends on the seed and i alone, and its line in
DIR/random_syntheses.jsonl is written when it is done: the same command goes on from there.

Limits and times are processor time: a worker that spends more without a word is killed, and its
synthesis counted as over the limit.

The check builds the loop in SI from the plant as it was drawn: eigenvalues by NumPy, the norm by
SLICOT's AB13DD and by frequency responses at its peak and on a grid. A design is refuted by an
eigenvalue with Re >= 0, or by one frequency at which the stack exceeds the bound. Where AB13DD
exceeds it and no frequency does, `norms.hinf_norm` decides.
"""

import argparse
import json
import multiprocessing
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import psutil

from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant, scale_state_space
from ccd_casadi.support.errors import PlantError
from ccd_casadi.synthesis.synthesis import Design, synthesise
from ccd_casadi.synthesis.weights import Weights

EACH = 10  # weights a plant
LIMIT = 10.0  # seconds a synthesis
PASSED = ("CERTIFIED", "NO_BANDWIDTH")  # the certificate holds; the second has no bandwidth
SLACK = 1e-6  # relative: what the check may be off by
HZ = 2.0 * np.pi


@dataclass(frozen=True)
class Case:
    """One drawn plant in SI, and as the synthesis takes it."""

    kind: str
    drawn: StateSpace
    plant: ScaledPlant


# ---- drawing ----------------------------------------------------------------------------------


def draw_case(seed: int, index: int) -> tuple[Case, np.random.Generator]:
    """Plant `index` of a seed, and the generator that its weights go on with."""
    rng = np.random.default_rng([seed, index])
    states = int(rng.integers(2, 21) if rng.random() < 0.85 else rng.integers(21, 61))
    p = int(rng.choice([1, 2, 3, 4], p=[0.4, 0.25, 0.2, 0.15]))
    m = p if rng.random() < 0.9 else int(rng.integers(1, 5))
    kind = str(rng.choice(["stage", "state space", "unstable"], p=[0.65, 0.3, 0.05]))
    if kind == "stage":
        return _stage(rng, max(1, states // 2), m, p), rng
    return _state_space(kind, rng, states, m, p), rng


def _stage(rng: np.random.Generator, modes: int, m: int, p: int) -> Case:
    """Modes of 1 Hz to 5 kHz, ζ 1e-4 to 0.1, some rigid; sensors at, near or off the actuators.

    ω₀, which M_K sets, lies between 1 Hz and 1 kHz.
    """
    rigid = int(rng.integers(0, min(modes, p) + 1))
    natural = np.concatenate(
        [np.zeros(rigid), HZ * 10.0 ** rng.uniform(0.0, 3.7, modes - rigid)]
    )  # fmt: skip
    B = rng.standard_normal((modes, m)) / np.sqrt(10.0 ** rng.uniform(-1.0, 2.5))
    C = rng.standard_normal((p, modes))
    if m == p:
        C = C * rng.choice([0.0, 0.02, 0.3, 3.0]) + np.abs(rng.standard_normal()) * B.T
    none = tuple(np.zeros((0, *shape)) for shape in [(modes, modes)] * 3 + [B.shape, C.shape])
    zeta = float(10.0 ** rng.uniform(-4.0, -1.0))
    system = Mechanics(
        np.eye(modes), np.zeros((modes, modes)), np.diag(natural**2), B, C, zeta, none
    )
    modal = modal_plant(system, Suspension(10.0 ** rng.uniform(-1.0, 0.5), rng.uniform(0.2, 1.0)))
    zero, one = np.zeros((modes, modes)), np.eye(modes)
    drawn = StateSpace(
        np.block([[zero, one], [-modal.K, -modal.D]]),
        np.vstack([np.zeros((modes, m)), modal.B]),
        np.hstack([modal.C, np.zeros((p, modes))]),
        np.zeros((p, m)),
    )
    omega_0 = HZ * 10.0 ** rng.uniform(0.0, 3.0)
    return Case(
        "stage", drawn, scale_plant(modal, omega_0**2 / (np.linalg.norm(B) * np.linalg.norm(C)))
    )


def _state_space(kind: str, rng: np.random.Generator, states: int, m: int, p: int) -> Case:
    """A random dense A shifted to the left of the axis, or for `unstable` over it.

    ω₀ lies between a tenth and a hundred times the rate of its states.
    """
    A = rng.standard_normal((states, states)) * 10.0 ** rng.uniform(-1.0, 1.0, (states, 1))
    right = np.linalg.eigvals(A).real.max()
    shift = right + 10.0 ** rng.uniform(-3.0, 1.0)
    if kind == "unstable":
        shift = right - 10.0 ** rng.uniform(-3.0, 0.0)
    rate = 10.0 ** rng.uniform(0.0, 4.0)
    A = rate * (A - shift * np.eye(states))
    B, C = rng.standard_normal((states, m)), rng.standard_normal((p, states))
    drawn = StateSpace(A, B, C, np.zeros((p, m)))
    omega_0 = rate * 10.0 ** rng.uniform(-1.0, 2.0)
    return Case(kind, drawn, scale_state_space(drawn, omega_0**2 / np.linalg.norm(C @ A @ B, 2)))


def draw_weights(plant: ScaledPlant, rng: np.random.Generator) -> Weights:
    """Weights of the paper's form, break frequencies over four decades around ω₀."""

    def between(low: float, high: float) -> float:
        return float(10.0 ** rng.uniform(np.log10(low), np.log10(high)))

    w0 = plant.omega_0
    return Weights(
        M_S=rng.uniform(1.2, 4.0), A_S=between(1e-5, 1e-1), omega_S=w0 * between(1e-2, 1e2),
        c_K=between(10.0, 1e5), omega_K=w0 * between(0.1, 10.0), M_K=plant.force,
        A_l=rng.uniform(0.7, 2.0), A_u=between(1e-3, 1e-1), omega_T=w0 * between(1e-2, 1e2),
    )  # fmt: skip


# ---- the independent check --------------------------------------------------------------------


def weighted_loop(G: StateSpace, K: StateSpace, w: Weights) -> StateSpace:
    """r to [W1 e; W2 u; W3 y] in SI, states [x; x_K; W1; W2; W3], weights as k/(s + a) + d."""
    n, N, m, p = len(G.A), len(K.A), G.B.shape[1], G.C.shape[0]
    As = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    Bs = np.vstack([G.B @ K.D, K.B])
    signals = (
        (np.hstack([-G.C, np.zeros((p, N))]), np.eye(p)),
        (np.hstack([-K.D @ G.C, K.C]), K.D),
        (np.hstack([G.C, np.zeros((p, N))]), np.zeros((p, p))),
    )
    a = (w.omega_S * w.A_S, w.c_K * w.omega_K, w.omega_T / w.A_u)
    d = (1.0 / w.M_S, w.c_K / w.M_K, 1.0 / w.A_u)
    at_zero = (1.0 / w.A_S, 1.0 / w.M_K, 1.0 / w.A_l)  # W(0)
    blocks, rows, inputs, outputs, through = [], [], [Bs], [], []
    for (Cv, Dv), pole, direct, gain in zip(signals, a, d, at_zero, strict=True):
        size = Cv.shape[0]
        blocks.append(-pole * np.eye(size))
        rows.append(pole * Cv)
        inputs.append(pole * Dv)
        outputs.append((direct * Cv, (gain - direct) * np.eye(size)))
        through.append(direct * Dv)
    sizes = [n + N, p, m, p]
    edges = np.concatenate([[0], np.cumsum(sizes)])
    A = np.zeros((edges[-1], edges[-1]))
    A[: n + N, : n + N] = As
    C = np.zeros((2 * p + m, edges[-1]))
    top = 0
    for i in range(3):
        own = slice(edges[i + 1], edges[i + 2])
        A[own, : n + N], A[own, own] = rows[i], blocks[i]
        high = outputs[i][0].shape[0]
        C[top : top + high, : n + N], C[top : top + high, own] = outputs[i]
        top += high
    return StateSpace(A, np.vstack(inputs), C, np.vstack(through))


def gains(G: StateSpace, K: StateSpace, w: Weights, omega: np.ndarray) -> np.ndarray:
    """σ_max of the stack at each ω in rad/s, from transfer functions by dense solves."""
    s = 1j * omega[:, None, None]

    def response(system: StateSpace) -> np.ndarray:
        return system.C @ np.linalg.solve(s * np.eye(len(system.A)) - system.A, system.B) + system.D

    g, k = response(G), response(K)
    p = G.C.shape[0]
    S = np.linalg.inv(np.eye(p) + g @ k)
    W1, W2, W3 = w.responses(omega)[:, :, None, None]
    stack = np.concatenate([W1 * S, W2 * (k @ S), W3 * (g @ k @ S)], axis=1)
    return np.linalg.svd(stack, compute_uv=False)[:, 0]


def check(case: Case, design: Design) -> tuple[str, float, float]:
    """What refutes the certificate ("" if nothing), the largest gain over the bound, max Re λ."""
    from slycot import ab13dd
    from slycot.exceptions import SlycotError

    loop = weighted_loop(case.drawn, design.controller, design.weights)
    inner = len(case.drawn.A) + len(design.controller.A)
    poles = np.linalg.eigvals(loop.A[:inner, :inner])
    right = float(poles.real.max())
    if not right < 0.0:
        return "unstable", np.nan, right
    bound = design.figures.certificate.norm_bound
    sizes = np.abs(poles)
    grid = np.geomspace(1e-2 * sizes.min(), 1e1 * sizes.max(), 40)
    omega = [grid, poles.imag[poles.imag > 0.0]]
    n, m, p = len(loop.A), loop.B.shape[1], loop.C.shape[0]
    norms = []
    for scaling in "NS":  # with its scaling AB13DD may overread, by 0.9 % seen; without it, fail
        with suppress(SlycotError):
            norm, peak = ab13dd(
                "C", "I", scaling, "D", n, m, p, loop.A, np.eye(n), loop.B, loop.C, loop.D, tol=1e-9
            )  # fmt: skip
            norms.append(float(norm))
            if np.isfinite(peak) and peak > 0.0:
                omega.append(np.array([peak]))
    found = gains(case.drawn, design.controller, design.weights, np.concatenate(omega))
    ratio = float(np.nanmax(found)) / bound
    if ratio > 1.0 + SLACK:
        return "norm", ratio, right
    if not norms:
        return "AB13DD failed", ratio, right
    if min(norms) > bound * (1.0 + SLACK):  # and no frequency shows it: a third opinion
        third = hinf_norm(loop)[0]
        if third > bound * (1.0 + SLACK):
            return "norm", third / bound, right
        return "AB13DD alone", ratio, right
    return "", ratio, right


# ---- running ----------------------------------------------------------------------------------


def work(pipe: Connection) -> None:
    """Do plants as their indices come, one message a synthesis, until the parent ends."""
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            _plant(pipe, *pipe.recv())


def _plant(pipe: Connection, seed: int, index: int, checked: bool) -> None:
    try:
        case, rng = draw_case(seed, index)
    except PlantError as error:
        pipe.send({"index": index, "refused": str(error)})
        return
    pipe.send(
        {"index": index, "kind": case.kind, "states": len(case.drawn.A),
         "inputs": case.drawn.B.shape[1], "outputs": case.drawn.C.shape[0]}
    )  # fmt: skip
    for _ in range(EACH):
        weights = draw_weights(case.plant, rng)
        began = time.process_time()
        design = synthesise(case.plant, weights, omega_low=1e-3 * case.plant.omega_0)
        row: dict = {
            "outcome": design.figures.outcome.name,
            "seconds": time.process_time() - began,
            "limited": design.figures.limited_by_bound,
        }
        if design.figures.certificate.passed and checked:
            found, ratio, right = check(case, design)
            row |= {"check": found, "ratio": ratio, "pole": right}
        pipe.send(row)


class Worker:
    """A process that is killed when it works on for longer than the limit and says nothing."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()
        self.usage = psutil.Process(self.process.pid)

    def answers(self, limit: float) -> bool:
        """Whether it answers within so many seconds of its processor time."""
        began = sum(self.usage.cpu_times()[:2])
        while not self.pipe.poll(1.0):
            if sum(self.usage.cpu_times()[:2]) - began > limit:
                return False
        return True

    def plant(self, seed: int, index: int, checked: bool) -> dict | None:
        """One plant with all its syntheses; None where the process died or did not start."""
        try:
            return self._plant(seed, index, checked)
        except (EOFError, OSError, psutil.NoSuchProcess):
            self.process.join()
            return None

    def _plant(self, seed: int, index: int, checked: bool) -> dict | None:
        self.pipe.send((seed, index, checked))
        if not self.answers(300.0):  # the first one waits for imports and compiled kernels
            self.process.kill()
            self.process.join()
            return None
        head = self.pipe.recv()
        rows: list[dict] = []
        while "refused" not in head and len(rows) < EACH:
            if not self.answers(LIMIT + 20.0):  # the check has 20 s of its own
                self.process.kill()
                self.process.join()
                return head | {"rows": [*rows, {"outcome": "OVER_LIMIT", "seconds": LIMIT}]}
            row = self.pipe.recv()
            if row["seconds"] > LIMIT:
                row["outcome"] = "OVER_LIMIT"
            rows.append(row)
        return head | {"rows": rows}


def summary(lines: list[dict], seed: int) -> dict:
    """Counts by outcome, kind and size; what the check found; times."""
    rows = [(line, row) for line in lines for row in line.get("rows", [])]
    checked = [row for _, row in rows if "check" in row]
    seconds = [row["seconds"] for _, row in rows]
    sizes = ((2, 10), (11, 20), (21, 40), (41, 60))
    by_size = {}
    for low, high in sizes:
        own = [row for line, row in rows if low <= line["states"] <= high]
        if own:
            times = 1e3 * np.array([row["seconds"] for row in own])
            by_size[f"{low} to {high}"] = {
                "syntheses": len(own),
                "passed": sum(row["outcome"] in PASSED for row in own),
                "median_ms": float(np.median(times)),
                "largest_ms": float(times.max()),
            }
    kinds = {line["kind"] for line, _ in rows}
    return {
        "seed": seed,
        "plants": len(lines),
        "refused_plants": dict(Counter(line["refused"] for line in lines if "refused" in line)),
        "syntheses": len(rows),
        "outcomes": dict(Counter(row["outcome"] for _, row in rows).most_common()),
        "by_kind": {
            kind: dict(Counter(r["outcome"] for line, r in rows if line["kind"] == kind))
            for kind in sorted(kinds)
        },
        "by_states": by_size,
        "checked": len(checked),
        "check": dict(Counter(row["check"] or "agrees" for row in checked)),
        "largest_gain_over_bound": max((row["ratio"] for row in checked), default=None),
        "longest_seconds": max(seconds, default=None),
    }


def main() -> None:
    """Run what is missing, then write the summary."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--plants", type=int, default=10_000)
    arguments.add_argument("--first", type=int, default=0, help="index of the first plant")
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--check-every", type=int, default=1, metavar="N", help="of the plants")
    arguments.add_argument("--out", type=Path, default=Path("runs"))
    options = arguments.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    journal = options.out / "random_syntheses.jsonl"
    lines = []
    if journal.exists():
        lines = [json.loads(t) for t in journal.read_text().splitlines() if t.endswith("}")]
    done = {line["index"] for line in lines}
    todo = [i for i in range(options.first, options.plants) if i not in done]
    worker, began = Worker(), time.monotonic()
    with journal.open("a") as out:
        for count, index in enumerate(todo, 1):
            for _ in range(3):  # the machine may end a worker for want of memory
                line = worker.plant(options.seed, index, index % options.check_every == 0)
                if not worker.process.is_alive():
                    worker = Worker()
                if line is not None:
                    break
            else:
                raise SystemExit(f"plant {index}: three workers died or did not start")
            lines.append(line)
            out.write(json.dumps(line) + "\n")
            out.flush()
            if count % 200 == 0:
                left = (time.monotonic() - began) / count * (len(todo) - count) / 60.0
                print(f"{len(lines)} of {options.plants} plants, {left:.0f} min left", flush=True)
    result = summary(lines, options.seed)
    (options.out / "random_syntheses.json").write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
