"""What the set, the second sensor, the drive's forms and the rounding cost on the two-mass bench.

    python benchmarks/drive_bench.py [ROW ...]      Hz, rounded   Tn (ms)
    the example                           54.4      11.7
    decay 10                              57.8      27.5
    no decay, filters at ω_b              62.0       -     60.5, 3917 with dampings up to 2
    position at 2 kHz                     47.6      13.4   judged by lifting, not proven
    the load's sensor alone               76.3       8.3   97.2 without the rules, by Kv = 13 1/s
    ball screw                            18.5      34.4   only proven to 0.51 %
    feed drive                            15.8      40.3   16 nm/N up to 50 Hz, judged

Beside free sections (`ccd inner`; at the load 4 biquads, at the motor a lead and 3, roll-off 1, the
same set, with the cascade's largest W_KS KS as weighted_level): 92.8 Hz for 54.4, ball screw 27.1
for 18.5. Without rules and without that level: 193 for 159. With filter_gain 100: 82.8.
"""

import sys
from pathlib import Path
from time import perf_counter
from typing import Any

from ccd_casadi.cases.case import Case, parse_case, read_toml
from ccd_casadi.extensions.drives.drive_case import drive_problem
from ccd_casadi.extensions.drives.drive_design import design_drive
from ccd_casadi.extensions.drives.sheet import verdict_entry
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

EXAMPLE = Path(__file__).parents[1] / "examples/drive_bench/case.toml"
# name: sensors, share of the set, and what differs in [drive]
FOUR = {"filters": 4, "setpoint_filters": 0}
ROWS: dict[str, tuple[str, float, dict[str, Any]]] = {
    "the example": ("both", 0.03, {}),
    "decay 10": ("both", 0.03, {"decay": 10.0}),
    "no decay": ("both", 0.03, {"decay": 1e6}),
    "no decay, filters at ω_b": ("both", 0.03, {"decay": 1e6, "filters_above": 1.0}),
    "position at 2 kHz": ("both", 0.03, {"position_rate_hz": 2000.0}),
    "no set": ("both", 0.0, {}),
    "the load's sensor alone": ("load", 0.03, FOUR),
    "the motor's sensor alone": ("motor", 0.03, FOUR),
    "current filters alone": ("both", 0.03, FOUR),
    "AX5000": ("both", 0.03, {"name": "beckhoff_ax5000", **FOUR}),
    "one notch": ("both", 0.03, {"name": "synapticon", "filters": 1, "setpoint_filters": 0}),
    "two of each": ("both", 0.03, {"name": "generic", "filters": 2, "setpoint_filters": 2}),
    "ball screw": ("screw", 0.03, {}),
    "feed drive": ("feed", 0.03, {}),
    "feed drive by its scale": ("scale", 0.03, {}),
}


def case_of(sensors: str, shift: float, differs: dict[str, Any]) -> Case:
    """The example with other sensors, set or drive; or a screw of 0.3 to 0.9 m, 100 to 400 kg."""
    data = read_toml(EXAMPLE)
    data["drive"] |= differs
    if sensors in ("feed", "scale"):
        path = EXAMPLE.parents[1] / "feed_drive/case.toml"
        data = read_toml(path)
        if sensors == "scale":
            data["plant"]["sensor"] = "table"
            data["inner"]["compliance_max"] *= 12.0
            del data["controller"]["bandwidth_of"], data["controller"]["channel"]
            del data["drive"]["velocity"]
        return parse_case(data, path)
    if sensors == "screw":
        path = EXAMPLE.parents[1] / "two_encoders/case.toml"
        data = {**read_toml(path), "drive": data["drive"]}
        own, ends = {"structure": "sections", "bandwidth_of": "table"}, ((100.0, 0.3), (400.0, 0.9))
        data["controller"] = own | {"channel": data["controller"]["channel"]}
        data["plant"] |= {"table": 250.0, "length": 0.6}
        plants = [{"table": mass, "length": at} for mass, at in ends]
        data["robust"] |= {"resonance_shift": shift, "plants": plants}
        return parse_case(data, path)
    data["plant"]["sensor"] = sensors
    data["robust"]["resonance_shift"] = shift
    if sensors != "both":
        del data["controller"]["bandwidth_of"], data["controller"]["channel"]
        del data["drive"]["velocity"]
    return parse_case(data, EXAMPLE)


def main(names: list[str]) -> None:
    """Print a line for each row."""
    for name in names or [*ROWS]:
        it, started = drive_problem(case_of(*ROWS[name])), perf_counter()
        try:
            found = design_drive(it.cascade, it.uncertain, it.bounds, it.sampling, ported=it.ported)
        except UserError as error:
            print(f"{name:26s}{error}", flush=True)
            continue
        hz, seconds = [one.bandwidth / HZ for one in (found.free, found)], perf_counter() - started
        end = f"{verdict_entry(it, found)['status']}, {found.proof.words}  {seconds:.0f} s"
        print(f"{name:26s}{hz[0]:7.1f} Hz free {hz[1]:7.1f} rounded  {end}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
