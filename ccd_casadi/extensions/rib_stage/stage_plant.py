"""Case study 2 as the case file names it: the options of `rib_stage`, and the plant they make."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import casadi as ca

from ccd_casadi.cases.checks import FRACTION, POSITIVE, choice, number, rows
from ccd_casadi.drawing.content import Figure
from ccd_casadi.extensions.rib_stage import reduced
from ccd_casadi.extensions.rib_stage.geometry import (
    COARSE,
    FINE,
    NAMES,
    Geometry,
    MeshOrder,
    Point,
    PointMass,
)
from ccd_casadi.extensions.rib_stage.model import (
    FORTY_FOUR,
    OUTPUTS,
    ROWS,
    TWENTY,
    ModeCount,
    RibStage,
)
from ccd_casadi.extensions.rib_stage.pictures import mode_shapes
from ccd_casadi.plants.differenced import remember
from ccd_casadi.plants.finite_elements import Material, StageError
from ccd_casadi.plants.fixed_parameters import with_fixed
from ccd_casadi.plants.plant import Evaluate, Plant
from ccd_casadi.plants.registry import Model

MESHES = {"coarse": COARSE, "shipped": MeshOrder(), "fine": FINE}
MODES = {10: ModeCount(), 20: TWENTY, 44: FORTY_FOUR}
Points = Sequence[Sequence[float]]


def rib_stage(
    names: Sequence[str],
    zeta: float = 0.01,
    outputs: str = "corners",
    mesh: str = "shipped",
    modes: int = 10,
    fading: int = 0,
    side: float = 0.3,
    young: float = 68.9e9,
    poisson: float = 0.33,
    density: float = 2700.0,
    least_bay: float = 8e-3,
    actuators: Points = (),
    sensors: Points = (),
    point_masses: Points = (),
) -> Plant:
    """The rib-reinforced stage, θ in m named as in `geometry.NAMES`, in any order.

    `actuators` and `sensors` are points [x, y] of the lower face in m (none: the corners),
    `point_masses` are [x, y, mass] in m and kg. Hardware cost: mass in kg; λ: the bays.
    `modes` flexible ones are kept, 10, 20 or 44, and `fading` more of each group that
    point masses leave apart, in part. References: the same stage on a finer mesh and with 20
    flexible modes, so far as it is not that itself.
    """
    if sorted(names) != sorted(NAMES):
        raise StageError(f"rib_stage has the parameters {', '.join(NAMES)}; give all of them")
    if mesh not in MESHES:
        raise StageError(f"mesh is {mesh!r}; choose one of {', '.join(MESHES)}")
    if modes not in MODES:
        raise StageError(f"modes is {modes!r}; choose 10, 20 or 44")
    if fading not in range((most := 8) + 1):
        raise StageError(f"fading is {fading!r}; give a whole number from 0 to {most}")
    geometry = Geometry(
        side=side,
        material=Material(young, poisson, density),
        point_masses=tuple(_point_mass(x, y, mass, side) for x, y, mass in point_masses),
        least_bay=least_bay,
    )
    stage = RibStage(
        geometry=geometry,
        order=MESHES[mesh],
        actuators=_points(actuators),
        sensors=_points(sensors),
        outputs=outputs,
        modes=MODES[modes],
        fading=fading,
        damping_ratio=zeta,
    )
    return plant_of_stage(stage, names)


def plant_of_stage(stage: RibStage, names: Sequence[str] = NAMES) -> Plant:
    """Any RibStage as the plant that the design loop asks for."""

    def nearby(known: Sequence[Sequence[float]]) -> Evaluate:
        made = reduced.bases(stage, tuple(map(tuple, known)))
        return remember(lambda theta, _: reduced.mechanics(stage, made, theta))

    def drawing(thetas: Mapping[str, Sequence[float]]) -> Figure:
        from ccd_casadi.extensions.rib_stage import pictures

        return pictures.drawing(stage.geometry, thetas)

    theta = ca.SX.sym("theta", len(NAMES))
    mass, constraints = stage.hardware(ca.vertsplit(theta))
    count = ROWS.get(stage.outputs)
    references = {}
    if stage.modes.total < TWENTY.total:
        references["20 flexible modes"] = replace(stage, modes=TWENTY)
    if stage.order != FINE:
        references["a finer mesh"] = replace(stage, order=FINE)
    plant = Plant(
        names=NAMES,
        constraint_names=tuple(constraints),
        evaluate=remember(stage.mechanics),
        hardware=ca.Function("hardware", [theta], [mass, ca.vertcat(*constraints.values())]),
        outputs=count or len(stage.sensor_points),
        inputs=count or len(stage.actuator_points),
        references={
            name: remember(variant.mechanics, False) for name, variant in references.items()
        },
        values=remember(stage.mechanics, False),
        expensive=reduced.applies(stage),
        nearby=nearby if reduced.applies(stage) else None,
        shapes=partial(mode_shapes, stage),
        drawing=drawing,
    )
    return with_fixed(plant, {}, names)


def _points(points: Points) -> tuple[Point, ...] | None:
    return tuple((float(x), float(y)) for x, y in points) or None


def _point_mass(x: float, y: float, mass: float, side: float) -> PointMass:
    if not mass > 0.0:
        raise StageError(f"point_masses: {mass:g} kg is not a mass; give a number above 0")
    if max(abs(x), abs(y)) > 0.5 * side * (1.0 + 1e-12):
        raise StageError(f"point_masses: ({x:g}, {y:g}) is off the stage; move it inside")
    return PointMass(float(x), float(y), float(mass))


MODEL = Model(
    rib_stage,
    theta=NAMES,
    checks={
        "zeta": FRACTION,
        "outputs": choice(*OUTPUTS),
        "mesh": choice(*MESHES),
        "poisson": number(0.0, 0.5, "give a number between 0 and 0.5"),
        **dict.fromkeys(("side", "young", "density", "least_bay"), POSITIVE),
        "actuators": rows(2),
        "sensors": rows(2),
        "point_masses": rows(3),
    },
    sound=True,
)
