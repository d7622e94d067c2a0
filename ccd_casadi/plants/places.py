"""Forces and sensors where θ puts them: shapes between nodes, and masses that move with them.

The inputs of the plant below are unit forces at nodes p_k, columns b_k: a node moves by b_kᵀ x.
Between nodes b is interpolated (`nodes`), and a mass m at p adds m b(p) b(p)ᵀ to M. Frequencies,
shapes and inertia move with it, exactly within the coordinates of the plant: how many modes these
must be is identified by its references.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import casadi as ca
import numpy as np
import scipy

from ccd_casadi.drawing.content import Curve, Figure, Lines, Panel, Table
from ccd_casadi.drawing.svg import GREEN, GREY, ORANGE, ModeShape, ModeShapes
from ccd_casadi.plants.as_written import natural_modes
from ccd_casadi.plants.fixed_parameters import reparametrise
from ccd_casadi.plants.nodes import (
    NodeInterpolation,
    Position,
    Positions,
    at_reference,
    followed_modes,
    in_axes,
    names_in,
)
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class Places:
    """The places where forces act and sensors read, and their masses.

    With `axes` all forces act, and all sensors read, together along the motions of a rigid body
    normal to the nodes, 1, x, y, in directions of length 1: the number of inputs and outputs is
    that of the axes, for any number of actuators.

    Attributes
    ----------
    nodes : tuple of points (N, d)
        Nodes of the plant's inputs, in their order, m.
    actuators, sensors : tuple of Position
        Coordinates in m or names of θ; without `sensors` the plant's own outputs are read.
    actuator_mass, sensor_mass : float
        kg of each.
    apart : float
        Least distance between two actuators, and between two sensors, m.
    axes : bool
        Whether forces and sensors are combined to rigid-body axes.
    quiet : tuple of int
        Flexible modes, from 1 by frequency, that the axes neither drive nor read.
    damped : tuple of int
        Flexible modes that are axes themselves.
    reference : tuple of points (3 or 4, 2)
        Inputs are loads and outputs displacements at these points (`nodes.at_reference`).
    present : tuple of str
        A θ from 0 to 1 for each actuator: its force is multiplied by √θ (γ² of a mixed sensitivity
        is convex in θ), its mass by θ.
    choose : int
        Largest number of actuators that are present.
    actuator_cost : float
        Added to f for each actuator that is present.
    """

    nodes: tuple[tuple[float, ...], ...]
    actuators: tuple[Position, ...]
    sensors: tuple[Position, ...] = ()
    actuator_mass: float = 0.0
    sensor_mass: float = 0.0
    apart: float = 0.0
    axes: bool = False
    quiet: tuple[int, ...] = ()
    damped: tuple[int, ...] = ()
    reference: tuple[tuple[float, ...], ...] = ()
    present: tuple[str, ...] = ()
    choose: int = 0
    actuator_cost: float = 0.0

    @property
    def identity(self) -> dict[str, object]:
        """Its values; those that earlier stores do not know only where they are given."""
        later = ("reference", "present", "choose", "actuator_cost")
        return {key: value for key, value in vars(self).items() if value or key not in later}

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that it takes, each once."""
        return names_in((*self.actuators, *self.sensors, self.present))


