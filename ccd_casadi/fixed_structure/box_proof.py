"""A proof that a controller keeps its bounds on a whole box of plants, by branch and bound.

Frequency and the uncertain parameters are divided (`box_division`) until enclosures say on every
sub-box that the loop has no pole on the axis and every figure stays below 1 + `slack` times its
bound (`enclosure`). With the model's own loop stable, so are all of them. What the given number of
boxes does not close is still bounded: the proof then names the factor that is proven.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_division import divided, raised
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.enclosure import LoopFamily
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.loop import Loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results

SLACK = 1e-3  # relative: by how much a bound may be passed in what is proven
SLACK_OF_MANY = 0.05  # of several channels or many parameters
FEW_PARAMETERS = 4
MOST_BOXES = 500_000  # some twenty seconds
MOST_OF_MANY, ENOUGH_OF_MANY = 250_000, 45_000  # of each option, at most, and where it is stuck
ABOVE = 3.0  # times ω_b and the fastest pole: from there on frequencies are counted by 1/ω


class ProofOutcome(StrEnum):
    """How far a proof came."""

    PROVEN = "every bound holds, with its slack, on the whole box"
    LOOSER = "stable on the whole box; some bound is only proven with a larger factor"
    OPEN = "stability is not proven on the whole box within the number of boxes"
    REFUTED = "a plant of the box exceeds a bound by more than the slack"
    UNSTABLE = "the model's own loop is not stable"
    NOT_SQUARE = "the plant has several outputs and not as many channels"
    NOT_MODAL = "the plant is not modal: its damping couples the modes, or brakes a free body"
    VARIES = "a theta varies in a plant whose modes are not enclosed, so its range was searched"


NOT_APPLICABLE = (ProofOutcome.NOT_SQUARE, ProofOutcome.NOT_MODAL, ProofOutcome.VARIES)


@dataclass(frozen=True)
class Proof:
    """What is proven on the box: every |figure| <= `levels` times its bound, by kind of bound.

    `slack` was asked for; `boxes` were looked at. Of a refuted box `option`, `point`, the bound and
    the factor by which it is passed at least; enclosures say so, not a sample.
    """

    outcome: ProofOutcome
    slack: float
    parameters: tuple[str, ...]
    levels: dict[str, float] = field(default_factory=dict)
    boxes: int = 0
    option: int = 0
    point: tuple[float, ...] = ()
    passed: tuple[str, float] = ("", np.nan)
    channels: bool = False  # whether there are bounds of single channels, which no proof is of

    @property
    def proven(self) -> bool:
        """Whether every bound holds with its slack on the whole box."""
        return self.outcome is ProofOutcome.PROVEN

    @property
    def conclusive(self) -> bool:
        """Whether that is all that is asked for, and closely: no plant need be drawn besides."""
        return self.proven and self.slack <= SLACK

    @property
    def refuted(self) -> bool:
        """Whether a plant of the box exceeds a bound by more than the slack."""
        return self.outcome is ProofOutcome.REFUTED

    @property
    def denies(self) -> bool:
        """Whether it contradicts that the box is kept: a plant of it, or the model's own loop."""
        return self.refuted or self.outcome is ProofOutcome.UNSTABLE

    @property
    def unasked(self) -> str:
        """Why nothing was proven that was not begun either: the proof does not apply, or is not of
        every bound; empty where it is complete in kind."""
        if self.outcome in NOT_APPLICABLE:
            return self.outcome.value
        return "bounds of single channels are judged, not proven" if self.channels else ""

    @property
    def unclosed(self) -> bool:
        """Whether it was begun, and did not reach every bound within its slack."""
        return self.outcome in (ProofOutcome.LOOSER, ProofOutcome.OPEN)

    @property
    def stable(self) -> bool:
        """Whether stability is proven on the whole box."""
        return self.outcome in (ProofOutcome.PROVEN, ProofOutcome.LOOSER)

    @property
    def words(self) -> str:
        """One line."""
        if self.outcome is ProofOutcome.REFUTED:
            at = ", ".join(f"{n} {v:.4g}" for n, v in zip(self.parameters, self.point, strict=True))
            return f"{self.passed[0]} is exceeded by a factor of {self.passed[1]:.4g} at {at}"
        if self.outcome is ProofOutcome.UNSTABLE:
            return f"the proof denies it: {self.outcome.value}"
        if not self.stable:
            return f"searched, not proven: {self.outcome.value}"
        left = f"; {self.unasked}" if self.channels else ""
        worst = max(self.levels.values(), default=0.0)
        if self.outcome is ProofOutcome.LOOSER:
            over = [name for name, level in self.levels.items() if not level <= 1.0 + self.slack]
            return (
                f"not every bound is proven: the whole box is stable by {self.boxes} enclosures, "
                f"but {', '.join(over)} only below {worst:.5g} of its bound{left}"
            )
        of_S = max((v for k, v in self.levels.items() if k not in ("KS", "T", "GS")), default=0.0)
        own = f"|S| at most {of_S:.5g} and " if of_S < worst else ""
        return (
            f"proven for the whole box by {self.boxes} enclosures: stable, {own}every figure at "
            f"most {worst:.5g} of its bound{left}"
        )


