"""The plant M(θ)ẍ + D(θ)ẋ + K(θ)x = B(θ)u, y = C(θ)x as CasADi expressions of θ.

(Paper, equations (1) and (2).)
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.drawing.content import Figure
from ccd_casadi.drawing.svg import ModeShapes
from ccd_casadi.lti.wiring import UNWIRED, Wiring
from ccd_casadi.plants.model_function import (
    MATRICES,
    PORTS,
    ModelFunction,
    PlantOptions,
    model_parts,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.user_code import raised_in_user_code

Evaluate = Callable[[Sequence[float]], "Mechanics"]


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
        """The place where forces act and what they move, in words; at a sensor the position itself
        counts."""
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
