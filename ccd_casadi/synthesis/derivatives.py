"""Total derivatives of a certified design's figures, and of every local peak of S."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ccd_casadi.kernels.certified_design import design, failed_row
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gradients import LoopAt, MadeFor, figure_gradients, peak_gradients
from ccd_casadi.kernels.sensitivity import Code, Column, sensitivity_gain, sensitivity_gains
from ccd_casadi.lti.frequency_grid import frequency_grid, local_maxima, refine_peak, root_flanks
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import NotebookHtml
from ccd_casadi.synthesis.statics import compliance_over_family
from ccd_casadi.synthesis.synthesis import (
    DesignFigures,
    Outcome,
    figures_from_row,
    judged_on,
    over_family,
)
from ccd_casadi.synthesis.weights import Weights

_WEIGHTS = ("M_S", "A_S", "omega_S", "c_K", "omega_K", "A_l", "A_u", "omega_T")


@dataclass(frozen=True)
class DesignDerivatives:
    """The design in scaled units, from which further derivatives are read.

    `row` of its figures, (A_K, B_K, C_K), dγ_opt to θ and weights; `worst` is the place in its
    family of the plant that has ‖S‖∞, 0 the plant itself.
    """

    row: Array
    controller: tuple[Array, Array, Array]
    to_gamma: Array
    worst: int = 0


@dataclass(frozen=True)
class Sensitivities(NotebookHtml):
    """Figures of one design with their gradients.

    Attributes
    ----------
    figures : DesignFigures
        SI.
    values : (4,) or (5,) array
        ω_b (rad/s), ln‖S‖∞, ln σ_max(S(jω_low)), where it is required ln‖GS‖∞ (m/N), γ_opt.
    to_theta : (4, n_θ) or (5, n_θ) array
        Their derivatives per unit of θ.
    to_weights : dict of (4,) or (5,) array
        Derivatives to the logarithm of each weight, W_d as `disturbance` where it is given.
    fixed_controller : (n_θ,) array
        dω_b/dθ with K held fixed, rad/s.
    simple : tuple of bool
        Whether σ_max is a simple singular value at the frequencies of the three gains; where it is
        not, the gradient is one of several one-sided ones.
    made : DesignDerivatives or None
        For more figures of the same design.
    """

    figures: DesignFigures
    values: Array
    to_theta: Array
    to_weights: dict[str, Array]
    fixed_controller: Array
    simple: tuple[bool, ...]
    made: DesignDerivatives | None = field(default=None, repr=False, compare=False)

    @property
    def to_break_frequencies(self) -> Array:
        """Derivatives (4 or 5, 2) to (ln ω_S, ln ω_T)."""
        return np.column_stack([self.to_weights["omega_S"], self.to_weights["omega_T"]])


def sensitivities(
    plant: ScaledPlant,
    weights: Weights,
    *,
    omega_low: float,
    gamma_backoff: float = 1.02,
    compliance: bool = False,
    multiple_gap: float = 1e-6,
) -> Sensitivities:
    """Synthesise, certify and differentiate at one point.

    With a family the peak is the largest on any of it, its gradient that of the plant that has it;
    so is ‖GS‖∞.

    Parameters
    ----------
    plant : ScaledPlant
        With derivatives to θ.
    weights : Weights
        W1, W2, W3.
    omega_low : float
        Where |S| is reported, rad/s.
    gamma_backoff : float
        The controller is made at this multiple of γ_opt.
    compliance : bool
        Whether ‖GS‖∞ is among the values.
    multiple_gap : float
        Below this (σ1 - σ2)/σ1 the largest singular value counts as multiple.

    Returns
    -------
    Sensitivities
        Gradients are NaN if not certified; where they are not finite the outcome is NO_DERIVATIVES.
    """
    w0, count = plant.omega_0, plant.dA.shape[0]
    made_on = plant.design_plant
    names = _WEIGHTS + (("disturbance",) if weights.delta else ())
    scaled = np.append(weights.scale(w0), weights.delta)
    made_for = MadeFor(made_on, weights.scale(w0), gamma_backoff, weights.delta)
    made = None
    try:
        # Rounding may put the blocks' γ_opt below the whole plant's: it is then made from that.
        for channels in (made_on.channels, ()) if made_on.channels else ((),):
            row, Ak, Bk, Ck = design(
                made_on.A, made_on.B, made_on.C, made_for.w, made_on.grid, made_on.gain,
                gamma_backoff, omega_low / w0, 0.0, channels, weights.delta, judged_on(plant),
            )  # fmt: skip
            K = Ak, Bk, Ck
            figures, worst = over_family(plant, weights, row, K, omega_low)
            places = [
                (plant, figures.bandwidth, False),
                (worst, figures.sensitivity_peak_frequency, False),
                (plant, omega_low, False),
            ]
            if compliance and figures.certified:
                most = compliance_over_family(plant, plant.controller_si(*K))
                figures = replace(figures, compliance=most.gain)
                places.append((most.plant, most.omega, True))
            loops = [LoopAt(at, omega / w0, of_force) for at, omega, of_force in places]
            gradient, fixed, gaps, to_gamma, whole = figure_gradients(
                made_for, row, made_on.grid, made_on.gain, loops if figures.certified else []
            )
            if whole:
                break
        made = DesignDerivatives(
            row, K, to_gamma, [at is worst for at in plant.members].index(True)
        )
    except np.linalg.LinAlgError:
        figures = figures_from_row(failed_row(), weights, w0)
        gradient, fixed = np.empty((0, count + len(names))), np.full(count, np.nan)
    if len(gradient) != 4 + compliance:
        gradient, gaps = np.full((4 + compliance, gradient.shape[1]), np.nan), np.full(3, np.nan)
    if figures.certified and not np.isfinite(gradient).all():
        figures = replace(figures, outcome=Outcome.NO_DERIVATIVES)
    gradient[0] *= w0
    with np.errstate(invalid="ignore", divide="ignore"):
        bounded = [figures.sensitivity_peak, figures.sensitivity_low]
        bounded += [figures.compliance] if compliance else []
        values = np.array([figures.bandwidth, *np.log(bounded), figures.gamma_opt])
    return Sensitivities(
        figures=figures,
        values=values,
        to_theta=gradient[:, :count],
        to_weights={name: gradient[:, count + i] * scaled[i] for i, name in enumerate(names)},
        fixed_controller=fixed * w0,
        simple=tuple(bool(gap > multiple_gap) for gap in gaps),
        made=made,
    )


@dataclass(frozen=True)
class PeakGridOptions:
    """Numbers of the grid on which local peaks are found.

    It is around each closed-loop pole, and over the decades about ω₀: what no pole of plant or loop
    points at is as broad as the distance between two of its points.
    """

    half_widths: tuple[float, ...] = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0)  # of a pole, either way
    decades: float = 2.0  # about ω₀, either way
    points: int = 1201
    apart: float = 1e-7  # relative: closer points differ in gain by rounding alone

    @cached_property
    def flanks(self) -> Array:
        """Around a pole, in its widths."""
        half = np.array(self.half_widths)
        return np.concatenate([-half[::-1], [0.0], half])

    @cached_property
    def broad(self) -> Array:
        """The broad grid of ω over ω₀."""
        return np.geomspace(10.0**-self.decades, 10.0**self.decades, self.points)


@dataclass(frozen=True)
class LocalPeak:
    """One local maximum of σ_max(S).

    Attributes
    ----------
    omega : float
        rad/s.
    member : int
        0: on the plant itself, i: on the i-th of its family.
    ln_gain : float
        ln σ_max(S(jω)).
    gradient : (n_θ + 2,) array
        Of that, to θ and (ln ω_S, ln ω_T).
    """

    omega: float
    member: int
    ln_gain: float
    gradient: Array


def local_peaks_with_gradients(
    plant: ScaledPlant,
    weights: Weights,
    design: Sensitivities,
    *,
    gamma_backoff: float,
    least: float,
) -> tuple[LocalPeak, ...]:
    """All local peaks of σ_max(S), of the plant and its family, with their gradients.

    Parameters
    ----------
    plant, weights : ScaledPlant, Weights
        As for `sensitivities`.
    design : Sensitivities
        Of the same plant and weights; nothing is synthesised anew.
    gamma_backoff : float
        That of the design.
    least : float
        Gain from which a peak counts.

    Returns
    -------
    tuple of LocalPeak
        The largest first; empty where the design has no derivatives.
    """
    made = design.made
    if made is None or made.row[Column.CODE] != Code.CERTIFIED or made.row[Column.BALANCED]:
        return ()
    w0, w = plant.omega_0, weights.scale(plant.omega_0)
    found = [
        (omega, i, gain)
        for i, member in enumerate(plant.members)
        for omega, gain in _peaks(member, made.controller, least)
    ]
    if not found:
        return ()
    loops = [LoopAt(plant.members[i], omega) for omega, i, _ in found]
    count = plant.dA.shape[0]
    made_for = MadeFor(plant.design_plant, w, gamma_backoff, weights.delta)
    try:
        rows = peak_gradients(made_for, made.row, made.to_gamma, loops)
    except np.linalg.LinAlgError:
        return ()
    out = []
    for (omega, i, gain), raw in zip(found, rows, strict=True):
        to_weights = raw[count : count + w.size] * w
        whole = np.array([*raw[:count], to_weights[2], to_weights[7]])
        if np.isfinite(whole).all():
            out.append(LocalPeak(omega * w0, i, float(np.log(gain)), whole))
    return tuple(sorted(out, key=lambda peak: -peak.ln_gain))


def _peaks(
    plant: ScaledPlant,
    controller: tuple[Array, Array, Array],
    least: float,
    options: PeakGridOptions = PeakGridOptions(),
) -> list[tuple[float, float]]:
    """Local maxima of σ_max(S) of at least `least`, (ω over ω₀, gain)."""
    Ak, Bk, Ck = (np.ascontiguousarray(part) for part in controller)
    Dk = np.zeros((Ck.shape[0], Bk.shape[1]))
    poles = closed_loop(plant.system, StateSpace(Ak, Bk, Ck, Dk)).S.poles
    near = root_flanks(poles[poles.imag > 0.0], options.flanks)
    low, high = float(plant.grid[0]), float(plant.grid[-1])
    grid = frequency_grid(low, high, 2, plant.grid, options.broad, near, apart=options.apart)
    grid = np.ascontiguousarray(grid)
    G, K = prepare(plant.A, plant.B, plant.C), prepare(Ak, Bk, Ck)
    gain = sensitivity_gains(G, K, Dk, grid)
    found = []
    for i in local_maxima(gain):
        if gain[i] >= 0.98 * least:
            omega, top = refine_peak(
                lambda w: sensitivity_gain(G, K, Dk, w), grid[i - 1], grid[i + 1]
            )
            if top >= least:
                found.append((omega, top))
    return found
