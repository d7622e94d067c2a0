"""Where the actuators of the rib stage stand, and how many: what a place buys at equal force.

    python benchmarks/rib_stage_places.py [--stages NAME ...] [--layouts R ...] [--write] [--draw]

At each stage and layout below every channel's largest bandwidth is searched by itself, with the
structure and bounds of runs/rib_stage_built.toml, on the stage with twenty flexible modes, with and
without payload: as it is and all modes 2 % lower and higher, at half the damping. ω_b is that of
the slowest channel. Each actuator has a sensor at its place. Layouts keep both axes as mirrors, so
that lift, tip, tilt and twist are channels of their own; tilt is as tip where the square does:

    0.09          four, at (±r, ±r)
    0.09+0        five: one in the centre too, for lift alone
    0.09+x0.12    six: two at (±x, 0) too, for lift and tilt; with +0 seven
    0.08+0.15     eight: four on each of two squares

**Equal force**: n actuators share the copper of four, so that forces f cost |f|² n/4 of what they
cost there. KS is that force for a displacement of the corners, GS the displacement of the corners
for a load there, wherever actuators and sensors are (`reference` of [places]: the least forces that
do the work of that load on 1, x, y, x y); both keep the bounds of the case.

`--write` keeps the rows in benchmarks/rib_stage_places.json. `--whole` climbs the whole loop of
each on the whole set of the case: the finer mesh, the payload, the worst plants of the box.
`--draw` makes a picture of the rows of the first stage.
"""  # fmt: skip

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from rib_stage_built import DESIGN, HZ, theta_of
from rib_stage_front import CASE, STAGES

from ccd_casadi.case_studies.rib_stage.geometry import NAMES
from ccd_casadi.case_studies.rib_stage.plant import rib_stage
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.fixed_structure import Structure, synthesise_sections
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.decoupling import Decoupling, channel_plant
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import (
    bounds_of,
    scaled_to_plant,
    structure_of,
    structured_of,
    with_structured,
)
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.structured_search import ROUNDS, prepared
from ccd_casadi.plants.modal import ModalPlant, Perturbation, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.json_files import json_values

RESULTS = Path(__file__).with_suffix(".json")
PICTURE = Path(__file__).parents[1] / "docs" / "rib_stage_places.png"
HALF = 0.15  # m
RADII = tuple(np.round(np.arange(0.05, 0.1501, 0.01), 3).tolist())
SHIFT, DAMPING = 0.02, 0.5
PAYLOAD = ((0.03, 0.0, 0.05),)  # m, m, kg: that of the case's set
CHANNELS = ("z", "tip", "tilt", "twist")
RING = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])  # signs; as the case's corners
PAIR = np.array([(1, 0), (-1, 0)])
POINTS = np.vstack([[(0.0, 0.0)], *(r * RING for r in RADII), *(r * PAIR for r in RADII)])
MOTIONS = {"z": np.ones(len(POINTS)), "tip": POINTS[:, 1], "tilt": POINTS[:, 0],
           "twist": POINTS.prod(axis=1)}  # fmt: skip
Parts = Sequence[float | str]  # of a layout: r of a square, 0 the centre, "x0.12" two on the x axis


@dataclass(frozen=True)
class Layout:
    """Places as rows of POINTS, and each channel's directions of forces over them (unit length)."""

    rows: tuple[int, ...]
    directions: dict[str, np.ndarray]

    @property
    def force(self) -> float:
        """√(4/n): the bound on KS over that of four actuators."""
        return float(np.sqrt(4.0 / len(self.rows)))


def stage_at(asked: CoDesignProblem, theta: tuple[float, ...]) -> list[ModalPlant]:
    """Twenty modes as they are, lower and higher, at half the damping, with and without payload."""
    points, found = POINTS.tolist(), []
    for masses in ((), PAYLOAD):
        plant = rib_stage(NAMES, actuators=points, sensors=points, modes=20, point_masses=masses)
        system = mechanics(plant, theta, derivatives=False)
        for shift in (0.0, -SHIFT, SHIFT):
            found.append(modal_plant(system, asked.suspension, Perturbation(shift, DAMPING, ())))
    return found


def problem() -> CoDesignProblem:
    return problem_of(load_case(CASE))


def rows_of(part: float | str) -> list[int]:
    """Its rows of POINTS."""
    if isinstance(part, str):
        first = 1 + 4 * len(RADII) + 2 * RADII.index(float(part.removeprefix("x")))
        return [first, first + 1]
    return [1 + 4 * RADII.index(part) + i for i in range(4)] if part else [0]


