"""The proof over a box of plants: enclosures hold, and what does not hold is not proven."""

import re
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from oracles.fixed_structure_loops import BOUNDS, FAST, LATE, WEIGHTS, by_curve
from oracles.helpers import HZ, two_mass_model

from ccd_casadi.codesign.structured_entries import bound_words
from ccd_casadi.fixed_structure.affine import Affine, exponential, inverse, root, variable
from ccd_casadi.fixed_structure.bounds import Bounds, key_words
from ccd_casadi.fixed_structure.box_proof import BoxProofOptions, Proof, ProofOutcome, prove
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.enclosure import LoopFamily
from ccd_casadi.fixed_structure.loop_problem import LoopCurve
from ccd_casadi.fixed_structure.plant_set import all_stable, closed_loops
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant, modal_sum
from ccd_casadi.fixed_structure.worst_plant import lattice
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Workers

SYSTEM = mechanics(two_mass_model(), np.array([55.0, 55.0]))
BOX = UncertainPlant(
    (SYSTEM,), WEIGHTS.M_K, resonance_shift=0.02, damping=(0.5, 2.0), gain=0.03
)
STRUCTURE = Structure(biquads=1)
# integrator, lead, a broad notch on the resonance at 183.6 Hz, roll-off: a PID as in a textbook
KAPPA = np.log(
    [1.2e5, 1.0 * HZ, 4.0 * HZ, 60.0 * HZ, 183.0 * HZ, 0.15, 183.0 * HZ, 0.8, 300.0 * HZ, 0.7]
)


def figures(sampling: Sampling | None, points: list, bounds: Bounds) -> dict[str, float]:
    """The judge's worst figures over their bounds on these plants."""
    judge = certify(BOX.plants(points), STRUCTURE.state_space(KAPPA), bounds, sampling)
    assert judge.worst, judge.words
    return judge.worst | {"SHAPE": 0.0, "LEVEL": 0.0, "bandwidth": judge.bandwidth}


def tight(found: dict[str, float], margin: float) -> tuple[Bounds, float]:
    """Bounds that the worst of the plants that were looked at keeps by this margin, and ω_b."""
    assert BOUNDS.weighted_level is not None
    assert BOUNDS.compliance_max is not None
    bounds = replace(
        BOUNDS,
        S_max=BOUNDS.S_max * found["S_max"] * margin,
        S_low=BOUNDS.S_low * found["S_low"] * margin,
        weighted_level=BOUNDS.weighted_level * max(found["KS"], found["T"]) * margin,
        compliance_max=BOUNDS.compliance_max * found["GS"] * margin,
    )
    return bounds, found["bandwidth"] / margin


@pytest.mark.parametrize("sampling", [None, LATE], ids=["continuous", "late"])
def test_what_the_judge_finds_is_below_what_is_proven_and_close(sampling) -> None:
    corners = figures(sampling, BOX.corners(), BOUNDS)
    bounds, bandwidth = tight(corners, 1.02)
    proof = prove(BOX, STRUCTURE, KAPPA, bandwidth, bounds, sampling)
    assert proof.proven, proof.words
    assert max(proof.levels.values()) <= 1.0 + proof.slack
    seen = figures(sampling, lattice(BOX, 6, 7)[-6:], bounds)
    names = {"S_max": "S_MAX", "S_low": "S_LOW", "KS": "KS", "T": "T", "GS": "GS"}
    for name, own in names.items():
        assert seen[name] <= proof.levels[own]
    assert seen["bandwidth"] >= bandwidth / (1.0 + proof.slack)


def test_a_slack_of_zero_is_taken_as_it_is() -> None:
    """It was replaced by the default: a proof of more than was required."""
    proof = prove(BOX, STRUCTURE, KAPPA, 20.0 * HZ, BOUNDS, slack=0.0, most_boxes=1)
    assert proof.slack == 0.0


def test_halves_of_the_boxes_enclosed_by_two_workers_prove_the_same() -> None:
    bounds, bandwidth = tight(figures(LATE, BOX.corners(), BOUNDS), 1.02)
    rest = BOX, STRUCTURE, KAPPA, bandwidth, bounds, LATE
    whole = prove(*rest, most_boxes=3_000, options=BoxProofOptions(shared=10**6))
    with Workers(2) as workers:
        assert prove(*rest, most_boxes=3_000, workers=workers,
                     options=BoxProofOptions(shared=2)) == whole  # fmt: skip


