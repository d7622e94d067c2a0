"""An expensive function that knows nothing of control, for retraining jobs to work on."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.codesign.acquisition import NEAR, distances
from ccd_casadi.codesign.retraining import Outcome, Settings, retrain
from ccd_casadi.codesign.truth import Observations
from surrogates import GaussianProcess
from surrogates.interface import Array


class Camel:
    """min y_0 s.t. y_1 <= 0 over a box, kept in a JSON-lines file: any expensive function.

    y_0 is least on the border that y_1 draws.
    """

    outputs, tolerance = ("cost", "limit"), 1e-3
    lower, upper = np.array([0.0, -2.0]), np.array([1.0, 2.0])
    x, y = ca.MX.sym("x", 2), ca.MX.sym("y", 2)
    objective = ca.Function("J", [x, y], [y[0]])
    constraints = ca.Function("g", [x, y], [y[1]])
    describe: dict[str, Any] = {"about": "a camel"}  # noqa: RUF012

    def __init__(self, folder: Path, hole: bool = False, die_after: int = 10**9) -> None:
        self.path, self.hole, self.die_after = folder / "truth.jsonl", hole, die_after
        self.finished: list[Any] = []

    def _rows(self) -> list[list[float]]:
        return [json.loads(line) for line in self.path.read_text().splitlines()] if (
            self.path.exists()
        ) else []  # fmt: skip

    @property
    def spent(self) -> int:
        return len(self._rows())

    def samples(self) -> Observations:
        return self._at(np.array(self._rows()).reshape(-1, 2))

    def evaluate(self, X: Array) -> Observations:
        known = np.array(self._rows()).reshape(-1, 2)
        assert (distances(self, X, known) > NEAR).all(), "this is known already"
        with self.path.open("a") as stream:
            for x in X:
                if self.die_after == 0:
                    raise KeyboardInterrupt
                self.die_after -= 1
                stream.write(json.dumps(list(x)) + "\n")
        return self._at(X)

    def finish(
        self, x: Array | None, surrogates: Sequence[GaussianProcess], version: str | None
    ) -> str:
        self.finished.append((x, version))
        if x is None:
            return "infeasible"
        y = self._at(x[None]).Y[0]
        predicted = [float(process.predict(x[None])[0]) for process in surrogates]
        return "verified" if np.abs(y - predicted).max() <= self.tolerance else "not_verified"

    def _at(self, X: Array) -> Observations:
        a, b = X[:, 0], (X[:, 1] + 2.0) / 4.0
        u, v = a - 0.5, b - 0.25
        Y = np.column_stack([u**2 + v**2 - 2.0 * u - v + 0.3 * np.sin(9.0 * u * v) - 1.0,
                             np.expm1(u) + 0.5 * v])  # fmt: skip
        if self.hole:  # over the best point without the constraint's border
            Y[np.hypot(u - 0.02, v - 0.02) < 0.15] = np.nan
        return Observations(X, Y)


def true_cost(truth: Any, x: Array) -> float:
    return float(truth._at(x[None]).Y[0, 0])


def finished(folder: Path) -> tuple[Path, Any, Outcome]:
    """A job on a camel in this folder, run to its end."""
    truth: Any = Camel(folder)
    return folder, truth, retrain(folder, truth, Settings(batch=3))
