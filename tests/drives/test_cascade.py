"""Cascades of drives: files, responses and slopes, rounding, search and proof."""

from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
from bench import RATE, SLOW, bounds, cascade, uncertain
from hypothesis import given, settings
from hypothesis import strategies as st

from ccd_casadi.extensions.drives.cascade_rows import FORCE, SearchOptions
from ccd_casadi.extensions.drives.cascade_search import Search
from ccd_casadi.extensions.drives.drive_data import (
    FORMS,
    Filter,
    Number,
    Rule,
    known_drives,
    read_drive,
)
from ccd_casadi.extensions.drives.drive_design import (
    DriveOptions,
    design_drive,
    moved_by_forces,
    require_known,
)
from ccd_casadi.extensions.drives.proof import SampledModel, prove_cascade
from ccd_casadi.fixed_structure.box_proof import ProofOutcome
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

CIRCLE = np.exp(1j * np.array([1e-3, 0.02, 0.3, 1.0, 2.0, 3.0]))


@pytest.mark.parametrize("rule", [Rule.BILINEAR, Rule.PREWARPED, Rule.BACKWARD])
@pytest.mark.parametrize("form", sorted(FORMS))
def test_a_filter_answers_as_its_difference_equation(form: str, rule: Rule) -> None:
    own = Filter(FORMS[form], rule, Number.DOUBLE, RATE.period)
    values = {"f": 300.0, "f_Z": 250.0, "f_N": 700.0, "D": 0.6, "D_Z": 0.2, "D_N": 0.8}
    b, a = own.coefficients(values)
    found, slopes = own.response(values, CIRCLE)
    by_equation = np.polyval(b, CIRCLE) / np.polyval(a, CIRCLE)
    np.testing.assert_allclose(found, by_equation, rtol=1e-9)
    for i, name in enumerate(FORMS[form].names):
        ahead, back = (np.log(own.response({**values, name: values[name] * np.exp(h)}, CIRCLE)[0])
                       for h in (1e-6, -1e-6))  # fmt: skip
        np.testing.assert_allclose(slopes[i], (ahead - back) / 2e-6, atol=1e-7)


def test_a_prewarped_filter_is_exact_at_its_frequencies() -> None:
    own = Filter(FORMS["general"], Rule.PREWARPED, Number.DOUBLE, RATE.period)
    values = {"f_Z": 900.0, "D_Z": 1e-9, "f_N": 2100.0, "D_N": 0.3}
    at = np.exp(2j * np.pi * 900.0 * RATE.period * np.ones(1))
    assert abs(own.response(values, at)[0][0]) < 1e-7


def test_K_is_one_by_responses_states_and_polynomials() -> None:
    own, turn = cascade(), 1.0 / CIRCLE
    K, slopes = own.responses(SLOW, CIRCLE)
    by_states = own.state_space(SLOW).sweep(np.angle(CIRCLE) / RATE.period)[:, 0].T
    np.testing.assert_allclose(by_states, K, rtol=1e-9)
    P, M, Q = (np.prod([np.polyval(c[::-1], turn) for c in part], axis=0)
               for part in own.polynomials(SLOW))  # fmt: skip
    np.testing.assert_allclose(np.array([M / Q, P / Q / (1.0 - turn)]), K, rtol=1e-8)
    for i in range(len(SLOW)):
        step = np.exp(1e-6 * (np.arange(len(SLOW)) == i))
        both = [own.responses(values, CIRCLE)[0] for values in (SLOW * step, SLOW / step)]
        np.testing.assert_allclose(slopes[i], (both[0] - both[1]) / 2e-6, rtol=1e-5, atol=1e-6)


