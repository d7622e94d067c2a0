"""What the surrogate promised and what the truth gave, round by round."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ccd_casadi.codesign.formulation import Iterate
from ccd_casadi.drawing.content import Table, Words
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.facts import paragraph, theta_axes
from ccd_casadi.support.units import HZ, small_share


def history_blocks(
    iterates: Sequence[Iterate], problem: CoDesignProblem, result: Mapping[str, Any],
    theta: tuple[float, ...], tolerance: float, *, lifted: bool,
) -> tuple[Words, Table]:  # fmt: skip
    """ω_b and J predicted and true, round by round, the verified design last, and the error."""
    predicted_hz, true_hz = result["surrogate_bandwidth_hz"], result["bandwidth_hz"]
    J = result["objective"]
    last = replace(
        iterates[-1], theta=theta, predicted=HZ * predicted_hz, truth=HZ * true_hz, objective=J,
        predicted_objective=J + problem.w2 * HZ * (predicted_hz - true_hz),
        error=abs(predicted_hz / true_hz - 1.0),
    )  # fmt: skip
    rows = [
        (i.predicted / HZ, i.truth / HZ, i.predicted_objective, i.objective, i.error)
        for i in (*iterates, last)
    ]
    known = np.array(rows, float)
    known[~np.isfinite(known)] = np.nan
    axes = theta_axes(problem)
    units = (f"{name} ({unit})" if unit else name for name, unit, _ in axes)
    head = ("round", *units, "ω_b predicted Hz", "ω_b true Hz", "J predicted", "J true", "error")
    names = [*(str(i + 1) for i in range(len(iterates))), "verified"]
    table = Table(head, tuple(
        (name, *(v * axis[2] for v, axis in zip(item.theta, axes, strict=True)), *row[:-1],
         small_share(row[-1]) if np.isfinite(row[-1]) else "–")
        for name, item, row in zip(names, (*iterates, last), known, strict=True)
    ))  # fmt: skip
    *_, objective, error = known.T
    ends = [small_share(float(e)) for e in error[np.isfinite(error)][[0, -1]]]
    met = np.flatnonzero(error[:-1] <= tolerance)
    stays = bool(met.size and (error[met[0] : -1] <= tolerance).all())
    first = int(met[0]) + 1 if met.size else 0
    lost = int(np.isnan(objective).sum())
    told = (len(iterates), *ends, tolerance, first, stays, lost, lifted)
    return Words(paragraph("report.history", *told)), table
