"""The files of a run folder read back, each value checked: one line where it is something else."""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


def read_json(path: Path) -> Mapping[str, Any]:
    """Read a JSON object.

    Parameters
    ----------
    path : Path

    Returns
    -------
    mapping

    Raises
    ------
    UserError
        There is none.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        words = "solve the case first"
        if (path.parent / "drive.json").exists():
            words = "the folder is of `ccd drive`, whose answer is sheet.txt and cascade.c"
        raise UserError(f"{path}: there is no such file; {words}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}; make the run again") from None
    except (ValueError, RecursionError):
        raise UserError(f"{path}: is not valid JSON; make the run again") from None
    if not isinstance(found, dict):
        raise UserError(f"{path}: holds no JSON object; make the run again")
    return found


@contextmanager
def refuse_damaged(place: str, words: str) -> Iterator[None]:
    """Raise UserError in these words where the block finds that a file holds something else."""
    try:
        yield
    except (KeyError, TypeError, ValueError, OverflowError):
        raise UserError(f"{place}: {words}") from None


def number_of(
    path: Path, table: Mapping[str, Any], key: str, low: float = 0.0, high: float = math.inf,
    words: str = "is not a positive number",
) -> float:  # fmt: skip
    """A number of a table between low and high, both left out; `key` is dotted, for messages."""
    value = table.get(key.rpartition(".")[2])
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        raise UserError(f"{path}: {key}: {words}; make the run again")
    return float(value)


def theta_of(path: Path, result: Mapping[str, Any], problem: CoDesignProblem) -> tuple[float, ...]:
    """θ (n,) of result.json in SI, within the bounds of the problem."""
    table, values = result.get("theta"), []
    if not isinstance(table, dict) or set(table) != set(problem.names):
        words = f"does not name {', '.join(problem.names)} as case.toml does; make the run again"
        raise UserError(f"{path}: theta: {words}")
    for name, low, high in zip(problem.names, problem.lower, problem.upper, strict=True):
        words, slack = (
            f"is outside the bounds {low:g} to {high:g} of case.toml",
            1e-9 * (high - low),
        )
        values.append(number_of(path, table, f"theta.{name}", low - slack, high + slack, words))
    return tuple(values)


def controller_of(path: Path, plant: ScaledPlant) -> StateSpace:
    """The controller of controller.json in SI, of the size that the plant needs."""
    table, m, p = read_json(path), plant.B.shape[1], plant.C.shape[0]
    found: dict[str, Array] = {}
    for key in "ABCD":
        with refuse_damaged(f"{path}: {key}", "is not a matrix; make the run again"):
            found[key] = np.array(table[key], dtype=float)
            n = len(found["A"])
    for key, shape in {"A": (n, n), "B": (n, p), "C": (m, n), "D": (m, p)}.items():
        if found[key].shape != shape or not np.isfinite(found[key]).all():
            words = f"is not a finite matrix {shape} for this plant; make the run again"
            raise UserError(f"{path}: {key}: {words}")
    return StateSpace(*found.values())


def sections_kappa(folder: Path, structure: Structure | ChannelStructure) -> tuple[float, ...]:
    """κ in SI of a fixed structure, from the controller.json of a folder. Raises UserError where it
    is of another structure.
    """
    path = folder / "controller.json"
    words = f"is not a list of the {len(structure.names)} parameters of the case's structure"
    with refuse_damaged(f"{path}: sections.kappa", f"{words}; name a run of this case"):
        kappa = np.array(read_json(path)["sections"]["kappa"], dtype=np.float64)
        if kappa.shape != (len(structure.names),) or not (np.abs(kappa) < 200.0).all():
            raise ValueError("of another structure")
    return tuple(map(float, kappa))
