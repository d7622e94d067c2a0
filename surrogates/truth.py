"""The truth that a surrogate stands in for: what `retrain` asks of it, and how it is found.

"Truth model" is the term of surrogate-based optimisation (Dakota, for one) for the expensive one.

A run folder names its truth in `truth.json`, {"truth": NAME, ...}, where NAME is an entry point
of the group "surrogates.truth" of an installed package. A folder may come from anybody, so it
never names a file or an import path.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import Array

GROUP = "surrogates.truth"
NAMES = "truth.json"


class TruthError(ValueError):
    """One line that says what the user has to change; `retrain` prints it and exits with 2."""


class TruthInterrupted(RuntimeError):
    """The evaluation was cut short (a worker was killed); what is known is kept."""


@dataclass(frozen=True, eq=False)
class Observations:
    """X (n, d); Y (n, k), a row of NaN where the truth has no value; dY (n, k, d) or None."""

    X: Array
    Y: Array
    dY: Array | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n,) whether the truth has a value there."""
        finite = np.isfinite(self.Y).all(axis=1)
        if self.dY is not None:
            finite &= np.isfinite(self.dY).all(axis=(1, 2))
        return np.asarray(finite)

    def rows(self, mask: NDArray[Any]) -> "Observations":
        """The rows that a mask (n,) or indices select."""
        return Observations(self.X[mask], self.Y[mask], None if self.dY is None else self.dY[mask])


class Truth(Protocol):
    """min objective(x, y) s.t. constraints(x, y) <= 0, lower <= x <= upper, y = truth(x).

    names (d), outputs (k). objective, constraints: casadi.Function of x (d) and y (k), the
    constraints (m, may be empty) scaled so that `tolerance`, relative, is a small violation.
    describe: what is kept with every surrogate. spent: evaluations that the run knows of,
    whoever made them, in the units of a budget.
    """

    names: tuple[str, ...]
    outputs: tuple[str, ...]
    lower: Array
    upper: Array
    tolerance: float
    objective: ca.Function
    constraints: ca.Function
    describe: dict[str, Any]

    @property
    def spent(self) -> int: ...

    def samples(self) -> Observations:
        """All that is known inside the box, oldest first, failures among it."""

    def evaluate(self, X: Array) -> Observations:
        """The truth at X (m, d), in order; kept as it comes, and nothing computed twice."""

    def finish(
        self, x: Array | None, surrogates: Sequence[GaussianProcess], version: str | None
    ) -> str:
        """Verify the design x (None: there is none) and write the results.

        Returns "verified", "not_verified" or "infeasible"; called again with nothing changed
        it computes nothing.
        """


# What an entry point of the group names: opener(folder, tolerance=, workers=, scheduler=, seed=,
# quiet=, user_code=), which raises TruthError. With `user_code` False nothing may run that the
# folder or a file that it names holds; `scheduler` is the address of a cluster to evaluate on, None
# for `workers` processes here, and a truth that knows no clusters raises TruthError for one.
Opener = Callable[..., AbstractContextManager[Truth]]


def opener_of(folder: Path) -> Opener:
    """The truth that a run folder names, or the only one installed where it names none.

    Raises TruthError where the folder is none, or names what is not installed.
    """
    if not folder.is_dir():
        raise TruthError(f"{folder}: there is no such run folder; make one with a solve")
    installed = {point.name: point for point in entry_points(group=GROUP)}
    known = ", ".join(sorted(installed)) or "none"
    path = folder / NAMES
    try:
        document = json.loads(path.read_bytes())
        name = document.get("truth") if isinstance(document, dict) else None
        if not isinstance(name, str):
            raise TruthError(f'{path}: truth: is missing; write {{"truth": NAME}}')
    except FileNotFoundError:
        if len(installed) != 1:
            raise TruthError(
                f"{path}: is missing, and there is not one truth installed but: {known}"
            ) from None
        name = next(iter(installed))
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, TruthError):
            raise
        raise TruthError(f"{path}: is no readable JSON ({error}); solve again") from None
    if name not in installed:
        shown = ascii(name[:60])
        raise TruthError(
            f"{path}: truth: {shown} is not installed (known: {known}); install the package "
            f"that has it as an entry point of the group {GROUP}"
        )
    found: Opener = installed[name].load()
    return found
