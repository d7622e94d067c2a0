"""A design in words and numbers: the conclusion, the table of the design, and what binds."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import UndefinedError

from ccd_casadi.analysis import MOTOR_LIMITS
from ccd_casadi.codesign.result import at_solve
from ccd_casadi.codesign.verdict import State
from ccd_casadi.drawing.content import Fact, Table
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, FIGURES
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.plant import hardware_slopes
from ccd_casadi.support.terminal import plain
from ccd_casadi.support.text import (
    HZ,
    display_unit,
    number,
    plural,
    small_share,
    spoken,
    template,
    with_unit,
)


def conclusion(result: Mapping[str, Any]) -> str:
    """One sentence with the key numbers, for every kind of controller."""
    theta = theta_words(result) if "theta" in result else ""
    value = FIGURES[result.get("minimise", BANDWIDTH.key)]
    return paragraph("report.conclusion", result, value, theta)


def run_name(place: Path) -> str:
    """Name a run by its folder or its case; `ccd new` names it by the folder around it.

    Parameters
    ----------
    place : Path

    Returns
    -------
    str
    """
    place = place.resolve()
    names = (place.name.removesuffix(".toml"), *(parent.name for parent in place.parents))
    return next((name for name in names if name != "case"), "case")


def cost_words(result: Mapping[str, Any], digits: int = 5) -> str:
    """Write the hardware cost with its unit, where the case gives one.

    Parameters
    ----------
    result : mapping
        Of result.json.
    digits : int
        Significant digits.

    Returns
    -------
    str
    """
    return f"{number(result['hardware_cost'], digits)} {result.get('cost_unit', '')}".strip()


def cost_label(problem: CoDesignProblem, name: str = "hardware cost f") -> str:
    """Name the hardware cost with its unit, on an axis or in the head of a table.

    Parameters
    ----------
    problem : CoDesignProblem
    name : str

    Returns
    -------
    str
    """
    return f"{name} ({problem.cost_unit})" if problem.cost_unit else name


def change_words(before: float | None, after: float | None, digits: int, none: str) -> str:
    """By how many percent a figure changed; `none` where these are 0, empty where not known."""
    if before is None or after is None or before == 0.0:
        return ""
    percent = 100.0 * (after / before - 1.0)
    return none if abs(percent) < 0.5 * 10.0**-digits else f"{percent:+.{digits}f} %"


def theta_axes(problem: CoDesignProblem) -> list[tuple[str, str, float]]:
    """List the parameters with their units on axes.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    list of (name, unit, factor)
        Factor from the SI unit to `unit`.
    """
    ends = zip(problem.names, problem.units, problem.upper, strict=True)
    return [(name, *display_unit(unit, upper)) for name, unit, upper in ends]


def theta_words(result: Mapping[str, Any]) -> str:
    """Write the hardware of a design, such as `m1 = 55 kg, m2 = 55 kg`.

    Parameters
    ----------
    result : mapping
        Of result.json.

    Returns
    -------
    str
    """
    units = result.get("units", {})
    words = []
    for name, value in {**result["theta"], **result.get("fixed", {})}.items():
        words.append(f"{name} = {with_unit(value, units.get(name, ''), 5)}".strip())
    for name, (low, high) in result.get("varies", {}).items():
        unit, factor = display_unit(units.get(name, ""), high)
        words.append(f"every {name} from {factor * low:.5g} to {factor * high:.5g} {unit}".strip())
    return ", ".join(words)


def theta_table(problem: CoDesignProblem, result: Mapping[str, Any]) -> Table:
    """Every parameter with its bounds, and where it lies between them."""
    rows = []
    for i, (name, unit, factor) in enumerate(theta_axes(problem)):
        value, low, high = result["theta"][name], problem.lower[i], problem.upper[i]
        share = (value - low) / (high - low)
        place = "at lower" if share <= 1e-6 else "at upper" if share >= 1 - 1e-6 else "inside"
        numbers = (factor * float(v) for v in (value, low, high, problem.start[i]))
        rows.append((name, unit or "–", *numbers, place))
    lists = result.get("listed", {}).get("values", {})
    for name, value in result.get("fixed", {}).items():
        unit, factor = display_unit(problem.parameter_units[name], value)
        place = f"one of {len(lists[name])}" if name in lists else "fixed"
        rows.append((name, unit or "–", factor * value, "–", "–", "–", place))
    for name, ends in result.get("varies", {}).items():
        unit, factor = display_unit(problem.parameter_units[name], ends[1])
        low, high = (factor * end for end in ends)
        rows.append((name, unit or "–", "–", low, high, "–", "varies"))
    head = ("θ", "unit", "optimum", "lower", "upper", "start", "where")
    return Table(head, tuple(rows))


def requirement_lines(result: Mapping[str, Any]) -> list[str]:
    """Write the requirements for the terminal.

    Parameters
    ----------
    result : mapping
        As result.json has it.

    Returns
    -------
    list of str
        One line for each.
    """
    found = []
    for name, required, achieved, margin, where, evidence in _requirement_rows(result):
        at = f", {where}" if where else ""
        found.append(f"{name} {required}: {achieved}, margin {margin}{at}, {evidence}")
    return found


def requirements_table(result: Mapping[str, Any]) -> Table:
    """The requirements, what is achieved, and what is left of each."""
    head = ("requirement", "at most, or at least", "achieved", "margin", "where", "known by")
    return Table(head, tuple(_requirement_rows(result)))


def margins_table(result: Mapping[str, Any], plants: int) -> tuple[Table, ...]:
    """Margins of the model beside those of the worst plant, each on its own.

    Parameters
    ----------
    result : mapping
        Of result.json.
    plants : int
        That the loop is designed on.

    Returns
    -------
    tuple of Table
        Empty of the model alone, and where one of them is not known.
    """
    model = at_solve(result, "survives")
    if plants < 2 or "phase_margin_deg" not in result or "gain_margin" not in model:
        return ()
    down, up = model["gain_margin"]
    late = at_solve(result, "deployable").get("delay_margin")
    factors = [x for x in (up, 1.0 / down if down else None) if x is not None]
    rows = (
        ("phase", "°", model["phase_margin_deg"], result["phase_margin_deg"]),
        ("gain, × or ÷", "", min(factors, default=None), result["gain_margin"]),
        ("delay", " µs", None if late is None else 1e6 * late, result["delay_margin_us"]),
        ("modulus", "", model["modulus_margin"], result["modulus_margin"]),
    )
    shown = tuple(
        (name, *("unlimited" if x is None else f"{number(x, 3)}{unit}" for x in pair))
        for name, unit, *pair in rows
    )
    return (Table(("margin", "model", f"worst of the {plants} plants designed on"), shown),)


def _requirement_rows(result: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for one in result.get("requirements", ()):
        margin = one["margin"]
        of_lambda = one["required"] == 0.0 and one["name"] not in MOTOR_LIMITS
        known = "not known" if margin is None else f"{_margin_digits(margin)} %"
        yield (
            one["name"], *requirement_words(one), known + " of its range" * of_lambda,
            requirement_place(one), one["evidence"],
        )  # fmt: skip


def _margin_digits(margin: float, *, rounding: float = 1e-8) -> str:
    """In percent; what is missed by less than the last digit is not shown as 0."""
    missed_little = -5e-5 < margin < -rounding
    return f"{100.0 * margin:.1g}" if missed_little else f"{round(100.0 * margin, 2) + 0.0:.2f}"


def requirement_words(
    one: Mapping[str, Any], *, digits: int = 5, least: float = 1e-6
) -> tuple[str, str]:
    """What is required and achieved of an entry of `requirements` in result.json, in the unit that
    an engineer would read it in; a constraint on θ that misses 0 by less than `least` is 0.
    """
    required, achieved = one["required"], one["achieved"]
    units = {"compliance_max": spoken("m/N"), "bandwidth_least_hz": "Hz"}
    unit, factor = display_unit(units.get(one["name"], ""), required)

    def shown(value: float) -> str:
        small = required == 0.0 and abs(value) < least
        return "0" if small else f"{factor * value:.{digits}g} {unit}".strip()

    if one["name"] in MOTOR_LIMITS:  # λ is the share of what the motor allows, less 1
        share = "not known" if achieved is None else f"{100.0 + 100.0 * achieved:.4g} %"
        return "at most 100 % of the motor's", share
    limit = shown(required) if required else "at most 0"
    return limit, "not known" if achieved is None else shown(achieved)


def requirement_place(one: Mapping[str, Any]) -> str:
    """Describe at which frequency and on which plant a requirement is nearest to its limit; may be
    empty."""
    hz, plant = one["frequency_hz"], one["plant"]
    plant = plant.replace("resonance_shift", "resonances")
    return ", ".join(filter(None, ("" if hz is None else f"{number(hz, 4)} Hz", plant)))


def facts(table: str, *known: Any) -> list[Fact]:
    """Render the rows of a table of `templates/facts.txt`, a line each.

    Parameters
    ----------
    table : str
        Its name.
    known : any
        What its words are of.

    Returns
    -------
    list of (str, str, str)
        Quantity, value, remark.
    """
    text = _text(f"facts.{table}", *known)
    rows = ([*line.split(" :: ", 2), "", ""] for line in text.split("\n") if line)
    return [(quantity, value, remark) for quantity, value, remark, *_ in rows]


def paragraphs(part: str, *known: Any, **functions: Any) -> list[str]:
    """The words of a part, `file.macro`, in `templates/`: a blank line ends a paragraph."""
    parts = re.split(r"\n[ \n]*\n", _text(part, *known, **functions))
    return [found for found in (re.sub("[ \n]+", " ", each).strip() for each in parts) if found]


def paragraph(part: str, *known: Any) -> str:
    """All of a part in one."""
    return " ".join(paragraphs(part, *known))


def _text(part: str, *known: Any, **functions: Any) -> str:
    """Raises KeyError where something that it says is not known, as of a run of before."""
    name, macro = part.split(".")
    made = template(
        f"templates/{name}.txt", HZ=HZ, number=number, with_unit=with_unit, counted=plural,
        small_share=small_share, cost_words=cost_words, prediction_words=prediction_words,
        channel_words=channel_words, **functions,
    )  # fmt: skip
    try:
        return str(getattr(made.module, macro)(*known))
    except UndefinedError as error:
        raise KeyError(str(error)) from None


def prediction_words(r: Mapping[str, Any], guess: str) -> str:
    """Write what was predicted of the design; empty without a surrogate.

    Parameters
    ----------
    r : mapping
        Of result.json.
    guess : str
        The predicted value in words.

    Returns
    -------
    str
    """
    line = r.get("verdict", {}).get("predicted", {})
    if r["formulation"] == "direct" or line.get("state") == State.UNKNOWN:
        return ""
    if line.get("left_out") is not None:
        return "not a prediction: the surrogate was fitted with this design"
    return f"predicted {guess} (error {small_share(r['verification_error'])})"


def gain_words(controller: Mapping[str, Any]) -> str:
    """Write the gain of a controller, such as `470 kN/m`, or `z: 470 kN/m, tip: …`.

    Parameters
    ----------
    controller : mapping
        `controller` of result.json.

    Returns
    -------
    str
    """
    if "gain" in controller:
        return with_unit(controller["gain"], spoken("N/m"), 4)
    return ", ".join(
        f"{c['name']}: {with_unit(c['gain'], spoken('N/m'), 4)}" for c in controller["channels"]
    )


def channel_words(own: Mapping[str, Any]) -> str:
    """Write the bounds of a channel and how it meets them.

    Parameters
    ----------
    own : mapping
        An entry of `channel_bounds` of result.json.

    Returns
    -------
    str

    Examples
    --------
    >>> own = {"name": "tilt", "sensitivity_peak": 1.5, "sensitivity_peak_hz": 212.0, "S_max": 1.5,
    ...        "bandwidth_hz": 60.2, "bandwidth_ratio": 1.6}
    >>> channel_words(own)
    'channel tilt: peak 1.5 at 212 Hz (S_max 1.5), 60.2 Hz (at least 1.6 ω_b)'
    """
    peak = f"peak {own['sensitivity_peak']:.6g} at {own['sensitivity_peak_hz']:.4g} Hz"
    if own["S_max"] is not None:
        peak += f" (S_max {own['S_max']:g})"
    if "place" in own:
        where = "the actuator" if own["place"] == "actuator" else f"sensor {own['name']}"
        return f"broken at {where}: {peak}"
    words = f"channel {own['name']}: {peak}, {own['bandwidth_hz']:.6g} Hz"
    if own["bandwidth_ratio"] > 1.0:
        words += f" (at least {own['bandwidth_ratio']:g} ω_b)"
    if "M_K" in own:
        words += f", |W_KS KS| {own['weighted_KS']:.4g} with its M_K"
    return words


def loop_lines(r: Mapping[str, Any]) -> list[str]:
    """Write margins, steps, narrow places at the bandwidth, error budget and move for the terminal.

    Parameters
    ----------
    r : mapping
        Of result.json.

    Returns
    -------
    list of str
    """
    found = [*facts("margins", r), *facts("budget", r), *facts("move", r)]
    return [plain(f"{name.lower():14s}{', '.join(filter(None, rest))}") for name, *rest in found]


def binding(problem: CoDesignProblem, result: Mapping[str, Any]) -> list[str]:
    """A sentence for everything that binds, with what loosening it by 1 % changes."""
    multipliers: dict[str, float] = result["kkt"]["multipliers"]
    names = list(dict.fromkeys([*multipliers, *result["active"]]))
    held = _held_theta(problem, result["theta"], multipliers)
    return [_sentence(problem, name, multipliers.get(name), held) for name in names]


def _held_theta(
    problem: CoDesignProblem,
    theta: Mapping[str, float],
    multipliers: Mapping[str, float],
    *,
    binding: float = 1e-6,
) -> dict[str, float] | None:
    """Compute df by each of bounds and λ that is loosened by 1 of its multiplier's unit, where they
    alone determine θ. None where θ moves otherwise too: that takes second derivatives. A constraint
    binds from a multiplier of `binding` times the largest on."""
    point, plant = [theta[name] for name in problem.names], plant_of(problem)
    width = np.subtract(problem.upper, problem.lower)
    df, dlam = (rows * width for rows in hardware_slopes(plant, point))
    rows = dict(zip(plant.constraint_names, dlam, strict=True))
    for i, name in enumerate(problem.names):
        rows |= {f"{name} lower": -np.eye(len(df))[i], f"{name} upper": np.eye(len(df))[i]}
    most = max(multipliers.values(), default=0.0)
    names = tuple(name for name, mu in multipliers.items() if name in rows and mu > binding * most)
    A = np.array([rows[name] for name in names]).reshape(len(names), len(df))
    if len(names) != len(df) or np.linalg.matrix_rank(A) < len(df):
        return None
    return dict(zip(names, (df @ np.linalg.inv(A)).tolist(), strict=True))


def _sentence(
    problem: CoDesignProblem, name: str, multiplier: float | None, held: dict[str, float] | None
) -> str:
    words, step, loosened = _held(problem, name)
    if multiplier is None or not loosened:  # a constraint on θ has no unit to be loosened by
        return f"{words}."
    falls = multiplier * step  # J does
    in_J = f"J falls by {number(falls, 3)}"
    if held is None or not problem.w2:
        return f"{words}. {loosened}: {in_J}."
    cost = step * held.get(name, 0.0)
    value = (-falls - problem.w1 * cost) / problem.w2
    v, changed = problem.figure, f"the cost by {number(cost, 3)} {problem.cost_unit}".rstrip()
    moves = f"{v.symbol} changes by {v.format_value(value, 3)}, {changed} ({in_J})"
    return f"{words}. {loosened}: {moves}."


def _held(problem: CoDesignProblem, name: str) -> tuple[str, float, str]:
    """Describe what holds the design, a step that loosens it (in the multiplier's unit), and that
    in words."""
    inner, (variable, _, end) = problem.inner, name.rpartition(" ")
    if name == "S_max":
        return f"The peak of S is at S_max = {inner.S_max:g}", 0.01, "Raising S_max by 1 %"
    if name == "S_low":
        return f"|S| at ω_low is at S_low = {inner.S_low:g}", 0.01, "Raising S_low by 1 %"
    if name == "compliance_max" and inner.compliance_max is not None:
        most = with_unit(inner.compliance_max, spoken("m")) + spoken("/N")
        words = f"‖GS‖∞ is at compliance_max = {most}"
        return words, 0.01, "Raising it by 1 %"
    if end in ("lower", "upper") and variable in ("omega_S", "omega_T"):
        ends = inner.omega_S if variable == "omega_S" else inner.omega_T
        value, sign = ends[0 if end == "lower" else 1] / HZ, variable.replace("omega", "ω")
        words = f"{sign} is at the {end} end of its range, {number(value)} Hz"
        return words, 0.01 / float(np.log(ends[1] / ends[0])), "Widening the range there by 1 %"
    if end in ("lower", "upper") and variable in problem.names:
        i = problem.names.index(variable)
        value = (problem.lower if end == "lower" else problem.upper)[i]
        _, unit, factor = theta_axes(problem)[i]
        step = number(0.01 * factor * (problem.upper[i] - problem.lower[i]), 3)
        words = f"{variable} is at its {end} bound, {number(factor * value)} {unit}".rstrip()
        way = "Lowering" if end == "lower" else "Raising"
        return words, 0.01, f"{way} this bound by {step} {unit}".rstrip()
    return f"The constraint “{name}” binds", 1.0, ""
