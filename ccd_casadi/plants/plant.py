"""The plant M(θ)ẍ + D(θ)ẋ + K(θ)x = B(θ)u, y = C(θ)x as CasADi expressions of θ.

A model is a function of theta (a mapping of names to floats or CasADi symbols) and keyword
options; it returns a mapping with `mass`, `stiffness`, `input`, `output`, one of `damping` or
`damping_ratio` (or `A`, `B`, `C` of first order in their place), `hardware_cost` and optionally
`constraints` (name to scalar, met where <= 0), `disturbance` (where other forces act) and
`performance` (where the error counts).
(Paper, equations (1) and (2).)
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.drawing.content import Figure
from ccd_casadi.drawing.svg import ModeShapes
from ccd_casadi.lti.wiring import UNWIRED, Wiring
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.user_code import raised_in_user_code

ModelFunction = Callable[..., Mapping[str, Any]]
Evaluate = Callable[[Sequence[float]], "Mechanics"]

_REQUIRED = ("mass", "stiffness", "input", "output", "hardware_cost")
MATRICES = ("mass", "damping", "stiffness", "input", "output")
PORTS = {"disturbance": "input", "performance": "output"}  # optional, and what they stand beside
FIRST_ORDER = ("A", "B", "C", "D")
_KNOWN = {*_REQUIRED, *PORTS, "damping", "damping_ratio", "constraints"}


@dataclass(frozen=True)
class PlantOptions:
    """Sizes beyond which a plant is refused.

    Attributes
    ----------
    most_coordinates : int
        Rows of M: matrices are dense, and the time of a synthesis grows with the cube.
    most_channels : int
        Inputs, and outputs.
    largest_entry : float
        Of any matrix or derivative, SI: its square is still a double.
    """

    most_coordinates: int = 1000
    most_channels: int = 100
    largest_entry: float = 1e100


@dataclass(frozen=True)
class Mechanics:
    """M, D, K, B, C at one θ in SI, with their derivatives to θ.

    Attributes
    ----------
    M, D, K : arrays (n, n)
        Mass, damping and stiffness.
    B, C : arrays (n, m), (p, n)
        Input and output.
    damping_ratio : float or None
        Modal damping ratio of every flexible mode, from which D is made later; D is then zero.
    derivatives : tuple of arrays
        ∂M, ∂D, ∂K, ∂B, ∂C with a leading axis over θ.
    wiring : Wiring
        What lies before the forces and behind the sensors.
    """

    M: Array
    D: Array
    K: Array
    B: Array
    C: Array
    damping_ratio: float | None
    derivatives: tuple[Array, Array, Array, Array, Array]
    wiring: Wiring = UNWIRED

    @property
    def matrices(self) -> tuple[Array, Array, Array, Array, Array]:
        """M, D, K, B, C."""
        return self.M, self.D, self.K, self.B, self.C

    @property
    def first_order(self) -> bool:
        """Whether its function returned A, B, C: M = 0, D = 1, K = -A."""
        return not self.M.any() and np.array_equal(self.D, np.eye(len(self.D)))

    def with_mass(self, what: str) -> "Mechanics":
        """The same. Raises PlantError of first order, where `what` needs mass and stiffness."""
        if self.first_order:
            words = f"{what} needs a plant function that returns mass, damping and stiffness"
            raise PlantError(f"{words}, not A, B and C; return these, or leave it out")
        return self


def to_first_order(system: Mechanics, step: Array) -> Mechanics:
    """Extrapolate a plant's matrices by their derivatives, which are kept.

    Parameters
    ----------
    system : Mechanics
        At θ.
    step : array (k,)
        Change of θ.

    Returns
    -------
    Mechanics
        At θ + step, to first order.
    """
    pairs = zip(system.matrices, system.derivatives, strict=True)
    M, D, K, B, C = (matrix + np.tensordot(step, slopes, 1) for matrix, slopes in pairs)
    return replace(system, M=M, D=D, K=K, B=B, C=C)


@dataclass(frozen=True)
class Plant:
    """A plant model bound to its parameters, as the design loop uses it.

        M(θ) q̈ + D(θ) q̇ + K(θ) q = B(θ) u,   y = C(θ) q

    Parameters
    ----------
    names, constraint_names : tuple of str
        Of θ (n,) and of λ (m,).
    evaluate : callable
        θ in SI -> M, D, K, B, C with derivatives, from CasADi or from finite elements.
    hardware : casadi.Function
        θ -> f, λ.
    outputs, inputs : int
        Rows of C, columns of B.
    references : mapping
        The same plant modelled more closely, by name, without derivatives: a design is certified on
        them again, not optimised.
    exact_hessian : bool
        Whether second derivatives of `hardware` are cheap enough to be taken.
    values : callable, optional
        `evaluate` without derivatives where that is cheaper.
    notes, doubt : callable
        θ -> what a reader of a result there must know; what is wrong with the derivatives, else "".
    mismatch : callable
        θ -> how the matrices there differ from those that the function returns, else "".
    domain : tuple of two arrays (n,), optional
        Bounds of θ beyond which the plant is not known.
    unknown_between : str
        Why the plant is known at samples of θ alone, where that is so.
    expensive : bool
        Whether the plant at another θ takes as long as a search for its controller, as finite
        elements do: searches then save plants, not controllers.
    nearby : callable, optional
        Known θ -> a cheaper `evaluate`, true there and nearly so beside them.
    shapes, drawing : callable, optional
        (θ, count) -> the lowest flexible modes for pictures; several θ by name -> a drawing.
    ports : tuple of str
        Of `PORTS` those that the model returns.
    callback : object
        What `hardware` calls, to which CasADi holds no reference.
    """

    names: tuple[str, ...]
    constraint_names: tuple[str, ...]
    evaluate: Callable[[Sequence[float]], Mechanics]
    hardware: ca.Function
    outputs: int
    inputs: int
    references: Mapping[str, Callable[[Sequence[float]], Mechanics]] = field(default_factory=dict)
    exact_hessian: bool = True
    values: Callable[[Sequence[float]], Mechanics] | None = None
    notes: Callable[[Sequence[float]], tuple[str, ...]] = lambda theta: ()
    domain: tuple[Array, Array] | None = None
    unknown_between: str = ""
    expensive: bool = False
    nearby: Callable[[Sequence[Sequence[float]]], Evaluate] | None = None
    doubt: Callable[[Sequence[float]], str] = lambda theta: ""
    mismatch: Callable[[Sequence[float]], str] = lambda theta: ""
    shapes: Callable[[Sequence[float], int], ModeShapes] | None = None
    drawing: Callable[[Mapping[str, Sequence[float]]], Figure] | None = None
    ports: tuple[str, ...] = ()
    callback: object = None

    @property
    def between(self) -> str:
        """Where forces act and what they move, in words; at a sensor the position itself counts."""
        acts = "of a force at `disturbance`" if "disturbance" in self.ports else "of an actuator's"
        return f"{acts}, seen at {'`performance`' if 'performance' in self.ports else 'the sensor'}"

    @cached_property
    def slopes(self) -> ca.Function:
        """θ to the Jacobians of f (1, n) and λ (m, n)."""
        theta = ca.MX.sym("theta", len(self.names))
        f, lam = self.hardware(theta)
        return ca.Function("slopes", [theta], [ca.jacobian(f, theta), ca.jacobian(lam, theta)])


def build_plant(model: ModelFunction, names: Sequence[str], options: Mapping[str, Any]) -> Plant:
    """Trace `model` once with CasADi symbols and check what it returns.

    Parameters
    ----------
    model : callable
        model(theta, **options) gives mass, stiffness, input, output and hardware_cost, in SI.
    names : sequence of str
        The parameters θ, in order.
    options : mapping
        Further keyword arguments of the model.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        A key is missing or unknown, or a shape is wrong; the sentence has a remedy.

    Examples
    --------
    >>> from ccd_casadi.plants.registry import two_mass
    >>> plant = build_plant(two_mass, ["m1", "m2"], {"zeta": 0.01})
    >>> mechanics(plant, (60.0, 50.0)).M.diagonal().tolist(), hardware_cost(plant, (60.0, 50.0))
    ([60.0, 50.0], 110.0)
    """
    theta = ca.SX.sym("theta", len(names))
    try:
        result = model({name: theta[i] for i, name in enumerate(names)}, **options)
    except TypeError as error:
        if raised_in_user_code(error):
            raise  # by a line of its own, not by how it is called
        words = f"the plant model does not take its options: {error}"
        raise PlantError(f"{words}; correct [plant] or a file of robust.plants") from error
    except KeyError as error:
        words = f"the plant model needs a theta that the case lacks: {error}"
        raise PlantError(f"{words}; the case has {', '.join(names)}") from None
    found, damping_ratio, scalars = model_parts(result, ca.SX)
    f, *constraints = scalars.values()
    lam = ca.vertcat(*constraints) if constraints else ca.SX(0, 1)
    dense = [ca.densify(matrix) for matrix in found]
    slopes = [ca.densify(ca.jacobian(ca.vec(matrix), theta)) for matrix in dense]
    matrices = ca.Function("matrices", [theta], dense + slopes)
    return Plant(
        names=tuple(names),
        constraint_names=tuple(scalars)[1:],
        evaluate=FromExpressions(matrices, damping_ratio),
        hardware=ca.Function("hardware", [theta], [f, lam]),
        outputs=found[4].shape[0],
        inputs=found[3].shape[1],
        ports=tuple(key for key in PORTS if key in result),
    )


def widened(model: ModelFunction) -> ModelFunction:
    """Put a model's disturbance beside its input, its performance below its output.

    Parameters
    ----------
    model : callable
        model(theta, **options).

    Returns
    -------
    callable
        The same without these two.
    """

    def of_both(theta: Mapping[str, Any], **options: Any) -> Mapping[str, Any]:
        found = _of_mechanics(model(theta, **options))
        for key, beside in PORTS.items():
            if key in found:
                own, other = found[beside], found.pop(key)
                kind = ca.SX if isinstance(own, ca.SX) or isinstance(other, ca.SX) else ca.DM
                join: Any = ca.horzcat if beside == "input" else ca.vertcat
                found[beside] = join(kind(own), kind(other))
        return found

    return of_both


def model_parts(
    result: Mapping[str, Any], kind: Any, *, options: PlantOptions = PlantOptions()
) -> tuple[tuple[Any, ...], float | None, dict[str, Any]]:
    """M, D, K, B, C as matrices of CasADi's `kind`, the damping ratio, and f and λ by name, of what
    a model returns. Raises PlantError where that is no plant."""
    if not isinstance(result, Mapping):
        words = "returned None" if result is None else f"returned a {type(result).__name__}"
        raise PlantError(f"the plant function {words}; let it return a mapping, such as a dict")
    first_order, result = "A" in result, _of_mechanics(result)
    constraints = result.get("constraints", {})
    if not isinstance(constraints, Mapping):
        words = f"constraints is a {type(constraints).__name__}; return a mapping of name to value"
        raise PlantError(f'{words}, such as {{"too thin": 6.0 - t}}')
    missing = [key for key in _REQUIRED if key not in result]
    unknown = sorted(map(str, set(result) - _KNOWN))
    if missing:
        near = {key: difflib.get_close_matches(key, unknown, 1) for key in missing}
        renamed = [f"rename {found[0]} to {key}" for key, found in near.items() if found]
        added = [key for key, found in near.items() if not found]
        if added:
            renamed.append(f"add {', '.join(added)}" if renamed else "add it")
        raise PlantError(f"the plant model returns no {', '.join(missing)}; {', '.join(renamed)}")
    if unknown:
        meant = difflib.get_close_matches(unknown[0], sorted(_KNOWN - set(result)), 1)
        remedy = f"did you mean {meant[0]}?" if meant and len(unknown) == 1 else "drop it"
        raise PlantError(f"the plant model returns unknown {', '.join(unknown)}; {remedy}")
    if ("damping" in result) == ("damping_ratio" in result):
        raise PlantError("the plant model must return either damping or damping_ratio; give one")
    M, K, B, C = (
        _converted(kind, key, result[key]) for key in ("mass", "stiffness", "input", "output")
    )
    n = M.shape[0]
    few = options.most_channels
    sizes = (("mass", n, options.most_coordinates), ("input", B.shape[1], few),
             ("output", C.shape[0], few))  # fmt: skip
    for key, size, most in sizes:
        if size > most:
            words = f"at most {most} are taken; reduce it to what matters (its first modes)"
            raise PlantError(f"{key} has {size} rows or columns, of which {words}")
    D = kind(result["damping"]) if "damping" in result else kind.zeros(n, n)
    ports = {key: _converted(kind, key, result[key]) for key in PORTS if key in result}
    _check_shapes(M, D, K, B, C, ports, first_order)
    ratio = _damping_ratio(result.get("damping_ratio"))
    for key, value in constraints.items():
        if _is_comparison(value):
            words = "is a comparison; return a number"
            raise PlantError(f"constraint {key} {words}: h - 1.2 for h < 1.2, met where <= 0")
    given = {"hardware_cost": result["hardware_cost"], **constraints}
    scalars = {key: _converted(kind, key, value) for key, value in given.items()}
    for key, value in scalars.items():
        if value.shape != (1, 1):
            raise PlantError(f"{key} is {value.shape}, not a scalar; return one number")
    return (M, D, K, B, C), ratio, scalars


def _of_mechanics(result: Mapping[str, Any]) -> dict[str, Any]:
    """The same with 0 q̈ + q̇ - A q = B u, y = C q in the place of A, B and C. Raises PlantError
    where these are beside mass or stiffness, incomplete, not square, or D is not 0."""
    found = dict(result)
    given = {key: found.pop(key) for key in FIRST_ORDER if key in found}
    if not given:
        return found
    both = [key for key in (*MATRICES, "damping_ratio") if key in found]
    if both:
        words = f"the plant model returns {', '.join(given)} and {', '.join(both)}"
        raise PlantError(f"{words}; return A, B, C alone, or mass, stiffness, input, output")
    if missing := [key for key in ("A", "B", "C") if key not in given]:
        raise PlantError(f"the plant model returns {', '.join(given)}; add {', '.join(missing)}")
    kinds = [ca.SX if isinstance(value, ca.SX) else ca.DM for value in given.values()]
    kind = ca.SX if ca.SX in kinds else ca.DM
    A, *_ = parts = [_converted(kind, key, value) for key, value in given.items()]
    if A.shape[0] != A.shape[1]:
        raise PlantError(f"A is {A.shape}; make it square, a row a state")
    if "D" in given and not kind(parts[-1]).is_zero():
        words = "D is not 0: a force moves the sensor at once"
        raise PlantError(f"{words}; add the state of what rolls it off, or drop D")
    found |= {"mass": kind.zeros(*A.shape), "damping": kind.eye(A.shape[0]), "stiffness": -A}
    return {**found, "input": given["B"], "output": given["C"]}


def _is_comparison(value: Any) -> bool:
    """Whether it is true or false, as a number or as an expression of CasADi."""
    if not isinstance(value, ca.SX | ca.MX):
        return np.asarray(value).dtype.kind == "b"
    comparing = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR)
    scalar = value.shape == (1, 1) and not value.is_constant() and not value.is_symbolic()
    return scalar and value.op() in comparing


def _damping_ratio(value: Any) -> float | None:
    """Raises PlantError where it is not one number, that of every mode."""
    if value is None:
        return None
    words = "between 0 and 1, both exclusive, such as 0.01"
    if isinstance(value, ca.SX | ca.MX) and not value.is_constant():
        raise PlantError("damping_ratio depends on theta; return damping, a matrix")
    try:
        ratio = float(value)
    except (TypeError, ValueError, RuntimeError):
        what = f"damping_ratio is a {type(value).__name__}"
        raise PlantError(f"{what}; give one number {words}, or damping, a matrix") from None
    if not 0.0 < ratio < 1.0:
        of_none = ", or damping, a matrix of zeros" if ratio == 0.0 else ""
        raise PlantError(f"damping_ratio is {value}; give a number {words}{of_none}")
    return ratio


def _converted(kind: Any, key: str, value: object) -> Any:
    if value is None or isinstance(value, str | Mapping):
        what = "None" if value is None else f"a {type(value).__name__}"
        raise PlantError(f"{key} is {what}; return numbers")
    return kind(value)


def _check_shapes(
    M: Any, D: Any, K: Any, B: Any, C: Any, ports: Mapping[str, Any], first_order: bool
) -> None:
    """Raise PlantError unless M, D, K are (n, n), B (n, m), C (p, n), and ports not 0."""
    n, rows = M.shape[0], "A" if first_order else "mass"
    for key, matrix in {"mass": M, "stiffness": K, "damping": D}.items():
        if matrix.shape != (n, n):
            raise PlantError(f"{key} is {matrix.shape}, the mass matrix {M.shape}; make them agree")
    drive, reading = ("B", "C") if first_order else ("input", "output")
    wanted = [(drive, B, 0, f"({n}, m), a column a force"),
              (reading, C, 1, f"(p, {n}), a row a sensor")]  # fmt: skip
    wanted += [(key, matrix, int(key == "performance"), form)
               for key, matrix in ports.items()
               for form in [f"({n}, q), a column a force" if key == "disturbance"
                            else f"(z, {n}), a row an error"]]  # fmt: skip
    for key, matrix, side, form in wanted:
        if matrix.shape[side] != n:
            remedy = "transpose it" if matrix.shape[1 - side] == n else f"make it {n} on that side"
            words = f"{key} is {matrix.shape}; expected {form}, as {rows} is {M.shape}"
            raise PlantError(f"{words}: {remedy}")
    for key, matrix in ports.items():
        entries: list[Any] = ca.SX(matrix).elements()
        numbers = [one for one in entries if one.is_constant()]
        if not all(one.is_regular() for one in numbers):
            raise PlantError(f"{key} is not finite; give numbers, or drop it")
        if matrix.is_empty() or matrix.is_zero():
            nothing = "no force acts there" if key == "disturbance" else "it sees nothing"
            raise PlantError(f"{key} has no entry but 0: {nothing}; give one, or drop it")


def mechanics(
    plant: Plant,
    theta: Sequence[float],
    *,
    derivatives: bool = True,
    options: PlantOptions = PlantOptions(),
) -> Mechanics:
    """Evaluate and check a plant's matrices at θ.

    Parameters
    ----------
    plant : Plant
    theta : sequence of float (n,)
    derivatives : bool
        Without, the derivatives may be missing where the plant is then cheaper.
    options : PlantOptions

    Returns
    -------
    Mechanics

    Raises
    ------
    PlantError
        A matrix is not finite, M or K is not symmetric, or M is not positive definite.
    """
    cheaper = plant.values is not None and not derivatives
    system = plant.values(theta) if cheaper and plant.values else plant.evaluate(theta)
    M, K = system.M, system.K
    place = f"at theta = {named_values(plant.names, theta)}"
    _require_finite(plant, system, place, options.largest_entry)
    if system.first_order:
        return system
    for name, matrix in (("mass", M), ("stiffness", K)):
        gap = np.abs(matrix - matrix.T)
        if gap.max() > 1e-9 * np.abs(matrix).max():
            i, j = np.unravel_index(int(gap.argmax()), gap.shape)
            entries = (
                f"row {i + 1}, column {j + 1} is {matrix[i, j]:g}, its mirror {matrix[j, i]:g}"
            )
            raise PlantError(f"{name} is not symmetric {place}: {entries}; make it symmetric")
    try:
        np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        least = float(np.linalg.eigvalsh(M)[0])
        words = f"mass is not positive definite {place}: its least eigenvalue is {least:.3g}"
        remedy = "give every coordinate a mass, or narrow the bounds of theta"
        raise PlantError(f"{words}; {remedy}") from None
    return system


def nearby_model(plant: Plant, known: Sequence[Sequence[float]], here: Sequence[float]) -> Evaluate:
    """Make a cheap model of a plant beside θ at which it is known.

    Parameters
    ----------
    plant : Plant
    known : sequence of θ (n,)
        Where the plant has been evaluated.
    here : sequence of float (n,)
        Centre of the first-order model.

    Returns
    -------
    callable
        θ -> Mechanics: `plant.nearby` where the plant has it, else the model to first order.
    """
    if plant.nearby is not None and known:
        return plant.nearby(known)
    system = mechanics(plant, here)
    return lambda theta: to_first_order(system, np.array(theta) - np.array(here))


def _require_finite(plant: Plant, system: Mechanics, place: str, largest: float) -> None:
    """Raise PlantError that names the first entry, or its slope, that is no number or too large."""
    keys = ("mass", "damping", "-A", "B", "C") if system.first_order else MATRICES
    entries = [*zip(keys, system.matrices, strict=True)]
    for key, slopes in zip(keys, system.derivatives, strict=True):
        entries += [(f"the derivative of {key} to {name}", slope)
                    for name, slope in zip(plant.names, slopes, strict=False)]  # fmt: skip
    for what, matrix in entries:
        wrong = ~(np.abs(matrix) <= largest)
        if not wrong.any():
            continue
        i, j = np.argwhere(wrong)[0]
        entry = f"{what} is {matrix[i, j]:g} in row {i + 1}, column {j + 1}"
        if np.isfinite(matrix[i, j]):
            words = f"the plant has an entry beyond {largest:g} {place}: {entry}"
            raise PlantError(f"{words}; choose other units")
        remedy = "keep divisions, roots and logarithms in their range over all bounds of theta"
        if what not in keys:
            remedy = "its value is finite: a root or power of 0, or abs, has no slope; smooth it"
        raise PlantError(f"the plant is not finite {place}: {entry}; {remedy}")


@dataclass(frozen=True)
class FromExpressions:
    """θ -> Mechanics by CasADi expressions.

    Attributes
    ----------
    matrices : casadi.Function
        θ to M, D, K, B, C and their Jacobians, a graph of scalars.
    damping_ratio : float or None
        As in `Mechanics`.
    """

    matrices: ca.Function
    damping_ratio: float | None

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        values = [np.array(value) for value in self.matrices(np.asarray(theta, float))]
        M, D, K, B, C = values[:5]
        slopes = tuple(
            value.reshape(matrix.shape[1], matrix.shape[0], len(theta)).transpose(2, 1, 0).copy()
            for matrix, value in zip(values[:5], values[5:], strict=True)
        )
        return Mechanics(M, D, K, B, C, self.damping_ratio, slopes)  # type: ignore[arg-type]


def hardware_cost(plant: Plant, theta: Sequence[float] | Array) -> float:
    """Evaluate the hardware cost f(θ).

    Parameters
    ----------
    plant : Plant
    theta : sequence or array (n,)

    Returns
    -------
    float
        In the unit of the plant's cost, usually kg.
    """
    return float(plant.hardware(np.asarray(theta, float))[0])


def constraint_values(plant: Plant, theta: Sequence[float] | Array) -> Array:
    """Evaluate the hardware constraints λ(θ), which are met where λ <= 0.

    Parameters
    ----------
    plant : Plant
    theta : sequence or array (n,)

    Returns
    -------
    array (m,)
        In the order of `plant.constraint_names`.
    """
    return np.array(plant.hardware(np.asarray(theta, float))[1]).ravel()


def hardware_slopes(plant: Plant, theta: Sequence[float] | Array) -> tuple[Array, Array]:
    """Evaluate the gradients of hardware cost and constraints.

    Parameters
    ----------
    plant : Plant
    theta : sequence or array (n,)

    Returns
    -------
    ∇f (n,), ∇λ (m, n)
    """
    df, dlam = (np.array(value) for value in plant.slopes(np.asarray(theta, float)))
    return df.ravel(), dlam.reshape(-1, len(plant.names))


def named_values(names: Sequence[str], values: Sequence[float] | Array) -> str:
    """Write names and values as `name=value, name=value`.

    Parameters
    ----------
    names : sequence of str (n,)
    values : sequence or array (n,)

    Returns
    -------
    str
    """
    return ", ".join(f"{name}={value:g}" for name, value in zip(names, values, strict=True))
