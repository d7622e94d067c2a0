"""What a run says about its own surrogates, in result.json and in the report."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.formulations import fit_quantities, update_quantities
from ccd_casadi.codesign.gaussian_processes import (
    best_left_out,
    kernels_of,
    quality_dict,
    recommendation,
    surrogate_quality,
)
from ccd_casadi.codesign.retraining import stored_designs
from ccd_casadi.drawing.paint import block_html
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.reporting.landscape import table_trust, trust_figure
from ccd_casadi.sampling.inner_samples import quantity_sample
from ccd_casadi.sampling.store import SampleStore
from surrogates import GaussianProcess, design, errors, fit
from surrogates.quality import Missed

HZ = 2.0 * np.pi
BOX = {"lower": [50.0, 50.0], "upper": [70.0, 70.0]}
X = design("sobol", **BOX, n=60, seed=3)


def at(*theta: float) -> Any:
    """What the judgement asks of a design with these θ."""
    return SimpleNamespace(point=np.array(theta), problem=SimpleNamespace(figure=BANDWIDTH))


def process(jump: float) -> GaussianProcess:
    u = (X - 50.0) / 20.0
    Y = HZ * (60.0 + 4.0 * np.sin(u.sum(1)) + jump * (u @ [1.0, -0.7] > 0.2))
    return fit(X, Y, **BOX, noise=1e-4, starts=1)


def test_a_smooth_bandwidth_is_trusted_in_its_own_unit() -> None:
    (q,) = surrogate_quality([process(0.0)], at(*[60.0, 60.0]))
    assert q.followed
    assert not q.extrapolates
    assert q.true.min() > 59.0  # Hz, not rad/s
    assert q.loo.rms == pytest.approx(errors(q.true - q.predicted, q.true).rms, rel=1e-6)
    assert 0.8 <= q.coverage <= 1.0
    assert recommendation([q]) == "The surrogates follow their samples, and support the design."


def test_a_bandwidth_that_jumps_recommends_lifted() -> None:
    (q,) = surrogate_quality([process(3.0)], at(*[60.0, 60.0]))
    assert not q.followed
    assert "--formulation lifted" in recommendation([q])
    several = [q, replace(q, name="sensitivity_peak", unit="%")]
    assert "kinked where they are equal" in recommendation(several)


def test_what_predicts_left_out_samples_badly_is_called_neither_smooth_nor_supported() -> None:
    """D10: Q² of 0.84 was "smooth, supported", and one of 0.998 "kinked"."""
    (q,) = surrogate_quality([process(0.0)], at(*[60.0, 60.0]))
    for q2, said in ((0.84, "poorly followed"), (0.93, "roughly followed"), (0.998, "followed")):
        assert replace(q, loo=replace(q.loo, q2=q2)).samples_are == said
    poor = replace(q, loo=replace(q.loo, q2=0.84))
    assert not poor.followed
    assert "0.84" in poor.unsupported
    assert "support the design" not in recommendation([poor])


@pytest.mark.parametrize("q2", [0.5, 0.91, 0.98, 0.9951, 1.0 - 1e-7])
def test_the_sentence_and_the_table_say_the_same_of_the_samples(q2: float) -> None:
    (q,) = surrogate_quality([process(0.0)], at(*[60.0, 60.0]))
    found = replace(q, loo=replace(q.loo, q2=q2))
    global_check, said = table_trust([found]).rows[0][-2], recommendation([found])
    assert ("predicted roughly" in said) == (global_check == "roughly followed")
    assert ("predicted poorly" in said) == (global_check == "poorly followed")
    assert ("support the design" in said) == (global_check == "followed")


def test_a_design_beside_samples_that_are_missed_is_not_supported() -> None:
    (q,) = surrogate_quality([process(0.0)], at(*[60.0, 60.0]))
    assert table_trust([q]).rows[0][-1] == "supported"
    for error, sigmas, at_point in ((3.0, 10.0, False), (3.0, 10.0, True), (-3.0, 9.4, False)):
        far = replace(q, around=(Missed(error, sigmas, at_point), Missed(1e-9, 0.1, False)))
        cell = str(table_trust([far]).rows[0][-1])
        assert f"the others miss by 3 Hz, {sigmas:.1f} deviations" in cell
        assert ("beside" in cell) != at_point
        assert "support the design" not in recommendation([far])
    slight = replace(q, around=(Missed(1e-6, 11.0, False),))  # by nothing, but the bands are wrong
    assert "11 deviations" in str(table_trust([slight]).rows[0][-1])
    assert not slight.unsupported


def test_a_design_beyond_the_samples_is_flagged() -> None:
    near = X[(X < 58.0).all(axis=1)]
    few = fit(near, near.sum(1) ** 2, **BOX, starts=1)
    (q,) = surrogate_quality([few], at(*[69.0, 69.0]))
    assert q.extrapolates
    assert "extrapolates" in recommendation([q])
    table = table_trust([q])
    assert "box widths" in str(table.rows[0][-1])


def test_nothing_is_said_of_no_surrogate() -> None:
    assert quality_dict(surrogate_quality([], at(0.0, 0.0))) == {}
    assert recommendation([]) == ""


def test_the_figure_shows_every_sample_and_the_bands() -> None:
    qualities = surrogate_quality([process(5.0)], at(*[60.0, 60.0]))
    svg = block_html(trust_figure(qualities), "trust").replace("\u00a0", " ")
    assert "predicted (Hz)" in svg
    assert svg.count(">95 % band<") == svg.count("<svg")  # of two panels, drawn for two widths
    assert f"{100 * qualities[0].coverage:.0f} %" in table_trust(qualities).rows[0]


def test_a_run_holds_its_quality(two_mass_run: Path) -> None:
    result = json.loads((two_mass_run / "result.json").read_text())
    quality = result["surrogate_quality"]
    bandwidth = quality["outputs"]["bandwidth"]
    saved = json.loads((two_mass_run / "surrogate.json").read_text())["extra"]["loo"][0]
    assert bandwidth["leave_one_out"]["rms"] == pytest.approx(saved["rms"] / HZ)
    assert bandwidth["leave_one_out"]["q2"] == pytest.approx(saved["q2"])
    assert 0.0 <= bandwidth["coverage_95"] <= 1.0
    assert quality["recommendation"]
    text = (two_mass_run / "report.html").read_text()
    assert re.search(r"<h2>Can the surrogate be trusted\?</h2>", text)
    assert quality["recommendation"].replace("'", "&#39;") in text


def test_auto_takes_the_kernel_that_predicts_left_out_samples_best() -> None:
    u = (X - 50.0) / 20.0
    kinds = {}
    for name, Y in (("analytic", np.exp(-u.sum(1))), ("rough", np.abs(u @ [1.0, -0.7] - 0.2))):
        found = [fit(X, Y, **BOX, noise=1e-7, starts=1, kernel=k) for k in kernels_of("auto")]
        best = best_left_out(found)
        assert best.loo.rms == min(p.loo.rms for p in found)
        kinds[name] = best.kernel.value
    assert kinds == {"analytic": "rbf", "rough": "matern52"}
    assert [k.value for k in kernels_of("rbf")] == ["rbf"]


def test_lifted_fits_the_kernel_that_the_case_names(two_mass_run: Path) -> None:
    problem = problem_of(load_case(two_mass_run / "case.toml"))
    with SampleStore(two_mass_run / "samples.sqlite") as store:
        rows = stored_designs(store, problem)[:20]
    samples = [quantity_sample(tuple(x), row, problem.inner) for x, row in rows]
    named = fit_quantities(problem, samples, 0, kind="rbf")
    assert {p.kernel.value for p in named} == {"rbf"}
    plain = fit_quantities(problem, samples, 0)
    assert {p.kernel.value for p in plain} == {"matern52"}
    auto = fit_quantities(problem, samples, 0, kind="auto")
    for one, two, best in zip(named, plain, auto, strict=True):
        assert best.loo.rms == min(one.loo.rms, two.loo.rms)


def test_rounds_interpolate_where_a_fit_saw_noise(two_mass_run: Path) -> None:
    """The truth is exact: a sample added to the surrogates is what they then predict there."""
    problem = problem_of(load_case(two_mass_run / "case.toml"))
    with SampleStore(two_mass_run / "samples.sqlite") as store:
        rows = stored_designs(store, problem)[:20]
    samples = [quantity_sample(tuple(x), row, problem.inner) for x, row in rows]
    fitted = [
        replace(p, hyperparameters=replace(p.hyperparameters, noise_variance=1e-2))
        for p in fit_quantities(problem, samples[:-1], 0)
    ]
    for k, process in enumerate(update_quantities(samples, tuple(fitted))):
        value, span = samples[-1].values[k], float(np.ptp([s.values[k] for s in samples]))
        assert process.predict([samples[-1].x])[0] == pytest.approx(value, abs=1e-6 * span)
