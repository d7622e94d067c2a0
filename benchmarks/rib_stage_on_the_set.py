"""What is left of the rib stage's published gain on the set that a stage has to survive.

`rib_stage_on_the_set.json` has the stages that the sequential design and co-designs end with, from
`benchmarks/rib_stage_front.py`: `nominal` is mixed sensitivity on the model alone
(runs/rib_stage.toml), `whole` one controller of sections on the whole set of
runs/rib_stage_built.toml, `apart_hz` each channel on its own, without coupling and worst plants.
All that is said here follows from these figures.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ccd_casadi.studies.published import PUBLISHED
from ccd_casadi.support.units import HZ

ON_THE_SET = Path(__file__).with_suffix(".json")
OPEN = 1e-3  # relative: past a bound by more, worst plants are left that the design does not know
APART = " (apart)"
ALL, NONE = 0.85, 0.15  # shares of a published gain from which it counts as kept, and as lost
LABELS = {
    "sequential": "the sequential stage",
    "descent, K held": "the stage of the paper's descent",
    "descent, total gradient": "the stage of the descent with the total gradient",
    "lifted": "the nominal optimum",
    "fitted to 0.59 kg": "the stage fitted to the paper's 0.59 kg",
    "co-designed": "the co-designed stage",
}
NOMINAL = ("descent, K held", "descent, total gradient", "lifted")  # of nominal co-designs
HEAD = (
    "stage", "θ in mm", "mass", "nominal: ω_b", "J", "lighter, faster", "on the set: ω_b", "J",
    "lighter, faster",
)  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """One θ: mass in kg, ω_b in Hz nominal and on the set; J of both."""

    name: str
    theta: tuple[float, ...]
    mass: float
    nominal_hz: float
    nominal_J: float
    set_hz: float
    set_J: float
    apart: bool  # the channels of the set on their own: no certified design of the whole is kept
    excess: float  # by how much a searched plant of the box passes a bound, relative

    @property
    def label(self) -> str:
        """What sentences call it."""
        return LABELS.get(self.name, self.name)


def stored_rows() -> dict[str, Any]:
    """The rows that are kept."""
    return dict(json.loads(ON_THE_SET.read_text(encoding="utf-8")))


def stages_of(rows: Mapping[str, Mapping[str, Any]], w1: float, w2: float) -> tuple[Stage, ...]:
    """The rows as stages, J = w₁ mass + w₂ ω_b with ω_b in rad/s."""
    found = []
    for name, row in rows.items():
        whole = row.get("whole", {})
        apart = not whole.get("certified", False)
        hz = min(row["apart_hz"].values()) if apart else whole["bandwidth_hz"]
        alone = row["nominal"]["bandwidth_hz"]
        J = [w1 * row["mass"] + w2 * HZ * value for value in (alone, hz)]
        excess = 0.0 if apart else whole.get("worst_excess", 0.0)
        found.append(
            Stage(name, tuple(row["theta"]), row["mass"], alone, J[0], hz, J[1], apart, excess)
        )
    return tuple(found)


def gains(stage: Stage, first: Stage, *, on_the_set: bool) -> tuple[float, float]:
    """By how many per cent a stage is lighter, and faster, than the first."""
    hz = (stage.set_hz, first.set_hz) if on_the_set else (stage.nominal_hz, first.nominal_hz)
    return 100.0 * (1.0 - stage.mass / first.mass), 100.0 * (hz[0] / hz[1] - 1.0)


def table(stages: Sequence[Stage]) -> list[tuple[str, ...]]:
    """The paper's two stages, then ours, nominal and on the set; the gains are over the first."""
    paper = PUBLISHED["rib_stage"]
    rows: list[tuple[str, ...]] = [
        (label, "not published", f"{p['hardware_cost']:.2f} kg", f"{p['bandwidth_hz']:.1f} Hz",
         f"{p['objective']:.2f}", gain, "–", "–", "–")
        for label, p, gain in (
            ("paper: sequential", paper["sequential"], "–"),
            ("paper: co-design", paper["nested_ccd"], _pair(*_published())),
        )
    ]  # fmt: skip
    first = _sequential(stages)
    for stage in stages:
        both = [_pair(*gains(stage, first, on_the_set=x)) if stage is not first else "–"
                for x in (False, True)]  # fmt: skip
        rows.append(
            (stage.name, ", ".join(f"{1e3 * v:.4g}" for v in stage.theta), f"{stage.mass:.3f} kg",
             f"{stage.nominal_hz:.2f} Hz", f"{stage.nominal_J:.2f}", both[0],
             f"{stage.set_hz:.2f} Hz{_mark(stage)}",
             f"{stage.set_J:.2f}", both[1])
        )  # fmt: skip
    return rows


