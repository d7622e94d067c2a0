"""A drive's cascade on a set of plants: searched, rounded, judged and proven."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.extensions.drives.cascade import Cascade
from ccd_casadi.extensions.drives.cascade_rows import SearchOptions, split
from ccd_casadi.extensions.drives.cascade_search import (
    Candidate,
    RoundingOptions,
    Search,
    on_the_grid,
)
from ccd_casadi.extensions.drives.drive_data import Setting
from ccd_casadi.extensions.drives.proof import prove_cascade
from ccd_casadi.extensions.drives.two_rates import judge_two_rates
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import Proof, ProofOutcome
from ccd_casadi.fixed_structure.certificate import JudgeOptions, SetCertificate, certify
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.lti.frequency_grid import local_maxima, zoom
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.norms import BetweenSamples, worst_between
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ, plural

NO_CASCADE = (
    "no cascade of this drive meets the bounds from any start; raise S_max or S_low, or give it "
    "more filters"
)


@dataclass(frozen=True)
class DriveOptions:
    """Numbers of a drive's design."""

    draws: int = 200  # plants that are drawn for the judge in each round, besides the corners
    rounds: int = 3  # of search and proof: a plant that the proof finds is added
    added: int = 4  # of the drawn ones, the worst that join the search's plants in a round at most
    lowered: int = 10  # how often ω_b is lowered where the proof finds a slower plant
    lower: float = 1e-3  # by which share
    rise_points: int = 20_000  # frequencies to half the rate at which the filters' gain is checked
    search: SearchOptions = field(default_factory=SearchOptions)
    rounding: RoundingOptions = field(default_factory=RoundingOptions)


@dataclass(frozen=True)
class DriveDesign:
    """A cascade with its rounded values, and what is known of it."""

    cascade: Cascade
    values: Array  # (n,) on the drive's grid, SI
    bandwidth: float  # ω_b in rad/s, for which the proof is
    free: Candidate  # before rounding
    certificate: SetCertificate  # of the rounded controller, on corners, draws and the proof's
    proof: Proof  # of the rounded controller
    worst: Excess  # of the judged plants
    drawn: Yield | None = None  # since the last change of the design; None where it is proven
    compliance: float | None = None  # the largest |z/d| that the judge found, m/N; it is not proven
    mass: float = 0.0  # kg that the force moves as a rigid body, at the position's sensor; 0: none
    between: BetweenSamples | None = None  # S between the samples, where the position counts

    @property
    def feedforward(self) -> list[tuple[Setting, float]]:
        """The settings of the drive's feedforward, with values on its grid: all of the velocity,
        and the mass."""
        drive = self.cascade.drive
        both = (drive.speed_feedforward, 1.0), (drive.force_feedforward, self.mass)
        return [(own, own.round_value(value)) for own, value in both if own and self.mass]

    @property
    def ahead(self) -> tuple[float, float]:
        """f and m of the program."""
        known, drive = dict(self.feedforward), self.cascade.drive
        f, m = (known.get(own, 0.0) if own else 0.0
                for own in (drive.speed_feedforward, drive.force_feedforward))  # fmt: skip
        return f, m

    @property
    def certified(self) -> bool:
        """Whether the judge passes it."""
        return self.certificate.passed

    @property
    def rise(self) -> float:
        """The largest gain of all filters on a sensor's way, relative to their gain at rest."""
        turn = np.linspace(0.0, np.pi, DriveOptions().rise_points)[1:]
        return float(np.exp(self.cascade.rises(self.values, np.exp(1j * turn))[0].max()))

    @property
    def controller(self) -> StateSpace:
        """K(z) of errors of all sensors."""
        return self.cascade.state_space(self.values)


