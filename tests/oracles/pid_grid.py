"""PID by the package's search beside dense grids over its parameters, on five plants.

    OPENBLAS_NUM_THREADS=1 python benchmarks/oracle.py pid_grid [NAME ...] [--write]

    K(s) = k (1 + ω_i/s) (1 + s/z)/(1 + s/p) / (1 + s/r)

The grid shares nothing with the package but the plants' matrices (`pid_judge`). Over
ln(ω_i, z, p, r) it is dense in the whole box, with 36 gains at every point; from its best points
that lie far apart it is refined by samples around the best of the samples before (their mean and
covariance, since the best lies in a narrow valley between bounds), with gains around theirs. Until
half way bounds may be passed, ever less. What the search finds goes to the same judge. `--write`
keeps the results in benchmarks/pid_grid.json.
"""

import argparse
import importlib.util
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.plants.modal import Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.plants.registry import two_mass
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.synthesis.weights import Weights
from oracles.pid_judge import Loop, Table, controller, judged, loop_of, near, poles

HZ = 2.0 * np.pi
RESULTS = Path(__file__).parents[2] / "benchmarks/pid_grid.json"
PID = Structure(integrator=True, lead=1, biquads=0, roll_off=1)


@dataclass(frozen=True)
class GridOptions:
    """Numbers of the grid and of its refinements."""

    coarse: tuple[int, ...] = (8, 12, 10, 8)  # points of ln ω_i, z, p, r
    gains: int = 36
    local_gains: int = 15
    basins: int = 4  # starts of a refinement
    apart: float = 0.8  # by how much they differ in a logarithm
    samples: int = 250
    best: int = 25
    rounds: int = 28
    slack: int = 14  # rounds in which bounds may be exceeded, ever less


def refined(loop: Loop, options: GridOptions = GridOptions()) -> tuple[float, np.ndarray, int]:
    """The grid's best ω_b in rad/s, its κ, and how many controllers were looked at."""
    o, table = options, Table.of(loop, loop.frequencies())
    low, high = loop.low, loop.high
    axes = [np.linspace(low[i + 1], high[i + 1], count) for i, count in enumerate(o.coarse)]
    shapes = np.array([(0.0, *row) for row in itertools.product(*axes)])
    shapes = shapes[shapes[:, 3] <= shapes[:, 4]]  # p and r change places without a change of K
    # Gains that bring |K| to the same range at one frequency, however slow the zeros are.
    size = np.log(np.abs(controller(shapes, np.array([[1j * loop.crossover]]))))
    gains = np.clip(np.linspace(high[0] - np.log(1e3), high[0], o.gains) - size, low[0], high[0])
    # Between the points of a grid bounds are passed by little: these too are worth refining.
    value = table.bandwidths(shapes, gains, slack=0.15)
    examined = value.size
    starts: list[np.ndarray] = []
    for flat in np.argsort(-value, axis=None):
        row, j = np.unravel_index(flat, value.shape)
        if not np.isfinite(value[row, j]) or len(starts) == o.basins:
            break
        kappa = shapes[row].copy()
        kappa[0] = gains[row, j]
        far = all(np.abs(kappa - other).max() > o.apart for other in starts)
        if far and (poles(loop, kappa).real < 0.0).all():
            starts.append(kappa)
    best, where = -np.inf, np.full(5, np.nan)
    spacing = np.array([np.log(1e3) / o.gains, *(axis[1] - axis[0] for axis in axes)])
    for number, start in enumerate(starts):
        rng = np.random.default_rng(number)
        mean, cov, own, at = start, np.diag(spacing**2), -np.inf, start
        fine, seen = table, np.geomspace(0.3, 30.0, 400) * loop.crossover
        for turn in range(o.rounds):
            if turn >= o.slack and (turn - o.slack) % 5 == 0:  # as the judge will see them
                seen = np.concatenate([seen, near(poles(loop, mean), 40)])
                fine = Table.of(loop, loop.frequencies(seen))
            kappa = rng.multivariate_normal(mean, cov, o.samples)
            kappa = np.clip(np.vstack([mean, at, kappa]), low, high)
            wide = max(2.0 * float(np.sqrt(cov[0, 0])), 1e-5)
            local = np.clip(kappa[:, :1] + np.linspace(-wide, wide, o.local_gains), low[0], high[0])
            slack = 0.15 * 0.6**turn if turn < o.slack else 0.0
            value = fine.bandwidths(kappa, local, slack)
            examined += value.size
            top = np.argmax(value, axis=1)
            kappa[:, 0] = local[np.arange(len(kappa)), top]
            value = value[np.arange(len(kappa)), top]
            chosen = []
            for row in np.argsort(-value):
                if len(chosen) == o.best or not np.isfinite(value[row]):
                    break
                if (poles(loop, kappa[row]).real < 0.0).all():
                    chosen.append(row)
            if not chosen:
                cov = 0.25 * cov
                continue
            if slack == 0.0 and value[chosen[0]] > own:
                own, at = float(value[chosen[0]]), kappa[chosen[0]]
            mean = kappa[chosen].mean(0)
            spread = kappa[chosen] - mean
            cov = 1.5 * spread.T @ spread / len(chosen) + 1e-14 * np.eye(5)
        if own > best:
            best, where = own, at
    return best, where, examined


def example(name: str, function: str) -> Callable[..., Any]:
    """A plant function of one of the examples."""
    path = Path(__file__).parents[2] / "examples" / name / "plant.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Callable[..., Any] = getattr(module, function)
    return found


