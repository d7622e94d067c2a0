"""The picture of a response from a record: |G| with its spread, phase, coherence."""

from io import BytesIO

import numpy as np

from ccd_casadi.drawing.svg import BLUE, GREY, log_axis, new_figure, place, style
from ccd_casadi.extensions.records.plant_estimate import PlantEstimate
from ccd_casadi.support.text import spoken

WIDTH, LEFT, RIGHT = 8.0, 0.85, 0.2  # inches
ROWS = ((5.0, 2.9), (2.75, 1.75), (0.55, 1.75))  # bottom and height, inches


def record_picture(found: PlantEstimate, confidence: float) -> bytes:
    """Draw a response.

    Parameters
    ----------
    found : PlantEstimate
    confidence : float
        Of its spread.

    Returns
    -------
    bytes
        A PNG file.
    """
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
