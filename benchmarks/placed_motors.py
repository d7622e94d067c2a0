"""Where the motors of examples/placed_motors stand, and J over their place, as a picture in docs/.

    python benchmarks/placed_motors.py RUN [EIGHT_RUN]

RUN is of examples/placed_motors/case.toml, EIGHT_RUN of eight.toml beside it. The modes that lift
would see are drawn with the motors of each; J is that of the controllers climbed from the run's own
anchors, on its own set of plants, at nine places along a. A minute of a core.
"""

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.inner_problem.sections_bandwidth import sections_value
from ccd_casadi.plants.places import Places

HERE = Path(__file__).parent.parent
CORNERS = np.array([(x, y) for x in (-160, 160) for y in (-100, 100)])
LOW, HIGH, COUNT = 0.04, 0.17, 9  # m, of a


def mode(run, ax, title: str, number: int) -> None:
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
    ax.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)", title=f"{title}\n{words}")


def main(folders: list[Path]) -> None:
    runs = [read_run(folder) for folder in folders]
    fig, axes = plt.subplots(1, len(runs) + 1, figsize=(4.6 * (len(runs) + 1), 3.6))
    titles = ("four motors", "eight motors, modes 1 and 2 quiet")
    for run, ax, title in zip(runs, axes, titles, strict=False):
        mode(run, ax, title, 2)
    axes[0].legend(loc="lower center", ncols=2, bbox_to_anchor=(0.5, -0.42), frameon=False)
    run = runs[0]
    problem, theta = run.problem, dict(zip(run.problem.names, run.theta, strict=True))
    rows = []
    for a in np.linspace(LOW, HIGH, COUNT):
        moved = theta | {"a": float(a)}
        at = tuple(moved[name] for name in problem.names)
        found = sections_value(problem, at)
        rows.append((1e3 * a, objective(problem, at, found.value), found.value / (2 * np.pi)))
        print(*(f"{v:.4g}" for v in rows[-1]), flush=True)
    a, J, _ = np.array(rows).T
    axes[-1].plot(a, J, "o-", color="#0072b2")
    axes[-1].plot(1e3 * theta["a"], run.result["objective"], "o", color="#d55e00", markersize=9)
    axes[-1].set(xlabel="a (mm), thickness and b as designed", ylabel="J", title="J over a place")
    axes[-1].grid(alpha=0.3)
    fig.tight_layout()
    fig.savefig(HERE / "docs" / "positions.png", dpi=90)


if __name__ == "__main__":
    main([Path(item) for item in sys.argv[1:]])
