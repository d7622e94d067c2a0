"""The design of benchmarks/rib_stage_design: light enough, and within its bounds as it runs."""

import json
from pathlib import Path

import numpy as np
import pytest
from benchmark_scripts import FOLDER, benchmark

from ccd_casadi.cases.case import load_case, problem_of
from ccd_casadi.cases.run_folder import sections_kappa
from ccd_casadi.deployment.sampled import sampled_figures, sampled_plant, sensitivity_loop
from ccd_casadi.fixed_structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner import main as inner_main
from ccd_casadi.inner_problem.sections_plant_set import structure_of
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.plants.rib_stage import NAMES
from ccd_casadi.plants.rib_stage.plant import rib_stage
from ccd_casadi.support.errors import UserError

built = benchmark("rib_stage_built")


def test_the_shipped_design_holds_on_the_ends_of_its_models_box() -> None:
    """Sampled with hold and delay by code that the synthesis does not use; no payload here."""
    theta = built.theta_of(built.DESIGN)
    stage = rib_stage(NAMES)
    assert hardware_cost(stage, theta) <= 0.6
    box = UncertainPlant((mechanics(stage, theta, derivatives=False),), Suspension(), built.M_K,
                         mode_shift=0.02, damping=(0.5, 2.0))  # fmt: skip
    K = built.controller(built.DESIGN)
    for _, point in box.corners()[1:]:
        loop = sensitivity_loop(
            sampled_plant(box.plant(point).plant_si(), 1.0 / built.RATE, built.DELAY), K
        )
        figures = sampled_figures(loop)
        assert figures.stable
        assert figures.sensitivity_peak <= built.S_MAX * (1.0 + 1e-4)
        assert figures.bandwidth > 75.0 * built.HZ


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
    runs = FOLDER.parent / "runs"
    problem = problem_of(load_case(runs / "rib_stage_built.toml"))
    kappa = sections_kappa(built.DESIGN, structure_of(problem))
    assert len(kappa) == len(structure_of(problem).names)
    with pytest.raises(UserError, match="name a run of this case"):
        sections_kappa(built.DESIGN, Structure())
    asked = ["--theta", "m1=60,m2=60", "--begin-at", str(built.DESIGN), "--quiet"]
    assert inner_main([str(runs / "two_mass.toml"), *asked]) == 2
    assert "--begin-at" in capsys.readouterr().err
    with pytest.raises(UserError):
        sections_kappa(tmp_path, structure_of(problem))
