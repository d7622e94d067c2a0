"""Several sensors on one actuator: |S| wherever the loop may be broken, by formulas of its own."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import control
import numpy as np
import pytest

import ccd_casadi as ccd
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.cases.diagnosis import suspicions
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.boxes import Boxes, Chart
from ccd_casadi.fixed_structure.break_points import SensorFamily
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import _scale
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    given_decoupling,
    sensors_on_one_actuator,
)
from ccd_casadi.fixed_structure.composite import in_search_units
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import RowPlaces, assess, evaluate_rows
from ccd_casadi.fixed_structure.loop_problem import LoopProblem
from ccd_casadi.fixed_structure.starts import actuator_starts
from ccd_casadi.fixed_structure.structure import ParameterKind, Structure
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.kernels.loop_grid import second
from ccd_casadi.kernels.sections import LoopCurve
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.second_engine import second_opinion

SENSORS = given_decoupling(("motor", "load"), [[1, 0], [0, 1]], [[1], [1]])
SECTIONS = ChannelStructure(SENSORS, (
    Structure(integrator=False, lead=1, biquads=1, roll_off=1, least_damping=0.1),
    Structure(lead=1, biquads=1, roll_off=1, least_damping=0.1),
))  # fmt: skip
RATE = Sampling(rate_hz=8000.0, delay_us=375.0)
PLACES = ("motor", "load", "actuator")


def bounds(**other: object) -> Bounds:
    return Bounds(**{
        "S_max": 2.0, "S_low": 0.1, "omega_low": 2.0 * HZ, "shape": 1.1, "error": 1,
        "channels": sensors_on_one_actuator(SENSORS, 2.0), **other,
    })  # fmt: skip


def two_masses(load: float = 1.0) -> StateSpace:
    """A motor of 33 g and a load of 77 g, anti-resonance at 147 Hz and resonance at 269 Hz."""
    m1, m2, d = 0.0329, 0.0771 * load, 2.5
    k = 0.0771 * (147.0 * HZ) ** 2
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    A[2] = [-k / m1, k / m1, -(d + 0.7) / m1, d / m1]
    A[3] = [k / m2, -k / m2, d / m2, -d / m2]
    B = np.array([[0.0], [0.0], [1.0 / m1], [0.0]])
    return StateSpace(A, B, np.eye(2, 4), np.zeros((2, 1)))


def broken(G: np.ndarray, K: np.ndarray) -> dict[str, np.ndarray]:
    """S_i and S_u of G (k, 2, 1) and K (k, 1, 2) by their fractions."""
    L = G[:, :, 0] * K[:, 0, :]
    D = 1.0 + L.sum(axis=1)
    return {"motor": (1.0 + L[:, 1]) / D, "load": (1.0 + L[:, 0]) / D, "actuator": 1.0 / D}


@cache
def design(seed: int = 0) -> ccd.SectionsDesign:
    plant = two_masses()
    system = control.ss(plant.A, plant.B, plant.C, plant.D)
    scale = 0.11 * (30.0 * HZ) ** 2
    return ccd.synthesise_sections(system, SECTIONS, bounds(), sampling=RATE, M_K=scale, starts=6,
                                   seed=seed)  # fmt: skip


@pytest.mark.parametrize("sampling", [None, RATE])
def test_values_and_slopes_of_every_place_are_those_of_its_fraction(
    sampling: Sampling | None,
) -> None:
    plant = two_masses()
    weights = ccd.Weights(M_S=2.0, A_S=1e-3, omega_S=60.0, c_K=1e3, omega_K=3e3, M_K=1e4,
                          A_l=1.0, A_u=1e-2, omega_T=3e3)  # fmt: skip
    limits = bounds(compliance_max=1e-4, weighted_level=2.0, weights=weights)
    scaled = _scale(control.ss(plant.A, plant.B, plant.C, plant.D), limits, None)
    problem = problem_for(scaled, SECTIONS, limits, sampling).parts[0].problem
    kappa = np.random.default_rng(1).normal(0.0, 0.4, len(SECTIONS.names))
    v, step = np.array([0.2, 1.0, 4.0, 7.0]), 1e-6
    G = problem.plants.responses(np.zeros(4, int), v)[0]
    K = np.stack([own.response(part, 1j * v) for own, part in SECTIONS.split(kappa)], -1)[:, None]
    S = broken(G, K)
    first = problem.first
    rows = [(LoopCurve.S_MAX, first + i, S[name] / 2.0) for i, name in enumerate(PLACES)]
    rows += [(curve, first + 1, None) for curve in (LoopCurve.SHAPE, LoopCurve.GS, LoopCurve.T)]
    rows.append((LoopCurve.KS, 0, None))
    for curve, number, expected in rows:
        at = RowPlaces(np.full(4, int(curve)), np.full(4, number), v)

        def of(kappa: np.ndarray, v: np.ndarray, at: RowPlaces = at) -> tuple:
            return evaluate_rows(problem, kappa, -1.0, replace(at, v=v))

        value, slope, to_kappa, *_ = of(kappa, v)
        if expected is not None:
            np.testing.assert_allclose(np.exp(value), np.abs(expected), rtol=1e-9)
        moved = [[of(kappa + sign * step * one, v) for sign in (1, -1)]
                 for one in np.eye(len(kappa))]  # fmt: skip
        by_difference = np.array([(a[0] - b[0]) / (2.0 * step) for a, b in moved]).T
        np.testing.assert_allclose(to_kappa, by_difference, atol=1e-6)
        ahead, back = (of(kappa, v * np.exp(sign * step))[0] for sign in (1, -1))
        np.testing.assert_allclose(slope, (ahead - back) / (2.0 * step), atol=1e-6)
        bending = np.array([(a[2] - b[2]) / (2.0 * step) for a, b in moved]).transpose(1, 2, 0)
        loop = problem.loop(kappa, -1.0)
        found = second(at.curve, at.plant, np.zeros(4, int), v, loop)
        np.testing.assert_allclose(found, bending, atol=1e-5)


def test_a_design_keeps_S_max_at_every_place_by_the_formulas() -> None:
    made = design()
    assert made.certified, made.words
    loop = Loop(two_masses(), made.controller, RATE)
    omega = np.geomspace(1.0, 0.999 * np.pi / RATE.period, 20_000)
    for name, S in broken(*loop.responses(omega)).items():
        assert np.abs(S).max() <= 2.0 * (1.0 + 1e-5), name
    own = np.abs(broken(*loop.responses(omega))["load"])
    below = omega < made.bandwidth * (1.0 - 1e-6)
    assert (own[below] <= np.sqrt(0.5) * (omega / made.bandwidth)[below] * (1.0 + 1e-5)).all()


def test_a_second_sensor_does_not_slow_the_first() -> None:
    plant = two_masses()
    alone = ccd.synthesise_sections(
        control.ss(plant.A, plant.B, plant.C[1:], np.zeros((1, 1))), SECTIONS.structures[1],
        bounds(error=None, channels=()), sampling=RATE, M_K=0.11 * (30.0 * HZ) ** 2, starts=6,
    )  # fmt: skip
    assert alone.certified
    assert design().bandwidth > (1.0 - 1e-3) * alone.bandwidth


def test_judges_and_SLICOT_say_the_same_of_every_place() -> None:
    made, plant = design(), two_masses()
    judged = certify([plant], made.controller, bounds(), RATE, integrator=True)
    places = bounds().places
    opinion = second_opinion(plant, made.controller, RATE, places=places)
    assert [place.name for place in places] == ["load", "motor", "actuator"]
    for own in judged.plants[0].channels:
        assert opinion.norms[f"S of {own.name}"] == pytest.approx(own.S_peak, rel=1e-6)
    loop = Loop(plant, made.controller, RATE, places)
    highest = max(own.S_peak for own in judged.plants[0].channels)
    assert loop.peak == pytest.approx(highest, rel=1e-6)


def test_a_place_that_exceeds_its_bound_alone_fails_the_judge() -> None:
    made, plant = design(), two_masses()
    whole = certify([plant], made.controller, bounds(), RATE)
    peaks = {own.name: own.S_peak for own in whole.plants[0].channels}
    for name, peak in peaks.items():
        own = sensors_on_one_actuator(SENSORS, 2.0, {name: 1.0 + 0.9 * (peak - 1.0)})
        judged = certify([plant], made.controller, bounds(channels=own), RATE)
        assert not judged.passed
        assert f"S_max of channel {name}" in judged.words


@pytest.mark.parametrize("free", [True, False])
@pytest.mark.parametrize("period", [None, 0.4])
@pytest.mark.parametrize("integrator", [True, False])
@pytest.mark.parametrize("skewed", [-0.6, 0.0, 0.6])
def test_enclosures_hold_what_plants_of_their_boxes_have(
    free: bool, period: float | None, integrator: bool, skewed: float
) -> None:
    """Channels may be differences of sensors: KS is then of the sensors, not of the channels."""
    U = SENSORS.outputs + skewed * np.array([[0.0, 1.0], [0.0, 0.0]])
    U = U / np.linalg.norm(U, axis=0)
    rng = np.random.default_rng(5)
    n, count = 3, 120
    omega, rigid = np.array([0.0 if free else 0.4, 1.0, 2.7]), np.array([free, False, False])
    drive = rng.normal(size=(n, 1))
    reading = np.column_stack([drive[:, 0] * rng.uniform(0.5, 1.5, n), rng.normal(size=n)])
    plant = ModalSum(omega, rigid, np.zeros(n), 0.02, drive, reading, np.zeros(n, bool))
    weights = ccd.Weights(M_S=2.0, A_S=1e-3, omega_S=0.3, c_K=100.0, omega_K=3.0, M_K=1.0,
                          A_l=1.0, A_u=1e-2, omega_T=3.0)  # fmt: skip
    limits = bounds(S_low=0.5, omega_low=0.05, compliance_max=1.0, weighted_level=1.0,
                    weights=weights)  # fmt: skip
    parts = []
    for own in (SECTIONS.structures[0], replace(SECTIONS.structures[1], integrator=integrator)):
        ratio = np.array([kind is ParameterKind.DAMPING for kind in own.kinds])
        parts.append((own, np.where(ratio, np.log(0.5), rng.normal(0.0, 1.0, len(ratio)))))
    delay, names = 0.3 * (period or 0.0), ("resonance_shift", "damping", "gain")
    family = SensorFamily(plant, names, tuple(parts), U, SENSORS.inputs, limits, 0.3,
                          1.0, period, delay)  # fmt: skip
    boxes = _drawn_boxes(rng, count, period)
    with np.errstate(all="ignore"):
        found = family.enclose(boxes)
    assert found.bounded.mean() > 0.9
    for k in np.flatnonzero(found.bounded):
        at = boxes.low[:, k] + rng.random(4) * (boxes.high[:, k] - boxes.low[:, k])
        w = {Chart.LOW: at[0], Chart.HIGH: 1.0 / at[0]}.get(boxes.chart[k], at[0] / (period or 1.0))
        *both, s = _responses(plant, at[1:], w, period, delay)
        G, free_G = (U.T @ part for part in both)
        K = np.array([[own.response(part, np.array([s]))[0] for own, part in parts]])
        S = {name: abs(value[0]) for name, value in broken(G[None], K[None]).items()}
        counted = w if integrator else max(w, limits.omega_low)
        of_KS, of_T = np.abs(weights.responses(np.array([w])))[1:, 0]
        true = {f"S_MAX of {name}": value / 2.0 for name, value in S.items()}
        true |= {
            "S_MAX": S["load"] / 2.0, "GS": S["actuator"] * abs(free_G[1, 0]) / (1.0 + at[3]),
            "SHAPE": S["load"] / (limits.room(counted / 0.3) * np.sqrt(0.5) * counted / 0.3),
            "KS": of_KS * S["actuator"] * np.linalg.norm(K @ U.T),
            "T": of_T * S["actuator"] * abs(K[0, 1] * G[1, 0]),
        }  # fmt: skip
        for name, high, low in zip(found.names, found.highest[:, k], found.lowest[:, k],
                                   strict=True):  # fmt: skip
            if name in true and high > 0.0:  # 0: the bound is not of these frequencies
                assert low * (1.0 - 1e-9) <= true[name] <= high * (1.0 + 1e-9), (name, k)


def _drawn_boxes(rng: np.random.Generator, count: int, period: float | None) -> Boxes:
    chart = np.full(count, int(Chart.SAMPLED))
    low = 10.0 ** rng.uniform(-4.0, 0.0, count) * np.pi
    if period is None:
        chart = rng.choice([int(Chart.LOW), int(Chart.HIGH)], count)
        low = 10.0 ** np.where(chart == Chart.LOW, rng.uniform(-4.0, 0.0, count),
                               rng.uniform(-2.0, 0.0, count))  # fmt: skip
    high = low * (1.0 + 10.0 ** rng.uniform(-6.0, -1.5, count))
    if period is not None:
        high = np.minimum(high, np.pi)
    lows, highs = [low], [high]
    for centre, width in ((0.0, 0.05), (1.2, 0.3), (0.0, 0.1)):
        middle = centre + width * rng.uniform(-1.0, 1.0, count)
        radius = width * 10.0 ** rng.uniform(-5.0, -0.5, count)
        lows.append(middle - radius)
        highs.append(middle + radius)
    return Boxes(chart, np.array(lows), np.array(highs))


def _responses(
    plant: ModalSum, at: np.ndarray, w: float, period: float | None, delay: float
) -> tuple[np.ndarray, np.ndarray, complex]:
    """G with hold and delay and without, at ω, and the s of K."""
    shift, damping, gain = at
    n = len(plant.omega)
    A, B, C = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 1)), np.zeros((2, 2 * n))
    own = np.where(plant.rigid, 0.0, plant.omega * (1.0 + shift))
    A[:n, n:] = np.eye(n)
    A[n:, :n], A[n:, n:] = -np.diag(own**2), -np.diag(2.0 * plant.zeta * damping * own)
    B[n:], C[:, :n] = (1.0 + gain) * plant.drive, plant.reading.T
    G = StateSpace(A, B, C, np.zeros((2, 1)))
    free = G.response(np.array([w]))[0]
    if period is None:
        return free, free, 1j * w
    loop = Loop(G, StateSpace(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)),
                              np.zeros((1, 2))), Sampling(1.0 / period, 1e6 * delay))  # fmt: skip
    z = np.exp(1j * w * period)
    return loop.as_run[0].at(np.array([z]))[0], free, 2.0 / period * (z - 1.0) / (z + 1.0)


EXAMPLE = Path(__file__).parents[2] / "examples" / "two_encoders"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('bandwidth_of = "table"\n', "", "controller.bandwidth_of"),
        ('bandwidth_of = "table"', 'bandwidth_of = "tool"', "name one of them"),
        ("outputs = [1, 0]", "outputs = [1, 0]\nintegrator = true", "two integrators"),
        ("outputs = [1, 0]", "outputs = [1, 0]\ninputs = [1]", "all channels drive one actuator"),
        ("S_max = 2.0\n", 'S_max = 2.0\nminimise = "rms_error"\n', "inner.minimise"),
    ],
)  # fmt: skip
def test_what_several_sensors_cannot_have_is_named(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    (tmp_path / "plant.py").write_text((EXAMPLE / "plant.py").read_text())
    text = (EXAMPLE / "case.toml").read_text()
    assert old in text
    (tmp_path / "case.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(CaseError, match=words):
        problem_of(load_case(tmp_path / "case.toml"))


def test_channels_need_no_tables_and_the_counting_one_alone_integrates(tmp_path: Path) -> None:
    (tmp_path / "plant.py").write_text((EXAMPLE / "plant.py").read_text())
    text = (EXAMPLE / "case.toml").read_text().replace('"table"', '"2"')
    head, _, rest = text.partition("[controller.channel.motor]")
    (tmp_path / "case.toml").write_text(head + rest[rest.index("[inner]") :])
    found = structure_of(problem_of(load_case(tmp_path / "case.toml")))
    assert isinstance(found, ChannelStructure)
    assert [own.integrator for own in found.structures] == [False, True]


def test_a_difference_of_sensors_that_sees_no_free_body_is_a_channel() -> None:
    """Alone it cannot be designed; beside the mean of both it may."""
    mean = given_decoupling(("mean", "difference"), [[1, 1], [1, -1]], [[1], [1]])
    structure = ChannelStructure(mean, (
        Structure(lead=1, biquads=0, roll_off=1),
        Structure(integrator=False, lead=1, biquads=0, roll_off=1),
    ))  # fmt: skip
    plant = two_masses()
    A = plant.A.copy()
    A[2, 2] += 0.7 / 0.0329  # without the brake, so that the body is free
    made = ccd.synthesise_sections(
        control.ss(A, plant.B, plant.C, plant.D), structure,
        bounds(error=0, channels=sensors_on_one_actuator(mean, 2.0)), sampling=RATE,
        M_K=0.11 * (30.0 * HZ) ** 2, starts=1,
    )  # fmt: skip
    assert made.certified, made.words


def highest(problem: LoopProblem, kappa: np.ndarray) -> dict[tuple[int, int], float]:
    """By curve and number the largest value over its bound."""
    rows, found = assess(problem, kappa, -1.0).peaks, dict[tuple[int, int], float]()
    assert rows is not None
    for curve, number, value in zip(rows.curve, rows.plant, rows.value, strict=True):
        key = int(curve), int(number)
        found[key] = max(found.get(key, -np.inf), float(value))
    return found


@pytest.mark.parametrize("units", [(1e3, 1.0), (1.0, 1e3), (1e-4, 30.0)])
def test_a_sensor_may_have_any_unit(units: tuple[float, float]) -> None:
    """What the search starts from, its box and its figures are those in metres, K's columns over
    the units."""
    plant, rng = two_masses(), np.random.default_rng
    names = [f"{name}: gain" for name in SENSORS.names]
    shift = np.zeros(len(SECTIONS.names))
    shift[[SECTIONS.names.index(name) for name in names]] = -np.log(units)
    found = []
    for C in (plant.C, np.diag(units) @ plant.C):
        scaled = _scale(control.ss(plant.A, plant.B, C, plant.D), bounds(), 1e4)
        problem = problem_for(scaled, SECTIONS, bounds(), RATE)
        alike = in_search_units(scaled, bounds())
        starts = actuator_starts(problem, SECTIONS, alike, RATE, 3, rng(0))
        found.append((problem, np.array(starts)))
    (metres, starts), (other, moved) = found
    np.testing.assert_allclose(other.box, metres.box + shift, atol=1e-9)
    np.testing.assert_allclose(moved, starts + shift, atol=1e-9)
    for kappa in starts:
        assert highest(other, kappa + shift) == pytest.approx(highest(metres, kappa), abs=1e-7)


@pytest.mark.slow
def test_a_design_in_millimetres_is_that_in_metres() -> None:
    plant, made = two_masses(), design()
    units = np.array([1e3, 1.0])
    system = control.ss(plant.A, plant.B, units[:, None] * plant.C, plant.D)
    other = ccd.synthesise_sections(system, SECTIONS, bounds(), sampling=RATE, starts=6,
                                    M_K=0.11 * (30.0 * HZ) ** 2)  # fmt: skip
    assert other.certified, other.words
    assert other.bandwidth == pytest.approx(made.bandwidth, rel=1e-4)
    # and each is one of the other's plant
    swapped = replace(other.controller, B=other.controller.B * units, D=other.controller.D * units)
    judged = certify([plant], swapped, bounds(), RATE, integrator=True)
    assert judged.passed, judged.words
    assert judged.bandwidth == pytest.approx(other.bandwidth, rel=1e-5)


@pytest.mark.parametrize(
    ("directions", "reversed_rows", "named"),
    [
        (((1, 0), (0, 1)), (), []),
        (((1, 0), (0, 1)), (0,), ["motor"]),
        (((1, 0), (0, 1)), (0, 1), ["motor", "table"]),
        (((1, 0), (0, -1)), (1,), []),  # as the channel has it
        (((1, 1), (1, -1)), (), []),  # a difference sees no free body
        (None, (1,), ["output 2"]),
    ],
)  # fmt: skip
def test_a_reversed_sensor_is_named(
    tmp_path: Path, directions: tuple[tuple[int, int], ...] | None,
    reversed_rows: tuple[int, ...], named: list[str],
) -> None:  # fmt: skip
    signs = [-1.0 if i in reversed_rows else 1.0 for i in range(2)]
    rows = '"both": ca.DM([[1.0, 0.0], [0.0, 1.0]])'
    plant, text = ((EXAMPLE / name).read_text() for name in ("plant.py", "case.toml"))
    assert rows in plant
    (tmp_path / "plant.py").write_text(
        plant.replace(rows, f'"both": ca.DM([[{signs[0]}, 0.0], [0.0, {signs[1]}]])')
    )
    if directions is None:
        head, _, rest = text.replace('"table"', '"2"').partition("[controller.channel.motor]")
        text = head + rest[rest.index("[inner]") :]
    else:
        for old, new in zip(("[1, 0]", "[0, 1]"), directions, strict=True):
            assert f"outputs = {old}" in text
            text = text.replace(f"outputs = {old}", f"outputs = {list(new)}", 1)
    (tmp_path / "case.toml").write_text(text)
    reported = [w for w in suspicions(problem_of(load_case(tmp_path / "case.toml"))) if "sign" in w]
    assert len(reported) == len(named)
    for words, name in zip(reported, named, strict=True):
        assert f"{name} to negative values" in words


@pytest.mark.parametrize(("scale", "named"), [(1.0, 0), (1e3, 1), (1e-3, 1)])
def test_sensors_of_unlike_units_are_named(tmp_path: Path, scale: float, named: int) -> None:
    """One bound on KS counts the gains of both: it has no meaning across units."""
    rows = '"both": ca.DM([[1.0, 0.0], [0.0, 1.0]])'
    plant, text = ((EXAMPLE / name).read_text() for name in ("plant.py", "case.toml"))
    (tmp_path / "plant.py").write_text(plant.replace(rows, rows.replace("[1.0, ", f"[{scale}, ")))
    for bound, count in (("", named), ("weighted_level", 0)):
        lines = [line for line in text.splitlines() if not bound or bound not in line]
        (tmp_path / "case.toml").write_text("\n".join(lines))
        words = suspicions(problem_of(load_case(tmp_path / "case.toml")))
        assert sum("one unit" in one for one in words) == count


def test_a_sensor_that_reads_nothing_is_refused_by_name() -> None:
    plant = two_masses()
    system = control.ss(plant.A, plant.B, np.diag([0.0, 1.0]) @ plant.C, plant.D)
    with pytest.raises(PlantError, match="sensor of channel motor reads nothing"):
        ccd.synthesise_sections(system, SECTIONS, bounds(), sampling=RATE, M_K=1e4, starts=2)
