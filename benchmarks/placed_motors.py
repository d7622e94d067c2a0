"""Where the motors of examples/placed_motors stand: docs/positions.png.

    python benchmarks/placed_motors.py RUN [OTHER_RUN ...]

RUN is of examples/placed_motors/case.toml. A mode that lift sees is drawn with the motors; beside
it is the bandwidth of every θ that this run, and others from other starts, have looked at.
"""

import json
import sys
from contextlib import closing
from pathlib import Path
from sqlite3 import connect

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.places import Places

HERE = Path(__file__).parent.parent
CORNERS = np.array([(x, y) for x in (-160, 160) for y in (-100, 100)])


def mode(run, ax, number: int) -> None:
    """A flexible mode at the nodes as lines of equal height, and the motors."""
    places: Places = run.problem.source.places
    shapes = plant_of(run.problem).shapes(run.theta, number)
    found = shapes.modes[number - 1]
    x, y = 1e3 * shapes.points[:, 0], 1e3 * shapes.points[:, 1]
    z = found.displacement[:, 2] / np.abs(found.displacement[:, 2]).max()
    ax.tricontourf(x, y, z, levels=np.linspace(-1, 1, 15), cmap="RdBu_r", alpha=0.75)
    ax.tricontour(x, y, z, levels=[0.0], colors="k", linewidths=0.8)
    theta = dict(zip(run.problem.names, run.theta, strict=True))

    def value(item) -> float:
        if isinstance(item, str):
            return theta[item.removeprefix("-")] * (-1.0 if item.startswith("-") else 1.0)
        return item

    at = 1e3 * np.array([[value(item) for item in point] for point in places.actuators])
    ax.plot(*CORNERS.T, "k+", markersize=9, label="corners")
    ax.plot(*at.T, "o", color="#d55e00", markeredgecolor="w", markersize=9, label="designed")
    words = f"mode {number}: {found.frequency:.0f} Hz, ω_b: {run.result['bandwidth_hz']:.1f} Hz"
    ax.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)", title=words)


def main(folders: list[Path], others: list[Path]) -> None:
    runs = [read_run(folder) for folder in folders]
    fig, axes = plt.subplots(1, len(runs) + 1, figsize=(4.6 * (len(runs) + 1), 3.6))
    for run, ax in zip(runs, axes, strict=False):
        mode(run, ax, 2)
    axes[0].legend(loc="lower center", ncols=2, bbox_to_anchor=(0.5, -0.42), frameon=False)
    run = runs[0]
    best = dict(zip(run.problem.names, run.theta, strict=True))
    names = list(run.problem.names)
    a, hz = [], []
    for folder in (folders[0], *others):
        with closing(connect(folder / "samples.sqlite")) as store:
            for theta, bandwidth in store.execute("select theta, bandwidth from samples"):
                a.append(1e3 * json.loads(theta)[names.index("a")])
                hz.append((bandwidth or np.nan) / (2 * np.pi))
    axes[-1].plot(a, hz, "o", color="#0072b2", label="looked at")
    axes[-1].plot(1e3 * best["a"], run.result["bandwidth_hz"], "o", color="#d55e00", markersize=9)
    axes[-1].set(xlabel="a (mm)", ylabel="Hz", title="bandwidth of every θ looked at")
    axes[-1].grid(alpha=0.3)
    fig.tight_layout()
    fig.savefig(HERE / "docs" / "positions.png", dpi=90)


if __name__ == "__main__":
    main([Path(sys.argv[1])], [Path(item) for item in sys.argv[2:]])
