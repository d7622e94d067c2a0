"""The optimum that surrogates predict, by IPOPT from several starts.

    min J(x, s(x))  s.t.  g(x, s(x)) <= 0,  lower <= x <= upper,  ‖x̂ - x̂_f‖ >= AVOID

with s the surrogates' means, x̂ in the unit box and x_f the points where the truth had no value.
"""

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

import casadi as ca
import numpy as np

from surrogates.acquisition import AVOID
from surrogates.casadi_export import to_casadi
from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import Array
from surrogates.truth import Truth

OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-9,
    "ipopt.acceptable_tol": 1e-7,
    "ipopt.max_iter": 300,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.honor_original_bounds": "yes",
    "show_eval_warnings": False,
}


@dataclass(frozen=True, eq=False)
class Optimum:
    """x (d,), the predicted J there, and from how many starts IPOPT converged."""

    x: Array
    objective: float
    converged: int


def predicted_optimum(
    truth: Truth, surrogates: Sequence[GaussianProcess], starts: Array, failed: Array
) -> Optimum | None:
    """The best local optimum from `starts` (m, d), away from `failed` (f, d); None without one."""
    lower, width = truth.lower, truth.upper - truth.lower
    z = ca.MX.sym("z", len(lower))
    x = lower + width * z
    y = to_casadi(list(surrogates), std=False)(x)
    free = [AVOID**2 - ca.sumsqr(z - point) for point in (failed - lower) / width]
    g = ca.vertcat(truth.constraints(x, y), *free)
    problem = {"x": z, "f": truth.objective(x, y), "g": g}
    solver = ca.nlpsol("predicted", "ipopt", problem, OPTIONS)
    best: Optimum | None = None
    converged = 0
    for start in starts:
        with _interrupts_kept():
            unit = np.clip((start - lower) / width, 0.0, 1.0)
            found = solver(x0=unit, lbx=0.0, ubx=1.0, lbg=-np.inf, ubg=0.0)
        if not solver.stats()["success"]:
            continue
        converged += 1
        objective = float(found["f"])
        if best is None or objective < best.objective:
            unit = np.clip(np.array(found["x"]).ravel(), 0.0, 1.0)
            best = Optimum(lower + width * unit, objective, converged)
    return None if best is None else Optimum(best.x, best.objective, converged)


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """Hold Ctrl-C, which CasADi's solvers swallow, and raise KeyboardInterrupt at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []

    def keep(number: int, frame: FrameType | None) -> None:
        pressed.append(number)

    before = signal.signal(signal.SIGINT, keep)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt
