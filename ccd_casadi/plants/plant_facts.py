"""What limits a loop, read off the plant alone: modes, transmission zeros, where effort ends.

A zero z = x + iy with x > 0 holds every stable S to an integral over the axis (Freudenberg and
Looze 1985; with several outputs |S| is σ_max(S), as uᴴ S(z) = uᴴ in the zero's direction):

    ∫ ln|S(jω)| (x/(x² + (ω - y)²) + x/(x² + (ω + y)²)) dω >= 0,   ω from 0 to ∞.

With |S| <= 1/√2 up to ω_b and <= M beyond, the share θ(ω_b) of the weight that lies below ω_b obeys

    θ(ω_b) = (atan((ω_b - y)/x) + atan((ω_b + y)/x))/π <= ln M/(ln M + ln √2).
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.kernels.frequency import prepare, responses
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class PlantMode:
    """One mode of the undamped plant; driven and measured: its gains over the largest.

    Where the stiffness drives it away it has no resonance and grows as exp(2π `growth_hz` t). It
    is `real` where it is one real pole of a plant of first order, as of a coil.
    """

    frequency_hz: float
    damping_ratio: float
    rigid: bool
    driven: float
    measured: float
    growth_hz: float = 0.0
    real: bool = False

    @property
    def resonant(self) -> bool:
        """Whether it swings, or would if it were damped less: K resists it."""
        return not (self.rigid or self.growth_hz or self.real)


@dataclass(frozen=True)
class Zero:
    """A transmission zero of a plant.

    Attributes
    ----------
    frequency_hz : float
        |z| in Hz.
    damping_ratio : float
        Negative in the right half-plane.
    dip : float
        The plant's least gain at |z| over its geometric mean at 0.7 and 1.4 times |z|.
    """

    frequency_hz: float
    damping_ratio: float
    dip: float


@dataclass(frozen=True)
class PlantFacts:
    """The facts that limit a loop on a plant at one θ.

    σ_r is the r-th singular value, r the number of rigid-body modes where there are fewer of them
    than inputs and outputs: a motion on a spring needs no force at low frequency.

    Attributes
    ----------
    theta : tuple of float (n,)
        With what varies, SI.
    modes : tuple of PlantMode
    zeros : tuple of Zero
    effort_hz : float
        Where M_K σ_r(G) first falls below 1, Hz; nan if nowhere.
    inertia : float
        The least that an actuator moves where the plant is rigid (kg, of a torque kg m²);
        infinite where it moves nothing freely.
    """

    theta: tuple[float, ...]
    modes: tuple[PlantMode, ...]
    zeros: tuple[Zero, ...]
    effort_hz: float
    inertia: float = float("inf")


def facts_of(theta: tuple[float, ...], modal: ModalPlant, scaled: ScaledPlant) -> PlantFacts:
    """Collect the facts of a plant at one θ.

    Parameters
    ----------
    theta : tuple of float (n,)
    modal : ModalPlant
    scaled : ScaledPlant
        The same plant.

    Returns
    -------
    PlantFacts
    """
    effort = _effort_hz(modal, scaled)
    driven = float((modal.B[modal.rigid] ** 2).sum(axis=0).max(initial=0.0))
    inertia = 1.0 / driven if driven > 0.0 else float("inf")
    return PlantFacts(theta, modes_of(modal), _zeros(scaled, effort), effort, inertia)


def modes_of(modal: ModalPlant) -> tuple[PlantMode, ...]:
    """List every mode in the order of the plant.

    Parameters
    ----------
    modal : ModalPlant

    Returns
    -------
    tuple of PlantMode
    """
    b = np.linalg.norm(modal.B, axis=1)
    c = np.linalg.norm(modal.C, axis=0)
    k, d = np.diag(modal.K), np.diag(modal.D)
    resonant = ~modal.rigid & (k > 0.0)
    zeta = np.where(resonant, d / (2.0 * np.sqrt(np.where(resonant, k, 1.0))), 0.0)
    away = np.minimum(k, 0.0)  # s² + d s + k = 0
    growth = np.where(away < 0.0, np.sqrt(0.25 * d**2 - away) - 0.5 * d, 0.0) / HZ
    swings = len(k) if modal.states is None else modal.states.bodies + len(modal.states.pairs)
    real = (np.arange(len(k)) >= swings) & (k > 0.0)
    columns = (modal.natural / HZ, zeta, modal.rigid, b / b.max(), c / c.max(), growth, real)
    return tuple(map(PlantMode, *(column.tolist() for column in columns)))


def _effort_hz(modal: ModalPlant, plant: ScaledPlant) -> float:
    """The first frequency at which M_K σ_r(G) falls through 1."""
    order = min(plant.B.shape[1], plant.C.shape[0])
    order = min(order, int(modal.rigid.sum()) or order)
    grid = plant.grid[plant.grid > 1e-4]
    G = responses(prepare(plant.A, plant.B, plant.C), grid)
    gain = np.linalg.svd(G, compute_uv=False)[:, order - 1].clip(1e-300)
    below = np.flatnonzero((gain[1:] < 1.0) & (gain[:-1] >= 1.0))
    if not below.size:
        return float("nan")
    i = int(below[0])
    x, y = np.log(grid[i : i + 2]), np.log(gain[i : i + 2])
    return float(np.exp(x[0] - y[0] * (x[1] - x[0]) / (y[1] - y[0])) * plant.omega_0 / HZ)


def _zeros(plant: ScaledPlant, effort_hz: float, *, rounding: float = 1e-9) -> tuple[Zero, ...]:
    """Zeros up to three times the frequency at which effort ends, one of each conjugate pair."""
    limit = 3.0 * effort_hz * HZ / plant.omega_0
    x, y = np.log(plant.grid), np.log(np.maximum(plant.gain, 1e-300))
    found = []
    for zero in plant.system.zeros():
        size = abs(zero)
        if zero.imag < 0.0 or not 1e-3 * limit < size < limit:
            continue
        gain = np.exp(np.interp(np.log(size * np.array([0.7, 1.0, 1.4])), x, y))
        dip = gain[1] / np.sqrt(gain[0] * gain[2])
        damping = -zero.real / size if abs(zero.real) > rounding * size else 0.0
        hz = float(size * plant.omega_0 / HZ)
        found.append(Zero(hz, float(damping), float(dip)))
    return tuple(sorted(found, key=lambda zero: zero.frequency_hz))


def bandwidth_limit_hz(zero: Zero, S_max: float) -> float:
    """Bound the bandwidth of every stable loop with ‖S‖∞ <= S_max by a right half-plane zero.

    Parameters
    ----------
    zero : Zero
    S_max : float
        Largest peak of S, above 1.

    Returns
    -------
    float
        ω_b in Hz that no such loop exceeds; see the head of the module.

    Examples
    --------
    >>> round(bandwidth_limit_hz(Zero(10.0, -1.0, 1.0), 2.0), 2)  # z tan(60°), real zero
    17.32
    """
    x, size = -zero.damping_ratio * zero.frequency_hz, zero.frequency_hz
    angle = np.pi * np.log(S_max) / (np.log(S_max) + 0.5 * np.log(2.0))
    # tan of both sides of θ(ω_b) = angle/π: 2 x ω_b = (|z|² - ω_b²) tan(angle)
    across, along = x * np.cos(angle), size * np.sin(angle)
    return float(size * along / (np.hypot(across, along) + across))
