"""The plants that a case file may name: the package's, and those of installed packages.

A package offers a plant of its own as an entry point of the group "ccd_casadi.plants", as
`case_studies` does the rib stage: a `Model`, or its builder alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from ccd_casadi.plants.plant import Plant
from ccd_casadi.plants.two_mass import two_mass_plant

GROUP = "ccd_casadi.plants"


@dataclass(frozen=True)
class Model:
    """`build(names of θ, **options)` gives the plant, and raises PlantError.

    theta: the parameters that it needs; None: any. checks: what is wrong with an option's value,
    None where nothing is. data: the option that names its data, relative to the case file. sound:
    known to be, not diagnosed on loading.
    """

    build: Callable[..., Plant]
    theta: tuple[str, ...] | None = None
    checks: Mapping[str, Callable[[Any], str | None]] = field(default_factory=dict)
    data: str = ""
    sound: bool = False


OWN = ("two_mass", "modal_table", "sampled_matrices", "cad_stage")


def _own(name: str) -> Model:
    """Finite elements and files of many formats take a sixth of a second to import, which a case
    that names neither does not wait for."""
    if name == "two_mass":
        return Model(two_mass_plant, theta=("m1", "m2"), sound=True)
    if name == "cad_stage":
        from ccd_casadi.plants.cad.plant import cad_stage

        return Model(cad_stage, data="morph")
    from ccd_casadi.plants.imported.plant import modal_table, sampled_matrices

    if name == "modal_table":
        return Model(modal_table, data="table")
    return Model(sampled_matrices, data="folder")


@cache
def _offered() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def model_names() -> list[str]:
    """All names, those of installed packages among them; nothing of these is imported."""
    return sorted({*OWN, *_offered()})


@cache
def model_named(name: str | None) -> Model | None:
    """The model of that name; None where there is none."""
    if name is not None and name in OWN:
        return _own(name)
    if name is None or name not in _offered():
        return None
    found = _offered()[name].load()
    return found if isinstance(found, Model) else Model(found)
