"""Certified mixed-sensitivity H∞ synthesis at one θ and (ω_S, ω_T)."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from ccd_casadi.kernels.certified_design import design, judge
from ccd_casadi.kernels.certified_design import sweep as _sweep
from ccd_casadi.kernels.generalized_plant import unstable_part
from ccd_casadi.kernels.sensitivity import Code, Column
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import NotebookHtml
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis.statics import compliance_over_family
from ccd_casadi.synthesis.weights import Weights


@dataclass(frozen=True)
class CertificateOptions:
    """Numbers of the certificate of a closed loop."""

    unbounded: float = 1e9  # a level of γ that no weighted loop reaches: its norm is not judged
    known: float = 0.01  # relative error of γ_opt up to which it counts as found


@dataclass(frozen=True)
class PoleOptions:
    """Numbers that decide which poles no mixed sensitivity serves."""

    on_axis: float = 1e-9  # Re p/|p| up to which an unstable pole is on the imaginary axis
    hidden: float = 1e-13  # share of inputs or outputs up to which an unstable mode is not seen


class Outcome(StrEnum):
    """The outcome of a synthesis. Only CERTIFIED designs are ever used; the value gives the
    reason."""

    CERTIFIED = "certified"
    GAMMA_NOT_CONVERGED = "the search for gamma_opt did not converge"
    RICCATI_FAILED = "the Hamiltonian has eigenvalues on the axis: no stabilising Riccati solution"
    NOT_FINITE = "the controller is not finite"
    UNSTABLE_LOOP = "the rebuilt closed loop is not stable"
    NORM_EXCEEDED = "the closed loop's norm exceeds gamma on the frequency grid"
    LEVEL_TEST_FAILED = "the Hamiltonian test finds a gain above gamma"
    NO_BANDWIDTH = "sigma_max(S) does not start below -3 dB and cross it"
    EIGENVALUES_FAILED = "LAPACK did not converge on an eigenvalue problem"
    FILTER_FAILED = (
        "the filter's Riccati equation has no stabilising solution: a mode on the axis that no "
        "force drives or no sensor sees"
    )
    PEAK_NOT_CONFIRMED = "the peak of S was not confirmed by the level test"
    LOST_IN_ROUNDING = (
        "the controller is lost in rounding: in SI its loop needs more digits than doubles have; "
        "in the case raise inner.gamma_backoff (1.05, 1.2), lower weights.M_K, or narrow "
        "inner.omega_S_hz and inner.omega_T_hz"
    )
    POLE_ON_AXIS = (
        "the plant has a pole on the imaginary axis, which mixed sensitivity excludes: give the "
        "weights a disturbance, or use ccd.tune"
    )
    NOT_STABILISABLE = (
        "the plant has an unstable pole that no force drives or no sensor sees: no controller "
        "stabilises it"
    )
    NO_DERIVATIVES = "certified, but its derivatives are lost in rounding"
    NOT_ROBUST = "the closed loop is not stable on every perturbed plant"


class Optimum(StrEnum):
    """The knowledge of γ_opt: a certified controller may be far from the best one."""

    FOUND = "found"
    UNKNOWN = (
        "not certified: rounding decides which levels pass; the optimum is between "
        "gamma_lower_bound and gamma"
    )
    NOT_SEARCHED = "not searched for: the controller was given"


_OUTCOMES = {code: Outcome[code.name] for code in Code}


@dataclass(frozen=True)
class Certificate:
    """Evidence from the rebuilt loop: stability, and the norm against the bound it had to meet.

    Attributes
    ----------
    stable, max_real_pole : bool, float
        The largest real part of a pole in 1/s.
    norm, norm_bound : float
        Of the weighted closed loop.
    passed : bool
        Whether it is stable and within the bound.
    """

    stable: bool
    max_real_pole: float
    norm: float
    norm_bound: float
    passed: bool


@dataclass(frozen=True)
class DesignFigures:
    """The figures of one synthesis; NaN where it ended before the figure was known.

    Attributes
    ----------
    omega_S, omega_T : float
        Of its weights, rad/s.
    outcome : Outcome
        Whether it is certified, or why not.
    gamma_opt, gamma_lower_bound, gamma : float
        The optimum, γ_jω that no controller goes below, and the norm that was reached.
    limited_by_bound : bool
        Whether γ_opt = γ_jω.
    bandwidth, sensitivity_peak_frequency : float
        rad/s.
    sensitivity_peak, sensitivity_low : float
        ‖S‖∞, and σ_max(S) at ω_low.
    certificate : Certificate
        Of the closed loop.
    compliance : float
        ‖GS‖∞ in m/N, where it was required.
    gamma_error : float
        Relative error that rounding may have left in γ_opt; infinite where it is not known.
    """

    omega_S: float
    omega_T: float
    outcome: Outcome
    gamma_opt: float
    gamma_lower_bound: float
    gamma: float
    limited_by_bound: bool
    bandwidth: float
    sensitivity_peak: float
    sensitivity_peak_frequency: float
    sensitivity_low: float
    certificate: Certificate
    compliance: float = float("nan")
    gamma_error: float = float("nan")

    @property
    def optimum(self) -> Optimum:
        """Whether γ_opt is known."""
        if np.isnan(self.gamma_error):
            return Optimum.NOT_SEARCHED
        known = self.gamma_error <= CertificateOptions().known
        return Optimum.FOUND if known else Optimum.UNKNOWN

    @property
    def certified(self) -> bool:
        """Whether the design may be used at all."""
        return self.outcome is Outcome.CERTIFIED


@dataclass(frozen=True)
class Design(NotebookHtml):
    """A synthesis with its controller.

    Attributes
    ----------
    figures : DesignFigures
        SI.
    weights : Weights
        By which it was made.
    controller : StateSpace
        Input e = r - y, output u, SI.
    """

    figures: DesignFigures
    weights: Weights
    controller: StateSpace


@one_blas_thread
def synthesise(
    plant: ScaledPlant,
    weights: Weights,
    *,
    omega_low: float,
    gamma_backoff: float = 1.02,
    guess: float = 0.0,
    compliance: bool = False,
) -> Design:
    """One certified design by mixed sensitivity.

    Parameters
    ----------
    plant : ScaledPlant
        With a family the design is made on the family's design plant, see `over_family`.
    weights : Weights
        W1, W2, W3.
    omega_low : float
        Where |S| is reported, rad/s.
    gamma_backoff : float
        The controller is made at this multiple of γ_opt.
    guess : float
        A nearby γ_opt; 0: none.
    compliance : bool
        Whether ‖GS‖∞ is among the figures.

    Returns
    -------
    Design
        A failure is an outcome of its `figures`, no exception.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
    >>> weights = problem.weights.at(800.0 * ccd.HZ, 40.0 * ccd.HZ)
    >>> made = ccd.synthesise(ccd.scaled_plant(problem, (60.0, 60.0)), weights, omega_low=ccd.HZ)
    >>> made.figures.outcome.value, round(made.figures.bandwidth / ccd.HZ, 2)
    ('certified', 55.56)
    """
    w0 = plant.omega_0
    on = plant.design_plant
    row, Ak, Bk, Ck = design(on.A, on.B, on.C, weights.scale(w0), on.grid, on.gain, gamma_backoff,
                     omega_low / w0, guess, on.channels, weights.delta,
                     judged_on(plant))  # fmt: skip
    figures = over_family(plant, weights, row, (Ak, Bk, Ck), omega_low)[0]
    refused = _refusal(on)
    if refused is Outcome.NOT_STABILISABLE and not figures.certificate.passed:
        figures = replace(figures, outcome=refused, gamma_opt=np.nan)
    if refused is Outcome.POLE_ON_AXIS and not weights.delta:
        figures = replace(figures, outcome=refused, gamma_opt=np.nan)
    controller = plant.controller_si(Ak, Bk, Ck)
    if compliance and figures.certified:
        figures = replace(figures, compliance=compliance_over_family(plant, controller).gain)
    return Design(figures, weights, controller)


def _refusal(plant: ScaledPlant, options: PoleOptions = PoleOptions()) -> Outcome | None:
    """Explain why mixed sensitivity does not serve a plant, by its poles."""
    poles = np.linalg.eigvals(plant.A)
    growing = poles[poles.real >= 0.0]
    if not len(growing):
        return None
    if (growing.real <= options.on_axis * np.abs(growing)).any():
        return Outcome.POLE_ON_AXIS
    for A, C in ((plant.A, plant.C), (plant.A.T, plant.B.T)):
        # P is c²/(2 Re p) for one mode, which the outputs see at c
        seen = 2.0 * np.abs(growing).max() * np.linalg.eigvalsh(unstable_part(A, C)[1])
        if (seen <= (options.hidden * np.linalg.norm(C)) ** 2).any():
            return Outcome.NOT_STABILISABLE
    return None


def sweep(
    plant: ScaledPlant,
    weights: Weights,
    omega_S: Array,
    omega_T: Array,
    *,
    omega_low: float,
    gamma_backoff: float = 1.02,
    compliance: bool = False,
) -> list[DesignFigures]:
    """A certified design at every (ω_S, ω_T) of a grid.

    Parameters
    ----------
    plant, weights : ScaledPlant, Weights
        As for `synthesise`; ω_S and ω_T of the weights do not count.
    omega_S, omega_T : (k,), (l,) array
        rad/s.
    omega_low, gamma_backoff, compliance
        As for `synthesise`.

    Returns
    -------
    list of DesignFigures
        k l of them; ω_T varies fastest.
    """
    w0 = plant.omega_0
    S, T = np.asarray(omega_S, float), np.asarray(omega_T, float)
    points = [weights.at(float(s), float(t)) for s in S for t in T]
    on = plant.design_plant
    if len(plant.members) > 1 or compliance:
        made = (synthesise(plant, point, omega_low=omega_low, gamma_backoff=gamma_backoff,
                           compliance=compliance) for point in points)  # fmt: skip
        return [design.figures for design in made]
    rows = _sweep(on.A, on.B, on.C, weights.scale(w0), S / w0, T / w0, on.grid, on.gain,
                  gamma_backoff, omega_low / w0, on.channels, weights.delta,
                  judged_on(plant))  # fmt: skip
    rows = rows.reshape(len(points), -1)
    return [figures_from_row(row, point, w0) for row, point in zip(rows, points, strict=True)]


def judged_on(plant: ScaledPlant) -> tuple[Array, ...]:
    """A, B, C of the plant that a design's loop is judged on, () where that is its design plant."""
    return (plant.A, plant.B, plant.C) if plant.family else ()


