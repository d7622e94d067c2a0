"""Required keys are required where they have an effect, and what replaces them has none."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.case import CaseError, case_to_toml, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.structured_plant_set import bounds_of
from ccd_casadi.support.text import package_text

TABLES = tomllib.loads(package_text("templates/case.toml").replace("plant.py", "new_plant.py"))
PATH = Path(parse_case.__code__.co_filename).parents[1] / "templates" / "case.toml"


def tables(*, level: bool = False, **left_out: tuple[str, ...]) -> dict:
    found = {name: dict(table) for name, table in TABLES.items()}
    if not level:
        del found["controller"]["weighted_level"]
    for name, keys in left_out.items():
        for key in keys:
            del found[name][key]
    return found


def bare() -> dict:
    found = tables(inner=("omega_S_hz", "omega_T_hz"))
    del found["weights"]
    return found


def test_a_case_without_idle_keys_has_the_same_bounds() -> None:
    """Whatever M_K would be: loops alone are counted in it."""
    without, given = (problem_of(parse_case(one, PATH)) for one in (bare(), tables()))
    assert np.isfinite(without.weights.M_K)
    assert bounds_of(without) == bounds_of(given)
    heavier = replace(given, weights=replace(given.weights, M_K=100.0 * given.weights.M_K))
    assert bounds_of(heavier) == bounds_of(given)


def test_it_is_read_again_as_it_was() -> None:
    case = parse_case(bare(), PATH)
    again = parse_case(tomllib.loads(case_to_toml(case)), PATH)
    assert problem_of(again) == problem_of(case)


@pytest.mark.parametrize(
    ("left_out", "named"),
    [({"weights": ("M_K",)}, "weights.M_K"), ({"weights": ("A_u",)}, "weights.A_u"),
     ({"inner": ("omega_T_hz",)}, "inner.omega_T_hz")],
)  # fmt: skip
def test_they_are_required_where_they_have_an_effect(
    left_out: dict[str, tuple[str, ...]], named: str
) -> None:
    parse_case(tables(level=True, inner=("omega_S_hz",)), PATH)
    with pytest.raises(CaseError, match=f"{named}: is missing"):
        parse_case(tables(level=True, **left_out), PATH)
    full_order = tables(**left_out)
    del full_order["controller"], full_order["loop"], full_order["inner"]["shape"]
    with pytest.raises(CaseError, match=f"{named}: is missing"):
        parse_case(full_order, PATH)


def test_a_structure_that_is_not_known_is_said_before_what_it_would_require() -> None:
    misspelt = bare()
    misspelt["controller"]["structure"] = "section"
    with pytest.raises(CaseError, match=r"controller.structure: is 'section'; choose one of"):
        parse_case(misspelt, PATH)
