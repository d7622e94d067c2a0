"""Plants of first order: the person's own matrices, mechanics, differences, SB10AD, refusals."""

import inspect
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.hard_plants import drawn_weights, far_from_sb10ad
from oracles.helpers import few
from oracles.wired_plants import first_order_system, machine
from scipy.linalg import block_diag

from ccd_casadi import inner
from ccd_casadi.cases.plant_findings import driven_away_findings
from ccd_casadi.fixed_structure.channel_structure import find_decoupling, is_decoupled
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.lti.wiring import Filters, Wiring
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.differenced import user_plant
from ccd_casadi.plants.modal import (
    FREE,
    NOMINAL,
    Perturbation,
    Suspension,
    modal_plant,
    require_damping,
)
from ccd_casadi.plants.places import Places, place_ports
from ccd_casadi.plants.plant import Mechanics, Plant, build_plant, mechanics
from ccd_casadi.plants.plant_facts import PlantFacts, PlantMode, facts_of
from ccd_casadi.plants.registry import two_mass
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant, scale_state_space
from ccd_casadi.support.errors import PlantError

seeds = st.integers(0, 10**6)
THETA = (0.3,)
OFF = Perturbation(0.03, 0.6, (0.01,))


def stable(rng: np.random.Generator, pairs: int, real: int) -> np.ndarray:
    """Light resonances and real poles, over two decades."""
    blocks = []
    for _ in range(pairs):
        rate, zeta = 10.0 ** rng.uniform(-1.0, 1.0), 10.0 ** rng.uniform(-2.5, -0.5)
        blocks.append(rate * np.array([[-zeta, 1.0], [-1.0, -zeta]]))
    return np.asarray(block_diag(*blocks, *(-(10.0 ** rng.uniform(-1.0, 1.0, real)))))


def drawn(seed: int, rest: bool = True, unstable: bool = False, channels: int = 1) -> Plant:
    """A(θ) = A₀ + θ A₁ with θ-dependent B and C; free bodies and integrators that stay, `rest`."""
    rng = np.random.default_rng(seed)
    zero = [np.eye(2, k=1), np.zeros((1, 1))][slice(*sorted(rng.integers(0, 3, 2)))] * rest
    zero = zero[:channels]  # one sensor sees one
    grows = [np.array([[10.0 ** rng.uniform(-1.0, 0.5)]])] * unstable
    part = block_diag(*zero, *grows, stable(rng, int(rng.integers(1, 3)), int(rng.integers(3))))
    n, held = len(part), sum(map(len, zero))
    T = np.linalg.qr(rng.normal(size=(n, n)))[0] * 10.0 ** rng.uniform(-0.5, 0.5, n)
    moved = np.zeros((n, n))
    moved[held:, held:] = 0.1 * rng.normal(size=(n - held, n - held))
    A0, A1 = (np.linalg.solve(T, X @ T) for X in (part, moved))
    B0, B1 = rng.normal(size=(2, n, channels))
    C0, C1 = rng.normal(size=(2, channels, n))

    def model(theta: Mapping[str, Any]) -> dict[str, Any]:
        p = theta["p"]
        U = ca.SX(np.eye(n)) + 0.1 * p * ca.SX(np.triu(A1, 1))  # coordinates that move with θ
        A = ca.solve(U, (A0 + p * A1) @ U)
        B, C = ca.solve(U, B0 + 0.1 * p * B1), (C0 + 0.1 * p * C1) @ U
        return {"A": A, "B": B, "C": C, "hardware_cost": p}

    return build_plant(model, ["p"], {})


def scaled(system: Mechanics, off: Perturbation = NOMINAL, held: Suspension = FREE) -> ScaledPlant:
    return scale_plant(modal_plant(system, held, off), 2.0, bare=True)


def response(system: StateSpace, omega: np.ndarray) -> np.ndarray:
    return np.asarray(system.at(1j * omega))


def distance(found: np.ndarray, expected: np.ndarray) -> float:
    """At the worst frequency, relative to the matrix there."""
    return float((np.abs(found - expected).max((1, 2)) / np.abs(expected).max((1, 2))).max())


OMEGA = np.geomspace(1e-2, 1e2, 25)


