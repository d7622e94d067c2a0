"""The shortest move of the linear-motor axis at each heat: docs/move_power.png.

    python benchmarks/move_time_against_power.py WATT [WATT ...]

The case of examples/linear_motor_axis with its largest motor; at each limit of heat, from the most
to the least, a local search over the arm for the least J from the best arm of the one before, with
its controllers. A row is the smooth time on the plant set, the setpoint alone and its limits.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.outer_structured import StructuredOuter
from ccd_casadi.codesign.outer_theta import SETTLED, pieces_from
from ccd_casadi.inner_problem.move_figures import motion_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "linear_motor_axis"
MOTOR = 1.9  # kg
ARM = 0.0268  # m, where the search begins
FAR = 0.03  # of the range of the arm: the first radius of a search


def axis(folder: Path, watts: float) -> CoDesignProblem:
    """The example with one motor and so much heat."""
    text = (EXAMPLE / "case.toml").read_text(encoding="utf-8")
    text = text.replace("values = [0.35, 0.62, 1.1, 1.9]\nstart = 0.62", f"fixed = {MOTOR}")
    text = text.replace("rms_power = 100.0", f"rms_power = {watts}")
    text = text.replace("start = 15e-3", f"start = {ARM}")
    assert f"fixed = {MOTOR}" in text
    assert f"rms_power = {watts}" in text
    (folder / "plant.py").write_text((EXAMPLE / "plant.py").read_text(encoding="utf-8"))
    (folder / "case.toml").write_text(text, encoding="utf-8")
    return problem_of(load_case(folder / "case.toml"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("watts", nargs="+", type=float)
    limits = sorted(parser.parse_args().watts, reverse=True)
    rows: list[tuple[float, float, float, float]] = []
    print("  limit W   arm mm   time ms   setpoint ms   heat W   limits", flush=True)
    with tempfile.TemporaryDirectory() as name, SampleStore(Path(name) / "s.sqlite") as store:
        folder, controller, kappa, arm = Path(name), None, (), ARM
        for watts in limits:
            problem = axis(folder, watts)
            if controller is None:
                outer = StructuredOuter(Sampler(problem, store, Workers(1))).prepared(0)
                controller = outer.problem.controller
            sampler = Sampler(replace(problem, controller=controller), store, Workers(1))
            best = sampler.values(np.array([[arm]]))[0]
            if kappa:
                best = sampler.value_from((arm,), kappa)
            best = pieces_from(sampler, best, 1e3 * SETTLED, FAR)
            (arm,), kappa = best.theta, best.kappa
            cycle = motion_of(problem, best.theta).cycle
            setpoint = 1e3 * cycle.profile.duration
            rows.append((float(cycle.power), 1e3 * best.value, setpoint, 1e3 * arm))
            print(
                f"{watts:9.1f} {1e3 * arm:8.2f} {1e3 * best.value:9.2f} {setpoint:13.2f} "
                f"{cycle.power:8.1f}   {', '.join(cycle.limits)}",
                flush=True,
            )
    power, time, setpoint, arms = np.array(rows).T
    fig, (top, bottom) = plt.subplots(2, 1, figsize=(5.2, 4.6), sharex=True, height_ratios=(2, 1))
    top.plot(power, time, "o-", color="#0072b2", label="settled on every plant")
    top.plot(power, setpoint, ".--", color="#777777", label="setpoint alone")
    top.set(ylabel="time of a move (ms)")
    top.legend(frameon=False)
    bottom.plot(power, arms, "o-", color="#d55e00")
    bottom.set(xlabel="heat, mean of a cycle (W)", ylabel="arm (mm)")
    for ax in (top, bottom):
        ax.grid(alpha=0.3)
    fig.tight_layout()
    fig.savefig(ROOT / "docs" / "move_power.png", dpi=90)


if __name__ == "__main__":
    main()
