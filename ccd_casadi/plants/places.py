"""Forces and sensors where θ puts them: shapes between nodes, and masses that move with them.

The inputs of the plant below are unit forces at nodes p_k, columns b_k: a node moves by b_kᵀ x.
Between nodes b is a polyharmonic spline, linear in what it interpolates and three times
differentiable:

    b(p) = Σ_k w_k(p) b_k,   w(p) = the first N columns of [|p - p_j|⁵, 1, p, p pᵀ] A⁻¹.

A mass m at p adds m b(p) b(p)ᵀ to M. Frequencies, shapes and inertia move with it, exactly within
the coordinates of the plant: how many modes these must be is told by its references.

Source: Duchon (1977) for the spline; Rippa, Adv. Comput. Math. 11 (1999), for nodes left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement

import casadi as ca
import numpy as np
from scipy.linalg import eigh
from scipy.spatial import Delaunay

from ccd_casadi.drawing.content import Curve, Figure, Lines, Panel, Table
from ccd_casadi.drawing.pictures import ModeShape, ModeShapes
from ccd_casadi.drawing.svg import GREEN, GREY, ORANGE
from ccd_casadi.plants.fixed import through
from ccd_casadi.plants.modal import RIGID_RATIO
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.units import HZ

Coordinate = float | str  # a number, the name of a θ, or that name after a minus sign
Point = tuple[Coordinate, ...]
HALF = 1e-2  # a presence z counts as √z from about here on, so that its slope at 0 is finite


@dataclass(frozen=True)
class Places:
    """Where forces act and sensors read, m; without `sensors` the plant's own outputs are read.

    `nodes` (N, d): of the plant's inputs, in their order. `present`, one for each actuator: 1 where
    it is there, 0 where not, a θ where that is chosen; at most `at_most` are. `actuator_cost` is
    what each adds to f. Masses in kg. Actuators, and sensors, are at least `apart` from each other.

    With `axes` all forces act, and all sensors read, together along the motions of a rigid body
    normal to the nodes, 1, x, y, in directions of length 1: as many inputs and outputs, however
    many actuators. `quiet` flexible modes, from 1 by frequency, are neither driven nor read by
    them; each `damped` one is an axis of its own.
    """

    nodes: tuple[tuple[float, ...], ...]
    actuators: tuple[Point, ...]
    sensors: tuple[Point, ...] = ()
    actuator_mass: float = 0.0
    sensor_mass: float = 0.0
    apart: float = 0.0
    present: tuple[Coordinate, ...] = ()
    at_most: int | None = None
    actuator_cost: float = 0.0
    axes: bool = False
    quiet: tuple[int, ...] = ()
    damped: tuple[int, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that it takes, each once."""
        return names_in((*self.actuators, *self.sensors, self.present))


def names_in(points: Sequence[Sequence[Coordinate]]) -> tuple[str, ...]:
    """The parameters that coordinates name, each once.

    >>> names_in((("r", 0.1), ("-r", "s")))
    ('r', 's')
    """
    texts = (value for point in points for value in point if isinstance(value, str))
    return tuple(dict.fromkeys(text.removeprefix("-") for text in texts))


