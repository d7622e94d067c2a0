"""`budget` of result.json: the RMS error by source, and its line for a terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from ccd_casadi.budget import BudgetFigures, SourceFigures
from ccd_casadi.inner_problem.design_loops import LoopBudget, loop_budget
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.state_space import StateSpace


def budget_entry(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> dict[str, Any]:
    """`budget` as the one key of a mapping; nothing where the problem has none."""
    found = loop_budget(problem, theta, controller)
    return {} if found is None else {"budget": budget_dict(found)}


def budget_dict(found: LoopBudget) -> dict[str, Any]:
    """The figures on the model, and the largest of all plants; m, N, s; null where infinite."""
    model = found.model
    head: dict[str, Any] = {
        "sampled": found.hold is not None,
        "plants": found.plants,
        "error_rms_largest": found.largest_error,
        "force_rms_largest": found.largest_force,
    }
    if model is None:
        return head | {"reason": "the loop with the model is not stable", "sources": []}
    return head | {
        "error_rms": model.error,
        "error_ma": None if model.window is None else model.average,
        "error_msd": None if model.window is None else model.deviation,
        "force_rms": model.force,
        "window_s": model.window,
        "disagreement": model.disagreement,
        "sources": [_source(item, model) for item in model.sources],
    }


def _source(item: SourceFigures, whole: BudgetFigures) -> dict[str, Any]:
    windowed = whole.window is not None
    return {
        "name": item.source.name,
        "kind": item.source.kind.value,
        "spectrum": "filter" if item.source.shaped else "table",
        "error_rms": item.error,
        "share": (item.error / whole.error) ** 2 if whole.error > 0.0 else 0.0,
        "error_ma": item.average if windowed else None,
        "error_msd": item.deviation if windowed else None,
        "force_rms": item.force,
        "disagreement": item.disagreement,
    }


def budget_lines(result: Mapping[str, Any]) -> list[str]:
    """The budget in a line for a terminal; none for a result without one."""
    budget = result.get("budget")
    if not budget:
        return []
    if not budget["sources"]:
        return [f"error budget  none: {budget['reason']}"]
    worst = max(budget["sources"], key=lambda item: item["share"] or 0.0)
    words = f"{_micro(budget['error_rms'])} RMS"
    if budget["window_s"] is not None:
        words += (
            f" (MA {_micro(budget['error_ma'])}, MSD {_micro(budget['error_msd'])} over "
            f"{1e3 * budget['window_s']:g} ms)"
        )
    force = "infinite" if budget["force_rms"] is None else f"{budget['force_rms']:.4g} N"
    words += f", force {force}; {worst['name']} has {100.0 * (worst['share'] or 0.0):.3g} %"
    if budget["plants"] > 1:
        words += f"; at most {_micro(budget['error_rms_largest'])} on {budget['plants']} plants"
    return [f"error budget  {words}"]


def _micro(metres: float | None) -> str:
    return "infinite" if metres is None else f"{1e6 * metres:.4g} um"
