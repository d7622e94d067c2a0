"""A co-design problem: everything that determines the true ω_b*(θ), and the way to find it.

It is made of plain values, so that it can be sent to a worker process, hashed, and written
beside the samples that it determines.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.inner_problem.controller_problem import (
    ControllerProblem,
    FigureOfMerit,
    MixedSensitivityProblem,
    RobustSet,
)
from ccd_casadi.inner_problem.plant_source import PlantSource, plant_from
from ccd_casadi.inner_problem.search import search_inner
from ccd_casadi.inner_problem.sweep import InnerBounds, InnerResult, evaluate, sweep_inner
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.optim.pieces import Box
from ccd_casadi.plants.modal import (
    NOMINAL,
    ModalPlant,
    Perturbation,
    Suspension,
    modal_plant,
    require_damping,
    without_hidden_rigid_modes,
)
from ccd_casadi.plants.plant import Mechanics, Plant, mechanics, named_values
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.terminal import NotebookHtml
from ccd_casadi.support.text import use_units
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.weights import Weights

if TYPE_CHECKING:
    from ccd_casadi.budget.sources import ErrorBudget

NUMERICS = 15  # raised whenever a change of ours moves the numbers that a sample holds


@dataclass(frozen=True)
class CoDesignProblem(NotebookHtml):
    """The co-design problem (paper, equation (9)); SI throughout.

        min w1 f(θ) + w2 ω_b*(θ)   s.t.  lower <= θ <= upper,   λ(θ) <= 0

    Made by `problem_of`; `dataclasses.replace` makes variants of it.

    Parameters
    ----------
    source : PlantSource
        The plant, and what identifies it in a store.
    names, units, lower, upper, start : tuple (n,)
        Of θ, in order.
    w1, w2 : float
        Weights of f(θ) and of the bandwidth (rad/s).
    weights, inner : Weights, InnerBounds
        W_S, W_KS, W_T; and S_max, S_low and ω_low (rad/s) of the inner problem.
    suspension : Suspension
        What modes without stiffness are given.
    method : str
        "search" or "sweep" of the inner problem.
    robust : RobustSet, optional
        Perturbed plants that the controller has to serve.
    controller : ControllerProblem
        Mixed sensitivity, or a fixed structure.
    budget : ErrorBudget, optional
        What moves the stage: judged, no part of a synthesis.
    cost_unit : str
        Of f(θ).
    listed : tuple of (str, tuple of float)
        Parameters that are one of a few values.
    spoken : (str, str)
        Units of outputs and inputs in words and on pages.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> from dataclasses import replace
    >>> problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
    >>> heavier = replace(problem, lower=(60.0, 60.0), start=(65.0, 65.0))
    """

    source: PlantSource
    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    start: tuple[float, ...]
    w1: float
    w2: float
    weights: Weights
    inner: InnerBounds
    suspension: Suspension
    method: str = "search"
    robust: RobustSet | None = None
    controller: ControllerProblem = field(default_factory=MixedSensitivityProblem)
    budget: "ErrorBudget | None" = None
    cost_unit: str = ""
    listed: tuple[tuple[str, tuple[float, ...]], ...] = ()
    spoken: tuple[str, str] = ("m", "N")

    def identity(self) -> dict[str, object]:
        """Return what determines one synthesis at (θ, ω_S, ω_T), and nothing more.

        S_max, S_low, bounds and the objective are not in it: the samples answer any of them. A
        bound on the compliance is only in so far as that is computed.
        """
        w, robust = self.weights, self.robust
        with_disturbance = (w.disturbance,) if w.disturbance else ()
        perturbed: dict[str, object] = {} if robust is None else {"robust": vars(robust)}
        perturbed |= self.controller_identity()
        if self.inner.compliance_max is not None:
            perturbed["compliance"] = True
        return {
            "numerics": NUMERICS,
            "plant": self.driven.identity(),
            "theta": list(self.names),
            "suspension": [
                self.suspension.frequency_hz,
                self.suspension.damping_ratio,
                self.suspension.rigid_modes,
                *(
                    []
                    if self.suspension.undamped == Suspension.undamped
                    else [self.suspension.undamped]
                ),
            ],
            "weights": [w.M_S, w.A_S, w.c_K, w.omega_K, w.M_K, w.A_l, w.A_u, *with_disturbance],
            "omega_low": self.inner.omega_low,
            "gamma_backoff": self.inner.gamma_backoff,
            **perturbed,
        }

    def controller_identity(self) -> dict[str, Any]:
        """The part of `identity` that its controller states."""
        return self.controller.identity_with(self.weights, self.budget)

    @property
    def driven(self) -> PlantSource:
        """The source of its plant, whose motors move what its controller has to serve too."""
        motion = self.source.motion
        if motion is None:
            return self.source
        loads = self.controller.loads_with(self.source.held)
        return replace(self.source, motion=replace(motion, loads=loads))

    @property
    def figure(self) -> FigureOfMerit:
        """The figure of the controller that J counts."""
        return self.controller.figure

    @property
    def sampling(self) -> Sampling | None:
        """Rate and delay that the controller is designed for; None: continuous."""
        return self.controller.sampling

    @property
    def parameter_units(self) -> dict[str, str]:
        """Units of θ and of the fixed parameters."""
        fixed = {name: unit for name, _, unit in self.source.fixed}
        return {**dict(zip(self.names, self.units, strict=True)), **fixed}

    def inner_identity(self) -> dict[str, object]:
        """Return what else determines ω_b*(θ)."""
        inner = self.inner
        return {
            **{name: bound for name, (_, bound) in inner.bounds.items()},
            "omega_S": list(inner.omega_S),
            "omega_T": list(inner.omega_T),
            "sweep_points": list(inner.sweep_points),
            "method": self.method,
        }


def plant_of(problem: CoDesignProblem) -> Plant:
    """Build the plant of a problem, once in a process.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    Plant

    Raises
    ------
    UserError
        It cannot be built.
    UserCodeRefused
        A user's function must not run.
    """
    use_units(*problem.spoken)
    return plant_from(problem.driven, problem.names, problem.lower, problem.upper)


def notes_of(problem: CoDesignProblem, theta: Sequence[float]) -> tuple[str, ...]:
    """List what a reader of a result must know of the plant.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float
        θ in SI.

    Returns
    -------
    tuple of str
        Its own notes, those of its controller, and the damping that modes lose in a mixed
        synthesis.
    """
    plant, ratio = plant_of(problem), problem.suspension.undamped
    notes = (*plant.notes(theta), *problem.controller.notes)
    if not isinstance(problem.controller, MixedSensitivityProblem):
        return notes
    if not require_damping(free_modal(problem, mechanics(plant, theta, derivatives=False))):
        return notes
    words = f"a mode is not damped: K is synthesised with a damping ratio {ratio:g} less of each"
    return (*notes, f"{words}, and judged without (suspension.undamped)")


def with_ports(problem: CoDesignProblem) -> CoDesignProblem:
    """Give a problem's plant its disturbance as inputs and its performance as outputs.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    CoDesignProblem
        Itself where its plant has neither, and no actuator or sensor between it and its loop.
    """
    if not plant_of(problem).ports and not problem.source.wiring:
        return problem
    return replace(problem, source=replace(problem.source, wide=True))


def refuse_ports(
    problem: CoDesignProblem, what: str, remedy: str = "drop one or the other"
) -> None:
    """Refuse a problem whose plant says where other forces act, or where the error counts.

    Parameters
    ----------
    problem : CoDesignProblem
    what : str
        Which does not know them, such as "controllers of full order".
    remedy : str
        What to change.

    Raises
    ------
    PlantError
        It has.
    """
    if ports := plant_of(problem).ports:
        words = f"{' and '.join(ports)} are not known to {what}"
        raise PlantError(f"{words}; {remedy}")


def require_as_returned(problem: CoDesignProblem, theta: Sequence[float]) -> None:
    """Check that what is judged at θ are the matrices that a person's function returns there.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float (n_θ,)
        θ in SI.

    Raises
    ------
    PlantError
        They differ: the function takes another branch of numbers than of symbols.
    """
    if words := plant_of(problem).mismatch(theta):
        at = named_values(problem.names, theta)
        raise PlantError(f"the plant function at {at}: {words}; let no branch hang on float(theta)")


def scaled_plant(problem: CoDesignProblem, theta: Sequence[float]) -> ScaledPlant:
    """The scaled plant M_K G(jω₀ω), with its family where the problem is a robust one.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence
        θ in SI, in the order of `problem.names`.

    Returns
    -------
    ScaledPlant
        What `synthesise` takes.

    Raises
    ------
    PlantError
        The model is not a plant at θ.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> plant = ccd.scaled_plant(ccd.problem_of(ccd.load_case(ccd.TWO_MASS)), (60.0, 60.0))
    >>> round(float(plant.natural[-1]) / ccd.HZ, 1), plant.A.shape
    (209.2, (4, 4))
    """
    return _scaled_plant(problem, tuple(map(float, theta)))


@lru_cache(maxsize=1)  # a design and what is read from it later are of one plant
def _scaled_plant(problem: CoDesignProblem, theta: tuple[float, ...]) -> ScaledPlant:
    return scaled_system(problem, mechanics(plant_of(problem), theta))


def free_modal(
    problem: CoDesignProblem, system: Mechanics, off: Perturbation = NOMINAL
) -> ModalPlant:
    """Take a plant to modal coordinates as every loop has it: free bodies are free.

    Parameters
    ----------
    problem, system : CoDesignProblem, Mechanics
        The matrices, SI.
    off : Perturbation
        Of resonances and damping.

    Returns
    -------
    ModalPlant
        Without rigid modes that no loop drives or sees.
    """
    return without_hidden_rigid_modes(modal_plant(system, problem.suspension.free, off))


def scaled_system(problem: CoDesignProblem, system: Mechanics) -> ScaledPlant:
    """Scale given matrices as `scaled_plant` does those of the plant.

    Parameters
    ----------
    problem, system : CoDesignProblem, Mechanics
        The matrices, SI: the plant's own or close to them.

    Returns
    -------
    ScaledPlant
        Free bodies are free, and undamped modes are undamped, on every plant of its family but the
        one that controllers are made on.
    """
    suspension, robust = problem.suspension, problem.robust

    def scaled(off: Perturbation, held: Suspension = suspension.free) -> ScaledPlant:
        modal = without_hidden_rigid_modes(modal_plant(system, held, off))
        return scale_plant(modal, problem.weights.M_K)

    nominal = scaled(NOMINAL)
    undamped = require_damping(free_modal(problem, system))
    if robust is None and not nominal.free and not undamped:
        return nominal
    shift, others = 0.0, list[ScaledPlant]()
    if robust is not None:
        shift = robust.design_shift or 0.0
        others = [scaled(off) for off in robust.perturbations() if off != NOMINAL]
    off = Perturbation(shift, lost=suspension.undamped if undamped else 0.0)
    return replace(nominal, family=(scaled(off, suspension), *others))


def design_choices(problem: CoDesignProblem) -> tuple[CoDesignProblem, ...]:
    """List the problem for each plant that its controllers may be made on.

    The minimum over θ and design plants is the least of the minima over θ.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    tuple of CoDesignProblem
        The problem itself where there is one design plant.
    """
    robust = problem.robust
    if robust is None or robust.design_shift is not None:
        return (problem,)
    shifts = (-robust.shift, 0.0, robust.shift) if robust.shift else (0.0,)
    return tuple(replace(problem, robust=replace(robust, design_shift=s)) for s in shifts)


@one_blas_thread
def true_inner(problem: CoDesignProblem, theta: Sequence[float]) -> InnerResult:
    """The true inner problem at θ, by the problem's method: ω_b*(θ), where, and what binds.

        max ω_b over (ω_S, ω_T)  s.t.  ‖S‖∞ <= S_max, σ_max(S(jω_low)) <= S_low    (paper),
                                       ‖GS‖∞ <= compliance_max where that is given

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence
        θ in SI, in the order of `problem.names`. A robust problem without a design plant takes
        the best one.

    Returns
    -------
    InnerResult
        Bandwidth in rad/s; an infeasible θ has no `optimum` and says what falls short.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> best = ccd.true_inner(ccd.problem_of(ccd.load_case(ccd.TWO_MASS)), (60.0, 60.0))
    >>> round(best.bandwidth / ccd.HZ, 2), best.active
    (58.12, ('S_max', 'omega_T lower'))
    """
    _require_mixed(problem)
    return best_choice(problem, theta)[1]


def best_choice(
    problem: CoDesignProblem, theta: Sequence[float], system: Mechanics | None = None
) -> tuple[CoDesignProblem, InnerResult]:
    """Solve the inner problem for every choice of `design_choices`, and take the best.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float
    system : Mechanics, optional
        In the place of the plant's own matrices at θ.

    Returns
    -------
    choice, result : CoDesignProblem, InnerResult
        Of the largest ω_b*, else of the least violation; `syntheses` counts those of all choices.
    """
    solve = sweep_inner if problem.method == "sweep" else search_inner
    system = mechanics(plant_of(problem), theta) if system is None else system
    found = [
        (choice, solve(scaled_system(choice, system), choice.weights, choice.inner))
        for choice in design_choices(problem)
    ]
    best = min(found, key=lambda item: (item[1].violation, -np.nan_to_num(item[1].bandwidth)))
    return best[0], replace(best[1], syntheses=sum(item[1].syntheses for item in found))


@one_blas_thread
def true_design(
    problem: CoDesignProblem, theta: Sequence[float], omega_S: float, omega_T: float
) -> Sensitivities:
    """One certified synthesis with its total derivatives.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence
        θ in SI, in the order of `problem.names`.
    omega_S, omega_T : float
        Frequencies of the weights, rad/s.

    Returns
    -------
    Sensitivities
        Figures and their derivatives to θ, ln ω_S and ln ω_T.

    Raises
    ------
    ValueError
        The problem has no design plant for the controller.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
    >>> made = ccd.true_design(problem, (60.0, 60.0), 800.0 * ccd.HZ, 40.0 * ccd.HZ)
    >>> made.figures.certified, (made.to_theta[0] / ccd.HZ).round(3).tolist()  # dω_b/dm, Hz/kg
    (True, [-0.209, -0.138])
    """
    _require_mixed(problem)
    if len(design_choices(problem)) > 1:
        raise ValueError("a synthesis needs one design plant: take one of design_choices(problem)")
    return evaluate(
        scaled_plant(problem, theta), problem.weights, problem.inner, (omega_S, omega_T)
    )


def _require_mixed(problem: CoDesignProblem) -> None:
    if not isinstance(problem.controller, MixedSensitivityProblem):
        words = "the problem is not one of mixed sensitivity; use structured_value(problem, theta)"
        raise UserError(words)


def box(problem: CoDesignProblem) -> Box:
    """Make the box of θ.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    Box
        In SI.
    """
    return Box(np.array(problem.lower), np.array(problem.upper))


def with_options(
    problem: CoDesignProblem, options: Sequence[tuple[str, object]]
) -> CoDesignProblem:
    """Replace some options of a problem's plant.

    Parameters
    ----------
    problem, options : CoDesignProblem, sequence of (str, object)

    Returns
    -------
    CoDesignProblem
    """
    return replace(problem, source=problem.source.with_options(options))
