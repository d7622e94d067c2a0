"""Mass against bandwidth of the rib stage that has to run: what each θ keeps on the set.

    python benchmarks/rib_stage_front.py [--race] [--whole] [--write] [NAME ...]

At each θ below the controllers of benchmarks/rib_stage_design, as they are and moved with the
plant, climb to the largest bandwidth of z, of tip and tilt, and of the twist, each on its own
entries of the set of runs/rib_stage_built.toml: the model and the payload, all modes at either end
of ±2 %, damping at its least. A climb ends at a local optimum; with `--race` some random starts are
climbed from too. A minute of a core for each θ.

With `--whole` the whole loop climbs from there on all three models, the worst plants of the box
are searched and added, and the judge sees the plants that it ends with: some minutes for each θ.
`--write` keeps what was found in benchmarks/rib_stage_on_the_set.json (`--whole` then
begins at the channels kept there), from which `benchmarks/rib_stage_conclusions.py` writes the
tables and sentences of docs/development/rib_stage_built.md.
"""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from rib_stage_built import DESIGN, HZ, theta_of
from rib_stage_on_the_set import ON_THE_SET

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.fixed_structure import Structure, synthesise_sections
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.decoupling import channel_plant, in_units_of
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, true_inner
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    scaled_to_plant,
    structure_of,
    structured_of,
    with_options,
)
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.structured_search import ROUNDS, prepared, with_range
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.studies.sequential import first_resonance

RUNS = Path(__file__).parent.parent / "runs"
CASE, NOMINAL = RUNS / "rib_stage_built.toml", RUNS / "rib_stage.toml"
PAYLOAD = 1  # which of the case's option sets
STARTS = 6  # of a race where the known controllers do not climb to a certified one
# h, t_o, t_i, t_c, H, x_i in mm: docs/rib_stage.md has the first five; the last is the command's
STAGES = {
    "sequential": (1.0, 3.0, 8.0, 8.0, 17.0, 67.5),
    "descent, K held": (1.0, 3.0, 3.0, 4.93, 9.48, 70.8),
    "descent, total gradient": (1.0, 3.01, 6.19, 6.95, 7.47, 70.1),
    "lifted": (1.0, 3.0, 3.0, 3.0, 7.29, 95.0),
    "fitted to 0.59 kg": (1.0, 3.0, 4.2446, 4.0588, 11.917, 74.974),
    "co-designed": tuple(1e3 * value for value in theta_of(DESIGN)),
}


def plants_at(problem: CoDesignProblem, theta: tuple[float, ...]) -> list[ScaledPlant]:
    """Model and payload, all modes low and high, least damping."""
    u = structured_of(problem).uncertainty
    loaded = with_options(problem, u.options[PAYLOAD])
    systems = tuple(mechanics(plant_of(p), theta, derivatives=False) for p in (problem, loaded))
    box = UncertainPlant(systems, problem.weights.M_K, u.resonance_shift,
                         u.mode_shift, u.damping, u.gain)  # fmt: skip
    plants = box.plants(box.corners()[len(systems) :])
    return [in_units_of(plant, plants[0]) for plant in plants]


@dataclass(frozen=True)
class Climb:
    """Hz of every free channel (NaN where none is certified), its κ in SI, all of them stacked."""

    hz: dict[str, float]
    kappa: np.ndarray


def climbs(
    problem: CoDesignProblem,
    plants: list[ScaledPlant],
    known: list[ScaledPlant],
    kappa: np.ndarray,
    race: bool,
) -> Climb:
    """The largest bandwidth of every channel with parameters of its own."""
    whole, sections = structure_of(problem), structured_of(problem)
    assert isinstance(whole, ChannelStructure)
    found, stacked = {}, kappa.copy()
    for i in whole.free:
        own: Structure = whole.structures[i]
        entries = [j for j in range(len(whole.structures)) if whole.owner(j) == i]
        members = [channel_plant(plant, whole.decoupling, j) for j in entries for plant in plants]
        first = channel_plant(known[0], whole.decoupling, i)
        start = kappa[whole.slices[i]]
        for starts in (STARTS,) if race else (0, STARTS):
            made = synthesise_sections(
                members, own, bounds_of(problem), sampling=sections.sampling,
                initial=[start, scaled_to_plant(own, first, members[0], start)],
                only_initial=not starts, starts=starts, frequencies=sections.frequencies,
            )  # fmt: skip
            if made.certified:
                break
        found[whole.decoupling.names[i]] = made.bandwidth / HZ if made.certified else np.nan
        stacked[whole.slices[i]] = made.kappa
    return Climb(found, stacked)