def prove(
    uncertain: UncertainPlant,
    structure: Structure | ChannelStructure,
    kappa: Array,
    bandwidth: float,
    bounds: Bounds,
    sampling: Sampling | None = None,
    *,
    slack: float | None = None,
    most_boxes: int | None = None,
    workers: Pool | None = None,
) -> Proof:
    """Bounds and stability of the SI controller κ with ω_b (rad/s) on the whole box.

    Of plants with modal damping. The box is that of `uncertain`, all its options; the plant's
    modal data and κ count as exact. Of several channels or more than four parameters with
    `SLACK_OF_MANY` by default, and of several channels the whole's bounds. The options are spread
    over `workers`.
    """
    names = uncertain.names
    many = isinstance(structure, ChannelStructure) or len(names) > FEW_PARAMETERS
    slack = slack or (SLACK_OF_MANY if many else SLACK)
    outputs, inputs = structure.directions
    if len(uncertain.options[0].C) != len(outputs) or 1 != len(outputs) != outputs.shape[1]:
        return Proof(ProofOutcome.NOT_SQUARE, slack, names)
    models = [uncertain.plant(uncertain.nominal, i).plant_si()
              for i in range(len(uncertain.options))]  # fmt: skip
    K = structure.state_space(kappa)
    if not all(Loop(model, K, sampling).stable for model in models):
        return Proof(ProofOutcome.UNSTABLE, slack, names)
    fastest = max(float(np.abs(model.rates).max()) for model in models)
    unit = ABOVE * max(bandwidth, fastest, bounds.omega_low)
    period = None if sampling is None else sampling.period * unit
    delay = 0.0 if sampling is None else sampling.delay * unit
    parts = tuple(structure.split(structure.in_units(kappa, 1.0 / unit, 1.0)))
    families = []
    for option in range(len(models)):
        plant = modal_sum(uncertain, option, unit)
        if plant is None:
            why = ProofOutcome.VARIES if uncertain.ranges else ProofOutcome.NOT_MODAL
            return Proof(why, slack, names)
        families.append(LoopFamily(
            plant, names, parts, outputs, inputs, bounds, bandwidth, unit, period, delay
        ))  # fmt: skip
    share, enough = (most_boxes or MOST_BOXES) // len(models), None
    if many and most_boxes is None:
        share, enough = min(share, MOST_OF_MANY), ENOUGH_OF_MANY
    proof = divide(families, uncertain.box, slack, share, workers, enough)
    return replace(proof, channels=any(own.given for own in bounds.channels))


def divide(
    families: list[LoopFamily], box: Array, slack: float, share: int, workers: Pool | None = None,
    enough: int | None = None,
) -> Proof:  # fmt: skip
    """Branch and bound of every option's loops, each stable at one point of `box` (2, n): `share`
    boxes of each, or `enough` where many of these are still open then."""
    enough = share if enough is None else enough
    first = sorted(range(len(families)), key=lambda option: -len(families[option].plant.omega))
    tasks = {option: (families[option], box, slack, share, enough) for option in first}
    found = dict(results(workers, divided, tasks))
    names, levels = families[0].names, dict[str, float]()
    for option in range(len(families)):
        if (passed := found[option].passed) is not None:
            name, factor, point = passed
            return Proof(ProofOutcome.REFUTED, slack, names, {}, found[option].boxes, option, point,
                         (name, factor))  # fmt: skip
        levels = raised(levels, found[option].levels)
    highest = max(levels.values(), default=0.0)
    outcome = ProofOutcome.PROVEN
    if not np.isfinite(highest):
        outcome = ProofOutcome.OPEN
    elif highest > 1.0 + slack:
        outcome = ProofOutcome.LOOSER
    return Proof(outcome, slack, names, levels, sum(one.boxes for one in found.values()))
