"""What the surrogate promised and what the truth gave, round by round."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ccd_casadi.codesign.formulation import Iterate
from ccd_casadi.drawing.content import Table, Words
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.facts import theta_axes
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ, counted, small_share


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
    return Words(_words(error, int(np.isnan(objective).sum()), tolerance, lifted)), table


def _words(error: Array, lost: int, tolerance: float, lifted: bool) -> str:
    """How the error fell, in numbers."""
    known = error[np.isfinite(error)]
    met = np.flatnonzero(error[:-1] <= tolerance)
    first, last = small_share(float(known[0])), small_share(float(known[-1]))
    words = f"{counted(len(error) - 1, 'round')} of fit, IPOPT and truth: the error "
    words += f"is {last}" if first == last else f"goes from {first} to {last}"
    if met.size:
        stays = (error[met[0] : -1] <= tolerance).all()
        when = f"from round {met[0] + 1} on" if stays else f"first in round {met[0] + 1}"
        words += f" and is within the tolerance of {100.0 * tolerance:g} % {when}"
    else:
        words += f", in no round within the tolerance of {100.0 * tolerance:g} %"
    words += ". "
    if lost:
        words += f"{lost} of the predicted θ had no feasible design. "
    if lifted:
        words += (
            "In the rounds the error is the largest of those of ω_b (relative), ln‖S‖∞ and "
            "ln|S(ω_low)|; at the verified design, of ω_b alone. A round may predict a design just "
            "outside S_max, so its true J may lie below the final one."
        )
    return words.strip()