def design_drive(
    cascade: Cascade, uncertain: UncertainPlant, bounds: Bounds, sampling: Sampling, *,
    seed: int = 0, workers: Pool | None = None, progress: Log = silent,
    options: DriveOptions = DriveOptions(), near: Candidate | None = None,
    ported: UncertainPlant | None = None,
) -> DriveDesign:  # fmt: skip
    """Find the fastest rounded cascade.

    `near` is where the search climbs from, instead of many starts; `ported` the same plants with
    their ports, where compliance_max bounds what a force moves; the workers are the judge's. Raises
    UserError where no start is stable within the drive's limits, or none meets the bounds.
    """
    require_known(cascade, bounds)
    if cascade.slower > 1:
        return _design_two_rates(cascade, uncertain, bounds, sampling, seed, progress, options,
                                 near)  # fmt: skip
    of_S, wide = replace(bounds, compliance_max=None), ported or uncertain
    points: list[tuple[int, Array]] = []
    new = first_points(uncertain)
    draws = options.draws if len(new) > 1 else 0
    progress(f"searching {options.search.starts} starts on {plural(len(new), 'plant')}")
    free = near
    for number in range(1, options.rounds + 1):
        points = [*points, *new]
        search = Search(cascade, bounds, sampling, plants_at(wide, points), options.search)
        free = search.fastest(seed, progress) if free is None else search.settle(free)
        if free is None:
            raise UserError(NO_CASCADE)
        progress(f"{free.bandwidth / HZ:.4g} Hz; rounding, round {number} of {options.rounds}")
        rounded = on_the_grid(search, free, options.rounding)
        # a round's draws are fresh: no search has seen them
        tried = [*points, *uncertain.drawn(np.random.default_rng([seed, number, draws]), draws)]
        judged = judge(cascade, rounded.values, uncertain, of_S, sampling, tried, workers)
        moved = None if ported is None else moved_by_forces(
            cascade, rounded.values, ported.as_written(tried), sampling,
            options.search.lowest * bounds.omega_low)  # fmt: skip
        if moved is not None and bounds.compliance_max is not None:
            judged = with_compliance(judged, moved, bounds.compliance_max)
        band = float(np.fmin(judged.bandwidth, rounded.bandwidth))
        progress(f"{band / HZ:.4g} Hz on the drive's grid; proof on the whole set")
        proof = prove_cascade(cascade, rounded.values, band, uncertain, of_S, sampling)
        for _ in range(options.lowered):  # ω_b is the least of the set, not of some plants
            if not proof.refuted or proof.exceeded[0] not in ("SHAPE", "LEVEL"):
                break
            band *= 1.0 - options.lower
            proof = prove_cascade(cascade, rounded.values, band, uncertain, of_S, sampling)
        new = [(proof.option, np.array(proof.point))] if proof.refuted else []
        over = excesses(judged, bounds, rounded.bandwidth)
        if ported is not None or not proof.conclusive:
            worst = np.argsort(-over)[: options.added]
            new += [tried[i] for i in worst if over[i] > options.lower and i >= len(points)]
        if not new:
            break
    assert free is not None
    cascade.require_fit(rounded.values)
    most = between = drawn = None
    if moved is not None:
        most = float(moved.max())
        proof = replace(proof, left="compliance_max is judged, not proven")
    over = excesses(judged, bounds, 0.0)  # ω_b is by definition the least of these plants
    if draws and (most is not None or not proof.conclusive):
        drawn = Yield(int(np.sum(over[-draws:] <= options.lower)), draws, number)
    if all(one.stable for one in judged.plants):
        K, peaks = cascade.state_space(rounded.values), [one.S_peak for one in judged.plants]
        between = worst_between(uncertain.as_written(tried), peaks, K, sampling, bounds.places)
    at = int(np.argmax(over))
    return DriveDesign(cascade, rounded.values, band, free, judged, proof,
                       Excess(*tried[at], float(np.log1p(over[at]))), drawn, most,
                       rigid_mass(uncertain, cascade.position), between)  # fmt: skip


def _design_two_rates(
    cascade: Cascade, uncertain: UncertainPlant, bounds: Bounds, sampling: Sampling, seed: int,
    progress: Log, options: DriveOptions, near: Candidate | None,
) -> DriveDesign:  # fmt: skip
    """Search with the part of a held error that has its frequency, judge by lifting; where that
    exceeds a bound, again with bounds that are tighter by as much."""
    points = first_points(uncertain)
    draws = options.draws if len(points) > 1 else 0
    drawn = uncertain.drawn(np.random.default_rng([seed, draws]), draws)
    plants = plants_at(uncertain, [*points, *drawn])
    own = bounds
    for number in range(1, options.rounds + 1):
        progress(f"searching {options.search.starts} starts, round {number} of {options.rounds}")
        search = Search(cascade, own, sampling, plants[: len(points)], options.search)
        free = search.fastest(seed, progress) if near is None else search.settle(near)
        if free is None:
            raise UserError(NO_CASCADE)
        rounded = on_the_grid(search, free, options.rounding)
        judged = judge_two_rates(cascade, rounded.values, plants, bounds, sampling)
        progress(f"{judged.bandwidth / HZ:.4g} Hz on the drive's grid; {judged.words}")
        if judged.passed:
            break
        peak = max((s for name, s in judged.worst.items() if name != "S_LOW"), default=1.1)
        low = max(1.0, judged.worst.get("S_LOW", 1.1))
        own = _tighter(own, max(1.0, peak) * (1.0 + options.lower), low * (1.0 + options.lower))
    assert free is not None
    cascade.require_fit(rounded.values)
    band = float(np.fmin(judged.bandwidth, rounded.bandwidth))
    worst = Excess(0, uncertain.nominal, float(np.log(max(judged.worst.values(), default=np.inf))))
    return DriveDesign(cascade, rounded.values, band, free, judged,
                       Proof(ProofOutcome.AS_RUN, 0.0, uncertain.names), worst,
                       mass=rigid_mass(uncertain, cascade.position))  # fmt: skip


