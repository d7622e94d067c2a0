"""Inputs that nobody should give, made from a seed: case files, thetas, plants, run folders.

`make(seed, folder, run)` writes an input into an empty folder and says how to call a command with
it. The same seed makes the same input.
"""

import random
from collections.abc import Callable
from pathlib import Path

from oracles.fuzz_cases import case_file, theta
from oracles.fuzz_folders import faulty, interrupted, run_folder
from oracles.fuzz_plants import plant, valid
from oracles.fuzz_values import Input

Maker = Callable[[random.Random, Path, Path], Input]
FAMILIES: dict[str, tuple[float, Maker]] = {
    "case": (36, case_file),
    "theta": (18, theta),
    "plant": (22, plant),
    "folder": (16, run_folder),
    "fault": (0.3, faulty),
    "interrupt": (0.3, interrupted),
    "valid": (3, valid),
}


def make(seed: str, folder: Path, run: Path) -> Input:
    """The input of a seed; `run` is a finished run folder to spoil copies of."""
    rng = random.Random(seed)
    families = list(FAMILIES)
    family = rng.choices(families, [FAMILIES[name][0] for name in families])[0]
    return FAMILIES[family][1](rng, folder, run)
