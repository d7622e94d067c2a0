"""At most k of n holes by whole co-designs: `solve` with `choose` beside enumeration.

    python benchmarks/choice_of_designs.py [--holes N] [--choose K] [--modes M] [--mass KG]
                                           [--seeds S]

The plate of examples/placed_motors with its first modes, N holes at random (their seed is printed),
a magnet of KG in each that is used and sensors at four corners. Its thickness is searched with the
choice, by mixed sensitivity. Enumeration co-designs every choice of three (one for each axis) to K
holes by itself, with the same search. A row is wrong where its J is worse by more than TOLERANCE.
"""

import argparse
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.catalogue import restricted
from ccd_casadi.codesign.formulations import Direct
from ccd_casadi.codesign.run import solve
from ccd_casadi.inner_problem.problem import CoDesignProblem

FOLDER = Path(__file__).parent.parent / "examples" / "placed_motors"
AXES = 3
TOLERANCE = 1e-4  # of J: local searches end a little apart


def case_of(folder: Path, holes: np.ndarray, given: argparse.Namespace) -> CoDesignProblem:
    """The case holes.toml with other holes, and fewer modes in its table."""
    lines = (FOLDER / "modes.csv").read_text().splitlines()
    kept = [line for line in lines[1:] if int(line.split(",")[1]) <= given.modes]
    (folder / "modes.csv").write_text("\n".join([lines[0], *kept]) + "\n")
    (folder / "nodes.csv").write_text((FOLDER / "nodes.csv").read_text())
    text = (FOLDER / "holes.toml").read_text()
    names = [f"p{i + 1}" for i in range(len(holes))]
    head, rest = text.split("[theta.p1]")
    tail = rest[rest.index("[objective]") :]
    flags = "".join(f"[theta.{name}]\nvalues = [0, 1]\n" for name in names)
    own = {
        "actuators": holes.tolist(),
        "present": names,
        "choose": given.choose,
        "actuator_mass": given.mass,
    }
    table = [
        next((f"{key} = {value}" for key, value in own.items() if line.startswith(f"{key} ")), line)
        for line in head.splitlines()
    ]
    case = folder / "case.toml"
    case.write_text("\n".join([*table, flags + tail]).replace("'", '"'))
    return problem_of(load_case(case))


def enumerated(problem: CoDesignProblem, way: Direct, choose: int) -> tuple[dict, int]:
    """J of every choice (inf: no design), and all syntheses."""
    names = [name for name, _ in problem.listed]
    found, spent = {}, 0
    for count in range(AXES, choose + 1):
        for chosen in combinations(range(len(names)), count):
            lists = {name: (float(i in chosen),) for i, name in enumerate(names)}
            result = solve(restricted(problem, lists), way).result
            found[chosen] = result.get("objective", np.inf) if "theta" in result else np.inf
            spent += result["syntheses"]
    return found, spent


def main(given: argparse.Namespace) -> int:
    wrong, way = 0, Direct(starts=given.starts, box_points=0)
    grid = np.array([(x, y) for x in np.arange(-4, 5) for y in np.arange(-3, 4)]) * [0.036, 0.03]
    for seed in range(given.seeds):
        rng = np.random.default_rng(seed)
        holes = np.round(grid[rng.choice(len(grid), given.holes, replace=False)], 3)
        with TemporaryDirectory() as folder:
            problem = case_of(Path(folder), holes, given)
            began = process_time()
            best = solve(problem, way).result
            ours = process_time() - began
            every, spent = enumerated(problem, way, given.choose)
            theirs = process_time() - began - ours
        listed = best["listed"]
        chosen = tuple(i for i, v in enumerate(listed["chosen"].values()) if v == 1.0)
        least = min(every, key=every.__getitem__)
        J = best.get("objective", np.inf)
        missed = every[least] + TOLERANCE * abs(every[least]) < J
        wrong += missed
        print(
            f"seed {seed}: {best['status']}, {chosen}, J {J:.4f}, {best['syntheses']} syntheses in "
            f"{listed['solved']} combinations and {listed['between']} parts, {ours:.0f} s; "
            f"enumeration {least}, J {every[least]:.4f}, {spent} in {len(every)}, {theirs:.0f} s, "
            f"the second {sorted(every.values())[1]:.4f}{' MISSED' * missed}",
            flush=True,
        )
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--holes", type=int, default=6)
    parser.add_argument("--choose", type=int, default=4)
    parser.add_argument("--modes", type=int, default=7)
    parser.add_argument("--mass", type=float, default=0.12)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--starts", type=int, default=1)
    raise SystemExit(main(parser.parse_args()))
