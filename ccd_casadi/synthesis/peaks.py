"""Every local peak of σ_max(S) with its total derivatives, on a plant and its perturbed siblings.

‖S‖∞ is the largest of them and has a kink where two are equal; each alone is smooth. By the
envelope theorem the derivative of a local maximum is that of σ_max(S(jω)) at its frequency.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.kernels.figures import Code, Column
from ccd_casadi.kernels.frequency import prepare
from ccd_casadi.kernels.gradients import LoopAt, MadeFor, peak_gradients
from ccd_casadi.kernels.sensitivity import sensitivity_gain, sensitivity_gains
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.grid import frequency_grid, local_maxima, refine_peak, root_flanks
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.weights import Weights

# Around each closed-loop pole in multiples of its width, and over the decades about ω₀: what no
# pole of plant or loop points at is as broad as the distance between two of these.
HALF = np.array([0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0])
FLANKS = np.concatenate([-HALF[::-1], [0.0], HALF])
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
    if made is None or made.row[Column.CODE] != Code.CERTIFIED or made.row[Column.BALANCED]:
        return ()
    w0, w = plant.omega_0, weights.scaled(plant.omega_0)
    found = [
        (omega, i, gain)
        for i, member in enumerate(plant.members)
        for omega, gain in _peaks(member, made.controller, least)
    ]
    if not found:
        return ()
    loops = [LoopAt(plant.members[i], omega) for omega, i, _ in found]
    count = plant.dA.shape[0]
    made_for = MadeFor(plant.design_plant, w, gamma_backoff, weights.delta)
    try:
        rows = peak_gradients(made_for, made.row, made.to_gamma, loops)
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
    poles = closed_loop(plant.system, StateSpace(Ak, Bk, Ck, Dk)).S.poles
    near = root_flanks(poles[poles.imag > 0.0], FLANKS)
    low, high = float(plant.grid[0]), float(plant.grid[-1])
    grid = np.ascontiguousarray(frequency_grid(low, high, 2, plant.grid, BROAD, near, apart=APART))
    G, K = prepare(plant.A, plant.B, plant.C), prepare(Ak, Bk, Ck)
    gain = sensitivity_gains(G, K, Dk, grid)
    found = []
    for i in local_maxima(gain):
        if gain[i] >= 0.98 * least:
            omega, top = refine_peak(
                lambda w: sensitivity_gain(G, K, Dk, w), grid[i - 1], grid[i + 1]
            )
            if top >= least:
                found.append((omega, top))
    return found
