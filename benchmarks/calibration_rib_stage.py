"""Calibrate what case study 2 leaves unpublished: S_max and the upper end of ω_S.

Two published bandwidths, on the two stages that have the published masses and first resonances
(ours, fitted): 55.7 Hz at 1.02 kg and 250.0 Hz, 71.6 Hz at 0.59 kg and 110.5 Hz.

    ω_b*(a; S_max, ω_S upper) = 55.7 Hz,    ω_b*(b; S_max, ω_S upper) = 71.6 Hz

The lower end of ω_T, S_low and ω_low stay those of case study 1, 25 Hz, 0.03 and 1 Hz.
Run: python benchmarks/calibration_rib_stage.py [--mesh coarse] [--out FILE];
docs/development/calibration.md.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.search import search_inner
from ccd_casadi.plants.scaling import ScaledPlant

HZ = 2.0 * np.pi
CASE = Path(__file__).parent.parent / "runs" / "rib_stage.toml"
# h, t_o, t_i, t_c, H, x_i in m
STAGES = {
    "a, 1.02 kg, 250.0 Hz": (1e-3, 3e-3, 8e-3, 8e-3, 16.806e-3, 67.5e-3),
    "b, 0.59 kg, 110.5 Hz": (1e-3, 3e-3, 4.2446e-3, 4.0588e-3, 11.917e-3, 74.974e-3),
}
PUBLISHED = {"a, 1.02 kg, 250.0 Hz": 55.7, "b, 0.59 kg, 110.5 Hz": 71.6}  # Hz
A, B = STAGES


def bandwidth(
    problem: CoDesignProblem, plant: ScaledPlant, S_max: float, omega_S_hz: float, omega_T_hz: float
) -> tuple[float, tuple[str, ...]]:
    """ω_b* in Hz and what binds."""
    inner = replace(
        problem.inner,
        S_max=S_max,
        omega_S=(problem.inner.omega_S[0], HZ * omega_S_hz),
        omega_T=(HZ * omega_T_hz, problem.inner.omega_T[1]),
    )
    found = search_inner(plant, problem.weights, inner)
    return found.bandwidth / HZ, found.active


def calibrate(problem: CoDesignProblem, omega_T_hz: float) -> dict[str, object]:
    """S_max and ω_S upper that meet both bandwidths, by turns; and what is left."""
    plants = {name: scaled_plant(problem, theta) for name, theta in STAGES.items()}

    def miss(name: str, S_max: float, omega_S: float) -> float:
        value = bandwidth(problem, plants[name], S_max, omega_S, omega_T_hz)[0]
        return (0.0 if np.isnan(value) else value) / PUBLISHED[name] - 1.0

    S_max, omega_S = 1.6, 1800.0
    for _ in range(6):
        before = S_max, omega_S
        S_max = brentq(lambda s, w=omega_S: miss(A, s, w), 1.3, 2.4, xtol=1e-4)
        omega_S = brentq(lambda w, s=S_max: miss(B, s, w), 200.0, 5000.0, xtol=0.5)
        if abs(S_max - before[0]) < 1e-3 and abs(omega_S - before[1]) < 2.0:
            break
    told = {name: bandwidth(problem, plants[name], S_max, omega_S, omega_T_hz) for name in STAGES}
    return {
        "omega_T_lower_hz": omega_T_hz,
        "S_max": S_max,
        "omega_S_upper_hz": omega_S,
        "bandwidth_hz": {name: value for name, (value, _) in told.items()},
        "active": {name: list(active) for name, (_, active) in told.items()},
    }


def main() -> None:
    """Print the settings as a table and write them."""
    words = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    words.add_argument("--mesh", default="shipped", choices=("coarse", "shipped"))
    words.add_argument("--out", type=Path)
    options = words.parse_args()
    case = load_case(CASE)
    source = {**case.plant.options, "mesh": options.mesh}
    problem = problem_of(replace(case, plant=replace(case.plant, options=source)))
    found = []
    for omega_T in (20.0, 25.0, 30.0, 40.0):
        try:
            item = calibrate(problem, omega_T)
        except ValueError:
            print(f"omega_T >= {omega_T:g} Hz: no S_max in 1.3 to 2.4 meets both")
            continue
        found.append(item)
        told = item["bandwidth_hz"]
        assert isinstance(told, dict)
        print(
            f"omega_T >= {omega_T:g} Hz: S_max {item['S_max']:.4f}, omega_S <= "
            f"{item['omega_S_upper_hz']:.0f} Hz gives "
            + ", ".join(f"{v:.2f} Hz (published {PUBLISHED[k]})" for k, v in told.items())
            + f"; binding {item['active']}",
            flush=True,
        )
    if options.out:
        options.out.write_text(json.dumps({"mesh": options.mesh, "settings": found}, indent=2))


if __name__ == "__main__":
    main()