def sentences(stages: Sequence[Stage]) -> list[str]:
    """What the figures say: the published gain, the nominal one, and what the set leaves of it."""
    first, named = _sequential(stages), {stage.name: stage for stage in stages}
    nominal = [named[name] for name in NOMINAL if name in named]
    found = [
        f"Published, on the paper's own stage: the co-design is {_words(*_published())} than the "
        "sequential design."
    ]
    if nominal:
        best = min(nominal, key=lambda stage: stage.nominal_J)
        found.append(f"Nominal, here: {best.label} is "
                     f"{_words(*gains(best, first, on_the_set=False))}.")  # fmt: skip
    ratio = first.set_hz / first.nominal_hz
    found.append(
        f"The sequential stage itself has {first.nominal_hz:.1f} Hz by mixed sensitivity on the "
        f"model alone and {first.set_hz:.1f} Hz with sections on the set, {ratio:.2f} times as "
        "much: controllers of two kinds, with other bounds on force, so that gains are counted "
        "within each column."
    )
    for stage in nominal:
        worse = stage.set_J - first.set_J
        found.append(
            f"On the set {stage.label} keeps {stage.set_hz:.1f} of its {stage.nominal_hz:.1f} Hz"
            f"{_mark(stage)}: {_words(*gains(stage, first, on_the_set=True))} than the "
            f"sequential stage there, J {abs(worse):.2f} {'worse' if worse > 0.0 else 'better'}."
        )
    ranked = sorted(stages, key=lambda stage: stage.set_J)
    if ranked[0] is first:
        found.append("No stage here has a better J on the set than the sequential one.")
    else:
        best = ranked[0]
        found.append(
            f"The best J on the set is that of {best.label}, {best.mass:.3f} kg"
            f"{_mark(best)}: {_words(*gains(best, first, on_the_set=True))} than the "
            "sequential stage."
        )
    if nominal and (before := min(stages, key=lambda stage: stage.nominal_J)) is ranked[-1]:
        found.append(
            f"{before.label.capitalize()} has the best J nominally and the worst on the set."
        )
    corners = [stage for stage in stages if stage.excess > OPEN]
    if corners:
        names = ", ".join(stage.label for stage in corners)
        found.append(
            f"Marked (corners), {names}: certified on the plants of the design; a last search of "
            f"the box finds plants that exceed a bound by up to "
            f"{100.0 * max(stage.excess for stage in corners):.1f} %, so that the bandwidth is "
            "a little less on all of the set."
        )
    if any(_mark(stage) == APART for stage in stages):
        found.append(f"Marked{APART}: each channel on its own.")
    return [*found, _left(stages, first)]


def _left(stages: Sequence[Stage], first: Stage) -> str:
    """Of the lightest stage that is no slower than the sequential one: which gain it keeps."""
    lighter = [s for s in stages if s.mass < first.mass and s.set_hz >= first.set_hz]
    if not lighter:
        return "On the set no lighter stage here is as fast as the sequential one: nothing is left."
    best = min(lighter, key=lambda stage: stage.mass)
    own, asked = gains(best, first, on_the_set=True), _published()
    shares = [mine / theirs for mine, theirs in zip(own, asked, strict=True)]
    mass, bandwidth = (_kept(*pair) for pair in zip(shares, ("mass", "bandwidth"), strict=True))
    if min(shares) >= ALL:
        words = "all of it"
    elif not mass and not bandwidth:
        words = "next to nothing"
    elif mass and bandwidth:
        words = f"{mass} and {bandwidth}"
    else:
        words = f"{mass or bandwidth}, not the {'bandwidth' if mass else 'mass'}"
    return (
        f"The lightest stage that is no slower than the sequential one on the set is {best.label}, "
        f"{best.mass:.3f} kg and {best.set_hz:.1f} Hz: {_words(*own)}, where {_words(*asked)} was "
        f"published. What remains of that gain on the set: {words}."
    )


def _mark(stage: Stage) -> str:
    """What a bandwidth on the set leaves open."""
    if stage.apart:
        return APART
    return " (corners)" if stage.excess > OPEN else ""


def _kept(share: float, name: str) -> str:
    """What a share of a gain is called; nothing where it is lost."""
    if share >= ALL:
        return f"the {name}"
    return "" if share <= NONE else f"{100.0 * share:.0f} % of the gain in {name}"


def _sequential(stages: Sequence[Stage]) -> Stage:
    return next(stage for stage in stages if stage.name == "sequential")


def _published() -> tuple[float, float]:
    gain = PUBLISHED["rib_stage"]["improvement"]
    return -gain["hardware_cost_percent"], gain["bandwidth_percent"]


def _words(lighter: float, faster: float) -> str:
    mass = f"{abs(lighter):.0f} % {'lighter' if lighter >= 0.0 else 'heavier'}"
    return f"{mass} and {abs(faster):.0f} % {'faster' if faster >= 0.0 else 'slower'}"


def _pair(lighter: float, faster: float) -> str:
    return f"{lighter:+.0f} %, {faster:+.0f} %"
