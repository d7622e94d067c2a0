"""The plants that a case file may name: the package's, and those of installed packages.

A package offers a plant of its own as an entry point of the group "ccd_casadi.plants", as
`case_studies` does the rib stage: a `Model`, or its builder alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from ccd_casadi.plants.plant import Plant

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


# Builder, and the rest of a Model. Finite elements and files of many formats take a sixth of a
# second to import, which a case that names neither does not wait for.
OWN: dict[str, tuple[str, dict[str, Any]]] = {
    "two_mass": ("two_mass.two_mass_plant", {"theta": ("m1", "m2"), "sound": True}),
    "modal_table": ("imported.plant.modal_table", {"data": "table"}),
    "sampled_matrices": ("imported.plant.sampled_matrices", {"data": "folder"}),
    "cad_stage": ("cad.plant.cad_stage", {"data": "morph"}),
}


def data_option(name: str | None) -> str:
    """The option of that model that names its data; empty where there is none."""
    found = model_named(name)
    return "" if found is None else found.data


@cache
def _offered() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def model_names() -> list[str]:
    """All names, those of installed packages among them; nothing of these is imported."""
    return sorted({*OWN, *_offered()})


@cache
def model_named(name: str | None) -> Model | None:
    """The model of that name; None where there is none."""
    if name in OWN:
        path, rest = OWN[name]
        module, _, builder = path.rpartition(".")
        return Model(getattr(import_module(f"{__package__}.{module}"), builder), **rest)
    if name is None or name not in _offered():
        return None
    found = _offered()[name].load()
    return found if isinstance(found, Model) else Model(found)
