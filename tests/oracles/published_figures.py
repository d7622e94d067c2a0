"""Case study 1's eight published figures, and what a setting of the unpublished options gives."""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.analysis.loop_view import peaks_of
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.inner_problem.search import search_inner
from ccd_casadi.lti.loop import Loop
from ccd_casadi.synthesis.synthesis import synthesise

HZ, W1, W2 = 2.0 * np.pi, 0.0995, -0.9950
A_B = (60.0, 60.0)
PLANTS = {  # theta, M_K
    "A": (A_B, 2e7),
    "B": (A_B, 0.5e7),
    "baseline": ((67.56, 67.56), 2e7),
    "co-design": ((58.33, 55.0), 2e7),
}
BANDWIDTH = {"A": 57.0, "B": 32.0, "baseline": 54.1, "co-design": 71.8}  # Hz
PEAK = {"A": 120.0, "B": 84.0}  # Hz, the first local peak of S, below the plant's zero
OBJECTIVE = {"baseline": -325.1, "co-design": -437.6}


@dataclass(frozen=True)
class Setting:
    """A candidate; frequencies in Hz. `S_hi_co` is ω_S's upper end for the co-design alone."""

    S_max: float
    T_lo: float
    T_hi: float
    S_hi: float
    backoff: float = 1.02
    S_hi_co: float = 0.0


def plant_at(name, case):
    """Scaled plant and weights of one of PLANTS."""
    theta, M_K = PLANTS[name]
    case = replace(case, weights=replace(case.weights, M_K=M_K))
    return scaled_plant(case, theta), case.weights


def figures(case, setting, solve=search_inner):
    """The eight figures of a setting, each with the published one: name -> (ours, published)."""
    out = {}
    for name in PLANTS:
        plant, weights = plant_at(name, case)
        top = setting.S_hi_co if name == "co-design" and setting.S_hi_co else setting.S_hi
        ends = {"omega_S": (10.0 * HZ, top * HZ), "omega_T": (setting.T_lo * HZ, setting.T_hi * HZ)}
        inner = replace(case.inner, S_max=setting.S_max, gamma_backoff=setting.backoff, **ends)
        optimum = solve(plant, weights, inner).optimum
        f = optimum.figures.bandwidth / HZ if optimum else np.nan
        out[f"{name} bandwidth"] = f, BANDWIDTH[name]
        if name in OBJECTIVE:
            out[f"{name} J"] = W1 * sum(PLANTS[name][0]) + W2 * HZ * f, OBJECTIVE[name]
        elif optimum:
            at = weights.at(optimum.figures.omega_S, optimum.figures.omega_T)
            args = {"omega_low": inner.omega_low, "gamma_backoff": setting.backoff}
            K = synthesise(plant, at, **args).controller
            peaks = peaks_of(Loop(plant.plant_si(), K))
            out[f"{name} peak"] = peaks[0][0], PEAK[name]
    return out
