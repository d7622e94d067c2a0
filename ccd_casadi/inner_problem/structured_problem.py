"""The second kind of inner problem: a controller of fixed structure on a set of plants.

    ω_b*(θ) = max ω_b over κ  s.t. on every plant: stable, ‖S‖∞ <= S_max, σ_max(S(jω_low)) <= S_low,
              |S| within the shape (`fixed_structure.bounds.Bounds`),
              |W_KS KS| and |W_T T| <= weighted_level, |GS| <= compliance_max

Everything is plain values, as in `problem`: it is hashed, sent to workers and kept in the store.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

from ccd_casadi.analysis import Loads
from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.controller_problem import (
    BANDWIDTH,
    FIGURES,
    RMS_ERROR,
    ControllerProblem,
    FigureOfMerit,
    Options,
)
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.plant import Plant
from ccd_casadi.support.errors import PlantError
from ccd_casadi.synthesis.weights import Weights

if TYPE_CHECKING:  # that states its controller by this module
    from ccd_casadi.budget.sources import ErrorBudget
    from ccd_casadi.inner_problem.problem import CoDesignProblem


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty of the plant; by default there is none.

    Attributes
    ----------
    resonance_shift, mode_shift, gain : float
        Relative, to either side: of all modes, of each, and of the plant.
    damping : tuple of two floats
        The least and the largest factor.
    options : tuple of options
        Further option sets of the plant (loads, positions), each what differs from the case's.
    ranges : tuple of (name, lower, upper)
        Fixed parameters that vary.
    """

    resonance_shift: float = 0.0
    mode_shift: float = 0.0
    damping: tuple[float, float] = (1.0, 1.0)
    gain: float = 0.0
    options: tuple[Options, ...] = ()
    ranges: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class ChannelProblem:
    """One channel of a plant with several outputs.

    Attributes
    ----------
    name, structure : str, Structure
    outputs, inputs : tuple of float, optional
        Its directions; None: those that are found at the start hold for every θ.
    like : str, optional
        The channel whose parameters it has.
    S_max, M_K, bandwidth_ratio : float or None, float or None, float
        Its bounds besides the whole loop's, as in `ChannelBounds`.
    """

    name: str
    structure: Structure
    outputs: tuple[float, ...] | None = None
    inputs: tuple[float, ...] | None = None
    like: str | None = None
    S_max: float | None = None
    M_K: float | None = None
    bandwidth_ratio: float = 1.0

    def identity(self) -> dict[str, Any]:
        """Return its values; those that came later only where they are not the default."""
        later = {"like": None, "S_max": None, "M_K": None, "bandwidth_ratio": 1.0}
        found = {key: value for key, value in vars(self).items() if value != later.get(key, ...)}
        return found | {"structure": self.structure.identity()}


def of_sensor(structure: Structure, counts: bool) -> Structure:
    """Derive the structure of one of several sensors on one actuator.

    Parameters
    ----------
    structure : Structure
    counts : bool
        Whether its error counts: that sensor alone may have an integrator, as a second one would
        drift against it.

    Returns
    -------
    Structure
    """
    return replace(structure, integrator=structure.integrator and counts)


