"""Random plants for the kind with input disturbances: certified or a reason, checked by others.

    OPENBLAS_NUM_THREADS=1 nice python benchmarks/random_disturbances.py [--plants 1000]

Plants and weights are those of `random_syntheses`, one set of weights a plant, W_d 0.01 to 100
times M_K. A certified design is refuted by an eigenvalue with Re >= 0 of the loop in SI, or by one
frequency at which [W1 I; W2 K; W3/M_K K] S [I W_d G], from dense solves in SI, exceeds the bound;
AB13DD of the standard plant closed with the controller says at which frequency to look.

γ_opt is compared with SB10AD's (up to `SB10AD_STATES` states), which gets outputs scaled by a
number so that γ_opt is about 1000: with one input and output it claims 67 whatever is less. Its γ
counts where its controller, at 1.02 times it, keeps its norm (AB13DD and frequencies).
"""

import argparse
import json
import time
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
from random_syntheses import SLACK, Case, draw_case, draw_weights
from slycot import ab13dd
from slycot.exceptions import SlycotError

from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.studies.backends import StandardPlant, balance, mixed_sensitivity, solve_slicot
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.progress import Progress
from ccd_casadi.support.worker_process import Overrun, Runner
from ccd_casadi.synthesis.synthesis import Design, synthesise

SB10AD_STATES = 30  # of the generalized plant; larger ones take it seconds
AGREE = 1e-6


def gains(case: Case, design: Design, omega: np.ndarray) -> np.ndarray:
    """σ_max of the stack at each ω in rad/s."""
    s, w = 1j * omega[:, None, None], design.weights

    def response(system: StateSpace) -> np.ndarray:
        return system.C @ np.linalg.solve(s * np.eye(len(system.A)) - system.A, system.B) + system.D

    g, k = response(case.drawn), response(design.controller)
    one = np.broadcast_to(np.eye(g.shape[1]), (len(g), g.shape[1], g.shape[1]))
    right = np.linalg.solve(one + g @ k, np.concatenate([one, w.disturbance * g], axis=2))
    W1, W2, W3 = w.responses(omega)[:, :, None, None]
    W3 = W3 / w.disturbance  # `responses` has the weight of T there
    stack = np.concatenate([W1 * right, W2 * (k @ right), W3 * (k @ right)], axis=1)
    return np.linalg.norm(stack, 2, axis=(1, 2))


def close(plant: StandardPlant, K: StateSpace) -> StateSpace:
    """The loop from w to z."""
    P, controller = (control.ss(*vars(part).values()) for part in (plant.whole(), K))
    loop = P.lft(controller)
    return StateSpace(*(np.asarray(M) for M in (loop.A, loop.B, loop.C, loop.D)))


def check(case: Case, design: Design) -> tuple[str, float]:
    """What refutes the certificate ("" if nothing), and the largest gain over the bound."""
    plant, K = case.plant, design.controller
    w0, force = plant.omega_0, plant.force
    scaled = StateSpace(K.A / w0, K.B / w0, K.C / force, K.D / force)
    loop = close(balance(mixed_sensitivity(plant, design.weights)), scaled)
    G = case.drawn
    poles = np.linalg.eigvals(np.block([[G.A, G.B @ K.C], [-K.B @ G.C, K.A]]))
    if not poles.real.max() < 0.0:
        return "unstable", np.nan
    omega = [np.geomspace(1e-2 * abs(poles).min(), 1e1 * abs(poles).max(), 60)]
    omega.append(poles.imag[poles.imag > 0.0])
    n, m, p = len(loop.A), loop.B.shape[1], loop.C.shape[0]
    for scaling in "NS":
        with suppress(SlycotError):
            peak = ab13dd("C", "I", scaling, "D", n, m, p, loop.A, np.eye(n), loop.B, loop.C,
                          loop.D, tol=1e-9)[1]  # fmt: skip
            if np.isfinite(peak) and peak > 0.0:
                omega.append(np.array([peak * w0]))
    ratio = float(np.nanmax(gains(case, design, np.concatenate(omega))))
    ratio /= design.figures.certificate.norm_bound
    return ("norm" if ratio > 1.0 + SLACK else ""), ratio


