"""A stage from CAD as the case file names it: its options, its plant, its mesh as polynomials of θ.

The CAD kernel draws and meshes once, and is needed no more afterwards. Node positions are
x(θ) = Σ_k c_k ξ^k, ξ the place in the box from -1 to 1, fitted by least squares to the moved mesh
at twice as many θ as there are terms, denser towards the bounds. Their velocities ∂x/∂θ are
therefore exact derivatives of this model; how far it is from the drawn solid is measured at θ that
the fit has not seen.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.drawing.content import Figure
from ccd_casadi.drawing.surface import surface_figure
from ccd_casadi.drawing.svg import ModeShapes
from ccd_casadi.extensions.cad import solid
from ccd_casadi.extensions.cad.elastic_body import Body, mode_shapes, reduce_body, surface
from ccd_casadi.extensions.cad.solid import volumes
from ccd_casadi.plants.differenced import remember
from ccd_casadi.plants.finite_elements import Material
from ccd_casadi.plants.fixed_parameters import with_fixed
from ccd_casadi.plants.plant import Mechanics, Plant, named_values
from ccd_casadi.plants.registry import Model
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.support.errors import PlantError, require
from ccd_casadi.support.terminal import Progress

FORMAT = "ccd_casadi morph 1"
# θ by name -> the solid (build123d, in mm, or a STEP file) and a point in mm on each named face
SolidDrawing = Callable[[Mapping[str, float]], tuple[Any, Mapping[str, Sequence[float]]]]


@dataclass(frozen=True)
class MorphOptions:
    """Numbers of the fit of a mesh."""

    unseen: int = 5  # θ beside those of the fit, at which its error is measured
    most_error: float = 1e-3  # largest error, as a share of the mesh size
    rounding: float = 1e-12  # m: coefficients are rounded to multiples of it


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
        mesh = solid.mesh_solid(gmsh, size)
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
    """Write a morph as an .npz file without pickled objects."""
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


MOTIONS = ("x", "y", "z", "rx", "ry", "rz")  # of the rigid body, about its centre of gravity


def cad_stage(
    names: Sequence[str],
    morph: str = "",
    forces: Sequence[str] = (),
    sensors: Sequence[str] = (),
    rigid: Sequence[str] = MOTIONS,
    held: Sequence[str] = (),
    modes: int = 10,
    zeta: float = 0.01,
    young: float = 68.9e9,
    poisson: float = 0.33,
    density: float = 2700.0,
) -> Plant:
    """Make the plant of a stage whose mesh `draw_morph` wrote; its hardware cost is its mass in kg.

    Its reference is the same stage with twice as many modes.

    Parameters
    ----------
    names : sequence of str (n,)
        θ, those of the mesh in any order.
    morph : str
        File of the mesh.
    forces, sensors : sequences of str
        "FACE:x", y or z: a force spread evenly over a named face, the mean displacement of one;
        without, all faces along z.
    rigid : sequence of str
        Rigid-body motions in the model, of x, y, z, rx, ry, rz.
    held : sequence of str
        Faces that do not move; a stage without floats.
    modes : int
        Flexible modes.
    zeta : float
        Their damping ratio.
    young, poisson, density : float
        Pa, 1, kg/m³.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        A name of the case is not one of the mesh; the message has the remedy.
    """
    if not morph:
        raise PlantError('cad_stage needs morph = "stage.npz", relative to the case file')
    require("skfem", "cad")
    mesh, file = read_morph(morph), Path(morph).name
    if sorted(names) != sorted(mesh.names):
        raise PlantError(
            f"{file} has the parameters {', '.join(mesh.names)}, the case {', '.join(names)}; "
            "make them agree"
        )
    every = tuple(f"{face}:z" for face in mesh.faces)
    stage = CadStage(
        morph=mesh,
        material=Material(young, poisson, density),
        forces=_ports("forces", forces or every, mesh),
        sensors=_ports("sensors", sensors or every, mesh),
        rigid=tuple(_one_of("rigid", name, MOTIONS) for name in rigid),
        held=tuple(_one_of("held", name, tuple(mesh.faces)) for name in held),
        modes=modes,
        damping_ratio=zeta,
    )
    return plant_of_stage(stage, names, file)


Port = tuple[str, int]  # a face and an axis


@dataclass(frozen=True)
class CadStage:
    """A morphed mesh with its material, forces, sensors and the modes of its model."""

    morph: Morph
    material: Material
    forces: tuple[Port, ...]
    sensors: tuple[Port, ...]
    rigid: tuple[str, ...] = MOTIONS
    held: tuple[str, ...] = ()
    modes: int = 10
    damping_ratio: float = 0.01

    def mechanics(self, theta: Sequence[float], derivatives: bool = True) -> Mechanics:
        """Rigid-body motions, then flexible modes by frequency; SI. θ in the morph's order."""
        ports = tuple(dict.fromkeys((*self.forces, *self.sensors)))
        body = Body(self.morph.points(theta), self.morph.tets, self.material)
        velocities = self.morph.velocities(theta)[: None if derivatives else 0]
        nodes = len(body.places)
        F = np.zeros((3 * nodes, len(ports)))
        dF = np.zeros((len(velocities), 3 * nodes, len(ports)))
        for k, (face, axis) in enumerate(ports):
            block = slice(axis * nodes, (axis + 1) * nodes)
            F[block, k], dF[:, block, k] = body.mean(self.morph.faces[face], velocities)
        found = reduce_body(body, velocities, F, dF, self.modes, self._mark_held(body))
        count = found.M.shape[0] - self.modes
        rows = [MOTIONS.index(name) for name in self.rigid] if count else []
        rows += range(count, count + self.modes)
        pick = np.ix_(rows, rows)
        drive, read = (
            [ports.index(port) for port in group] for group in (self.forces, self.sensors)
        )
        F, dF = found.F[rows], found.dF[:, rows]
        dM, dK = (item[:, rows][:, :, rows] for item in (found.dM, found.dK))
        n = len(rows)
        return Mechanics(
            M=found.M[pick], D=np.zeros((n, n)), K=found.K[pick],
            B=F[:, drive], C=F[:, read].T, damping_ratio=self.damping_ratio,
            derivatives=(
                dM, np.zeros_like(dM), dK, dF[:, :, drive], dF[:, :, read].transpose(0, 2, 1),
            ),
        )  # fmt: skip

    def _mark_held(self, body: Body) -> np.ndarray:
        """(3N,) the unknowns that are zero."""
        held = np.zeros((3, len(body.places)), dtype=bool)
        for face in self.held:
            held[:, body.on(self.morph.faces[face])] = True
        return held.ravel()

    def shapes(self, theta: Sequence[float], count: int) -> ModeShapes:
        """The lowest flexible modes on the surface."""
        body = Body(self.morph.points(theta), self.morph.tets, self.material)
        return mode_shapes(body, count, self._mark_held(body))

    def drawing(self, thetas: Mapping[str, Sequence[float]]) -> Figure:
        """Stages by name; θ in the morph's order."""
        used, faces = surface(self.morph.tets)
        surfaces = {name: self.morph.points(theta)[used] for name, theta in thetas.items()}
        return surface_figure(surfaces, faces, [self.mass(theta) for theta in thetas.values()])

    def mass(self, theta: Sequence[float] | Array) -> float:
        """Compute the mass in kg."""
        return float(
            self.material.density * volumes(self.morph.points(theta), self.morph.tets).sum()
        )

    def mass_slope(self, theta: Sequence[float] | Array) -> Array:
        """Compute ∂mass/∂θ, (p,)."""
        corners = self.morph.points(theta)[self.morph.tets]
        moved = self.morph.velocities(theta)[:, self.morph.tets]
        edges, steps = (part[..., 1:, :] - part[..., :1, :] for part in (corners, moved))
        growth = np.einsum("tij,ptji->pt", np.linalg.inv(edges), steps)
        return self.material.density * growth @ np.linalg.det(edges) / 6.0


