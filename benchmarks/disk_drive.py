"""The dual-stage disk drive of PyHDDBenchmark: our sections beside its hand-tuned controllers.

    python benchmarks/disk_drive.py [--design] [--seed N] [--workers N] [--theirs DIR] [--write]

judges the controllers kept in benchmarks/disk_drive.json, of the largest bandwidth and of the least
position error, or with `--design` those that `examples/disk_drive/design.py` finds (minutes), on
the nine plants and on 63 over the range of temperatures, with code of its own (SciPy alone:
sections by the bilinear rule, every mode's exact zero-order hold, eigenvalues of the whole loop,
|S| at the sampling instants on a dense grid). `--theirs` is a checkout of
github.com/liuzd1997/PyHDDBenchmark: its controllers are read from `utils.py` there and judged
alike, with their filters at twice the rate; otherwise their figures are those kept. `--write` keeps
the results, and the picture docs/disk_drive.png.
"""

import argparse
import ast
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag, expm
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import bilinear, tf2ss

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples" / "disk_drive"))
import plant as drive  # noqa: E402

RESULTS = Path(__file__).with_suffix(".json")
PICTURE = ROOT / "docs" / "disk_drive.png"
THEIRS, OURS = "PyHDDBenchmark", ("largest bandwidth", "least error")
NINE = [(t, g) for g in drive.PZT_GAINS for t in drive.TEMPERATURES.values()]
BETWEEN = [(t, g) for g in drive.PZT_GAINS for t in np.linspace(-1.0, 1.0, 21).tolist()]
T = 1.0 / drive.RATE_HZ
FLANKS = np.array([-3, -1, -0.4, 0, 0.4, 1, 3])
System = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Branch:
    """One actuator's way from e to y: C(z) at the rate 1/T, F(z) at `times` that rate, the hold."""

    controller: System
    filtered: System | None
    times: int


def modes(temperature: float, pzt_gain: float) -> list[np.ndarray]:
    """Rows (ω, ζ, residue) of the VCM and of the PZT."""
    on_vcm, on_pzt, on_damping = drive.factors(temperature)
    found = []
    for which, on_hz in ((drive.VCM, on_vcm), (drive.PZT, on_pzt)):
        omega = 2.0 * np.pi * on_hz * np.array(which["hz"], float)
        kappa = np.array(which["kappa"], float)
        static = abs((kappa / omega**2).sum()) if which is drive.PZT else 1.0
        size = which.get("gain", pzt_gain / static)
        found.append(np.column_stack([omega, on_damping * np.array(which["zeta"]), size * kappa]))
    return found


def held(rows: np.ndarray, period: float) -> System:
    """Zero-order hold of Σ r/(s² + 2ζωs + ω²), mode by mode."""
    A, B = [], []
    for omega, zeta, residue in rows:
        scale = 2.0 * np.pi * 1e4  # of velocity
        M = np.zeros((3, 3))
        M[0, 1], M[1, 0], M[1, 1] = scale, -(omega**2) / scale, -2.0 * zeta * omega
        M[1, 2] = residue / scale
        E = expm(M * period)
        A.append(E[:2, :2])
        B.append(E[:2, 2:])
    return block_diag(*A), np.vstack(B), np.tile([1.0, 0.0], len(A))[None], np.zeros((1, 1))


def response(system: System, z: np.ndarray) -> np.ndarray:
    """C (z - A)⁻¹ B + D of a SISO system, block by block where there are many and all are 2 x 2."""
    A, B, C, D = system
    out = np.full(len(z), D[0, 0], complex)
    n = len(A)
    blocks = [A[i : i + 2, i : i + 2] for i in range(0, n, 2)]
    if n < 16 or np.any(A - block_diag(*blocks)):
        for i in range(0, len(z), 4096):
            part = z[i : i + 4096, None, None]
            out[i : i + 4096] += (C @ np.linalg.solve(part * np.eye(n) - A, B + 0j))[:, 0, 0]
        return out
    for i in range(0, n, 2):
        (a, b), (c, d) = A[i : i + 2, i : i + 2]
        top = C[0, i] * ((z - d) * B[i, 0] + b * B[i + 1, 0])
        top += C[0, i + 1] * (c * B[i, 0] + (z - a) * B[i + 1, 0])
        out += top / ((z - a) * (z - d) - b * c)
    return out


