"""The mesh as a polynomial of θ: drawn once with the CAD kernel, and needed no more afterwards.

Node positions are x(θ) = Σ_k c_k ξ^k, ξ the place in the box from -1 to 1, fitted by least squares
to the moved mesh at twice as many θ as there are terms, denser towards the bounds. Their
velocities ∂x/∂θ are therefore exact derivatives of this model; how far it is from the drawn solid
is measured at θ that the fit has not seen.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.extensions.cad import solid
from ccd_casadi.plants.plant import named_values
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.terminal import Progress

FORMAT = "ccd_casadi morph 1"
# θ by name -> the solid (build123d, in mm, or a STEP file) and a point in mm on each named face
SolidDrawing = Callable[[Mapping[str, float]], tuple[Any, Mapping[str, Sequence[float]]]]


@dataclass(frozen=True)
class MorphOptions:
    """Numbers of the fit of a mesh.

    Attributes
    ----------
    unseen : int
        θ beside those of the fit, at which its error is measured.
    most_error : float
        Largest error, as a share of the mesh size.
    rounding : float
        m: coefficients are rounded to multiples of it.
    """

    unseen: int = 5
    most_error: float = 1e-3
    rounding: float = 1e-12


@dataclass(frozen=True)
class Morph:
    """Tetrahedra (t, 4) whose points (n, 3) in m are polynomials of θ between `lower` and `upper`.

    `exponents` (k, p) and `coefficients` (k, n, 3) of ξ; `faces` are triangles (f, 3) by name;
    `error` is the largest distance of a node to its place on the drawn solid, in m.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    exponents: np.ndarray
    coefficients: Array
    tets: np.ndarray
    faces: Mapping[str, np.ndarray]
    error: float

    def points(self, theta: Sequence[float] | Array) -> Array:
        """(n, 3) in m. Raises PlantError where an element is inside out."""
        points = np.tensordot(_terms(self._unit(theta), self.exponents), self.coefficients, 1)
        if not solid.volumes(points, self.tets).min() > 0.0:
            place = named_values(self.names, theta)
            raise PlantError(f"an element of the mesh is inside out at {place}; narrow the bounds")
        return points

    def velocities(self, theta: Sequence[float] | Array) -> Array:
        """∂points/∂θ, (p, n, 3)."""
        unit, found = self._unit(theta), []
        for i, width in enumerate(0.5 * (self.upper - self.lower)):
            lowered = self.exponents.copy()
            lowered[:, i] = np.maximum(lowered[:, i] - 1, 0)
            slope = self.exponents[:, i] * _terms(unit, lowered) / width
            found.append(np.tensordot(slope, self.coefficients, 1))
        return np.array(found)

    def _unit(self, theta: Sequence[float] | Array) -> Array:
        middle, half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        return (np.asarray(theta, float) - middle) / half


def draw_morph(
    drawing: SolidDrawing,
    bounds: Mapping[str, tuple[float, float]],
    file: str | Path,
    *,
    size: float,
    degree: int = 3,
    quiet: bool = False,
    options: MorphOptions = MorphOptions(),
) -> Morph:
    """Mesh the solid in the middle of `bounds` with elements of `size` in m, follow it, write it.

    Raises PlantError where the solid at some θ has other faces, or `degree` does not follow it.
    """
    from scipy.stats import qmc  # half a second to import, which every command would wait for

    names = tuple(bounds)
    lower, upper = np.array([bounds[name] for name in names], float).T
    powers = product(range(degree + 1), repeat=len(names))
    exponents = np.array([row for row in powers if sum(row) <= degree])
    unseen, rounding = options.unseen, options.rounding
    count = 2 * len(exponents) + unseen
    draws = qmc.Halton(len(names), scramble=False).random(count)
    unit = -np.cos(np.pi * draws)
    theta = lower + 0.5 * (unit + 1.0) * (upper - lower)

    def drawn(row: Array) -> tuple[Any, Mapping[str, Sequence[float]]]:
        values = dict(zip(names, map(float, row), strict=True))
        try:
            return drawing(values)
        except Exception as error:
            raise PlantError(f"it cannot be drawn: {error}") from error

    with solid.kernel() as gmsh, Progress(count + 1, "drawing the solid", quiet=quiet) as bar:
        part, named = drawn(0.5 * (lower + upper))
        solid.load(gmsh, part)
        tags = {name: solid.face_at(gmsh, name, point) for name, point in named.items()}
        mesh = solid.meshed(gmsh, size)
        bar.advance()
        samples = []
        for row in theta:
            try:
                solid.load(gmsh, drawn(row)[0])
                samples.append(solid.moved_points(gmsh, mesh))
            except PlantError as refused:
                words = f"the solid at {named_values(names, row)}: {refused}"
                raise PlantError(words) from refused
            bar.advance()
    flat = np.array(samples).reshape(count, -1)
    fit = np.array([_terms(row, exponents) for row in unit])
    coefficients = np.linalg.lstsq(fit[unseen:], flat[unseen:], rcond=None)[0]
    gap = (fit[:unseen] @ coefficients - flat[:unseen]).reshape(-1, 3)
    error = float(np.linalg.norm(gap, axis=1).max())
    if error > options.most_error * size:
        raise PlantError(
            f"a polynomial of degree {degree} is {error:.1e} m off the solid; raise `degree`, "
            "narrow the bounds, or find the face that jumps"
        )
    morph = Morph(
        names, lower, upper, exponents,
        np.round(coefficients / rounding).reshape(len(exponents), -1, 3) * rounding,
        mesh.tets, {name: mesh.faces[tag] for name, tag in tags.items()}, error,
    )  # fmt: skip
    write_morph(morph, file)
    return morph


def write_morph(morph: Morph, file: str | Path) -> None:
    """As an .npz file without pickled objects."""
    faces = {f"face:{name}": triangles for name, triangles in morph.faces.items()}
    fields = {key: value for key, value in vars(morph).items() if key != "faces"}
    with Path(file).open("wb") as stream:
        np.savez_compressed(stream, format=FORMAT, **fields, **faces)  # type: ignore[arg-type]


def read_morph(file: str | Path) -> Morph:
    """Raises PlantError where the file is none of `draw_morph`."""
    try:
        with np.load(file, allow_pickle=False) as data:
            if str(data["format"]) != FORMAT:
                raise ValueError(f"its format is {data['format']}, not {FORMAT}")
            faces = {key[5:]: data[key] for key in data.files if key.startswith("face:")}
            arrays = ("lower", "upper", "exponents", "coefficients", "tets")
            fields = {key: data[key] for key in arrays}
            names = tuple(map(str, data["names"]))
            return Morph(names, faces=faces, error=float(data["error"]), **fields)
    except Exception as error:
        words = "write it with ccd_casadi.extensions.cad.draw_morph"
        raise PlantError(f"{Path(file).name}: is not a morphed mesh ({error}); {words}") from None


def _terms(unit: Array, exponents: np.ndarray) -> Array:
    """(k,) monomials at ξ."""
    return np.prod(unit[None, :] ** exponents, axis=1)
