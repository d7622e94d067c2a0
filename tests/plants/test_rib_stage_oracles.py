"""The stage against scikit-fem and CalculiX, where they are installed; neither is required."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.linalg import eigsh

from ccd_casadi.extensions.rib_stage.geometry import plain
from ccd_casadi.extensions.rib_stage.model import RibStage
from ccd_casadi.plants.finite_elements import Material

A = 1e-3 * np.array([1.0, 3.0, 8.0, 8.0, 16.806, 67.5])
B = 1e-3 * np.array([1.0, 3.0, 4.2446, 4.0588, 11.917, 74.974])
SIDE = 0.3


def intervals(theta: np.ndarray) -> tuple[np.ndarray, list[bool]]:
    """Edges of the whole side and which intervals are ribs, written out anew."""
    _, t_o, t_i, t_c, _, x_i = theta
    half = [0.5 * t_c, x_i - 0.5 * t_i, x_i + 0.5 * t_i, 0.5 * SIDE - t_o, 0.5 * SIDE]
    return np.array([-x for x in half[::-1]] + half), [True, False] * 4 + [True]


def boxes(ribs: list[bool], cells: list[int], layers: list[int]) -> list[tuple[int, int, int]]:
    """Cells (i, j, k) of the grid that are solid: the plate and the ribs on it."""
    rib = np.repeat(ribs, cells)
    return [
        (i, j, k)
        for k in range(sum(layers))
        for i in range(len(rib))
        for j in range(len(rib))
        if k < layers[0] or rib[i] or rib[j]
    ]


def lines(theta: np.ndarray, bay: int, rib: int, layers: list[int]) -> tuple[np.ndarray, ...]:
    """Grid lines along the side and the height; bays are graded towards the ribs."""
    edges, ribs = intervals(theta)
    parts = []
    for low, high, is_rib in zip(edges[:-1], edges[1:], ribs, strict=True):
        s = np.linspace(0.0, 1.0, (rib if is_rib else bay) + 1)
        if not is_rib:
            s = 0.5 * s + 0.25 * (1.0 - np.cos(np.pi * s))
        parts.append(low + (high - low) * s[:-1])
    h, H = theta[0], theta[4]
    z = np.concatenate(
        [np.linspace(0.0, h, layers[0] + 1), h + H * np.linspace(0, 1, layers[1] + 1)[1:]]
    )
    return np.append(np.concatenate(parts), edges[-1]), z


@pytest.mark.slow
def test_scikit_fem_has_the_same_frequencies_on_the_same_mesh() -> None:
    """27-node elements of scikit-fem on the whole stage, order two everywhere here."""
    skfem = pytest.importorskip("skfem")
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    x, z = lines(B, 1, 1, [1, 1])
    cells = boxes(intervals(B)[1], [1] * 9, [1, 1])
    # the centre rib is halved by the mirror plane of the quarter
    x = np.sort(np.append(x, 0.0))
    cells = [
        (i2, j2, k)
        for i, j, k in cells
        for i2 in ([i] if i < 4 else [4, 5] if i == 4 else [i + 1])
        for j2 in ([j] if j < 4 else [4, 5] if j == 4 else [j + 1])
    ]
    mesh = skfem.MeshHex.init_tensor(x, x, z)
    centre = mesh.p[:, mesh.t].mean(axis=1)
    index = np.stack(
        [np.searchsorted(g, c) - 1 for g, c in zip((x, x, z), centre, strict=True)], axis=1
    )
    solid = set(cells)
    mesh = mesh.restrict(np.array([i for i, c in enumerate(index.tolist()) if tuple(c) in solid]))
    element = skfem.ElementVector(skfem.ElementHex2())
    basis = skfem.Basis(mesh, element, intorder=4)
    material = Material()
    K = linear_elasticity(*lame_parameters(material.young, material.poisson)).assemble(basis)

    @skfem.BilinearForm
    def inertia(u, v, _):
        return material.density * sum(u[i] * v[i] for i in range(3))

    M = inertia.assemble(basis)
    shift = (2.0 * np.pi * 100.0) ** 2
    lam = eigsh(K.tocsc(), 16, M.tocsc(), sigma=-shift, return_eigenvectors=False)
    expected = np.sqrt(np.sort(lam)[6:]) / (2.0 * np.pi)
    stage = RibStage(order=plain(2, 2, 2), truncation="frequency")
    found = [mode.frequency for mode in stage.frequencies(B)[3:]]
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def calculix_frequencies(theta: np.ndarray, folder: Path) -> np.ndarray:
    """C3D20R on the whole stage, 16 lowest frequencies in Hz, from a mesh of its own."""
    bay, rib, layers = 6, 3, [2, 3]
    x, z = lines(theta, bay, rib, layers)
    ribs = intervals(theta)[1]
    cells = boxes(ribs, [rib if r else bay for r in ribs], layers)
    numbers: dict[tuple[int, int, int], int] = {}
    corners = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)]
    top = [(a, b, 2) for a, b, _ in corners]
    ring = [(1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0)]
    order = [
        *corners,
        *top,
        *ring,
        *((a, b, 2) for a, b, _ in ring),
        *((a, b, 1) for a, b, _ in corners),
    ]
    elements = [
        [
            numbers.setdefault((2 * i + a, 2 * j + b, 2 * k + c), len(numbers) + 1)
            for a, b, c in order
        ]
        for i, j, k in cells
    ]
    fine_x, fine_z = (
        np.interp(np.arange(2 * len(g) - 1) / 2, np.arange(len(g)), g) for g in (x, z)
    )
    text = ["*NODE, NSET=ALL"]
    text += [
        f"{n}, {fine_x[i]:.12e}, {fine_x[j]:.12e}, {fine_z[k]:.12e}"
        for (i, j, k), n in numbers.items()
    ]
    text.append("*ELEMENT, TYPE=C3D20R, ELSET=STAGE")
    for number, nodes in enumerate(elements, start=1):
        words = [str(n) for n in (number, *nodes)]
        text += [", ".join(words[:11]) + ",", ", ".join(words[11:])]
    text += ["*MATERIAL, NAME=AL", "*ELASTIC", "68.9e9, 0.33", "*DENSITY", "2700."]
    text += ["*SOLID SECTION, ELSET=STAGE, MATERIAL=AL", "*STEP", "*FREQUENCY", "16", "*END STEP"]
    (folder / "stage.inp").write_text("\n".join(text) + "\n")
    subprocess.run(["ccx", "stage"], cwd=folder, check=True, capture_output=True, timeout=900)
    found = []
    for line in (
        (folder / "stage.dat").read_text().split("P A R T I C I P A T I O N")[0].splitlines()
    ):
        words = line.split()
        if len(words) == 5 and words[0].isdigit():
            found.append(float(words[3]))
    return np.sort(np.array(found))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed")
@pytest.mark.parametrize("theta", [A, B], ids=["a", "b"])
def test_calculix_agrees_to_one_per_cent(theta: np.ndarray, tmp_path: Path) -> None:
    expected = calculix_frequencies(theta, tmp_path)
    assert expected[:6].max() < 1.0
    stage = RibStage(truncation="frequency")
    found = [mode.frequency for mode in stage.frequencies(theta)[3:]]
    np.testing.assert_allclose(found, expected[6:], rtol=1e-2)
