"""Is the morphed stage the drawn one? CalculiX meshes it anew at three θ; slopes by differences.

python examples/cad_stage/check.py        needs ccx (CalculiX) on the path, and the extra `cad`
"""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from stage import BOUNDS, solid

from ccd_casadi.extensions.cad.cad_stage import cad_stage
from ccd_casadi.extensions.cad.solid import kernel, load

HERE = Path(__file__).parent
SIZE = 6e-3  # m, of the elements of CalculiX, curved where the solid is
SHARES = ((0.1, 0.9), (0.5, 0.5), (0.9, 0.2))  # of the box: three θ
COUNT = 6
STEP = 1e-3  # of the box, for differences


def calculix(theta: dict[str, float], folder: Path) -> np.ndarray:
    """The COUNT lowest flexible frequencies in Hz, in C3D10 on a mesh of its own."""
    with kernel() as gmsh:
        load(gmsh, solid(theta)[0])
        gmsh.option.setNumber("Mesh.MeshSizeMax", SIZE)
        gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", 30)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        labels, points, _ = gmsh.model.mesh.getNodes()
        _, corners = gmsh.model.mesh.getElementsByType(11)
    order = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]  # Abaqus counts the last two edges the other way
    elements = corners.reshape(-1, 10)[:, order]
    text = ["*NODE, NSET=ALL"]
    rows = zip(labels, points.reshape(-1, 3), strict=True)
    text += [f"{n}, {x:.12e}, {y:.12e}, {z:.12e}" for n, (x, y, z) in rows]
    text.append("*ELEMENT, TYPE=C3D10, ELSET=STAGE")
    text += [", ".join(map(str, (k, *row))) for k, row in enumerate(elements.tolist(), start=1)]
    text += ["*MATERIAL, NAME=AL", "*ELASTIC", "68.9e9, 0.33", "*DENSITY", "2700."]
    text += ["*SOLID SECTION, ELSET=STAGE, MATERIAL=AL", "*STEP", "*FREQUENCY", f"{6 + COUNT}"]
    (folder / "stage.inp").write_text("\n".join([*text, "*END STEP", ""]))
    subprocess.run(["ccx", "stage"], cwd=folder, check=True, capture_output=True)
    table = (folder / "stage.dat").read_text().split("P A R T I C I P A T I O N")[0]
    words = (line.split() for line in table.splitlines())
    found = [float(row[3]) for row in words if len(row) == 5 and row[0].isdigit()]
    return np.sort(found)[6 : 6 + COUNT]


def main() -> None:
    names = tuple(BOUNDS)
    lower, upper = np.array([BOUNDS[name] for name in names]).T
    plant = cad_stage(names, morph=str(HERE / "stage.npz"), modes=COUNT)

    def squares(theta: np.ndarray) -> np.ndarray:
        return np.diag(plant.values(theta).K)[-COUNT:]

    worst = {"frequency": 0.0, "slope": 0.0}
    for share in SHARES:
        theta = lower + np.array(share) * (upper - lower)
        print(", ".join(f"{n} = {1e3 * v:.4g} mm" for n, v in zip(names, theta, strict=True)))
        system = plant.evaluate(theta)
        lam = np.diag(system.K)[-COUNT:]
        own = np.sqrt(lam) / (2.0 * np.pi)
        with tempfile.TemporaryDirectory() as folder:
            other = calculix(dict(zip(names, theta, strict=True)), Path(folder))
        print("  morphed mesh, Hz ", np.round(own, 1))
        print("  CalculiX, Hz     ", np.round(other, 1))
        worst["frequency"] = max(worst["frequency"], np.abs(own / other - 1.0).max())
        dM, _, dK, _, _ = system.derivatives
        for i, width in enumerate(upper - lower):
            exact = np.diag(dK[i])[-COUNT:] - lam * np.diag(dM[i])[-COUNT:]
            step = STEP * width * np.eye(len(names))[i]
            differences = (squares(theta + step) - squares(theta - step)) / (2.0 * STEP * width)
            worst["slope"] = max(
                worst["slope"], np.abs(differences - exact).max() / np.abs(exact).max()
            )
    print(f"frequencies differ by at most {100.0 * worst['frequency']:.2f} %, limit 1 %")
    print(f"slopes of eigenvalues differ by at most {worst['slope']:.1e}, limit 1e-4")
    if worst["frequency"] > 1e-2 or worst["slope"] > 1e-4:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
