"""IPOPT from many starts over the unit box: the one driver of every optimisation here."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.support.interrupts import interrupts_kept, raise_dropped
from surrogates.interface import Array

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
class EndPoint:
    """Where IPOPT ended: z (d,) in the unit box, f, its verdict."""

    z: Array
    objective: float
    status: str
    converged: bool


def end_points(
    program: dict[str, ca.MX],
    starts: Iterable[Array],
    options: dict[str, Any] | None = None,
    g_lower: Array | float = -np.inf,
) -> list[EndPoint]:
    """Minimise f(z) s.t. g_lower <= g(z) <= 0, 0 <= z <= 1 from every start (d,).

    `program` holds "x", "f" and "g" as `casadi.nlpsol` takes them; `options` are added to
    OPTIONS. Ctrl-C ends it after the start that is under way.
    """
    solver = ca.nlpsol("program", "ipopt", program, OPTIONS | (options or {}))
    found = []
    for start in starts:
        raise_dropped()
        with interrupts_kept():
            result = solver(x0=np.clip(start, 0.0, 1.0), lbx=0.0, ubx=1.0, lbg=g_lower, ubg=0.0)
        stats = solver.stats()
        found.append(
            EndPoint(
                z=np.clip(np.array(result["x"]).ravel(), 0.0, 1.0),
                objective=float(result["f"]),
                status=str(stats["return_status"]),
                converged=bool(stats["success"]),
            )
        )
    return found
