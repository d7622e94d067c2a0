"""A controller of fixed structure for plants that exist: no θ, no case file, one call."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_design import synthesise
from ccd_casadi.fixed_structure.sections_design import Progress, SectionsDesign
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.synthesis.interchange import from_control, plant_from_control

SLOWEST = 10.0  # ω₀ over ω_low/S_low, the bandwidth that S of slope one needs at least


def synthesise_sections(
    plants: Any,
    structure: Structure,
    bounds: Bounds,
    *,
    sampling: Sampling | None = None,
    M_K: float | None = None,
    starts: int = 12,
    seed: int = 0,
    initial: Sequence[Array] = (),
    progress: Progress | None = None,
) -> SectionsDesign:
    """max ω_b over the parameters of a structure, with every bound on every plant of a set.

        max ω_b   s.t.  on each plant: stable, |S| <= S_max, |S(jω_low)| <= S_low,
                        |S(jω)| <= 1/√2 for ω <= ω_b, |S(jω)| <= shape (ω/ω_b)/√2,
                        |W_KS KS|, |W_T T| <= weighted_level, |GS| <= compliance_max

    Parameters
    ----------
    plants : control.StateSpace, control.TransferFunction or ScaledPlant, or a list of them
        SISO and stable, force (N) to displacement (m). Give a free mass the slow suspension that it
        has, if only of its cables.
    structure, bounds : Structure, Bounds
        Sections of K, and what holds on every plant.
    sampling : Sampling, optional
        Rate and delay, exact; left out, the loop is continuous.
    M_K : float, optional
        Scale of control systems, N/m; left out, that of `bounds.weights`, or that of
        ω₀ = 10 ω_low/S_low.
    starts, seed : int
        Of the multi-start search.
    initial, progress : sequence of array, callable
        Parameters κ of earlier designs, which start beside the others; is given a line at a time.

    Returns
    -------
    SectionsDesign
        `outcome` says how it ended; `controller` is K(s) in SI, e = r - y to force.

    Raises
    ------
    UserError
        A system is no continuous one.
    PlantError
        A system cannot be a plant.

    Examples
    --------
    >>> import control
    >>> import ccd_casadi as ccd
    >>> plant = control.tf([1.0], [2.0, 12.0, 800.0])  # 2 kg on 800 N/m
    >>> bounds = ccd.Bounds(S_max=1.8, S_low=0.1, omega_low=5.0, shape=1.1, compliance_max=1e-4)
    >>> structure = ccd.Structure(lead=1, biquads=0, roll_off=1)
    >>> light = control.tf([1.0], [1.8, 12.0, 800.0])
    >>> sampling = ccd.Sampling(rate_hz=2000.0, delay_us=250.0)
    >>> design = ccd.synthesise_sections([plant, light], structure, bounds, sampling=sampling,
    ...                                  starts=4)
    >>> design.certified, design.certificate.words
    (True, 'stable and within every bound on 2 plants')
    """
    given = [plants] if not isinstance(plants, list | tuple) else list(plants)
    scale = M_K if bounds.weights is None else bounds.weights.M_K
    if M_K is not None and bounds.weights is not None and M_K != bounds.weights.M_K:
        raise UserError(f"M_K is {M_K:g}, that of the weights {bounds.weights.M_K:g}; give one")
    scaled = []
    for system in given:
        if not isinstance(system, ScaledPlant):
            scale = _scale(system, bounds) if scale is None else scale
            system = plant_from_control(system, scale)
        scaled.append(system)
    return synthesise(
        scaled, structure, bounds, sampling=sampling, starts=starts, seed=seed, initial=initial,
        progress=progress,
    )  # fmt: skip


def _scale(system: Any, bounds: Bounds) -> float:
    """M_K (N/m) that puts ω₀ a decade above the least bandwidth that the bounds ask for."""
    space = from_control(system)
    inertial = float(np.linalg.norm(space.C @ space.A @ space.B, 2))
    omega_0 = SLOWEST * bounds.omega_low / bounds.S_low
    return omega_0**2 / inertial if inertial > 0.0 else 1.0