def on_the_whole_set(
    problem: CoDesignProblem, theta: tuple[float, ...], kappa: np.ndarray
) -> dict[str, Any]:
    """The whole loop climbed from κ, worst plants added; the judge's word on the plants of its end.

    `worst_excess`: by how much a last search of the box, with another seed, passed a bound.
    """
    sections = replace(structured_of(problem), warm_starts=(tuple(map(float, kappa)),))
    asked = replace(problem, controller=sections, start=theta)
    asked, made, _ = prepared(asked, lambda words: print(f"  {words}", flush=True), None, True)
    if not made.certified or made.certificate is None:
        return {"certified": False, "reason": made.words}
    worst = DesignOnBox(asked, theta, made).worst(turn=ROUNDS)[0]
    return {
        "certified": True,
        "bandwidth_hz": made.bandwidth / HZ,
        "sensitivity_peak": max(plant.S_peak for plant in made.certificate.plants),
        "plants": len(made.certificate.plants),
        "worst_excess": float(np.expm1(worst.value)),
        "kappa": made.kappa.tolist(),
    }


def shipped() -> dict[str, Any]:
    """The same of the design in benchmarks/rib_stage_design, which is not climbed again."""
    kept = json.loads((DESIGN / "inner.json").read_text())
    return {"certified": True, "bandwidth_hz": kept["bandwidth_hz"], "plants": len(kept["set"])}


def nominal(problem: CoDesignProblem, theta: tuple[float, ...]) -> dict[str, float]:
    """Mixed sensitivity at θ on the model alone, as runs/rib_stage.toml asks."""
    found = true_inner(problem, theta)
    return {"bandwidth_hz": found.bandwidth / HZ,
            "first_resonance_hz": first_resonance(problem, np.array(theta))[0] / HZ}  # fmt: skip


def read() -> dict[str, Any]:
    """The rows that are kept."""
    return dict(json.loads(ON_THE_SET.read_text())) if ON_THE_SET.is_file() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(STAGES))
    for name in ("--race", "--whole", "--write"):
        parser.add_argument(name, action="store_true")
    given = parser.parse_args()
    problem, alone = with_range(problem_of(load_case(CASE))), problem_of(load_case(NOMINAL))
    kappa = np.array(json.loads((DESIGN / "controller.json").read_text())["sections"]["kappa"])
    known = None
    for name in given.names or STAGES:
        began = process_time()
        theta = tuple(round(1e-3 * value, 9) for value in STAGES[name])
        row = read().get(name, {})
        if not (given.whole and given.write and row.get("theta") == list(theta)):
            known = known or plants_at(problem, tuple(theta_of(DESIGN)))
            climb = climbs(problem, plants_at(problem, theta), known, kappa, given.race)
            row = {"theta": list(theta), "mass": hardware_cost(plant_of(problem), theta),
                   "nominal": nominal(alone, theta),
                   "apart_hz": climb.hz, "apart_kappa": climb.kappa.tolist()}  # fmt: skip
        words = ", ".join(f"{channel} {value:.2f} Hz" for channel, value in row["apart_hz"].items())
        print(f"{name}: {row['mass']:.4f} kg, {words}, {process_time() - began:.0f} s", flush=True)
        if given.whole:
            same = np.allclose(theta, theta_of(DESIGN), rtol=0.0, atol=1e-8)
            begin = np.array(row["apart_kappa"])
            row["whole"] = shipped() if same else on_the_whole_set(problem, theta, begin)
            told = {key: value for key, value in row["whole"].items() if key != "kappa"}
            print(f"{name}: {told}, {process_time() - began:.0f} s", flush=True)
        if given.write:
            rows = read() | {name: row}  # another process may have written its own
            ordered = {key: rows[key] for key in STAGES if key in rows}
            ON_THE_SET.write_text(json.dumps(ordered, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
