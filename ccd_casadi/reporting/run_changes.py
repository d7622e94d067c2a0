"""What changed between two finished runs: figures, requirements, verdict, case file, and |S|.

All figures are those of both `result.json`; nothing is designed.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from difflib import unified_diff
from functools import partial
from pathlib import Path
from typing import Any

from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.paint import write_page
from ccd_casadi.reporting.concerns import lines_of
from ccd_casadi.reporting.decision import advice
from ccd_casadi.reporting.facts import change_words, cost_words, requirement_words, run_name
from ccd_casadi.reporting.gain_figures import gain_panels, run_view
from ccd_casadi.support.text import display_unit, number, spoken

NAME = "changes.html"
FIGURES = (  # key of result.json, its name, its unit
    ("objective", "J", ""),
    ("bandwidth_hz", "bandwidth", "Hz"),
    ("sensitivity_peak", "peak of |S|", ""),
    ("phase_margin_deg", "phase margin", "deg"),
    ("gain_margin", "gain margin", ""),
    ("delay_margin_us", "delay margin", "µs"),
    ("step_overshoot", "overshoot of a step", ""),
    ("settling_ms", "settling of a step", "ms"),
    ("compliance_max", "compliance", "m/N"),
)
_change = partial(change_words, digits=2, none="none")
Row = tuple[str, str, str, str]  # what, the first run, the second, the change


def write_changes(first: FinishedRun, second: FinishedRun) -> Path:
    """Write changes.html into the folder of the second run.

    Parameters
    ----------
    first, second : FinishedRun

    Returns
    -------
    Path
    """
    path = second.folder / NAME
    write_page(path, changes_page(first, second))
    return path


def changes_page(first: FinishedRun, second: FinishedRun) -> c.Page:
    """The page of what changed."""
    runs = (first, second)
    names = run_names(first, second)
    views = [replace(run_view(run), label=name) for run, name in zip(runs, names, strict=True)]
    head = ("", *names, "change")
    S = c.Lines(((gain_panels(views, bounds=False)[0],),), "S of both runs")
    decisions = " ".join(
        f"{name}: {advice(run.result)}" for run, name in zip(runs, names, strict=True)
    )
    chapters = [
        c.Chapter("Requirements", (_requirements(first, second, names),)),
        c.Chapter("Figures", (c.Table(head, tuple(figure_rows(first, second))),)),
        c.Chapter("Sensitivity", (c.Figure(S, "The largest |S| on the plants of each run."),)),
        c.Chapter("Verdict", (_verdicts(first, second, names),)),
        c.Chapter("Case file", (_case(first, second, names),)),
    ]
    meta = datetime.now().strftime("%Y-%m-%d %H:%M")
    title = f"What changed from {names[0]} to {names[1]}"
    return c.Page(c.Head(title, "good", "compared", "", meta, decisions), tuple(chapters))


def run_names(first: FinishedRun, second: FinishedRun) -> tuple[str, str]:
    """Names of two runs that differ: their folders', numbered where these are alike."""
    names = (first.folder.resolve().name, second.folder.resolve().name)
    return names if names[0] != names[1] else (f"{names[0]} (1)", f"{names[1]} (2)")


def figure_rows(first: FinishedRun, second: FinishedRun) -> Iterator[Row]:
    """Hardware, cost and figures of both runs.

    Parameters
    ----------
    first, second : FinishedRun

    Yields
    ------
    tuple of str
        What, the first run, the second, the change.
    """
    a, b = first.result, second.result
    yield ("case", run_name(first.case.path), run_name(second.case.path), "")
    yield ("formulation", a["formulation"], b["formulation"], "")
    thetas = [{**one["theta"], **one.get("fixed", {})} for one in (a, b)]
    units = {**a.get("units", {}), **b.get("units", {})}
    for name in dict.fromkeys((*thetas[0], *thetas[1])):
        values = [theta.get(name) for theta in thetas]
        most = max(abs(value) for value in values if value is not None)
        unit, factor = display_unit(units.get(name, ""), most)
        yield _row(name, values[0], values[1], unit, factor)
    change = _change(a["hardware_cost"], b["hardware_cost"])
    yield ("hardware cost", cost_words(a), cost_words(b), change)
    for key, name, unit in FIGURES:
        known = [one[key] for one in (a, b) if one.get(key) is not None]
        if known:
            shown, factor = display_unit(spoken(unit), max(map(abs, known)))
            yield _row(name, a.get(key), b.get(key), shown, factor)
    orders = [one.get("controller", {}).get("order") for one in (a, b)]
    if any(order is not None for order in orders):
        yield _row("order of the controller", *orders)
    yield _row("syntheses", a["syntheses"], b["syntheses"])
    yield _row("time", a["seconds"], b["seconds"], "s")


def _row(
    name: str, first: float | None, second: float | None, unit: str = "", factor: float = 1.0
) -> Row:
    before, after = (
        "–" if value is None else f"{number(factor * value)} {unit}".strip()
        for value in (first, second)
    )
    return (name, before, after, _change(first, second))


def _requirements(first: FinishedRun, second: FinishedRun, names: tuple[str, str]) -> c.Table:
    """Limits and what is achieved, a requirement a row."""
    found: list[Mapping[str, Mapping[str, Any]]] = [
        {one["name"]: one for one in run.result.get("requirements", ())} for run in (first, second)
    ]
    rows = []
    for name in dict.fromkeys((*found[0], *found[1])):
        cells = []
        for of in found:
            one = of.get(name)
            if one is None:
                cells += ["–", "–"]
                continue
            required, achieved = requirement_words(one)
            cells += [f"{achieved} of {required}", one["evidence"]]
        rows.append((name, *cells))
    head = ("requirement", names[0], "known by", names[1], "known by")
    return c.Table(head, tuple(rows))


def _verdicts(first: FinishedRun, second: FinishedRun, names: tuple[str, str]) -> c.Table:
    """The lines of both verdicts; words where they differ."""
    found = [{line.name: line for line in lines_of(run.result)} for run in (first, second)]
    rows = []
    for name in dict.fromkeys((*found[0], *found[1])):
        lines = [of.get(name) for of in found]
        states = ["–" if line is None else line.state for line in lines]
        words = ["" if line is None else line.words for line in lines]
        rows.append((name, states[0], states[1], "as before" if len(set(words)) == 1 else words[1]))
    return c.Table(("line", *names, f"in words, of {names[1]}"), tuple(rows))


def _case(first: FinishedRun, second: FinishedRun, names: tuple[str, str]) -> c.Words | c.Source:
    """List which lines of the resolved cases differ, defaults included."""
    before, after = (_with_tables(run) for run in (first, second))
    differ = unified_diff(before, after, names[0], names[1], n=0, lineterm="")
    lines = [line for line in differ if not line.startswith("@@")]
    if not lines:
        return c.Words("The case files are alike.")
    return c.Source("\n".join(lines))


def _with_tables(run: FinishedRun) -> list[str]:
    """The lines of a run's case, each key behind the name of its table."""
    table, found = "", []
    for line in case_to_toml(run.case).replace(f"{run.folder.resolve()}/", "").splitlines():
        if line.startswith("["):
            table = line.strip("[]")
        elif line:
            found.append(f"{table}.{line}")
    return found
