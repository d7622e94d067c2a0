"""Where the actuators of the rib stage stand, and how many: what a place buys at equal force.

    python benchmarks/rib_stage_places.py [--stages NAME ...] [--places N] [--write] [--draw]

At each stage and layout below every channel's largest bandwidth is searched by itself, with the
structure and bounds of runs/rib_stage_built.toml, on the stage with twenty flexible modes, with and
without payload: as it is and all modes 2 % lower and higher, at half the damping. ω_b is that of
the slowest channel. Each actuator has a sensor at its place. Layouts keep the symmetry of the
square, so that lift, tip (as tilt) and twist are channels of their own:

    4   at (±r, ±r)
    5   the same and one in the centre: lift does not drive its first mode
    8   at (±r, ±r) and at the corners: lift, tip and twist do not drive a mode each (that of lift
        and tip the first, that of twist the second: the first is what the channel is for)

**Equal force**: n actuators share the copper of four, so that forces f cost |f|² n/4 of what they
cost there. KS is that force for a displacement of the corners (of the whole, in twist by the first
mode), GS the displacement of the corners for a load on the stage, wherever actuators and sensors
are; both keep the bounds of the case.

`--write` keeps the rows in benchmarks/rib_stage_places.json. Of those of four actuators `--whole`
climbs the whole loop on the whole set of the case: the finer mesh, the payload, the worst plants of
the box. `--draw` makes a picture of the rows of the first stage.
"""  # fmt: skip

import argparse
import json
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
from ccd_casadi.inner_problem.structured_robustness import (
    certify_lattice,
    fresh_yield,
    proof_of,
    worst_case,
)
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
CHANNELS = ("z", "tip", "twist")
RING = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])  # signs; as the case's corners
PATTERNS = {"z": (1, 1, 1, 1), "tip": (1, 1, -1, -1), "twist": (1, -1, 1, -1)}
QUIET = {"z": 0, "tip": 0, "twist": 1}  # which of the modes that a channel sees is not driven
POINTS = np.vstack([[(0.0, 0.0)], *(r * RING for r in RADII)])


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


def ring(r: float) -> list[int]:
    return [1 + 4 * RADII.index(r) + i for i in range(4)]


def layout(count: int, r: float, modal: ModalPlant) -> Layout:
    """Four, five or eight actuators, of which four at (±r, ±r)."""
    whole = {name: np.array(PATTERNS[name], float) for name in CHANNELS}
    if count == 4:
        return Layout(tuple(ring(r)), {name: v / 2.0 for name, v in whole.items()})
    other = [0] if count == 5 else ring(RADII[-1])
    rows, found = (*ring(r), *other), {}
    for name, v in whole.items():
        second = np.append(np.zeros(4), v if count == 8 else (1.0 if name == "z" else 0.0))
        first = np.append(v, np.zeros(len(other)))
        if not second.any():
            found[name] = first / 2.0
            continue
        B = modal.B[:, rows] @ np.column_stack([first / 2.0, second / np.linalg.norm(second)])
        seen = sorted(np.flatnonzero(~modal.rigid & _seen(B)), key=lambda k: modal.natural[k])
        a, b = B[seen[QUIET[name]]]
        found[name] = (b * first / 2.0 - a * second / np.linalg.norm(second)) / np.hypot(a, b)
    return Layout(rows, found)


def _seen(B: np.ndarray) -> np.ndarray:
    """Which modes are driven by any column."""
    size = np.abs(B).reshape(len(B), -1).max(axis=1)
    return np.asarray(size > 1e-6 * size.max())


def reading(where: Layout, name: str, modal: ModalPlant) -> float:
    """What a channel's axis shows of its motion: of 1 m, of 1 rad, or of the first twist mode."""
    v, rows = where.directions[name], list(where.rows)
    if name == "z":
        return float(v.sum())
    if name == "tip":
        return float(v @ POINTS[rows, 1])
    seen = modal.B[:, ring(HALF)] @ PATTERNS["twist"]
    first = min(np.flatnonzero(~modal.rigid & _seen(seen)), key=lambda k: modal.natural[k])
    return abs(float(modal.B[first, rows] @ v))


