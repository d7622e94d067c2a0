"""The plants that a case file may name: case study 1, those of extensions and of packages."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, cast

import casadi as ca

from ccd_casadi.plants.plant import Plant, build_plant
from ccd_casadi.support import extensions


def two_mass(theta: Mapping[str, Any], zeta: float = 0.01) -> dict[str, Any]:
    """The paper's two-mass system, k = 2 m1⁴ + 2 m2⁴, force and sensor on m1 (equation (14)).

    θ: m1, m2 in kg; u in N, y in m. The damper b = 2 ζ √(k μ), μ = m1 m2/(m1 + m2), keeps the
    damping ratio of the flexible mode at `zeta`. Hardware cost: m1 + m2 in kg.
    """
    m1, m2 = theta["m1"], theta["m2"]
    k = 2 * m1**4 + 2 * m2**4
    b = 2 * zeta * ca.sqrt(k * m1 * m2 / (m1 + m2))
    spring = ca.DM([[1, -1], [-1, 1]])
    return {
        "mass": ca.diag(ca.vertcat(m1, m2)),
        "damping": b * spring,
        "stiffness": k * spring,
        "input": ca.DM([1, 0]),
        "output": ca.DM([[1, 0]]),
        "hardware_cost": m1 + m2,
    }


def two_mass_plant(names: Sequence[str], zeta: float = 0.01) -> Plant:
    """The plant of `two_mass`, θ in the order of `names`."""
    return build_plant(two_mass, names, {"zeta": zeta})


GROUP = "ccd_casadi.plants"


@dataclass(frozen=True)
class Model:
    """A plant model that a case file may name.

    Attributes
    ----------
    build : callable
        build(names of θ, **options) -> Plant; raises PlantError.
    theta : tuple of str, optional
        The parameters that it needs; None: any.
    checks : mapping
        Option -> a check of its value, which returns what is wrong or None.
    data : str
        The option that names its data, relative to the case file.
    sound : bool
        Whether it is known to be sound: it is then not diagnosed on loading.
    annotated : bool
        Whether the annotations of `build` say what each option takes.
    """

    build: Callable[..., Plant]
    theta: tuple[str, ...] | None = None
    checks: Mapping[str, Callable[[Any], str | None]] = field(default_factory=dict)
    data: str = ""
    sound: bool = False
    annotated: bool = False


TWO_MASS = Model(two_mass_plant, theta=("m1", "m2"), sound=True, annotated=True)


@cache
def _offer() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def model_names() -> list[str]:
    """List all models, those of installed packages among them, without importing these.

    Returns
    -------
    list of str
        Sorted.
    """
    return sorted({"two_mass", *extensions.collect_declared("plants"), *_offer()})


@cache
def model_named(name: str | None) -> Model | None:
    """Find a model by its name.

    Parameters
    ----------
    name : str or None

    Returns
    -------
    Model or None
        None where there is none of that name.
    """
    if name is None or name == "two_mass":
        return TWO_MASS if name else None
    if place := extensions.find("plants", name):
        return cast(Model, extensions.load(place))
    if name in extensions.SHIPPED["plants"] or name not in _offer():
        return None
    found = _offer()[name].load()
    return found if isinstance(found, Model) else Model(found)