def over_family(
    plant: ScaledPlant,
    weights: Weights,
    row: Array,
    controller: tuple[Array, Array, Array],
    omega_low: float,
) -> tuple[DesignFigures, ScaledPlant]:
    """Figures of a scaled controller (A_K, B_K, C_K) on a plant and its perturbed siblings.

    ω_b and σ_max(S(jω_low)) are the plant's own, ‖S‖∞ is the largest of all; second comes the
    plant that has it. `row`: of the synthesis on the family's design plant, judged on this one.
    γ_opt is of the design plant; the certified norm is of the plant itself, not optimal there.
    """
    w0 = plant.omega_0
    if row[Column.CODE] != Code.CERTIFIED or len(plant.members) == 1:
        return figures_from_row(row, weights, w0), plant
    w, Dk = weights.scale(w0), np.zeros((controller[2].shape[0], controller[1].shape[1]))

    def assess(member: ScaledPlant, gamma: float) -> Array:
        own = row.copy()
        loop = (member.A, member.B, member.C, *controller, Dk)
        judge(*loop, w, weights.delta, gamma, omega_low / w0, own)
        return own

    own, worst = row.copy(), plant
    for member in plant.members[1:]:
        other = assess(member, CertificateOptions().unbounded)
        if other[Column.CODE] not in (Code.CERTIFIED, Code.NO_BANDWIDTH):
            figures = figures_from_row(own, weights, w0)
            return replace(figures, outcome=Outcome.NOT_ROBUST, sensitivity_peak=np.inf), member
        if other[Column.PEAK] > own[Column.PEAK]:
            worst, of_peak = member, [Column.PEAK, Column.PEAK_FREQUENCY]
            own[of_peak] = other[of_peak]
    return figures_from_row(own, weights, w0), worst