@few(max_examples=40)
@given(seeds, st.integers(1, 2))
def test_the_scaled_plant_is_the_matrices_as_returned(seed: int, channels: int) -> None:
    system = mechanics(drawn(seed, channels=channels), THETA)
    own = strictly_proper(-system.K, system.B, system.C)
    expected, found = response(own, OMEGA), response(scaled(system).plant_si(), OMEGA)
    assert distance(found, expected) < 1e-7
    assert np.array_equal(as_written(system).A, own.A)
    off = response(as_written(system, shift=OFF.shift, damping=OFF.damping, modes=OFF.modes), OMEGA)
    assert distance(response(scaled(system, OFF).plant_si(), OMEGA), off) < 1e-7


@few(max_examples=25)
@given(seeds, st.booleans(), st.booleans(), st.booleans())
def test_derivatives_are_those_of_the_response(
    seed: int, perturbed: bool, suspended: bool, wired: bool
) -> None:
    """Also behind an actuator, off the model and on its suspension, coordinates frozen."""
    plant, h = drawn(seed), 1e-5
    off, held = OFF if perturbed else NOMINAL, Suspension(0.01, 0.7) if suspended else FREE
    around = Wiring(actuator=Filters(lag_hz=(3.0,))) if wired else Wiring()

    def at(p: float) -> ScaledPlant:
        return scaled(replace(mechanics(plant, (p,)), wiring=around), off, held)

    here = at(THETA[0])
    G = [response(at(THETA[0] + k * h).plant_si(), OMEGA) for k in (-1.0, 1.0)]
    slope, (dA, dB, dC) = (G[1] - G[0]) / (2.0 * h), here.changes_si()[0]
    s, own = 1j * OMEGA[:, None, None], here.plant_si()
    R = np.linalg.inv(s * np.eye(len(own.A)) - own.A)
    found = dC @ R @ own.B + own.C @ R @ (dA @ R @ own.B + dB)
    assert distance(found, slope) < 1e-4


