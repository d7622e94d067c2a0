"""[sampling], [outer], [baseline] and [limits] of a case file: how a run goes about it."""

from dataclasses import dataclass

from ccd_casadi.cases.checks import FRACTION, POSITIVE, choice, count, key, steps


@dataclass(frozen=True)
class SamplingSection:
    """[sampling]: the offline design over θ; points per axis for grid, in all for the others.

    `lifted_points` designs of (θ, ω_S, ω_T) are sampled for the lifted formulation; 0 chooses.
    """

    design: str = key(choice("grid", "sobol", "lhs"), "grid", says="how θ is spread for samples")
    points: int = key(
        count(2), 5, says="of θ: on each axis of a grid, in all for the other designs"
    )
    lifted_points: int = key(
        count(0), 0, says="designs of (θ, ω_S, ω_T) for the lifted formulation; 0 chooses"
    )


@dataclass(frozen=True)
class OuterSection:
    """[outer]: IPOPT starts, agreement of prediction and truth, rounds of refinement, surrogate.

    `surrogate`: the kernel of the Gaussian processes; "auto" takes, output by output, the one
    that predicts left-out samples best. `box_points`: true inner problems spread over the box of θ
    that a solve ends with a look at, those that it has solved already among them; 0: none.
    """

    starts: int = key(count(1), 16, says="of IPOPT on the surrogates")
    direct_starts: int = key(count(1), 4, says="of IPOPT on the true problem")
    tolerance: float = key(
        FRACTION, 1e-3, says="to which prediction and truth have to agree, relative"
    )
    max_refinements: int = key(count(0), 12, says="rounds of adding true samples at the optimum")
    surrogate: str = key(
        choice("matern52", "rbf", "auto"),
        "matern52",
        says='kernel of the Gaussian processes; "auto": what predicts left-out samples best',
    )
    box_points: int = key(
        count(0), 32, says="θ spread over the box that every solve ends with a look at; 0: none"
    )


@dataclass(frozen=True)
class BaselineSection:
    """[baseline]: the sequential design's first resonance, and the descents' steps and starts.

    `steps` are the first steps tried, as shares of the box; `starts` start points: the case's own
    and a Latin hypercube.
    """

    first_resonance_hz: float = key(
        POSITIVE,
        250.0,
        says="of the sequential design: its first resonance is at least this",
        unit="Hz",
    )
    steps: tuple[float, ...] = key(
        steps, (0.02, 0.05, 0.1), says="first steps that the descents try, as shares of the box"
    )
    starts: int = key(count(1), 3, says="of the descents: the case's own and a Latin hypercube")
    max_iterations: int = key(count(1), 100, says="of a descent")


@dataclass(frozen=True)
class LimitsSection:
    """[limits]: how long a user's plant function may take at each call, in s."""

    plant_seconds: float = key(
        POSITIVE,
        60.0,
        says="how long a plant function of one's own may take at each call",
        unit="s",
    )
