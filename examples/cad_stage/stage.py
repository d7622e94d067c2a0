"""A levitated carrier drawn with build123d: a hub with a bore, and three tapered arms with holes.

python examples/cad_stage/stage.py        draws and meshes it, writes stage.npz; extra `cad`
"""

import math
from pathlib import Path

import build123d as cad

from ccd_casadi.extensions.cad.cad_stage import draw_morph

HUB, BORE, ROOT = 50.0, 24.0, 74.0  # mm: radii, and an arm's width at the hub's centre
ARMS = {"left": (150.0, 130.0), "right": (30.0, 130.0), "front": (270.0, 104.0)}  # degrees, mm
BOUNDS = {"height": (6e-3, 14e-3), "tip": (24e-3, 48e-3)}  # m
SIZE = 10e-3  # m, of an element


def solid(theta):
    """θ: `height` of the plate and width of an arm's `tip` in m; drawn in mm, as build123d does."""
    height, tip = 1e3 * theta["height"], 1e3 * theta["tip"]
    outline, holes, ends = cad.Circle(HUB), cad.Circle(BORE), {}
    for name, (angle, reach) in ARMS.items():
        arm = cad.Polygon(
            (0.0, -0.5 * ROOT), (reach, -0.5 * tip), (reach, 0.5 * tip), (0.0, 0.5 * ROOT),
            align=None,
        )  # fmt: skip
        outline += cad.Rot(Z=angle) * arm
        holes += cad.Rot(Z=angle) * cad.Pos(X=0.72 * reach) * cad.Circle(0.3 * tip)
        a = math.radians(angle)
        ends[name] = (reach * math.cos(a), reach * math.sin(a), 0.5 * height)
    return cad.extrude(outline - holes, height), ends


if __name__ == "__main__":
    draw_morph(solid, BOUNDS, Path(__file__).parent / "stage.npz", size=SIZE)
