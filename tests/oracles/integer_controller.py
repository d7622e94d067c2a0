"""A controller in integers from its deployed file alone, written apart from the package's own.

Floor is Python's `//` of whole numbers; nothing of `ccd_casadi` is imported.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class IntegerController:
    """`fixed` of controller.json, sample by sample."""

    def __init__(self, fixed: Mapping[str, Any]) -> None:
        self.fixed = fixed
        self.unit = 2 ** fixed["guard"]
        self.top = 2 ** (fixed["bits"] - 1) - 1
        self.X = [0] * len(fixed["states"])
        self.met = False  # whether anything saturated

    def clamp(self, value: int, most: int) -> int:
        self.met = self.met or abs(value) > most
        return -most if value < -most else most if value > most else value

    def added(self, terms: Sequence[Mapping[str, int]], z: Sequence[int]) -> int:
        total = 0
        for t in terms:
            up = 2 ** max(-t["shift"], 0)
            total += t["value"] * z[t["source"]] * up // 2 ** max(t["shift"], 0)
        return total

    def __call__(self, errors: Sequence[float]) -> list[int]:
        """u in counts of e in SI."""
        e = [self.clamp(round(v / s), self.top)
             for v, s in zip(errors, self.fixed["errors"], strict=True)]  # fmt: skip
        self.heard = e
        z = [*(x // self.unit for x in self.X), *e, *(0 for _ in self.fixed["limits"])]
        u = []
        for terms, most in zip(self.fixed["to_forces"], self.fixed["limits"], strict=True):
            v = (2 * self.added(terms, z) + self.unit) // (2 * self.unit)
            u.append(self.clamp(v, most))
            z[len(self.X) + len(e) + len(u) - 1] = max(min(u[-1] - v, self.top), -self.top)
        self.X = [self.clamp(x + self.added(terms, z), self.top * self.unit)
                  for x, terms in zip(self.X, self.fixed["to_states"], strict=True)]  # fmt: skip
        return u


def driven(
    G: tuple[np.ndarray, ...], controller: Any, forces: np.ndarray, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """y and e words while forces (k, m) in N disturb the plant (A, B, C); u in counts of `steps`,
    or in N where the controller gives floats."""
    A, B, C = G
    x, ys, heard = np.zeros(len(A)), [], []
    for d in forces:
        y = C @ x
        u = np.asarray(controller(-y), float) * steps
        heard.append(getattr(controller, "heard", []))
        x = A @ x + B @ (u + d)
        ys.append(y)
    return np.array(ys), np.array(heard)
