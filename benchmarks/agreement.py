"""Whether the kernels' figures moved: every random design of an older revision against now.

    python benchmarks/agreement.py [revision] [n_siso] [n_mimo]

checks out `revision` (default HEAD) beside the working tree, runs the same random designs with
both, and prints the largest relative differences, the outcomes, and the designs whose outcome
changed.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

FIGURES = ("GAMMA_OPT", "GAMMA_LOWER_BOUND", "BANDWIDTH", "PEAK", "PEAK_FREQUENCY", "LOW",
           "MAX_REAL_POLE", "NORM")  # fmt: skip


def figures(siso: int, mimo: int, warm: bool) -> np.ndarray:
    """Rows of figures of random designs; with `warm` each starts from a γ_opt 1 % off."""
    from problems import BACKOFF, OMEGA_LOW, stage, two_masses, weights

    from ccd_casadi.kernels.design import design
    from ccd_casadi.kernels.figures import Column

    rng = np.random.default_rng(7)
    rows = []
    for i in range(siso + mimo):
        plant = two_masses(*rng.uniform(55, 70, 2), 10 ** rng.uniform(6.5, 7.5)) if i < siso else (
            stage(i // 4, flexible=int(rng.integers(2, 11)))
        )  # fmt: skip
        omega_S, omega_T = np.exp(rng.uniform(np.log([30, 10]), np.log([2000, 1000])))
        w = weights(omega_S, omega_T, plant.force).scaled(plant.omega_0)
        low = OMEGA_LOW / plant.omega_0
        row = design(plant.A, plant.B, plant.C, w, plant.grid, plant.gain, BACKOFF, low, 0.0)[0]
        if warm:
            guess = row[Column.GAMMA_OPT] * (1 + 0.01 * rng.choice([-1, 1]))
            row = design(plant.A, plant.B, plant.C, w, plant.grid, plant.gain, BACKOFF, low, guess)[
                0
            ]
        rows.append(row)
    return np.array(rows)


def compare(old: np.ndarray, new: np.ndarray) -> None:
    """Print the largest relative differences over designs that both certify."""
    from ccd_casadi.kernels.figures import Code, Column

    for code in Code:
        a, b = (rows[:, Column.CODE] == code for rows in (old, new))
        if a.any() or b.any():
            print(f"  {code.name:20s} {a.sum():6d} before, {b.sum():6d} now")
    moved = old[:, Column.CODE] != new[:, Column.CODE]
    print(f"  outcomes that changed: {np.flatnonzero(moved).tolist()}")
    both = ~moved & (old[:, Column.CODE] == 0)
    limited = (old[:, Column.LIMITED_BY_BOUND] != new[:, Column.LIMITED_BY_BOUND]) & both
    print(f"  limited by the bound: {int(new[:, Column.LIMITED_BY_BOUND].sum())}, "
          f"changed: {int(limited.sum())}")  # fmt: skip
    for name in FIGURES:
        a, b = old[both, Column[name]], new[both, Column[name]]
        with np.errstate(invalid="ignore"):
            off = np.abs(b / a - 1.0)
        off[a == b] = 0.0  # infinite peak frequencies
        print(f"  {name:20s} {off.max():.1e} (median {np.median(off):.1e})")
    forms = [rows[both, Column.SCHUR_FORMS].mean() for rows in (old, new)]
    print(f"  Schur forms to γ_opt: {forms[0]:.2f} before, {forms[1]:.2f} now")


def main(revision: str = "HEAD", siso: str = "2000", mimo: str = "120") -> None:
    """Compare the working tree with a revision of it."""
    root = Path(__file__).resolve().parents[1]
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(
            ["git", "archive", revision, "ccd_casadi"], cwd=root, check=True, capture_output=True
        )
        subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)
        results = []
        for place in (folder, str(root)):
            file = Path(folder) / "rows.npz"
            code = (
                f"import sys; sys.path[:0] = [{place!r}, {str(root / 'benchmarks')!r}]\n"
                "import numpy as np, agreement\n"
                f"a = [agreement.figures({siso}, {mimo}, warm) for warm in (False, True)]\n"
                f"np.savez({str(file)!r}, cold=a[0], warm=a[1])"
            )
            subprocess.run([sys.executable, "-c", code], check=True)
            results.append(dict(np.load(file)))
    for start in ("cold", "warm"):
        for name, part in (("SISO", slice(0, int(siso))), ("MIMO", slice(int(siso), None))):
            print(f"{name}, {start} start: {results[0][start][part].shape[0]} designs")
            compare(results[0][start][part], results[1][start][part])


if __name__ == "__main__":
    main(*sys.argv[1:])
