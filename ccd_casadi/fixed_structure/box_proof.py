"""A proof that a controller keeps its bounds on a whole box of plants, by branch and bound.

Frequency and the uncertain parameters are divided until enclosures say on every sub-box that the
loop has no pole on the axis and every figure stays below 1 + `slack` times its bound
(`enclosure`). With the model's own loop stable, so are all of them. What the given number of boxes
does not close is still bounded: the proof then names the factor that is proven.
"""

import itertools
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure, controller_of
from ccd_casadi.fixed_structure.enclosure import LoopFamily
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.loop import Loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, Workers

SLACK = 1e-3  # relative: by how much a bound may be passed in what is proven
SLACK_OF_MANY = 0.05  # of several channels or many parameters
FEW_PARAMETERS = 4
MOST_BOXES = 500_000  # some twenty seconds
MOST_OF_MANY = 250_000  # of each option, at most
AT_ONCE = 20_000
ABOVE = 3.0  # times ω_b and the fastest pole: from there on frequencies are counted by 1/ω
DECADES = 6.0  # of frequency cells at the start, downwards; below is one cell to 0


class ProofOutcome(StrEnum):
    """How far a proof came."""

    PROVEN = "every bound holds, with its slack, on the whole box"
    LOOSER = "stable on the whole box; some bound is only proven with a larger factor"
    OPEN = "stability is not proven on the whole box within the number of boxes"
    REFUTED = "a plant of the box exceeds a bound by more than the slack"
    UNSTABLE = "the model's own loop is not stable"
    NOT_SQUARE = "the plant has several outputs and not as many channels"
    NOT_MODAL = "a given damping matrix couples the modes"
    VARIES = "a theta that varies moves the modes, so its range was searched"


