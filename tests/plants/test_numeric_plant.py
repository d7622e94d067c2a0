"""Plants that take numbers only: their derivatives against exact ones, and that they are told."""

import json
import math
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from oracles.helpers import few

from ccd_casadi.codesign.outer_problem import NonlinearProgram, solve_program
from ccd_casadi.optim.pieces import Box
from ccd_casadi.plants.differenced import user_plant
from ccd_casadi.plants.plant import build_plant, constraint_values, hardware_cost
from ccd_casadi.solve import main
from ccd_casadi.support.errors import PlantError

NAMES, LOWER, UPPER = ("m", "t"), (1.0, 2e-3), (3.0, 5e-3)
SOLVE = ["--formulation", "lifted", "--workers", "1"]


def model(theta, sine=ca.sin, array=ca.DM):
    m, t = theta["m"], theta["t"]
    k = 1e14 * t**3 * (1 + 0.1 * sine(m))
    return {
        "mass": m * array([[2.0, 0.1], [0.1, 1.0]]),
        "stiffness": k * array([[1.0, -1.0], [-1.0, 1.0]]),
        "damping": 1e-6 * k * array([[1.0, -1.0], [-1.0, 1.0]]),
        "input": array([[1.0], [0.0]]) * m,
        "output": array([[1.0, 0.0]]) / t,
        "hardware_cost": m**2 + 1e3 * m * t,
        "constraints": {"stiff": 2.0 - m * t * 500.0},
    }


def numbers_only(theta):
    """The same by floats: `math.sin` of a symbol is nan, which tracing does not notice."""
    return model(theta, math.sin, np.array)


@few(max_examples=20)
@example(0.17419198495041546, 0.1796875)
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_differences_are_the_exact_derivatives_up_to_the_bounds(a: float, b: float) -> None:
    theta = [
        low + share * (high - low) for low, high, share in zip(LOWER, UPPER, (a, b), strict=True)
    ]
    exact = build_plant(model, NAMES, {})
    plant = user_plant(numbers_only, NAMES, {}, LOWER, UPPER)
    assert "takes numbers only" in plant.notes(theta)[0]
    expected, found = exact.evaluate(theta), plant.evaluate(theta)
    width = np.subtract(UPPER, LOWER)[:, None, None]
    for one, other in zip(expected.derivatives, found.derivatives, strict=True):
        size = np.abs(one * width).max()
        np.testing.assert_allclose(other * width, one * width, atol=1e-8 * size)
    x = ca.MX.sym("x", 2)
    f = [ca.vertcat(*p.hardware(x)) for p in (exact, plant)]
    slopes = [ca.Function("slopes", [x], [ca.jacobian(value, x)]) for value in f]
    np.testing.assert_allclose(slopes[1](theta), slopes[0](theta), rtol=1e-8)
    curve = [ca.Function("curve", [x], [ca.hessian(value[0], x)[0]]) for value in f]
    box = np.outer(np.subtract(UPPER, LOWER), np.subtract(UPPER, LOWER))
    np.testing.assert_allclose(curve[1](theta) * box, curve[0](theta) * box, atol=1e-5)
    # CasADi and Python multiply in an order and by a power of their own
    last = {"rel": 1e-15, "abs": 4e-15}
    assert hardware_cost(plant, theta) == pytest.approx(hardware_cost(exact, theta), **last)
    assert constraint_values(plant, theta) == pytest.approx(constraint_values(exact, theta), **last)


def test_the_function_is_never_required_outside_the_bounds() -> None:
    required = []

    def watched(theta):
        required.append((float(theta["m"]), float(theta["t"])))
        return numbers_only(theta)

    plant = user_plant(watched, NAMES, {}, LOWER, UPPER)
    required.clear()
    for theta in (LOWER, UPPER):
        plant.evaluate(theta)
    assert len(required) >= 8
    assert (np.array(required) >= np.array(LOWER) * (1 - 1e-12)).all()
    assert (np.array(required) <= np.array(UPPER) * (1 + 1e-12)).all()


def test_the_error_reported_is_above_the_true_one_and_shows_noise() -> None:
    theta = (1.7, 3e-3)
    plant = user_plant(numbers_only, NAMES, {}, LOWER, UPPER)
    reported = float(plant.notes(theta)[0].split("at most ")[1].split()[0])
    assert 1e-12 < reported < 1e-4
    rng = np.random.default_rng(0)

    def noisy(theta):
        found = numbers_only(theta)
        return found | {"stiffness": found["stiffness"] * (1.0 + 1e-5 * rng.normal())}

    words = user_plant(noisy, NAMES, {}, LOWER, UPPER).notes(theta)[0]
    assert float(words.split("at most ")[1].split()[0]) > 1e-4