@few(max_examples=6)
@given(seeds, st.booleans())
def test_a_set_has_derivatives_to_its_point(seed: int, ranged: bool) -> None:
    """Also to a parameter of the model itself, which comes last."""
    plant, h = drawn(seed), 1e-5
    system = mechanics(plant, THETA)
    ranges = (("p", 0.2, 0.3, 0.4),) if ranged else ()
    uncertain = UncertainPlant(
        (system,), 2.0, 0.03, 0.02, (0.5, 2.0), 0.1, ranges,
        (lambda option, values: mechanics(plant, values)) if ranged else None,
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    point = uncertain.nominal + 0.3 * rng.uniform(size=len(uncertain.names)) * (
        uncertain.box[1] - uncertain.nominal
    )
    here = uncertain.with_slopes(point)
    own, s = here.plant_si(), 1j * OMEGA[:, None, None]
    R = np.linalg.inv(s * np.eye(len(own.A)) - own.A)
    for k, (dA, dB, dC) in enumerate(here.changes_si()):
        step = h * np.eye(len(point))[k]
        ends = [response(uncertain.with_slopes(point + e).plant_si(), OMEGA) for e in (-step, step)]
        slope = (ends[1] - ends[0]) / (2.0 * h)
        found = dC @ R @ own.B + own.C @ R @ (dA @ R @ own.B + dB)
        size = 1e-4 * np.abs(slope) + 1e-6 * np.abs(response(own, OMEGA))
        assert (np.abs(found - slope) < size).all(), uncertain.names[k]


def in_units(system: Mechanics, seed: int, decades: float) -> tuple[Mechanics, float, float]:
    """The same in other units of every state, force, position and of time; M_K and ω₀ in these."""
    rng = np.random.default_rng(seed)
    x, (u, y, t) = (10.0 ** rng.uniform(-decades, decades, k) for k in (len(system.K), 3))
    A, B, C = -t * system.K * x / x[:, None], t * system.B * u / x[:, None], y * system.C * x
    return first_order_system(A, B, C), 1.0 / (u * y), t


@few(max_examples=40)
@given(seeds, st.integers(1, 2), st.floats(0.0, 8.0))
def test_units_change_no_verdict(seed: int, channels: int, decades: float) -> None:
    system = machine(seed, channels=channels).system
    own, (other, force, time) = modal_plant(system, FREE), in_units(system, seed, decades)
    moved = modal_plant(other, FREE)
    one, states = own.states, moved.states
    assert one is not None
    assert states is not None
    assert (states.bodies, states.integrators, states.resonances) == (
        one.bodies, one.integrators, one.resonances,
    )  # fmt: skip
    assert states.leading[0] == one.leading[0]
    before, after = (scale_plant(plant, M_K, bare=True)
                     for plant, M_K in ((own, 1.0), (moved, force)))  # fmt: skip
    assert after.omega_0 == pytest.approx(time * before.omega_0, rel=1e-9)
    omega = np.geomspace(1e-2, 3.0, 15) * before.omega_0
    expected = response(strictly_proper(-system.K, system.B, system.C), omega)
    found = response(after.plant_si(), time * omega) * force
    assert distance(found, expected) < 1e-6


@few(max_examples=50)
@given(seeds, st.floats(0.0, 8.0), st.sampled_from(["measured", "driven", "row", "double"]))
def test_what_no_loop_holds_is_refused_in_any_units(seed: int, decades: float, what: str) -> None:
    system = machine(seed).system
    n, none = len(system.K), np.zeros((1, 1))
    loose = block_diag(-system.K, none), np.vstack([system.B, none]), np.hstack([system.C, none])
    if what == "driven":
        loose[2][0, n] = 1.0
    if what == "measured":
        loose[1][n] = 1.0
    if what in ("row", "double"):
        pole = 0.0 if what == "row" else -1.0
        loose = (
            block_diag(-system.K, pole * np.eye(3) + np.eye(3, k=1)),
            np.vstack([system.B, np.eye(3)[:, 2:]]), np.hstack([system.C, np.eye(1, 3)]),
        )  # fmt: skip
    with pytest.raises(PlantError):
        modal_plant(in_units(first_order_system(*loose), seed, decades)[0], FREE)


def test_channels_of_alike_static_gains_are_found_free_or_held() -> None:
    """Two axes, turned: of two equal gains no direction is that of the static gain."""
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    for held in (0.0, 1.0):
        axes = [np.array([[0, 1.0, 0, 0], [-k - held, 0, k, 0], [0, 0, 0, 1.0], [k, 0, -k, -0.1]])
                for k in (100.0, 400.0)]  # fmt: skip
        B, C = np.kron(np.eye(2), np.eye(4)[:, [1]]), np.kron(np.eye(2), np.eye(1, 4))
        system = first_order_system(block_diag(*axes), B @ turn.T, turn @ C)
        found = find_decoupling(scaled(system, held=Suspension(0.01, 0.7)))
        assert np.abs(np.abs(turn.T @ found.outputs).max(0) - 1.0).max() < 1e-9
        assert is_decoupled(scaled(system), found)


def as_first_order(theta: Mapping[str, Any], **options: Any) -> dict[str, Any]:
    """The two masses as ẋ = A x + B u."""
    found = dict(two_mass(theta, **options))
    M, D, K, B, C = (ca.SX(found.pop(key)) for key in
                     ("mass", "damping", "stiffness", "input", "output"))  # fmt: skip
    n = M.shape[0]
    A = ca.vertcat(ca.horzcat(ca.SX(n, n), ca.SX.eye(n)), -ca.solve(M, ca.horzcat(K, D)))
    B, C = ca.vertcat(ca.SX(n, 1), ca.solve(M, B)), ca.horzcat(C, ca.SX(1, n))
    return {**found, "A": A, "B": B, "C": C}


@pytest.mark.parametrize("held", [FREE, Suspension(0.1, 0.7)])
def test_two_masses_are_the_same_in_both_forms(held: Suspension) -> None:
    models, names = (two_mass, as_first_order), ["m1", "m2"]
    both = [build_plant(model, names, {"zeta": 0.01}) for model in models]
    modal = [modal_plant(mechanics(plant, (60.0, 50.0)), held) for plant in both]
    omega = np.geomspace(1.0, 1e4, 40)
    one, other = (response(scale_plant(each, 1e7).plant_si(), omega) for each in modal)
    assert np.abs(other / one - 1.0).max() < 1e-9
    assert modal[1].natural == pytest.approx(modal[0].natural)
    assert modal[1].rigid.tolist() == modal[0].rigid.tolist()
    assert pytest.approx(modal[0].C * modal[0].B.T) == modal[1].C * modal[1].B.T
    assert np.diag(modal[1].D)[1] == pytest.approx(np.diag(modal[0].D)[1])


@few(max_examples=25)
@given(seeds, st.floats(-0.2, 0.2), st.floats(0.3, 3.0))
def test_off_the_model_pairs_move_and_real_poles_and_those_at_0_stay(
    seed: int, shift: float, damping: float
) -> None:
    system = mechanics(drawn(seed), THETA)
    before, after = (modal_plant(system, FREE, off).states for off in
                     (NOMINAL, Perturbation(shift, damping)))  # fmt: skip
    assert before is not None
    assert after is not None
    r, lam = before.at_rest, before.rates
    pairs = (lam.imag != 0.0) & (np.abs(lam.real) < 0.3 * np.abs(lam))
    expected = np.where(pairs, (1.0 + shift) * (damping * lam.real + 1j * lam.imag), lam)
    found = np.linalg.eigvals(after.system.A[r:, r:])
    distance = np.abs(found[:, None] - expected).min(axis=0)
    assert (distance < 1e-7 * np.abs(lam).max()).all()
    assert not after.system.A[r:, :r].any()
    assert after.system.A[:r, :r] == pytest.approx(before.system.A[:r, :r], abs=1e-12)


def judged(seed: int) -> float:
    """The distance of γ_opt from SB10AD's on the matrices as returned; NaN where it is useless."""
    unstable, channels = bool(seed % 2), 1 + seed // 2 % 2
    system = mechanics(drawn(seed, False, unstable, channels), THETA)
    plant = scale_plant(modal_plant(system, FREE), 1.0)
    own = scale_state_space(strictly_proper(-system.K, system.B, system.C), 1.0)
    weights = drawn_weights(np.random.default_rng(seed), own.omega_0)
    return far_from_sb10ad(plant, own, weights)


@few(max_examples=6)
@given(st.integers(0, 49))
def test_certified_with_the_optimum_of_sb10ad(seed: int) -> None:
    assert not judged(seed) > 1e-6


@pytest.mark.slow
def test_fifty_plants() -> None:
    found = [judged(seed) for seed in range(50)]
    assert np.nanmax(found) < 1e-6
    assert np.isfinite(found).sum() > 25


def model_of(**parts: Any) -> Plant:
    given = {"A": -np.eye(2), "B": np.ones((2, 1)), "C": np.ones((1, 2)), "hardware_cost": 1.0}
    found = {key: value for key, value in {**given, **parts}.items() if value is not None}
    return user_plant(lambda theta: found, ["p"], {}, [0.0], [1.0])


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"mass": np.eye(2)}, "returns A, B, C and mass"),
        ({"B": None}, "returns A, C; add B"),
        ({"A": np.ones((2, 3))}, "make it square"),
        ({"D": np.ones((1, 1))}, "add the state of what rolls it off"),
        ({"B": np.ones((3, 1))}, r"B is \(3, 1\); expected \(2, m\), .* as A is \(2, 2\)"),
    ],
)
def test_what_is_no_plant_of_first_order_is_refused(parts: dict[str, Any], words: str) -> None:
    with pytest.raises(PlantError, match=words):
        model_of(**parts)


