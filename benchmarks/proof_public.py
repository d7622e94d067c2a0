"""Two public plants proven over their whole ranges: a disk drive's temperatures, a soft shaft.

    python benchmarks/proof_public.py [--only drive|positioning] [--draws N] [--most BOXES]

Drive: PyHDDBenchmark's dual-stage drive (examples/disk_drive) with the kept controllers, at every
temperature from cold to hot at once, each mode by its own law, with every gain of the piezo within
±5 %: modes, hold and one output of two actuators by the package's discs (`mode_discs`).
Positioning: MathWorks' two inertias on a soft shaft, three dampings ±50 % and a stiffness ±25 %,
with the controller of benchmarks/mathworks.py. Its dampings couple the modes, so that the package
has no discs for it; here |S| is enclosed as a quotient of polynomials by the same affine forms and
divided by the same branch and bound. Then random plants, judged by NumPy alone, are held against
what is proven.
"""

import argparse
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import numpy as np
from scipy.signal import ss2tf

from ccd_casadi.fixed_structure.affine import Affine, inverse, root, variable
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import divide
from ccd_casadi.fixed_structure.boxes import Boxes, axis_of
from ccd_casadi.fixed_structure.enclosure import Enclosures, LoopFamily
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.lti.loop import Loop
from ccd_casadi.support.arrays import Array

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "examples" / "disk_drive"))
import design as drive_design  # noqa: E402
import plant as drive  # noqa: E402

HZ = 2.0 * np.pi
SLACK = 0.02


@dataclass(frozen=True)
class DriveModes(ModalSum):
    """The drive's modes over temperature t and gain g of the piezo, time in 1/`scale`.

    ω_i (1 - rate t), ζ_i (1 + 0.2 t); the piezo's modes times (1 - 0.06 t)² (1 + g), which keeps
    its answer at rest. The spring that holds the arm, mode 0, does not move.
    """

    ratio: Array = field(kw_only=True)
    vcm: int = field(kw_only=True)

    def poles(
        self, i: int, names: tuple[str, ...], low: Array, high: Array, moved: Affine | None = None
    ) -> tuple[list[tuple[Affine, Affine]], np.ndarray]:
        m = low.shape[1]
        one = Affine(np.ones(m), np.zeros((3, m)), np.zeros(m))
        t, g = (variable(low[k], high[k], k + 1, 3) for k in range(2))
        piezo, still = i >= self.vcm, i == 0
        rate = -0.06 if piezo else -0.04
        slower = one if still else t * rate + 1.0
        w = slower * self.omega[i]
        half = w * self.ratio[i] * (one if still else t * 0.2 + 1.0)
        swing = root(w * w - half * half) * 1j
        gain = slower * slower * (g + 1.0) if piezo else one
        residue = gain * inverse(swing * 2.0)
        return [(swing - half, residue), (-swing - half, -residue)], np.zeros(m)


def of_drive(most: int, draws: int) -> None:
    """Both kept controllers."""
    box = np.array([[-1.0, -0.05], [1.0, 0.05]])
    kept = json.loads((ROOT / "benchmarks" / "disk_drive.json").read_text())["sections"]
    shapes = {"largest bandwidth": (2, 3, 0.1), "least error": (4, 5, 0.05)}
    for name, shape in shapes.items():
        structure = drive_design.structure(*shape)
        kappa = drive_design.read(structure, kept[name])
        soft = drive_design.SOFTER_HZ
        model = drive.plants([0.0], [1.0], soft)[0]
        K = structure.state_space(kappa)
        assert Loop(model, K, drive_design.SAMPLING).stable
        unit = 2.0 * drive.RATE_HZ
        omega = np.concatenate([drive.VCM["hz"], drive.PZT["hz"]]) * HZ
        zeta = np.concatenate([drive.VCM["zeta"], drive.PZT["zeta"]])
        omega[0], zeta[0], vcm = soft * HZ, 0.7, len(drive.VCM["hz"])
        kappa_p = np.array(drive.PZT["kappa"])
        static = abs((kappa_p / omega[vcm:] ** 2).sum())
        B = np.zeros((len(omega), 2))
        B[:vcm, 0] = drive.VCM["gain"] * np.array(drive.VCM["kappa"])
        B[vcm:, 1] = kappa_p / static
        modes = DriveModes(
            omega / unit, np.zeros(len(omega), bool), (0.0, 0.0), 0.0 * omega, 0.0, B / unit**2,
            np.ones((len(omega), 1)), ratio=zeta, vcm=vcm,
        )  # fmt: skip
        own = structure.in_units(kappa, 1.0 / unit, 1.0)
        d = structure.decoupling
        points = np.random.default_rng(0).uniform(*box, (draws, 2))
        seen = max(drive_peak(K, t, 1.0 + g, soft) for t, g in points)
        bounds = Bounds(S_max=seen, S_low=1.0, omega_low=drive_design.BOUNDS.omega_low)
        family = LoopFamily(
            modes, ("temperature", "gain"), tuple(structure.split(own)), d.outputs, d.inputs,
            bounds, 1.0, unit, unit / drive.RATE_HZ, 0.0,
        )  # fmt: skip
        told(f"drive, {name}", seen, draws, [family], box, most)


def told(name: str, seen: float, draws: int, families: list, box: Array, most: int) -> None:
    """What is proven, beside the largest of the draws."""
    began = process_time()
    proof = divide(families, box, SLACK, most)
    print(f"{name}: |S| of {draws} draws at most {seen:.4f}; {proof.words}: "
          f"{proof.levels.get('S_MAX', np.inf) * seen:.4f}; {process_time() - began:.0f} s of a "
          "processor", flush=True)  # fmt: skip


