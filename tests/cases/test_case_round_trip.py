"""Any case is written and read back as it was; any value anywhere is a case or one line."""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.case_documents import DOCUMENT, PLANT, TWO_MASS, again, edited, message, verdict
from oracles.helpers import few

from ccd_casadi.cases.case import case_to_toml, load_case, parse_case
from ccd_casadi.cases.tables import Case


def test_the_contracts_case_comes_back_as_it_was(tmp_path: Path) -> None:
    case = load_case(TWO_MASS)
    assert again(case, tmp_path) == case


finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(1e-9, 1e9)
fraction = st.floats(1e-6, 0.9)
above_one = st.floats(1.001, 1e6)
texts = st.text(max_size=12)
names = st.one_of(
    st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True), st.sampled_from(["é", "μ1"])
)
options = st.recursive(
    st.one_of(st.booleans(), st.integers(-(2**63) + 1, 2**63 - 1), finite, texts),
    lambda inside: st.lists(inside, max_size=3),
    max_leaves=5,
)
ranges = st.tuples(positive, st.floats(1.01, 100.0)).map(lambda v: [v[0], v[0] * v[1]])


@st.composite
def parameters(draw: st.DrawFn) -> dict[str, Any]:
    lower, width, share = draw(st.floats(-1e9, 1e9)), draw(st.floats(1.0, 1e9)), draw(fraction)
    table = {"lower": lower, "upper": lower + width}
    optional = {"start": lower + share * width, "unit": draw(texts)}
    return table | draw(st.sampled_from([optional, {}]))


cases = st.fixed_dictionaries(
    {
        "plant": st.dictionaries(names, options, max_size=4).map(
            lambda table: table | {"function": "my_plant.py:model"}
        ),
        "theta": st.dictionaries(names, parameters(), min_size=1, max_size=3),
        "objective": st.fixed_dictionaries({"w1": st.floats(0, 1e9), "w2": st.floats(-1e9, -1e-9)}),
        "weights": st.fixed_dictionaries(
            {
                "M_S": above_one, "A_S": fraction, "c_K": above_one, "omega_K_hz": positive,
                "M_K": positive, "A_l": above_one, "A_u": fraction,
            }
        ),
        "inner": st.fixed_dictionaries(
            {
                "S_max": above_one, "S_low": fraction, "omega_low_hz": positive,
                "omega_S_hz": ranges, "omega_T_hz": ranges,
            },
            optional={
                "gamma_backoff": st.floats(1.001, 9.0),
                "sweep_points": st.lists(st.integers(2, 50), min_size=2, max_size=2),
            },
        ),
    },
    optional={
        "suspension": st.fixed_dictionaries({}, optional={"frequency_hz": positive}),
        "sampling": st.fixed_dictionaries(
            {}, optional={"design": st.sampled_from(["grid", "sobol", "lhs"])}
        ),
        "outer": st.fixed_dictionaries({}, optional={"starts": st.integers(1, 99)}),
    },
)  # fmt: skip


@few(max_examples=50)
@given(document=cases)
def test_every_case_comes_back_as_it_was(
    tmp_path_factory: pytest.TempPathFactory, document: dict[str, Any]
) -> None:
    folder = tmp_path_factory.mktemp("case")
    (folder / "my_plant.py").write_text(PLANT)
    case = parse_case(document, folder / "x.toml")
    found = again(case, tmp_path_factory.mktemp("elsewhere"))
    assert found == case
    assert repr(found) == repr(case)  # types too: 1, 1.0 and True are equal


anything = st.recursive(
    st.one_of(
        st.booleans(), st.integers(), st.floats(), texts, st.dates(),
        st.sampled_from([10**400, -(2**63), 0, 1, 1.0, 60.0, "two_mass", "my_plant.py:model"]),
    ),
    lambda inside: st.one_of(
        st.lists(inside, max_size=3), st.dictionaries(texts, inside, max_size=3)
    ),
    max_leaves=6,
)  # fmt: skip
places = [
    *DOCUMENT,
    *(f"{section}.{key}" for section, table in DOCUMENT.items() for key in table),
    *(f"theta.m1.{key}" for key in DOCUMENT["theta"]["m1"]),
    "plant.function", "inner.sweep_points", "sampling", "sampling.points", "outer.starts",
    "sampling.design", "suspension.frequency_hz",
]  # fmt: skip


@few(max_examples=300)
@given(place=st.sampled_from(places), value=anything)
def test_any_value_anywhere_gives_a_case_or_one_line(place: str, value: Any) -> None:
    path = Path("runs/x.toml")
    found = verdict(lambda: parse_case(edited((place, value)), path))
    if isinstance(found, Case):
        assert tomllib.loads(case_to_toml(found))["plant"]["model"] == "two_mass"
    else:
        assert found.startswith(f"{path}: ")
        assert found.isprintable()


@few(max_examples=100)
@given(document=st.dictionaries(st.one_of(st.sampled_from(list(DOCUMENT)), texts), anything))
def test_no_random_document_is_a_case(document: dict[str, Any]) -> None:
    message(document)


@few(max_examples=100)
@given(cut=st.integers(0, TWO_MASS.stat().st_size), junk=st.binary(max_size=8))
def test_a_damaged_file_gives_a_case_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, cut: int, junk: bytes
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "x.toml"
    whole = TWO_MASS.read_bytes()
    path.write_bytes(whole[:cut] + junk + whole[cut + len(junk) :])
    found = verdict(lambda: load_case(path))
    if isinstance(found, Case):
        assert [p.name for p in found.theta] == ["m1", "m2"]
    else:
        assert found.startswith(f"{path}: ")
        assert found.isprintable()