def _tighter(bounds: Bounds, peak: float, low: float) -> Bounds:
    """The bounds with |S| - 1 and S_low divided by these."""

    def less(S_max: float) -> float:
        return 1.0 + (S_max / peak - 1.0 if S_max > peak else 0.5 * (S_max - 1.0))

    channels = tuple(replace(one, S_max=None if one.S_max is None else less(one.S_max))
                     for one in bounds.channels)  # fmt: skip
    return replace(bounds, S_max=less(bounds.S_max), S_low=bounds.S_low / low, channels=channels)


def judge(
    cascade: Cascade, values: Array, uncertain: UncertainPlant, bounds: Bounds, sampling: Sampling,
    points: list[tuple[int, Array]], workers: Pool | None = None,
) -> SetCertificate:  # fmt: skip
    """Certify values on plants, by the matrices as they are written."""
    plants, K = uncertain.as_written(points), cascade.state_space(values)
    return certify(plants, K, bounds, sampling, integrator=True, workers=workers)


def moved_by_forces(
    cascade: Cascade, values: Array, plants: Sequence[StateSpace], sampling: Sampling, lowest: float
) -> Array:
    """The largest |z/d| of every plant with its ports, m/N, from `lowest` (rad/s; below it the
    integrator lets it fall, and free bodies cost it its digits) to `stiff_below`; inf: unstable."""
    found, K = [], cascade.state_space(values)
    for plant in plants:
        sensed, drive, counted = split(plant, cascade)
        loop = Loop(sensed, K, sampling, drive=drive, counted=counted)
        if not loop.stable:
            found.append(np.inf)
            continue

        def gain(omega: Array, loop: Loop = loop) -> Array:
            return np.asarray(
                np.abs(loop.force_responses(omega.ravel())).max((1, 2)).reshape(omega.shape)
            )

        omega = np.append(loop.grid(), min(cascade.stiff_below, np.pi / sampling.period * 0.999))
        omega = omega[(omega >= lowest) & (omega <= cascade.stiff_below)]
        values = gain(omega)
        top = local_maxima(values)
        tops = zoom(gain, omega[top - 1], omega[top + 1])[1]
        found.append(float(np.append(tops, values).max()))
    return np.array(found)


def with_compliance(judged: SetCertificate, moved: Array, most: float) -> SetCertificate:
    """A certificate with what forces move in the place of GS, over its bound."""
    plants = tuple(replace(one, GS=m) for one, m in zip(judged.plants, moved.tolist(), strict=True))
    share, words = float(moved.max() / most), judged.words
    over = share > 1.0 + JudgeOptions().tolerance
    if over:
        words = f"exceeds compliance_max by {100.0 * (share - 1.0):.2g} %; of |S|: {words}"
    return replace(judged, passed=judged.passed and not over, words=words, plants=plants,
                   worst=judged.worst | {"GS": share})  # fmt: skip


def excesses(judged: SetCertificate, bounds: Bounds, bandwidth: float) -> Array:
    """Compute the share by which every plant exceeds its worst bound, or falls short of the
    bandwidth."""
    found = np.full(len(judged.plants), np.inf)
    for i, one in enumerate(judged.plants):
        if one.stable:
            shares = bounds.shares(one) | bounds.channel_shares(one.channels)
            found[i] = max(*shares.values(), bandwidth / one.bandwidth) - 1.0
    return found


def require_known(cascade: Cascade, bounds: Bounds) -> None:
    """Raise UserError for bounds that a drive's design has no rows of."""
    if bounds.weighted_level is not None:
        raise UserError("weighted_level does not go with [drive]; leave it out")
    if bounds.compliance_max is not None and cascade.slower > 1:
        words = "compliance_max does not go with a slower position loop"
        raise UserError(f"{words}; leave out that or position_rate_hz")


def rigid_mass(uncertain: UncertainPlant, position: int) -> float:
    """kg that the model's force moves as rigid bodies at the position's sensor; 0: none."""
    modal = uncertain.modal(0)
    if modal.states is not None:
        return 0.0
    per_force = float(modal.C[position, modal.rigid] @ modal.B[modal.rigid, 0])
    return 1.0 / per_force if per_force > 0.0 else 0.0


def first_points(uncertain: UncertainPlant) -> list[tuple[int, Array]]:
    """List options and points: the corners, and between the model and each of them half way."""
    corners = uncertain.corners()
    middle = uncertain.nominal
    between = [(option, 0.5 * (point + middle)) for option, point in corners
               if (point != middle).any()]  # fmt: skip
    return [*corners, *between]


def plants_at(uncertain: UncertainPlant, points: list[tuple[int, Array]]) -> list[StateSpace]:
    """Make the plants at points of the box, continuous, SI."""
    return [uncertain.plant(point, option).plant_si() for option, point in points]
