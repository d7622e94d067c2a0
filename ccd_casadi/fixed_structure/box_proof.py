"""A proof that a controller keeps its bounds on a whole box of plants, by branch and bound.

A box is a range of frequency times one of each uncertain parameter. `LoopFamily.enclose` has, for
every box and every bound, lower <= figure/bound <= upper on all of the box. Boxes are halved, those
with the largest `upper` first, until

    upper <= 1 + slack on every box and bound    proven, and all loops are stable as one is
    lower > 1 + slack on one box                 refuted: every plant of it exceeds the bound
    the number of boxes is spent                 every figure is proven below its largest `upper`
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds, key_words
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.break_points import SensorFamily
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.enclosure import Enclosures, LoopFamily
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum, unmoved_words
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.wiring import OwnPorts
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, Workers, results


@dataclass(frozen=True)
class BoxProofOptions:
    """Numbers of the proof on a box; slacks are relative.

    Attributes
    ----------
    slack : float
        By how much a bound may be exceeded in what is proven.
    slack_of_many : float
        That of several channels or more than `few_parameters`.
    few_parameters : int
        Up to which a box has few parameters.
    most_boxes : int
        Of all options; some twenty seconds.
    most_boxes_of_many : int
        Of each option, with several channels or many parameters.
    stuck_boxes_of_many : int
        Those after which such a proof gives up if it is stuck.
    stuck_share : float
        Of its boxes open: it would take many times as many to close them.
    batch : int
        Boxes that are divided at a time, at most.
    batches : int
        At least, so that little is spent on the worst boxes alone.
    decades : float
        Of frequency cells at the start; below them is one cell to 0.
    poles_apart : float
        Of actuators and sensors behind a hold, relative: or no proof.
    unit_frequency : float
        Over ω_b and the fastest pole: above it cells divide 1/ω.
    shared : int
        Boxes from which on two workers enclose half of them each: a call takes as long as a
        thousand boxes.
    """

    slack: float = 1e-3
    slack_of_many: float = 0.05
    few_parameters: int = 4
    most_boxes: int = 500_000
    most_boxes_of_many: int = 250_000
    stuck_boxes_of_many: int = 45_000
    stuck_share: float = 0.25
    batch: int = 4_000
    batches: int = 250
    decades: float = 6.0
    poles_apart: float = 1e-4
    unit_frequency: float = 3.0
    shared: int = 2_000


@dataclass(frozen=True)
class Division:
    """The result of a division into `boxes`: figures over bounds at most, by kind of bound.

    `exceeded`: a bound, the least factor by which a box exceeds it, and the middle of that box.
    """

    levels: dict[str, float]
    boxes: int
    exceeded: tuple[str, float, tuple[float, ...]] | None = None


@dataclass(frozen=True)
class _Enclosed(Boxes):
    """Boxes with their figures over bounds at most (M, N), and what moves the loop there."""

    highest: Array
    spread: Array

    @property
    def worst(self) -> Array:
        return np.asarray(self.highest.max(axis=0))

    def levels(self, names: Sequence[str]) -> dict[str, float]:
        return dict(zip(names, self.highest.max(axis=1, initial=0.0).tolist(), strict=True))


def divide_one(
    family: LoopFamily, box: Array, slack: float, most: int, enough: int,
    options: BoxProofOptions = BoxProofOptions(), workers: Pool | None = None,
) -> Division:  # fmt: skip
    """Divide the box (2, n) of one option into up to `most`; `enough` where too many stay open."""
    part, known, spent = _initial_boxes(family, box, options.decades), np.array(np.inf), 0
    levels: dict[str, float] = {}
    waiting: _Enclosed | None = None
    while True:
        found = _enclosed(family, part, options.shared, workers)
        spent += len(part.chart)
        k, j = np.unravel_index(np.argmax(found.lowest), found.lowest.shape)
        if found.lowest[k, j] > 1.0 + slack:
            middle = tuple((0.5 * (part.low + part.high)[1:, j]).tolist())
            return Division({}, spent, (found.names[k], float(found.lowest[k, j]), middle))
        highest = np.minimum(found.highest, known)  # what holds on a box holds on its halves
        here = _Enclosed(part.chart, part.low, part.high, highest, found.spread)
        is_open = here.worst > 1.0 + slack
        levels = raise_levels(levels, here.only(~is_open).levels(found.names))
        here = here.only(is_open)
        waiting = here if waiting is None else waiting.beside(here)
        count = len(waiting.worst)
        stuck = spent >= enough and count > options.stuck_share * spent
        if not count or spent >= most or stuck:
            return Division(raise_levels(levels, waiting.levels(found.names)), spent)
        order = np.argsort(-waiting.worst, kind="stable")
        first = min(options.batch, max(enough // options.batches, count // 4, 1))
        worst, waiting = waiting.only(order[:first]), waiting.only(order[first:])
        part, known = _halve(worst), np.tile(worst.highest, 2)


def _enclosed(family: LoopFamily, boxes: Boxes, shared: int, workers: Pool | None) -> Enclosures:
    """The figures on boxes, of many in two halves: the same by any number of workers."""
    every = np.arange(len(boxes.chart))
    parts = enumerate(np.array_split(every, 2 if len(every) >= shared else 1))
    tasks = {i: (family, boxes.only(part)) for i, part in parts}
    done = dict(results(workers, _enclosed_here, tasks))
    names, *arrays = zip(*(vars(done[i]).values() for i in tasks), strict=True)
    return Enclosures(names[0], *map(np.hstack, arrays))


def _enclosed_here(family: LoopFamily, boxes: Boxes) -> Enclosures:
    with np.errstate(all="ignore"):  # of boxes that enclose nothing
        return family.enclose(boxes)


def raise_levels(levels: Mapping[str, float], others: Mapping[str, float]) -> dict[str, float]:
    """The larger one of each."""
    names = dict.fromkeys([*levels, *others])
    return {name: max(levels.get(name, 0.0), others.get(name, 0.0)) for name in names}


def _initial_boxes(family: LoopFamily, box: Array, decades: float) -> Boxes:
    """Cells of frequency from 0 to infinity, or to half the sampling rate, over the whole box.

    Their coordinate is ω/unit up to 1 and then unit/ω down to 0, or ωT from 0 to π; one more cell
    is ω_low alone. ω_low, ω_b and the end of the shape are edges: no bound ends inside a cell.
    """
    low, band = family.bounds.omega_low / family.unit, family.bandwidth / family.unit
    scale, top = 1.0, 1.0
    if family.period is not None:
        scale, top = family.period, np.pi
    edges = np.geomspace(10.0**-decades, 1.0, int(2 * decades) + 1) * top
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
        if 0.0 < 2.0 * low < high:  # a factor begins in octaves: a disc over more holds too much
            ends = np.geomspace(low, high, int(np.ceil(np.log2(high / low))) + 1)
            pieces[i] = np.stack([ends[:-1], ends[1:]], axis=1)
    every = [*itertools.product(cells, *pieces)]
    chart = np.array([one[0][0] for one in every])
    ends = np.array([[one[0][1:], *one[1:]] for one in every], float)
    return Boxes(chart, ends[..., 0].T, ends[..., 1].T)


def _halve(boxes: _Enclosed) -> Boxes:
    """Halve each box along the coordinate that moves its loop most.

    Not along one whose ends differ by rounding alone; a range over more than a factor of 4 at its
    geometric mean, and one of frequency from 0 at a tenth of its end.
    """
    width = boxes.high - boxes.low
    size = np.maximum(np.abs(boxes.low), np.abs(boxes.high))
    fine = width > 1e-13 * np.maximum(size, 1e-300)
    score = np.where(fine, np.where(np.isfinite(boxes.spread), boxes.spread, width), -1.0)
    along = np.argmax(score, axis=0)
    rows = np.arange(len(along))
    a, b = boxes.low[along, rows], boxes.high[along, rows]
    middle = 0.5 * (a + b)
    wide = ((along == 0) | (a > 0.0)) & (b > 4.0 * a)
    with np.errstate(invalid="ignore"):  # √(ab) of a parameter from below 0 is not chosen
        middle = np.where(wide, np.where(a > 0.0, np.sqrt(a * b), 0.1 * b), middle)
    left, right = boxes.high.copy(), boxes.low.copy()
    left[along, rows] = right[along, rows] = middle
    return Boxes(
        np.concatenate([boxes.chart, boxes.chart]),
        np.concatenate([boxes.low, right], axis=1),
        np.concatenate([left, boxes.high], axis=1),
    )


class ProofOutcome(StrEnum):
    """The outcome of a proof; its value is the sentence that reports it."""

    PROVEN = "every bound holds, with its slack, on the whole box"
    LOOSER = "stable on the whole box; some bound is only proven with a larger factor"
    OPEN = "stability is not proven on the whole box within the number of boxes"
    REFUTED = "a plant of the box exceeds a bound by more than the slack"
    UNSTABLE = "the model's own loop is not stable"
    NOT_SQUARE = "the plant has several outputs and not as many channels"
    NOT_MODAL = "the plant is not modal: its damping couples the modes, or brakes a free body"
    FIRST_ORDER = "the plant is given as A, B and C, whose poles are not enclosed"
    WIRED = (
        "channels have different actuators or sensors, or two of their poles coincide, so the set "
        "was searched"
    )
    VARIES = "a theta varies in a plant whose modes are not enclosed, so its range was searched"
    AS_RUN = (
        "two rates, lags of actuators or sensors, or more than three parameters are not enclosed, "
        "so the set was searched"
    )


NOT_APPLICABLE = (ProofOutcome.NOT_SQUARE, ProofOutcome.NOT_MODAL, ProofOutcome.FIRST_ORDER,
                  ProofOutcome.WIRED, ProofOutcome.VARIES, ProofOutcome.AS_RUN)  # fmt: skip


@dataclass(frozen=True)
class Proof:
    """The proof on a box: every |figure| <= level times its bound.

    Attributes
    ----------
    outcome, slack : ProofOutcome, float
        How far it came; the relative excess that was allowed.
    parameters : tuple of str
        The names of the box's coordinates.
    levels : dict
        By kind of bound.
    boxes : int
        Boxes that were enclosed.
    option, point, exceeded : int, tuple of float, (str, float)
        Of a refuted box: where, the bound that it exceeds there and the least factor by which, by
        an enclosure and not by a sample.
    left : str
        Which bounds the proof is not of, in words (empty: of every bound); where it does not apply
        what of the plant is in its way.
    """

    outcome: ProofOutcome
    slack: float
    parameters: tuple[str, ...]
    levels: dict[str, float] = field(default_factory=dict)
    boxes: int = 0
    option: int = 0
    point: tuple[float, ...] = ()
    exceeded: tuple[str, float] = ("", np.nan)
    left: str = ""

    @property
    def proven(self) -> bool:
        """Whether every bound holds with its slack on the whole box."""
        return self.outcome is ProofOutcome.PROVEN

    @property
    def conclusive(self) -> bool:
        """Whether it proves all that is required, and closely: no plant need be drawn besides."""
        return self.proven and not self.left and self.slack <= BoxProofOptions.slack

    @property
    def refuted(self) -> bool:
        """Whether a plant of the box exceeds a bound by more than the slack."""
        return self.outcome is ProofOutcome.REFUTED

    @property
    def denies(self) -> bool:
        """Whether it contradicts that the box is kept: a plant of it, or the model's own loop."""
        return self.refuted or self.outcome is ProofOutcome.UNSTABLE

    @property
    def applies(self) -> bool:
        """Whether plants of this kind are enclosed."""
        return self.outcome not in NOT_APPLICABLE

    @property
    def unproven(self) -> str:
        """The reason why the proof does not apply, or is not of every bound; empty where it is of
        all."""
        if self.applies:
            return self.left
        return self.outcome.value + (f": {self.left}" if self.left else "")

    @property
    def unclosed(self) -> bool:
        """Whether it applied, and did not reach every bound within its slack."""
        return self.outcome in (ProofOutcome.LOOSER, ProofOutcome.OPEN)

    @property
    def stable(self) -> bool:
        """Whether stability is proven on the whole box."""
        return self.outcome in (ProofOutcome.PROVEN, ProofOutcome.LOOSER)

    @property
    def words(self) -> str:
        """The outcome in one line, with its levels."""
        return "; ".join(self.clauses)

    @property
    def clauses(self) -> tuple[str, ...]:
        """The outcome, its levels, and what the proof is not of."""
        if self.outcome is ProofOutcome.REFUTED:
            at = ", ".join(f"{n} {v:.4g}" for n, v in zip(self.parameters, self.point, strict=True))
            name, factor = key_words(self.exceeded[0]), self.exceeded[1]
            return f"a plant of the set exceeds {name} by a factor of {factor:.4g}", f"at {at}"
        if self.outcome is ProofOutcome.UNSTABLE:
            return (f"the proof denies it: {self.outcome.value}",)
        if not self.stable:
            why = self.outcome.value if self.applies else self.unproven
            return (f"searched, not proven: {why}",)
        left = (self.unproven,) if self.left else ()
        worst = max(self.levels.values(), default=0.0)
        if self.outcome is ProofOutcome.LOOSER:
            over = [f"{key_words(name)} below {level:.5g}" for name, level in self.levels.items()
                    if not level <= 1.0 + self.slack]  # fmt: skip
            whose = "its bound" if len(over) == 1 else "their bounds"
            return (
                f"not every bound is proven: only {', '.join(over)} of {whose}",
                f"stable on the whole box by {self.boxes} enclosures",
                *left,
            )
        of_S = max((v for k, v in self.levels.items() if k not in ("KS", "T", "GS")), default=0.0)
        own = f"|S| at most {of_S:.5g} and " if of_S < worst else ""
        return (
            f"proven for the whole box by {self.boxes} enclosures: stable, {own}every figure at "
            f"most {worst:.5g} of its bound",
            *left,
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
    options: BoxProofOptions = BoxProofOptions(),
) -> Proof:
    """Prove bounds and stability of a controller on the whole box, by branch and bound.

    The enclosures are those of `LoopFamily.enclose`. Plants have modal damping; their modal data
    and κ count as exact. Of several channels the whole's bounds are proven.

    Parameters
    ----------
    uncertain : UncertainPlant
        Its box, with all its options.
    structure, kappa : Structure or ChannelStructure, array (n,)
        The controller, SI.
    bandwidth : float
        ω_b, rad/s.
    bounds, sampling : Bounds, Sampling, optional
        None: a continuous loop.
    slack, most_boxes : float, int, optional
        By default those of `options`.
    workers : Pool, optional
        The options are spread over them; of one option its boxes, unless they are a cluster.
    options : BoxProofOptions

    Returns
    -------
    Proof
        Of every bound the factor below which its figure is proven.
    """
    names = uncertain.names
    several = isinstance(structure, ChannelStructure) and bounds.error is None
    many = several or len(names) > options.few_parameters
    if slack is None:
        slack = options.slack_of_many if many else options.slack
    judged = bounds.compliance_max is not None and not uncertain.encloses_forces
    if judged:
        bounds = replace(bounds, compliance_max=None)
    families = _families(uncertain, structure, kappa, bandwidth, bounds, sampling, options)
    if isinstance(families, ProofOutcome):
        why = unmoved_words(uncertain) if families is ProofOutcome.VARIES else ""
        return Proof(families, slack, names, left=why)
    most, enough = (most_boxes or options.most_boxes) // len(families), None
    if many and most_boxes is None:
        most, enough = min(most, options.most_boxes_of_many), options.stuck_boxes_of_many
    proof = divide(families, uncertain.box, slack, most, workers, enough, options)
    # where sensors share an actuator every place is enclosed
    single = bounds.error is None and any(c.given for c in bounds.channels)
    left = "bounds of single channels are" if single else "compliance_max is" if judged else ""
    return replace(proof, left=f"{left} judged, not proven" if left else "")


