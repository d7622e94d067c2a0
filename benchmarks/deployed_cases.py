"""Random cases through solve and deploy, and what is called verified judged apart from the package.

    python benchmarks/deployed_cases.py [--cases N] [--first N] [--seed N] [--out FILE]

Case i of a seed is a plant (masses on springs, or modes with random shapes; the sensor anywhere), a
design problem, and for three of four a [robust] set. `solve` and `deploy` are run as a user would.
What `deploy` calls verified is then rebuilt here, with NumPy alone: modes from an eigenvalue
problem, each flexible one shifted, hold and delay by a matrix exponential of this file's own, the
loop closed with the matrices of controller.json. It must be stable with a peak of S within 5 % of
S_max on the whole set, on plants between those that the package looked at too, and no peak may lie
above the one that deploy.json names. There is no global check over the box, which costs two
thirds of a case: whether a better design exists does not matter here. What the file of `--out`
holds is not run again.
"""

import argparse
import collections
import contextlib
import io
import json
import tempfile
import time
from pathlib import Path

import numpy as np

SHIFTS = 61  # plants over the range, and as many at random
SLACK = 2e-4  # relative: grids of frequencies here and between plants there
WAY = ["--quiet"]
MODEL = '''
import casadi as ca

MASS, SPRING, SENSOR, RATIO = {mass!r}, {spring!r}, {sensor!r}, {ratio!r}


def model(theta):
    """A chain of masses, driven at the first; theta scales the first mass and the first spring."""
    n = len(MASS)
    masses = [MASS[0] * theta["m"], *MASS[1:]]
    springs = [SPRING[0] * theta["k"], *SPRING[1:]]
    K = [[0] * n for _ in range(n)]
    for i, k in enumerate(springs):
        K[i][i] += k
        K[i + 1][i + 1] += k
        K[i][i + 1] -= k
        K[i + 1][i] -= k
    rows = [ca.horzcat(*row) for row in K]
    return {{
        "mass": ca.diag(ca.vertcat(*masses)),
        "stiffness": ca.vertcat(*rows),
        "damping_ratio": RATIO,
        "input": ca.DM([1] + [0] * (n - 1)),
        "output": ca.DM([SENSOR]),
        "hardware_cost": theta["m"] + 0.2 * theta["k"],
    }}
'''


def drawn(seed: int, index: int) -> tuple[str, str, dict]:
    """The plant's file, the case file, and what the judge has to know of them."""
    rng = np.random.default_rng([seed, index])
    n = int(rng.integers(2, 5))
    mass = [float(v) for v in rng.uniform(0.5, 20.0) * rng.uniform(0.3, 2.0, n)]
    hz = float(np.exp(rng.uniform(np.log(60.0), np.log(600.0))))
    light = min(mass)
    spring = [float(light * (2 * np.pi * hz) ** 2 * rng.uniform(0.4, 2.0)) for _ in range(n - 1)]
    share = float(rng.choice([0.0, 0.0, 0.2, 0.5, 0.8, 1.0]))
    sensor = [1.0 - share, *[0.0] * (n - 2), share]
    ratio = float(np.exp(rng.uniform(np.log(0.003), np.log(0.03))))
    shift = float(rng.choice([0.0, 0.005, 0.01, 0.02, 0.03, 0.05]))
    damping = [0.5, 2.0] if shift and rng.random() < 0.25 else []
    S_max, wanted = float(rng.uniform(1.6, 2.5)), hz * float(rng.uniform(0.15, 0.4))
    M_K = sum(mass) * (2 * np.pi * wanted) ** 2
    case = f"""
[plant]
function = "plant.py:model"
[theta.m]
lower = 0.7
upper = 1.4
[theta.k]
lower = 0.5
upper = 2.0
[objective]
w1 = {rng.uniform(5.0, 60.0):.6g}
w2 = -1.0
[weights]
M_S = 2.0
A_S = 1e-4
c_K = 1e4
omega_K_hz = {2.0 * wanted:.6g}
M_K = {M_K:.6g}
A_l = 1.0
A_u = 1e-2
[inner]
S_max = {S_max:.6g}
S_low = {rng.choice([0.03, 0.1, 0.3]):g}
omega_low_hz = {wanted / 40.0:.6g}
omega_S_hz = [{wanted / 8.0:.6g}, {wanted * 25.0:.6g}]
omega_T_hz = [{wanted / 4.0:.6g}, {wanted * 12.0:.6g}]
[robust]
resonance_shift = {shift:g}
damping = {damping}
[sampling]
lifted_points = 16
[outer]
max_refinements = 5
box_points = 0
"""
    facts = {"mass": mass, "spring": spring, "sensor": sensor, "ratio": ratio, "shift": shift,
             "damping": damping, "S_max": S_max}  # fmt: skip
    return MODEL.format(**facts), case, facts


