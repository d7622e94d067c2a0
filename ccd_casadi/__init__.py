"""Control co-design of precision motion stages: a machine and its H∞ controller, certified.

>>> import ccd_casadi as ccd
>>> problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
>>> round(ccd.true_inner(problem, (60.0, 60.0)).bandwidth / ccd.HZ, 1)
58.2

Names are imported when they are first used: this module alone loads neither numba nor CasADi.
"""

import sys
from importlib import import_module
from pathlib import PurePath
from types import ModuleType

from ccd_casadi.support.notebook import Shown

# a command is starting, not a library: its first import is this
if sys.argv[:1] == ["-m"] or PurePath(sys.argv[0] if sys.argv else "").stem == "ccd":
    import surrogates as _surrogates  # takes care of Ctrl-C while the rest is imported

    del _surrogates

# Every public name, and the module that defines it.
_PUBLIC = {
    "Bounds": "fixed_structure.bounds",
    "CoDesignProblem": "inner_problem.problem",
    "Direct": "codesign.direct",
    "HZ": "support.units",
    "Lifted": "codesign.lifted",
    "Nested": "codesign.nested",
    "Plant": "plants.plant",
    "Sampling": "fixed_structure.hold_and_delay",
    "SectionsDesign": "fixed_structure.sections_design",
    "Solution": "codesign.solution",
    "TWO_MASS": "cases.case",
    "StateSpace": "plants.scaling",
    "Structure": "fixed_structure.structure",
    "TrueQuantities": "inner_problem.true_function",
    "UserError": "support.errors",
    "Weights": "synthesis.weights",
    "build_plant": "plants.plant",
    "certify": "fixed_structure.certificate",
    "compare": "codesign.comparison",
    "deploy": "deployment.pipeline",
    "fit_modes": "fixed_structure.modal_fit",
    "load_case": "cases.case",
    "parse_case": "cases.case",
    "plant_from_control": "synthesis.interchange",
    "problem_of": "cases.case_problem",
    "read_frequency_response": "fixed_structure.measured",
    "read_run": "cases.run_folder",
    "robustness": "robust.study",
    "samples_frame": "interop.frames",
    "scaled_plant": "inner_problem.problem",
    "solve": "codesign.run",
    "synthesise": "synthesis.synthesis",
    "synthesise_sections": "fixed_structure.existing_plants",
    "true_design": "inner_problem.problem",
    "true_inner": "inner_problem.problem",
    "verify": "codesign.verify",
}
__all__ = [*_PUBLIC, "__version__"]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib import metadata  # slow to import

        return metadata.version("ccd-casadi")
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


def _html_of(item: object) -> str:
    return str(import_module(f"{__name__}.reporting.notebook").html_of(item))


Shown.drawn = _html_of  # loaded when something is shown, and not before


class _Package(ModuleType):
    """Keeps `ccd_casadi.solve` the function when the command's module of that name is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _PUBLIC and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