def tutorial(theta: dict[str, Any]) -> dict[str, Any]:
    """The stage of docs/tutorial.md; rib and plate in mm."""
    ribs = 0.05 * theta["rib"]
    table, chuck = 2.0 + 0.4 * theta["plate"] + 0.5 * ribs, 1.5 + 0.5 * ribs
    return {
        "mass": ca.diag(ca.vertcat(table, chuck)),
        "stiffness": 2.0e6 * (theta["rib"] / 10.0) ** 3 * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": 0.01,
        "input": ca.DM([1, 0]),
        "output": ca.DM([[0.3, 0.7]]),
        "hardware_cost": table + chuck,
    }


def acc(theta: dict[str, Any]) -> dict[str, Any]:
    """Two masses of 1 kg and a spring of k N/m, force on one and sensor on the other (ACC 1990)."""
    return {
        "mass": ca.DM.eye(2),
        "stiffness": theta["k"] * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": 0.01,
        "input": ca.DM([1, 0]),
        "output": ca.DM([[0, 1]]),
        "hardware_cost": theta["k"],
    }


def weights(M_K: float, omega_K_hz: float) -> Weights:
    return Weights(M_S=2.0, A_S=1e-4, omega_S=800.0 * HZ, c_K=1e4, omega_K=omega_K_hz * HZ,
                   M_K=M_K, A_l=1.0, A_u=1e-2, omega_T=25.0 * HZ)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A plant and its bounds."""

    function: Callable[..., Any]
    theta: dict[str, float]
    options: dict[str, float]
    bounds: Bounds
    M_K: float
    expected_hz: float  # about: the boxes of the parameters lie around it
    shifts: tuple[float, ...] = (0.0,)
    suspended_hz: float = 0.1


CASES = {
    "two_mass (55, 55), +-3 %": Case(
        two_mass, {"m1": 55.0, "m2": 55.0}, {"zeta": 0.01},
        Bounds(1.75, 0.03, HZ, 1.1, 8.426, weights(2e7, 100.0)), 2e7, 25.0, (0.0, -0.03, 0.03),
    ),
    "tutorial stage, rib 19 mm": Case(
        tutorial, {"rib": 19.0, "plate": 6.0}, {},
        Bounds(2.0, 0.03, HZ, 1.1, 16.12, weights(2e6, 200.0)), 2e6, 60.0, (0.0, -0.05, 0.05),
    ),
    "guided beam, 30 mm": Case(
        example("guided_beam", "beam"), {"guide": 0.03, "tip": 0.03},
        {"zeta": 0.01, "volume": 0.3}, Bounds(2.0, 0.05, HZ, 1.1), 1e6, 60.0,
    ),
    "three-mass axis, not collocated": Case(
        example("three_mass_axis", "axis"), {"d": 5e-3, "b": 10e-3},
        {"zeta": 0.01, "least_tool_stiffness": 2e5},
        Bounds(2.0, 0.05, HZ, 1.2, compliance_max=2e-4), 1e5, 20.0,
    ),
    "ACC benchmark": Case(
        acc, {"k": 1.0}, {}, Bounds(2.0, 0.5, 0.001 * HZ, 1.2), 0.2, 0.01,
        suspended_hz=1e-5,
    ),
}  # fmt: skip


def compared(case: Case, seed: int) -> dict[str, Any]:
    """The search and the grid on one plant."""
    plant = build_plant(case.function, tuple(case.theta), case.options)
    system = mechanics(plant, np.array(list(case.theta.values())))
    suspension = Suspension(case.suspended_hz)
    started = time.process_time()
    plants = [scale_plant(modal_plant(system, suspension, Perturbation(shift, 1.0)), case.M_K)
              for shift in case.shifts]  # fmt: skip
    made = synthesise_sections(plants, PID, case.bounds, seed=seed)
    spent = time.process_time() - started
    loop = loop_of(system, suspension, case.shifts, case.bounds,
                   case.expected_hz * HZ, made.frequencies[0])  # fmt: skip
    started = time.process_time()
    _, kappa, examined = refined(loop)
    grid, over = judged(loop, kappa)
    row: dict[str, Any] = {
        "grid_hz": grid / HZ, "grid_over_bound": over, "grid_kappa": np.exp(kappa).tolist(),
        "controllers": examined, "grid_seconds": time.process_time() - started,
        "outcome": made.outcome.value, "search_seconds": spent,
    }  # fmt: skip
    if made.certified:
        own, over = judged(loop, np.asarray(made.kappa))
        row |= {"search_hz": made.bandwidth / HZ, "search_judged_hz": own / HZ,
                "search_over_bound": over, "search_kappa": np.exp(made.kappa).tolist(),
                "difference": made.bandwidth / grid - 1.0,
                "optima_hz": [[o.bandwidth / HZ, o.count] for o in made.local_optima]}  # fmt: skip
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="beginnings of plants' names; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    rows: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name, case in CASES.items():
        if options.names and not name.startswith(tuple(options.names)):
            continue
        rows[name] = row = compared(case, options.seed)
        print(f"{name:32s} search {row.get('search_hz', np.nan):.3f} Hz, grid "
              f"{row['grid_hz']:.3f} Hz of {row['controllers']} controllers, "
              f"{row.get('difference', np.nan):+.2%}", flush=True)  # fmt: skip
        print("   ", json.dumps(row), flush=True)
        if options.write:
            RESULTS.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