def place_ports(plant: Plant, places: Places, names: Sequence[str]) -> Plant:
    """Move a plant's forces and sensors to their places.

    Parameters
    ----------
    plant : Plant
        With one input for each node, a unit force there.
    places : Places
    names : sequence of str
        θ (n,) of the new plant, those of `plant` and of `places`, in this order.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        Nodes and inputs, or coordinates of nodes and places, do not match.
    """
    nodes = np.array(places.nodes, float)
    if len(nodes) != plant.inputs:
        words = f"places.nodes are {len(nodes)}, the plant has {plant.inputs} inputs"
        raise PlantError(f"{words}; give one for each, and each input a unit force at one")
    for point in (*places.actuators, *places.sensors):
        if len(point) != nodes.shape[1]:
            words = f"has {len(point)} coordinates, a node {nodes.shape[1]}"
            raise PlantError(f"places: {list(point)} {words}; make them agree")
    axes = places.axes * (1 + nodes.shape[1] + len(places.damped))
    least = min(places.choose or len(places.actuators), len(places.sensors))
    if axes and least < axes + len(places.quiet):
        words = f"need {axes + len(places.quiet)} actuators and sensors or more"
        raise PlantError(f"places.axes, quiet and damped {words}; add some, or drop a mode")
    reference = len(places.reference)
    if reference and (nodes.shape[1] != 2 or reference not in (3, 4) or least < reference):
        words = "needs nodes in a plane, 3 or 4 points, and no fewer actuators and sensors"
        raise PlantError(f"places.reference {words}")
    between, order = NodeInterpolation(nodes), list(names).index
    own, there = ([order(name) for name in part] for part in (plant.names, places.present))
    given = len(there) == len(places.actuators) and places.choose and (axes or reference)
    if there and not given:
        words = "needs a name for each actuator, choose, and axes or a reference; add them"
        raise PlantError(f"places.present {words}")
    points = Positions(places.actuators, names), Positions(places.sensors, names)
    for word, group in zip(
        ("actuator", "sensor")[: 1 + bool(places.sensors)], points, strict=False
    ):
        still, slack = ~group.slope.any(axis=2), 1e-9 * np.ptp(nodes, axis=0)
        beyond = np.clip(group.constant, nodes.min(axis=0) - slack, nodes.max(axis=0) + slack)
        for i in np.flatnonzero((still & (beyond != group.constant)).any(axis=1)):
            at = ", ".join(f"{x:g}" for x in group.constant[i])
            ends = " and ".join(
                f"({', '.join(f'{x:g}' for x in end(nodes, axis=0))})" for end in (np.min, np.max)
            )
            words = f"{word} {i + 1} at ({at}) is beyond the nodes, which lie between {ends}"
            raise PlantError(f"places: {words}; move it between them, or add nodes")

    def of(evaluate: Evaluate) -> PlacedMechanics:
        return PlacedMechanics(evaluate, places, between, *points, own, there)

    def below(theta: Sequence[float]) -> tuple[float, ...]:
        return tuple(float(theta[i]) for i in own)

    def notes(theta: Sequence[float]) -> tuple[str, ...]:
        whole = plant.evaluate(below(theta))
        at = np.array([point for group in points for point in group.at(np.asarray(theta))])
        error = between.left_out(_flexible(whole)[1].T @ whole.B, at)
        return (
            *plant.notes(below(theta)),
            f"forces and sensors stand between {len(nodes)} nodes: the inner ones nearest to them, "
            f"left out, are predicted to {100.0 * error:.2g} % of a mode's largest displacement",
        )

    evaluate = of(plant.evaluate)
    x = ca.MX.sym("theta", len(names))
    f, lam = plant.hardware(ca.vertcat(*(x[i] for i in own)))
    f += places.actuator_cost * (ca.sum1(x[there]) if there else len(places.actuators))
    rules = _rules(evaluate, x)
    return reparametrise(
        plant,
        of,
        below,
        names=tuple(names),
        constraint_names=(*plant.constraint_names, *rules),
        evaluate=evaluate,
        hardware=ca.Function("hardware", [x], [f, ca.vertcat(lam, *rules.values())]),
        outputs=axes or reference or len(places.sensors) or plant.outputs,
        inputs=axes or reference or len(places.actuators),
        notes=notes,
        domain=_domain(plant, evaluate, len(names)),
        shapes=evaluate.shapes if nodes.shape[1] == 2 else None,
        drawing=evaluate.drawing if nodes.shape[1] < 3 else None,
    )