def placed(plant: Plant, places: Places, names: Sequence[str]) -> Plant:
    """The plant with its forces and sensors at their places, θ in the order of `names`.

    Raises PlantError where nodes and inputs, or coordinates of nodes and places, do not match.
    """
    nodes = np.array(places.nodes, float)
    if len(nodes) != plant.inputs:
        words = f"places.nodes are {len(nodes)}, the plant has {plant.inputs} inputs"
        raise PlantError(f"{words}; give one for each, and each input a unit force at one")
    for point in (*places.actuators, *places.sensors):
        if len(point) != nodes.shape[1]:
            words = f"has {len(point)} coordinates, a node {nodes.shape[1]}"
            raise PlantError(f"places: {list(point)} {words}; make them agree")
    if places.present and len(places.present) != len(places.actuators):
        words = f"{len(places.present)} numbers for {len(places.actuators)} actuators"
        raise PlantError(f"places.present has {words}; give one for each")
    axes = places.axes * (1 + nodes.shape[1] + len(places.damped))
    least = min(len(places.actuators), len(places.sensors))
    if axes and least < axes + len(places.quiet):
        words = f"need {axes + len(places.quiet)} actuators and sensors or more"
        raise PlantError(f"places.axes, quiet and damped {words}; add some, or drop a mode")
    between, own = Between(nodes), [list(names).index(name) for name in plant.names]

    def of(evaluate: Evaluate) -> PlacedMechanics:
        return PlacedMechanics(evaluate, places, between, tuple(names), own)

    def below(theta: Sequence[float]) -> tuple[float, ...]:
        return tuple(float(theta[i]) for i in own)

    def notes(theta: Sequence[float]) -> tuple[str, ...]:
        whole = plant.evaluate(below(theta))
        error = between.left_out(_flexible(whole)[1].T @ whole.B)
        return (
            *plant.notes(below(theta)),
            f"forces and sensors stand between {len(nodes)} nodes: an inner one, left out, is "
            f"predicted to {100.0 * error:.2g} % of a mode's largest displacement at worst",
        )

    whole = of(plant.evaluate)
    x = ca.MX.sym("theta", len(names))
    f, lam = plant.hardware(ca.vertcat(*(x[i] for i in own)))
    f += places.actuator_cost * sum(whole.there.symbols(x))
    lam = ca.vertcat(lam, *_rules(places, whole, x).values())
    return through(
        plant,
        of,
        below,
        names=tuple(names),
        constraint_names=(*plant.constraint_names, *_rules(places, whole, x)),
        evaluate=whole,
        hardware=ca.Function("hardware", [x], [f, lam]),
        outputs=axes or len(places.sensors) or plant.outputs,
        inputs=axes or len(places.actuators),
        notes=notes,
        domain=_domain(plant, places, nodes, names),
        shapes=whole.shapes if nodes.shape[1] == 2 else None,
        drawing=whole.drawing if nodes.shape[1] < 3 else None,
    )  # fmt: skip


class Between:
    """w(p) and its slopes, for nodes (N, d)."""

    def __init__(self, nodes: Array) -> None:
        self.nodes, count = nodes, len(nodes)
        self.centre = 0.5 * (nodes.max(axis=0) + nodes.min(axis=0))
        self.size = max(0.5 * float(np.ptp(nodes, axis=0).max()), 1e-300)
        self._at = (nodes - self.centre) / self.size
        rows = [self._row(at) for at in self._at]
        kernel, power = (np.array([row[k] for row in rows]) for k in (0, 1))
        q = power.shape[1]
        if np.linalg.matrix_rank(power, 1e-6) < q or (kernel + np.eye(count)).min() == 0.0:
            words = "places.nodes are too few, on one line or curve, or one is there twice"
            raise PlantError(f"{words}; three or more in every direction, on a grid, do")
        self._inverse = np.linalg.inv(np.block([[kernel, power], [power.T, np.zeros((q, q))]]))
        self._inverse = self._inverse[:, :count]

    def weights(self, point: Array) -> tuple[Array, Array]:
        """(N,) at a point (d,), and the slopes (d, N)."""
        kernel, power, dkernel, dpower = self._row((point - self.centre) / self.size)
        slopes = np.vstack([dkernel, dpower]).T @ self._inverse
        return np.concatenate([kernel, power]) @ self._inverse, slopes / self.size

    def left_out(self, values: Array) -> float:
        """How far fields (n, N) at an inner node are from what the others say, over their largest.

        Nodes at the edge are not counted: beyond the others nothing is interpolated.
        """
        count, inner = (
            len(self.nodes),
            (np.abs(self._at) < np.abs(self._at).max(axis=0)).all(axis=1),
        )
        gap = (self._inverse[:count] @ values.T) / np.diag(self._inverse[:count])[:, None]
        share = np.abs(gap[inner]) / np.abs(values).max(axis=1, initial=1e-300)
        return float(share.max(initial=0.0))

    def _row(self, at: Array) -> tuple[Array, Array, Array, Array]:
        """Kernel and polynomial at a scaled point, and their slopes (., d)."""
        away, eye = at - self._at, np.eye(len(at))
        r = np.linalg.norm(away, axis=1)
        pairs = list(combinations_with_replacement(range(len(at)), 2))
        power = np.array([1.0, *at, *(at[i] * at[j] for i, j in pairs)])
        slopes = [at[i] * eye[j] + at[j] * eye[i] for i, j in pairs]
        return r**5, power, 5.0 * r[:, None] ** 3 * away, np.vstack([0.0 * at, eye, *slopes])


