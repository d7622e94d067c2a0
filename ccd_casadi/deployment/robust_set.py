"""The plants of a run's [robust] set beside its nominal one, as a deployed loop meets them.

What a robust design promises, stability and ‖S‖∞, is promised on every one of them; ω_b and S_low
are the nominal plant's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.analysis.loop_channels import LoopChannel, SampledFigures, along_directions
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.final_judgement import RobustCheckOptions, written_plants
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import lattice
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import require_as_returned
from ccd_casadi.inner_problem.searched_problem import state_of
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class SetPlace(Perturbation):
    """A place in the set of sections: besides, an option set of the plant (0: none), a gain, and
    parameters of the model that vary."""

    option: int = 0
    gain: float = 0.0
    varies: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Member:
    """A perturbed plant and where it lies in the set."""

    at: Perturbation
    plant: ScaledPlant

    def seen_by(self, channel: LoopChannel) -> ScaledPlant:
        """Uᵀ G V of a channel of the nominal plant: a perturbation leaves the mode shapes."""
        return along_directions(self.plant, channel.outputs, channel.inputs)


@dataclass(frozen=True)
class MemberLoop:
    """The sampled loop on a member of the set."""

    at: Perturbation
    figures: SampledFigures

    @property
    def badness(self) -> float:
        """‖S‖∞, and beyond any the spectral radius of what is unstable."""
        f = self.figures
        return f.sensitivity_peak if f.stable else 1e9 * f.spectral_radius


def place_words(at: Perturbation) -> str:
    """A perturbation in words.

    Parameters
    ----------
    at : Perturbation
        Of the plant.

    Returns
    -------
    str
        Its parts that are not nominal.

    Examples
    --------
    >>> place_words(Perturbation(0.03, 0.5)), place_words(Perturbation())
    ('resonances +3 %, damping x 0.5', 'the nominal plant')
    """
    parts = [f"resonances {100.0 * at.shift:+.3g} %"] if at.shift else []
    parts += [f"damping x {at.damping:.3g}"] if at.damping != 1.0 else []
    parts += [f"mode {i} {100.0 * s:+.3g} %" for i, s in enumerate(at.modes, 1) if s]
    if isinstance(at, SetPlace):
        parts += [f"gain {100.0 * at.gain:+.3g} %"] if at.gain else []
        parts += [f"option set {at.option}"] if at.option else []
        parts += [f"{name.removeprefix('theta.')}={value:.4g}" for name, value in at.varies]
    return ", ".join(parts) or "the nominal plant"


def members(run: FinishedRun, *, dense: bool = False) -> tuple[Member, ...]:
    """List the plants of a run's set but the nominal one.

    Parameters
    ----------
    run : FinishedRun
    dense : bool
        On the number of shifts that a design is verified on.

    Returns
    -------
    tuple of Member
        Empty without a set.
    """
    if kind_of(run.problem).as_designed:
        return _of_structured(run, dense)
    robust = run.problem.robust
    if robust is None:
        return ()
    places = robust.perturbations(RobustCheckOptions().shifts if dense and robust.shift else None)
    return tuple(
        Member(at, scale_plant(run.modal(at), run.weights.M_K))
        for at in places
        if at != Perturbation()
    )


def forced_model(run: FinishedRun) -> StateSpace:
    """The model in SI, with what disturbing forces move where a bound is on it."""
    if not kind_of(run.problem).as_designed:
        return run.plant.plant_si()
    uncertain = uncertain_plant(run.problem, run.theta)
    return uncertain.plant(uncertain.nominal).plant_si()


def as_written(run: FinishedRun) -> list[StateSpace]:
    """The model and every plant of the dense set, by the matrices as the plant function returned
    them."""
    if not kind_of(run.problem).as_designed:
        return written_plants(run.problem, run.theta, RobustCheckOptions().shifts)
    require_as_returned(run.problem, run.theta)
    uncertain = uncertain_plant(run.problem, run.theta)
    return uncertain.as_written([(0, uncertain.nominal), *_points(run, uncertain, True)])


def _points(
    run: FinishedRun, uncertain: UncertainPlant, dense: bool, count: int = 41
) -> list[tuple[int, Array]]:
    """Corners of the box, the run's own set, `dense`: a lattice of `count` plants too; of a share
    the set alone."""
    state = state_of(run.problem)
    if run.case.robust.share is not None:
        return [(i, np.array(p)) for i, p in state.scenarios]
    points = [*uncertain.corners(), *((i, np.array(p)) for i, p in state.scenarios)]
    return points + (lattice(uncertain, count, state.seed) if dense else [])


def _of_structured(run: FinishedRun, dense: bool) -> tuple[Member, ...]:
    """Return the plants of a run with sections."""
    uncertain = uncertain_plant(run.problem, run.theta)
    found: dict[SetPlace, Member] = {}
    for option, point in _points(run, uncertain, dense):
        if option == 0 and np.array_equal(point, uncertain.nominal):
            continue
        values = dict(zip(uncertain.names, np.asarray(point, float).tolist(), strict=True))
        modes = tuple(values.get(f"mode_shift {i}", 0.0) for i in range(1, uncertain.modes + 1))
        model = tuple(item for item in values.items() if item[0].startswith("theta."))
        place = SetPlace(
            values.get("resonance_shift", 0.0), values.get("damping", 1.0),
            modes if any(modes) else (), option=option, gain=values.get("gain", 0.0), varies=model,
        )  # fmt: skip
        found.setdefault(place, Member(place, uncertain.plant(point, option)))
    return tuple(found.values())


class WorstFirst:
    """A test of all of a sequence that begins with the one that failed last."""

    def __init__(self, items: Sequence[Member]) -> None:
        self._items = list(items)

    def all(self, test: Callable[[Member], bool]) -> bool:
        """Whether every item passes."""
        for i, item in enumerate(self._items):
            if not test(item):
                self._items.insert(0, self._items.pop(i))
                return False
        return True
