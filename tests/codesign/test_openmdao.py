"""Certified loops as OpenMDAO's components: its own check of the partials, and the same optimum."""

import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.helpers import HZ, problem

import ccd_casadi as ccd
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.plant import constraint_values, hardware_cost
from ccd_casadi.support.errors import UserError

om = pytest.importorskip("openmdao.api", reason="OpenMDAO is not installed (the extra `openmdao`)")
from ccd_casadi.extensions.openmdao.components import CertifiedLoop, LargestBandwidth, pose  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
# what OpenMDAO itself calls in a way that newer versions of others warn of is not ours to mend
pytestmark = pytest.mark.filterwarnings("ignore")


def at(component: Any, values: dict[str, float]) -> Any:
    found = om.Problem(reports=False)
    found.model.add_subsystem("loop", component, promotes=["*"])
    found.setup()
    for name, value in values.items():
        found.set_val(name, value)
    found.run_model()
    return found


def largest_error(found: Any) -> float:
    """Relative, of any partial that is not zero, against central differences."""
    checked = found.check_partials(
        out_stream=None, method="fd", form="central", step=3e-4, step_calc="rel_element"
    )["loop"]
    sizes = {pair: np.abs(entry["J_fd"]).max() for pair, entry in checked.items()}
    for pair, size in sizes.items():
        if size == 0.0:
            assert np.abs(checked[pair]["J_fwd"]).max() == 0.0
    return max(
        np.abs(entry["J_fwd"] - entry["J_fd"]).max() / sizes[pair]
        for pair, entry in checked.items()
        if sizes[pair] > 0.0
    )


@pytest.mark.parametrize("compliance_max", [None, 1e-4])
def test_the_partials_of_a_synthesis_are_exact(compliance_max: float | None) -> None:
    required = problem()
    required = replace(required, inner=replace(required.inner, compliance_max=compliance_max))
    omega = (800.0 * HZ, 40.0 * HZ)
    weights = dict(zip(("ln_omega_S", "ln_omega_T"), np.log(omega), strict=True))
    found = at(CertifiedLoop(problem=required), {"m1": 60.0, "m2": 58.0} | weights)
    assert largest_error(found) < 1e-5
    figures = ccd.true_design(required, (60.0, 58.0), *omega).figures
    assert found.get_val("bandwidth").item() == pytest.approx(figures.bandwidth, rel=1e-9)
    bounded = required.inner.bounds.values()
    assert len(bounded) == 2 + (compliance_max is not None)
    for name, _ in bounded:
        assert found.get_val(name).item() == pytest.approx(getattr(figures, name), rel=1e-9)


def test_a_plant_gives_its_constraints_and_a_model_is_reported_the_bounds() -> None:
    required = ccd.problem_of(ccd.load_case(ROOT / "examples/three_mass_axis/case.toml"))
    found = om.Problem(reports=False)
    found.model.add_subsystem("loop", CertifiedLoop(problem=required), promotes=["*"])
    pose(found.model, required)
    found.model.add_objective("hardware_cost")
    found.setup()
    found.run_model()
    plant = plant_of(required)
    own = constraint_values(plant, required.start)
    np.testing.assert_allclose(found.get_val("constraints"), own)
    slopes = found.compute_totals(["hardware_cost", "constraints"], list(required.names))
    d, h = np.array(required.start), 1e-6 * np.array(required.start)
    for i, name in enumerate(required.names):
        step = h * np.eye(len(h))[i]
        for output, of in (("hardware_cost", hardware_cost), ("constraints", constraint_values)):
            change = (np.array(of(plant, d + step)) - of(plant, d - step)) / (2.0 * h[i])
            np.testing.assert_allclose(slopes[output, name].ravel(), change.ravel(), rtol=1e-6)
    bounds = found.model.get_design_vars()
    for name, low, high in zip(required.names, required.lower, required.upper, strict=True):
        assert (bounds[name]["lower"], bounds[name]["upper"]) == (low, high)
    assert {"ln_omega_S", "ln_omega_T"} < set(bounds)
    limits = found.model.get_constraints()
    assert set(limits) == {"sensitivity_peak", "sensitivity_low", "constraints"}
    assert limits["sensitivity_peak"]["upper"] == required.inner.S_max


def test_the_partials_of_the_inner_problem_are_its_envelope() -> None:
    required = problem()
    found = at(LargestBandwidth(problem=required), {"m1": 60.0, "m2": 58.0})
    assert largest_error(found) < 1e-5
    best = ccd.true_inner(required, (60.0, 58.0))
    assert found.get_val("bandwidth").item() == best.bandwidth


def test_what_is_not_certified_is_an_analysis_error() -> None:
    required = problem()
    nothing = replace(required, inner=replace(required.inner, S_max=1.01))
    with pytest.raises(om.AnalysisError, match="no certified design"):
        at(LargestBandwidth(problem=nothing), {})


def test_a_fixed_structure_needs_its_anchors() -> None:
    required = ccd.problem_of(ccd.load_case(ROOT / "runs/two_mass_built.toml"))
    with pytest.raises(UserError, match="read_run"):
        at(LargestBandwidth(problem=required), {})


def test_the_example_ends_where_solve_does_and_moves_for_a_price(
    two_mass_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = ccd.read_run(two_mass_run).result
    same, priced = runpy.run_path(str(ROOT / "examples/openmdao/lightness.py"))["main"]()
    assert same.get_val("J").item() == pytest.approx(result["objective"], rel=1e-6)
    for name, value in result["theta"].items():
        assert same.get_val(name).item() == pytest.approx(value, rel=1e-6)
    assert priced.get_val("m2").item() > 55.5
    assert "EUR" in capsys.readouterr().out
