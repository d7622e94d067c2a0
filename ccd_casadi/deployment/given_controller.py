"""A controller from a file, to be judged on a run's plant: ours, a .mat, or a table of filters.

A table (TOML, or JSON of the same form) is what one enters in a drive:

    K(s) = gain Π sections,  every section with the gain 1 at s = 0 (an integrator aside)

    gain = 1.5e6                                                   # N/m
    integrator_hz = 5.0                                            # (s + ω)/s
    lead = [{ zero_hz = 30.0, pole_hz = 300.0 }]                   # (1 + s/ω_z)/(1 + s/ω_p)
    notch = [{ zero_hz = 480.0, zero_damping = 0.02, pole_hz = 480.0, pole_damping = 0.3 }]
    low_pass = [{ pole_hz = 900.0, pole_damping = 0.7 }]           # second order; first without
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_channels import loop_figures
from ccd_casadi.budget.sources import polynomial
from ccd_casadi.cases.case import read_toml
from ccd_casadi.cases.checks import POSITIVE, Fail, require_good, tables
from ccd_casadi.cases.run_folder import FinishedRun, read_json
from ccd_casadi.lti.loop import Sampling, tustin
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.interchange import read_mat

UNSEEN = StateSpace(-np.eye(1), np.zeros((1, 1)), np.zeros((1, 1)), np.eye(1))
SECTIONS = {
    "lead": (("zero_hz", "pole_hz"), ()),
    "notch": (("zero_hz", "zero_damping", "pole_hz", "pole_damping"), ()),
    "low_pass": (("pole_hz",), ("pole_damping",)),
}


def as_it_runs(run: FinishedRun) -> FinishedRun:
    """A run whose case has a sampled loop with its controller as it runs there, by Tustin's rule.

    Parameters
    ----------
    run : FinishedRun
        With K(s).

    Returns
    -------
    FinishedRun
        With K(z), and ω_b and ‖S‖∞ of the sampled loop; other runs as they are.
    """
    if run.problem.sampling is None:
        return run
    at = run.problem.sampling
    return _measure(replace(run, controller=tustin(run.controller, at.period), sampling=at))


def with_controller(run: FinishedRun, path: Path) -> FinishedRun:
    """The run with the controller of a file in place of its own, measured on its plant.

    Parameters
    ----------
    run : FinishedRun
        With the plant.
    path : Path
        See the module.

    Returns
    -------
    FinishedRun
        With the figures of that controller.

    Raises
    ------
    UserError
        The file holds no controller that fits, or the loop is not stable with it.
    """
    K, delay = read_controller(path)
    p, m = len(run.plant.C), run.plant.B.shape[1]
    if (K.C.shape[0], K.B.shape[1]) != (m, p):
        sizes = f"{K.B.shape[1]} inputs and {K.C.shape[0]} outputs"
        raise UserError(f"{path}: has {sizes}; this plant needs {p} and {m}")
    if not K.period:
        figures = run.measure(run.plant, K)
        if not figures.certificate.stable:
            pole = figures.certificate.max_real_pole
            raise UserError(f"{path}: the loop is not stable with it (a pole at {pole:.4g} 1/s)")
        return replace(run, controller=K, figures=figures)
    sampling = Sampling(1.0 / K.period, 1e6 * delay)
    found = _measure(replace(run, controller=K, sampling=sampling))
    if not np.isfinite(found.figures.sensitivity_peak):
        growth = found.loop_on(run.plant.plant_si()).poles.real.max()
        words = f"the sampled loop is not stable with it (it grows by {growth:.4g} 1/s)"
        raise UserError(f"{path}: {words}")
    return found


def _measure(run: FinishedRun) -> FinishedRun:
    """The run with ω_b and ‖S‖∞ of its sampled loop; NaN where that is unstable."""
    loop = run.loop_on(run.plant.plant_si())
    f = loop_figures(closed_loop(*loop.as_run), loop.at)
    figures = replace(run.figures, bandwidth=f.bandwidth, sensitivity_peak=f.sensitivity_peak)
    return replace(run, figures=figures)


def read_controller(path: Path) -> tuple[StateSpace, float]:
    """Read a controller from a file.

    Parameters
    ----------
    path : Path
        A .json, .toml or .mat file: matrices, sections, or a system.

    Returns
    -------
    StateSpace
        From e = r - y in m to u in N.
    float
        The delay in s from reading y to the new u; 0 of a continuous controller.

    Raises
    ------
    UserError
        The file has no controller, or one with a delay in it.
    """
    if path.suffix not in (".json", ".toml", ".mat"):
        raise UserError(f"{path}: name a controller as .json, .toml or .mat")
    if not path.exists():
        raise UserError(f"{path}: there is no such file; name a controller")
    if path.suffix == ".mat":
        return _from_mat(path)
    table = read_json(path) if path.suffix == ".json" else read_toml(path)
    if "A" in table:
        return _from_matrices(path, table)
    return _from_sections(path, table), 0.0


def _from_mat(path: Path) -> tuple[StateSpace, float]:
    systems = read_mat(path).systems
    for name in ("controller_discrete", "controller", ""):
        if name in systems:
            found = systems[name].system
            if systems[name].delay:
                raise UserError(f"{path}: {name}: has a delay in it; give the controller without")
            delay, beside = found.period, path.with_name("deploy.json")
            if found.period and beside.exists():
                reported = read_json(beside).get("delay")
                delay = float(reported) if isinstance(reported, int | float) else delay
            return found, delay
    raise UserError(f"{path}: holds no struct controller_discrete or controller")


def _from_matrices(path: Path, table: Mapping[str, Any]) -> tuple[StateSpace, float]:
    try:
        parts = [np.array(table[name], dtype=float) for name in "ABCD"]
        period, delay = float(table.get("period", 0.0)), float(table.get("delay", 0.0))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: A, B, C, D are not matrices: {error}") from None
    A, B, C, D = parts
    fits = all(part.ndim == 2 and np.isfinite(part).all() for part in parts) and (
        A.shape == (len(A), len(A))
        and B.shape == (len(A), D.shape[1])
        and C.shape == (len(D), len(A))
    )
    if not fits or not (0.0 <= period < np.inf and 0.0 <= delay < np.inf):
        raise UserError(f"{path}: A, B, C, D (and period, delay) are of no state space")
    return StateSpace(A, B, C, D, period=period), delay


def _from_sections(path: Path, table: Mapping[str, Any]) -> StateSpace:
    fail = Fail(path)
    kinds = dict.fromkeys(SECTIONS, tables)
    require_good("", table, {"gain": POSITIVE, "integrator_hz": POSITIVE, **kinds}, fail)
    if "gain" not in table:
        raise fail("gain", "is missing; give K at s = 0 in N/m (without integrator)")
    gain = np.array([[float(table["gain"])]])
    found = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), gain)
    if "integrator_hz" in table:
        w = np.array([[HZ * table["integrator_hz"]]])
        found = found.series(StateSpace(np.zeros((1, 1)), np.eye(1), w, np.eye(1)))
    for kind, (needed, optional) in SECTIONS.items():
        rows, keys = table.get(kind, []), (*needed, *optional)
        for i, row in enumerate(rows if isinstance(rows, list) else [rows], 1):
            if not set(needed) <= set(row) <= set(keys):
                raise fail(f"{kind} {i}", f"give {', '.join(keys)}")
            require_good(f"{kind} {i}", row, dict.fromkeys(keys, POSITIVE), fail)
            found = found.series(_section({key: float(value) for key, value in row.items()}))
    # a gain alone gets a state that nothing sees: what certifies a loop expects one
    return found if len(found.A) else found.series(UNSEEN)


def _section(v: Mapping[str, float]) -> StateSpace:
    """(b₂s² + b₁s + 1)/(a₂s² + a₁s + 1) of a row."""
    from scipy.signal import tf2ss  # slow to import

    zeros, poles = (
        [tuple(v[key] for key in (f"{root}_hz", f"{root}_damping") if key in v)]
        for root in ("zero", "pole")
    )
    return StateSpace(*tf2ss(*(polynomial(filter(None, roots), 1.0) for roots in (zeros, poles))))
