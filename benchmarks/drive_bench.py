"""What the set, the second sensor, the drive's forms and the rounding cost on the two-mass bench.

    python benchmarks/drive_bench.py [ROW ...]

Each row is one design of examples/drive_bench: Hz before rounding, rounded, and what is proven.
"""

import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from ccd_casadi.cases.case import Case, parse_case, read_toml
from ccd_casadi.extensions.drives.drive_case import drive_problem
from ccd_casadi.extensions.drives.drive_design import DriveOptions, design_drive
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

EXAMPLE = Path(__file__).parents[1] / "examples/drive_bench/case.toml"
# name: sensors, share of the set, drive, filters of the current and of the setpoint
ROWS: dict[str, tuple[str, float, str, int, int]] = {
    "the example": ("both", 0.03, "sinamics_s120", 3, 1),
    "no set": ("both", 0.0, "sinamics_s120", 3, 1),
    "the load's sensor alone": ("load", 0.03, "sinamics_s120", 4, 0),
    "the motor's sensor alone": ("motor", 0.03, "sinamics_s120", 4, 0),
    "current filters alone": ("both", 0.03, "sinamics_s120", 4, 0),
    "AX5000": ("both", 0.03, "beckhoff_ax5000", 4, 0),
    "one notch": ("both", 0.03, "synapticon", 1, 0),
    "two setpoint filters": ("both", 0.03, "generic", 2, 2),
}


def case_of(sensors: str, shift: float, drive: str, filters: int, setpoint: int) -> Case:
    """The example with other sensors, another set or drive."""
    data = read_toml(EXAMPLE)
    data["plant"]["sensor"] = sensors
    data["robust"]["resonance_shift"] = shift
    data["drive"] |= {"name": drive, "filters": filters, "setpoint_filters": setpoint}
    if sensors != "both":
        del data["controller"]["bandwidth_of"], data["controller"]["channel"]
        del data["drive"]["velocity"]
    return parse_case(data, EXAMPLE)


def main(names: list[str]) -> None:
    """Print a line for each row."""
    for name in names or [*ROWS]:
        problem, started = drive_problem(case_of(*ROWS[name])), perf_counter()
        try:
            found = design_drive(problem.cascade, problem.uncertain, problem.bounds,
                                 problem.sampling, options=replace(DriveOptions()))  # fmt: skip
        except UserError as error:
            print(f"{name:26s}{error}", flush=True)
            continue
        print(f"{name:26s}{found.free.bandwidth / HZ:7.1f} Hz free {found.bandwidth / HZ:7.1f} "
              f"rounded  {found.status}, {found.proof.outcome.name.lower()}  "
              f"{perf_counter() - started:.0f} s", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
