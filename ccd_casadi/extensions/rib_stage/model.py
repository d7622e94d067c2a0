"""The stage as a plant: θ in, the flexible modes that are kept and their exact derivatives out.

The plant keeps a fixed number of modes of each symmetry, or the lowest of all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ccd_casadi.extensions.rib_stage import geometry as shape
from ccd_casadi.extensions.rib_stage import stage_modes
from ccd_casadi.extensions.rib_stage.assembly import AS, SA
from ccd_casadi.extensions.rib_stage.geometry import (
    RIGID_NAMES,
    Geometry,
    MeshOrder,
    Point,
    has_square_symmetry,
    rigid_fields,
    rigid_values,
)
from ccd_casadi.plants.finite_elements import StageError
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.worker_process import side_by_side


@dataclass(frozen=True)
class ModeCount:
    """The number of flexible modes of each symmetry that are kept; `tilt` counts pairs SA, AS.

    The default are the ten lowest of the stage of 0.59 kg and 110.5 Hz, and the cut leaves a gap
    of a tenth to the next mode of each symmetry; a third A1 mode would meet the fourth there
    (1782 and 1802 Hz). B1 and A2 rest on the diagonals of the square, so that actuators and
    sensors at the corners neither drive nor see them.
    """

    A1: int = 2
    B1: int = 1
    B2: int = 2
    A2: int = 1
    tilt: int = 2

    @property
    def total(self) -> int:
        """Flexible modes in all."""
        return self.A1 + self.B1 + self.B2 + self.A2 + 2 * self.tilt

    def of(self, group: stage_modes.Group) -> int:
        """Modes solved of a group of symmetries."""
        return sum(getattr(self, "tilt" if s in (SA, AS) else s.name) for s in group.solved)


TWENTY = ModeCount(A1=4, B1=2, B2=4, A2=2, tilt=4)  # to see spill-over
# To see what twenty hide: the lightest stages' modes up to 3.4 kHz, with a payload too.
FORTY_FOUR = ModeCount(A1=8, B1=6, B2=8, A2=6, tilt=8)


@dataclass(frozen=True)
class Mode:
    """The origin of a column of the model; group, place and image are -1 of a rigid-body mode."""

    name: str  # symmetry: z, tip, tilt, A1, B1, B2, A2, SA, AS, or "-" without symmetry
    sector: str  # of the quarter that is solved, S or A about x and y: SS, SA, AS, AA, or "-"
    frequency: float  # Hz
    group: int = -1  # of symmetries that are solved together, its number in ModeSet.spectra
    place: int = -1  # among the modes of that group, the lowest is 0
    image: int = -1  # of the symmetries that one solution stands for, as SA and AS of a square


@dataclass(frozen=True)
class ModeSet:
    """The modes solved at one θ and the flexible ones kept of them, in the model's order."""

    spectra: tuple[stage_modes.GroupModes, ...]
    flexible: tuple[Mode, ...]

    def kept_count(self, group: int) -> int:
        """Return the number of the lowest modes of a spectrum that are in the model."""
        return 1 + max((m.place for m in self.flexible if m.group == group), default=-1)


def fade(values: Array, slopes: Array, full: int) -> tuple[Array, Array]:
    """Compute the weights w (k,) of the displacements of a group's modes, and their slopes (θ, k).

    `values` (k + 1,) and `slopes` (θ, k + 1) are λ of k modes that are kept and of the next one, b;
    the first `full` count whole, a being the last of these, the others by Hermite's step

        w = t²(3 - 2t),   t = (λ_b - λ)/(λ_b - λ_a),   w' = 6t(1 - t) t',
        t' = (λ_b' - λ' - t (λ_b' - λ_a'))/(λ_b - λ_a).

    A mode without displacements is neither driven nor seen, so that the plant has lost it. Where
    two modes nearly meet they change places in the order of λ, and the plant does not jump: w = 1
    on both sides where a and the next one do, w = 0 where b and the one before it do.
    """
    a, b = full - 1, len(values) - 1
    span, slope = values[b] - values[a], (slopes[:, b] - slopes[:, a])[:, None]
    t = np.minimum((values[b] - values[:b]) / span, 1.0)
    dt = np.where(t < 1.0, (slopes[:, b, None] - slopes[:, :b] - t * slope) / span, 0.0)
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) * dt


