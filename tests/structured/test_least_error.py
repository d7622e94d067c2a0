"""The least RMS error of a fixed structure: its gradient, its bounds, its optimality."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.case_documents import TWO_MASS
from oracles.fixed_structure_loops import BOUNDS, FAST, loop, plant

from ccd_casadi.budget.sources import (
    ErrorBudget,
    ErrorSource,
    ShapedSpectrum,
    SourceKind,
    TabulatedSpectrum,
)
from ccd_casadi.cases.case import CaseError, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.fixed_structure import least_value as module
from ccd_casadi.fixed_structure import local_search
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.least_value import RmsError, least_value
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.text import HZ

BUDGET = ErrorBudget((
    ErrorSource("cable", SourceKind.FORCE, ShapedSpectrum(1e-4)),
    ErrorSource("encoder", SourceKind.SENSOR_NOISE,
                TabulatedSpectrum((1.0, 1e3), (2.5e-21, 2.5e-21))),
))  # fmt: skip
PID = Structure(biquads=0)
KEPT = replace(BOUNDS, compliance_max=None)


def test_the_error_of_a_set_has_its_gradient() -> None:
    plants = [plant(-0.01), plant(0.02)]
    problem, kappa = loop(3, PID, FAST, (-0.01, 0.02))
    kappa = PID.in_units(kappa, problem.plants.omega_0, problem.plants.force)
    hold = FAST
    goal = RmsError(tuple(plants), PID, BUDGET, hold)
    value, slope = goal.at(kappa)
    each = [RmsError((one,), PID, BUDGET, hold).at(kappa)[0] for one in goal.plants]
    assert np.exp(2.0 * value) == pytest.approx(np.mean(np.exp(2.0 * np.array(each))))
    rng = np.random.default_rng(0)
    way, h = rng.normal(size=len(slope)), 1e-4
    ends = [goal.at(kappa + sign * h * way)[0] for sign in (1.0, -1.0)]
    assert slope @ way == pytest.approx((ends[0] - ends[1]) / (2.0 * h), abs=1e-6)


def test_the_least_error_keeps_bounds_and_bandwidth_and_is_stationary() -> None:
    plants = [plant(0.01)]
    problem, kappa = loop(0, PID, FAST)
    initial = PID.in_units(kappa, problem.plants.omega_0, problem.plants.force)
    first = synthesise_sections(plants, PID, KEPT, sampling=FAST, initial=[initial],
                                only_initial=True)  # fmt: skip
    assert first.certified
    floor = 0.85 * first.bandwidth
    goal = RmsError(tuple(plants), PID, BUDGET, FAST)
    found = least_value(plants, KEPT, first, goal, sampling=FAST, least_bandwidth=floor)
    design = found.design
    assert found.value < found.first_value
    assert design.bandwidth >= floor * (1.0 - 1e-5)
    assert design.controller is not None
    again = certify(plants, design.controller, KEPT, FAST)
    assert again.passed
    assert design.kkt_residual < 1e-4
    assert np.exp(goal.at(design.kappa)[0]) == pytest.approx(found.value)
    # What may be slower need not err more.
    slower = least_value(plants, KEPT, first, goal, sampling=FAST, least_bandwidth=0.9 * floor)
    assert slower.value <= found.value * (1.0 + 1e-4)


def test_a_search_at_the_end_climbs_from_its_design_beside_the_warm_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plants = [plant(0.01)]
    problem, kappa = loop(0, PID, FAST)
    initial = PID.in_units(kappa, problem.plants.omega_0, problem.plants.force)
    first = synthesise_sections(plants, PID, KEPT, sampling=FAST, initial=[initial],
                                only_initial=True)  # fmt: skip
    goal, started = RmsError(tuple(plants), PID, BUDGET, FAST), []

    def descend(model: Any, start: Any, *others: Any) -> Any:
        started.append(start.x[:-1])
        return local_search.descend(model, start, *others)

    monkeypatch.setattr(module, "descend", descend)
    known = least_value(plants, KEPT, first, goal, sampling=FAST).design.kappa
    started.clear()
    alone, both = (
        least_value(plants, KEPT, first, goal, sampling=FAST, initial=[known], only_initial=only)
        for only in (True, False)
    )
    warm, *more = (PID.in_units(x, problem.plants.omega_0, problem.plants.force) for x in started)
    assert warm == pytest.approx(known)
    assert more[0] == pytest.approx(known)
    assert more[1:] == [pytest.approx(first.kappa)]
    assert both.value <= alone.value
    # What another search has gone through is not searched again, and the end is the same.
    started.clear()
    twice = least_value(plants, KEPT, first, goal, sampling=FAST, initial=[known, known],
                        only_initial=True)  # fmt: skip
    assert len(started) == 1
    assert (twice.value, twice.steps) == (alone.value, alone.steps)


@pytest.mark.slow
def test_descents_end_alike_on_any_number_of_workers() -> None:
    plants = [plant(0.01)]
    problem, kappa = loop(0, PID, FAST)
    initial = PID.in_units(kappa, problem.plants.omega_0, problem.plants.force)
    first = synthesise_sections(plants, PID, KEPT, sampling=FAST, initial=[initial],
                                only_initial=True)  # fmt: skip
    goal = RmsError(tuple(plants), PID, BUDGET, FAST)
    begins, ends = [initial + 0.05, initial], []
    for count in (1, 2):
        with Workers(count) as workers:
            found = least_value(plants, KEPT, first, goal, sampling=FAST, initial=begins,
                                workers=workers)  # fmt: skip
        ends.append(found)
    assert (ends[0].value, ends[0].steps) == (ends[1].value, ends[1].steps)
    alone = least_value(plants, KEPT, first, goal, sampling=FAST, initial=begins)
    assert ends[0].value == pytest.approx(alone.value, rel=1e-6)


@pytest.mark.parametrize(
    ("inner", "added", "words"),
    [
        ('minimise = "rms_error"', '[controller]\nstructure = "sections"', "no spectrum says"),
        ("bandwidth_least_hz = 3.0", '[controller]\nstructure = "sections"', "has no effect"),
        ('minimise = "rms_error"', "", 'controller.structure = "sections" only'),
        ('minimise = "energy"', '[controller]\nstructure = "sections"', "choose one of"),
    ],
)
def test_mistakes_in_the_case(tmp_path: Path, inner: str, added: str, words: str) -> None:
    path = tmp_path / "case.toml"
    path.write_text(TWO_MASS.read_text().replace("[inner]", f"[inner]\n{inner}") + "\n" + added)
    with pytest.raises(CaseError, match="inner") as caught:
        load_case(path)
    assert words in str(caught.value)


def test_a_case_asks_for_the_least_error(tmp_path: Path) -> None:
    path = tmp_path / "case.toml"
    text = TWO_MASS.read_text().replace(
        "[inner]", '[inner]\nminimise = "rms_error"\nbandwidth_least_hz = 10.0'
    )
    added = (
        '\n[controller]\nstructure = "sections"\n[budget.force]\nunit = "N/rtHz"\nlevel = 0.01\n'
    )
    path.write_text(text + added)
    sections = problem_of(load_case(path)).controller
    assert sections is not None
    assert (sections.minimise, sections.bandwidth_least) == ("rms_error", 10.0 * HZ)