def test_a_model_of_symbols_stays_exact_and_one_with_a_moving_ratio_is_refused() -> None:
    assert user_plant(model, NAMES, {}, LOWER, UPPER).notes((2.0, 3e-3)) == ()

    def moving(theta):
        found = numbers_only(theta)
        np.linalg.eigvalsh(np.array([[theta["m"]]]))  # takes no symbols
        del found["damping"]
        return found | {"damping_ratio": 0.01 * theta["m"]}

    plant = user_plant(moving, NAMES, {}, LOWER, UPPER)
    with pytest.raises(PlantError, match="damping_ratio changes with theta"):
        plant.evaluate((2.0, 3e-3))


@pytest.mark.parametrize("at", [0.05, 0.3, 0.7, 0.95])
def test_a_branch_on_a_symbol_is_read_as_the_function_returns_it(at: float) -> None:
    """`float` of a symbol is nan: traced, one side of the branch is taken in the whole box."""
    edge = LOWER[0] + at * (UPPER[0] - LOWER[0])

    def branched(theta):
        found = model(theta)
        factor = 0.25 if float(theta["m"]) < edge else 1.0
        return found | {"stiffness": factor * found["stiffness"]}

    plant = user_plant(branched, NAMES, {}, LOWER, UPPER)
    for share in (0.0, 0.01, 0.2, 0.5, 0.8, 1.0):
        theta = np.add(LOWER, share * np.subtract(UPPER, LOWER))
        expected = branched(dict(zip(NAMES, theta, strict=True)))["stiffness"]
        assert pytest.approx(np.array(expected), rel=1e-9) == plant.evaluate(theta).K


def test_a_branch_that_no_compared_theta_shows_is_seen_where_it_is_judged() -> None:
    """A window in the box that corners and points in between do not meet."""
    traced = user_plant(model, NAMES, {}, LOWER, UPPER)
    inside = tuple(np.add(LOWER, 0.37 * np.subtract(UPPER, LOWER)))

    def window(theta):
        found = model(theta)
        factor = 2.0 if abs(float(theta["m"]) - inside[0]) < 1e-6 else 1.0
        return found | {"stiffness": factor * found["stiffness"]}

    plant = user_plant(window, NAMES, {}, LOWER, UPPER)
    assert plant.notes(inside) == traced.notes(inside) == ()
    assert plant.mismatch(inside) == "its expressions differ from the numbers that it returns"
    assert plant.mismatch(tuple(LOWER)) == traced.mismatch(inside) == ""


def test_ipopt_finds_the_least_cost_of_a_numeric_plant_as_of_the_exact_one() -> None:
    ends = []
    for plant in (build_plant(model, NAMES, {}), user_plant(numbers_only, NAMES, {}, LOWER, UPPER)):
        theta = ca.MX.sym("theta", 2)
        f, lam = plant.hardware(theta)
        program = NonlinearProgram(
            x=theta, f=f, g=lam, box=Box(np.array(LOWER), np.array(UPPER)),
            exact_hessian=plant.exact_hessian,
        )  # fmt: skip
        ends.append(solve_program(program, np.array([[2.0, 3e-3]])).best)
    np.testing.assert_allclose(ends[1].x, ends[0].x, rtol=1e-6)
    assert ends[0].x[0] * ends[0].x[1] == pytest.approx(2.0 / 500.0)  # the constraint binds


@pytest.mark.slow
def test_a_numeric_plant_is_solved_as_the_exact_one_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], two_mass_run: Path
) -> None:
    """Case study 1 written with NumPy and `float`."""
    (tmp_path / "plant.py").write_text(
        "import numpy as np\n\n\ndef model(theta):\n"
        '    m1, m2 = float(theta["m1"]), float(theta["m2"])\n'
        "    k = 2 * m1**4 + 2 * m2**4\n"
        "    spring = np.array([[1, -1], [-1, 1]])\n"
        '    return {"mass": np.diag([m1, m2]), "stiffness": k * spring,\n'
        '            "damping": 0.02 * np.sqrt(k * m1 * m2 / (m1 + m2)) * spring,\n'
        '            "input": [1.0, 0.0], "output": [[1.0, 0.0]],\n'
        '            "hardware_cost": m1 + m2}\n'
    )
    text = (Path(__file__).parents[2] / "runs" / "two_mass.toml").read_text()
    text = text.replace('model = "two_mass"', 'function = "plant.py:model"')
    text = text.replace("zeta = 0.01 ", "#")
    (tmp_path / "own.toml").write_text(text)
    assert main([str(tmp_path / "own.toml"), "--out", str(tmp_path / "run"), *SOLVE]) == 0
    assert "note: the plant function takes numbers only" in capsys.readouterr().err
    found = json.loads((tmp_path / "run" / "result.json").read_text())
    exact = json.loads((two_mass_run / "result.json").read_text())
    assert "takes numbers only" in found["notes"][0]
    assert exact["notes"] == []
    assert found["bandwidth_hz"] == pytest.approx(exact["bandwidth_hz"], rel=1e-7)
    assert "takes numbers only" in (tmp_path / "run" / "report.html").read_text("utf-8")