class _Linear:
    """Rows of coordinates as a linear function of θ: `constant` (m, d) + `slope` (m, d, n) θ."""

    def __init__(self, points: Sequence[Sequence[Coordinate]], names: Sequence[str]) -> None:
        shape = (len(points), len(points[0]) if points else 0)
        self.constant, self.slope = np.zeros(shape), np.zeros((*shape, len(names)))
        for i, point in enumerate(points):
            for j, value in enumerate(point):
                if isinstance(value, str):
                    sign = -1.0 if value.startswith("-") else 1.0
                    self.slope[i, j, list(names).index(value.removeprefix("-"))] = sign
                else:
                    self.constant[i, j] = value

    def at(self, theta: Array) -> Array:
        """At θ, (m, d)."""
        return np.asarray(self.constant + self.slope @ theta)

    def symbols(self, theta: ca.MX) -> list[ca.MX]:
        """The same of symbols, a vector for each row."""
        return [
            ca.DM(row) + ca.mtimes(ca.DM(slope), theta)
            for row, slope in zip(self.constant, self.slope, strict=True)
        ]


@dataclass(frozen=True)
class PlacedMechanics:
    """θ in the order of `names` -> Mechanics; `evaluate` takes the parameters `own` of them."""

    evaluate: Evaluate
    places: Places
    between: Between
    names: tuple[str, ...]
    own: list[int]

    @property
    def actuators(self) -> _Linear:
        """Where they are."""
        return _Linear(self.places.actuators, self.names)

    @property
    def sensors(self) -> _Linear:
        """Where they are."""
        return _Linear(self.places.sensors, self.names)

    @property
    def there(self) -> _Linear:
        """Whether each actuator is there."""
        present = self.places.present or (1.0,) * len(self.places.actuators)
        return _Linear([(value,) for value in present], self.names)

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        values = np.asarray(theta, float)
        below = self.evaluate(tuple(values[self.own].tolist()))
        count = len(values) if len(below.derivatives[0]) or not self.own else 0

        def spread(slopes: Array) -> Array:
            """Derivatives to the plant's own θ, among those to all."""
            out = np.zeros((count, *slopes.shape[1:]))
            if count:
                out[self.own] = slopes
            return out

        dM, dD, dK, dB0, dC = map(spread, below.derivatives)
        z, dz = self.there.at(values)[:, 0], self.there.slope[:, 0, :count]
        drive = z * np.sqrt((1.0 + HALF) / (z + HALF))  # 0 at 0, 1 at 1
        ddrive = np.sqrt((1.0 + HALF) / (z + HALF)) * (1.0 - 0.5 * z / (z + HALF))
        fields = []
        for group in (self.actuators, self.sensors):
            W, dW = self._weights(group, values, count)
            fields.append((below.B @ W, dB0 @ W + below.B @ dW))
        (F, dF), (R, dR) = fields
        kg = self.places.actuator_mass
        M = below.M + (F * kg * z) @ F.T + self.places.sensor_mass * R @ R.T
        half = dF @ (F * kg * z).T + self.places.sensor_mass * dR @ R.T
        dM = dM + half + half.transpose(0, 2, 1) + kg * np.einsum("xm,mt,ym->txy", F, dz, F)
        B, dB = F * drive, dF * drive + np.einsum("xm,mt->txm", F * ddrive, dz)
        if not self.places.axes:
            read = bool(self.places.sensors)
            C, dC = (R.T, dR.transpose(0, 2, 1)) if read else (below.C, dC)
            return replace(below, M=M, B=B, C=C, derivatives=(dM, dD, dK, dB, dC))
        modes = _followed(M, below.K, dM, dK, (*self.places.quiet, *self.places.damped))
        B, dB = self._in_axes(self.actuators, values, (B, dB), (drive, ddrive[:, None] * dz), modes)
        ones = np.ones(R.shape[1])
        R, dR = self._in_axes(
            self.sensors, values, (R, dR), (ones, np.zeros((len(ones), count))), modes
        )
        dC = dR.transpose(0, 2, 1)
        return replace(below, M=M, B=B, C=R.T, derivatives=(dM, dD, dK, dB, dC))

    def _in_axes(
        self,
        group: _Linear,
        theta: Array,
        fields: tuple[Array, Array],
        share: tuple[Array, Array],
        modes: tuple[Array, Array],
    ) -> tuple[Array, Array]:
        """b (n, m) and its slopes, combined by the directions of `Places.axes`.

        The columns of [b'φ of quiet modes, 1, x, y, b'φ of damped ones] at the points, each brought
        to length 1 beside those before it; without the quiet ones, which the rest does not see.
        """
        (b, db), (s, ds), (phi, dphi) = fields, share, modes
        quiet, at = len(self.places.quiet), group.at(theta)
        seen, dseen = b.T @ phi, db.transpose(0, 2, 1) @ phi + b.T @ dphi
        rigid = s[:, None] * np.hstack([np.ones((len(s), 1)), at])
        drigid = np.zeros((len(db), *rigid.shape))
        drigid[:, :, 1:] = s[:, None] * group.slope[:, :, : len(db)].transpose(2, 0, 1)
        drigid += ds.T[:, :, None] * np.hstack([np.ones((len(s), 1)), at])
        A = np.hstack([seen[:, :quiet], rigid, seen[:, quiet:]])
        dA = np.concatenate([dseen[:, :, :quiet], drigid, dseen[:, :, quiet:]], axis=2)
        Q, dQ = _orthonormal(A, dA)
        Q, dQ = Q[:, quiet:], dQ[:, :, quiet:]
        return b @ Q, db @ Q + b @ dQ

    def shapes(self, theta: Sequence[float], count: int) -> ModeShapes:
        """The lowest flexible modes at the nodes, with all masses where they are."""
        omega, modes = _flexible(self(theta))
        nodes = self.between.nodes
        moved = modes.T @ self.evaluate(tuple(float(theta[i]) for i in self.own)).B
        corners = Delaunay(nodes).simplices[:, [0, 1, 2, 2]]
        flat = np.zeros((len(nodes), 3))
        found = [
            ModeShape(flat + row[:, None] * [0.0, 0.0, 1.0], float(w) / HZ, (i + 1,))
            for i, (w, row) in enumerate(zip(omega[:count], moved, strict=False))
        ]
        return ModeShapes(np.hstack([nodes, flat[:, :1]]), corners, tuple(found))

    def drawing(self, thetas: Mapping[str, Sequence[float]]) -> Figure:
        """Nodes, forces and sensors, for each design a panel."""
        panels, rows = [], []
        for title, theta in thetas.items():
            values = np.asarray(theta, float)
            curves = [_dots(self.between.nodes, "node", GREY, ".")]
            there = self.there.at(values)[:, 0] > 0.5
            kinds = (("sensor", self.sensors.at(values), GREEN, "o"),
                     ("force", self.actuators.at(values)[there], ORANGE, "x"))  # fmt: skip
            for label, at, colour, marker in kinds:
                curves += [_dots(at, label, colour, marker)] if len(at) else []
                rows += [(title, label, *(1e3 * p for p in point)) for point in at]
            panels.append(Panel("x (mm)", "y (mm)", tuple(curves), title=title))
        axes = ("x (mm)", "y (mm)")[: self.between.nodes.shape[1]]
        return Figure(
            Lines((tuple(panels),), "where forces and sensors stand", (3.6,)),
            "Where forces act and sensors read, between the nodes of the model.",
            (Table(("design", "what", *axes), tuple(rows)),),
        )

    def _weights(self, group: _Linear, theta: Array, count: int) -> tuple[Array, Array]:
        """w of every point (N, m), and its slopes (count, N, m)."""
        points = group.at(theta)
        W = np.zeros((len(self.between.nodes), len(points)))
        dW = np.zeros((count, *W.shape))
        for i, point in enumerate(points):
            W[:, i], slopes = self.between.weights(point)
            dW[:, :, i] = group.slope[i, :, :count].T @ slopes
        return W, dW