def _families(
    uncertain: UncertainPlant, structure: Structure | ChannelStructure, kappa: Array,
    bandwidth: float, bounds: Bounds, sampling: Sampling | None, options: BoxProofOptions,
) -> list[LoopFamily] | ProofOutcome:  # fmt: skip
    """The loops of every option, or why there is no proof of them."""
    outputs, inputs = structure.directions
    first = uncertain.options[0]
    own = uncertain.own or OwnPorts(len(first.C), first.B.shape[1])
    if own.outputs != len(outputs) or 1 != len(outputs) != outputs.shape[1]:
        return ProofOutcome.NOT_SQUARE
    models = [uncertain.plant(uncertain.nominal, i).plant_si()
              for i in range(len(uncertain.options))]  # fmt: skip
    K = structure.state_space(kappa)
    if not all(Loop(model, K, sampling).stable for model in models):
        return ProofOutcome.UNSTABLE
    fastest = max(float(np.abs(model.rates).max()) for model in models)
    unit = options.unit_frequency * max(bandwidth, fastest, bounds.omega_low)
    period = None if sampling is None else sampling.period * unit
    delay = 0.0 if sampling is None else sampling.delay * unit
    parts = tuple(structure.split(structure.in_units(kappa, 1.0 / unit, 1.0)))
    kind = LoopFamily if bounds.error is None else SensorFamily
    families = []
    for option, system in enumerate(uncertain.options):
        low_pass = _low_pass(system, own, sampling, options.poles_apart)
        if low_pass is None:
            return ProofOutcome.WIRED
        plant = modal_sum(uncertain, option, unit)
        if plant is None and system.first_order:
            return ProofOutcome.FIRST_ORDER
        if plant is None:
            return ProofOutcome.VARIES if uncertain.ranges else ProofOutcome.NOT_MODAL
        families.append(kind(
            plant, uncertain.names, parts, outputs, inputs, bounds, bandwidth, unit, period, delay,
            tuple((low_pass / unit).tolist()),
        ))  # fmt: skip
    return families


