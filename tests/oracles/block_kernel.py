"""What gmsh answers of a sheared block, without gmsh: its wheel needs X11's libraries, CI has none.

A drawing is a JSON file: `size` (mm), `shear` (mm of x at the top), `turn` (its pieces are numbered
from there on), `solids`. tests/plants/test_cad_solid.py asks gmsh itself where that is installed.
"""

import json
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

CELLS = 3  # along each side
CORNERS = [np.array(c) for c in product((0, 1), repeat=3)]
# an edge runs along an axis from a corner, a face lies at one end of an axis
EDGES = [(a, c) for a in range(3) for c in CORNERS if c[a] == 0]
FACES = [(a, end) for a in range(3) for end in (0, 1)]
# six tetrahedra of a cell: one path from its lowest to its highest corner each, right-handed
PATHS = [(0, 1, 2), (1, 2, 0), (2, 0, 1), (1, 0, 2), (0, 2, 1), (2, 1, 0)]


def draw(path: Path, size: Any, shear: float = 0.0, turn: int = 0, solids: int = 1) -> Path:
    """Write a drawing; lengths in mm."""
    data = {"size": [*map(float, size)], "shear": shear, "turn": turn, "solids": solids}
    path.write_text(json.dumps(data))
    return path


class Block:
    """A stand-in for the module gmsh."""

    def __init__(self) -> None:
        nothing = lambda *_, **__: None  # noqa: E731
        self.option = SimpleNamespace(setNumber=nothing, setString=nothing)
        self.initialize = self.finalize = nothing
        self.isInitialized = lambda: False
        occ = SimpleNamespace(
            importShapes=self.read, synchronize=nothing, getCenterOfMass=self.centre
        )
        mesh = SimpleNamespace(
            generate=nothing, getNodes=self.nodes, getElementsByType=self.elements
        )
        names = ("add", "remove", "setCurrent")
        self.model = SimpleNamespace(
            occ=occ, mesh=mesh, getEntities=self.entities, getValue=self.value,
            getBoundary=self.rim, getType=self.kind, getClosestPoint=self.nearest,
            isInside=self.inside, getParametrizationBounds=lambda d, tag: ([0.0], [1.0]),
            **dict.fromkeys(names, nothing),
        )  # fmt: skip

    def read(self, path: str) -> None:
        drawn = json.loads(Path(path).read_text())
        self.solids, self.turn = drawn["solids"], drawn["turn"]
        self.axes = 1e-3 * np.diag(drawn["size"])  # columns: the block's sides
        self.axes[0, 2] = 1e-3 * drawn["shear"]

    def place(self, unit: Any) -> np.ndarray:
        return np.asarray(unit, float) @ self.axes.T

    def entities(self, dimension: int) -> list[tuple[int, int]]:
        count = (8, 12, 6, self.solids)[dimension]
        return [(dimension, 1 + (i + self.turn) % count) for i in range(count)]

    def number(self, dimension: int, index: int) -> int:
        return self.entities(dimension)[index][1]

    def piece(self, dimension: int, tag: int) -> Any:
        pieces: Any = (CORNERS, EDGES, FACES)[dimension]
        return pieces[(tag - 1 - self.turn) % len(pieces)]

    def value(self, dimension: int, tag: int, parameters: Any) -> np.ndarray:
        if dimension == 0:
            return self.place(self.piece(0, tag))
        axis, corner = self.piece(1, tag)
        return self.place(corner + np.outer(parameters, np.eye(3)[axis])).ravel()

    def centre(self, dimension: int, tag: int) -> np.ndarray:
        axis, end = self.piece(2, tag)
        unit = np.full(3, 0.5)
        unit[axis] = end
        return self.place(unit)

    def rim(self, pieces: list[tuple[int, int]], oriented: bool) -> list[tuple[int, int]]:
        (dimension, tag), = pieces  # fmt: skip
        axis, there = self.piece(dimension, tag)
        if dimension == 1:
            ends = [i for i, c in enumerate(CORNERS) if (np.delete(c - there, axis) == 0).all()]
            return [(0, self.number(0, i)) for i in ends]
        around = [i for i, (a, c) in enumerate(EDGES) if a != axis and c[axis] == there]
        return [(1, self.number(1, i)) for i in around]

    def kind(self, dimension: int, tag: int) -> str:
        return ("Point", "Line", "Plane")[dimension]

    def nearest(self, dimension: int, tag: int, points: Any) -> tuple[np.ndarray, np.ndarray]:
        axis, end = self.piece(2, tag)
        here = np.reshape(points, (-1, 3)) - end * self.axes[:, axis]
        sides = np.delete(self.axes, axis, axis=1)
        shares = np.linalg.lstsq(sides, here.T, rcond=None)[0]
        return ((sides @ shares).T + end * self.axes[:, axis]).ravel(), shares.T.ravel()

    def inside(self, dimension: int, tag: int, shares: Any, parametric: bool) -> bool:
        return bool(((np.asarray(shares) > -1e-9) & (np.asarray(shares) < 1.0 + 1e-9)).all())

    @property
    def grid(self) -> np.ndarray:
        return np.array([*product(range(CELLS + 1), repeat=3)])

    def labels(self, points: Any) -> np.ndarray:
        side = CELLS + 1
        return 1 + np.asarray(points) @ np.array([side * side, side, 1])

    def nodes(self, dimension: int = -1, tag: int = -1) -> tuple[np.ndarray, np.ndarray, Any]:
        points, parameters = self.grid, np.empty(0)
        if dimension == 0:
            points = CELLS * self.piece(0, tag)[None, :]
        elif dimension == 1:
            axis, corner = self.piece(1, tag)
            steps = np.arange(1, CELLS)
            points, parameters = (
                CELLS * corner + np.outer(steps, np.eye(3, dtype=int)[axis]),
                (steps / CELLS),
            )
        return self.labels(points), self.place(points / CELLS).ravel(), parameters

    def elements(self, kind: int, tag: int = -1) -> tuple[None, np.ndarray]:
        tets = []
        for low in product(range(CELLS), repeat=3):
            for path in PATHS:
                steps = np.cumsum([np.zeros(3, int), *np.eye(3, dtype=int)[list(path)]], axis=0)
                odd = path in PATHS[3:]
                tets.append((low + steps)[[1, 0, 2, 3] if odd else [0, 1, 2, 3]])
        if kind == 4:
            return None, self.labels(np.array(tets)).ravel()
        axis, end = self.piece(2, tag)
        found = []
        for tet in tets:
            on = tet[tet[:, axis] == CELLS * end]
            if len(on) == 3:
                found.append(on)
        return None, self.labels(np.array(found)).ravel()