@settings(max_examples=5, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_coefficients_of_the_model_are_those_of_every_plant(shift: float, factor: float) -> None:
    plant = uncertain(damping=(0.7, 1.3), gain=0.0)
    model = SampledModel(plant, 0, RATE, 6000.0)
    assert model.faithful
    powers, error = model.polynomials
    by_powers = np.polynomial.polynomial.polyval2d(shift, factor, powers)
    low, high = plant.box
    at = 0.5 * (low + high) + 0.5 * (high - low) * np.array([shift, factor])
    assert (np.abs(by_powers - model.values(at)) <= error + 1e-300).all()
    assert (error[0, :-1] < 1e-6 * np.abs(powers[0, 0, 0, :-1])).all()


def test_the_model_is_the_sampled_plant() -> None:
    plant = uncertain()
    model, at = SampledModel(plant, 0, RATE, 6000.0), np.array([0.021])
    D, *N = model.values(at)
    z = CIRCLE[1:]
    w = (z - 1.0) / model.period
    G = zoh(plant.plant(at).plant_si(), RATE.period, RATE.delay)
    expected = G.sweep(np.angle(z) / RATE.period)[:, :, 0].T
    for j in range(2):
        own = (np.polyval(N[j], w) + np.polyval(N[2 + j], w) / z) / np.polyval(D, w)
        np.testing.assert_allclose(own / z ** model.delay[0], expected[j], rtol=1e-7)


def figures(values: np.ndarray, shift: float, omega: np.ndarray) -> dict[str, np.ndarray]:
    """|S| at every place by its fraction, of python-control's sampled plant."""
    plant = uncertain().plant(np.array([shift])).plant_si()
    held = control.c2d(control.ss(plant.A, plant.B, plant.C, plant.D), RATE.period, "zoh")
    z = np.exp(1j * omega * RATE.period)
    G = np.array([held(one)[:, 0] for one in z]).T / z**3
    L = G * cascade().state_space(values).sweep(omega)[:, 0].T
    D = np.abs(1.0 + L.sum(axis=0))
    return {"motor": np.abs(1.0 + L[1]) / D, "load": np.abs(1.0 + L[0]) / D, "actuator": 1.0 / D}


def test_what_is_proven_holds_on_plants_of_the_box() -> None:
    proof = prove_cascade(cascade(), SLOW, 15.0 * HZ, uncertain(), bounds(4.0), RATE)
    assert proof.proven, proof.words
    omega = np.geomspace(1.0, 0.9999 * np.pi / RATE.period, 3000)
    for shift in (-0.03, -0.011, 0.0, 0.023, 0.03):
        for name, S in figures(SLOW, shift, omega).items():
            assert S.max() <= 4.0 * proof.levels[f"S_MAX of {name}"] * (1.0 + 1e-9)


def test_a_bound_that_a_plant_exceeds_is_refuted() -> None:
    omega = np.geomspace(100.0, 0.9999 * np.pi / RATE.period, 3000)
    top = max(S.max() for S in figures(SLOW, 0.03, omega).values())
    proof = prove_cascade(cascade(), SLOW, 5.0 * HZ, uncertain(), bounds(0.97 * top), RATE)
    assert proof.outcome is ProofOutcome.REFUTED


def test_an_unstable_loop_is_not_proven() -> None:
    fast = SLOW * np.where(np.arange(len(SLOW)) == 1, 30.0, 1.0)
    proof = prove_cascade(cascade(), fast, 20.0 * HZ, uncertain(), bounds(4.0), RATE)
    assert proof.outcome is ProofOutcome.UNSTABLE


def test_what_is_not_a_polynomial_here_is_not_proven() -> None:
    proof = prove_cascade(cascade(), SLOW, 20.0 * HZ, uncertain(mode_shift=0.01, gain=0.1,
                          damping=(0.9, 1.1)), bounds(4.0), RATE)  # fmt: skip
    assert not proof.proven
    assert proof.outcome is ProofOutcome.AS_RUN


@pytest.mark.parametrize("most", [None, 1e-5])
def test_rows_have_exact_slopes(most: float | None) -> None:
    plants = [pushed(uncertain().plant(np.array([p])).plant_si()) for p in (-0.03, 0.03)]
    search = Search(cascade(), bounds(compliance_max=most), RATE, plants, SearchOptions(points=20))
    here, band = np.log(SLOW), np.log(20.0 * HZ)
    _, slopes = search.rows(here, band)
    for i in range(len(here) + 1):
        step = 1e-6 * (np.arange(len(here) + 1) == i)
        ahead, back = (search.rows(here + h * step[:-1], band + h * step[-1])[0] for h in (1, -1))
        np.testing.assert_allclose(slopes[:, i], (ahead - back) / 2e-6, atol=2e-4)


def model() -> StateSpace:
    return uncertain().plant(np.zeros(1)).plant_si()


def test_a_slow_integral_and_a_low_filter_hold_the_bandwidth_back() -> None:
    search = Search(cascade(), bounds(shape=None), RATE, [model()], SearchOptions(points=20))
    for places, value, allowed in (([2], 1.0, 4.0), ([3, 5], 10.0, 5.0 * HZ)):
        values = SLOW.copy()
        values[places] = value
        assert search.judge(values)[0] == pytest.approx(allowed)
    assert cascade().allowed_bandwidths(np.where(np.arange(len(SLOW)) == 0, 2.0, SLOW)).min() == 8.0


@pytest.mark.parametrize("place", [0, 2])
def test_what_a_constant_force_moves_decays_with_Kv_and_Tn(place: int) -> None:
    """Where one of both is slow the loop has a pole beside it: so `decay` counts them."""
    rate = 1.0  # 1/s
    values = np.where(np.arange(len(SLOW)) == place, rate, SLOW)
    G, K = zoh(model(), RATE.period, RATE.delay), cascade().state_space(values)
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    slowest = np.abs(np.log(np.linalg.eigvals(A).astype(complex) + 1e-300)).min() / RATE.period
    assert slowest == pytest.approx(rate, rel=0.05)


@pytest.mark.parametrize("number", [0.999, 1.001])
def test_a_value_beyond_its_range_is_outside(number: float) -> None:
    search = Search(cascade(), bounds(), RATE, [model()], SearchOptions(points=20))
    values = np.where(np.arange(len(SLOW)) == 4, number, SLOW)  # D_Z: above 1 its roots part
    assert search.inside(values) == (number < 1.0)


@pytest.mark.slow
def test_a_design_is_on_the_grid_verified_and_proven() -> None:
    few = DriveOptions(search=SearchOptions(starts=1, stages=((0.4, 20),)))
    box = uncertain(resonance_shift=0.01)  # 3 % are proven to 0.5 % with these few starts
    found = design_drive(cascade("sinamics_s120"), box, bounds(), RATE, options=few)
    assert found.certificate.passed
    assert found.proof.proven, found.proof.words
    for setting, value in zip(found.cascade.settings, found.values.tolist(), strict=True):
        steps = value * setting.per_si / setting.step
        assert abs(steps - round(steps)) < 1e-6 * max(1.0, abs(steps)), setting.name
        assert setting.range[0] <= value <= setting.range[1] * (1.0 + 1e-12)
        if setting.unit == "Hz":  # no filter takes the place of the PI
            assert value >= 2.0 * found.bandwidth / HZ * (1.0 - 1e-9)
    Kv, _, Tn = found.values[:3]
    assert max(found.bandwidth * Tn, found.bandwidth / Kv) <= 4.0 * (1.0 + 1e-9)
    omega = np.geomspace(1.0, 0.9999 * np.pi / RATE.period, 5000)
    z = np.exp(1j * omega * RATE.period)
    parts = zip(found.cascade.parts(found.values), found.cascade.filters, strict=True)
    current, setpoint = (np.abs(block.response(own, z)[0]) for own, block in parts)
    assert max(current.max(), (current * setpoint).max()) <= 3.0
    plant = box.plant(np.array([0.01])).plant_si()
    G = zoh(plant, RATE.period, RATE.delay).sweep(omega)[:, :, 0].T
    L = G * found.controller.sweep(omega)[:, 0].T
    S = np.abs((1.0 + L[0]) / (1.0 + L.sum(axis=0)))
    assert (S[omega < found.bandwidth] <= np.sqrt(0.5) * 1.0011).all()


@pytest.mark.parametrize("name", known_drives())
def test_every_file_says_where_it_is_from(name: str) -> None:
    drive = read_drive(name)
    assert drive.sources or drive.chosen
    assert drive.places("current")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("rule = ", "rules = "), "unknown key rules"),
        (('"prewarped"', '"sometimes"'), "sometimes"),
        (('place = "current"', 'place = "nowhere"'), "no place or form"),
        (("step = 0.01", "step = 0.0"), "out of order"),
        (("[velocity]", "[speed]"), "speed"),
        (("loop", "= loop"), "valid TOML"),
    ],
)
def test_a_mistake_in_a_file_is_named(change: tuple[str, str], words: str, tmp_path: Path) -> None:
    from ccd_casadi.support.text import package_text

    text = package_text("extensions/drives/data/generic.toml").replace(*change, 1)
    (tmp_path / "own.toml").write_text(text, "utf-8")
    with pytest.raises(UserError, match=words):
        read_drive("own.toml", tmp_path)


