"""The rib stage's controller on random plants inside its set, sampled with hold and delay.

    python benchmarks/oracle.py rib_stage_built [FOLDER] [--plants N] [--seed N] [--write]

FOLDER holds controller.json of runs/rib_stage_built.toml (`solve`, or `inner --out`), and
result.json or inner.json (what `inner` printed) for θ; by default the design of
docs/development/rib_stage_study.md, which lies in benchmarks/rib_stage_design. 25 plants are one
finite-element model: a payload of up to 50 g on one of the centre ribs, up to 30 mm off centre to
any side, ten or twenty modes, the shipped mesh (every fourth group: no payload, the finer mesh);
within it every flexible mode is shifted on its own within ±2 % and the damping factor lies between
0.5 and 2. `--anywhere` puts the payload anywhere within 30 mm, on the plate between the ribs too,
where the case's set has none; `--modes` keeps so many modes in all of them. Every loop is closed
with K by Tustin's rule, hold and delay exact (`robust.sampled`, which the synthesis does not use):
eigenvalues, ‖S‖∞, ω_b; the worst plant is run sample by sample too. `--write` keeps every group in
benchmarks/rib_stage_built.json and goes on from there.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import cont2discrete

from ccd_casadi.analysis.loop_channels import sampled_figures
from ccd_casadi.extensions.rib_stage.geometry import NAMES
from ccd_casadi.extensions.rib_stage.stage_plant import rib_stage
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.plant import mechanics
from oracles.sampled_simulation import measure_set

RESULTS = Path(__file__).parents[2] / "benchmarks/rib_stage_built.json"
DESIGN = Path(__file__).parents[2] / "benchmarks/rib_stage_design"
HZ = 2.0 * np.pi
RATE, DELAY = 12500.0, 80e-6
S_MAX, M_K = 1.5636, 4.5e4
GROUP = 25  # plants of one finite-element model
REACH, PAYLOAD = 0.03, 0.05  # m, kg


def controller(folder: Path) -> StateSpace:
    """K(z) by Tustin's rule."""
    table = json.loads((folder / "controller.json").read_text())
    parts = [np.array(table[name], float) for name in "ABCD"]
    A, B, C, D, _ = cont2discrete(parts, 1.0 / RATE, "bilinear")
    return StateSpace(A, B, C, D, period=1.0 / RATE)


def theta_of(folder: Path) -> list[float]:
    """θ of the run, or of what `inner` printed."""
    for name in ("result.json", "inner.json"):
        if (folder / name).is_file():
            theta = json.loads((folder / name).read_text())["theta"]
            return [theta[key] for key in NAMES]
    raise SystemExit(f"{folder}: holds no result.json or inner.json; name a run folder")


def plants(
    theta: list[float], seed: int, group: int, anywhere: bool, modes: int | None
) -> list[tuple[StateSpace, dict[str, Any]]]:
    """The plants of a group with where they lie."""
    rng = np.random.default_rng([seed, group])
    radius, angle = REACH * rng.random(), 0.5 * np.pi * rng.integers(4)
    if anywhere:
        radius, angle = REACH * np.sqrt(rng.random()), 2.0 * np.pi * rng.random()
    payload = (radius * np.cos(angle), radius * np.sin(angle), PAYLOAD * rng.random())
    options: dict[str, Any] = {"modes": int(rng.choice([10, 20]))}
    options |= {"modes": modes} if modes else {}
    options |= {"mesh": "fine"} if group % 4 == 3 else {"point_masses": (payload,)}
    system = mechanics(rib_stage(NAMES, **options), theta, derivatives=False)
    box = UncertainPlant((system,), M_K, mode_shift=0.02, damping=(0.5, 2.0))
    found = []
    for _ in range(GROUP):
        point = box.box[0] + rng.random(len(box.names)) * (box.box[1] - box.box[0])
        point[-1] = 2.0 ** rng.uniform(-1.0, 1.0)
        found.append((box.plant(point).plant_si(), options))
    return found


def judged(
    K: StateSpace, theta: list[float], seed: int, group: int, anywhere: bool, modes: int | None
) -> tuple[list[dict[str, Any]], StateSpace]:
    """Rows of a group, and its worst plant."""
    rows, made = [], plants(theta, seed, group, anywhere, modes)
    for plant, place in made:
        f = sampled_figures(closed_loop(zoh(plant, 1.0 / RATE, DELAY), K).S)
        rows.append({"group": group, "stable": f.stable, "radius": f.spectral_radius,
                     "peak": f.sensitivity_peak if f.stable else None,
                     "bandwidth_hz": f.bandwidth / HZ if f.stable else None, **place})  # fmt: skip
    worst = max(range(GROUP), key=lambda i: rows[i]["peak"] or np.inf)
    return rows, made[worst][0]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("folder", type=Path, nargs="?", default=DESIGN)
    arguments.add_argument("--plants", type=int, default=500)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--anywhere", action="store_true")
    arguments.add_argument("--modes", type=int, choices=(10, 20, 44))
    arguments.add_argument("--write", action="store_true")
    options = arguments.parse_args()
    K, theta = controller(options.folder), theta_of(options.folder)
    rows: list[dict[str, Any]] = []
    if options.write and RESULTS.is_file():
        known = json.loads(RESULTS.read_text())
        own = (theta, options.seed, options.anywhere, options.modes)
        if (known["theta"], known["seed"], known["anywhere"], known.get("modes")) == own:
            rows = known["rows"]
    measured, top = None, -np.inf
    for group in range(len(rows) // GROUP, -(-options.plants // GROUP)):
        more, plant = judged(K, theta, options.seed, group, options.anywhere, options.modes)
        rows += more
        peak = max(row["peak"] or np.inf for row in more)
        if top < peak < np.inf:
            held = zoh(plant, 1.0 / RATE, DELAY)
            bandwidth = HZ * min(row["bandwidth_hz"] for row in more)
            top, measured = peak, measure_set([held], K, bandwidth, options.seed)[0]
        print(f"{len(rows)} plants: {summary(rows)}", flush=True)
        if options.write:
            kept = {
                "theta": theta,
                "seed": options.seed,
                "anywhere": options.anywhere,
                "modes": options.modes,
                "rows": rows,
            }
            RESULTS.write_text(json.dumps(kept) + "\n")
    if measured is not None:
        print(f"worst of those run now, sample by sample: peak {measured.sensitivity_peak:.4f}")


def summary(rows: list[dict[str, Any]]) -> str:
    """How many are stable and within S_max, the largest peak, the least bandwidth."""
    stable = [row for row in rows if row["stable"]]
    peaks = [row["peak"] for row in stable]
    within = sum(peak <= S_MAX * (1.0 + 1e-3) for peak in peaks)
    slowest = min((row["bandwidth_hz"] for row in stable), default=np.nan)
    words = f"{len(stable)} stable, {within} within S_max, largest peak"
    return f"{words} {max(peaks, default=np.nan):.4f}, bandwidth {slowest:.2f} Hz or more"


if __name__ == "__main__":
    main()
