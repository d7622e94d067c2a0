"""A design in words and numbers: the conclusion, the table of the design, and what binds."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.drawing.content import Fact, Table
from ccd_casadi.inner_problem.figure import BANDWIDTH, FIGURES
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.support.terminal import plain
from ccd_casadi.support.units import HZ, counted, display_unit, number, small_share, with_unit


def conclusion(result: Mapping[str, Any]) -> str:
    """One sentence with the key numbers, for every kind of controller."""
    if result["status"] == "infeasible":
        return f"No feasible design: {result['reason']}"
    verdict = "a verified design" if result["status"] == "verified" else "an UNVERIFIED design"
    begins = f"The {result['formulation']} formulation ends at {verdict}, {theta_words(result)}"
    hz = f"{number(result['bandwidth_hz'])} Hz"
    cost = f"a hardware cost of {cost_words(result)} (J = {number(result['objective'], 6)})"
    if "race" in result:  # a fixed structure
        order = f"a controller of order {result['controller']['order']}"
        v = FIGURES[result.get("minimise", BANDWIDTH.key)]
        own = "" if v is BANDWIDTH else f"{v.words} {v.shown(result[f'{v.entry}_of_set'])} and "
        return f"{begins}: {order} with {own}a bandwidth of {hz} on {_plants(result)}, at {cost}."
    certificate = result["certificate"]
    proof = (
        f"certified stable with ‖[W_S S; W_KS KS; W_T T]‖∞ ≤ {number(certificate['norm_bound'])}"
        if certificate["passed"]
        else "NOT certified"
    )
    return (
        f"{begins}, with a closed-loop bandwidth of {hz} at {cost}, {proof}. It took "
        f"{result['syntheses']} true syntheses and {number(result['seconds'], 2)} s."
        f"{_prediction(result)}"
    )


def _plants(result: Mapping[str, Any]) -> str:
    designed, judged = (result[name]["plants"] for name in ("certificate", "robust"))
    if designed == judged == 1:
        return "the model, the only plant of its set"
    again = counted(judged, "plant")
    return f"each of {counted(designed, 'plant')}, judged again on {again} of the box"


def _prediction(result: Mapping[str, Any]) -> str:
    """How good the prediction was; of a design that was itself a sample the figure says nothing."""
    line = result.get("verdict", {}).get("predicted", {})
    if result.get("formulation") == "direct":
        return ""
    if line.get("left_out") is not None:
        missed = number(100.0 * line["left_out"], 2)
        return f" It is a training sample; a surrogate without it misses ω_b by {missed} %."
    return f" The prediction errs by {small_share(result['verification_error'])}."


def run_name(place: Path) -> str:
    """Of a run by its folder or its case; what `ccd new` makes is named by the folder around it."""
    place = place.resolve()
    names = (place.name.removesuffix(".toml"), *(parent.name for parent in place.parents))
    return next((name for name in names if name != "case"), "case")


def cost_words(result: Mapping[str, Any], digits: int = 5) -> str:
    """The hardware cost with its unit, where the case gives one."""
    return f"{number(result['hardware_cost'], digits)} {result.get('cost_unit', '')}".strip()


def cost_axis(problem: CoDesignProblem) -> str:
    """The hardware cost on an axis."""
    return f"hardware cost f ({problem.cost_unit})" if problem.cost_unit else "hardware cost f"


def theta_axes(problem: CoDesignProblem) -> list[tuple[str, str, float]]:
    """Name, unit for the eye and the factor to it of every parameter."""
    ends = zip(problem.names, problem.units, problem.upper, strict=True)
    return [(name, *display_unit(unit, upper)) for name, unit, upper in ends]


def theta_words(result: Mapping[str, Any]) -> str:
    """`m1 = 55 kg, m2 = 55 kg`."""
    units = result.get("units", {})
    words = []
    for name, value in {**result["theta"], **result.get("fixed", {})}.items():
        unit, factor = display_unit(units.get(name, ""), value)
        words.append(f"{name} = {number(factor * value)} {unit}".strip())
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


def design_facts(problem: CoDesignProblem, result: Mapping[str, Any]) -> list[Fact]:
    """Quantity, value, remark: the design, its loop, its proof and what it cost."""
    r, inner, certificate = result, problem.inner, result["certificate"]
    passed = "passed" if certificate["passed"] else "FAILED"
    proof = "all closed-loop poles stable" if certificate["stable"] else "UNSTABLE"
    ranges = [
        f"range {number(a / HZ)} to {number(b / HZ)} Hz" for a, b in (inner.omega_S, inner.omega_T)
    ]
    hz = {key: f"{number(r[key + '_hz'], 6)} Hz" for key in ("omega_S", "omega_T")}
    poles = f"largest real part {number(certificate['max_real_pole'], 4)} 1/s"
    norm = f"norm {number(certificate['norm'], 6)} ≤ {number(certificate['norm_bound'], 6)}"
    bound = f"least possible norm; lower bound γ_jω = {number(r['gamma_lower_bound'], 6)}"
    backoff = f"synthesised at {inner.gamma_backoff:g} γ_opt, recomputed from the closed loop"
    return [
        *value_facts(problem, r, "true: the first crossing of -3 dB by S"),
        ("Weight on S: ω_S", hz["omega_S"], ranges[0]),
        ("Weight on T: ω_T", hz["omega_T"], ranges[1]),
        ("γ_opt", number(r["gamma_opt"], 6), bound),
        ("γ achieved", number(r["gamma"], 6), backoff),
        *sensitivity_facts(problem, r),
        *_compliance(problem, r),
        *loop_facts(r),
        ("Certificate", passed, f"{proof} ({poles}); {norm}"),
        *_robust(r),
        *_without_suspension(r),
        *_references(r),
        *_optimality(r),
        ("Cost", f"{r['syntheses']} syntheses", f"{number(r['seconds'], 3)} s"),
    ]


def value_facts(problem: CoDesignProblem, r: Mapping[str, Any], of: str) -> list[Fact]:
    """J and what it counts, true and predicted; `of`: which bandwidth it is, in words."""
    figure, guess = problem.figure, f"{number(r['surrogate_bandwidth_hz'], 6)} Hz"
    v, words, entry = figure.symbol, figure.words, figure.entry
    bandwidth, value = ("Bandwidth ω_b", f"{number(r['bandwidth_hz'], 6)} Hz"), []
    if f"{entry}_of_set" in r and not figure.larger_is_better:
        e, guess = (figure.shown(r[key], 6) for key in (f"{entry}_of_set", f"surrogate_{entry}"))
        name = f"{words[0].upper()}{words[1:]} {v}"
        value = [(name, f"{e} over the set", prediction_words(r, guess))]
    else:
        of = "; ".join(filter(None, (of, prediction_words(r, guess))))
    J = f"{problem.w1:g} f(θ) + ({problem.w2:g}) {v}, {v} in {figure.si_unit}"
    return [
        ("Objective J", number(r["objective"], 7), J),
        ("Hardware cost f(θ)", cost_words(r, 6), ""),
        (*bandwidth, of),
        *value,
    ]


def prediction_words(r: Mapping[str, Any], guess: str) -> str:
    """What was predicted of the design: nothing without a surrogate, or of one of its samples."""
    if r["formulation"] == "direct":
        return ""
    if r.get("verdict", {}).get("predicted", {}).get("left_out") is not None:
        return "a training sample of the surrogate"  # which repeats it
    return f"predicted {guess} (error {small_share(r['verification_error'])})"


def sensitivity_facts(problem: CoDesignProblem, r: Mapping[str, Any]) -> list[Fact]:
    """The peak of S and |S| at ω_low, with their bounds."""
    inner, at = problem.inner, f"at {number(r['sensitivity_peak_hz'], 6)} Hz"
    low = f"|S| at {number(inner.omega_low / HZ)} Hz"
    return [
        ("Peak of S", number(r["sensitivity_peak"], 6), f"{at}; S_max = {inner.S_max:g}"),
        (low, number(r["sensitivity_low"], 4), f"S_low = {inner.S_low:g}"),
    ]


def loop_facts(r: Mapping[str, Any]) -> list[Fact]:
    """Margins and steps, and what is narrow at the bandwidth; nothing of a run of before."""
    if "phase_margin_deg" not in r:
        return []

    def shown(key: str, unit: str, scale: float = 1.0) -> str:
        return "unlimited" if r[key] is None else f"{number(scale * r[key], 3)}{unit}"

    gain = f"gain × {shown('gain_margin', '')} or ÷ as much"
    rest = f"delay {shown('delay_margin_us', ' µs')}, modulus {shown('modulus_margin', '')}"
    found = [
        ("Margins", f"phase {shown('phase_margin_deg', '°')}",
         f"{gain}, {rest}; the least of its plants"),
        ("Crossover", shown("crossover_hz", " Hz"),
         "of the model" if "step_overshoot" in r else "of the first plant"),
    ]  # fmt: skip
    if "step_overshoot" in r:
        settled = "does not settle" if r["settling_ms"] is None else (
            f"within 2 % after {number(r['settling_ms'], 3)} ms"
        )  # fmt: skip
        found += [
            ("Step response", f"overshoot {shown('step_overshoot', ' %', 100.0)}", settled),
            ("Force step", with_unit(r["force_step_max"], "m"), "largest displacement by 1 N"),
        ]
    return found + [("Warning", "narrow", words) for words in r.get("loop_warnings", ())]


def loop_lines(r: Mapping[str, Any]) -> list[str]:
    """The same for the terminal."""
    return [plain(f"{name.lower():14s}{value}, {remark}") for name, value, remark in loop_facts(r)]


def _compliance(problem: CoDesignProblem, r: Mapping[str, Any]) -> list[Fact]:
    """What a force moves, at most and at rest; nothing of a run of before."""
    if "compliance_words" not in r:
        return []
    most = problem.inner.compliance_max
    bound = "" if most is None else f"compliance_max = {with_unit(most, 'm')}/N; "
    value = f"{with_unit(r['compliance_max'], 'm', 4)}/N"
    return [("Compliance ‖GS‖∞", value, f"{bound}{r['compliance_words']}")]


def _robust(r: Mapping[str, Any]) -> list[Fact]:
    found = r.get("robust")
    if not found:
        return []
    words = number(found["worst_sensitivity_peak"], 6) if found["stable"] else "unstable"
    where = f"{100.0 * found['worst_shift']:+.2f} %, damping × {found['worst_damping']:g}"
    remark = (
        f"largest of {found['plants']} plants, at a resonance shift of {where}; "
        f"on the nominal plant {number(found['nominal_sensitivity_peak'], 5)}"
    )
    return [("Peak of S on the perturbed plants", words, remark)]


def _without_suspension(r: Mapping[str, Any]) -> list[Fact]:
    free = r.get("without_suspension")
    if not free:
        return []
    words = "unstable" if not free["stable"] else "no bandwidth"
    remark = "same controller, rigid-body modes free"
    if free["bandwidth_hz"] is not None:
        words = _changed(free, r)
        stable = "stable" if free["stable"] else "UNSTABLE"
        remark += f": {stable}, peak of S {number(free['sensitivity_peak'], 5)}"
    return [("Without the soft suspension", words, remark)]


def _changed(found: Mapping[str, Any], r: Mapping[str, Any]) -> str:
    change = 100.0 * (found["bandwidth_hz"] / r["bandwidth_hz"] - 1.0)
    return f"{number(found['bandwidth_hz'], 5)} Hz ({change:+.2f} %)"


def _references(r: Mapping[str, Any]) -> list[Fact]:
    """The same controller on closer models of the plant."""
    facts = []
    for name, found in r.get("references", {}).items():
        value = "NOT robust to it"
        remark = f"same controller, same bound on the norm: {found['reason']}"
        if found["bandwidth_hz"] is not None:
            value, peak = _changed(found, r), number(found["sensitivity_peak"], 5)
            remark += f"; peak of S {peak}, norm {number(found['gamma'], 6)}"
        facts.append((f"On the plant with {name}", value, remark))
    return facts


def _optimality(r: Mapping[str, Any]) -> list[Fact]:
    kkt, globality = r["kkt"], r["globality"]
    if kkt["vertex"]:
        second = "a vertex: the binding constraints alone determine it"
    elif kkt["second_order"] is None:
        second = "second order not computed"
    else:
        second = f"least curvature of the Lagrangian {number(kkt['second_order'], 3)} (scaled)"
    residual = number(kkt["stationarity"], 2)
    facts = [("Optimality (KKT residual)", residual, f"on the true problem; {second}")]
    optima = globality["optima"]
    values = ", ".join(f"{number(o['objective'], 6)} ({o['starts']}×)" for o in optima[:6])
    if optima:
        count = f"{len(optima)} distinct optim{'um' if len(optima) == 1 else 'a'}"
        facts.append(
            ("Globality", f"{globality['starts']} starts, {count}", f"J (starts): {values}")
        )
    gap = r.get("inner_gap")
    if gap is not None:
        words = "more bandwidth by the best controller that the searches at this θ found"
        facts.append(("Gap of the controller search", small_share(gap), words))
    return facts


def binding(problem: CoDesignProblem, result: Mapping[str, Any]) -> list[str]:
    """A sentence for everything that binds, with what loosening it would gain."""
    multipliers: dict[str, float] = result["kkt"]["multipliers"]
    names = list(dict.fromkeys([*multipliers, *result["active"]]))
    return [_sentence(problem, name, multipliers.get(name)) for name in names]


def _sentence(problem: CoDesignProblem, name: str, multiplier: float | None) -> str:
    words, step, loosened = _held(problem, name)
    if multiplier is None:
        return f"{words}."
    gain = multiplier * step  # in J, which is nobody's unit
    worth = [problem.figure.shown(gain / abs(problem.w2), 3)] if problem.w2 else []
    if problem.w1 > 0.0 and problem.cost_unit:
        worth.append(f"{gain / problem.w1:.3g} {problem.cost_unit}")
    value = " or ".join(worth) or f"{number(gain, 3)} of J"
    return f"{words}; {loosened} is worth {value}, to first order."


def _held(problem: CoDesignProblem, name: str) -> tuple[str, float, str]:
    """What holds the design, a step that loosens it (in the multiplier's unit), that in words."""
    inner, (variable, _, end) = problem.inner, name.rpartition(" ")
    if name == "S_max":
        return f"The peak of S is at S_max = {inner.S_max:g}", 0.01, "raising S_max by 1 %"
    if name == "S_low":
        return f"|S| at ω_low is at S_low = {inner.S_low:g}", 0.01, "raising S_low by 1 %"
    if name == "compliance_max" and inner.compliance_max is not None:
        words = f"‖GS‖∞ is at compliance_max = {with_unit(inner.compliance_max, 'm')}/N"
        return words, 0.01, "raising it by 1 %"
    if end in ("lower", "upper") and variable in ("omega_S", "omega_T"):
        ends = inner.omega_S if variable == "omega_S" else inner.omega_T
        value, sign = ends[0 if end == "lower" else 1] / HZ, variable.replace("omega", "ω")
        words = f"{sign} is at the {end} end of its range, {number(value)} Hz"
        return words, 0.01 / float(np.log(ends[1] / ends[0])), "widening the range there by 1 %"
    if end in ("lower", "upper") and variable in problem.names:
        i = problem.names.index(variable)
        value = (problem.lower if end == "lower" else problem.upper)[i]
        _, unit, factor = theta_axes(problem)[i]
        step = number(0.01 * factor * (problem.upper[i] - problem.lower[i]), 3)
        words = f"{variable} is at its {end} bound, {number(factor * value)} {unit}".rstrip()
        return words, 0.01, f"moving the bound outwards by {step} {unit}".rstrip()
    return f"The constraint “{name}” binds", 1.0, "loosening it by one unit"