def test_a_drive_that_is_not_there_is_named() -> None:
    with pytest.raises(UserError, match="sinamics_s120"):
        read_drive("sinamics")


@pytest.mark.parametrize(
    ("other", "slower", "words"),
    [({"weighted_level": 2.0, "weights": object()}, 1, "weighted_level"),
     ({"compliance_max": 1e-6}, 2, "position_rate_hz")],
)  # fmt: skip
def test_bounds_without_rows_are_refused(other: dict, slower: int, words: str) -> None:
    with pytest.raises(UserError, match=words):
        require_known(replace(cascade(), slower=slower), bounds(**other))


def pushed(plant: StateSpace) -> StateSpace:
    """A second force, at the load (0.0771 kg), and what it moves there."""
    n, u, y = len(plant.A) // 2, plant.B[:, 0], plant.C
    at_load = np.linalg.solve(y[:, :n], [0.0, 1.0 / 0.0771])  # the modes' accelerations
    B = np.column_stack([u, np.concatenate([np.zeros(n), at_load])])
    return StateSpace(plant.A, B, np.vstack([y, y[[1]]]), np.zeros((3, 2)))


def test_what_a_force_moves_is_the_judges_and_that_of_a_simulation() -> None:
    """Rows of the search, `Loop.force_responses`, and a loop that is closed sample by sample."""
    hertz, plant = 20.0, pushed(model())
    own = replace(cascade(), stiff_below=hertz * HZ)
    search = Search(own, bounds(compliance_max=1.0), RATE, [plant], SearchOptions())
    search.on(np.array([1.0, hertz, 100.0]) * HZ)
    (row,) = (one for one in search._figures(search.seen[0], own.responses(SLOW, search.z)[0])
              if one.place == FORCE)  # fmt: skip
    assert np.isinf(row.limit).tolist() == [False, False, True]
    (most,) = moved_by_forces(own, SLOW, [plant], RATE, HZ)
    assert most == pytest.approx(row.size[:2].max(), rel=0.02)  # largest at 20 Hz, or near it
    K, T, count = own.state_space(SLOW), RATE.period, 4000
    G = zoh(strictly_proper(plant.A, plant.B[:, :1], plant.C[:2]), T, RATE.delay)
    parts, n = 8, len(plant.A)  # of a period, in which the force is constant
    fine = zoh(plant, T / parts, 0.0)
    x, k, old, z = np.zeros(n), np.zeros(len(K.A)), [0.0] * 3, []
    assert len(G.A) == n + 3  # the delay is three whole periods
    for i in range(count):
        y = plant.C @ x
        z.append(y[2])
        old.append(float((K.C @ k - K.D @ y[:2])[0]))
        k = K.A @ k - K.B @ y[:2]
        u = old.pop(0)
        for j in range(parts):
            d = np.sin(hertz * HZ * T * (i + (j + 0.5) / parts))
            x = fine.A @ x + fine.B @ np.array([u, d])
    tail = slice(count - 2000, count)
    turn = np.exp(-1j * hertz * HZ * T * np.arange(count))[tail]
    assert 2.0 * abs(np.mean(np.array(z)[tail] * turn)) == pytest.approx(row.size[1], rel=2e-3)
