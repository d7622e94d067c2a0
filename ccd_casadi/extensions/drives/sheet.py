"""The sheet that a person types into a drive: numbers, names, values, units; as text and JSON."""

from collections.abc import Mapping
from typing import Any

from ccd_casadi.extensions.drives.drive_case import DriveProblem
from ccd_casadi.extensions.drives.drive_codesign import DriveAt
from ccd_casadi.extensions.drives.drive_design import DriveDesign
from ccd_casadi.support.text import HZ, number


def sheet_rows(
    design: DriveDesign, today: Mapping[str, float] | None = None
) -> list[dict[str, Any]]:
    """One entry for each parameter, in the drive's unit; `today`'s values by number or name."""
    rows, given = [], today or {}
    for setting, value in zip(design.cascade.settings, design.values.tolist(), strict=True):
        shown = setting.shown(round(value * setting.per_si / setting.step))
        old = given.get(setting.name, given.get(setting.number))
        rows.append({"number": setting.number, "name": setting.name, "value": shown,
                     "unit": setting.unit, "today": old})  # fmt: skip
    return rows


def entry(design: DriveDesign, today: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Everything that is known, as JSON holds it."""
    drive, judged, bounds = design.cascade.drive, design.certificate, design.certificate.worst
    return {
        "status": design.status,
        "drive": drive.title,
        "rate_hz": 1.0 / design.cascade.period,
        "bandwidth_hz": design.bandwidth / HZ,
        "free_bandwidth_hz": design.free.bandwidth / HZ,
        "filter_gain": design.rise,
        "judge": {"passed": judged.passed, "words": judged.words, "plants": len(judged.plants),
                  "shares": bounds},
        "position_rate_hz": 1.0 / (design.cascade.period * design.cascade.slower),
        "proof": None if design.proof is None else {
            "proven": design.proof.proven, "words": design.proof.words,
            "levels": design.proof.levels, "slack": design.proof.slack},
        "parameters": sheet_rows(design, today),
        "sources": list(drive.sources),
        "chosen": list(drive.chosen),
        "unknown": list(drive.unknown),
    }  # fmt: skip


def named_theta(problem: DriveProblem, at: DriveAt) -> dict[str, float]:
    """θ by name, SI."""
    return dict(zip(problem.problem.names, at.theta, strict=True))


def figures_of(problem: DriveProblem, at: DriveAt) -> dict[str, Any]:
    """What is known of a θ before rounding."""
    return {"theta": named_theta(problem, at), "bandwidth_hz": at.candidate.bandwidth / HZ,
            "hardware_cost": at.cost, "objective": at.objective}  # fmt: skip


def codesign_words(entry: Mapping[str, Any]) -> str:
    """Both designs of a co-design, a line each."""
    return "\n".join(
        f"{name:14s}J {number(one['objective'], 5)}, {number(one['bandwidth_hz'], 4)} Hz, cost "
        f"{number(one['hardware_cost'], 4)} at "
        + ", ".join(f"{key} = {number(value)}" for key, value in one["theta"].items())
        for name, one in entry.items()
    )


def proof_words(design: DriveDesign) -> str:
    """What is proven, in a sentence."""
    if design.proof is not None:
        return design.proof.words
    if len(design.certificate.plants) == 1:
        return "not needed: the set is one plant"
    return "there is none of two rates; between the judged plants nothing is proven"


def sheet_text(design: DriveDesign, today: Mapping[str, float] | None = None) -> str:
    """The sheet as text, `today`'s values beside the new ones."""
    head = ["number", "parameter", "new", "unit"] if today is None else [
        "number", "parameter", "today", "new", "unit"]  # fmt: skip
    lines = [head]
    for row in sheet_rows(design, today):
        old = row["today"]
        before = [] if today is None else ["" if old is None else f"{old:.10g}"]
        lines.append([row["number"], row["name"], *before, f"{row['value']:.10g}", row["unit"]])
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    table = ["  ".join(part.ljust(width) for part, width in zip(line, widths, strict=True)).rstrip()
             for line in lines]  # fmt: skip
    drive = design.cascade.drive
    found = [drive.title, *table, ""]
    rounded, free = design.bandwidth / HZ, design.free.bandwidth / HZ
    found.append(f"bandwidth     {rounded:.4g} Hz; {free:.4g} Hz before rounding, on fewer plants")
    found.append(f"judged        {design.certificate.words}")
    found.append(f"proof         {proof_words(design)}")
    limit = design.cascade.filter_gain
    found.append(f"filters       raise their gain to {design.rise:.4g} of rest; limit {limit:.4g}")
    found += [f"chosen        {words}" for words in drive.chosen]
    found += [f"not known     {words}" for words in drive.unknown]
    return "\n".join(found)