def drive_peak(K: object, t: float, gain: float, soft: float) -> float:
    """|S| on a grid by NumPy alone: the hold of each mode's own pole, K by Tustin's rule."""
    T = 1.0 / drive.RATE_HZ
    f = np.concatenate([np.geomspace(20.0, 0.5 * drive.RATE_HZ, 1500), DENSE])
    z = np.exp(1j * HZ * f * T)
    w = 2.0 / T * (z - 1.0) / (z + 1.0)
    on_vcm, on_pzt, on_damping = drive.factors(t)
    total = np.zeros((len(f), 2), complex)
    for column, (which, on) in enumerate(((drive.VCM, on_vcm), (drive.PZT, on_pzt))):
        omega = HZ * on * np.array(which["hz"], float)
        zeta = on_damping * np.array(which["zeta"], float)
        size = np.array(which["kappa"], float)
        if column == 0:
            omega[0], zeta[0], size = HZ * soft, 0.7, size * which["gain"]
        else:
            size = size * gain / abs((size / omega**2).sum())
        p = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
        for pole in (p, p.conj()):
            residue = size / (pole - pole.conj())
            total[:, column] += (
                np.expm1(pole * T) / pole * residue / (z[:, None] - np.exp(pole * T))
            ).sum(axis=1)
    gains = K.C @ np.linalg.solve(w[:, None, None] * np.eye(len(K.A)) - K.A, K.B + 0j) + K.D
    return float(np.abs(1.0 / (1.0 + (total * gains[:, :, 0]).sum(axis=1))).max())


DENSE = np.linspace(300.0, 15e3, 3000)


@dataclass(frozen=True)
class Shaft:
    """S = D_K D/(D_K D + N_K N) over frequency, b_1, b_2, b_12, k; ascending coefficients."""

    numerator: Array
    denominator: Array
    bounds: Bounds
    unit: float
    names: tuple[str, ...] = ("b1", "b2", "b12", "k")
    period: None = None
    bandwidth: float = 1.0
    corner: float = np.inf

    def enclose(self, boxes: Boxes) -> Enclosures:
        axis = axis_of(boxes, None, 0.0)
        n = 5
        x, y = axis.x.of(n), axis.y.of(n) * self.unit  # s = y/x
        b1, b2, b12, k = (variable(boxes.low[i], boxes.high[i], i, n) for i in range(1, n))
        J1, J2 = 1e-6, 1.15e-7
        # D/s = J1 J2 s³ + (J1 (b2 + b12) + J2 (b1 + b12)) s² + (k (J1 + J2) + b1 b2 + ...) s + ...
        d = [k * (b1 + b2), k * (J1 + J2) + b1 * b2 + b12 * (b1 + b2),
             (b2 + b12) * J1 + (b1 + b12) * J2, J1 * J2]  # fmt: skip
        plant = y * polynomial(d, x, y)
        force = polynomial([k, b12], x, y) * x * x * x
        A = plant * polynomial(list(self.denominator), x, y)
        whole = A + force * polynomial(list(self.numerator), x, y)
        S = A * inverse(whole)
        most = np.minimum(S.size, (np.abs(A.centre) + A.reach + A.rest) / whole.lowest)
        bounded = whole.lowest > 0.0
        limit = np.where(boxes.chart == 3, np.inf, self.bounds.S_max)
        highest = np.where(bounded & np.isfinite(most), most, np.inf) / limit
        lowest = np.where(bounded, S.lowest, 0.0) / limit
        spread = np.abs(whole.slope) / np.abs(whole.centre)
        return Enclosures(("S_MAX",), highest[None], lowest[None], spread, bounded)


def polynomial(c: list, x: Affine, y: Affine) -> Affine:
    """Σ c_i y^i x^(n-i): a polynomial of s = y/x times x^n."""
    one = Affine(np.ones(len(x.centre)), np.zeros_like(x.slope), np.zeros(len(x.centre)))
    total, ahead = one * 0.0, one
    for i, own in enumerate(c):
        term = ahead
        for _ in range(len(c) - 1 - i):
            term = term * x
        total = total + term * own
        ahead = ahead * y
    return total


def of_positioning(most: int, draws: int) -> None:
    """|S| of the continuous loop, as its goals are."""
    import mathworks

    K = mathworks.tuned_positioning()[0]
    numerator, denominator = (np.ravel(part)[::-1] for part in ss2tf(K.A, K.B, K.C, K.D))
    centre, reach = mathworks.CENTRE, mathworks.REACH
    box = np.array([centre - reach, centre + reach])
    rng, f = np.random.default_rng(0), np.geomspace(1e-2, 1e5, 4000)
    s, seen = 1j * f, 0.0
    gain = np.polyval(numerator[::-1], s) / np.polyval(denominator[::-1], s)
    for i in range(draws):
        share = rng.integers(0, 2, 4) if i % 2 else rng.random(4)
        G = mathworks.positioning(*(box[0] + share * (box[1] - box[0])))
        assert Loop(G, K, None).stable
        response = G.response(f)[:, 0, 0]
        seen = max(seen, float(np.abs(1.0 / (1.0 + response * gain)).max()))
    bounds = Bounds(S_max=seen, S_low=1.0, omega_low=1e-3)
    told("positioning", seen, draws, [Shaft(numerator, denominator, bounds, 3e3)], box, most)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=("drive", "positioning"))
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--most", type=int, default=2_000_000)
    given = parser.parse_args()
    if given.only != "positioning":
        of_drive(given.most, given.draws)
    if given.only != "drive":
        of_positioning(given.most, given.draws)


if __name__ == "__main__":
    main()