@dataclass(frozen=True)
class StructuredProblem(ControllerProblem):
    """A controller of fixed structure: its bounds beyond S_max and S_low, its plants, its search.

    Attributes
    ----------
    structure : Structure
        Of each channel that the case does not name.
    shape, shape_ends, weighted_level, compliance_max
        As in `Bounds`; None: no such bound. W_T at the lower end of ω_T.
    sampling : Sampling or None
        Hold and delay.
    uncertainty : Uncertainty
    starts : int
        Of the multi-start search, which finds the warm starts and the scenarios.
    frequencies : tuple of two floats, optional
        Bounds of those of K, rad/s, alike at every θ; None: by the plant at the start.
    minimise, bandwidth_least : str, float
        "bandwidth", "rms_error" or "move_time"; the last two at ω_b >= bandwidth_least (rad/s).
    channels : tuple of ChannelProblem
        Of a plant with several outputs.
    bandwidth_of : str or None
        Of several sensors on one actuator: the channel whose error counts.
    """

    kernels: ClassVar[tuple[str, ...]] = ("loops",)

    structure: Structure = field(default_factory=Structure)
    shape: float | None = 1.1
    shape_ends: ShapeEnd = ShapeEnd.S_MAX
    weighted_level: float | None = None
    compliance_max: float | None = None
    sampling: Sampling | None = None
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    starts: int = 12
    frequencies: tuple[float, float] | None = None
    minimise: str = "bandwidth"
    bandwidth_least: float = 0.0
    channels: tuple[ChannelProblem, ...] = ()
    bandwidth_of: str | None = None

    @property
    def figure(self) -> FigureOfMerit:
        """The least RMS error or move time where that is minimised, else ω_b*."""
        return FIGURES[self.minimise]

    @property
    def plant_options(self) -> tuple[Options, ...]:
        return self.uncertainty.options

    def loads_with(self, held: Mapping[str, float]) -> Loads:
        """Return the corners of what varies and every option, with the weakest motor."""
        u = self.uncertainty
        ranges = tuple((name, low, held[name], high)
                       for name, low, high in u.ranges if name in held)  # fmt: skip
        return Loads(ranges, u.gain, u.options)

    def require_plants(self, plants: Sequence[Plant]) -> None:
        """Raise PlantError unless each has as many inputs as outputs, and channels for them."""
        for plant in plants:
            m, p = plant.inputs, plant.outputs
            if self.bandwidth_of is not None:
                self._require_sensors(m, p)
            elif m == 1 < p:
                words = "name the channel whose error counts for the bandwidth"
                raise PlantError(f"has {p} outputs and 1 input; {words}: controller.bandwidth_of")
            elif m != p:
                words = 'controller.structure = "sections" needs as many of one as of the other'
                counts = f"has {m} inputs and {p} outputs"
                raise PlantError(f'{counts}; {words}: leave some out, or "h_infinity"')
            if p > 1 and self.figure is not BANDWIDTH:
                words = f'has several outputs; inner.minimise = "{self.minimise}" is for one'
                raise PlantError(words)
            if not self.channels:
                continue
            given = self.channels[0].outputs is not None
            found = [channel.name for channel in self.channels]
            if p == 1:
                raise PlantError("has one output: drop the tables [controller.channel]")
            if len(found) == p and all(c.bandwidth_ratio > 1.0 for c in self.channels):
                words = "every one of its channels has a bandwidth_ratio above 1; drop it at the"
                raise PlantError(f"{words} slowest, whose bandwidth is ω_b")
            if given:
                from ccd_casadi.fixed_structure.channel_structure import given_decoupling

                channels = [(c.name, c.outputs or (), c.inputs or ()) for c in self.channels]
                given_decoupling(*(list(part) for part in zip(*channels, strict=True)))
                if len(found) != p:
                    words = "give as many tables [controller.channel.NAME]"
                    raise PlantError(f"has {p} outputs; {words}")
            elif not set(found) <= {str(i + 1) for i in range(p)}:
                words = "where none gives outputs; name one of them, or give them"
                raise PlantError(f"has channels 1 to {p} {words}")

    def _require_sensors(self, inputs: int, outputs: int) -> None:
        """Raise PlantError unless these are several sensors on one actuator, each a channel."""
        if inputs != 1 or outputs == 1:
            words = f"has {inputs} inputs and {outputs} outputs"
            remedy = "is of several sensors on one actuator; drop it"
            raise PlantError(f"{words}; controller.bandwidth_of {remedy}")
        given = any(channel.outputs is not None for channel in self.channels)
        names = [c.name for c in self.channels] if given else [str(i + 1) for i in range(outputs)]
        if self.bandwidth_of not in names:
            words = f"{self.bandwidth_of!r} is none of the channels {', '.join(names)}"
            raise PlantError(f"controller.bandwidth_of = {words}; name one of them")

    def identity_with(self, weights: Weights, budget: "ErrorBudget | None") -> dict[str, Any]:
        """Return its own identity, ω_T that bounds KS and T, and what moves the stage where that
        counts."""
        found: dict[str, Any] = {"sections": self.identity() | {"omega_T": weights.omega_T}}
        if self.figure is RMS_ERROR:
            assert budget is not None
            found["budget"] = asdict(budget)
        return found

    def identity(self) -> dict[str, Any]:
        """Return what determines ω_b*(θ), as plain values, without a search state
        (`SearchedProblem`)."""
        structure, sampling = self.structure, self.sampling
        found: dict[str, Any] = {
            "structure": structure.identity(),
            "shape": self.shape,
            "weighted_level": self.weighted_level,
            "compliance_max": self.compliance_max,
            "sampling": None if sampling is None else vars(sampling),
            "uncertainty": vars(self.uncertainty)
            | {"options": [dict(options) for options in self.uncertainty.options]},
            "starts": self.starts,
            "seed": 0,
            "frequencies": self.frequencies,
            "anchors": (),
            "members": (),
        }
        if not self.uncertainty.ranges:  # as stores knew it before
            del found["uncertainty"]["ranges"]
        if self.shape_ends is not ShapeEnd.CROSSING:  # which stores knew first
            found["shape_ends"] = self.shape_ends.value
            if self.shape is not None and self.shape > 1.0:  # which was all open once
                found["room"] = "opens from the bandwidth on"
        if self.channels:
            found["channels"] = [channel.identity() for channel in self.channels]
        if self.bandwidth_of is not None:
            found["bandwidth_of"] = self.bandwidth_of
        if self.figure is not BANDWIDTH:
            found["least_error"] = [self.bandwidth_least, ()]
        return found


def structured_of(problem: "CoDesignProblem") -> StructuredProblem:
    """Take the part of a structured problem that states its controller.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    StructuredProblem
    """
    assert isinstance(problem.controller, StructuredProblem)
    return problem.controller


def with_structured(problem: "CoDesignProblem", **changes: object) -> "CoDesignProblem":
    """Change fields of a problem's `StructuredProblem`.

    Parameters
    ----------
    problem : CoDesignProblem
    changes
        Fields by name.

    Returns
    -------
    CoDesignProblem
    """
    return replace(problem, controller=replace(structured_of(problem), **changes))  # type: ignore[arg-type]