def _flexible(system: Mechanics) -> tuple[Array, Array]:
    """ω in rad/s and shapes, as columns, of the flexible modes."""
    lam, modes = eigh(system.K, system.M)
    flexible = lam > RIGID_RATIO**2 * lam[-1]
    return np.sqrt(lam[flexible]), modes[:, flexible]


def _followed(
    M: Array, K: Array, dM: Array, dK: Array, numbers: Sequence[int]
) -> tuple[Array, Array]:
    """Shapes of flexible modes, from 1 by frequency, as columns, and their slopes.

    φ' = Σ_j φ_j φ_jᵀ(K' - λ M')φ/(λ - λ_j) - φ φᵀM'φ/2,   j over all other modes
    """
    lam, modes = eigh(K, M)
    flexible = np.flatnonzero(lam > RIGID_RATIO**2 * lam[-1])
    if max(numbers, default=0) > len(flexible):
        raise PlantError(f"places: mode {max(numbers)} is beyond the {len(flexible)} flexible ones")
    at = flexible[[number - 1 for number in numbers]]
    modes[:, at] *= np.where(modes[np.abs(modes[:, at]).argmax(axis=0), at] < 0.0, -1.0, 1.0)
    slopes = np.zeros((len(dM), len(M), len(at)))
    for k, i in enumerate(at):
        gap = lam[i] - lam
        gap[i] = np.inf
        moved = (dK - lam[i] * dM) @ modes[:, i]
        own = 0.5 * (dM @ modes[:, i]) @ modes[:, i]
        slopes[:, :, k] = (moved @ modes / gap) @ modes.T - own[:, None] * modes[:, i]
    return modes[:, at], slopes


