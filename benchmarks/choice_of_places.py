"""Four of 13 holes of the plate of examples/placed_motors: `choose_inputs` beside enumeration.

    python benchmarks/choice_of_places.py [--bandwidth N]

The reduced model has lift, pitch, roll and four flexible modes, all 13 magnets' mass left out and
four sensors at the corners. Every one of the 715 choices is synthesised, at three break frequencies
of the weights; `syntheses` are those of `choose_inputs`, which knows none of them.

With --bandwidth the largest bandwidth within S_max and S_low is found at N choices, those of the
least γ_opt and others at random, to say what γ_opt is worth as a measure of it.
"""

import argparse
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from time import process_time

import numpy as np
from scipy.stats import spearmanr

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.inner_problem.search import search_inner
from ccd_casadi.kernels.gamma import plant_gain
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.choice import choose_inputs
from ccd_casadi.synthesis.synthesis import synthesise

CASE = Path(__file__).parent.parent / "examples" / "placed_motors" / "case.toml"
HOLES = [(x, y) for x in (-0.144, 0.0, 0.144) for y in (-0.09, 0.0, 0.09)]
HOLES += [(x, y) for x in (-0.072, 0.072) for y in (-0.06, 0.06)]
CORNERS = [(x, y) for x in (-0.18, 0.18) for y in (-0.12, 0.12)]
COUNT, MODES, THICKNESS = 4, 7, 8e-3


def reduced(problem) -> ScaledPlant:
    """Forces at all holes to lift, pitch and roll at the corners."""
    nodes = np.array(problem.source.places.nodes)
    source = replace(problem.source, places=None)
    bare = replace(problem, source=source, names=("t",), units=("m",), lower=problem.lower[-1:],
                   upper=problem.upper[-1:], start=problem.start[-1:])  # fmt: skip
    modal = modal_plant(mechanics(plant_of(bare), (THICKNESS,)), problem.suspension)

    def at(points) -> list[int]:
        return [int(np.hypot(*(nodes - point).T).argmin()) for point in points]

    corners = nodes[at(CORNERS)]
    axes = np.linalg.qr(np.column_stack([np.ones(len(corners)), corners]))[0]
    keep, none = slice(MODES), np.zeros((0, MODES, MODES))
    B, C = modal.B[keep][:, at(HOLES)], axes.T @ modal.B[keep][:, at(CORNERS)].T
    small = replace(
        modal, K=modal.K[keep, keep], D=modal.D[keep, keep], B=B, C=C, dM=none, dD=none, dK=none,
        dB=np.zeros((0, *B.shape)), dC=np.zeros((0, *C.shape)),
        natural=modal.natural[keep], rigid=modal.rigid[keep],
    )  # fmt: skip
    return scale_plant(small, problem.weights.M_K)


def with_inputs(plant: ScaledPlant, inputs) -> ScaledPlant:
    """The plant with some of its inputs."""
    B = plant.B[:, list(inputs)]
    gain = plant_gain(plant.A, B, plant.C, plant.grid)
    return replace(plant, B=B, dB=plant.dB[:, :, list(inputs)], gain=gain, channels=())


def _bandwidth(plant: ScaledPlant, weights, inner) -> float:
    """Hz; NaN where no controller is within the bounds."""
    found = search_inner(plant, weights, inner).optimum
    return np.nan if found is None else found.figures.bandwidth / HZ


def main(samples: int) -> int:
    problem = problem_of(load_case(CASE))
    plant = reduced(problem)
    choices = list(combinations(range(len(HOLES)), COUNT))
    wrong = 0
    for hz in (30.0, 60.0, 100.0):
        weights = problem.weights.at(hz * HZ, hz * HZ)
        began = process_time()
        found = choose_inputs(plant, weights, COUNT)
        ours = process_time() - began
        gammas = np.full(len(choices), np.inf)
        for i, inputs in enumerate(choices):
            figures = synthesise(with_inputs(plant, inputs), weights, omega_low=HZ).figures
            gammas[i] = figures.gamma_opt if figures.certified else np.inf
        theirs = process_time() - began - ours
        best = int(gammas.argmin())
        wrong += not found.gamma_opt <= gammas[best] * (1.0 + 1e-6)
        print(f"{hz:5.0f} Hz: {list(found.inputs)}, gamma {found.gamma_opt:.6f} in "
              f"{found.syntheses} syntheses, {ours:.1f} s; enumeration {list(choices[best])}, "
              f"{gammas[best]:.6f} in {len(choices)}, {theirs:.1f} s; "
              f"median {np.median(gammas):.4f}")  # fmt: skip
    if samples:
        order = np.argsort(gammas)
        others = np.random.default_rng(0).permutation(order[samples // 2 :])[: samples // 2]
        chosen = [*order[: samples // 2], *others]
        hz = np.array([
            _bandwidth(with_inputs(plant, choices[i]), problem.weights, problem.inner)
            for i in chosen
        ])  # fmt: skip
        print(f"bandwidth of the choice of least gamma {hz[0]:.2f} Hz, the largest of "
              f"{len(chosen)}: {np.nanmax(hz):.2f} Hz, median {np.nanmedian(hz):.2f} Hz; "
              f"rank correlation {spearmanr(gammas[chosen], -hz).statistic:.2f}")  # fmt: skip
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--bandwidth", type=int, default=0, metavar="N")
    raise SystemExit(main(parser.parse_args().bandwidth))
