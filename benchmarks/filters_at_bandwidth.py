"""Is bandwidth bought by a filter: what any pair of roots is worth, on designs and random chains.

    python benchmarks/filters_at_bandwidth.py [CASE [m1=55,m2=55]] [--chains N]

A design is made on the corners of its set. Then each pair of zeros and poles (a biquad) is taken
out, and the rest is designed anew, from what is left and from a few starts beside it. A pair that
cancels to 10 % within an octave of ω_b buys bandwidth (exit code 1) if without it ω_b is more than
3 % lower and the peak of S lower too. Chains: `random_sections` with a biquad and bounds on KS, T.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ccd_casadi.analysis.loop_warnings import bandwidth_dip
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.plant_tables import parse_theta
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem import structured_plant_set as plant_set
from ccd_casadi.inner_problem.structured_search import with_range
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ

sys.path += [str(Path(__file__).parents[1] / folder) for folder in (".", "tests")]

from oracles import random_sections

COSTS, LOWER, CANCELS = 0.03, 1e-3, 0.1  # of ω_b, of the peak of S, of a frequency
STARTS, STARTS_WITHOUT = 12, 4


@dataclass(frozen=True)
class Task:
    """A structure on the plants of a set."""

    plants: Sequence[ScaledPlant]
    structure: Structure
    bounds: Bounds
    sampling: Sampling | None
    frequencies: tuple[float, float] | None = None

    def designed(self, starts: int, initial: Sequence[Array] = ()) -> SectionsDesign:
        return synthesise_sections(
            self.plants, self.structure, self.bounds, sampling=self.sampling, starts=starts,
            initial=initial, frequencies=self.frequencies,
        )  # fmt: skip


@dataclass(frozen=True)
class Removal:
    """A pair (frequency over ω_b, damping), and what is left without it over what there was."""

    zeros: tuple[float, float]
    poles: tuple[float, float]
    bandwidth: float  # NaN where nothing certified is found
    peak: float

    @property
    def buys(self) -> bool:
        (z, _), (p, _) = self.zeros, self.poles
        beside = min(z, p) >= 0.5 and max(z, p) <= 2.0 and abs(z / p - 1.0) < CANCELS
        return beside and self.bandwidth < 1.0 - COSTS and self.peak < 1.0 - LOWER


def peak_of(design: SectionsDesign) -> float:
    assert design.certificate is not None
    return max(figures.S_peak for figures in design.certificate.plants)


def removals(task: Task, design: SectionsDesign) -> Iterator[Removal]:
    """Every biquad taken out in turn."""
    names = task.structure.names
    fewer = replace(task.structure, biquads=task.structure.biquads - 1)
    for number in range(1, task.structure.biquads + 1):
        own = np.array([name.startswith(f"biquad {number} ") for name in names])
        without = replace(task, structure=fewer, frequencies=design.frequencies)
        made = without.designed(STARTS_WITHOUT, [design.kappa[~own]])
        wz, dz, wp, dp = np.exp(design.kappa[own]).tolist()
        omega, left = design.bandwidth, (np.nan, np.nan)
        if made.certified:
            left = made.bandwidth / omega, peak_of(made) / peak_of(design)
        yield Removal((wz / omega, dz), (wp / omega, dp), *left)


def dip_of(task: Task, design: SectionsDesign) -> float:
    assert design.controller is not None
    loops = [Loop(one.plant_si(), design.controller, task.sampling) for one in task.plants]
    return bandwidth_dip(loops, design.bandwidth)


def task_of(path: Path, theta: str | None) -> Task:
    """A case with one channel at a θ, by default its start."""
    case = load_case(path)
    problem, at = with_range(problem_of(case)), theta
    at = at or ",".join(f"{one.name}={one.start:g}" for one in case.theta)
    uncertain = plant_set.uncertain_plant(problem, parse_theta(case, at))
    structured = plant_set.structured_of(problem)
    structure = plant_set.structure_of(problem)
    if not isinstance(structure, Structure):
        sys.exit(f"{path}: has several channels; this takes cases with one")
    return Task(uncertain.plants(uncertain.corners()), structure, plant_set.bounds_of(problem),
                structured.sampling, structured.frequencies)  # fmt: skip


def chains(count: int) -> Iterator[tuple[str, Task]]:
    """The first chains that have a biquad and a bound on KS and T, with the default shape."""
    seed = 0
    while count:
        one = random_sections.case(seed)
        if one.structure.biquads and one.bounds.weighted_level is not None:
            bounds = replace(one.bounds, shape=1.1, S_max=max(one.bounds.S_max, 1.6))
            plants = one.uncertain.plants(one.uncertain.corners())
            yield f"chain {seed}", Task(plants, one.structure, bounds, one.sampling)
            count -= 1
        seed += 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", nargs="?", type=Path)
    parser.add_argument("theta", nargs="?")
    parser.add_argument("--chains", type=int, default=0)
    options = parser.parse_args()
    named = [(str(options.case), task_of(options.case, options.theta))] if options.case else []
    bought = 0
    for name, task in [*named, *chains(options.chains)]:
        design = task.designed(STARTS)
        if not design.certified:
            print(f"{name}: {design.words}", flush=True)
            continue
        dip = 100.0 * (dip_of(task, design) - 1.0)
        print(f"{name}: {design.bandwidth / HZ:.2f} Hz, peak {peak_of(design):.4f}, dip {dip:.1f} "
              f"%, {design.evaluations} loops", flush=True)  # fmt: skip
        for one in removals(task, design):
            bought += one.buys
            change = [100.0 * (value - 1.0) for value in (one.bandwidth, one.peak)]
            (z, dz), (p, dp) = one.zeros, one.poles
            print(f"   zeros {z:.3g} ω_b ({dz:.3g}), poles {p:.3g} ω_b ({dp:.3g}): without "
                  f"ω_b {change[0]:+.1f} %, peak {change[1]:+.2f} %"
                  f"{', buys bandwidth' if one.buys else ''}", flush=True)  # fmt: skip
    print(f"{bought} pairs buy bandwidth")
    return 1 if bought else 0


if __name__ == "__main__":
    sys.exit(main())