def modes_of(facts: dict, theta: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Natural frequencies (rad/s) and the modal gains of input and output."""
    mass, spring = np.array(facts["mass"]), np.array(facts["spring"])
    mass[0] *= theta["m"]
    spring[0] *= theta["k"]
    n = len(mass)
    K = np.zeros((n, n))
    for i, k in enumerate(spring):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    root = np.sqrt(mass)
    values, vectors = np.linalg.eigh(K / np.outer(root, root))
    shapes = vectors / root[:, None]
    return np.sqrt(np.maximum(values, 0.0)), shapes[0], np.array(facts["sensor"]) @ shapes


def exponential(A: np.ndarray) -> np.ndarray:
    """e^A by scaling, a Taylor series, and squaring."""
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(A).sum(axis=1).max(), 1e-30)))) + 4)
    A = A / 2.0**halvings
    term = total = np.eye(len(A))
    for k in range(1, 16):
        term = term @ A / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def plant(facts: dict, theta: dict, shift: float, damping: float) -> tuple[np.ndarray, ...]:
    """A, B, C: the rigid body on 0.1 Hz and 70 %, flexible modes shifted, damping multiplied."""
    w, b, c = modes_of(facts, theta)
    n = len(w)
    A, B, C = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 1)), np.zeros((1, 2 * n))
    for i in range(n):
        rigid = i == 0
        wi = 0.2 * np.pi if rigid else w[i] * (1.0 + shift)
        zeta = 0.7 if rigid else facts["ratio"] * damping
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, wi], [-wi, -2.0 * zeta * wi]]
        B[2 * i + 1, 0] = b[i] / wi
        C[0, 2 * i] = c[i]
    return A, B, C


def judged(system: tuple[np.ndarray, ...], K: dict) -> tuple[float, float]:
    """Spectral radius, and the peak of S over a grid crowded around the loop's poles."""
    A, B, C = system
    T, delay = K["period"], K["delay"]
    Ak, Bk, Ck, Dk = (np.array(K[name], float) for name in "ABCD")
    whole = int(delay / T + 1e-9)
    part = delay - whole * T
    n = len(A)
    joint = np.zeros((n + 1, n + 1))
    joint[:n] = np.hstack([A, B])
    early, late = exponential(joint * part), exponential(joint * (T - part))
    # states: x, controller, and the forces that are still on their way, newest first
    waiting = whole + 1
    N = n + len(Ak) + waiting
    F = np.zeros((N, N))
    step, old, new = late[:n, :n] @ early[:n, :n], late[:n, :n] @ early[:n, n:], late[:n, n:]
    u = np.zeros((1, N))
    u[:, :n], u[:, n : n + len(Ak)] = -Dk @ C, Ck
    e = np.zeros((1, N))
    e[:, :n] = -C
    first = n + len(Ak)
    F[:n, :n] = step
    F[n:first, n:first] = Ak
    F[n:first] += Bk @ e
    F[first] = u[0]
    for i in range(1, waiting):
        F[first + i, first + i - 1] = 1.0

    def force(age: int) -> np.ndarray:
        if age == 0:
            return u
        row = np.zeros((1, N))
        row[0, first + age - 1] = 1.0
        return row

    F[:n] += new @ force(whole) + old @ force(whole + 1)
    r = np.zeros((N, 1))
    r[n:first] = Bk
    r[first] = Dk[0, 0]
    if whole == 0:
        r[:n] += new * Dk[0, 0]
    poles = np.linalg.eigvals(F)
    radius = float(np.abs(poles).max())
    if radius >= 1.0:
        return radius, np.inf
    angles = np.abs(np.angle(poles))
    width = np.maximum(1.0 - np.abs(poles), 1e-9)
    around = [angles + k * width for k in (-3, -1, -0.5, -0.2, 0, 0.2, 0.5, 1, 3)]
    grid = np.concatenate([np.geomspace(1e-4, 1.0, 600) * np.pi, *around])
    z = np.exp(1j * np.clip(grid, 1e-6, np.pi))[:, None, None]
    S = 1.0 + e @ np.linalg.solve(z * np.eye(N) - F, r + 0j)
    return radius, float(np.abs(S).max())


def verdict(folder: Path, facts: dict, index: int) -> list[str]:
    """What is wrong with a deployment that is called verified; empty where nothing is."""
    K = json.loads((folder / "deploy" / "controller.json").read_text())
    said = json.loads((folder / "deploy" / "deploy.json").read_text())
    theta = json.loads((folder / "result.json").read_text())["theta"]
    rng = np.random.default_rng([7, index])
    reach = facts["shift"]
    shifts = np.array([0.0])
    if reach:
        shifts = np.append(np.linspace(-reach, reach, SHIFTS), rng.uniform(-reach, reach, SHIFTS))
    worst, named = 0.0, (said["robust"] or {}).get("worst", said["sampled"])["sensitivity_peak"]
    faults = []
    for factor in (1.0, *facts["damping"]):
        for shift in shifts:
            radius, peak = judged(plant(facts, theta, float(shift), factor), K)
            if radius >= 1.0:
                faults.append(f"unstable at {shift:+.4f}, damping x {factor:g}: {radius:.6f}")
            worst = max(worst, peak)
    if worst > 1.05 * facts["S_max"] * (1.0 + SLACK):
        faults.append(f"peak {worst:.5f} above 1.05 S_max = {1.05 * facts['S_max']:.5f}")
    if worst > max(named, facts["S_max"]) * (1.0 + 5.0 * SLACK):
        faults.append(f"peak {worst:.5f} above the {named:.5f} of deploy.json")
    return faults


def one(seed: int, index: int) -> dict:
    """Solve, deploy and judge one case."""
    from ccd_casadi.deploy import main as deploy
    from ccd_casadi.solve import main as solve

    source, case, facts = drawn(seed, index)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "plant.py").write_text(source)
        (place / "case.toml").write_text(case)
        quiet = ["--quiet", "--workers", "1"]
        words = io.StringIO()
        with contextlib.redirect_stderr(words), contextlib.redirect_stdout(words):
            code = solve(
                [str(place / "case.toml"), "--formulation", "lifted", "--no-report", *quiet]
            )
        folder = place / "case"
        result = json.loads((folder / "result.json").read_text()) if code != 2 else {}
        row = {
            "index": index, "shift": facts["shift"], "damping": bool(facts["damping"]),
            "solve": code, "status": result.get("status", "bad input"),
            "failed": [k for k, ok in result.get("checks", {}).items() if not ok],
            "lines": {k: v["state"] for k, v in result.get("verdict", {}).items()},
            "design_at": result.get("robust", {}).get("design_at"),
            "deploy": None, "called": None, "faults": [], "words": words.getvalue()[-300:],
        }  # fmt: skip
        if code in (0, 4):
            with contextlib.redirect_stderr(words), contextlib.redirect_stdout(words):
                row["deploy"] = deploy([str(folder), "--unverified", *WAY])
            row["words"] = words.getvalue()[-300:]
            place = folder / "deploy" / "deploy.json"
            if place.exists():
                row["called"] = json.loads(place.read_text())["status"]
            if code == 4 and row["called"] == "verified":
                row["faults"].append("verified, of a run that is not")
            if row["called"] == "verified":
                row["faults"] += verdict(folder, facts, index)
    return row | {"cpu_seconds": time.process_time() - began}


