"""A plant of numbers whose derivatives to θ are differences."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import islice, product
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.plants.model_function import MATRICES, PORTS, ModelFunction, model_parts
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant, build_plant, named_values
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.user_code import raised_words


def remember(
    mechanics: Callable[[tuple[float, ...], bool], Mechanics],
    derivatives: bool = True,
    *,
    plants: int = 64,
) -> Evaluate:
    """Keep the last values of θ -> `mechanics(θ, derivatives)`.

    Parameters
    ----------
    mechanics : callable
        (θ, derivatives) -> Mechanics.
    derivatives : bool
        Second argument of every call.
    plants : int
        Number of θ whose matrices are kept.

    Returns
    -------
    callable
        θ -> Mechanics.
    """
    kept = lru_cache(maxsize=plants)(mechanics)
    return lambda theta: kept(tuple(map(float, theta)), derivatives)


@dataclass(frozen=True)
class DifferenceOptions:
    """Numbers of derivatives by differences."""

    step: float = 1e-3  # share of the box: h⁴ is 1e-12, and rounding is magnified a thousandfold
    values_kept: int = 256  # θ: matrices and hardware cost are evaluated at the same ones
    wrong: float = 0.1  # relative: two difference formulas differ by more of a wrong derivative
    jump: float = 1e-2  # share of a matrix by which its values differ over one step where they jump
    noise: float = 1e-4  # share of a matrix over the box below which a derivative counts as zero
    agreement: float = 1e-9  # relative difference between the values of symbols and of numbers
    corners: int = 16  # of the box at most, where these are compared, besides the middle
    inside: int = 6  # places inside it, too


def user_plant(
    model: ModelFunction,
    names: Sequence[str],
    options: Mapping[str, Any],
    lower: Sequence[float],
    upper: Sequence[float],
    *,
    differences: DifferenceOptions = DifferenceOptions(),
) -> Plant:
    """Make a plant of a user's model: CasADi expressions, or numbers with differences.

    The expressions must give the numbers that the model returns for numbers, over the box: `float`
    of a symbol is silently nan, and a branch on it then goes one way everywhere.

    Parameters
    ----------
    model : callable
        model(theta, **options), as in `build_plant`.
    names : sequence of str (n,)
        Of θ.
    options : mapping
        Keyword arguments of the model.
    lower, upper : sequences (n,)
        Box of θ in SI; it scales the steps of the differences.
    differences : DifferenceOptions

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        What `build_plant` raises where the model takes neither symbols nor numbers.
    """
    box = np.array([lower, upper], float)
    numeric = DifferencedModel(model, tuple(names), options, box[0], box[1], differences)
    middle = box.mean(axis=0)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # CasADi's notice on NumPy functions
            plant = build_plant(model, names, options)
    except Exception as error:
        if isinstance(error, PlantError) and error.__cause__ is None:
            raise  # it was traced, and is no plant
        try:
            numeric.values(middle)
        except (
            Exception
        ) as of_numbers:  # it takes none either: what its own lines raised is reported
            own = isinstance(of_numbers, PlantError) or not isinstance(error, PlantError)
            raise (of_numbers if own else error) from None
        return numeric.plant(f"{type(error).__name__}: {error}")
    try:
        numeric.values(middle)
    except Exception:
        if all(np.isfinite(matrix).all() for matrix in plant.evaluate(middle).matrices):
            return plant  # the symbols are all it takes
        raise  # `float` of a symbol is nan: what it raised of numbers is what is wrong
    for theta in (middle, *_spread(box, differences)):  # a branch on a symbol goes one way
        try:
            reason = _disagreement(plant, numeric, theta)
        except UserError:
            reason = "it raises an error where its expressions have numbers"
        if reason:
            return numeric.plant(reason)
    return replace(plant, mismatch=partial(_disagreement, plant, numeric))


def _spread(box: Array, options: DifferenceOptions) -> Array:
    """θ (k, n) where expressions and numbers are compared: corners of the box, and between.

    In between are the points k α mod 1 of Roberts's sequence, α_i = φ⁻ⁱ with φⁿ⁺¹ = φ + 1.
    """
    n = box.shape[1]
    corners = np.array(list(islice(product((0.0, 1.0), repeat=n), options.corners)))
    golden = max(np.roots([1.0, *np.zeros(n - 1), -1.0, -1.0]).real)
    inside = np.outer(np.arange(1, options.inside + 1), golden ** -np.arange(1.0, n + 1.0)) % 1.0
    return np.asarray(box[0] + np.concatenate([corners, inside]) * (box[1] - box[0]))


def _disagreement(plant: Plant, numeric: "DifferencedModel", theta: Sequence[float]) -> str:
    """Words where the expressions of a traced model are not the numbers that it returns at θ."""
    expected = numeric.values(np.asarray(theta, float))
    for one, other in zip(plant.evaluate(theta).matrices, expected.matrices, strict=True):
        size, gap = np.abs(other).max(initial=0.0), np.abs(one - other).max(initial=0.0)
        if np.isfinite(size) and not gap <= numeric.differences.agreement * size:
            return "its expressions differ from the numbers that it returns"
    return ""


def _at_theta(error: UserError, names: Sequence[str], theta: Sequence[float]) -> UserError:
    """The same in words that name θ."""
    head, _, remedy = str(error).rpartition("; ")
    place = f"at theta = {named_values(names, theta)}"
    return type(error)(f"{head} {place}; {remedy}" if head else f"{remedy} {place}")


class _Values:
    """The values that a model returns at one θ, as arrays when they are read; `scalars` are f and
    λ."""

    def __init__(self, result: Mapping[str, Any]) -> None:
        self._matrices, self._ratio, scalars = model_parts(result, ca.DM)
        self.constraint_names = tuple(scalars)[1:]
        self.ports = tuple(key for key in PORTS if key in result)
        self.scalars = np.array([float(value) for value in scalars.values()])

    @cached_property
    def system(self) -> Mechanics:
        """M, D, K, B, C, with derivatives to no parameter."""
        M, D, K, B, C = (np.array(matrix, dtype=float) for matrix in self._matrices)
        none = tuple(np.zeros((0, *matrix.shape)) for matrix in (M, D, K, B, C))
        return Mechanics(M, D, K, B, C, self._ratio, none)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class DifferencedModel:
    """A numeric model as θ -> Mechanics with derivatives by differences; the box scales the steps.

    Raises PlantError where the model returns no plant, or one of another shape than before.
    """

    model: ModelFunction
    names: tuple[str, ...]
    options: Mapping[str, Any]
    lower: Array
    upper: Array
    differences: DifferenceOptions = DifferenceOptions()

    @cached_property
    def _read(self) -> Callable[[tuple[float, ...]], _Values]:
        """The function that evaluates the model; its last values are kept."""

        @lru_cache(maxsize=self.differences.values_kept)
        def read(theta: tuple[float, ...]) -> _Values:
            try:
                found = self.model(dict(zip(self.names, theta, strict=True)), **self.options)
            except UserError as error:
                raise _at_theta(error, self.names, theta) from None
            except Exception as error:
                words = f"the plant function raised {raised_words(error)}; correct it"
                raise _at_theta(PlantError(words), self.names, theta) from error
            return _Values(found)

        return read

    def plant(self, reason: str) -> Plant:
        """The plant of the model; `reason` says why its function cannot be traced."""
        middle = self._at(0.5 * (self.lower + self.upper))
        count = len(self.names)
        width = self.upper - self.lower

        def inside(unit: Array) -> Array:
            return self.lower + width * unit

        callback = VectorCallback(
            "differences",
            count,
            middle.scalars.size,
            lambda unit: self._at(inside(unit)).scalars,
            lambda unit: self._slopes(inside(unit), lambda item: (item.scalars,))[0][0].T * width,
            hessians=True,
        )
        theta = ca.MX.sym("theta", count)
        both = callback((theta - self.lower) / width)
        lam = both[1:] if middle.scalars.size > 1 else ca.MX(0, 1)
        short = " ".join(reason.split())[:120]

        def notes(theta: Sequence[float]) -> tuple[str, ...]:
            return (
                f"the plant function takes numbers only ({short}): its derivatives are "
                f"differences over {self.differences.step:g} of the box, at most "
                f"{self.error(theta):.1e} wrong (relative, from a second step)",
            )

        return Plant(
            names=self.names,
            constraint_names=middle.constraint_names,
            ports=middle.ports,
            evaluate=self,
            hardware=ca.Function("hardware", [theta], [both[0], lam]),
            outputs=middle.system.C.shape[0],
            inputs=middle.system.B.shape[1],
            exact_hessian=False,
            values=self.values,
            notes=notes,
            doubt=self.doubt,
            callback=callback,
        )

    def __call__(self, theta: Sequence[float] | Array) -> Mechanics:
        """M, D, K, B, C and their derivatives at θ."""
        here = self._at(theta).system

        def parts(item: _Values) -> tuple[Array, ...]:
            if item.system.damping_ratio != here.damping_ratio:
                words = "damping_ratio changes with theta; return damping, a matrix"
                raise PlantError(f"{words}, in its place")
            return item.system.matrices

        M, D, K, B, C = (fine for fine, _ in self._slopes(theta, parts))
        jump = self._disagreement(theta, self.differences.jump)
        if jump:  # a value leaps between neighbouring points, not only bends
            raise PlantError(jump)
        return replace(here, derivatives=(M, D, K, B, C))

    def values(self, theta: Sequence[float] | Array) -> Mechanics:
        """M, D, K, B, C at θ, with derivatives to no parameter."""
        return self._at(theta).system

    def error(self, theta: Sequence[float] | Array) -> float:
        """The largest difference of both formulas, over the largest derivative of its matrix."""
        gaps = self._gaps(theta)
        return max((gap / max(slope, 1e-6 * size) for *_, gap, slope, size in gaps if gap > 0.0),
                   default=0.0)  # fmt: skip

    def doubt(self, theta: Sequence[float] | Array) -> str:
        """Name the derivative that is wrong at θ, and the usual cause; empty where both formulas
        agree."""
        return self._disagreement(theta, 0.0)

    def _disagreement(self, theta: Sequence[float] | Array, leap: float) -> str:
        """The worst derivative whose two formulas differ by `wrong` of it, and over a step by
        `leap` of the matrix."""
        numbers = self.differences
        worst, words = numbers.wrong, ""
        for k, i, gap, slope, size in self._gaps(theta):
            floor = max(slope, numbers.noise * size)
            if not gap > worst * floor or numbers.step * gap <= leap * size:
                continue
            worst = gap / floor
            label = (*MATRICES, "hardware_cost or a constraint")[k]
            words = (
                f"the derivative of {label} to {self.names[i]} is {100 * worst:.0f} % wrong at "
                f"theta = {named_values(self.names, theta)}: two difference formulas disagree, so "
                "the plant function jumps or bends there; usual causes are eigenvectors whose sign "
                "or order changes between points (fix the sign, sort by shape), `if`, `abs`, "
                "`round`, or an iteration that stops early"
            )
        return words

    def _gaps(
        self, theta: Sequence[float] | Array
    ) -> Iterator[tuple[int, int, float, float, float]]:
        """Yield for every matrix and parameter by number: how far both formulas differ over the
        box, the matrix's largest derivative over the box, and its size.

        Nothing is called again: the coarse formula uses the fine one's points.
        """

        def parts(item: _Values) -> tuple[Array, ...]:
            return (*item.system.matrices, item.scalars)

        width = self.upper - self.lower
        sizes = [float(np.abs(part).max(initial=0.0)) for part in parts(self._at(theta))]
        pairs = zip(self._slopes(theta, parts), sizes, strict=True)
        for k, ((fine, coarse), size) in enumerate(pairs):
            over_box = width.reshape(-1, *[1] * (fine.ndim - 1))
            slope = float(np.abs(fine * over_box).max(initial=0.0))
            for i, gap in enumerate(np.abs((fine - coarse) * over_box)):
                yield k, i, float(gap.max(initial=0.0)), slope, size

    def _slopes(
        self, theta: Sequence[float] | Array, parts: Callable[[_Values], tuple[Array, ...]]
    ) -> list[tuple[Array, Array]]:
        """Derivatives of every part, a leading axis over θ, by five points, and by three of them
        with twice the step."""
        point = np.asarray(theta, float)
        base = parts(self._at(point))
        rows: list[list[Array]] = []
        offsets = np.arange(-2.0, 3.0)  # steps, of the points about θ
        for i, width in enumerate(self.upper - self.lower):
            h = self.differences.step * width
            centre = np.clip(point[i], self.lower[i] + 2.0 * h, self.upper[i] - 2.0 * h)
            away, weights, found = (point[i] - centre) / h, np.zeros((2, len(offsets))), []
            for row, every in zip(weights, (1, 2), strict=True):
                powers = np.arange(len(offsets[::every]))
                # row k: ((x - at)^k), of which only k = 1 slopes
                system = (offsets[::every] - away) ** powers[:, None]
                row[::every] = np.linalg.solve(system, (powers == 1) / h)
            for offset in offsets:
                moved = point.copy()
                moved[i] = point[i] if offset == away else centre + offset * h
                found.append(parts(self._at(moved)))
            # The weights sum to zero: without the value at θ a constant has no slope at all.
            pairs = zip(zip(*found, strict=True), base, strict=True)
            rows.append([np.tensordot(weights, np.array(c) - b, 1) for c, b in pairs])
        return [tuple(np.stack(column, axis=1)) for column in zip(*rows, strict=True)]

    def _at(self, theta: Sequence[float] | Array) -> _Values:
        return self._read(tuple(float(value) for value in theta))
