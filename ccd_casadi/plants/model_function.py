"""A model function: what a person's plant returns, its matrices by name, read and checked.

model(theta, **options), theta a mapping of names to floats or CasADi symbols, returns a mapping
with `mass`, `stiffness`, `input`, `output`, one of `damping` or `damping_ratio` (or `A`, `B`, `C`
of first order in their place), `hardware_cost` and optionally `constraints` (name to scalar, met
where <= 0), `disturbance` (where other forces act) and `performance` (where the error counts).
"""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.support.errors import PlantError

ModelFunction = Callable[..., Mapping[str, Any]]

_REQUIRED = ("mass", "stiffness", "input", "output", "hardware_cost")
MATRICES = ("mass", "damping", "stiffness", "input", "output")
PORTS = {"disturbance": "input", "performance": "output"}  # optional, and what they stand beside
FIRST_ORDER = ("A", "B", "C", "D")
_KNOWN = {*_REQUIRED, *PORTS, "damping", "damping_ratio", "constraints"}


@dataclass(frozen=True)
class PlantOptions:
    """Sizes beyond which a plant is refused."""

    most_coordinates: int = 1000  # rows of M, which is dense: the time grows with the cube
    most_channels: int = 100  # inputs, and outputs
    largest_entry: float = 1e100  # of any matrix or derivative, SI: its square is still a double


def widen(model: ModelFunction) -> ModelFunction:
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
        _convert(kind, key, result[key]) for key in ("mass", "stiffness", "input", "output")
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
    ports = {key: _convert(kind, key, result[key]) for key in PORTS if key in result}
    _check_shapes(M, D, K, B, C, ports, first_order)
    ratio = _damping_ratio(result.get("damping_ratio"))
    for key, value in constraints.items():
        if _is_comparison(value):
            words = "is a comparison; return a number"
            raise PlantError(f"constraint {key} {words}: h - 1.2 for h < 1.2, met where <= 0")
    given = {"hardware_cost": result["hardware_cost"], **constraints}
    scalars = {key: _convert(kind, key, value) for key, value in given.items()}
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
    A, *_ = parts = [_convert(kind, key, value) for key, value in given.items()]
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


def _convert(kind: Any, key: str, value: object) -> Any:
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