def plant_of_stage(stage: CadStage, names: Sequence[str], file: str = "the mesh") -> Plant:
    """The stage as the plant that the design loop asks for, θ in the order of `names`."""
    morph = stage.morph
    middle, half = 0.5 * (morph.lower + morph.upper), 0.5 * (morph.upper - morph.lower)

    # in units of the box, so that CasADi's differences of the slope have a fitting step
    mass = VectorCallback(
        "mass", len(names), 1,
        lambda unit: np.array([stage.mass(middle + half * unit)]),
        lambda unit: (half * stage.mass_slope(middle + half * unit))[None],
        hessians=True,
    )  # fmt: skip
    theta, finer = ca.MX.sym("theta", len(names)), replace(stage, modes=2 * stage.modes)
    notes = (
        f"the stage is the mesh of {file} moved with theta, {len(morph.tets)} tetrahedra, within "
        f"{morph.error:.1e} m of the drawing where that was checked; its first "
        f"{stage.modes} flexible modes",
    )
    plant = Plant(
        names=morph.names,
        constraint_names=(),
        evaluate=remember(stage.mechanics),
        hardware=ca.Function("hardware", [theta], [mass((theta - middle) / half), ca.MX(0, 1)]),
        outputs=len(stage.sensors),
        inputs=len(stage.forces),
        references={"twice as many modes": remember(finer.mechanics, False)},
        exact_hessian=False,
        values=remember(stage.mechanics, False),
        notes=lambda theta: notes,
        domain=(morph.lower, morph.upper),
        shapes=stage.shapes,
        drawing=stage.drawing,
        callback=mass,
    )
    return with_fixed(plant, {}, names)


def _ports(key: str, texts: Sequence[str], morph: Morph) -> tuple[Port, ...]:
    found = []
    for text in texts:
        face, _, axis = str(text).rpartition(":")
        if axis not in ("x", "y", "z"):
            raise PlantError(f'{key}: {text!r} has no direction; write "FACE:z", or x or y')
        found.append((_one_of(key, face, tuple(morph.faces)), "xyz".index(axis)))
    return tuple(found)


def _one_of(key: str, name: str, known: tuple[str, ...]) -> str:
    if name not in known:
        raise PlantError(f"{key}: {name!r} is none of {', '.join(known)}; correct it")
    return name


MODEL = Model(cad_stage, data="morph", annotated=True)
