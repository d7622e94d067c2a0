"""What an estimate shows and what is missing in it: words with frequencies, and a picture."""

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO

import numpy as np

from ccd_casadi.drawing.svg import BLUE, GREY, log_axis, new_figure, place, style
from ccd_casadi.extensions.records.plant_estimate import EstimateOptions, PlantEstimate
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import plural, spoken


@dataclass(frozen=True)
class RecordFindingOptions:
    """Limits beyond which something is named."""

    leakage: float = 0.9  # share of the power that the ends of the record explain
    most: int = 4  # ranges of frequency that are named
    joined: float = 1.1  # ratio of two lines below which they are of one range


def ranges(
    hz: Array, chosen: np.ndarray, options: RecordFindingOptions = RecordFindingOptions()
) -> str:
    """Write the ranges of some lines.

    Parameters
    ----------
    hz, chosen : array (k,), bool array (k,)
    options : RecordFindingOptions

    Returns
    -------
    str
        Empty where no line is chosen.
    """
    parts = list(_runs(hz[chosen], options.joined))
    words = [f"{a:.4g} Hz" if a == b else f"{a:.4g} to {b:.4g} Hz" for a, b in parts]
    more = [f"{len(words) - options.most} more ranges"] if len(words) > options.most else []
    return ", ".join(words[: options.most] + more)


def _runs(hz: Array, joined: float) -> Iterator[tuple[float, float]]:
    start = 0
    for i in range(1, len(hz) + 1):
        if i == len(hz) or hz[i] > joined * hz[i - 1]:
            yield float(hz[start]), float(hz[i - 1])
            start = i


def findings(
    found: PlantEstimate, period: float, estimate: EstimateOptions,
    options: RecordFindingOptions = RecordFindingOptions(),
) -> list[tuple[str, str]]:  # fmt: skip
    """List what is to be known of an estimate.

    Parameters
    ----------
    found : PlantEstimate
        On all its lines.
    period : float
        s, of the samples.
    estimate, options : EstimateOptions, RecordFindingOptions

    Returns
    -------
    list of (subject, words)
    """
    used = found.used
    if not len(used.hz):
        return [("missing", "every line: the spread is above |G|; inject more force, or longer")]
    ratio = used.spread / np.abs(used.G)
    percent = 100.0 * estimate.confidence
    worst = int(ratio.argmax())
    rows = [
        ("response", f"{plural(len(used.hz), 'line')} from {used.hz[0]:.4g} to "
                     f"{used.hz[-1]:.4g} Hz, hold and delay in it"),
        ("spread", f"{percent:g} % confidence at each line: {100.0 * np.median(ratio):.2g} % of "
                   f"|G| in the median, {100.0 * ratio[worst]:.3g} % at {used.hz[worst]:.4g} Hz"),
        ("coherence", f"{np.median(used.coherence):.3f} in the median, least "
                      f"{used.coherence.min():.3f} at "
                      f"{used.hz[int(used.coherence.argmin())]:.4g} Hz"),
        ("excitation", f"{found.periods} whole periods" if found.periods > 1 else
                       "does not repeat; local polynomials part it from leakage"),
    ]  # fmt: skip
    missing = []
    if found.hz[0] < used.hz[0]:
        missing.append(f"{found.hz[0]:.4g} to {used.hz[0]:.4g} Hz")
    inside = ranges(used.hz, used.weak, options)
    missing += [inside] if inside else []
    if found.hz[-1] > used.hz[-1]:
        missing.append(f"{used.hz[-1]:.4g} to {0.5 / period:.4g} Hz")
    if missing:
        words = "there the spread is above |G|: excite more, or record longer"
        rows.append(("missing", f"{', '.join(missing)}: {words}"))
    below = f"below {found.hz[0]:.4g} Hz: the record has no line there"
    rows.append(("no line", below))
    ends = ranges(used.hz, used.leakage > options.leakage, options)
    if ends and found.periods == 1:
        share = f"{100.0 * options.leakage:.0f} % of the position at {ends}"
        rows.append(("leakage", f"the ends of the record explain more than {share}: begin and end "
                                "at rest, or record longer"))  # fmt: skip
    if found.drift > estimate.drift:
        share = f"{100.0 * found.drift:.2g} % of its range"
        rows.append(("drift", f"the position ends {share} from where it began; first differences "
                              "remove an offset, not friction"))  # fmt: skip
    return rows


WIDTH, LEFT, RIGHT = 8.0, 0.85, 0.2  # inches
ROWS = ((5.0, 2.9), (2.75, 1.75), (0.55, 1.75))  # bottom and height, inches


def record_picture(found: PlantEstimate, confidence: float) -> bytes:
    """Draw the estimated response."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    hz, size, used = found.hz, np.abs(found.G), found.used
    with style():
        figure = new_figure(8.2, WIDTH)
        FigureCanvasAgg(figure)
        axes = [
            place(figure, LEFT, bottom, WIDTH - LEFT - RIGHT, height) for bottom, height in ROWS
        ]
        floor = 0.3 * float(size[~found.weak].min(initial=size.max()))
        axes[0].fill_between(
            used.hz, np.maximum(np.abs(used.G) - used.spread, floor), np.abs(used.G) + used.spread,
            color=BLUE, alpha=0.25, linewidth=0.0, label=f"spread, {100.0 * confidence:g} %",
        )  # fmt: skip
        axes[0].plot(hz, size, color=GREY, linewidth=0.6, label="not used: too little excitation")
        axes[0].plot(used.hz, np.abs(used.G), color=BLUE, linewidth=1.1, label="|G|")
        top = 2.0 * float(size[~found.weak].max(initial=0.0) or size.max())
        log_axis(axes[0].yaxis, floor, top)
        axes[0].set_ylabel(spoken("|G| (m/N)"))
        axes[0].legend(loc="best")
        angle = np.degrees(np.angle(used.G))
        angle = np.where(angle > 0.0, angle - 360.0, angle)  # a mass lies in the middle
        angle[1:][np.abs(np.diff(angle)) > 180.0] = np.nan  # no line across the whole panel
        axes[1].plot(used.hz, angle, color=BLUE, linewidth=1.0)
        axes[1].set_ylim(-370.0, 10.0)
        axes[1].set_yticks([-360.0, -270.0, -180.0, -90.0, 0.0])
        axes[1].set_ylabel("phase (deg)")
        axes[2].plot(hz, found.coherence, color=GREY, linewidth=0.6)
        axes[2].plot(used.hz, used.coherence, color=BLUE, linewidth=1.0)
        axes[2].set_ylim(0.0, 1.03)
        axes[2].set_ylabel("coherence")
        axes[2].set_xlabel("frequency (Hz)")
        for own in axes:
            log_axis(own.xaxis, float(hz[0]), float(hz[-1]))
            own.grid(True, which="major", linewidth=0.4, alpha=0.5)
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=130)
    return buffer.getvalue()
