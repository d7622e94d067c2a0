"""The page of a schedule: bandwidth over the range, and how fast the range may be crossed."""

import numpy as np

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREY, ORANGE
from ccd_casadi.extensions.schedule.handover import CrossingOptions
from ccd_casadi.extensions.schedule.schedule_files import Schedule
from ccd_casadi.support.text import HZ


def schedule_page(title: str, found: Schedule) -> c.Page:
    """Make report.html.

    Parameters
    ----------
    title : str
    found : Schedule

    Returns
    -------
    Page
    """
    kept = sum(one.passed for one in found.frozen)
    lead = (
        f"{len(found.segments)} controllers of the same sections, one for each part of "
        f"{found.name}: at least {100.0 * found.least_share:.3g} % of the bandwidth that a "
        f"position has alone. One controller for all of it has {found.whole / HZ:.4g} Hz."
    )
    meta = (
        f"{kept} of {len(found.frozen)} positions keep every bound; {found.proven} of "
        f"{len(found.segments)} parts are proven"
    )
    head = c.Head(
        f"Schedule of {title}", "good" if found.verified else "bad",
        "verified" if found.verified else "not verified", "", meta, lead,
    )  # fmt: skip
    unit = found.unit or "–"
    rows = tuple(
        (f"{one.low:.4g} to {one.high:.4g}", one.design.bandwidth / HZ, one.proof.words)
        for one in found.segments
    )
    table = c.Table((f"{found.name} ({unit})", "bandwidth on its whole set (Hz)", "proof"), rows)
    return c.Page(head, (
        c.Chapter("Bandwidth over the range", (_bandwidths(found, unit),)),
        c.Chapter("The parts", (table,)),
        c.Chapter("On the way", (_rates(found, unit),)),
    ), index="")  # fmt: skip


def _bandwidths(found: Schedule, unit: str) -> c.Figure:
    at = np.array([one.at for one in found.frozen])
    alone = np.array([[one.at, one.bandwidth / HZ] for one in found.alone])
    panel = c.Panel(
        f"{found.name} ({unit})", "bandwidth (Hz)",
        (c.Curve(at, np.array([one.bandwidth / HZ for one in found.frozen]), "the schedule", BLUE),
         c.Curve(at, np.full(len(at), found.whole / HZ), "one controller, on its whole set", GREY),
         c.Curve(alone[:, 0], alone[:, 1], "each position alone", ORANGE, line="", marker="o")),
        levels=tuple(c.Level(one.low, "", vertical=True) for one in found.segments[1:]),
    )  # fmt: skip
    words = (
        "On the model at each position; where parts overlap, of the slower one. Lines: where a "
        "part begins."
    )
    return c.Figure(c.Lines(((panel,),), "Bandwidth", (3.4,)), words)


def _rates(found: Schedule, unit: str) -> c.Figure:
    shown = [one for one in found.rates if np.isfinite(one.rise)]
    panel = c.Panel(
        f"rate of {found.name} ({unit}/s)", "largest motion, over that at rest (–)",
        (c.Curve(np.array([one.rate for one in shown]), np.array([one.rise for one in shown]),
                 marker="o"),),
        levels=(c.Level(CrossingOptions().rise, "allowed"),), log_x=True,
    )  # fmt: skip
    words = (
        f"{found.name} moves to and fro at a constant rate under a random force; simulated, not "
        "proven. Forces of that motion itself are not in it."
    )
    return c.Figure(c.Lines(((panel,),), "Rates", (2.8,)), words)