def solve_modes(
    disc: stage_modes.Discretisation,
    geometry: Geometry,
    theta: Array,
    count: ModeCount,
    by_frequency: bool,
    fading: int = 0,
    points: Sequence[Point] = (),
) -> ModeSet:
    """Solve every symmetry (or direct sums of them) at θ and choose the modes of the model.

    By symmetry the order is A1, B1, B2, A2, then SA and AS in turns, or the even and the odd ones
    about an axis, lowest first in each: it does not change where frequencies of different
    symmetries cross. The `fading` ones of every group follow. With `points` they have slopes of
    displacements there, computed while a group's factorisation is in memory: all at once are large.
    """
    square = has_square_symmetry(geometry)
    wanted = {}
    for group in stage_modes.groups_of(geometry):
        number = count.of(group)
        if by_frequency:  # no symmetry of the square has more than half of the lowest
            number = max(count.total // 2, 1) if square else count.total
        if number:
            wanted[group] = number
    boxes = disc.assembler.box_matrices(theta, stage_modes.StageModeOptions.shift)

    def solve(group: stage_modes.Group) -> stage_modes.GroupModes:
        keep = wanted[group] + fading
        found = stage_modes.spectrum(
            disc, geometry, theta, group, keep + stage_modes.StageModeOptions.extra, boxes
        )
        return stage_modes.group_modes(disc, geometry, found, keep + bool(fading), points)

    largest_first = list(wanted)[::-1]  # the tilts have twice as many displacements as the others
    found = dict(zip(largest_first, side_by_side(solve, largest_first), strict=True))
    spectra = tuple(found[group] for group in wanted)
    flexible = [
        _mode(item, index, place, image)
        for whole in (True, False)  # then those that fade
        for index, (item, number) in enumerate(zip(spectra, wanted.values(), strict=True))
        for place in (range(number) if whole else range(number, number + fading))
        for image in range(len(item.group.images))
    ]
    if by_frequency:
        flexible = sorted(flexible, key=lambda mode: mode.frequency)[: count.total]
    return ModeSet(spectra, tuple(flexible))


def _mode(item: stage_modes.GroupModes, group: int, place: int, image: int) -> Mode:
    symmetries = item.group.images[image]
    known = len(symmetries) == 1
    hertz = float(np.sqrt(item.values[place]) / (2.0 * np.pi))
    name, sector = (symmetries[0].name, symmetries[0].sector) if known else ("-", "-")
    return Mode(name, sector, hertz, group, place, image)


OUTPUTS = ("corners", "rigid", "modal4", "z")
ROWS = {"z": 1, "rigid": 3, "modal4": 4}  # directions of those that are not the corners


@dataclass(frozen=True)
class RibStage:
    """The rib-reinforced levitated stage, θ = (h, t_o, t_i, t_c, H, x_i) in m.

    `actuators` and `sensors` are points (x, y) of the lower face in m; None means the four
    corners. `outputs`: "corners" keeps forces (N) and displacements (m) as they are, "rigid"
    decouples to z, tip and tilt by orthonormal rigid-body directions, "modal4" adds the twist, "z"
    keeps that alone and the modes that it moves, of a stage whose point masses leave it apart.
    `truncation`: "symmetry" keeps `modes` of each symmetry, so that crossing frequencies do not
    make the model jump; "frequency" keeps as many of the lowest of all. A stage whose point
    masses break the square has no symmetries and is truncated by frequency. `fading` modes more of
    each of its groups count in part, see `fade`: the plant does not jump where the last
    one kept and the next, whose shapes the masses couple, nearly meet.
    """

    geometry: Geometry = field(default_factory=Geometry)
    order: MeshOrder = field(default_factory=MeshOrder)
    actuators: tuple[Point, ...] | None = None
    sensors: tuple[Point, ...] | None = None
    outputs: str = "corners"
    modes: ModeCount = field(default_factory=ModeCount)
    truncation: str = "symmetry"
    fading: int = 0
    damping_ratio: float = 0.01

    def __post_init__(self) -> None:
        if self.outputs not in OUTPUTS:
            raise StageError(f"outputs is {self.outputs!r}; give one of {', '.join(OUTPUTS)}")
        if self.truncation not in ("symmetry", "frequency"):
            raise StageError(f"truncation is {self.truncation!r}; give symmetry or frequency")
        if self.fading and (has_square_symmetry(self.geometry) or self.truncation != "symmetry"):
            raise StageError("fading is for point masses that break the square; leave it out")
        half = 0.5 * self.geometry.side * (1 + 1e-12)
        for points in (self.actuator_points, self.sensor_points):
            if not points:
                raise StageError("the stage has no actuator or no sensor; give one point or more")
            if not all(abs(v) <= half for p in points for v in p):
                raise StageError("an actuator or a sensor is off the stage; move it inside")
            if self.outputs == "modal4" and len(points) != 4:
                raise StageError("modal4 needs four actuators and four sensors")
            if self.outputs != "corners":
                orthonormal_directions(points, 3)

    @property
    def actuator_points(self) -> tuple[Point, ...]:
        """The points where the forces act."""
        return shape.corners(self.geometry) if self.actuators is None else self.actuators

    @property
    def sensor_points(self) -> tuple[Point, ...]:
        """The points where displacements are read."""
        return shape.corners(self.geometry) if self.sensors is None else self.sensors

    def mechanics(self, theta: Sequence[float], derivatives: bool = True) -> Mechanics:
        """M = I, D = 0, K = diag(ω²), B and C of 3 rigid and the flexible modes, and ∂/∂θ.

        Rows: z, tip, tilt, then flexible modes; M (n, n), B (n, m) in 1/√kg, C (p, n), SI.
        Derivatives are those of these matrices themselves: M stays I, K stays diagonal (but for
        entries between modes of equal frequency in a stage without symmetry). Cached; read-only.
        Without derivatives, a quarter of the work, they are those to no parameter.
        """
        return _mechanics(self, _check(self, theta), derivatives)

    def frequencies(self, theta: Sequence[float]) -> tuple[Mode, ...]:
        """The modes of the model in the order of its rows, three rigid ones first, Hz."""
        rigid = tuple(Mode(name, "rigid", 0.0) for name in RIGID_NAMES)
        return (*rigid, *modes_at(self, _check(self, theta)).flexible)

    def hardware(self, theta: Any) -> tuple[Any, dict[str, Any]]:
        """Mass in kg and λ(θ) <= 0 (no unit) for floats or CasADi symbols, in closed form."""
        here = [theta[i] for i in range(len(shape.NAMES))]
        return shape.mass(self.geometry, here), shape.constraints(self.geometry, here)


def orthonormal_directions(points: Sequence[Point], count: int) -> Array:
    """(count, points): z, tip, tilt as orthonormal rows, fourth what is left of four points.

    Rigid motions move a point (x, y) by 1, y and x. Gram-Schmidt of these at the points and of xy,
    in this order, by QR, each with the sign of its function; at the corners of a square the rows
    are (1, 1, 1, 1)/2, (1, 1, -1, -1)/2, (1, -1, -1, 1)/2 and (1, -1, 1, -1)/2.

    >>> orthonormal_directions(((1, 1), (-1, 1), (-1, -1), (1, -1)), 4)[3].round(6).tolist()
    [0.5, -0.5, 0.5, -0.5]
    """
    x, y = np.array(points, float).T
    functions = np.stack([np.ones_like(x), y, x, x * y])
    if len(points) < 3 or np.linalg.matrix_rank(functions[:3]) < 3:
        raise StageError("actuators and sensors must not lie on one line; move one")
    rows = np.linalg.qr(functions.T, mode="complete")[0].T[:count]
    along = (rows * functions[:count]).sum(axis=1)
    return rows * np.where(along < 0.0, -1.0, 1.0)[:, None]


def _check(stage: RibStage, theta: Sequence[float]) -> tuple[float, ...]:
    values = tuple(float(v) for v in theta)
    if len(values) != len(shape.NAMES) or not all(np.isfinite(v) and v > 0.0 for v in values):
        raise StageError(f"theta must be six lengths in m: {', '.join(shape.NAMES)}")
    if min(shape.bays(stage.geometry, values)) <= 0.0:
        raise StageError("the ribs overlap at this theta; keep the bays open")
    return values


def discretisation(stage: RibStage) -> stage_modes.Discretisation:
    """Mesh and sparsity patterns of a stage, shared by all of its θ."""
    return stage_modes.discretise(stage.order, stage.geometry.side, stage.geometry.material)


def modes_at(stage: RibStage, theta: tuple[float, ...], points: tuple[Point, ...] = ()) -> ModeSet:
    """The modes at θ, with slopes of displacements at `points`, if there are any.

    They are cached by what they depend on: actuators, sensors, outputs and damping do not count.
    """
    own = replace(stage, actuators=None, sensors=None, outputs="corners", damping_ratio=0.01)
    return _modes(own, theta, points)


@lru_cache(maxsize=2)
def _modes(stage: RibStage, theta: tuple[float, ...], points: tuple[Point, ...]) -> ModeSet:
    by_frequency = stage.truncation == "frequency"
    return solve_modes(
        discretisation(stage), stage.geometry, np.array(theta), stage.modes, by_frequency,
        stage.fading, points,
    )  # fmt: skip


_rigid_function = lru_cache(maxsize=16)(rigid_fields)


@lru_cache(maxsize=256)
def _mechanics(stage: RibStage, theta: tuple[float, ...], derivatives: bool) -> Mechanics:
    points, here = points_of(stage), np.array(theta)
    found = modes_at(stage, theta, points if derivatives else ())
    u, du, dK = _displacements(stage, found, here, points)
    lam = np.array([(2.0 * np.pi * mode.frequency) ** 2 for mode in found.flexible])
    return assemble(stage, lam, u, du, dK)


def points_of(stage: RibStage) -> tuple[Point, ...]:
    """Actuators and sensors, each point once."""
    return tuple(dict.fromkeys((*stage.actuator_points, *stage.sensor_points)))


def rigid_part(stage: RibStage, theta: Array) -> tuple[Array, Array]:
    """u_z of z, tip and tilt at the points (3, p), and its slopes (θ, 3, p)."""
    return rigid_values(_rigid_function(stage.geometry, points_of(stage)), theta)


def assemble(
    stage: RibStage, lam: Array, u: Array, du: Array | None = None, dK: Array | None = None
) -> Mechanics:
    """The stage's matrices from λ of the flexible modes and u_z of all at the points (n, p).

    In M-orthonormal modes M = I and K = diag(λ), and a force at a point drives a mode by its u_z
    there, as a sensor sees it: B = u at the actuators, C = uᵀ at the sensors. The points are these,
    each once; `du` (θ, n, p) and `dK` (θ, n, n) are the slopes of u and of K, if there are any.
    Read-only.
    """
    n, points = len(u), points_of(stage)
    du = np.zeros((0, *u.shape)) if du is None else du
    dK = np.zeros((0, n, n)) if dK is None else dK
    act = [points.index(p) for p in stage.actuator_points]
    sens = [points.index(p) for p in stage.sensor_points]
    B, dB, C, dC = u[:, act], du[:, :, act], u[:, sens].T, du[:, :, sens].transpose(0, 2, 1)
    if stage.outputs != "corners":
        rows = max(ROWS[stage.outputs], 3)
        drive = orthonormal_directions(stage.actuator_points, rows)[: ROWS[stage.outputs]].T
        read = orthonormal_directions(stage.sensor_points, rows)[: ROWS[stage.outputs]]
        B, dB, C, dC = B @ drive, dB @ drive, read @ C, read @ dC
    K = np.diag([0.0, 0.0, 0.0, *lam])
    if stage.outputs == "z":
        moved = np.abs(B[:, 0]) > 1e-9 * np.abs(B).max()  # modes with less of z are not moved
        if moved[1:3].any():
            raise StageError("z moves tip or tilt of this stage; choose other outputs")
        K, dK, n = K[moved][:, moved], dK[:, moved][:, :, moved], int(moved.sum())
        B, dB, C, dC = B[moved], dB[:, moved], C[:, moved], dC[:, :, moved]
    zero = np.zeros((len(du), n, n))
    result = Mechanics(
        M=np.eye(n),
        D=np.zeros((n, n)),
        K=K,
        B=B,
        C=C,
        damping_ratio=stage.damping_ratio,
        derivatives=(zero, zero.copy(), dK, dB, dC),
    )
    for array in (result.M, result.D, result.K, result.B, result.C, *result.derivatives):
        array.flags.writeable = False  # shared by everyone who asks for this θ
    return result


def _displacements(
    stage: RibStage, found: ModeSet, theta: Array, points: tuple[Point, ...]
) -> tuple[Array, Array, Array]:
    """u_z of every mode at the points (n, p), its slopes (θ, n, p), and ∂K (θ, n, n).

    Of modes without slopes the last two have no entry along θ.
    """
    disc, n = discretisation(stage), 3 + len(found.flexible)
    count = len(theta) if found.spectra[0].slopes else 0
    u, du = np.zeros((n, len(points))), np.zeros((count, n, len(points)))
    dK = np.zeros((count, n, n))
    u[:3], slope = rigid_part(stage, theta)
    du[:, :3] = slope[:count]

    for index, item in enumerate(found.spectra):
        keep = found.kept_count(index)
        F, _ = stage_modes.heights(disc, item.group, theta, points)
        own = [(3 + r, m) for r, m in enumerate(found.flexible) if m.group == index]
        # columns of F: the points of the first image, then those of the next
        seen = [slice(k * len(points), (k + 1) * len(points))
                for k in range(len(item.group.images))]  # fmt: skip
        for row, mode in own:
            u[row] = F[:, seen[mode.image]].T @ item.vectors[:, mode.place]
        known = keep + bool(stage.fading)  # modes with slopes: `fade` needs the next one's too
        modes_dK = np.zeros((0, known, known))
        if item.slopes:
            modes_dK, modes_du = item.slopes
            for row, mode in own:
                du[:, row] = modes_du[:, seen[mode.image], mode.place]
                for column, other in own:
                    if other.image == mode.image:
                        dK[:, row, column] = modes_dK[:, mode.place, other.place]
        if stage.fading:
            dlam = np.diagonal(modes_dK, 0, 1, 2)
            w, dw = fade(item.values[:known], dlam, keep - stage.fading)
            for row, mode in own:
                du[:, row] = w[mode.place] * du[:, row] + dw[:, mode.place, None] * u[row]
                u[row] *= w[mode.place]
    return u, du, dK
