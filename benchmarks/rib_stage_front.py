"""Mass against bandwidth of the rib stage that has to run: channels apart, from a known design.

    python benchmarks/rib_stage_front.py [--race] [NAME ...]

At each θ below the controllers of benchmarks/rib_stage_design, as they are and moved with the
plant, climb to the largest bandwidth of z, of tip and tilt, and of the twist, each on its own
entries of the set of runs/rib_stage_built.toml: the model and the payload, all modes at either end
of ±2 %, damping at its least. Coupling and the search for worse plants are left out: they took
1.1 % off the design that was carried through (`rib_stage_built.py` judges that one). A climb ends
at a local optimum; with `--race` some random starts are climbed from too. The last lines say what
remains of the co-design's gain. A minute of a core for each θ.
"""

import json
import sys
from pathlib import Path
from time import process_time

import numpy as np
from rib_stage_built import DESIGN, HZ, theta_of

from ccd_casadi.cases.case import load_case, problem_of
from ccd_casadi.fixed_structure import Structure
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.decoupling import channel_plant, in_units_of
from ccd_casadi.fixed_structure.design import synthesise_sections
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.sections_bandwidth import with_range
from ccd_casadi.inner_problem.sections_plant_set import (
    bounds_of,
    sections_of_problem,
    structure_of,
    with_options,
)
from ccd_casadi.inner_problem.sections_warm import moved
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.plants.scaling import ScaledPlant

CASE = Path(__file__).parent.parent / "runs" / "rib_stage_built.toml"
PAYLOAD = 1  # which of the case's option sets
STARTS = 6  # of a race where the known controllers do not climb to a certified one
# h, t_o, t_i, t_c, H, x_i in mm: docs/rib_stage.md has the first five
STAGES = {
    "sequential": (1.0, 3.0, 8.0, 8.0, 17.0, 67.5),
    "descent, K held": (1.0, 3.0, 3.0, 4.93, 9.48, 70.8),
    "descent, total gradient": (1.0, 3.01, 6.19, 6.95, 7.47, 70.1),
    "lifted": (1.0, 3.0, 3.0, 3.0, 7.29, 95.0),
    "fitted to 0.59 kg": (1.0, 3.0, 4.2446, 4.0588, 11.917, 74.974),
    "this set": (1.0, 3.0, 3.0, 4.06, 14.05, 73.0),
    "heavier": (1.0, 3.0, 3.5, 4.5, 17.0, 73.0),
    "heavier still": (1.0, 4.0, 5.7, 5.6, 15.9, 73.0),
}


def plants_at(problem: CoDesignProblem, theta: tuple[float, ...]) -> list[ScaledPlant]:
    """Model and payload, all modes low and high, least damping."""
    u = sections_of_problem(problem).uncertainty
    loaded = with_options(problem, u.options[PAYLOAD])
    systems = tuple(mechanics(plant_of(p), theta, derivatives=False) for p in (problem, loaded))
    box = UncertainPlant(systems, problem.suspension, problem.weights.M_K, u.resonance_shift,
                         u.mode_shift, u.damping, u.gain)  # fmt: skip
    plants = box.plants(box.corners()[len(systems) :])
    return [in_units_of(plant, plants[0]) for plant in plants]


def bandwidths(
    problem: CoDesignProblem,
    plants: list[ScaledPlant],
    known: list[ScaledPlant],
    kappa: np.ndarray,
    race: bool,
) -> dict[str, float]:
    """Hz of every channel with parameters of its own; NaN where no climb is certified."""
    whole, sections = structure_of(problem), sections_of_problem(problem)
    assert isinstance(whole, ChannelStructure)
    found = {}
    for i in whole.free:
        own: Structure = whole.structures[i]
        entries = [j for j in range(len(whole.structures)) if whole.owner(j) == i]
        members = [channel_plant(plant, whole.decoupling, j) for j in entries for plant in plants]
        first = channel_plant(known[0], whole.decoupling, i)
        start = kappa[whole.slices[i]]
        for starts in (STARTS,) if race else (0, STARTS):
            made = synthesise_sections(
                members, own, bounds_of(problem), sampling=sections.sampling,
                initial=[start, moved(own, first, members[0], start)], only_initial=not starts,
                starts=starts, frequencies=sections.frequencies,
            )  # fmt: skip
            if made.certified:
                break
        found[whole.decoupling.names[i]] = made.bandwidth / HZ if made.certified else np.nan
    return found


def main() -> None:
    problem = with_range(problem_of(load_case(CASE)))
    plant = plant_of(problem)
    kappa = np.array(json.loads((DESIGN / "controller.json").read_text())["sections"]["kappa"])
    known = plants_at(problem, tuple(theta_of(DESIGN)))
    names = [name for name in sys.argv[1:] if name != "--race"]
    race, table = len(names) < len(sys.argv) - 1, {}
    for name in names or STAGES:
        began = process_time()
        theta = tuple(1e-3 * value for value in STAGES[name])
        hz = bandwidths(problem, plants_at(problem, theta), known, kappa, race)
        mass, least = hardware_cost(plant, theta), float(np.min(list(hz.values())))
        table[name] = (mass, least, problem.w1 * mass + problem.w2 * HZ * least)
        words = ", ".join(f"{channel} {value:.2f} Hz" for channel, value in hz.items())
        print(f"{name}: {mass:.4f} kg, {words}; J {table[name][2]:.3f}, "
              f"{process_time() - began:.0f} s", flush=True)  # fmt: skip
    if "sequential" in table:
        mass, hz, J = table["sequential"]
        for name, (own, fast, j) in table.items():
            if name != "sequential":
                print(f"{name} against sequential: {own / mass - 1.0:+.0%} mass, "
                      f"{fast / hz - 1.0:+.1%} bandwidth, J {j - J:+.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
