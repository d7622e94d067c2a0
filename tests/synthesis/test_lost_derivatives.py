"""Designs that are certified while their derivatives are lost: passed over, never a traceback."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.commands import changed, read

from ccd_casadi.inner import main as inner
from ccd_casadi.solve import main as solve
from ccd_casadi.synthesis import derivatives as module

CASE = Path(__file__).parents[2] / "runs" / "two_mass.toml"
whole = module.figure_gradients


def lose(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """A share of all designs, chosen by their weights, without derivatives.

    Stripes in the weights, wide against rounding; the optimum is at 0.79, outside the first 0.2.
    """

    def losing(plant: Any, *more: Any) -> Any:
        gradient, fixed, *rest = whole(plant, *more)
        if (30.0 * np.log(plant.w[2]) + 17.0 * np.log(plant.w[7])) % 1.0 < share:
            gradient, fixed = np.full_like(gradient, np.nan), np.full_like(fixed, np.nan)
        return gradient, fixed, *rest

    monkeypatch.setattr(module, "figure_gradients", losing)


@pytest.mark.parametrize("formulation", ["direct", "lifted"])
def test_the_optimum_is_found_past_designs_without_derivatives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, formulation: str
) -> None:
    """By IPOPT's starts alone: without the global check over the box at the end."""
    lose(monkeypatch, 0.2)
    case = changed(tmp_path, more="\n[outer]\nbox_points = 0\n")
    words = [str(case), "--out", str(tmp_path / "run"), "--quiet", "--no-report", "--workers", "1"]
    assert solve([*words, "--formulation", formulation]) == 0
    result = read(tmp_path / "run")
    assert result["status"] == "verified"
    assert result["objective"] == pytest.approx(-438.75639, abs=5e-5)


@pytest.mark.parametrize(
    "formulation", ["direct", "lifted", pytest.param("nested", marks=pytest.mark.slow)]
)
def test_without_any_derivatives_nothing_is_claimed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    formulation: str,
) -> None:
    lose(monkeypatch, 1.0)
    words = [str(CASE), "--out", str(tmp_path), "--quiet", "--no-report", "--workers", "1"]
    assert solve([*words, "--formulation", formulation]) in (3, 4)
    assert "certified" in capsys.readouterr().err
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["status"] in ("infeasible", "not_verified")


def test_the_inner_problem_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(monkeypatch, 1.0)
    assert inner([str(CASE), "--theta", "m1=60,m2=60"]) == 3
    assert "its derivatives are lost in rounding" in capsys.readouterr().out