def channel(
    modals: list[ModalPlant], where: Layout, name: str, M_K: float
) -> tuple[list[ScaledPlant], float]:
    """SISO plants from equal-force input to displacement at the corners, and their lever, η."""
    corners = layout(4, HALF, modals[0])
    out = reading(corners, name, modals[0]) / reading(where, name, modals[0])
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
    """What four actuators keep with the finer mesh, the payload and the box's worst plants.

    M_K of each channel makes the bound on KS the same force for a displacement of the corners.
    """
    r, text = row["r"], CASE.read_text()
    points = (r * RING).tolist()
    places = f"actuators = {points}\nsensors = {points}\n"
    text = text.replace('outputs = "corners"', f'{places}outputs = "corners"')
    M_K = {c: 4.5e4 / row["levers"][c] for c in CHANNELS}
    text = text.replace("M_K = 4.5e4", f"M_K = {max(M_K.values()):.9g}")
    for c in CHANNELS:
        table = f"[controller.channel.{c}]\n"
        text = text.replace(table, f"{table}M_K = {M_K[c]:.9g}\n")
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
        own, gain = np.array(row["kappa"][c]), 1.0 / row["levers"][c]
        stacked[whole.slices[i]] = whole.structures[i].in_units(own, 1.0, gain)
    begun = with_structured(asked, warm_starts=(tuple(map(float, stacked)),))
    return climbed(replace(begun, start=stage_theta(row["stage"])))