def _low_pass(
    system: Mechanics, own: OwnPorts, sampling: Sampling | None, apart: float
) -> np.ndarray | None:
    """The poles in rad/s that actuators and sensors add; None where the enclosures have none."""
    poles = system.wiring.poles(own.outputs, own.inputs)
    if poles is None or sampling is None:
        return poles
    distance = np.abs(poles[:, None] - poles) + np.diag(np.full(len(poles), np.inf))
    return poles if (distance > apart * np.abs(poles)).all() else None


def divide(
    families: list[LoopFamily], box: Array, slack: float, most: int, workers: Pool | None = None,
    enough: int | None = None, options: BoxProofOptions = BoxProofOptions(),
) -> Proof:  # fmt: skip
    """Prove bounds on a box by branch and bound over every option's loops.

    Parameters
    ----------
    families : list of LoopFamily
        One of each option, its loop stable at one point of `box`.
    box : array (2, n)
        Ends of the uncertain parameters.
    slack : float
        Relative; by how much a bound may be exceeded in what is proven.
    most : int
        Boxes of each option, at most.
    workers : Pool or None
    enough : int or None
        Boxes after which a proof ends that has too many of them open (`stuck_share`); None: `most`.
    options : BoxProofOptions

    Returns
    -------
    Proof
    """
    enough = most if enough is None else enough
    longest_first = sorted(range(len(families)), key=lambda i: -len(families[i].plant.omega))
    near = workers if len(families) == 1 and isinstance(workers, Workers) else None
    tasks = {i: (families[i], box, slack, most, enough, options, near) for i in longest_first}
    found = dict(results(workers, divide_one, tasks))
    names, levels = families[0].names, dict[str, float]()
    for option in range(len(families)):
        one = found[option]
        if one.exceeded is not None:
            name, factor, point = one.exceeded
            return Proof(ProofOutcome.REFUTED, slack, names, {}, one.boxes, option, point,
                         (name, factor))  # fmt: skip
        levels = raise_levels(levels, one.levels)
    highest = max(levels.values(), default=0.0)
    outcome = ProofOutcome.PROVEN if highest <= 1.0 + slack else ProofOutcome.LOOSER
    if not np.isfinite(highest):
        outcome = ProofOutcome.OPEN
    return Proof(outcome, slack, names, levels, sum(one.boxes for one in found.values()))