def channels_of(radii: Parts) -> tuple[str, ...]:
    """Those to search: tilt is as tip on a square."""
    own = any(isinstance(part, str) for part in radii)
    return CHANNELS if own else tuple(c for c in CHANNELS if c != "tilt")


def layout(radii: Parts) -> Layout:
    """Actuators at all parts; every channel by the least forces that do its work."""
    rows = [row for part in radii for row in rows_of(part)]
    motions = {name: motion[rows] for name, motion in MOTIONS.items()}
    return Layout(tuple(rows), {name: v / np.linalg.norm(v) for name, v in motions.items()})


def reading(where: Layout, name: str) -> float:
    """What a channel's axis shows of its motion, of 1 m, 1 rad or x y."""
    return float(where.directions[name] @ MOTIONS[name][list(where.rows)])


def channel(
    modals: list[ModalPlant], where: Layout, name: str, M_K: float
) -> tuple[list[ScaledPlant], float]:
    """SISO plants from equal-force input to displacement at the corners, and their lever, η."""
    out = reading(layout([HALF]), name) / reading(where, name)
    V, rows, found = where.directions[name][:, None], list(where.rows), []
    for modal in modals:
        own = replace(
            modal, B=where.force * modal.B[:, rows], C=out * modal.C[rows],
            dB=modal.dB[:, :, rows], dC=modal.dC[:, rows],
        )  # fmt: skip
        plant = scale_plant(own, M_K, bare=True)
        found.append(channel_plant(plant, Decoupling((name,), V, V), 0))
    return found, where.force / out


@dataclass
class Known:
    """κ of a channel at another place, with the plant it is of."""

    kappa: np.ndarray
    plant: ScaledPlant


def bandwidth(
    asked: CoDesignProblem, plants: list[ScaledPlant], name: str, lever: float,
    known: list[Known], starts: int,
) -> tuple[float, Known | None, list[str]]:  # fmt: skip
    """rad/s (NaN: nothing certified), where the next search starts, and the bounds that are met."""
    whole, sections = structure_of(asked), structured_of(asked)
    assert isinstance(whole, ChannelStructure)
    own: Structure = whole.structures[whole.decoupling.names.index(name)]
    bounds = replace(bounds_of(asked), channels=())
    bounds = replace(bounds, compliance_max=bounds.compliance_max * lever)
    initial = [scaled_to_plant(own, k.plant, plants[0], k.kappa) for k in known]
    made = synthesise_sections(
        plants, own, bounds, sampling=sections.sampling, initial=initial,
        starts=starts,
    )  # fmt: skip
    if not made.certified:
        return np.nan, None, []
    return made.bandwidth, Known(made.kappa, plants[0]), sorted({str(n) for n in _active(made)})


def _active(made: Any) -> list[str]:
    from ccd_casadi.codesign.structured_entries import active_of

    return list(active_of(made))


def on_the_whole_set(row: dict[str, Any]) -> dict[str, Any]:
    """What the loop keeps with the finer mesh, the payload and the box's worst plants.

    Inputs are loads at the corners: M_K of each channel makes its bound on KS one on equal force.
    """
    text = CASE.read_text()
    points = POINTS[[i for part in row["radii"] for i in rows_of(part)]].tolist()
    edge = [[HALF, 0.0], [0.0, HALF], [-HALF, 0.0], [0.0, -HALF]]
    edge = edge[1::2] if any(isinstance(part, str) for part in row["radii"]) else edge
    among = POINTS if len(edge) < 4 else POINTS[: 1 + 4 * len(RADII)]
    nodes = f"{[*among.tolist(), *edge]}"
    places = f"nodes = {nodes}\nactuators = {points}\nsensors = {points}\n"
    places = f"[places]\n{places}reference = {(HALF * RING).tolist()}\n\n[theta.h]"
    text = text.replace('outputs = "corners"', f'actuators = {nodes}\noutputs = "corners"')
    text = text.replace("[theta.h]", places, 1)
    M_K = {c: 4.5e4 * row["levers"][c] for c in row["levers"]}
    text = text.replace("M_K = 4.5e4", f"M_K = {max(M_K.values()):.9g}")
    for c in M_K:
        table = f"[controller.channel.{c}]\n"
        text = text.replace(table, f"{table}M_K = {M_K[c]:.9g}\n")
    if "tilt" in M_K:
        text = "\n".join(line for line in text.splitlines() if not line.startswith("like = "))
    text = text.replace('"rib_stage_plants/', f'"{CASE.parent}/rib_stage_plants/')
    with TemporaryDirectory() as folder:
        path = Path(folder) / "case.toml"
        path.write_text(text)
        asked = problem_of(load_case(path))
    whole = structure_of(asked)
    assert isinstance(whole, ChannelStructure)
    stacked = np.zeros(whole.slices[whole.free[-1]].stop)
    for i in whole.free:
        c = whole.decoupling.names[i]
        own = np.array(row["kappa"][c])
        stacked[whole.slices[i]] = whole.structures[i].in_units(own, 1.0, row["levers"][c])
    begun = with_structured(asked, warm_starts=(tuple(map(float, stacked)),))
    return climbed(replace(begun, start=stage_theta(row["stage"])))


