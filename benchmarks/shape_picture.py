"""docs/shape.png: |S| of case study 1 where the shape ends at ω_b, and where it holds up to S_max.

    python benchmarks/shape_picture.py

The two controllers are those of benchmarks/fixed_structure.json (sampled, least damping 0.05), as
`fixed_structure.py case1` found and judged them with either meaning.
"""

import json
from pathlib import Path

import fixed_structure as study
import matplotlib.pyplot as plt
import numpy as np

from ccd_casadi.fixed_structure import Structure
from ccd_casadi.lti.loop import Loop

ROW = "+-3 %, damping x 0.5 to 2, 10 kHz, 100 us, least_damping 0.05"


def main() -> None:
    rows = json.loads(study.RESULTS.read_text())
    bounds, (uncertain, *_) = study.BOUNDS, study.ROWS[ROW]
    hz = np.geomspace(5.0, 1000.0, 3000)
    figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    for part, colour, words in (
        ("case1_crossing", "#c2571a", "shape below ω_b only"),
        ("case1", "#1f6fb4", "shape up to S_max"),
    ):
        row = rows[part][ROW]
        K, ω_b = Structure().state_space(np.array(row["kappa"])), row["judged_bandwidth_hz"]
        S = [
            np.abs(Loop(plant.plant_si(), K, study.SAMPLED).sensitivity(study.HZ * hz)[:, 0, 0])
            for plant in uncertain.plants(uncertain.corners())
        ]
        loop = row["loop"]
        label = f"{words}: {ω_b:.1f} Hz, {loop['phase_margin_deg']:.0f}° of phase margin, "
        label += f"settles in {loop['settling_ms']:.0f} ms"
        axes.loglog(hz, np.max(S, axis=0), color=colour, label=label)
        axes.plot([ω_b], [2.0**-0.5], "o", color=colour)
        if part == "case1":
            limit = np.minimum(bounds.S_max, bounds.room(hz / ω_b) * hz / ω_b / np.sqrt(2.0))
            axes.fill_between(hz, limit, 10.0, color="#8896a0", alpha=0.25, lw=0.0)
            axes.plot(hz, limit, color="#5b666e", lw=1.0, label="S_max and the shape")
    axes.set(ylim=(0.05, 3.0), xlim=(5.0, 1000.0), xlabel="frequency (Hz)",
             ylabel="|S|, largest on all plants of the set")  # fmt: skip
    axes.axhline(2.0**-0.5, color="#8896a0", lw=0.8, ls=":")
    axes.grid(which="both", alpha=0.2)
    axes.legend(loc="lower right", fontsize=8.5)
    figure.savefig(Path(__file__).parents[1] / "docs/shape.png", dpi=110)


if __name__ == "__main__":
    main()