@dataclass(frozen=True)
class PlacedMechanics:
    """θ -> Mechanics; `evaluate` takes the parameters `own` of it, the points are moved by all;
    `there` are those that say which actuators are."""

    evaluate: Evaluate
    places: Places
    between: NodeInterpolation
    actuators: Positions
    sensors: Positions
    own: list[int]
    there: list[int]
    absent: float = 1e-12  # presence of an actuator that is not there: √ has a slope above 0

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        values = np.asarray(theta, float)
        below = self.evaluate(tuple(values[self.own].tolist())).with_mass("[places]")
        count = len(values) if len(below.derivatives[0]) or not self.own else 0

        def spread(slopes: Array) -> Array:
            """Derivatives to the plant's own θ, among those to all."""
            out = np.zeros((count, *slopes.shape[1:]))
            if count:
                out[self.own] = slopes
            return out

        places, B0 = self.places, below.B
        dM, dD, dK, dB0, dC = map(spread, below.derivatives)
        (W, dW), (R, dR) = (
            self.between.weights(points, values) for points in (self.actuators, self.sensors)
        )
        root = np.sqrt(np.maximum(values[self.there], self.absent)) if self.there else 1.0
        W, dW, dR = W * root, dW[:count] * root, dR[:count]
        for i, k in enumerate(self.there if count else ()):
            dW[k, :, i] += 0.5 * W[:, i] / max(values[k], self.absent)
        M = below.M
        for w, dw, kg in ((W, dW, places.actuator_mass), (R, dR, places.sensor_mass)):
            F = B0 @ w
            half = kg * (dB0 @ w + B0 @ dw) @ F.T
            M, dM = M + kg * F @ F.T, dM + half + half.transpose(0, 2, 1)
        if places.axes:
            phi, dphi = followed_modes(M, below.K, dM, dK, (*places.quiet, *places.damped))
            quiet, nodes = len(places.quiet), self.between.nodes
            rigid = np.hstack([np.ones((len(nodes), 1)), nodes])
            motions = np.insert(B0.T @ phi, [quiet] * rigid.shape[1], rigid, axis=1)
            moved = dB0.transpose(0, 2, 1) @ phi + B0.T @ dphi
            dmotions = np.insert(moved, [quiet] * rigid.shape[1], 0.0, axis=2)
            W, dW = in_axes(W, dW, motions, dmotions, quiet)
            R, dR = in_axes(R, dR, motions, dmotions, quiet)
        if places.reference:
            at = np.array(places.reference)
            W, dW = at_reference(W, dW, self.between.nodes, at)
            R, dR = at_reference(R, dR, self.between.nodes, at)
        C = below.C
        if places.sensors:
            C, dC = (B0 @ R).T, (dB0 @ R + B0 @ dR).transpose(0, 2, 1)
        return replace(below, M=M, B=B0 @ W, C=C, derivatives=(dM, dD, dK, dB0 @ W + B0 @ dW, dC))

    def shapes(self, theta: Sequence[float], count: int) -> ModeShapes:
        """The lowest flexible modes at the nodes, with all masses where they are."""
        omega, modes = _flexible(self(theta))
        nodes = self.between.nodes
        moved = modes.T @ self.evaluate(tuple(float(theta[i]) for i in self.own)).B
        corners = scipy.spatial.Delaunay(nodes).simplices[:, [0, 1, 2, 2]]
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
            forces = self.actuators.at(values)
            forces = forces[values[self.there] > 0.5] if self.there else forces
            curves = [_dots(self.between.nodes, "node", GREY, ".")]
            kinds = (("sensor", self.sensors.at(values), GREEN, "o"),
                     ("force", forces, ORANGE, "x"))  # fmt: skip
            for label, at, colour, marker in kinds:
                curves += [_dots(at, label, colour, marker)] if len(at) else []
                rows += [(title, label, *(1e3 * p for p in point)) for point in at]
            flat = self.between.nodes.shape[1] > 1
            panels.append(Panel("x (mm)", "y (mm)", tuple(curves), title=title, equal=flat))
        axes = ("x (mm)", "y (mm)")[: self.between.nodes.shape[1]]
        return Figure(
            Lines((tuple(panels),), "where forces and sensors stand", (3.6,)),
            "Where forces act and sensors read, between the nodes of the model.",
            (Table(("design", "what", *axes), tuple(rows)),),
        )


def _flexible(system: Mechanics) -> tuple[Array, Array]:
    """ω in rad/s and shapes, as columns, of the flexible modes."""
    lam, modes, rigid = natural_modes(system.K, system.M)
    return np.sqrt(lam[~rigid]), modes[:, ~rigid]


def _rules(of: PlacedMechanics, theta: ca.MX) -> dict[str, ca.MX]:
    """λ by name: least distances, where θ moves them, and how many are there."""
    found: dict[frozenset[Position], tuple[str, ca.MX]] = {}  # a force and its sensor are one place
    for word, points, group in (("actuators", of.places.actuators, of.actuators),
                                ("sensors", of.places.sensors, of.sensors)):  # fmt: skip
        for i, j in combinations(range(len(points)) if of.places.apart else (), 2):
            slope = group.slope[i] - group.slope[j]
            if slope.any():
                name = f"{word} {i + 1} and {j + 1} apart"
                away = ca.DM(group.constant[i] - group.constant[j]) + ca.DM(slope) @ theta
                lam = 1.0 - ca.sumsqr(away) / of.places.apart**2
                found.setdefault(frozenset((points[i], points[j])), (name, lam))
    rules = dict(found.values())
    if of.there:
        rules["actuators chosen"] = ca.sum1(theta[of.there]) / of.places.choose - 1.0
    return rules


def _domain(plant: Plant, of: PlacedMechanics, count: int) -> tuple[Array, Array]:
    """The plant's, and for positions the box around the nodes."""
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    if plant.domain is not None:
        low[of.own], high[of.own] = plant.domain
    ends = of.between.nodes.min(axis=0), of.between.nodes.max(axis=0)
    for points in (of.actuators, of.sensors):
        for point, axis, k in np.argwhere(points.slope):
            least, most = sorted(points.slope[point, axis, k] * end[axis] for end in ends)
            low[k], high[k] = max(low[k], least), min(high[k], most)
    low[of.there], high[of.there] = 0.0, 1.0
    return low, high


def _dots(at: Array, label: str, colour: str, marker: str) -> Curve:
    x, y = 1e3 * at[:, 0], 1e3 * at[:, 1] if at.shape[1] > 1 else 0.0 * at[:, 0]
    return Curve(x, y, label, colour, line="", marker=marker)
