"""The tables of a case file as frozen dataclasses; each key carries its check and a sentence.

Units are those of the file (Hz where a name says so).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

from ccd_casadi.cases import checks, controller_tables
from ccd_casadi.cases.checks import key
from ccd_casadi.cases.controller_tables import MotorTable, MoveTable
from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.support.terminal import NotebookHtml
from ccd_casadi.support.user_code import name_of

Spectra = tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class PlantTable:
    """[plant]: a model's name or function = "file.py:name"; all other keys are its options.

    In a program the function may be a Python callable.
    """

    model: str | None
    function: str | Callable[..., Any] | None
    options: Mapping[str, Any]

    @property
    def name(self) -> str:
        """The name of the model, or of the function."""
        return self.model or name_of(self.function)


@dataclass(frozen=True)
class Parameter:
    """[theta.NAME]: one hardware parameter.

    Attributes
    ----------
    name : str
    lower, upper, start : float
        Bounds, and where searches start, in `unit`.
    unit : str
    values : tuple of float
        The values that it may have, rising; empty: all between the bounds. With one value it is
        fixed, and not part of θ.
    varies : bool
        It is not part of θ either: the design holds between its bounds.
    """

    name: str
    lower: float
    upper: float
    start: float
    unit: str
    values: tuple[float, ...] = ()
    varies: bool = False

    def fixed_at(self, value: float) -> "Parameter":
        """The same at one value."""
        return replace(self, lower=value, upper=value, start=value, values=(value,))

    @property
    def table(self) -> dict[str, Any]:
        """The table of a case file that states it."""
        if len(self.values) == 1:
            return {"fixed": self.start, "unit": self.unit}
        if self.values:
            return {"values": self.values, "start": self.start, "unit": self.unit}
        found = {"lower": self.lower, "upper": self.upper, "start": self.start, "unit": self.unit}
        return found | {"varies": True} if self.varies else found


@dataclass(frozen=True)
class ObjectiveTable:
    """[objective] J = w1 f(θ) + w2 ω_b, ω_b in rad/s; else w2 e, e in m, or w2 t, t in s."""

    w1: float = key(
        "weight of the hardware cost f(θ) in J",
        check=checks.number(0.0, math.inf, "give 0 or more: J is minimised", closed=True),
    )
    w2: float = key(
        "weight of the bandwidth in J, negative, 1/(rad/s); of an RMS error or a move's time "
        "positive, 1/m or 1/s",
        check=checks.signed("give a negative number: J must reward bandwidth"),
    )
    cost_unit: str = key("unit of the hardware cost f(θ), for tables and pages", "")


@dataclass(frozen=True)
class WeightsTable:
    """[weights] of the paper's Table 1; M_K in force over displacement."""

    M_S: float = key(
        "W_S at high frequency is 1/M_S: the peak of S that the weight allows", idle=2.0
    )
    A_S: float = key(
        "W_S at zero frequency is 1/A_S: the S that the weight allows there",
        check=checks.FRACTION, idle=1e-4,
    )  # fmt: skip
    c_K: float = key("W_KS grows by this factor above omega_K", check=checks.ABOVE_ONE, idle=1e4)
    omega_K_hz: float = key("W_KS is 1/M_K below this frequency and grows above it", idle=100.0)
    M_K: float = key(  # idle: by the plant, in `problem_of`
        "gain of the controller that W_KS allows: about mass times (2π ω_b)²", unit="N/m",
        idle=math.nan,
    )  # fmt: skip
    A_l: float = key("W_T at zero frequency is 1/A_l", idle=1.0)
    A_u: float = key(
        "W_T at high frequency is 1/A_u: the T that the weight allows there",
        check=checks.FRACTION, idle=1e-2,
    )  # fmt: skip
    disturbance: float | None = key(
        '"h_infinity_disturbance": force that weighs as 1 m of reference; default 10 M_K',
        None,
        unit="N/m",
    )


