"""Sections for both actuators of the dual-stage drive, with |S| no higher than the benchmark's own.

    python examples/disk_drive/design.py [--out FILE] [--seed N] [--starts N] [--workers N]

ends with ω_b on every plant and writes the controllers (see `README.md`).
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plant as drive

from ccd_casadi.fixed_structure import (
    Bounds,
    ChannelStructure,
    Sampling,
    SectionsDesign,
    Structure,
    synthesise,
)
from ccd_casadi.fixed_structure.decoupling import given_decoupling
from ccd_casadi.fixed_structure.design import Progress
from ccd_casadi.plants.scaling import ScaledPlant, scale_state_space
from ccd_casadi.support.process_pool import Workers

HZ = 2.0 * np.pi
SAMPLING = Sampling(drive.RATE_HZ)
# Both actuators see the one sensor: U = (1 1), V = I.
CHANNELS = given_decoupling(("VCM", "PZT"), outputs=[[1], [1]], inputs=[[1, 0], [0, 1]])
# One integrator for the loop: a second one would share its input, and no one would hold the
# difference.
STRUCTURE = ChannelStructure(
    CHANNELS,
    (
        Structure(lead=1, biquads=2, roll_off=1, least_damping=0.05),
        Structure(integrator=False, lead=1, biquads=3, roll_off=1, least_damping=0.05),
    ),
)
# What the benchmark's own controllers reach: the peak of |S|, and |S| at 300 Hz. Roots of K from
# 500 Hz on leave none to gain at 300 Hz alone; below it S falls with the third power of frequency.
BOUNDS = Bounds(S_max=2.087, S_low=0.0345, omega_low=300.0 * HZ, shape=1.1)
FREQUENCIES = (500.0 * HZ, 2.0 * drive.RATE_HZ)
SOFT_HZ = 1.0
GAIN = 0.01  # M_K: with it ω₀ is 9 kHz, where the bandwidth is looked for


def scaled(temperatures: Sequence[float], gains: Sequence[float]) -> list[ScaledPlant]:
    """The plants at these temperatures and gains as the synthesis takes them."""
    found = drive.plants(temperatures, gains, SOFT_HZ)
    return [scale_state_space(one, GAIN) for one in found]


def design(
    structure: ChannelStructure = STRUCTURE,
    *,
    starts: int = 8,
    seed: int = 2,
    workers: int = 1,
    progress: Progress | None = None,
) -> SectionsDesign:
    """The largest bandwidth on 17 temperatures with each of the PZT's gains.

    First a search on nine temperatures at its nominal gain, then from its end on all. The three
    of the benchmark alone are not enough: a controller for these was unstable between them.
    """
    first = synthesise(
        scaled(np.linspace(-1.0, 1.0, 9).tolist(), [1.0]), structure, BOUNDS, sampling=SAMPLING,
        starts=starts, seed=seed, frequencies=FREQUENCIES, workers=Workers(workers),
        progress=progress,
    )  # fmt: skip
    if not first.certified:
        return first
    return synthesise(
        scaled(np.linspace(-1.0, 1.0, 17).tolist(), drive.PZT_GAINS), structure, BOUNDS,
        sampling=SAMPLING, initial=[first.kappa], only_initial=True, frequencies=FREQUENCIES,
        workers=Workers(workers), progress=progress,
    )  # fmt: skip


def written(made: SectionsDesign) -> dict[str, dict[str, float]]:
    """Every section's parameters by actuator: gains, Hz, damping ratios."""
    found: dict[str, dict[str, float]] = {name: {} for name in CHANNELS.names}
    names, kinds = made.structure.names, made.structure.kinds
    for name, kind, value in zip(names, kinds, made.kappa, strict=True):
        actuator, own = name.split(": ")
        found[actuator][own] = float(np.exp(value)) / (HZ if kind == "frequency" else 1.0)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("disk_drive_controller.json"))
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--starts", type=int, default=8)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    made = design(starts=given.starts, seed=given.seed, workers=given.workers, progress=print)
    print(f"{made.words}: {made.bandwidth / HZ:.0f} Hz on every plant")
    given.out.write_text(json.dumps(written(made), indent=1) + "\n")
    print(f"controllers in {given.out}")


if __name__ == "__main__":
    main()
