"""Plants from finite-element programs: modal tables, matrices at samples, and results files.

Matrices and results become one modal table; the table, interpolated over θ, becomes the plant.

`python -m ccd_casadi.imported FOLDER`: result files or matrices at samples into modes.csv.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ccd_casadi.support.command_line import RUN, ExitCode, command, run_folder
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.options import integer, option, take_value
from ccd_casadi.support.terminal import inform

if TYPE_CHECKING:
    from ccd_casadi.extensions.imported.modal_table import ModalTable


EXTENSION = Extension(
    commands={
        "imported": (
            "ccd_casadi.extensions.imported",
            "make a modal table from result files; also: ccd import",
        )
    },
    plants={
        "modal_table": "ccd_casadi.extensions.imported.sampled_plant:MODAL_TABLE",
        "sampled_matrices": "ccd_casadi.extensions.imported.sampled_plant:SAMPLED_MATRICES",
    },
)


def _table(folder: Path, options: argparse.Namespace) -> "ModalTable":
    from ccd_casadi.extensions.imported.sampled_plant import (
        read_index,
        reduced_table,
        results_table,
    )

    columns = next(iter(read_index(folder).values()))
    if "results" in columns:
        return results_table(folder)
    if "mass" not in columns:
        words = "has neither a column results nor the columns mass and stiffness; add one"
        raise PlantError(f"{folder / 'index.csv'}: {words}")
    return reduced_table(folder, options.modes, options.static_correction)


@command(
    "ccd_casadi.imported",
    "Make a modal table from result files or matrices; see docs/own_finite_elements.md.",
    take_value("--modes", "N", integer(1), "modes of matrices", 10),
    option("--static-correction", action="store_true", help="exact static compliance of matrices"),
    needs=["ccd_casadi.extensions.imported.sampled_plant"],
    place=RUN | {"metavar": "FOLDER", "help": "the folder with index.csv and dofs.csv"},
    without_effect=["--workers", "--seed", "--no-user-code"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.extensions.imported.modal_table import write_modal_table

    folder: Path = options.run
    try:
        table = _table(folder, options)
    except PlantError as error:  # it names the file at fault, and there is no case
        raise UserError(str(error)) from error
    file = run_folder(folder, options.out or folder) / "modes.csv"
    write_modal_table(file, table)
    N, r = table.omega.shape
    inform(f"{file}: {N} samples of {r} modes, {', '.join(table.names)}")
    return ExitCode.DONE
