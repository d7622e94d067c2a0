"""Finite-element models of the user's own as the case file names them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.extensions.imported.interpolation import (
    Errors,
    InterpolatedModes,
    fit_entries,
    row_of,
)
from ccd_casadi.extensions.imported.matrices import reduced_table
from ccd_casadi.extensions.imported.modal_table import ModalTable, read_modal_table
from ccd_casadi.plants.plant import Plant, named_values
from ccd_casadi.plants.registry import Model
from ccd_casadi.support.errors import PlantError

NEAREST = "the nearest sample as it stands"


@dataclass(frozen=True)
class AcceptanceOptions:
    """Largest relative errors of a sample that is predicted without it.

    A mode 5 % off moves a response at 10 % of damping by half.
    """

    frequency_error: float = 0.05  # of a frequency
    response_error: float = 0.5  # of the response


def modal_table(
    names: Sequence[str], table: str = "", rigid_below_hz: float = 0.1,
    frequency_error: float = AcceptanceOptions.frequency_error,
    response_error: float = AcceptanceOptions.response_error,
) -> Plant:  # fmt: skip
    """Interpolate the plant between the modal models of a CSV file (see `modal_table`).

    Parameters
    ----------
    names : sequence of str (n,)
        θ, those of the table in any order.
    table : str
        The CSV file.
    rigid_below_hz : float
        Modes below this frequency in Hz are rigid-body modes.
    frequency_error, response_error : float
        Largest relative errors of a sample that is predicted without it: beyond, the plant is known
        at the samples alone.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        The table cannot be read, or its parameters are not those of the case.
    """
    if not table:
        raise PlantError('modal_table needs table = "modes.csv", relative to the case file')
    accepted, file = (frequency_error, response_error), Path(table)
    return plant_of_table(read_modal_table(file), names, rigid_below_hz, file.name, accepted)


def sampled_matrices(
    names: Sequence[str], folder: str = "", modes: int = 10, static_correction: bool = False,
    rigid_below_hz: float = 0.1, frequency_error: float = AcceptanceOptions.frequency_error,
    response_error: float = AcceptanceOptions.response_error,
) -> Plant:  # fmt: skip
    """Interpolate the plant between M and K given as files (see `matrices`), reduced to modes.

    Parameters
    ----------
    names : sequence of str (n,)
        θ, those of the samples in any order.
    folder : str
        Folder of the matrices.
    modes : int
        Modes kept of each sample.
    static_correction : bool
        Whether static responses join the modes; see `reduced_table`.
    rigid_below_hz, frequency_error, response_error : float
        As in `modal_table`.

    Returns
    -------
    Plant

    Raises
    ------
    PlantError
        A file cannot be read, or the parameters are not those of the case.
    """
    if not folder:
        raise PlantError('sampled_matrices needs folder = "fe", relative to the case file')
    table = reduced_table(Path(folder), modes, static_correction)
    accepted = (frequency_error, response_error)
    return plant_of_table(table, names, rigid_below_hz, Path(folder).name, accepted)


def plant_of_table(
    table: ModalTable, names: Sequence[str], rigid_below_hz: float, source: str,
    accepted: Errors = (AcceptanceOptions.frequency_error, AcceptanceOptions.response_error),
) -> Plant:  # fmt: skip
    """Any modal table as the plant that the design loop asks for.

    Raises PlantError where the table's parameters are not those of the case.
    """
    if names and not table.names:
        raise PlantError(f"{source}: has no column of theta; add one for each parameter")
    if sorted(names) != sorted(table.names):
        raise PlantError(
            f"{source} has the parameters {', '.join(table.names)}, the case "
            f"{', '.join(names)}; make them agree"
        )
    order = [table.names.index(name) for name in names]
    table = replace(table, names=tuple(names), theta=table.theta[:, order])
    theta, rigid_below = ca.MX.sym("theta", len(names)), 2.0 * np.pi * rigid_below_hz
    numbers, between = np.column_stack([table.cost, table.constraints]), dict[str, Any]()
    if names:
        try:
            modes = InterpolatedModes(table, rigid_below, accepted)
        except PlantError as error:
            raise PlantError(f"{source}: {error}") from error
        scalars = fit_entries(table.theta, numbers)[0](theta)
        between = {
            "evaluate": modes,
            "unknown_between": modes.refusal and f"{source}: {modes.refusal}",
            "references": {NEAREST: lambda at: row_of(table, modes.rigid, modes.nearest(at)[0])},
            "notes": lambda at: _notes(modes, source, at),
            "domain": (table.theta.min(axis=0), table.theta.max(axis=0)),
        }
    else:  # one model, whose forces and sensors [places] may move
        found = row_of(table, int((table.omega[0] < rigid_below).sum()), 0)
        scalars, between = ca.MX(ca.DM(numbers[0])), {"evaluate": lambda theta: found}
    lam = scalars[1:] if scalars.numel() > 1 else ca.MX(0, 1)
    return Plant(
        names=tuple(names),
        constraint_names=table.constraint_names,
        hardware=ca.Function("hardware", [theta], [scalars[0], lam]),
        outputs=table.outputs.shape[2],
        inputs=table.inputs.shape[2],
        **between,
    )


def _notes(modes: InterpolatedModes, source: str, theta: Sequence[float]) -> tuple[str, ...]:
    index, distance = modes.nearest(theta)
    place = named_values(modes.table.names, modes.table.theta[index])
    frequency, response = 100 * modes.left_out.frequency, 100 * modes.left_out.response
    count = len(modes.table.theta)
    here = f"is {100 * distance:.2g} % of the sampled range away from the nearest sample"
    if distance < modes.options.same:
        here = "is one of the samples"
    return (
        f"designs are verified on the model interpolated between the {count} samples of {source}, "
        f"as no other is known between them ({modes.frame.name}); a sample left out is predicted "
        f"to {frequency:.2g} % in frequency and {response:.2g} % in response at worst",
        f"this theta {here}, {place}; analyse its own finite-element model before it is built",
    )


MODAL_TABLE = Model(modal_table, data="table", annotated=True)
SAMPLED_MATRICES = Model(sampled_matrices, data="folder", annotated=True)