def series(first: System, second: System) -> System:
    a, b, c, d = first
    A, B, C, D = second
    return (np.block([[A, B @ c], [np.zeros((len(a), len(A))), a]]), np.vstack([B @ d, b]),
            np.hstack([C, D @ c]), D @ d)  # fmt: skip


def slowed(system: System, times: int) -> System:
    """What every `times`-th sample sees of an input held as long."""
    A, B, C, D = system
    total, power = np.zeros_like(B), np.eye(len(A))
    for _ in range(times):
        total, power = total + power @ B, A @ power
    return power, total, C, D


def open_loop(branch: Branch, rows: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """L of one actuator at the sampling instants."""
    times = branch.times
    plant = held(rows, T / times)
    out = np.zeros(len(omega), complex)
    for k in range(times):
        angle = (omega * T + 2.0 * np.pi * k) / times
        z = np.exp(1j * angle)
        part = response(plant, z)
        if branch.filtered is not None:
            part *= response(branch.filtered, z)
        out += part * sum(z**-j for j in range(times)) / times
    return out * response(branch.controller, np.exp(1j * omega * T))


def closed_poles(branches: list[Branch], plants: list[np.ndarray]) -> np.ndarray:
    """Eigenvalues of the whole loop at the sampling instants."""
    ways = []
    for branch, rows in zip(branches, plants, strict=True):
        way = held(rows, T / branch.times)
        if branch.filtered is not None:
            way = series(branch.filtered, way)
        ways.append(series(branch.controller, slowed(way, branch.times)))
    A = block_diag(*(way[0] for way in ways))
    B, C = np.vstack([way[1] for way in ways]), np.hstack([way[2] for way in ways])
    D = sum(way[3][0, 0] for way in ways)
    return np.linalg.eigvals(A - B @ C / (1.0 + D))


def judge(branches: list[Branch], temperature: float, pzt_gain: float) -> dict:
    """On one plant: the largest pole, the peak of |S|, its first -3 dB, and more.

    |S| at some frequencies; the peaks of |K_v S| and |K_p S| (theirs in front of their filters).
    """
    rows = modes(temperature, pzt_gain)

    def S(omega: np.ndarray) -> np.ndarray:
        return np.abs(sensitivity(branches, rows, omega))

    poles = closed_poles(branches, rows)
    s = np.log(poles[np.abs(poles) > 1e-6].astype(complex)) / T
    flanks = (np.abs(s.imag)[:, None] + np.abs(s.real)[:, None] * FLANKS).ravel()
    grid = np.concatenate([2.0 * np.pi * np.geomspace(1.0, 0.5 / T, 6000),
                           2.0 * np.pi * np.linspace(10.0, 0.5 / T, 6000), flanks])  # fmt: skip
    grid = np.unique(grid[(grid > 2.0 * np.pi) & (grid <= np.pi / T)])
    value = S(grid)
    tops = np.flatnonzero((value[1:-1] >= value[:-2]) & (value[1:-1] >= value[2:])) + 1
    peak, at = float(value.max()), float(grid[value.argmax()])
    for i in tops[np.argsort(-value[tops])[:5]]:
        near = minimize_scalar(lambda w: -S(np.array([w]))[0], bounds=(grid[i - 1], grid[i + 1]),
                               method="bounded", options={"xatol": 1e-9 * grid[i]})  # fmt: skip
        if -near.fun > peak:
            peak, at = float(-near.fun), float(near.x)
    over = int(np.flatnonzero(value > np.sqrt(0.5))[0])
    crossing = brentq(lambda w: S(np.array([w]))[0] - np.sqrt(0.5), grid[over - 1], grid[over])
    return {
        "temperature": temperature,
        "pzt_gain": pzt_gain,
        "stable": bool(np.abs(poles).max() < 1.0),
        "largest_pole": float(np.abs(poles).max()),
        "S_peak": peak,
        "S_peak_hz": at / (2.0 * np.pi),
        "bandwidth_hz": float(crossing) / (2.0 * np.pi),
        "S_at_hz": {str(f): float(S(2.0 * np.pi * np.array([float(f)]))[0])
                    for f in (10, 30, 100, 300, 1000)},
        "KS_peak": [float((value * np.abs(response(one.controller, np.exp(1j * grid * T)))).max())
                    for one in branches],
    }  # fmt: skip


def sensitivity(branches: list[Branch], rows: list[np.ndarray], omega: np.ndarray) -> np.ndarray:
    """S at the sampling instants."""
    ways = zip(branches, rows, strict=True)
    return 1.0 / (1.0 + sum(open_loop(*way, omega) for way in ways))


def ours(sections: dict[str, dict[str, float]]) -> list[Branch]:
    """Sections as `design.py` writes them, by z = (1 + sT/2)/(1 - sT/2), in a cascade."""
    found = []
    for name in ("VCM", "PZT"):
        own = sections[name]
        gain = np.array([[own["gain"]]])
        systems = [(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), gain)]

        def pair(key: str, own: dict = own) -> list[float]:
            omega, zeta = 2.0 * np.pi * own[key], own[f"{key} damping"]
            return [1.0 / omega**2, 2.0 * zeta / omega, 1.0]

        def real(key: str, own: dict = own) -> list[float]:
            return [1.0 / (2.0 * np.pi * own[key]), 1.0]

        parts = []
        if "integrator" in own:
            parts.append(([1.0, 2.0 * np.pi * own["integrator"]], [1.0, 0.0]))
        for key in own:
            if key.startswith("lead") and key.endswith("zero"):
                parts.append((real(key), real(key.replace("zero", "pole"))))
            elif key.startswith("biquad") and key.endswith("zeros"):
                parts.append((pair(key), pair(key.replace("zeros", "poles"))))
            elif key == "roll-off real":
                parts.append(([1.0], real(key)))
        for above, below in parts:
            systems.append(tf2ss(*bilinear(above, below, fs=1.0 / T)))
        whole = systems[0]
        for system in systems[1:]:
            whole = series(whole, system)
        found.append(Branch(whole, None, 1))
    return found