def compared(design: Design, plant: ScaledPlant, runner: Runner) -> dict:
    """SB10AD's γ_opt over ours, and whether its own controller keeps it."""
    given = mixed_sensitivity(plant, design.weights)
    scale = 1e3 / design.figures.gamma_opt
    scaled = replace(
        given, C1=scale * given.C1, D11=scale * given.D11, D12=scale * given.D12
    )  # fmt: skip
    try:
        found = runner.call(10.0, solve_slicot, scaled)
    except Overrun:
        return {"sb10ad": "over 10 s"}
    if found.controller is None:
        return {"sb10ad": "no controller"}
    difference = found.gamma_opt / 1e3 - 1.0
    loop = close(balance(scaled), found.controller)
    stable = np.linalg.eigvals(loop.A).real.max() < 0.0
    norm = hinf_norm(loop)[0] if stable else np.nan
    words = "equal" if abs(difference) <= AGREE else "above" if difference > 0.0 else "below"
    if words != "equal" and not norm <= found.gamma * (1.0 + SLACK):
        words += ", its controller does not keep it"
    return {"sb10ad": words, "difference": difference, "norm": norm / found.gamma}


def one(seed: int, index: int, runner: Runner) -> dict:
    """Plant `index`: outcome, what the check found, SB10AD beside it."""
    try:
        case, rng = draw_case(seed, index)
    except PlantError as error:
        return {"outcome": "REFUSED", "reason": str(error)}
    weights = draw_weights(case.plant, rng)
    weights = replace(weights, disturbance=weights.M_K * 10.0 ** rng.uniform(-2.0, 2.0))
    omega_low = 1e-3 * case.plant.omega_0
    began = time.process_time()
    design = synthesise(case.plant, weights, omega_low=omega_low)
    row = {
        "index": index, "kind": case.kind, "outcome": design.figures.outcome.name,
        "seconds": time.process_time() - began, "limited": design.figures.limited_by_bound,
        "shape": [len(case.drawn.A), case.drawn.B.shape[1], case.drawn.C.shape[0]],
    }  # fmt: skip
    if design.figures.certificate.passed:
        row["check"], row["ratio"] = check(case, design)
        n, m, p = row["shape"]
        if n + p + 2 * m <= SB10AD_STATES:
            row |= compared(design, case.plant, runner)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plants", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    options = parser.parse_args()
    rows = []
    with Runner() as runner, Progress(options.plants, "plants") as bar:
        for index in range(options.plants):
            rows.append(one(options.seed, index, runner))
            bar.advance()
    checked = [row for row in rows if "check" in row]
    beside = [row for row in rows if "sb10ad" in row]
    equal = [abs(row["difference"]) for row in beside if row["sb10ad"] == "equal"]
    found = {
        "plants": len(rows),
        "seed": options.seed,
        "outcomes": dict(Counter(row["outcome"] for row in rows)),
        "outcomes_of_kinds": {
            kind: dict(Counter(row["outcome"] for row in rows if row.get("kind") == kind))
            for kind in ("stage", "state space", "unstable")
        },
        "limited_by_bound": sum(row.get("limited", False) for row in rows),
        "checked": len(checked),
        "refuted": [row for row in checked if row["check"]],
        "largest_gain_over_bound": max((row["ratio"] for row in checked), default=None),
        "sb10ad": dict(Counter(row["sb10ad"] for row in beside)),
        "largest_difference_where_equal": max(equal, default=None),
        "sb10ad_differs": [row for row in beside if row["sb10ad"] in ("above", "below")],
        "median_seconds": float(np.median([r["seconds"] for r in rows if "seconds" in r])),
    }
    (options.out / "random_disturbances.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