def climbed(asked: CoDesignProblem) -> dict[str, Any]:
    """The whole loop from its warm start, with the worst plants that are found; judge and proof."""
    asked, made, _ = prepared(asked, lambda words: print(f"  {words}", flush=True), None, True)
    if not made.certified or made.certificate is None:
        return {"certified": False, "reason": made.words}
    on_box = DesignOnBox(asked, asked.start, made)
    worst = on_box.worst(turn=ROUNDS)[0]
    judged, count = on_box.on_lattice(worst)
    fresh = on_box.fresh_yield()
    assert fresh is not None
    return {
        "certified": True,
        "bandwidth_hz": made.bandwidth / HZ,
        "plants": len(made.certificate.plants),
        "worst_excess": float(np.expm1(worst.value)),
        "judged": {"plants": count, "passed": judged.passed},
        "fresh": {"plants": fresh.draws, "survived": fresh.survived},
        "proof": on_box.proof().words,
        "GS": max(plant.GS for plant in made.certificate.plants),
        "kappa": made.kappa.tolist(),
    }


def stage_theta(name: str) -> tuple[float, ...]:
    if name == "shipped":
        return tuple(theta_of(DESIGN))
    return tuple(round(1e-3 * value, 9) for value in (STAGES | MORE)[name])


MORE = {"light": (1.0, 3.0, 3.0, 3.0, 9.0, 75.0)}  # 0.456 kg, 56 % below the sequential stage


def keep(row: dict[str, Any]) -> None:
    """The row in place of an earlier one of the same stage and layout."""
    rows = json.loads(RESULTS.read_text()) if RESULTS.is_file() else []
    key = ("stage", "radii")
    rows = [other for other in rows if any(other[k] != row[k] for k in key)] + [row]
    RESULTS.write_text(json.dumps(json_values(rows), indent=1) + "\n")


def count(row: dict[str, Any]) -> int:
    """Its actuators."""
    return len([i for part in row["radii"] for i in rows_of(part)])


def _mm(part: float | str) -> str:
    """A part of a layout in mm."""
    if isinstance(part, str):
        return f"x{1e3 * float(part.removeprefix('x')):.0f}"
    return f"{1e3 * part:.0f}"


