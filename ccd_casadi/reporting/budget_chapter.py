"""The error budget on a page: a table by source, and the cumulative error over frequency."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.budget import BudgetFigures
from ccd_casadi.drawing.content import Chapter, Curve, Figure, Lines, Panel, Table, Words
from ccd_casadi.drawing.svg import BLACK, CYCLE
from ccd_casadi.inner_problem.design_loops import LoopBudget, loop_budget
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.support.units import display_unit, spoken

SHOWN = 3e-2  # of the whole error: the axis of frequency starts where this much is together
DECADES = 3.5  # of the error's axis


def budget_chapter(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[Chapter]:
    """Nothing for a problem without a budget."""
    found = loop_budget(problem, theta, controller)
    if found is None:
        return []
    if found.model is None:
        words = "The loop with the model is not stable: it has no stationary error."
        return [Chapter("Error budget", (Words(words),))]
    return [Chapter("Error budget", (*_table(found, found.model), _figure(found.model)))]


def _table(found: LoopBudget, model: BudgetFigures) -> tuple[Words, Table]:
    windowed = model.window is not None
    unit, scale = display_unit(spoken("m"), model.error)
    head = ["source", "enters as", f"RMS error ({unit})", "of the variance (%)"]
    head += [f"MA ({unit})", f"MSD ({unit})"] if windowed else []
    head += ["RMS force (N)"]
    rows = []
    for item in model.sources:
        share = 100.0 * (item.error / model.error) ** 2 if model.error > 0.0 else 0.0
        moving = (scale * item.average, scale * item.deviation) if windowed else ()
        kind = item.source.kind.value.replace("_", " ")
        rows.append((item.source.name, kind, scale * item.error, share, *moving, item.force))
    moving = (scale * model.average, scale * model.deviation) if windowed else ()
    rows.append(("together", "", scale * model.error, 100.0, *moving, model.force))
    words = paragraph("report.budget_table", found, model)
    return Words(words), Table(tuple(head), tuple(rows))


def _figure(model: BudgetFigures) -> Figure:
    shown = [item for item in model.sources if item.cumulative[-1] > 0.0]
    hz = np.unique(np.concatenate([item.hz for item in shown]))
    parts = [np.interp(hz, item.hz, item.cumulative, left=0.0) for item in shown]
    whole = np.sum(parts, axis=0)
    low = float(hz[np.searchsorted(whole, SHOWN**2 * whole[-1])])
    high = float(hz[min(np.searchsorted(whole, (1.0 - 1e-6) * whole[-1]), len(hz) - 1)])
    x = (low, max(2.0 * high, 10.0 * low))
    unit, scale = display_unit(spoken("m"), model.error)
    curves = [
        Curve(hz, scale * np.sqrt(part), item.source.name, CYCLE[i % (len(CYCLE) - 1)],
              "-" if i < len(CYCLE) - 1 else "--")
        for i, (item, part) in enumerate(zip(shown, parts, strict=True))
    ]  # fmt: skip
    total = Curve(hz, scale * np.sqrt(whole), "together", BLACK, width=1.8)
    top = scale * float(np.sqrt(whole[-1]))
    panel = Panel("frequency (Hz)", f"RMS error up to it ({unit})", (*curves, total), log_x=True,
                  log_y=True, x_range=x, y_range=(top * 10.0**-DECADES, 1.5 * top))  # fmt: skip
    lines = Lines(((panel,),), "Cumulative RMS error over frequency by source", (3.4,))
    return Figure(lines, paragraph("report.budget"))