def main() -> None:
    """Run, print a line a case and the shares at the end."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=16)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    done = {}
    if options.out and options.out.exists():
        found = [json.loads(line) for line in options.out.read_text().splitlines()]
        done = {row["index"]: row for row in found if row["seed"] == options.seed}
    for index in range(options.first, options.first + options.cases):
        row = done.get(index) or {"seed": options.seed} | one(options.seed, index)
        rows.append(row)
        print(
            f"{index:4d} +-{100 * row['shift']:3.1f} % {row['status']:13s} "
            f"{','.join(row['failed']):28s} {row['design_at'] or '':8s} {row['called'] or '':13s}"
            f"{row['cpu_seconds']:6.1f} s  {'; '.join(row['faults'])}",
            flush=True,
        )
        if options.out and index not in done:
            with options.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    report(rows)


def report(rows: list[dict]) -> None:
    """Shares by reason, and what was called verified and is not."""
    total = len(rows)

    def share(label: str, counts: collections.Counter) -> None:
        for key, count in counts.most_common():
            print(f"{label} {key}: {count} of {total} ({100 * count / total:.0f} %)")

    share("solve", collections.Counter(row["status"] for row in rows))
    share("  failed check", collections.Counter(k for row in rows for k in row["failed"]))
    lines = [
        f"{k} {v}" for row in rows for k, v in row["lines"].items() if v in ("failed", "warned")
    ]
    share("  line of the verdict", collections.Counter(lines))
    share("  design plant", collections.Counter(r["design_at"] for r in rows if r["design_at"]))
    share("deploy", collections.Counter(row["called"] for row in rows if row["called"]))
    called = [row for row in rows if row["called"] == "verified"]
    wrong = [row for row in called if row["faults"]]
    print(f"called verified: {len(called)}, of these refuted: {len(wrong)}")
    for row in wrong:
        print(row["index"], row["faults"])


if __name__ == "__main__":
    main()
