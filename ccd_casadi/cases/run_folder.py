"""A finished run folder read back: its problem, its design, and the design's figures measured anew.

What a run folder holds may come from somebody else, or from an older version: everything is
checked, and the controller is certified again on the plant that the case file describes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.analysis.loop_channels import loop_figures
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import plain_case, problem_of
from ccd_casadi.cases.plant_tables import parse_theta
from ccd_casadi.cases.run_files import (
    controller_of,
    number_of,
    read_json,
    refuse_damaged,
    sections_kappa,
    theta_of,
)
from ccd_casadi.cases.tables import Case
from ccd_casadi.inner_problem.kinds import kind_of, loop_on
from ccd_casadi.inner_problem.objective import final_design
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    free_modal,
    plant_of,
    scaled_plant,
    with_ports,
)
from ccd_casadi.inner_problem.searched_problem import state_of, with_state, with_warm_start
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.inner_problem.structured_problem import (
    ChannelProblem,
    StructuredProblem,
    structured_of,
    with_structured,
)
from ccd_casadi.inner_problem.structured_robustness import certify_corners
from ccd_casadi.inner_problem.structured_search import with_range
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.modal import ModalPlant, Perturbation
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.terminal import NotebookHtml
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import DesignFigures
from ccd_casadi.synthesis.weights import Weights

if TYPE_CHECKING:
    import control


@dataclass(frozen=True)
class RunFolderOptions:
    """Relative tolerances with which a run folder is read."""

    gamma: float = 1e-3  # difference of γ between two syntheses of the same problem on two machines
    bound: float = 1e-5  # excess of a bound of [inner] that counts as met
    norm: float = 1e-6  # excess of the norm over the stored bound


@dataclass(frozen=True)
class FinishedRun(NotebookHtml):
    """The design of a finished run, measured again when its folder was read.

    Attributes
    ----------
    folder : Path
    case : Case
    problem : CoDesignProblem
    theta : tuple of float (n,)
        SI.
    plant : ScaledPlant
        As the case describes it now.
    weights : Weights
        W_S, W_KS, W_T, SI.
    controller : StateSpace
        e to u, SI.
    figures : DesignFigures
        Measured on `plant`.
    result : mapping
        result.json as it was written.
    sampling : Sampling, optional
        How a controller in discrete time runs, where one is checked in place of the run's.
    kappa : array, optional
        Parameters of a fixed structure, SI.
    """

    folder: Path
    case: Case
    problem: CoDesignProblem
    theta: tuple[float, ...]
    plant: ScaledPlant
    weights: Weights
    controller: StateSpace
    figures: DesignFigures
    result: Mapping[str, Any]
    sampling: Sampling | None = None
    kappa: Array | None = None  # of a fixed structure, SI

    @cached_property
    def system(self) -> Mechanics:
        """The plant's matrices at θ."""
        return mechanics(plant_of(self.problem), self.theta, derivatives=False)

    def modal(self, *off: Perturbation) -> ModalPlant:
        """The plant in its modes, as the model has it or off that; rigid bodies are free."""
        return free_modal(self.problem, self.system, *off)

    def loop_on(self, plant: StateSpace) -> Loop:
        """The loop on a plant in SI, as it runs: as a controller that is checked does, else as the
        case has it."""
        found = loop_on(self.problem, plant, self.controller)
        return found if self.sampling is None else replace(found, sampling=self.sampling)

    @property
    def loop(self) -> Loop:
        """The loop on the model, as it runs, with its ports."""
        wide = with_ports(self.problem)
        plant = self.plant if wide is self.problem else scaled_plant(wide, self.theta)
        return self.loop_on(plant.plant_si())

    @cached_property
    def bandwidth(self) -> float:
        """ω_b in rad/s of the continuous loop; where that has none, of the sampled one."""
        loop = self.loop_on(self.plant.plant_si())
        if loop.sampling is None or np.isfinite(self.figures.bandwidth):
            return self.figures.bandwidth
        return loop_figures(closed_loop(*loop.as_run), loop.at).bandwidth

    def measure(self, plant: ScaledPlant, controller: StateSpace) -> DesignFigures:
        """The figures of a continuous loop, its norm not judged."""
        return _measure(self.problem, plant, controller, self.weights)

    def to_control(self) -> "tuple[control.StateSpace, control.StateSpace]":
        """G (N to m) and K (e = r - y to N) in continuous time, SI, for python-control.

        `control.feedback(G * K, 1)` is T. What a sampled loop of sections runs is Tustin's rule of
        K, `control.c2d(K, period, "tustin")`, behind its delay.
        """
        from ccd_casadi.synthesis.interchange import named_controller, named_plant, to_control

        plant, controller = named_plant(self.plant.plant_si()), named_controller(self.controller)
        return to_control(plant, "plant"), to_control(controller, "controller")


