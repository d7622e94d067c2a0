"""The design of benchmarks/rib_stage_design: within its bounds as it runs, and no trick in it."""

import json
from pathlib import Path

import numpy as np
import pytest
from benchmark_scripts import FOLDER, benchmark

from ccd_casadi.case_studies.rib_stage import NAMES
from ccd_casadi.case_studies.rib_stage.plant import rib_stage
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import sections_kappa
from ccd_casadi.fixed_structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner import main as inner_main
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.hold import sampled
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.robust.sampled import sampled_figures
from ccd_casadi.support.errors import UserError

built = benchmark("rib_stage_built")
conclusions = benchmark("rib_stage_conclusions")
on_the_set = benchmark("rib_stage_on_the_set")


def test_the_shipped_design_holds_on_the_ends_of_its_models_box() -> None:
    """Sampled with hold and delay by code that the synthesis does not use; no payload here."""
    theta = built.theta_of(built.DESIGN)
    stage, kept = rib_stage(NAMES), json.loads((built.DESIGN / "inner.json").read_text())
    assert hardware_cost(stage, theta) == pytest.approx(kept["hardware_cost"], rel=1e-9)
    box = UncertainPlant((mechanics(stage, theta, derivatives=False),), built.M_K,
                         mode_shift=0.02, damping=(0.5, 2.0))  # fmt: skip
    K = built.controller(built.DESIGN)
    for _, point in box.corners()[1:]:
        loop = closed_loop(sampled(box.plant(point).plant_si(), 1.0 / built.RATE, built.DELAY), K).S
        figures = sampled_figures(loop)
        assert figures.stable
        # It was designed on a suspension: on the free stage its peak is 9e-4 above S_max.
        assert figures.sensitivity_peak <= built.S_MAX * (1.0 + 1e-3)
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


def test_the_conclusions_of_the_page_are_those_of_the_stored_figures() -> None:
    rows = on_the_set.stored_rows()
    kept = (
        conclusions.PAGE.read_text(encoding="utf-8")
        .split(conclusions.BEGIN)[1]
        .split(conclusions.END)[0]
        .strip()
    )
    assert kept == conclusions.markdown(rows)
    problem = problem_of(load_case(conclusions.CASE))
    for words in on_the_set.sentences(on_the_set.stages_of(rows, problem.w1, problem.w2)):
        assert words in kept


def test_another_figure_is_another_conclusion() -> None:
    """The same stages on a set that the sequential one suffers from, and on one that all do."""
    problem = problem_of(load_case(conclusions.CASE))

    def said(hz: dict[str, float]) -> list[str]:
        rows = {name: {"theta": [1e-3], "mass": mass, "apart_hz": {"z": 1.0},
                       "nominal": {"bandwidth_hz": alone},
                       "whole": {"certified": True, "bandwidth_hz": hz[name]}}
                for name, mass, alone in (("sequential", 1.0, 50.0), ("lifted", 0.4, 80.0),
                                          ("co-designed", 0.6, 70.0))}  # fmt: skip
        return on_the_set.sentences(on_the_set.stages_of(rows, problem.w1, problem.w2))

    first = said({"sequential": 75.0, "lifted": 45.0, "co-designed": 76.0})
    assert first[1].endswith("the nominal optimum is 60 % lighter and 60 % faster.")
    assert "keeps 45.0 of its 80.0 Hz: 60 % lighter and 40 % slower" in first[3]
    assert "The nominal optimum has the best J nominally and the worst on the set." in first
    assert first[-1].endswith("on the set: the mass, not the bandwidth.")
    other = said({"sequential": 50.0, "lifted": 45.0, "co-designed": 70.0})
    assert "40 % lighter and 40 % faster" in other[-1]
    assert other[-1].endswith("on the set: all of it.")
    part = said({"sequential": 50.0, "lifted": 45.0, "co-designed": 55.0})
    assert part[-1].endswith("on the set: the mass and 36 % of the gain in bandwidth.")
    nothing = said({"sequential": 75.0, "lifted": 45.0, "co-designed": 60.0})
    assert "No stage here has a better J on the set than the sequential one." in nothing
    assert nothing[-1].endswith("nothing is left.")
