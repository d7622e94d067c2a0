"""A loop that is stable as it is sampled, and not without: two masses without any damping."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from ccd_casadi.deploy import main

PLANT = """
import numpy as np

def masses(theta):
    K = np.array([[1.0, -1.0], [-1.0, 1.0]])
    return {"mass": np.diag([float(theta["m1"]), 1.0]), "stiffness": K, "damping": 0.0 * K,
            "input": np.array([[1.0], [0.0]]), "output": np.array([[0.0, 1.0]]),
            "hardware_cost": 1.0}
"""
CASE = """
[plant]
function = "plant.py:masses"
[theta.m1]
lower = 0.9
upper = 1.1
[objective]
w1 = 0.0
w2 = -1.0
[inner]
S_max = 3.0
S_low = 0.5
omega_low_hz = 0.005
[controller]
structure = "sections"
[loop]
rate_hz = 10
delay_us = 50000
"""
KAPPA = [-5.416, -7.372555, -7.372555, 2.9957323, 0.374895, -6.907755, 2.9957323, -6.907755,
         1.186539, -0.035755, 2.9957323, 1.098612, 2.9957323, 1.098612]  # fmt: skip


def test_a_sampled_loop_is_deployed_whatever_the_continuous_one_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plant.py").write_text(PLANT)
    (tmp_path / "case.toml").write_text(CASE)
    run = {"status": "verified", "theta": {"m1": 0.9}}
    (tmp_path / "result.json").write_text(json.dumps(run))
    (tmp_path / "controller.json").write_text(json.dumps({"sections": {"kappa": KAPPA}}))
    assert main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "unknown, unstable without its sampling" in said
    found = json.loads((tmp_path / "deploy" / "deploy.json").read_text())
    assert found["full"]["stable"] is False
    assert found["full"]["bandwidth_hz"] is None

    code = json.loads((tmp_path / "deploy" / "controller.json").read_text())
    a, b, c, d = (np.array(code[key]) for key in "ABCD")
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1 / 0.9, 1 / 0.9, 0, 0], [1, -1, 0, 0]])
    joint = np.zeros((5, 5))
    joint[:4] = np.column_stack([A, [0, 0, 1 / 0.9, 0]])
    half = expm(0.05 * joint)  # the old force, then the new one
    F, old, new = half[:4, :4] @ half[:4, :4], half[:4, :4] @ half[:4, 4:], half[:4, 4:]
    F, G, C = np.block([[F, old], [np.zeros((1, 5))]]), np.vstack([new, [[1]]]), np.eye(1, 5, 1)
    loop = np.block([[F - G @ d @ C, G @ c], [-b @ C, a]])
    assert np.abs(np.linalg.eigvals(loop)).max() < 1.0
    z = np.exp(1j * 2.0 * np.pi * np.geomspace(1e-3, 5.0, 2000) / 10.0)[:, None, None]
    L = (C @ np.linalg.solve(z * np.eye(5) - F, G)) * (
        c @ np.linalg.solve(z * np.eye(len(a)) - a, b) + d
    )
    peak = np.abs(1.0 / (1.0 + L)).max()
    assert peak == pytest.approx(found["sampled"]["sensitivity_peak"], rel=1e-2)