def draw(name: str) -> None:
    """The first modes in lift and twist, with the places, and bandwidths of each layout."""
    rows = [row for row in json.loads(RESULTS.read_text()) if row["stage"] == name]
    line = np.linspace(-HALF, HALF, 13)
    grid = [(x, y) for x in line for y in line]
    plant = rib_stage(NAMES, actuators=grid, sensors=grid)
    system = mechanics(plant, stage_theta(name), derivatives=False)
    modal = modal_plant(system, problem().suspension)
    drive = np.abs(modal.B[:, [0, 12, 156, 168]].sum(axis=1))
    lift = np.flatnonzero(~modal.rigid & (drive > 1e-6 * drive.max()))
    modes = [min(lift, key=lambda k: modal.natural[k]), np.flatnonzero(~modal.rigid)[0]]
    shown = {n: max((row for row in rows if count(row) == n), key=lambda row: -row["J"])
             for n in sorted({count(row) for row in rows})}  # fmt: skip
    fig, axes = plt.subplots(1, 3, figsize=(12.5, 3.9), width_ratios=(1, 1, 1.15))
    x, y = 1e3 * np.array(grid).T
    for ax, k, words in zip(axes, modes, ("lift", "twist"), strict=False):
        z = modal.B[k] / np.abs(modal.B[k]).max()
        ax.tricontourf(x, y, z, levels=np.linspace(-1, 1, 15), cmap="RdBu_r", alpha=0.75)
        ax.tricontour(x, y, z, levels=[0.0], colors="k", linewidths=0.8)
        ax.plot(*(1e3 * HALF * RING.T), "k+", markersize=10, label="corners", clip_on=False)
        for (n, row), marker in zip(shown.items(), "o^sDv", strict=False):
            at = 1e3 * POINTS[[i for part in row["radii"] for i in rows_of(part)]].T
            ax.plot(*at, marker, mec="w", ms=9, label=f"{n} placed")
        title = f"first mode in {words}: {modal.natural[k] / HZ:.0f} Hz"
        ax.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)", title=title)
    axes[0].legend(loc="lower center", ncols=2, bbox_to_anchor=(0.5, -0.42), frameon=False)
    rows.sort(key=lambda row: (count(row), [str(part) for part in row["radii"]]))
    names = [f"{count(row)}: " + "+".join(map(_mm, row["radii"])) for row in rows]
    for c, marker in zip(CHANNELS, "osv^", strict=True):
        axes[2].plot(names, [row["hz"].get(c, row["hz"]["tip"]) for row in rows], marker, label=c)
    whole = [row.get("whole", {}).get("bandwidth_hz", np.nan) for row in rows]
    axes[2].plot(names, whole, "kD", mfc="none", label="all, on the whole set")
    axes[2].set(ylabel="Hz", title=f"bandwidth, stage of {rows[0]['mass']:.3f} kg")
    axes[2].tick_params(axis="x", rotation=45)
    axes[2].legend(frameon=False)
    axes[2].grid(alpha=0.3)
    fig.tight_layout()
    fig.savefig(PICTURE, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", nargs="*", default=["shipped", "sequential", "light"])
    parser.add_argument("--layouts", nargs="*", default=[f"{r:g}" for r in RADII], metavar="R[+R]")
    parser.add_argument("--starts", type=int, default=2)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--whole", action="store_true", help="of the rows that are kept")
    parser.add_argument("--draw", action="store_true")
    given = parser.parse_args()
    layouts: list[list[float | str]] = [
        [part if part.startswith("x") else float(part) for part in words.split("+")]
        for words in given.layouts
    ]
    if given.draw:
        draw(given.stages[0])
        return
    if given.whole:
        for row in json.loads(RESULTS.read_text()):
            if row["stage"] in given.stages and row["radii"] in layouts:
                began = process_time()
                row["whole"] = on_the_whole_set(row)
                words = f"{row['stage']}, {row['radii']}: {row['whole']}"
                print(f"{words}, {process_time() - began:.0f} s", flush=True)
                keep(row)
        return
    asked = problem()
    for name in given.stages:
        theta, began = stage_theta(name), process_time()
        modals = stage_at(asked, theta)
        ones = modals[0].B[modals[0].rigid][:, rows_of(HALF)] @ np.ones(4) / 4.0
        mass = 1.0 / float(ones @ ones)
        print(f"{name}: {mass:.4f} kg, {process_time() - began:.0f} s", flush=True)
        known: dict[str, list[Known]] = {c: [] for c in CHANNELS}
        for radii in layouts:
            where, hz, met = layout(radii), {}, {}
            kappa, levers = {}, {}
            for c in channels_of(radii):
                plants, lever = channel(modals, where, c, asked.weights.M_K)
                value, last, active = bandwidth(asked, plants, c, lever, known[c], given.starts)
                hz[c], met[c], levers[c] = value / HZ, active, lever
                if last is not None:
                    known[c] = [last, *known[c]][:2]
                    kappa[c] = last.kappa.tolist()
            omega = HZ * min(hz.values())
            J = asked.w1 * mass + asked.w2 * omega
            row = {"stage": name, "mass": mass, "radii": radii, "hz": hz, "J": J,
                   "active": met, "levers": levers, "kappa": kappa}  # fmt: skip
            print(f"  {radii}: {omega / HZ:.2f} Hz, J {J:.3f}; "
                  + ", ".join(f"{c} {hz[c]:.1f} {met[c]}" for c in hz)
                  + f"; {process_time() - began:.0f} s", flush=True)  # fmt: skip
            if given.write:
                keep(row)


if __name__ == "__main__":
    main()
