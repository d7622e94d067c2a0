"""What is drawn of one design: gains, Nyquist, poles, a step and a move; pure functions of it."""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.analysis.loop import Loop
from ccd_casadi.analysis.move import Move
from ccd_casadi.analysis.signals import signals_of
from ccd_casadi.deployment.given_controller import in_discrete_time
from ccd_casadi.explorer.designs import Look, Standing
from ccd_casadi.fixed_structure import Sampling
from ccd_casadi.inner_problem.sweep import missed_by
from ccd_casadi.lti.closed_loop import largest, responses_of
from ccd_casadi.lti.grid import frequency_grid
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.reporting.loops import section_bounds
from ccd_casadi.reporting.nyquist import around_resonances, loci_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.classical_margins import ClassicalMargins, least_margins

POINTS = 180  # of the frequency grid, besides those around resonances
SAME = 1e-9  # relative distance of two frequencies below which they are one


@dataclass(frozen=True)
class Curves:
    """Of one design. Gains are largest singular values of S, KS (N/m) and T, rows (3, k) over Hz.

    `bounds` are γ/|W1|, γ/|W2|, γ/|W3| (3, k). `loci` (k, p): eigenvalues of L = GK. `margins`: the
    least of the loops broken one at a time at the plant's inputs. `poles` of the closed loop, of K
    and of G in Hz, complex. `step`: y of the first output after a step of its reference, over s.
    """

    hz: Array
    gains: Array
    bounds: Array
    loci: np.ndarray
    margins: ClassicalMargins
    poles: np.ndarray
    controller_poles: np.ndarray
    plant_poles: np.ndarray
    step_time: Array
    step: Array
    move: Move

    @property
    def unstable(self) -> bool:
        """Of the loop: it has no step, no move and no margins."""
        return not self.poles.real.max() < 0.0


@dataclass(frozen=True)
class AsSampled:
    """The same controller by Tustin's rule at a rate, hold and delay exact: judged, not designed.

    `stable`, ω_b in Hz and ‖S‖∞ are of the sampled loop; σ_max(S) over Hz up to half the rate.
    """

    stable: bool
    bandwidth_hz: float
    peak: float
    hz: Array
    gain: Array


def curves_of(look: Look) -> Curves | None:
    """The curves of a design; None where its synthesis ended without a controller."""
    if look.controller is None:
        return None
    plant, K = look.plant, look.controller
    hz = grid_of(look)
    run_at = sampling_of(look)

    loop = Loop(plant.plant_si(), K, run_at)
    if run_at is not None:  # it was designed for hold and delay
        hz = hz[hz < 0.499 * run_at.rate_hz]
    G, k = loop.responses(HZ * hz)
    found = responses_of(G, k)
    gains = np.array([largest(found[name]) for name in ("S", "KS", "T")])
    bandwidth = look.bandwidth_hz if np.isfinite(look.bandwidth_hz) else plant.omega_0 / HZ
    signals = signals_of(
        loop, modal_plant(look.elements.system, Suspension(0.0, 0.0)), bandwidth
    )
    return Curves(
        hz=hz,
        gains=gains,
        bounds=bounds_of(look, hz),
        loci=loci_of(G @ k, np.inf),
        margins=least_margins(loop.responses, HZ * hz),
        poles=signals.poles / HZ,
        controller_poles=np.linalg.eigvals(K.A) / HZ,
        plant_poles=np.linalg.eigvals(plant.A) * plant.omega_0 / HZ,
        step_time=signals.step_time,
        step=signals.step,
        move=signals.move,
    )


def sampling_of(look: Look) -> Sampling | None:
    """The sampled loop that a design is made for; None where that is a continuous one."""
    sections = look.problem.sections
    return None if sections is None else sections.sampling


def bounds_of(look: Look, hz: Array) -> Array:
    """What σ_max of S, KS and T must not exceed (3, k): γ/|W|, or the bounds of the sections."""
    if look.problem.sections is not None:
        return section_bounds(look.problem, hz, look.bandwidth_hz)
    size = np.abs(look.weights.responses(HZ * hz))
    return float(np.nan_to_num(look.figures.certificate.norm_bound)) / size


def grid_of(look: Look) -> Array:
    """Frequencies in Hz from ω_low/5 to far beyond ω_b and the modes, fine where either needs it.

    It holds the peak of S and ω_b themselves.
    """
    plant, figures = look.plant, look.figures
    low = look.problem.inner.omega_low / HZ / 5.0
    natural = plant.natural[plant.natural > 0.0] / HZ
    bandwidth = look.bandwidth_hz if np.isfinite(look.bandwidth_hz) else plant.omega_0 / HZ
    high = max(30.0 * bandwidth, 3.0 * float(natural.max(initial=0.0)))
    around = around_resonances(plant, look.controller)
    special = [figures.sensitivity_peak_frequency / HZ, look.bandwidth_hz]
    # around a double pole they come twice
    return frequency_grid(low, high, POINTS, around, np.array(special), apart=SAME)


def sampled_of(look: Look) -> AsSampled | None:
    """A certified design at the rate and delay of its sliders; None where it is designed for it."""
    if look.controller is None or look.problem.sections is not None:
        return None
    if look.standing is Standing.REFUSED:
        return None
    return as_sampled(look.plant, look.controller, look.knobs.rate_hz, look.knobs.delay_us)


def with_sampled(look: Look, found: AsSampled | None) -> Look:
    """The look with the standing that its sampled loop leaves it."""
    k, S_max = look.knobs, look.problem.inner.S_max
    if found is None or (found.stable and found.peak <= S_max):
        return look
    at = f"as sampled at {k.rate_hz:.4g} Hz with a delay of {k.delay_us:.4g} µs"
    if not found.stable:
        return replace(look, standing=Standing.REFUSED, reason=f"the loop is unstable {at}")
    if look.standing is not Standing.KEPT:
        return look  # it is no better already
    over = missed_by(found.peak, S_max)
    return replace(look, standing=Standing.MISSED, reason=f"{at} the peak of S is {over}")


def as_sampled(
    plant: ScaledPlant, controller: StateSpace, rate_hz: float, delay_us: float
) -> AsSampled:
    """A controller in discrete time on a plant: stability, ω_b and ‖S‖∞, hold and delay exact."""
    sampled = in_discrete_time(controller, Sampling(rate_hz, delay_us))
    stable, bandwidth, peak, _ = sampled.judge(plant)
    near = plant.grid * plant.omega_0 / HZ
    hz = frequency_grid(1e-4 * rate_hz, 0.499 * rate_hz, POINTS, near)
    S = sampled.loop(plant).sensitivity(HZ * hz)
    return AsSampled(stable, bandwidth / HZ, peak, hz, largest(S))