def theirs(folder: Path) -> list[Branch]:
    """The benchmark's controllers: the number arrays of the functions in its utils.py."""
    found = {}
    for node in ast.parse((folder / "utils.py").read_text()).body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("get_Sys_"):
            parts = {}
            for line in node.body:
                if isinstance(line, ast.Assign) and isinstance(line.value, ast.Call):
                    number = ast.literal_eval(line.value.args[0])
                    parts[line.targets[0].id] = np.array(number, float)
            parts["C"], parts["D"] = parts["C"].reshape(1, -1), parts["D"].reshape(1, 1)
            found[node.name[8:]] = tuple(parts[k] for k in "ABCD")
    return [Branch(found[f"Cd_{name}"], found[f"Fm_{name}"], 2) for name in ("vcm", "pzt")]


def summary(found: list[dict]) -> dict:
    """The ends over some plants."""
    widths = [row["bandwidth_hz"] for row in found]
    return {
        "plants": len(found),
        "stable": sum(row["stable"] for row in found),
        "S_peak": max(row["S_peak"] for row in found),
        "bandwidth_hz": [min(widths), max(widths)],
        "S_at_hz": {f: max(row["S_at_hz"][f] for row in found) for f in found[0]["S_at_hz"]},
        "KS_peak": [max(row["KS_peak"][i] for row in found) for i in (0, 1)],
    }


def line(name: str, one: dict) -> str:
    low, high = one["bandwidth_hz"]
    rest = " ".join(f"{value:8.1e}" for value in one["S_at_hz"].values())
    rest += "".join(f"{value:7.2f}" for value in one["KS_peak"])
    return (f"{name:24s} {one['stable']:3d}/{one['plants']:<3d} {one['S_peak']:7.4f}  "
            f"{low:7.1f} to {high:6.1f}  {rest}")  # fmt: skip