@dataclass(frozen=True)
class Proof:
    """What is proven on the box: every |figure| <= `levels` times its bound, by kind of bound.

    `slack` was asked for; `of_S`: of |S| alone, since for the others the boxes did not suffice.
    `boxes` were looked at. Of a refuted box `option`, `point`, the bound and the factor by which it
    is passed at least; enclosures say so, not a sample.
    """

    outcome: ProofOutcome
    slack: float
    parameters: tuple[str, ...]
    levels: dict[str, float] = field(default_factory=dict)
    boxes: int = 0
    option: int = 0
    point: tuple[float, ...] = ()
    passed: tuple[str, float] = ("", np.nan)
    of_S: bool = False

    @property
    def proven(self) -> bool:
        """Whether every bound holds with its slack on the whole box."""
        return self.outcome is ProofOutcome.PROVEN

    @property
    def close(self) -> bool:
        """Whether that is all that is asked for, and closely: no plant need be drawn besides."""
        return self.proven and not self.of_S and self.slack <= SLACK

    @property
    def refuted(self) -> bool:
        """Whether a plant of the box exceeds a bound by more than the slack."""
        return self.outcome is ProofOutcome.REFUTED

    @property
    def stable(self) -> bool:
        """Whether stability is proven on the whole box."""
        return self.outcome in (ProofOutcome.PROVEN, ProofOutcome.LOOSER)

    @property
    def words(self) -> str:
        """One line."""
        if self.outcome is ProofOutcome.REFUTED:
            at = ", ".join(f"{n} {v:.4g}" for n, v in zip(self.parameters, self.point, strict=True))
            return f"{self.passed[0]} is passed by a factor of {self.passed[1]:.4g} at {at}"
        if not self.stable:
            return f"between these plants nothing is proven: {self.outcome.value}"
        worst = max(self.levels.values(), default=0.0)
        figure = "|S|" if self.of_S else "every figure"
        return (
            f"proven for the whole box by {self.boxes} enclosures: stable, {figure} at most "
            f"{worst:.5g} of its bound"
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
    `SLACK_OF_MANY` by default, and of several channels the whole's bounds; where the boxes do not
    suffice for all of these, those on |S| alone. The options are spread over `workers`.
    """
    names = uncertain.names
    several = isinstance(structure, ChannelStructure)
    many = several or len(names) > FEW_PARAMETERS
    slack = slack or (SLACK_OF_MANY if many else SLACK)
    outputs = inputs = np.eye(1)
    if isinstance(structure, ChannelStructure):
        outputs, inputs = structure.decoupling.outputs, structure.decoupling.inputs
    if len(uncertain.options[0].C) != len(outputs) or 1 != len(outputs) != outputs.shape[1]:
        return Proof(ProofOutcome.NOT_SQUARE, slack, names)
    if uncertain.ranges:
        return Proof(ProofOutcome.VARIES, slack, names)
    models = [uncertain.plant(uncertain.nominal, i).plant_si()
              for i in range(len(uncertain.options))]  # fmt: skip
    K = controller_of(structure, kappa)
    if not all(Loop(model, K, sampling).stable for model in models):
        return Proof(ProofOutcome.UNSTABLE, slack, names)
    fastest = max(float(np.abs(model.rates).max()) for model in models)
    unit = ABOVE * max(bandwidth, fastest, bounds.omega_low)
    period = None if sampling is None else sampling.period * unit
    delay = 0.0 if sampling is None else sampling.delay * unit
    own = structure.in_units(kappa, 1.0 / unit, 1.0)
    parts = ((structure, own),) if isinstance(structure, Structure) else (
        tuple(structure.split(own))
    )  # fmt: skip
    families = []
    for option in range(len(models)):
        plant = modal_sum(uncertain, option, unit)
        if plant is None:
            return Proof(ProofOutcome.NOT_MODAL, slack, names)
        families.append(LoopFamily(
            plant, names, parts, outputs, inputs, bounds, bandwidth, unit, period, delay
        ))  # fmt: skip
    share = (most_boxes or MOST_BOXES) // len(models)
    if many and most_boxes is None:
        share = min(share, MOST_OF_MANY)
    whole = divide(families, uncertain.box, slack, share, workers)
    bare = replace(bounds, weighted_level=None, compliance_max=None)
    if not several or bare == bounds or whole.proven or whole.refuted:
        return whole
    bared = [replace(own, bounds=bare) for own in families]
    return replace(divide(bared, uncertain.box, slack, share, workers), of_S=True)


def divide(
    families: list[LoopFamily], box: Array, slack: float, share: int, workers: Pool | None = None
) -> Proof:
    """Branch and bound of every option's loops, each stable at one point of `box` (2, n): so many
    boxes of each."""
    tasks = [(option, family, box, slack, share) for option, family in enumerate(families)]
    found = dict((workers or Workers(1)).map_unordered(_divided_option, tasks))
    proofs = [found[option] for option in range(len(families))]
    for proof in proofs:
        if proof.refuted:
            return proof
    levels: dict[str, float] = {}
    for name, value in (item for proof in proofs for item in proof.levels.items()):
        levels[name] = max(levels.get(name, 0.0), value)
    highest = max(levels.values(), default=0.0)
    outcome = ProofOutcome.PROVEN
    if not np.isfinite(highest):
        outcome = ProofOutcome.OPEN
    elif highest > 1.0 + slack:
        outcome = ProofOutcome.LOOSER
    boxes = sum(proof.boxes for proof in proofs)
    return Proof(outcome, slack, families[0].names, levels, boxes)


def _divided_option(task: tuple[int, LoopFamily, Array, float, int]) -> tuple[int, Proof]:
    """The number of an option, and what is proven of it; its outcome is refuted, or still open."""
    option, family, box, slack, share = task
    levels: dict[str, float] = {}
    names, queue, spent = family.names, [_first(family, box)], 0
    while queue:
        boxes = queue.pop(0)
        for start in range(0, len(boxes.chart), AT_ONCE):
            part = boxes.only(np.arange(start, min(start + AT_ONCE, len(boxes.chart))))
            with np.errstate(all="ignore"):  # of boxes that enclose nothing
                found = family.enclose(part)
            spent += len(part.chart)
            worst = found.highest.max(axis=0)
            k, j = np.unravel_index(np.argmax(found.lowest), found.lowest.shape)
            if found.lowest[k, j] > 1.0 + slack:
                middle = 0.5 * (part.low + part.high)[1:, j]
                passed = (found.names[k], float(found.lowest[k, j]))
                return option, Proof(ProofOutcome.REFUTED, slack, names, {}, spent, option,
                                     tuple(map(float, middle)), passed)  # fmt: skip
            closed = worst <= 1.0 + slack
            if spent >= share:
                closed[:] = True
            for name, value in zip(found.names, found.highest[:, closed], strict=True):
                levels[name] = max(levels.get(name, 0.0), float(value.max(initial=0.0)))
            if not closed.all():
                queue.append(_divided(part.only(~closed), found.spread[:, ~closed]))
    return option, Proof(ProofOutcome.OPEN, slack, names, levels, spent)


def _first(family: LoopFamily, box: Array) -> Boxes:
    """Cells of frequency from 0 to infinity, or to half the sampling rate, over the whole box."""
    low, band = family.bounds.omega_low / family.unit, family.bandwidth / family.unit
    scale, top = 1.0, 1.0
    if family.period is not None:
        scale, top = family.period, np.pi
    edges = np.geomspace(10.0**-DECADES, 1.0, int(2 * DECADES) + 1) * top
    corner = min(family.corner / family.unit, 1.0)
    edges = np.unique(np.concatenate([[0.0], edges, np.array([low, band, corner]) * scale]))
    edges = edges[edges <= top]
    cells = [(Chart.LOW if family.period is None else Chart.SAMPLED, a, b)
             for a, b in itertools.pairwise(edges)]  # fmt: skip
    if family.period is None:
        steps = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 9)])
        cells += [(Chart.HIGH, a, b) for a, b in itertools.pairwise(steps)]
    cells.append((Chart.POINT, low * scale, low * scale))
    pieces = [np.array([[low], [high]]).T for low, high in box.T]
    for i, (low, high) in enumerate(box.T.tolist()):
        if 0.0 < 2.0 * low < high:  # a factor: its lowest values are found in pieces only
            ends = np.geomspace(low, high, int(np.ceil(np.log2(high / low))) + 1)
            pieces[i] = np.stack([ends[:-1], ends[1:]], axis=1)
    every = [*itertools.product(cells, *pieces)]
    chart = np.array([one[0][0] for one in every])
    ends = np.array([[one[0][1:], *one[1:]] for one in every], float)
    return Boxes(chart, ends[..., 0].T, ends[..., 1].T)


def _divided(boxes: Boxes, spread: Array) -> Boxes:
    """Each box halved along the coordinate that moves its loop most."""
    width = boxes.high - boxes.low
    size = np.maximum(np.abs(boxes.low), np.abs(boxes.high))
    fine = width > 1e-13 * np.maximum(size, 1e-300)
    score = np.where(fine, np.where(np.isfinite(spread), spread, width), -1.0)
    along = np.argmax(score, axis=0)
    rows = np.arange(len(along))
    a, b = boxes.low[along, rows], boxes.high[along, rows]
    middle = 0.5 * (a + b)
    wide = ((along == 0) | (a > 0.0)) & (b > 4.0 * a)
    with np.errstate(invalid="ignore"):
        middle = np.where(wide, np.where(a > 0.0, np.sqrt(a * b), 0.1 * b), middle)
    left, right = boxes.high.copy(), boxes.low.copy()
    left[along, rows] = right[along, rows] = middle
    return Boxes(
        np.concatenate([boxes.chart, boxes.chart]),
        np.concatenate([boxes.low, right], axis=1),
        np.concatenate([left, boxes.high], axis=1),
    )
