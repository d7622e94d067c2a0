"""Surrogates as JSON files and as CasADi functions."""

import json
import os
import typing
from collections.abc import Sequence
from dataclasses import MISSING, asdict, fields, is_dataclass
from math import factorial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import solve_triangular

from surrogates.files import write_whole
from surrogates.gaussian_process import ROOT5, GaussianProcess, Kernel

SCHEMA = "surrogates/2"
READABLE = (SCHEMA, "surrogates/1")
KIND = "gaussian_process"


class SurrogateFileError(ValueError):
    """The file is not a readable surrogate file of a schema this package knows."""


def save(
    surrogates: GaussianProcess | Sequence[GaussianProcess],
    path: str | os.PathLike[str],
    extra: dict[str, Any] | None = None,
) -> None:
    """Write surrogates to a JSON file, replacing it in one step or not at all.

    Parameters
    ----------
    surrogates : GaussianProcess or sequence
        What to write.
    path : path
        The file.
    extra : dict, optional
        Anything that JSON holds, stored alongside: origin of the samples, units, names.

    Raises
    ------
    TypeError, ValueError
        `extra` is not JSON; a number is not finite.
    """
    members = list(surrogates) if isinstance(surrogates, Sequence) else [surrogates]
    records = [{"kind": KIND, **asdict(member)} for member in members]
    document = {"schema": SCHEMA, "surrogates": records, "extra": extra or {}}
    write_whole(Path(path), json.dumps(document, default=np.ndarray.tolist, allow_nan=False))