def test_places_are_refused_where_no_mass_is_given() -> None:
    """Neither a mass that moves along nor a sensor's row is known of A, B and C."""
    plant = replace(drawn(0), inputs=3)
    moved = place_ports(plant, Places(((0.0,), (1.0,), (2.0,)), ((0.5,),)), ["p"])
    with pytest.raises(PlantError, match=r"\[places\] needs a plant function that returns mass"):
        mechanics(moved, THETA)


@pytest.mark.parametrize(
    ("A", "words"),
    [
        (np.array([[-1.0, 1.0], [0.0, -1.0]]), "is not diagonalisable"),
        (np.eye(3, k=1), "three integrators in a row"),
        (np.diag([-1.0, 0.0, 0.0]), "pole at 0 of A is not driven"),
    ],
)
def test_poles_that_cannot_be_reported_apart_are_refused(A: np.ndarray, words: str) -> None:
    n = len(A)
    C = np.eye(1, n) if n == 3 and A[0, 1] else np.ones((1, n))
    B = np.ones((n, 1))
    system = mechanics(model_of(A=A, B=B, C=C), (0.5,))
    with pytest.raises(PlantError, match=words):
        modal_plant(system, FREE)


def test_an_undamped_pair_that_no_loop_reaches_is_refused_by_its_frequency() -> None:
    A = block_diag(np.array([[0.0, 62.8318], [-62.8318, 0.0]]), [[-1.0]])
    system = mechanics(model_of(A=A, B=np.ones((3, 1)), C=np.eye(1, 3, 2)), (0.5,))
    with pytest.raises(PlantError, match="mode at 10 Hz is not damped"):
        require_damping(modal_plant(system, FREE))