def figures_from_row(row: Array, weights: Weights, omega_0: float) -> DesignFigures:
    """A kernel's row of scaled figures in SI.

    Parameters
    ----------
    row : (Column.COUNT,) array
        Frequencies over ω₀.
    weights : Weights
        Of the design.
    omega_0 : float
        rad/s.

    Returns
    -------
    DesignFigures
        SI.
    """
    code = Code(int(row[Column.CODE]))
    pole = float(row[Column.MAX_REAL_POLE]) * omega_0
    return DesignFigures(
        omega_S=weights.omega_S,
        omega_T=weights.omega_T,
        outcome=_OUTCOMES[code],
        gamma_opt=float(row[Column.GAMMA_OPT]),
        gamma_lower_bound=float(row[Column.GAMMA_LOWER_BOUND]),
        gamma=float(row[Column.NORM]),
        limited_by_bound=bool(row[Column.LIMITED_BY_BOUND]),
        bandwidth=float(row[Column.BANDWIDTH]) * omega_0,
        sensitivity_peak=float(row[Column.PEAK]),
        sensitivity_peak_frequency=float(row[Column.PEAK_FREQUENCY]) * omega_0,
        sensitivity_low=float(row[Column.LOW]),
        certificate=Certificate(
            stable=pole < 0.0,
            max_real_pole=pole,
            norm=float(row[Column.NORM]),
            norm_bound=float(row[Column.GAMMA]),
            passed=code in (Code.CERTIFIED, Code.NO_BANDWIDTH),
        ),
        gamma_error=float(row[Column.GAMMA_ERROR]),
    )