def _orthonormal(A: Array, dA: Array) -> tuple[Array, Array]:
    """Q of A = Q R with a positive diagonal of R, and its slopes: dQ = Q Ω + (I - Q Qᵀ) dA R⁻¹."""
    Q, R = np.linalg.qr(A)
    if np.abs(np.diag(R)).min() < 1e-9 * np.abs(np.diag(R)).max():
        words = "places: forces or sensors are on one line, or a quiet or damped mode is not seen"
        raise PlantError(f"{words} where they are; move one, or drop the mode")
    sign = np.where(np.diag(R) < 0.0, -1.0, 1.0)
    Q, R = Q * sign, sign[:, None] * R
    step = dA @ np.linalg.inv(R)
    turn = Q.T @ step
    lower = np.tril(turn, -1)
    return Q, Q @ (lower - lower.transpose(0, 2, 1)) + step - Q @ turn


def _rules(places: Places, of: PlacedMechanics, theta: ca.MX) -> dict[str, ca.MX]:
    """λ by name: least distances, where θ moves them, and how many actuators there may be."""
    found: dict[str, ca.MX] = {}
    seen: set[frozenset[Point]] = set()
    for word, points, group in (("actuators", places.actuators, of.actuators),
                                ("sensors", places.sensors, of.sensors)):  # fmt: skip
        at = group.symbols(theta) if places.apart else []
        for i, j in combinations(range(len(at)), 2):
            pair = frozenset((points[i], points[j]))  # a force and its sensor are at one place
            if (group.slope[i] != group.slope[j]).any() and pair not in seen:
                seen.add(pair)
                away = at[i] - at[j]
                found[f"{word} {i + 1} and {j + 1} apart"] = 1.0 - ca.sumsqr(away) / places.apart**2
    if places.at_most is not None:
        count = ca.sum1(ca.vertcat(*of.there.symbols(theta)))
        found[f"at most {places.at_most} actuators"] = count / places.at_most - 1.0
    return found


def _domain(
    plant: Plant, places: Places, nodes: Array, names: Sequence[str]
) -> tuple[Array, Array]:
    """The plant's, and for positions the box around the nodes."""
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    if plant.domain is not None:
        own = [list(names).index(name) for name in plant.names]
        low[own], high[own] = plant.domain
    first, last = nodes.min(axis=0), nodes.max(axis=0)
    for point in (*places.actuators, *places.sensors):
        for axis, value in enumerate(point):
            if isinstance(value, str):
                i = list(names).index(value.removeprefix("-"))
                least, most = (-last, -first) if value.startswith("-") else (first, last)
                low[i], high[i] = max(low[i], least[axis]), min(high[i], most[axis])
    return low, high


def _dots(at: Array, label: str, colour: str, marker: str) -> Curve:
    x, y = 1e3 * at[:, 0], 1e3 * at[:, 1] if at.shape[1] > 1 else 0.0 * at[:, 0]
    return Curve(x, y, label, colour, line="", marker=marker)