def load(path: str | os.PathLike[str]) -> tuple[tuple[GaussianProcess, ...], dict[str, Any]]:
    """Read a file written by `save`.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    tuple of GaussianProcess, dict

    Raises
    ------
    SurrogateFileError
        The file is truncated, foreign, of another schema, or its arrays contradict each other.
    OSError
        The file cannot be read.
    """
    try:
        document = json.loads(Path(path).read_bytes(), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:  # covers JSON, UTF-8 and the refused constants
        raise SurrogateFileError(f"{path}: not a complete JSON file ({error})") from error
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema not in READABLE:
        raise SurrogateFileError(f"{path}: expected schema {SCHEMA!r}, found {schema!r:.60}")
    try:
        members = []
        for record in document["surrogates"]:
            body = dict(record)
            if (kind := body.pop("kind")) != KIND:
                raise ValueError(f"kind {kind!r:.60} is not {KIND}; fit it again")
            members.append(_decode(GaussianProcess, body))
        extra = document["extra"]
        if not isinstance(extra, dict):
            raise TypeError("extra is not an object")
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise SurrogateFileError(f"{path}: damaged record ({error!r:.300})") from error
    return tuple(members), extra


def _decode(cls: Any, value: Any) -> Any:
    if is_dataclass(cls):
        hints = typing.get_type_hints(cls)
        names = {f.name for f in fields(cls)}
        needed = {f.name for f in fields(cls) if f.default is f.default_factory is MISSING}
        if not needed <= set(value) <= names:
            raise ValueError(f"fields differ by {sorted(names ^ set(value))}")
        return typing.cast(Any, cls)(**{k: _decode(hints[k], value[k]) for k in sorted(value)})
    if typing.get_origin(cls) is np.ndarray:
        array = np.array(value, dtype=float)
        if not np.isfinite(array).all():  # null and 1e999 come in as nan and inf
            raise ValueError("an array holds what is not a finite number")
        return array
    if cls is float and (type(value) not in (int, float) or not np.isfinite(value)):
        raise ValueError(f"expected a finite number, found {value!r}")
    return cls(value)


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not a number")


def to_casadi(
    surrogate: GaussianProcess | Sequence[GaussianProcess],
    name: str = "surrogate",
    std: bool = True,
) -> ca.Function:
    """The CasADi function x (d) -> mean (k), or -> (mean, std) with `std`; equal to `predict`.

    Value, gradient and Hessian are exact and finite everywhere, at the samples too.

    Parameters
    ----------
    surrogate : GaussianProcess or sequence
        One, or k of the same inputs.
    name : str
        Of the function.
    std : bool
        Whether to return deviations: O(n²) an evaluation, where the mean takes O(n).

    Returns
    -------
    casadi.Function
        In input and output units.

    Raises
    ------
    ValueError
        No surrogates, or surrogates of different numbers of inputs.
    """
    members = list(surrogate) if isinstance(surrogate, Sequence) else [surrogate]
    inputs = {member.lower.size for member in members}
    if len(inputs) != 1:
        raise ValueError(f"surrogates must share their inputs, got {sorted(inputs)} of them")
    x = ca.MX.sym("x", inputs.pop())
    pairs = [expression(member, x, std) for member in members]
    outputs = [ca.vertcat(*part) for part in zip(*pairs, strict=True)]
    return ca.Function(name, [x], outputs, ["x"], ["mean", "std"][: len(outputs)])


def expression(process: GaussianProcess, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    """Return (mean,) or, with `std`, (mean, std) of a process at the symbol x (d)."""
    p = process.hyperparameters
    lengths = p.length_scales
    n, d = process.X.shape
    unit = (x - ca.DM(process.lower)) / ca.DM(process.upper - process.lower)
    # Columns are samples: CasADi stores by column, and this repeats x contiguously.
    z = ca.repmat(unit / lengths, 1, n) - ca.DM((process.X / lengths).T)
    s = ca.sum1(z * z).T
    phi = radial_expression(process.kernel, s, int(process.has_gradients))
    weights = process.weights.reshape(-1, n)
    total = ca.dot(ca.DM(weights[0]), phi[0])
    if process.has_gradients:
        # Σ_aj weights_aj cov(f, ∂_j f_a), with the sum over j inside.
        along = ca.sum1(z * ca.DM(weights[1:] / lengths[:, None])).T
        total -= 2.0 * ca.dot(along, phi[1])
    scaled = p.signal_variance * total
    mean = process.output_mean + process.output_scale * scaled
    if not std:
        return (mean,)
    k = phi[0]
    if process.has_gradients:
        k = ca.vertcat(k, *[(-2.0 / lengths[j]) * (z[j, :].T * phi[1]) for j in range(d)])
    # L⁻¹ and not K⁻¹: its condition is the root, and a sum of squares stays positive.
    factor = process.factor
    half = p.signal_variance * solve_triangular(factor, np.eye(len(factor)), lower=True)
    variance = p.signal_variance - ca.sumsqr(ca.mtimes(ca.DM(half), k))
    floor = process.variance_floor * p.signal_variance
    return mean, process.band * process.output_scale * ca.sqrt(ca.fmax(variance, floor))


def radial_expression(
    kernel: Kernel, s: ca.MX, order: int, close: float = 1e-2, offset: float = 1e-30
) -> list[ca.MX]:
    """Return [φ, φ'](s) up to `order` <= 1, differentiable twice at s = 0 as well.

    AD differentiates r = √s as 1/(2r): at a sample that is 0 · inf, and just beside
    it the 1 - 1 that cancels in φ' is divided by r and by r³. So near a sample the
    Matérn kernel is its Taylor polynomial in s and s^(m/2), where nothing cancels,
    and the closed form is kept off zero by fmax, whose derivative there is 0.

    `close`, in length scales: below it the Taylor polynomial is of degree 9, whose remainder
    (√5 r)^10 · 10⁻⁵ is below 1e-20 there. `offset` is added to s under the root of the odd terms,
    which start at r³: AD finds 0 · 1e15 and not 0 · inf.
    """
    if kernel is Kernel.RBF:
        e = ca.exp(-0.5 * s)
        return [e, -0.5 * e][: order + 1]
    far, near = ca.fmax(s, close**2), ca.sqrt(s + offset)
    r = ca.sqrt(far)
    e = ca.exp(-ROOT5 * r)
    closed = [(1.0 + ROOT5 * r + (5.0 / 3.0) * far) * e, (-5.0 / 6.0) * (1.0 + ROOT5 * r) * e]
    # of (1 + a r + a² r²/3) e^(-a r), a = √5: (-a)^m (m - 1)(m - 3) / (3 m!)
    c = [(-ROOT5) ** m * ((m - 1) * (m - 3)) / (3.0 * factorial(m)) for m in range(10)]
    # φ = Σ c_m r^m and φ' = Σ (m/2) c_m r^(m-2); c_1 = c_3 = 0, which is what makes
    # the kernel twice differentiable.
    c1 = [0.5 * (m + 2) * c[m + 2] for m in range(len(c) - 2)]
    taylor = [even_odd(c, 5, s, near), even_odd(c1, 3, s, near)]
    return [
        ca.if_else(s < close**2, inner, outer)
        for inner, outer in zip(taylor[: order + 1], closed, strict=False)
    ]


def even_odd(c: list[float], first_odd: int, s: ca.MX, r: ca.MX) -> ca.MX:
    """Σ c_m r^m by Horner in s = r², the odd terms from first_odd with one r outside."""
    even = odd = 0.0 * s
    for coefficient in reversed(c[0::2]):
        even = coefficient + s * even
    for coefficient in reversed(c[first_odd::2]):
        odd = coefficient + s * odd
    return even + s ** ((first_odd - 1) // 2) * r * odd
