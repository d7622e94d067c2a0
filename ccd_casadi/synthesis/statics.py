"""The loop at rest and at the lowest frequency that counts: what a constant force does.

    K(0) in N/m,   GS(0) = (I + G(0) K(0))⁻¹ G(0) in m/N, the rigid bodies on their suspension

Not the edge of a grid: mixed sensitivity cancels the suspension's poles, and |K| may fall by
decades below the last frequency that a grid shows. With an integrator GS(0) is nothing and K(0)
what rounding left of a pole; what such a loop gives way is then told at ω_low.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.grid import refine_peak
from ccd_casadi.lti.norms import gains, hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.units import HZ, display_unit, spoken, with_unit

DIFFERENTIATOR = 0.1  # |K(0)| under this share of |K(jω_b)| holds little at rest
# |p|/ω_b of a controller's slowest pole below which it is an integrator: rounding, or an hour
INTEGRATOR = 1e-6

RESTING = 1e-6  # of ω_low: where a plant with a pole at 0 is at rest


@dataclass(frozen=True)
class Statics:
    """Least singular value of K(0) (N/m), largest of GS(0) (m/N), |K(0)| over |K| at ω_b.

    Infinite, 0 and infinite of a controller that integrates. `low` is that of GS at `low_hz`.
    """

    stiffness: float
    compliance: float
    share: float
    low: float
    low_hz: float

    @property
    def differentiates(self) -> bool:
        """Whether the controller is almost a differentiator."""
        return self.share < DIFFERENTIATOR

    @property
    def words(self) -> str:
        """One or two sentences."""
        low = f"{spoken('1 N')} at {self.low_hz:.3g} Hz moves it {with_unit(self.low, spoken('m'))}"
        if np.isinf(self.stiffness):  # a pole at rest
            return f"The controller integrates: a constant force does not move the stage; {low}."
        found = (
            f"Static stiffness K(0) = {with_unit(self.stiffness, spoken('N/m'))}: "
            f"a constant force of {spoken('1 N')} moves the stage "
            f"{with_unit(self.compliance, spoken('m'))}, {low}."
        )
        if self.differentiates:
            found += (
                f" K(0) is {100.0 * self.share:.2g} % of |K| at the bandwidth: the controller is "
                "almost a differentiator, and holds little against cables, friction and gravity."
            )
        return found


def statics(
    plant: StateSpace, controller: StateSpace, *, bandwidth: float, omega_low: float
) -> Statics:
    """Of a continuous plant, at rest close to 0, and a controller in SI; ω_b, ω_low in rad/s.

    Of a controller in discrete time the rest is z = 1; hold and delay, which turn nothing at
    ω_low, are left out there.
    """

    def at(omega: float) -> np.ndarray:
        return controller.response(np.array([omega]))[0]

    def compliance(omega: float, K: np.ndarray) -> float:
        G = plant.response(np.array([max(omega, RESTING * omega_low)]))[0]
        return float(np.linalg.norm(np.linalg.solve(np.eye(len(G)) + G @ K, G), 2))

    low = compliance(omega_low, at(omega_low))
    poles, T = controller.poles, controller.period
    rates = np.abs(poles - 1.0) / T if T else np.abs(poles)
    if rates.size and rates.min() <= INTEGRATOR * bandwidth:
        return Statics(np.inf, 0.0, np.inf, low, omega_low / HZ)
    K0 = at(0.0)
    gains = np.linalg.svd(K0, compute_uv=False)
    share = gains[0] / max(float(np.linalg.norm(at(bandwidth), 2)), 1e-300)
    return Statics(float(gains[-1]), compliance(0.0, K0), float(share), low, omega_low / HZ)


def compliance_words(most: float, at_rest: float, low: float, low_hz: float) -> str:
    """‖GS‖∞, GS at rest (0: an integrator) and at the lowest frequency that counts, all in m/N.

    >>> compliance_words(2e-6, 0.0, 5e-7, 1.0)
    '2 um/N at most, 0.5 um/N at 1 Hz, none at rest (an integrator)'
    >>> compliance_words(64e-3, 59e-3, 5.5e-3, 1.0)
    '64 mm/N at most, 5.5 mm/N at 1 Hz, 59 mm/N at rest'
    """
    metres, factor = display_unit(spoken("m"), most)
    unit = f"{metres.replace('µ', 'u')}{spoken('/N')}"  # as the terminal prints it
    rest = f"{factor * at_rest:.4g} {unit} at rest" if at_rest else "none at rest (an integrator)"
    at_low = f"{factor * low:.4g} {unit} at {low_hz:.3g} Hz"
    return f"{factor * most:.4g} {unit} at most, {at_low}, {rest}"


WITHIN = 1e-3  # relative: where the maximum is, from where the norm was found


@dataclass(frozen=True)
class Compliance:
    """‖GS‖∞ in m/N, its frequency in rad/s (0: at rest), and the plant that has it."""

    gain: float
    omega: float
    plant: ScaledPlant


def compliance_of(plant: ScaledPlant, controller: StateSpace) -> Compliance:
    """‖GS‖∞ with a controller in SI (e in, u out); infinite where the loop is not stable."""
    loop = closed_loop(plant.plant_si(), controller).GS
    gain, omega = hinf_norm(loop)
    if not np.isfinite(gain) or omega <= 0.0:
        return Compliance(gain, omega, plant)
    at, top = refine_peak(
        lambda w: float(gains(loop, np.array([w]))[0]),
        omega * np.exp(-WITHIN), omega * np.exp(WITHIN),
    )  # fmt: skip
    if top >= gain:
        gain, omega = top, at
    return Compliance(gain, omega, plant)


def compliance_over_family(plant: ScaledPlant, controller: StateSpace) -> Compliance:
    """The largest of the plant itself and, where it has a family, of every plant of that."""
    return max((compliance_of(each, controller) for each in plant.members), key=lambda c: c.gain)
