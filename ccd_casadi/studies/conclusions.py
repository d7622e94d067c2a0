"""What a comparison shows, computed from its figures: who wins, by how much, at what cost, why."""

from typing import Any

from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.reporting.verdict import advice
from ccd_casadi.support.units import counted

EQUAL = 1e-6  # relative difference of J that counts as none
LABELS = {
    "nested": "nested",
    "lifted": "lifted",
    "direct": "direct",
    "steepest_descent": "steepest descent, K fixed",
    "steepest_descent_total": "steepest descent, total gradient",
    "sequential": "sequential, next to the start",
    "sequential_global": "sequential, globally cheapest",
}


def conclusions(problem: CoDesignProblem, methods: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Figures and sentences; entries without a feasible design are left out of the ranking."""
    solved = {name: f for name, f in methods.items() if f.get("objective") is not None}
    if not solved:
        return {"best": None, "sentences": ["No method found a feasible design."]}
    ranked = sorted(solved, key=lambda name: solved[name]["objective"])
    best = solved[ranked[0]]["objective"]
    near = [n for n in ranked if solved[n]["objective"] <= best + EQUAL * abs(best)]
    cheapest = min(near, key=lambda name: solved[name]["syntheses_to_optimum"])
    answer: dict[str, Any] = {"best": cheapest, "best_objective": best, "equally_good": near}
    sentences = [
        f"The best J is {best:.4f}, reached by {', '.join(near)}; the cheapest of these is "
        f"{cheapest} with {solved[cheapest]['syntheses_to_optimum']} true syntheses to the optimum"
        f"{_beside(solved[cheapest])}."
    ]
    for name in ("steepest_descent", "steepest_descent_total"):
        if name in solved:
            found, words = _descent(problem, solved[name], solved[cheapest], name)
            answer[name] = found
            sentences += words
    against = [name for name in ranked if name in ("sequential", "sequential_global")]
    for i, name in enumerate(against):  # the best of them stands first: it is the answer
        answer[name], sentence = _sequential(solved[name], solved[cheapest], name)
        sentences.insert(len(sentences) if i else 0, sentence)
    if said := decision(solved[cheapest]):
        sentences[0] = f"{said} That is the best design, of {LABELS[cheapest]}. {sentences[0]}"
    return answer | {"sentences": sentences}


def decision(figures: dict[str, Any]) -> str:
    """Whether to build a design: of a baseline, which has no other line, by what it survives."""
    words = advice(figures)
    if words and "certified" not in figures.get("verdict", {}) and words.startswith("Build"):
        return "Solve the case before you build this: a baseline has no whole verdict."
    return words


def stable_words(figures: dict[str, Any]) -> str:
    """For resonances how far off a loop is stable, in %; what is not known is a dash."""
    shift = figures.get("verdict", {}).get("survives", {}).get("stable_shift")
    return "–" if not shift else f"{100.0 * shift[0]:+.2g} to {100.0 * shift[1]:+.2g} %"


def _beside(figures: dict[str, Any]) -> str:
    """The global check over the box that every formulation ends with, and no descent."""
    beside = figures["syntheses"] - figures["syntheses_to_optimum"]
    return f", and {beside} in the global check over the box" if beside else ""


def _descent(
    problem: CoDesignProblem, run: dict[str, Any], best: dict[str, Any], name: str
) -> tuple[dict[str, Any], list[str]]:
    """How far a descent ends from the best, and what stopped it."""
    gap = run["objective"] - best["objective"]
    ratio = run["syntheses"] / best["syntheses_to_optimum"]
    ends = zip(run["theta"].values(), best["theta"].values(), *box(problem), strict=True)
    moved = max(abs(a - b) / (high - low) for a, b, low, high in ends)
    found = {
        "objective_gap": gap,
        "synthesis_ratio": ratio,
        "distance_to_best": moved,
        "stop": run["stop"],
        "last_gradient": run["history"][-1]["gradient"],
    }
    words = [
        f"S{LABELS[name][1:]} (best of {counted(run['runs'], 'run')}) ends at J = "
        f"{run['objective']:.4f}, {gap:.3g} above, after {run['syntheses']} syntheses, "
        f"{ratio:.0f} times as many; all its runs together took {run['syntheses_of_all_runs']}."
    ]
    if gap > EQUAL * abs(best["objective"]):
        words.append(
            f"It stopped: {run['stop']}. Its theta is {100 * moved:.2g} % of the box "
            "from the best one."
        )
    return found, words


def _sequential(run: dict[str, Any], best: dict[str, Any], name: str) -> tuple[dict[str, Any], str]:
    cost = 100.0 * (best["hardware_cost"] / run["hardware_cost"] - 1.0)
    speed = 100.0 * (best["bandwidth_hz"] / run["bandwidth_hz"] - 1.0)
    found = {"hardware_cost_percent": cost, "bandwidth_percent": speed}
    words = (
        f"Against the {LABELS[name].replace(',', ' design,')} (hardware cost "
        f"{run['hardware_cost']:.5g}, {run['bandwidth_hz']:.2f} Hz) co-design "
        f"changes the hardware cost by {cost:+.1f} % and the bandwidth by {speed:+.1f} %."
    )
    return found, words
