"""What a co-design problem states of its controller, and what of it J counts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ccd_casadi.analysis import Loads
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.plant import Plant
from ccd_casadi.support.text import HZ, spoken, with_unit
from ccd_casadi.synthesis.weights import Weights

if TYPE_CHECKING:
    from ccd_casadi.budget.sources import ErrorBudget


@dataclass(frozen=True)
class FigureOfMerit:
    """A figure v of a controller that the outer problem counts, and how it is shown.

    Attributes
    ----------
    key, words, symbol : str
        What a case names it by (`minimise`); its name in words; its symbol in formulas.
    si_unit, unit, factor : str, str, float
        v is in `si_unit`, v times `factor` in `unit`, which is shown.
    larger_is_better : bool
    entry : str
        Its stem in the keys of result.json.
    """

    key: str
    words: str
    symbol: str
    si_unit: str
    unit: str
    factor: float
    larger_is_better: bool
    entry: str

    def gain(self, value: float, reference: float) -> float:
        """Compute by how much (relative) a value is better than a reference; negative where it is
        worse."""
        better, worse = (value, reference) if self.larger_is_better else (reference, value)
        return better / worse - 1.0

    def format_value(self, value: float, digits: int = 4) -> str:
        """The value with its unit, a length or a time with the prefix that its size needs.

        >>> RMS_ERROR.format_value(12.3456e-9)
        '12.35 nm'
        """
        if self is BANDWIDTH:  # in Hz without a prefix, as everywhere
            return f"{self.factor * value:.{digits}g} {self.unit}"
        return with_unit(value, spoken(self.si_unit), digits)


BANDWIDTH = FigureOfMerit(
    "bandwidth", "bandwidth", "ω_b", "rad/s", "Hz", 1.0 / HZ, True, "bandwidth"
)
RMS_ERROR = FigureOfMerit("rms_error", "RMS error", "e", "m", "nm", 1e9, False, "error_rms")
MOVE_TIME = FigureOfMerit("move_time", "move time", "t", "s", "ms", 1e3, False, "move_time")
FIGURES = {figure.key: figure for figure in (BANDWIDTH, RMS_ERROR, MOVE_TIME)}


Options = tuple[tuple[str, object], ...]  # of a plant: (name, value), sorted by name


@dataclass(frozen=True)
class ControllerProblem:
    """The statement of the controller in a problem; the base of all kinds.

    What a kind does not override is that of a continuous controller of largest bandwidth, on the
    plant of the case alone.

    Attributes
    ----------
    kernels : tuple of str
        Groups of compiled kernels that its searches need.
    """

    kernels: ClassVar[tuple[str, ...]] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of a result must know of it, in sentences."""
        return ()

    @property
    def figure(self) -> FigureOfMerit:
        """The figure of the controller that J counts."""
        return BANDWIDTH

    @property
    def sampling(self) -> Sampling | None:
        """Rate and delay that the controller is designed for; None: continuous."""
        return None

    @property
    def bandwidth_least(self) -> float:
        """The bandwidth below which no design counts, rad/s."""
        return 0.0

    @property
    def plant_options(self) -> tuple[Options, ...]:
        """Further option sets of the plant that the controller is for."""
        return ()

    def loads_with(self, held: Mapping[str, float]) -> Loads:
        """Return what motors move beside the model, given the values of fixed parameters."""
        return Loads()

    def require_plants(self, plants: Sequence[Plant]) -> None:
        """Raise PlantError unless such a controller can be designed for each of the plants."""

    def identity_with(self, weights: Weights, budget: "ErrorBudget | None") -> dict[str, Any]:
        """Return what else determines a design, given the weights and the budget of its problem."""
        return {}


@dataclass(frozen=True)
class MixedSensitivityProblem(ControllerProblem):
    """An H∞ controller by the weights W_S, W_KS and W_T, which the problem itself states.

    Attributes
    ----------
    kernels : tuple of str
        Groups of compiled kernels that its searches need.
    """

    kernels: ClassVar[tuple[str, ...]] = ("synthesis",)


@dataclass(frozen=True)
class RobustSet:
    """Plants on which the loop has to be stable and ‖S‖∞ within S_max.

    Attributes
    ----------
    shift, shifts : float, int
        Frequencies of the flexible modes are multiplied by 1 + s, `shifts` values of s evenly over
        ±`shift`; both are in the set, so that `shifts` is 2 or more, or 1 where `shift` is 0.
    damping : tuple of float
        With every s damping is multiplied by 1 and by each of these factors.
    design_shift : float or None
        s of the plant that the controller is designed on; None: both ends and the middle are tried
        (`design_choices`).
    """

    shift: float
    shifts: int
    damping: tuple[float, ...]
    design_shift: float | None

    def perturbations(self, shifts: int | None = None) -> tuple[Perturbation, ...]:
        """The set, (s, factor of damping) each; with `shifts` values of s for a denser one."""
        values = np.linspace(-self.shift, self.shift, self.shifts if shifts is None else shifts)
        factors = sorted({1.0, *self.damping})
        return tuple(Perturbation(float(s), z) for s in values for z in factors)

    @property
    def design_at(self) -> str:
        """The plant that the controller is made on: "auto", "low", "nominal" or "high"."""
        if self.design_shift is None:
            return "auto"
        return ("low", "nominal", "high")[1 + int(np.sign(self.design_shift))]

    def scale(self, share: float) -> "RobustSet":
        """The set that reaches a share, above 0, of this one's way from the model alone: s and the
        logarithm of a factor of damping are in proportion to it."""
        design = None if self.design_shift is None else share * self.design_shift
        damping = tuple(factor**share for factor in self.damping)
        return RobustSet(share * self.shift, self.shifts, damping, design)