@pytest.mark.parametrize("sampling", [None, FAST], ids=["continuous", "fast"])
def test_a_box_with_a_plant_that_fails_is_refuted_at_a_plant_that_fails(sampling) -> None:
    bounds, bandwidth = tight(figures(sampling, BOX.corners()[:1], BOUNDS), 1.005)
    proof = prove(BOX, STRUCTURE, KAPPA, bandwidth, bounds, sampling)
    assert proof.outcome is ProofOutcome.REFUTED
    worst = figures(sampling, [(proof.option, np.array(proof.point))], bounds)
    name, factor = proof.exceeded
    if name in ("SHAPE", "LEVEL"):
        assert worst["bandwidth"] < bandwidth
    else:
        assert worst[{"S_MAX": "S_max", "S_LOW": "S_low"}.get(name, name)] >= factor * (1.0 - 1e-9)


@pytest.mark.parametrize("sampling", [None, LATE], ids=["continuous", "late"])
@pytest.mark.parametrize("structure", [STRUCTURE, Structure(False, biquads=1)], ids=["I", "no I"])
def test_enclosures_hold_at_the_corners_of_small_boxes(sampling, structure) -> None:
    """Against the search's own figures, which small enclosures have to meet at a corner."""
    rng, count, unit = np.random.default_rng(5), 60, 3000.0
    kappa = KAPPA if structure.integrator else np.delete(KAPPA, 1)
    period, delay = (sampling.period * unit, sampling.delay * unit) if sampling else (None, 0.0)
    box = replace(BOX, resonance_shift=0.0, damping=(1.0, 1.0))
    plant, bandwidth = modal_sum(box, 0, unit), 20.0 * HZ
    assert plant is not None
    parts = ((structure, structure.in_units(kappa, 1.0 / unit, 1.0)),)
    family = LoopFamily(plant, box.names, parts, np.eye(1), np.eye(1), BOUNDS, bandwidth, unit,
                        period, delay)  # fmt: skip
    omega, gain = np.exp(rng.uniform(*np.log([2.0 * HZ, 400.0 * HZ]), count)), np.zeros(count)
    middle = np.vstack([omega, gain])
    half = 10.0 ** rng.uniform(-5.0, -3.0, (2, count)) * np.vstack([omega, np.ones(count)])
    scale = np.array([[(period or 1.0) / unit], [1.0]])
    chart = np.full(count, Chart.LOW if sampling is None else Chart.SAMPLED)
    found = family.enclose(Boxes(chart, (middle - half) * scale, (middle + half) * scale))
    assert found.bounded.all()
    signs = np.array([[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])
    corner = (middle[:, :, None] + half[:, :, None] * signs[:, None]).reshape(2, -1)
    plants = box.plants([(0, point) for point in corner[1:].T])
    problem = problem_for(plants, structure, BOUNDS, sampling)
    own = problem.plants
    curves = (LoopCurve.S_MAX, LoopCurve.SHAPE, LoopCurve.KS, LoopCurve.T, LoopCurve.GS)
    v = own.variable(corner[0] / own.omega_0)[:, None]
    tau = float(np.log(bandwidth / own.omega_0))
    levels = by_curve(problem, in_problem_units(problem, kappa), tau, curves, v)
    rising = (middle - half)[0] < family.corner
    assert rising.sum() > 10
    for curve in curves:
        highest = found.highest[found.names.index(curve.name)]
        value = np.exp(levels[curve]).reshape(count, 4).max(axis=1)
        if curve is LoopCurve.SHAPE:  # beyond it S_max says more
            highest, value = highest[rising], value[rising]
        assert (value <= highest * (1.0 + 1e-9)).all()
        lost, size = 1.0 - value / highest, (half / np.vstack([omega, np.ones(count)])).max(axis=0)
        assert np.median(lost / (size[rising] if curve is LoopCurve.SHAPE else size)) < 10.0


def test_an_unstable_corner_is_never_proven() -> None:
    """With a gain at which the model is stable and 1.9 times as much is not: no bound helps."""
    box = replace(BOX, gain=0.9, resonance_shift=0.0, damping=(1.0, 1.0))
    models = problem_for(box.plants(box.corners()), STRUCTURE, BOUNDS)
    for factor in np.geomspace(4.0, 100.0, 20):
        hot = KAPPA + np.log(factor) * (np.arange(len(KAPPA)) == 0)
        good = all_stable(closed_loops(models.plants, STRUCTURE, in_problem_units(models, hot)))[0]
        if not good.all():
            break
    assert good[0]
    assert not good[-1]
    loose = replace(BOUNDS, S_max=50.0, S_low=10.0, weighted_level=1e4, compliance_max=1.0)
    proof = prove(box, STRUCTURE, hot, 0.01, loose, most_boxes=20_000)
    assert not proof.stable
    assert not proof.proven


def test_what_cannot_be_closed_says_what_is_proven() -> None:
    """Far more is asked for than the boxes allow: the factor that is proven is no smaller then."""
    bounds, bandwidth = tight(figures(None, BOX.corners(), BOUNDS), 1.0)
    few = prove(BOX, STRUCTURE, KAPPA, bandwidth, bounds, slack=1e-9, most_boxes=12_000)
    assert not few.proven
    if few.outcome is ProofOutcome.LOOSER:
        assert 1.0 + few.slack < max(few.levels.values()) < np.inf
    else:
        assert few.outcome in (ProofOutcome.REFUTED, ProofOutcome.OPEN)


def test_of_coupled_damping_nothing_is_proven() -> None:
    coupled = replace(SYSTEM, damping_ratio=None, D=np.diag([50.0, 400.0]))
    box = replace(BOX, options=(coupled,))
    assert prove(box, STRUCTURE, KAPPA, 1.0, BOUNDS).outcome is ProofOutcome.NOT_MODAL
    twice = replace(BOX, options=(replace(SYSTEM, C=np.eye(2)),))
    assert prove(twice, STRUCTURE, KAPPA, 1.0, BOUNDS).outcome is ProofOutcome.NOT_SQUARE


def forms(rng: np.random.Generator, count: int = 200) -> tuple[Affine, Array, np.ndarray]:
    """Random forms of three variables, points of their boxes, and the forms' values there."""
    centre = rng.normal(size=count) + 1j * rng.normal(size=count)
    slope = (rng.normal(size=(3, count)) + 1j * rng.normal(size=(3, count))) * 0.1
    t = rng.uniform(-1.0, 1.0, (3, count))
    t[:, ::3] = np.sign(t[:, ::3])
    return Affine(centre, slope, np.zeros(count)), t, centre + (slope * t).sum(0)


def encloses(form: Affine, t: Array, value: np.ndarray) -> bool:
    """The value lies within the form at t, and its size within the form's bounds."""
    near = np.abs(value - form.centre - (form.slope * t).sum(0)) <= form.rest
    size = np.abs(value)
    return bool((near & (size <= form.size) & (size >= form.lowest)).all())


def test_affine_forms_enclose_what_they_say() -> None:
    rng = np.random.default_rng(3)
    (f, t, a), (g, _, _) = forms(rng), forms(rng)
    b = g.centre + (g.slope * t).sum(0)
    assert encloses(f + g, t, a + b)
    assert encloses(f - g, t, a - b)
    assert encloses(f * g, t, a * b)
    assert encloses(f * f * g, t, a * a * b)
    assert encloses(inverse(f), t, 1.0 / a)
    assert encloses(exponential(f), t, np.exp(a))
    x = variable(np.array([1.0]), np.array([2.0]), 1, 3)
    here = np.array([[0.0], [0.7], [0.0]])
    assert encloses(root(x * x), here, np.array([1.85]))
    assert np.isfinite(inverse(f).rest).mean() > 0.5


@pytest.mark.parametrize("curve", LoopCurve)
def test_words_name_a_bound_as_a_reader_knows_it(curve: LoopCurve) -> None:
    """No name of an enumeration is in what a proof, a missed bound or a search says of any row."""
    known = ("weighted_level of KS", "weighted_level of T")
    for row in (curve.name, f"{curve.name} of tilt"):
        proof = Proof(ProofOutcome.OPEN, 1e-3, ("damping",), {row: 1.03}, point=(0.5,),
                      exceeded=(row, 1.03))  # fmt: skip
        said = [replace(proof, outcome=outcome).words for outcome in ProofOutcome]
        said += [BOUNDS.missed_words(row, 1.41), key_words(row), *bound_words([row])]
        for words in said:
            plain = reduce(lambda text, name: text.replace(name, ""), known, words)
            names = {one.name for kind in (LoopCurve, ProofOutcome, Chart) for one in kind}
            assert not names & set(re.findall(r"\w+", plain)), words
        assert key_words(row) in said[list(ProofOutcome).index(ProofOutcome.LOOSER)]
        assert key_words(row) in said[list(ProofOutcome).index(ProofOutcome.REFUTED)]
