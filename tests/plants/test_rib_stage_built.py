"""The design of benchmarks/rib_stage_design: within its bounds as it runs, and no trick in it."""

import json
from pathlib import Path

import numpy as np
import pytest
from oracles import rib_stage_built as built

from ccd_casadi.analysis.loop_channels import sampled_figures
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_files import sections_kappa
from ccd_casadi.extensions.rib_stage.geometry import NAMES
from ccd_casadi.extensions.rib_stage.stage_plant import rib_stage
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner import main as inner_main
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import closed_loop
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.support.errors import UserError

RUNS = Path(__file__).parents[2] / "runs"


def test_the_shipped_design_holds_on_the_ends_of_its_models_box() -> None:
    """Sampled with hold and delay by code that the synthesis does not use; no payload here."""
    theta = built.theta_of(built.DESIGN)
    stage, kept = rib_stage(NAMES), json.loads((built.DESIGN / "inner.json").read_text())
    assert hardware_cost(stage, theta) == pytest.approx(kept["hardware_cost"], rel=1e-9)
    box = UncertainPlant((mechanics(stage, theta, derivatives=False),), built.M_K,
                         mode_shift=0.02, damping=(0.5, 2.0))  # fmt: skip
    K = built.controller(built.DESIGN)
    for _, point in box.corners()[1:]:
        loop = closed_loop(zoh(box.plant(point).plant_si(), 1.0 / built.RATE, built.DELAY), K).S
        figures = sampled_figures(loop)
        assert figures.stable
        assert figures.sensitivity_peak <= built.S_MAX * (1.0 + 1e-4)
        assert figures.bandwidth > kept["bandwidth_hz"] * built.HZ * (1.0 - 1e-3)


def test_no_light_root_of_the_controller_stands_at_the_bandwidth() -> None:
    """A pole and a zero there that nearly cancel would bend |S| for the figure alone."""
    kept = json.loads((built.DESIGN / "inner.json").read_text())
    channels = json.loads((built.DESIGN / "controller.json").read_text())["sections"]["channels"]
    for channel in channels:
        values = {item["name"]: item["value"] for item in channel["parameters"]}
        for name, value in values.items():
            if f"{name} damping" in values and 0.8 < value / kept["bandwidth_hz"] < 1.25:
                assert values[f"{name} damping"] >= 0.1 * (1.0 - 1e-9)


def test_tip_and_tilt_have_one_controller() -> None:
    """So that a payload to any side is the one that the set has."""
    channels = json.loads((built.DESIGN / "controller.json").read_text())["sections"]["channels"]
    one, other = (
        [row["value"] for row in channel["parameters"]]
        for channel in channels
        if channel["name"] in ("tip", "tilt")
    )
    assert one == pytest.approx(other, rel=1e-12)
    assert np.isfinite(one).all()


def test_a_known_controller_is_where_inner_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its parameters are read for the case's structure alone, and for sections alone."""
    problem = problem_of(load_case(RUNS / "rib_stage_built.toml"))
    kappa = sections_kappa(built.DESIGN, structure_of(problem))
    assert len(kappa) == len(structure_of(problem).names)
    with pytest.raises(UserError, match="name a run of this case"):
        sections_kappa(built.DESIGN, Structure())
    required = ["--theta", "m1=60,m2=60", "--begin-at", str(built.DESIGN), "--quiet"]
    assert inner_main([str(RUNS / "two_mass.toml"), *required]) == 2
    assert "--begin-at" in capsys.readouterr().err
    with pytest.raises(UserError):
        sections_kappa(tmp_path, structure_of(problem))