def picture(sets: dict[str, list[Branch] | dict], path: Path) -> dict:
    """|S| of both on the nine plants; returns the curves, so that theirs can be drawn again."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    hz = np.geomspace(30.0, 0.499999 / T, 300)
    fig, axes = plt.subplots(figsize=(9.0, 5.0), layout="constrained")
    curves = {}
    for (name, branches), colour in zip(
        sets.items(), ("tab:orange", "tab:blue", "tab:green"), strict=False
    ):
        if isinstance(branches, dict):
            curves[name] = branches
        else:
            curves[name] = {"hz": hz.tolist(), "S": [
                np.abs(sensitivity(branches, modes(t, g), 2.0 * np.pi * hz)).tolist()
                for t, g in NINE
            ]}  # fmt: skip
        for i, row in enumerate(curves[name]["S"]):
            label = name if i == 0 else None
            axes.loglog(curves[name]["hz"], row, color=colour, lw=0.9, label=label)
    axes.axhline(2.087, color="0.3", lw=0.8, ls="--")
    axes.axhline(np.sqrt(0.5), color="0.3", lw=0.8, ls=":")
    axes.text(32.0, 2.2, "2.087", fontsize=9)
    axes.text(32.0, 0.75, "-3 dB", fontsize=9)
    axes.set(xlabel="frequency in Hz", ylabel="|S| at the sampling instants", ylim=(1e-4, 4.0),
             xlim=(30.0, 0.5 / T), title="Dual-stage disk drive, nine plants")  # fmt: skip
    axes.grid(True, which="both", lw=0.3)
    axes.legend(loc="lower right")
    fig.savefig(path, dpi=110)
    return curves


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--design", action="store_true")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--theirs", type=Path)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    sections = kept.get("sections", {})
    if given.design or not sections:
        import design

        made = design.design(seed=given.seed, workers=given.workers, progress=print)
        if not made.certified:
            sys.exit(made.words)
        least = design.least_error(made.kappa, design.run_out(), print)
        found = (design.written(made), design.written(least))
        sections = dict(zip(OURS, found, strict=True))
        print(f"certified by the synthesis' own judge: {made.bandwidth / design.HZ:.1f} Hz")
        print(f"of the least error: {least.judged.words}")
    sets: dict = {name: ours(sections[name]) for name in OURS}
    if given.theirs:
        sets[THEIRS] = theirs(given.theirs)
    print(
        f"{'':24s} stable   max|S|      -3 dB in Hz    |S| at 10, 30, 100, 300, 1000 Hz"
        "             |K_v S|, |K_p S|"
    )
    results = dict(kept.get("results", {}))
    for name in (THEIRS, *OURS):
        if name in sets:
            results[name] = {
                which: summary([judge(sets[name], *case) for case in cases])
                for which, cases in (("nine", NINE), ("between", BETWEEN))
            }
        for which, one in results.get(name, {}).items():
            print(line(f"{name}, {which}", one))
    if given.write:
        curves = kept.get("curves", {})
        order = {name: sets.get(name) or curves.get(name) for name in (THEIRS, *OURS)}
        drawn = picture({name: one for name, one in order.items() if one}, PICTURE)
        curves = {**curves, THEIRS: drawn[THEIRS]} if THEIRS in drawn else curves
        keep = {"sections": sections, "results": results, "seed": given.seed,
                "numpy": np.__version__, "curves": curves}  # fmt: skip
        RESULTS.write_text(json.dumps(rounded(keep)) + "\n")


def rounded(item: object) -> object:
    """To six digits, but for the sections."""
    if isinstance(item, dict):
        return {k: v if k == "sections" else rounded(v) for k, v in item.items()}
    if isinstance(item, list):
        return [rounded(value) for value in item]
    return float(f"{item:.6g}") if isinstance(item, float) else item


if __name__ == "__main__":
    main()
