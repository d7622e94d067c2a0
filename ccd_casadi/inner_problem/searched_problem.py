"""A problem with what a search for structured controllers has found: its search state.

A `CoDesignProblem` is what a case states, and never changes. A search over controllers returns the
same statement with a `SearchState`: v(θ) is then the best of the climbs from its warm starts, on
the plants of its scenarios, so one function of θ that can be sampled and stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.support.arrays import Array

Scenario = tuple[int, tuple[float, ...]]


@dataclass(frozen=True)
class WarmStartOptions:
    """Numbers of the warm starts that a state keeps."""

    found: int = 3  # of a multi-start search
    kept: int = 4  # with one that is added


@dataclass(frozen=True)
class SearchState:
    """The state of a search: what it has found so far."""

    warm_starts: tuple[tuple[float, ...], ...] = ()  # κ (SI) of the largest bandwidth
    error_warm_starts: tuple[tuple[float, ...], ...] = ()  # of the least error or time
    scenarios: tuple[Scenario, ...] = ()  # options and points of the box
    seed: int = 0  # of the multi-start search that finds them


@dataclass(frozen=True)
class SearchedProblem(CoDesignProblem):
    """A statement with the state of a search for it."""

    state: SearchState = field(default_factory=SearchState)

    def controller_identity(self) -> dict[str, Any]:
        """Return the identity of the statement with the state, under the names that stores knew
        first."""
        found, state = super().controller_identity(), self.state
        own = {"seed": state.seed, "anchors": state.warm_starts, "members": state.scenarios}
        if "least_error" in found["sections"]:
            least = found["sections"]["least_error"][0]
            own["least_error"] = [least, state.error_warm_starts]
        return found | {"sections": found["sections"] | own}


def state_of(problem: CoDesignProblem) -> SearchState:
    """Take what a search has found for a problem.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    SearchState
        Empty where there was no search.
    """
    return problem.state if isinstance(problem, SearchedProblem) else SearchState()


def with_state(problem: CoDesignProblem, **changes: object) -> CoDesignProblem:
    """Change fields of a problem's `SearchState`; what the case states stays.

    Parameters
    ----------
    problem : CoDesignProblem
    changes
        Fields by name.

    Returns
    -------
    CoDesignProblem
        The statement itself where the state is empty.
    """
    state = replace(state_of(problem), **changes)  # type: ignore[arg-type]
    own = dict(vars(problem))
    own.pop("state", None)
    return CoDesignProblem(**own) if state == SearchState() else SearchedProblem(**own, state=state)


def with_warm_start(
    problem: CoDesignProblem, kappa: Sequence[float] | Array, most: int = WarmStartOptions.kept
) -> CoDesignProblem:
    """Add a warm start of what a problem minimises, as the first.

    Parameters
    ----------
    problem : CoDesignProblem
    kappa : array (n,)
        κ in SI; empty of a design that has no controller, which adds nothing.
    most : int
        Warm starts that are kept.

    Returns
    -------
    CoDesignProblem
    """
    own = tuple(map(float, kappa))
    if not own:
        return problem
    name = "warm_starts" if problem.figure is BANDWIDTH else "error_warm_starts"
    others = (known for known in getattr(state_of(problem), name) if known != own)
    return with_state(problem, **{name: (own, *others)[:most]})