def climbed(asked: CoDesignProblem) -> dict[str, Any]:
    """The whole loop from its warm start, with the worst plants that are found; judge and proof."""
    asked, made = prepared(asked, lambda words: print(f"  {words}", flush=True), None, True)
    if not made.certified or made.certificate is None:
        return {"certified": False, "reason": made.words}
    worst = worst_case(asked, asked.start, made, turn=ROUNDS)[0]
    judged, count = certify_lattice(asked, asked.start, made.controller, worst)
    fresh = fresh_yield(asked, asked.start, made)
    assert fresh is not None
    return {
        "certified": True,
        "bandwidth_hz": made.bandwidth / HZ,
        "plants": len(made.certificate.plants),
        "worst_excess": float(np.expm1(worst.value)),
        "judged": {"plants": count, "passed": judged.passed},
        "fresh": {"plants": fresh.draws, "survived": fresh.survived},
        "proof": proof_of(asked, asked.start, made).words,
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
    key = ("stage", "actuators", "r")
    rows = [other for other in rows if any(other[k] != row[k] for k in key)] + [row]
    RESULTS.write_text(json.dumps(json_values(rows), indent=1) + "\n")


def draw(name: str) -> None:
    """The first mode that lift drives, with the places, and bandwidths over r of a stage."""
    rows = [row for row in json.loads(RESULTS.read_text()) if row["stage"] == name]
    line = np.linspace(-HALF, HALF, 13)
    grid = [(x, y) for x in line for y in line]
    plant = rib_stage(NAMES, actuators=grid, sensors=grid)
    system = mechanics(plant, stage_theta(name), derivatives=False)
    modal = modal_plant(system, problem().suspension)
    corners = [0, 12, 156, 168]
    lift = np.flatnonzero(~modal.rigid & _seen(modal.B[:, corners].sum(axis=1)))
    modes = [min(lift, key=lambda k: modal.natural[k]), np.flatnonzero(~modal.rigid)[0]]
    four = sorted((row for row in rows if row["actuators"] == 4), key=lambda row: row["r"])
    best = max(four, key=lambda row: -row["J"])
    fig, axes = plt.subplots(1, 3, figsize=(12.5, 3.9), width_ratios=(1, 1, 1.15))
    x, y = 1e3 * np.array(grid).T
    for ax, k, words in zip(axes, modes, ("lift", "twist"), strict=False):
        z = modal.B[k] / np.abs(modal.B[k]).max()
        ax.tricontourf(x, y, z, levels=np.linspace(-1, 1, 15), cmap="RdBu_r", alpha=0.75)
        ax.tricontour(x, y, z, levels=[0.0], colors="k", linewidths=0.8)
        ax.plot(*(1e3 * HALF * RING.T), "k+", markersize=10, label="corners", clip_on=False)
        ax.plot(*(1e3 * best["r"] * RING.T), "o", color="#d55e00", mec="w", ms=9, label="placed")
        title = f"first mode in {words}: {modal.natural[k] / HZ:.0f} Hz"
        ax.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)", title=title)
    axes[0].legend(loc="lower center", ncols=2, bbox_to_anchor=(0.5, -0.42), frameon=False)
    for c, colour in zip(CHANNELS, ("#0072b2", "#009e73", "#cc79a7"), strict=True):
        for count, style in ((4, "o-"), (5, "^"), (8, "s")):
            own = sorted((row["r"], row["hz"][c]) for row in rows if row["actuators"] == count)
            if own:
                label = f"{c}, {count}" if c == "z" or count == 4 else None
                axes[2].plot(*(np.array(own).T * [[1e3], [1.0]]), style, color=colour, label=label)
    axes[2].set(xlabel="r (mm)", ylabel="Hz", title=f"bandwidth, stage of {best['mass']:.3f} kg")
    axes[2].legend(frameon=False)
    axes[2].grid(alpha=0.3)
    fig.tight_layout()
    fig.savefig(PICTURE, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", nargs="*", default=["shipped", "sequential", "light"])
    parser.add_argument("--counts", nargs="*", type=int, default=[4, 5, 8])
    parser.add_argument("--radii", nargs="*", type=float, default=list(RADII))
    parser.add_argument("--starts", type=int, default=2)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--whole", action="store_true", help="of the rows that are kept")
    parser.add_argument("--draw", action="store_true")
    given = parser.parse_args()
    if given.draw:
        draw(given.stages[0])
        return
    if given.whole:
        for row in json.loads(RESULTS.read_text()):
            chosen = row["stage"] in given.stages and row["r"] in given.radii
            if chosen and row["actuators"] == 4:
                began = process_time()
                row["whole"] = on_the_whole_set(row)
                words = f"{row['stage']}, 4 at {1e3 * row['r']:.0f} mm: {row['whole']}"
                print(f"{words}, {process_time() - began:.0f} s", flush=True)
                keep(row)
        return
    asked = problem()
    for name in given.stages:
        theta, began = stage_theta(name), process_time()
        modals = stage_at(asked, theta)
        ones = modals[0].B[modals[0].rigid][:, ring(HALF)] @ np.ones(4) / 4.0
        mass = 1.0 / float(ones @ ones)
        print(f"{name}: {mass:.4f} kg, {process_time() - began:.0f} s", flush=True)
        known: dict[str, list[Known]] = {c: [] for c in CHANNELS}
        for count in given.counts:
            for r in given.radii:
                if count == 8 and r == HALF:
                    continue
                where, hz, met = layout(count, r, modals[0]), {}, {}
                kappa, levers = {}, {}
                for c in CHANNELS:
                    plants, lever = channel(modals, where, c, asked.weights.M_K)
                    value, last, active = bandwidth(asked, plants, c, lever, known[c], given.starts)
                    hz[c], met[c], levers[c] = value / HZ, active, lever
                    if last is not None:
                        known[c] = [last, *known[c]][:2]
                        kappa[c] = last.kappa.tolist()
                omega = HZ * min(hz.values())
                J = asked.w1 * mass + asked.w2 * omega
                row = {"stage": name, "mass": mass, "actuators": count, "r": r, "hz": hz, "J": J,
                       "active": met, "levers": levers, "kappa": kappa}  # fmt: skip
                print(f"  {count} at {1e3 * r:.0f} mm: {omega / HZ:.2f} Hz, J {J:.3f}; "
                      + ", ".join(f"{c} {hz[c]:.1f} {met[c]}" for c in CHANNELS)
                      + f"; {process_time() - began:.0f} s", flush=True)  # fmt: skip
                if given.write:
                    keep(row)


if __name__ == "__main__":
    main()
