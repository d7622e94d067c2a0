"""Every local peak of σ_max(S) with its total derivatives, on a plant and its perturbed siblings.

‖S‖∞ is the largest of them and has a kink where two are equal; each alone is smooth. By the
envelope theorem the derivative of a local maximum is that of σ_max(S(jω)) at its frequency.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from ccd_casadi.kernels.figures import Code, Figure
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gradients import DesignPlant, Loop, peak_gradients
from ccd_casadi.kernels.sensitivity import sensitivity_gain, sensitivity_gains
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.weights import Weights

# Around each closed-loop pole in multiples of its width, and over the decades about ω₀: what no
# pole of plant or loop points at is as broad as the distance between two of these.
FLANKS = np.array([0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0])
BROAD = np.geomspace(1e-2, 1e2, 1201)
APART = 1e-7  # relative: closer points of the grid differ in gain by rounding alone


@dataclass(frozen=True)
class LocalPeak:
    """One local maximum of σ_max(S): ω in rad/s, ln of it, and derivatives of that logarithm.

    `member`: 0 the plant itself, i the i-th of its family. `gradient` (n_θ + 2) to θ and
    (ln ω_S, ln ω_T).
    """

    omega: float
    member: int
    ln_gain: float
    gradient: Array


def local_peaks_with_gradients(
    plant: ScaledPlant,
    weights: Weights,
    design: Sensitivities,
    *,
    gamma_backoff: float,
    least: float,
) -> tuple[LocalPeak, ...]:
    """All local peaks of at least `least`, largest first; none where the design has no derivatives.

    `design`: what `sensitivities` made of the same plant and weights; nothing is made anew.
    """
    made = design.made
    if made is None or made.row[Figure.CODE] != Code.CERTIFIED or made.row[Figure.BALANCED]:
        return ()
    w0, w = plant.omega_0, weights.scaled(plant.omega_0)
    made_on = plant if plant.family is None else plant.family.design
    found = [
        (omega, i, gain)
        for i, member in enumerate(plant.members)
        for omega, gain in _peaks(member, made.controller, least)
    ]
    if not found:
        return ()
    loops = [
        Loop(at.A, at.B, at.C, at.dA, at.dB, at.dC, omega)
        for omega, at in ((omega, plant.members[i]) for omega, i, _ in found)
    ]
    count = plant.dA.shape[0]
    slopes = (made_on.dA, made_on.dB, made_on.dC)
    made_at = DesignPlant(made_on.A, made_on.B, made_on.C, *slopes, w, gamma_backoff, weights.delta)
    try:
        rows = peak_gradients(made_at, made.row, made.to_gamma, loops)
    except np.linalg.LinAlgError:
        return ()
    out = []
    for (omega, i, gain), raw in zip(found, rows, strict=True):
        to_weights = raw[count : count + w.size] * w
        whole = np.array([*raw[:count], to_weights[2], to_weights[7]])
        if np.isfinite(whole).all():
            out.append(LocalPeak(omega * w0, i, float(np.log(gain)), whole))
    return tuple(sorted(out, key=lambda peak: -peak.ln_gain))


def _peaks(
    plant: ScaledPlant, controller: tuple[Array, Array, Array], least: float
) -> list[tuple[float, float]]:
    """Local maxima of σ_max(S) of at least `least`, (ω over ω₀, gain)."""
    Ak, Bk, Ck = (np.ascontiguousarray(part) for part in controller)
    Dk = np.zeros((Ck.shape[0], Bk.shape[1]))
    A = np.block([[plant.A, plant.B @ Ck], [-Bk @ plant.C, Ak]])
    poles = np.linalg.eigvals(A)
    poles = poles[poles.imag > 0.0]
    pieces = [plant.grid, BROAD]
    for sign in (1.0, -1.0):
        pieces += [poles.imag + sign * np.abs(poles.real) * flank for flank in FLANKS]
    grid = np.unique(np.concatenate(pieces))
    grid = grid[(grid >= plant.grid[0]) & (grid <= plant.grid[-1])]
    grid = np.ascontiguousarray(grid[np.append(True, np.diff(grid) > APART * grid[1:])])
    G, K = prepare(plant.A, plant.B, plant.C), prepare(Ak, Bk, Ck)
    gain = sensitivity_gains(G, K, Dk, grid)
    tops = np.flatnonzero((gain[1:-1] > gain[:-2]) & (gain[1:-1] >= gain[2:])) + 1
    found = []
    for i in tops[gain[tops] >= 0.98 * least]:
        best = minimize_scalar(
            lambda x: -sensitivity_gain(G, K, Dk, np.exp(x)),
            bounds=np.log([grid[i - 1], grid[i + 1]]),
            method="bounded",
            options={"xatol": 1e-10},
        )
        if -best.fun >= least:
            found.append((float(np.exp(best.x)), float(-best.fun)))
    return found