def _measure(
    problem: CoDesignProblem, plant: ScaledPlant, controller: StateSpace, weights: Weights
) -> DesignFigures:
    """Measure the loop as `loop_figures` does for several sensors on one actuator, with S_low where
    the error counts."""
    low = problem.inner.omega_low
    found, places = (
        measure(plant, controller, weights, omega_low=low),
        kind_of(problem).bounds().places,
    )
    if not places:
        return found
    whole = closed_loop(plant.plant_si(), controller)
    own, at_low = (
        loop_figures(whole, places),
        places[0].close_loop(whole).S.response(np.array([low])),
    )
    return replace(found, sensitivity_low=float(abs(at_low[0, 0, 0])), bandwidth=own.bandwidth,
                   sensitivity_peak=own.sensitivity_peak,
                   sensitivity_peak_frequency=own.sensitivity_peak_frequency)  # fmt: skip


def read_run(
    folder: str | Path, *, of_share: bool = False, options: RunFolderOptions = RunFolderOptions()
) -> FinishedRun:
    """Read a finished run, and certify its controller again.

    Parameters
    ----------
    folder : path
        With case.toml, result.json and controller.json.
    of_share : bool
        Whether it may be of a share of machines, which keeps the set that it was designed on and
        not its box.
    options : RunFolderOptions
        Tolerances.

    Returns
    -------
    FinishedRun
        What `deploy`, `robustness` and `samples_frame` take.

    Raises
    ------
    UserError
        A file is missing, damaged or foreign, the run found no feasible design, or the controller
        is not certified on its plant any more.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder}: is not a folder; name the run folder of a finished solve")
    result = read_json(folder / "result.json")
    if result.get("status") == "infeasible":
        words = "the run found no feasible design; there is nothing to work on"
        raise UserError(f"{folder / 'result.json'}: status: {words}")
    case = load_case(folder / "case.toml")
    share = case.robust.share_words
    if share and not of_share:
        words = f"is {share}; name a run of the whole box, or use `ccd deploy` or `ccd robustness`"
        raise UserError(f"{folder}: {words}")
    problem = problem_of(plain_case(case))
    theta = theta_of(folder / "result.json", result, problem)
    if isinstance(problem.controller, StructuredProblem):
        found = _read_structured(folder, problem, theta, result, of_share=bool(share))
    else:
        found = _read_mixed(folder, problem, theta, result, options)
    problem = found.pop("problem", problem)
    plant = scaled_plant(problem, theta)
    return FinishedRun(folder, case, problem, theta, plant, result=result, **found)


def problem_at(
    place: Path, theta: str | None
) -> tuple[CoDesignProblem, tuple[float, ...] | None, FinishedRun | None]:
    """Read the problem, the θ and the run of a place.

    Parameters
    ----------
    place : Path
        The folder of a finished run, or a case file.
    theta : str, optional
        θ of a case file, as `m1=60,m2=60`.

    Returns
    -------
    problem : CoDesignProblem
    theta : tuple of float, or None of a case file without θ
    run : FinishedRun, or None of a case file

    Raises
    ------
    UserError
        As `read_run` and `load_case`, and for a run with another θ.
    """
    if place.is_dir():
        run = read_run(place)
        if theta is not None:
            raise UserError(f"{place}: a run has its own theta; leave out --theta")
        return run.problem, run.theta, run
    case = load_case(place)
    return problem_of(case), None if theta is None else parse_theta(case, theta), None


def _read_mixed(
    folder: Path,
    problem: CoDesignProblem,
    theta: tuple[float, ...],
    result: Mapping[str, Any],
    options: RunFolderOptions,
) -> dict[str, Any]:
    """Weights, controller and figures of a run of mixed sensitivity, certified again at its γ."""
    path = folder / "result.json"
    hz = [number_of(path, result, key) for key in ("omega_S_hz", "omega_T_hz")]
    weights, plant = problem.weights.at(HZ * hz[0], HZ * hz[1]), scaled_plant(problem, theta)
    controller = controller_of(folder / "controller.json", plant)
    certificate = result.get("certificate")
    bound = number_of(path, certificate if isinstance(certificate, Mapping) else {}, "norm_bound")
    bound = max(bound, number_of(path, result, "gamma"))
    # What a file says of γ is not relied on: it is at most that of a synthesis made anew.
    made = final_design(problem, theta, (HZ * hz[0], HZ * hz[1])).figures
    if made.certified and bound > made.certificate.norm_bound * (1.0 + options.gamma):
        words = f"is {bound:.6g}, and a synthesis reaches {made.certificate.norm_bound:.6g}"
        raise UserError(f"{path}: certificate.norm_bound: {words}; make the run again")
    figures = measure(
        plant, controller, weights,
        gamma=bound * (1.0 + options.norm),
        omega_low=problem.inner.omega_low, gamma_opt=number_of(path, result, "gamma_opt"),
        gamma_lower_bound=number_of(path, result, "gamma_lower_bound"),
    )  # fmt: skip
    figures = replace(figures, gamma_error=made.gamma_error)
    if not figures.certified:
        words = f"is not certified on the plant of case.toml: {figures.outcome.value}"
        raise UserError(f"{folder / 'controller.json'}: {words}; make the run again")
    for name, most in (("sensitivity_peak", "S_max"), ("sensitivity_low", "S_low")):
        found, own = getattr(figures, name), getattr(problem.inner, most)
        if result.get("status") == "verified" and not found <= own * (1.0 + options.bound):
            words = f"is verified, but {most} = {own:g} of case.toml is exceeded: {found:.6g}"
            raise UserError(f"{path}: status: {words}; make the run again")
    return {"weights": weights, "controller": controller, "figures": figures}


def _read_structured(
    folder: Path, problem: CoDesignProblem, theta: tuple[float, ...], result: Mapping[str, Any],
    *, of_share: bool,
) -> dict[str, Any]:  # fmt: skip
    """The same and κ of a fixed structure: rebuilt from κ, judged on the corners of its set; for a
    share on the machines that it was designed on.

    `figures` are those of the continuous loop with the model; hold and delay are not in them.
    """
    path = folder / "controller.json"
    problem = _with_directions(problem, read_json(path).get("sections"), path)
    structure = structure_of(problem)
    kappa = np.array(sections_kappa(folder, structure))
    controller = structure.state_space(kappa)
    problem = with_function(folder / "result.json", problem, result)
    kept = [(option, np.array(point)) for option, point in state_of(problem).scenarios]
    if of_share and not kept:
        words = "robust.set: is missing; run `ccd tolerances` again"
        raise UserError(f"{folder / 'result.json'}: {words}")
    judged = certify_corners(problem, theta, controller, kept if of_share else ())
    if not judged.passed:
        words = f"is not certified on the plants of case.toml: {judged.words}"
        raise UserError(f"{path}: {words}; make the run again")
    problem = with_warm_start(problem, kappa)
    figures = _measure(problem, scaled_plant(problem, theta), controller, problem.weights)
    return {"problem": problem, "weights": problem.weights, "controller": controller,
            "figures": figures, "kappa": kappa}  # fmt: skip


def with_function(
    path: Path, problem: CoDesignProblem, result: Mapping[str, Any]
) -> CoDesignProblem:
    """Add to a problem the warm starts and the plant set that a run ended with: its ω_b*(θ).

    Parameters
    ----------
    path : Path
        result.json, for messages.
    problem : CoDesignProblem
    result : mapping
        Its content.

    Returns
    -------
    CoDesignProblem

    Raises
    ------
    UserError
        result.json holds others.
    """
    if "anchors" not in result:
        return problem  # of an earlier version
    words = "anchors, robust.set and seed are not those of a solve; make the run again"
    with refuse_damaged(str(path), words):
        warm_starts, slower = (
            tuple(tuple(map(float, kappa)) for kappa in result.get(name, ()))
            for name in ("anchors", "error_anchors")
        )
        scenarios = tuple(
            (int(item["option"]), tuple(map(float, item["point"])))
            for item in result["robust"]["set"]
        )
        seed, own = int(result["seed"]), len(structure_of(problem).names)
        if any(len(kappa) != own for kappa in (*warm_starts, *slower)):
            raise ValueError("of another structure")
    known = {"warm_starts": warm_starts, "error_warm_starts": slower}
    return with_range(with_state(problem, **known, scenarios=scenarios, seed=seed))


def _with_directions(
    problem: CoDesignProblem, table: Mapping[str, Any] | None, path: Path
) -> CoDesignProblem:
    """The problem with the directions of channels that the controller was designed in."""
    structured = structured_of(problem)
    if not isinstance(table, Mapping) or "channels" not in table:
        return problem
    own = {channel.name: channel for channel in structured.channels}
    with refuse_damaged(f"{path}: sections.channels", "names no directions; make the run again"):
        channels = tuple(
            replace(
                own.get(str(item["name"]), ChannelProblem(str(item["name"]), structured.structure)),
                outputs=tuple(map(float, item["outputs"])),
                inputs=tuple(map(float, item["inputs"])),
            )
            for item in table["channels"]
        )
    return with_structured(problem, channels=channels)
