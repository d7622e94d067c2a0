"""The loop at rest, and its largest compliance: what a force moves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.lti.frequency_grid import refine_peak
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.norms import gains, hinf_norm
from ccd_casadi.lti.ports import BreakPoint, Ports
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.text import HZ, display_unit, spoken, with_unit


@dataclass(frozen=True)
class StaticsOptions:
    """Numbers of a loop at rest.

    Attributes
    ----------
    differentiator : float
        |K(0)| under this share of |K(jω_b)| holds little at rest.
    integrator : float
        |p|/ω_b of a controller's slowest pole below which it is an integrator: rounding, or an
        hour.
    resting : float
        Of ω_low: where a plant with a pole at 0 is evaluated at rest.
    apart : float
        Ratio of two frequencies just above those of integrators, between which K of a channel that
        integrates falls by as much; by less than its root: not every channel integrates.
    rounding : float
        Share of what a force moves at ω_low up to which what is left at rest is rounding.
    """

    differentiator: float = 0.1
    integrator: float = 1e-6
    resting: float = 1e-6
    apart: float = 4.0
    rounding: float = 1e-9


@dataclass(frozen=True)
class Statics:
    """A loop at rest.

    Attributes
    ----------
    stiffness, compliance : float
        Least singular value of K(0) in N/m, largest of GS(0) in m/N; where every channel
        integrates inf and 0.
    share : float
        |K(0)| over |K(jω_b)|; inf where any channel integrates.
    low, low_hz : float
        Largest singular value of GS in m/N at this frequency.
    """

    stiffness: float
    compliance: float
    share: float
    low: float
    low_hz: float

    @property
    def differentiates(self) -> bool:
        """Whether the controller is almost a differentiator."""
        return self.share < StaticsOptions().differentiator

    @property
    def words(self) -> str:
        """One or two sentences."""
        low = f"{spoken('1 N')} at {self.low_hz:.3g} Hz moves it {with_unit(self.low, spoken('m'))}"
        if np.isinf(self.stiffness):  # a pole at rest
            size = with_unit(self.compliance, spoken("m"))
            moved = f"of {spoken('1 N')} moves it {size}, beyond the sensors"
            held = moved if self.compliance else "does not move the stage"
            return f"The controller integrates: a constant force {held}; {low}."
        found = "" if np.isfinite(self.share) else "Not every channel integrates. "
        found += (
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


def statics_of(loop: Loop, *, bandwidth: float, omega_low: float) -> Statics:
    """`statics` of a loop's own plant and controller, at its places and ports.

    Parameters
    ----------
    loop : Loop
        SI.
    bandwidth, omega_low : float
        rad/s.

    Returns
    -------
    Statics
    """
    return statics(loop.plant, loop.controller, bandwidth=bandwidth, omega_low=omega_low,
                   places=loop.at, ports=loop.ports if loop.ported else None)  # fmt: skip


def statics(
    plant: StateSpace,
    controller: StateSpace,
    *,
    bandwidth: float,
    omega_low: float,
    places: Sequence[BreakPoint] = (),
    ports: Ports | None = None,
    options: StaticsOptions = StaticsOptions(),
) -> Statics:
    """Stiffness and compliance of a loop at rest.

    Of a controller in discrete time the rest is z = 1; hold and delay, which turn nothing at
    ω_low, are left out there.

    Parameters
    ----------
    plant, controller : StateSpace
        The plant continuous; SI.
    bandwidth, omega_low : float
        ω_b and the lowest frequency that counts, rad/s.
    places : sequence of BreakPoint
        Of several sensors on one actuator: K is then the force per motion of the first, whose error
        counts, while one force moves them all.
    ports : Ports, optional
        Where forces act and the error counts: compliances are of these, at rest near it.
    options : StaticsOptions
        Numbers of the method.

    Returns
    -------
    Statics
        SI.
    """

    row = np.array([places[0].output]) if places else np.eye(len(plant.C))

    def moved(omega: float) -> np.ndarray:
        return plant.response(np.array([max(omega, options.resting * omega_low)]))[0]

    def at(omega: float) -> np.ndarray:
        K = controller.response(np.array([omega]))[0]
        return K @ moved(omega) / (row @ moved(omega)) if places else K

    def compliance(omega: float, K: np.ndarray) -> float:
        if ports is not None:
            rate = Sampling(1.0 / controller.period) if controller.period else None
            loop = Loop(plant, controller, rate, drive=ports.drive, counted=ports.counted)
            at = np.array([omega])
            found = (
                loop.force_responses(at) if omega else loop.closed.GS.response(at)
            )  # exact at rest
            return float(np.linalg.norm(found[0], 2))
        G = row @ moved(omega)
        return float(np.linalg.norm(np.linalg.solve(np.eye(len(G)) + G @ K, G), 2))

    low = compliance(omega_low, at(omega_low))
    poles, T = controller.poles, controller.period
    rates = np.abs(poles - 1.0) / T if T else np.abs(poles)
    if rates.size and rates.min() <= options.integrator * bandwidth:
        above = options.apart * options.integrator * bandwidth
        least, lower = (
            np.linalg.svd(at(omega), compute_uv=False)[-1]
            for omega in (above, options.apart * above)
        )
        if least < np.sqrt(options.apart) * lower and len(controller.C) > 1 and not places:
            rest = compliance(0.0 if ports is not None else above, at(above))
            return Statics(float(least), rest, np.inf, low, omega_low / HZ)
        at_rest = 0.0 if ports is None else compliance(0.0, at(options.resting * omega_low))
        left = at_rest if at_rest > options.rounding * low else 0.0
        return Statics(np.inf, left, np.inf, low, omega_low / HZ)
    K0 = at(0.0)
    gains = np.linalg.svd(K0, compute_uv=False)
    share = gains[0] / max(float(np.linalg.norm(at(bandwidth), 2)), 1e-300)
    return Statics(float(gains[-1]), compliance(0.0, K0), float(share), low, omega_low / HZ)


def compliance_words(
    most: float, at_rest: float, low: float, low_hz: float, *, rounding: float = 1e-9
) -> str:
    """A sentence of what a force moves.

    Parameters
    ----------
    most, at_rest, low : float
        ‖GS‖∞, GS at rest (0: an integrator) and at the lowest frequency that counts, m/N.
    low_hz : float
        That one, Hz.
    rounding : float
        Share of the most up to which what is left at rest is rounding.

    Returns
    -------
    str
        In units that are easy to read.

    Examples
    --------
    >>> compliance_words(2e-6, 0.0, 5e-7, 1.0)
    '2 um/N at most, 0.5 um/N at 1 Hz, none at rest (an integrator)'
    >>> compliance_words(64e-3, 59e-3, 5.5e-3, 1.0)
    '64 mm/N at most, 5.5 mm/N at 1 Hz, 59 mm/N at rest'
    >>> compliance_words(2e-6, 1e-20, 5e-7, 1.0)
    '2 um/N at most, 0.5 um/N at 1 Hz, none at rest (an integrator)'
    """
    metres, factor = display_unit(spoken("m"), most)
    unit = f"{metres.replace('µ', 'u')}{spoken('/N')}"  # as the terminal prints it
    rest = "none at rest (an integrator)"
    if not at_rest <= rounding * most:
        rest = f"{factor * at_rest:.4g} {unit} at rest"
    at_low = f"{factor * low:.4g} {unit} at {low_hz:.3g} Hz"
    return f"{factor * most:.4g} {unit} at most, {at_low}, {rest}"


@dataclass(frozen=True)
class Compliance:
    """‖GS‖∞ in m/N, its frequency in rad/s (0: at rest), and the plant that has it."""

    gain: float
    omega: float
    plant: ScaledPlant


def compliance_of(
    plant: ScaledPlant, controller: StateSpace, *, within: float = 1e-3
) -> Compliance:
    """The largest compliance of a loop, ‖GS‖∞.

    Parameters
    ----------
    plant : ScaledPlant
        Itself, without its family.
    controller : StateSpace
        e in, u out, SI.
    within : float
        Relative: how far from the frequency of the norm its maximum is refined.

    Returns
    -------
    Compliance
        Infinite where the loop is not stable.
    """
    loop = closed_loop(plant.plant_si(), controller).GS
    gain, omega = hinf_norm(loop)
    if not np.isfinite(gain) or omega <= 0.0:
        return Compliance(gain, omega, plant)
    at, top = refine_peak(
        lambda w: float(gains(loop, np.array([w]))[0]),
        omega * np.exp(-within), omega * np.exp(within),
    )  # fmt: skip
    if top >= gain:
        gain, omega = top, at
    return Compliance(gain, omega, plant)


def compliance_over_family(plant: ScaledPlant, controller: StateSpace) -> Compliance:
    """The largest of the plant itself and, where it has a family, of every plant of that."""
    return max((compliance_of(each, controller) for each in plant.members), key=lambda c: c.gain)