@pytest.mark.slow
def test_a_case_of_first_order_has_the_controller_of_the_same_mechanics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = Path(__file__).resolve().parents[2] / "runs" / "two_mass_built.toml"
    head = "from typing import Any, Mapping\nimport casadi as ca\n"
    head += "from ccd_casadi.plants.registry import two_mass\n"
    (tmp_path / "plant.py").write_text(head + inspect.getsource(as_first_order))
    text, case = shipped.read_text(), tmp_path / "case.toml"
    case.write_text(text.replace('model = "two_mass"', 'function = "plant.py:as_first_order"'))
    found = []
    for path in (shipped, case):
        assert inner.main([str(path), "--theta", "m1=55,m2=55"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[1]["status"] == "verified"
    assert found[1]["bandwidth_hz"] == pytest.approx(found[0]["bandwidth_hz"], rel=0.02)


def test_what_drives_a_motion_away_is_named_as_it_is_given() -> None:
    facts = PlantFacts((0.5,), (PlantMode(0.0, 0.0, False, 1.0, 1.0, 2.0),), (), np.nan)
    words = [driven_away_findings(facts, first, "at the start")[0].words for first in (False, True)]
    assert "stiffness" in words[0]
    assert "stiffness" not in words[1]


def test_a_real_pole_is_no_resonance_and_an_undamped_zero_has_no_sign() -> None:
    """A coil before a mass on a spring beside a free body, without damping."""
    masses = np.array([[0.0, 0, 1, 0], [0, 0, 0, 1], [-9, 9, 0, 0], [9, -9, 0, 0]])
    A = block_diag(masses, [[-5.0]])
    A[2, 4] = 1.0
    modal = modal_plant(mechanics(model_of(A=A, B=np.eye(5)[:, 4:], C=np.eye(1, 5)), (0.5,)), FREE)
    facts = facts_of((0.5,), modal, scale_plant(modal, 1e3))
    assert [mode.real for mode in facts.modes] == [False, False, True]
    assert [mode.resonant for mode in facts.modes] == [False, True, False]
    assert [zero.damping_ratio for zero in facts.zeros] == [0.0]
    assert facts.zeros[0].frequency_hz == pytest.approx(3.0 / (2.0 * np.pi))


@pytest.mark.parametrize("integrators", [1, 2])
def test_a_plant_that_first_goes_the_wrong_way_has_the_sign_of_where_it_ends(
    integrators: int,
) -> None:
    """(1 - s/10)/s and (1 - s/10)/s² behind a lag: the first C Aⁿ B is negative."""
    A = block_diag(np.eye(integrators, k=1), [[-50.0]])
    A[integrators - 1, integrators] = 1.0
    B, C = 50.0 * np.eye(integrators + 1)[:, -1:], np.eye(1, integrators + 1)
    wrong = C if integrators == 1 else A
    wrong[0, -1] = -0.1
    first = C @ np.linalg.matrix_power(A, integrators - 1) @ B
    states = modal_plant(mechanics(model_of(A=A, B=B, C=C), (0.5,)), FREE).states
    assert states is not None
    assert first[0, 0] < 0.0 < states.pushed[0, 0]
