"""Plants and controllers as `control.StateSpace` and as .mat files, both ways.

Conventions, the same in both: SI, time in s; the plant takes forces u1, u2, … (N) to
displacements y1, y2, … (m), the controller errors e1, e2, … = r - y (m) to the same forces.
Closing the loop takes one minus sign: in python-control `control.feedback(G * K, I)`, in MATLAB
`feedback(G*K, eye(p))`.

A .mat file is MATLAB's version 5 (`load`, `scipy.io.loadmat`): one struct a system with A, B, C, D,
Ts (s, 0 for continuous time), InputName, OutputName, InputUnit, OutputUnit, and theta,
theta_names, theta_units. `ss(K.A, K.B, K.C, K.D, K.Ts)` makes it a system.

A transfer function becomes a state space that is compared with it, response and poles.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from scipy.linalg import block_diag

from ccd_casadi.lti.state_space import StateSpace, balance_system
from ccd_casadi.plants.scaling import ScaledPlant, scale_state_space
from ccd_casadi.plants.table_columns import refuse_polynomials
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import mat_variables
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis.matlab_systems import (
    HINT,
    PARTS,
    appears_discrete,
    strings,
    system_of,
    systems_in,
)

if TYPE_CHECKING:
    import control  # a second to import: where it is called, and not before


@dataclass(frozen=True)
class RealisationOptions:
    """Numbers by which a realisation is compared with its polynomials."""

    beside: float = 1.01  # frequency over that of a root, and below, where responses are compared
    beyond: float = 30.0  # of the outermost roots: ends of the grid
    points: int = 200  # of the grid
    numerator_error: float = 1e-6  # relative, of coefficients: what is allowed
    denominator_error: float = 1e-9
    unstable: float = 1e-4  # Re p over |p| that counts
    at_rest: float = 1e-6  # |p| over the largest that is 0


def realise(system: "control.TransferFunction") -> StateSpace:
    """A state space with this response and its poles. Raises UserError where there is none."""
    import control

    num, den = _polynomials(system)
    if any(len(n) > len(d) for n, d in zip(num.flat, den.flat, strict=True)):
        raise UserError("the system has no state space: more zeros than poles; make it proper")
    period = float(system.dt or 0.0)

    def by_library() -> StateSpace:
        space = control.ss(system)
        return StateSpace(space.A, space.B, space.C, space.D, period=period)

    ways: list[Callable[[], StateSpace]] = [by_library, lambda: _by_columns(num, den, period)]
    for way in ways if num.size > 1 else ways[1:]:
        try:
            found = way()
        except (ValueError, np.linalg.LinAlgError, control.ControlMIMONotImplemented):
            continue
        if _same(num, den, found):
            return found
    words = "no state space has its response and poles to six digits"
    raise UserError(f"the transfer function is lost in conversion: {words}; give A, B, C, D")


def _polynomials(system: "control.TransferFunction") -> tuple[np.ndarray, np.ndarray]:
    """Numerators and denominators (p, m) of object, without leading zeros, denominators monic."""
    p, m = system.noutputs, system.ninputs
    num, den = np.empty((p, m), object), np.empty((p, m), object)
    for i, j in np.ndindex(p, m):
        n, d = (np.asarray(part[i][j], float) for part in (system.num, system.den))
        if not (np.isfinite(n).all() and np.isfinite(d).all()):
            raise UserError("a coefficient of the transfer function is not a finite number")
        d = np.trim_zeros(d, "f")
        num[i, j], den[i, j] = np.trim_zeros(n, "f") / d[0], d / d[0]
    return num, den


def _by_columns(num: np.ndarray, den: np.ndarray, period: float) -> StateSpace:
    """Realise in controllable companion form, one for each denominator of a column, balanced."""
    p, m = num.shape
    blocks, drive, reading, D = [], [], [], np.zeros((p, m))
    for j in range(m):
        alike: dict[tuple[float, ...], list[int]] = {}
        for i in range(p):
            alike.setdefault(tuple(den[i, j]), []).append(i)
        for d, rows in alike.items():
            n = len(d) - 1
            C = np.zeros((p, n))
            for i in rows:
                full = np.concatenate([np.zeros(n + 1 - len(num[i, j])), num[i, j]])
                D[i, j] = full[0]
                C[i] = full[1:] - full[0] * np.array(d[1:])
            A, B = np.eye(n, k=-1), np.zeros((n, m))
            if n:
                A[0], B[0, j] = -np.array(d[1:]), 1.0
            A, B, C = balance_system(A, B, C) if n else (A, B, C)
            blocks.append(A)
            drive.append(B)
            reading.append(C)
    A = block_diag(*blocks)[: sum(map(len, blocks))]
    return StateSpace(A, np.vstack(drive), np.hstack(reading), D, period=period)


def _same(
    num: np.ndarray,
    den: np.ndarray,
    found: StateSpace,
    options: RealisationOptions = RealisationOptions(),
) -> bool:
    """Whether response and poles are those of the polynomials."""
    if not all(np.isfinite(part).all() for part in (found.A, found.B, found.C, found.D)):
        return False
    each = [np.roots(d) for d in den.flat]
    unstable = [_unstable(poles, found.period, options) for poles in each]
    own = _unstable(found.poles, found.period, options)
    if num.size == 1:
        if len(found.A) != len(each[0]) or own != unstable[0]:
            return False
    elif not max(unstable) <= own <= sum(unstable):
        return False
    roots = np.concatenate([*each, *(np.roots(n) for n in num.flat)])
    omega = _frequencies(found.rates_of(roots), found.period, options)
    s = found.variable(omega)
    response = found.response(omega)
    for (i, j), n in np.ndenumerate(num):
        d = den[i, j]
        below, above = np.polyval(d, s), np.polyval(n, s)
        size, spread = np.abs(below), np.polyval(np.abs(d), np.abs(s))
        allowed = options.numerator_error * np.polyval(np.abs(n), np.abs(s))
        allowed += options.denominator_error * np.abs(above) * spread / size
        allowed = allowed / size
        if not (np.abs(response[:, i, j] - above / below) <= allowed).all():
            return False
    return True


def _unstable(poles: np.ndarray, period: float, options: RealisationOptions) -> int:
    if period:
        return int((np.abs(poles) > 1.0 + options.unstable).sum())
    away = np.abs(poles) > options.at_rest * np.abs(poles).max(initial=0.0)
    return int((away & (poles.real > options.unstable * np.abs(poles))).sum())


def _frequencies(rates: np.ndarray, period: float, options: RealisationOptions) -> Array:
    """About every root, and in between, in rad/s."""
    size = np.abs(rates)[np.abs(rates) > 0.0]
    size = np.append(size, [1.0 / period] if period else [] if len(size) else [1.0])
    top = size.max() * options.beyond
    grid = np.geomspace(size.min() / options.beyond, top, options.points)
    omega = np.concatenate([grid, size * options.beside, size / options.beside])
    return np.unique(omega[omega <= (0.999 * np.pi / period if period else top)])


@dataclass(frozen=True)
class NamedSystem:
    """A state space with named signals; `delay` in s before it, `words`: how it was understood."""

    system: StateSpace
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_unit: str
    output_unit: str
    delay: float = 0.0
    words: str = ""


@dataclass(frozen=True)
class DesignFile:
    """The content of a .mat file.

    Attributes
    ----------
    systems : mapping of NamedSystem
        By the names of variables.
    theta, units : mapping
        θ by name in SI, and its units.
    """

    systems: Mapping[str, NamedSystem]
    theta: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


def named_plant(plant: StateSpace) -> NamedSystem:
    """Name the signals of a plant: forces u1, … in N to displacements y1, … in m.

    Parameters
    ----------
    plant : StateSpace
        SI.

    Returns
    -------
    NamedSystem
        The same matrices.
    """
    inputs, outputs = _names("u", plant.B.shape[1]), _names("y", plant.C.shape[0])
    return NamedSystem(plant, inputs, outputs, "N", "m")


def named_controller(controller: StateSpace) -> NamedSystem:
    """Name the signals of a controller: errors e1, … = r - y in m to forces u1, … in N.

    Parameters
    ----------
    controller : StateSpace
        SI.

    Returns
    -------
    NamedSystem
        The same matrices.
    """
    inputs, outputs = _names("e", controller.B.shape[1]), _names("u", controller.C.shape[0])
    return NamedSystem(controller, inputs, outputs, "m", "N")


def to_control(named: NamedSystem, name: str = "") -> "control.StateSpace":
    """The same matrices as `control.StateSpace`.

    Parameters
    ----------
    named : NamedSystem
        With its signals.
    name : str
        Of the system.

    Returns
    -------
    control.StateSpace
        Signals named, dt = period in s.
    """
    import control

    parts = [getattr(named.system, part).copy() for part in PARTS]
    return control.ss(
        *parts, named.system.period, inputs=list(named.inputs), outputs=list(named.outputs),
        name=name or None, remove_useless_states=False,
    )  # fmt: skip


def from_control(system: Any) -> StateSpace:
    """A state space of a `control` system.

    Parameters
    ----------
    system : control.StateSpace or control.TransferFunction
        Its dt is 0, None, or a period in s.

    Returns
    -------
    StateSpace
        With the same response.

    Raises
    ------
    UserError
        It is not a linear system, is discrete without a sampling period, or has no state space that
        is the same plant.
    """
    import control

    if not isinstance(system, control.StateSpace | control.TransferFunction):
        words = "is not a control.StateSpace or TransferFunction; convert it with control.ss"
        raise UserError(f"{type(system).__name__}: {words}")
    if system.dt is True:
        raise UserError("the system is in discrete time without a period; give it a dt in s")
    if isinstance(system, control.TransferFunction):
        return realise(system)
    parts = [np.array(getattr(system, part)) for part in PARTS]
    if any(np.iscomplexobj(part) or not np.isfinite(part).all() for part in parts):
        raise UserError("the state space has an entry that is not a finite real number")
    if system.dt is None and appears_discrete(parts[0]):
        raise UserError(f"dt is None, and {HINT}; give dt in s, or 0 of a continuous system")
    return StateSpace(*(part.astype(float) for part in parts), period=float(system.dt or 0.0))


@one_blas_thread
def plant_from_control(system: Any, M_K: float) -> ScaledPlant:
    """A plant of python-control, ready for synthesis.

    Parameters
    ----------
    system : control.StateSpace or control.TransferFunction
        In continuous time, force (N) to displacement (m).
    M_K : float
        Of the weights, N/m.

    Returns
    -------
    ScaledPlant
        What `synthesise` takes.

    Raises
    ------
    UserError
        The system is in discrete time.
    PlantError
        It cannot be a plant.

    Examples
    --------
    >>> import control
    >>> plant = plant_from_control(control.tf([1.0], [2.0, 40.0, 8e4]), M_K=1e5)
    >>> round(float(plant.natural[0]), 6), plant.A.shape  # rad/s
    (200.0, (2, 2))
    """
    space = from_control(system)
    if space.period:
        raise UserError("the plant is in discrete time; give the continuous one")
    return scale_state_space(space, M_K)


def write_mat(path: Path, design: DesignFile) -> None:
    """Write systems and θ as MATLAB version 5.

    Parameters
    ----------
    path : Path
        Of the .mat file.
    design : DesignFile
        Names of systems are variables of MATLAB.

    Raises
    ------
    UserError
        A name is not one for MATLAB, or the file cannot be written.
    """
    content: dict[str, Any] = {}
    for name, named in design.systems.items():
        if not (name.isidentifier() and name.isascii() and len(name) <= 63):  # as MATLAB
            raise UserError(f"{path}: {name!r} is not a name for a variable in MATLAB")
        content[name] = {
            **{part: getattr(named.system, part) for part in PARTS},
            "Ts": named.system.period,
            "InputName": _cells(named.inputs),
            "OutputName": _cells(named.outputs),
            "InputUnit": named.input_unit,
            "OutputUnit": named.output_unit,
        }
    names = list(design.theta)
    content["theta"] = np.array([design.theta[name] for name in names]).reshape(-1, 1)
    content["theta_names"] = _cells(names)
    content["theta_units"] = _cells([design.units.get(name, "") for name in names])
    try:
        scipy.io.savemat(path, content, format="5", oned_as="column", long_field_names=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def read_mat(path: Path) -> DesignFile:
    """Every struct with A, B, C, D in a .mat file, ours or another's, and θ where it is there.

    A file with the matrices themselves is one system without a name. Names and units may be
    missing: they are then u1, …; Ts defaults to 0. Nothing in the file is executed. Raises
    UserError naming file and variable where something is missing or damaged.
    """
    content = mat_variables(path)
    systems = {name: _named(path, name, fields) for name, fields in systems_in(path, content)}
    if not systems:
        structs = (value.dtype.names for value in content.values() if isinstance(value, np.ndarray))
        for group in (content, *filter(None, structs)):
            refuse_polynomials(path, group)
        words = "holds no struct with A, B, C, D, nor f_hz and G of a response"
        raise UserError(f"{path}: {words}; save one for each system")
    names = strings(content.get("theta_names"))
    values = np.asarray(content.get("theta", np.zeros(0))).ravel()
    units = strings(content.get("theta_units"))
    if len(names) != len(values) or values.dtype.kind not in "fiu":
        raise UserError(f"{path}: theta: is not one number for each of theta_names")
    theta = {name: float(value) for name, value in zip(names, values, strict=True)}
    return DesignFile(systems, theta, dict(zip(names, units, strict=False)))


def _named(path: Path, name: str, fields: Mapping[str, Any]) -> NamedSystem:
    found = system_of(path, name, fields)
    signals = ("InputName", "OutputName", "InputUnit", "OutputUnit")
    inputs, outputs, input_unit, output_unit = (strings(fields.get(key)) for key in signals)
    m, p = found.system.B.shape[1], len(found.system.C)
    return NamedSystem(
        found.system,
        inputs if len(inputs) == m else _names("u", m),
        outputs if len(outputs) == p else _names("y", p),
        " ".join(input_unit),
        " ".join(output_unit),
        found.delay,
        found.words,
    )


def _cells(texts: Sequence[str]) -> np.ndarray:
    """A MATLAB cell column of texts."""
    cells = np.empty((len(texts), 1), dtype=object)
    cells[:, 0] = list(texts)
    return cells


def _names(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i + 1}" for i in range(count))