@dataclass(frozen=True)
class InnerTable:
    """[inner]: constraints on S, the box of the weights' frequencies, and how it is searched."""

    S_max: float = key(
        "bound of the peak of S, as a ratio: 2 is 6 dB",
        check=checks.number(
            1.0,
            math.inf,
            "give more than 1 and less than infinity: a peak of S below 1 contradicts Bode's "
            "integral",
        ),
    )
    S_low: float = key("bound of |S| at omega_low", check=checks.FRACTION)
    omega_low_hz: float = key("where S_low holds")
    omega_S_hz: tuple[float, float] = key(
        "searched range of the frequency of W_S", check=checks.interval, idle=(1e-3, 1e6)
    )
    omega_T_hz: tuple[float, float] = key(
        "searched range of the frequency of W_T; sections: the lower end is that of W_T",
        check=checks.interval,
        idle=(1e-3, 1e6),
    )
    gamma_backoff: float = key(
        "controllers are synthesised at this multiple of γ_opt",
        1.02,
        check=checks.number(1.0, 10.0, "give a number above 1 and below 10, such as 1.02"),
    )
    sweep_points: tuple[int, int] = key(
        'grid of (omega_S, omega_T) for method "sweep", as in the paper',
        (20, 20),
        check=checks.points,
    )
    method: str = key(
        "how the best weights are found", "search", check=checks.choice("search", "sweep")
    )
    shape: float | None = key(
        "sections: |S| stays below (ω/ω_b)/√2 up to ω_b, this times that far above; absent: 1.1",
        None,
        check=checks.number(1.0, 10.0, "give 1 to 10", closed=True),
    )
    shape_ends: str = key(
        "sections: the shape holds up to S_max, or up to ω_b only",
        ShapeEnd.S_MAX.value,
        check=checks.choice(*ShapeEnd),
    )
    compliance_max: float | None = key(
        "bound of the peak of GS, the displacement by a force at any frequency; of |z/d| where "
        "the plant has disturbance or performance",
        None,
        unit="m/N",
    )
    minimise: str = key(
        "sections: what is minimised instead of the negative bandwidth",
        "bandwidth",
        check=checks.choice("bandwidth", "rms_error", "move_time"),
    )
    bandwidth_least_hz: float | None = key(
        'least bandwidth, where minimise is not "bandwidth"', None
    )


@dataclass(frozen=True)
class SuspensionTable:
    """[suspension]: where a mixed synthesis puts rigid-body poles, and how many there must be."""

    frequency_hz: float | None = key(
        "soft suspension of free bodies in a mixed synthesis; absent: a tenth of omega_low_hz, "
        "at most 0.1 Hz",
        None,
    )
    damping_ratio: float = key("of these poles", 0.7)
    rigid_modes: int | None = key("required number of rigid-body modes; absent: any number", None)
    undamped: float = key(
        "damping ratio that modes lose in a mixed synthesis if one is undamped",
        1e-3,
        check=checks.number(1e-7, 0.1, "give a damping ratio between 1e-7 and 0.1"),
    )


@dataclass(frozen=True)
class RobustTable:
    """[robust]: plants on which the loop has to be stable and ‖S‖∞ within S_max; off by default.

    `resonance_shift` s: flexible frequencies at `shifts` places from -s to +s (relative), each with
    damping times 1 and every factor of `damping`. `design_at`: which end of that range, or its
    middle, the controller is synthesised for; "auto" tries all three and keeps the best.

    With sections the box between these ends counts, searched for its worst plants, and besides:
    `mode_shift` of each flexible mode on its own, `gain` of the whole plant, `plants`: options of
    other plants (loads, positions), in TOML files or tables; as tables once it is read.
    """

    resonance_shift: float = key(
        "largest common shift of flexible frequencies, as a share",
        0.0,
        check=checks.number(0.0, 0.5, "give a share of the frequency, 0 to 0.5", closed=True),
    )
    shifts: int = key(
        "number of plants over that range (full-order kinds)", 5, check=checks.count(2)
    )
    damping: tuple[float, ...] = key(
        "factors of every modal damping, besides 1", (), check=checks.factors
    )
    design_at: str = key(
        'plant that a full-order controller is made for; "auto" tries all',
        "auto",
        check=checks.choice("auto", "low", "nominal", "high"),
    )
    mode_shift: float = key(
        "sections: largest shift of each flexible mode by itself, as a share",
        0.0,
        check=checks.number(0.0, 0.5, "give a share of the frequency, 0 to 0.5", closed=True),
    )
    gain: float = key(
        "sections: largest error of what u moves, as a share",
        0.0,
        check=checks.number(0.0, 0.9, "give a share of the gain, 0 to 0.9", closed=True),
    )
    plants: tuple[Any, ...] = key(
        "sections: options of other plants, in TOML files or tables", (), check=checks.plant_options
    )
    share: float | None = key(
        "sections: share of machines that keep every bound (`ccd tolerances`); absent: the box",
        None,
        check=checks.FRACTION,
    )
    confidence: float = key("sections: of that share", 0.99, check=checks.FRACTION)
    distribution: Mapping[str, str] | None = key(
        "sections: uniform or normal, by name of a tolerance, for share; absent: uniform",
        None,
        check=checks.by_name(checks.choice("uniform", "normal")),
    )
    cost_per_percent: Mapping[str, float] | None = key(
        "sections: by name, what f rises by for each percent less of half-width (`ccd tolerances`)",
        None,
        check=checks.by_name(checks.POSITIVE),
    )
    half_width: Mapping[str, Any] | None = key(
        "sections: by name, least and largest for cost_per_percent; absent: 0.25 to 2 times",
        None,
        check=checks.by_name(checks.interval),
    )

    @property
    def share_words(self) -> str:
        """The share that a design is for, in words; empty for the whole box."""
        if self.share is None:
            return ""
        sure = f"{100.0 * self.confidence:g} % confidence"
        return f"for a share of {100.0 * self.share:g} % of machines at {sure}"


@dataclass(frozen=True)
class PlacesTable:
    """[places]: forces and sensors between the nodes of a plant, see `plants.places`; m and kg.

    A coordinate is a number, the name of a [theta], or that name after a minus sign.
    """

    nodes: str | tuple[tuple[float, ...], ...] = key(
        "places of the plant's inputs, in their order: a CSV file with a header, or rows of "
        "coordinates",
        (),
        check=checks.text_or_rows,
        unit="m",
    )
    actuators: tuple[tuple[float | str, ...], ...] = key(
        "coordinates of each force: numbers, or names of [theta]", (), check=checks.places, unit="m"
    )
    sensors: tuple[tuple[float | str, ...], ...] = key(
        "coordinates of each sensor; absent, without axes: the plant's own outputs",
        (),
        check=checks.places,
        unit="m",
    )
    actuator_mass: float = key("moves with each force", 0.0, check=checks.NOT_NEGATIVE, unit="kg")
    sensor_mass: float = key("moves with each sensor", 0.0, check=checks.NOT_NEGATIVE, unit="kg")
    apart: float = key(
        "least distance of two forces, and of two sensors", 0.0, check=checks.NOT_NEGATIVE, unit="m"
    )
    axes: bool = key(
        "true: forces and sensors act together along the motions of a rigid body normal to the "
        "nodes",
        False,
    )
    quiet: tuple[int, ...] = key(
        "with axes: flexible modes, from 1, that these leave alone",
        (),
        check=checks.numbers_of_modes,
    )
    damped: tuple[int, ...] = key(
        "with axes: flexible modes, from 1, each with its own axis",
        (),
        check=checks.numbers_of_modes,
    )
    reference: tuple[tuple[float, ...], ...] = key(
        "3 or (with twist) 4 points of a plane: inputs are loads, outputs displacements there",
        (),
        check=checks.rows(2),
        unit="m",
    )
    present: tuple[str, ...] = key(
        "with either: a [theta] for each actuator, 1 where it is there, else 0",
        (),
        check=checks.names_of_theta,
    )
    choose: int = key("how many of these are there at most", 0)
    actuator_cost: float = key(
        "hardware cost of each force that is there, in its unit", 0.0, check=checks.NOT_NEGATIVE
    )


@dataclass(frozen=True)
class BudgetTable:
    """[budget]: what moves the stage, by where it enters, and the window of MA and MSD in ms.

    Each kind is one table or several of them; their keys are checked in `budget`.
    """

    window_ms: float | None = key("window of the moving average and the moving deviation", None)
    force: Spectra = key("spectra of forces on the stage", (), check=checks.tables)
    floor_motion: Spectra = key("spectra of the floor's motion", (), check=checks.tables)
    sensor_noise: Spectra = key("spectra of the sensor's noise", (), check=checks.tables)
    setpoint: Spectra = key("spectra of the setpoint", (), check=checks.tables)


@dataclass(frozen=True)
class UnitsTable:
    """[units]: what the plant's outputs and inputs are, in words; numbers are in SI either way."""

    output: str = key("of every output", "m", check=checks.choice("m", "rad"))
    input: str = key("of every input", "N", check=checks.choice("N", "N m", "V", "A"))


@dataclass(frozen=True)
class Case(NotebookHtml):
    """A checked case file.

    Attributes
    ----------
    path : Path
    plant : PlantTable
    theta, fixed : tuples of Parameter
        Searched parameters; fixed ones and those that vary.
    objective, weights, inner, suspension, places, robust, controller, loop, drive : tables
    actuator, sensor, budget : tables
    sampling, outer, baseline, limits, motor, move, units : tables
        Of the same names, in units of the file.
    """

    path: Path
    plant: PlantTable
    theta: tuple[Parameter, ...]
    objective: ObjectiveTable
    weights: WeightsTable
    inner: InnerTable
    suspension: SuspensionTable
    places: PlacesTable
    robust: RobustTable
    controller: controller_tables.ControllerTable
    loop: controller_tables.LoopTable
    drive: controller_tables.DriveTable
    actuator: controller_tables.FiltersTable
    sensor: controller_tables.FiltersTable
    budget: BudgetTable
    sampling: controller_tables.SamplingTable
    outer: controller_tables.OuterTable
    baseline: controller_tables.BaselineTable
    limits: controller_tables.LimitsTable
    motor: MotorTable
    move: MoveTable
    units: UnitsTable
    fixed: tuple[Parameter, ...] = ()


TABLES: dict[str, type] = {
    name: kind
    for name, kind in get_type_hints(Case).items()
    if isinstance(kind, type) and is_dataclass(kind) and kind is not PlantTable
}
REQUIRED = tuple(  # tables with a key that has no default
    name for name, kind in TABLES.items() if MISSING in [item.default for item in fields(kind)]
)
