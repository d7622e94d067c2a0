"""The loop of one controller with every plant of a set, continuous or sampled, in one variable.

Sampled at a rate 1/T, with a zero-order hold and a delay τ, the plant is z⁻ᵈ C f(A) B at the
instants, exactly. It is written in w = (2/T)(z - 1)/(z + 1): the inside of the unit circle becomes
the left half plane, z = e^{jωT} becomes w = jv with v = (2/T) tan(ωT/2), and K(w) is K(z) by
Tustin's rule, without prewarping and without lead, as `deploy` discretises it. So both kinds of
loop are one: poles in the left half plane, responses on jv. Without sampling v = ω. A delay comes
with sampling only: then the loop has finitely many poles, and its stability is decided by them.

Time is counted in 1/ω₀ of the first plant, force in its unit (`scaling`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ccd_casadi.fixed_structure.loop_plant import (
    LoopPlant,
    finite_zeros,
    loop_plants,
    padded_modes,
    padded_states,
)
from ccd_casadi.fixed_structure.structure import Structure, state_spaces
from ccd_casadi.lti.hold import Sampling, moments, transfer
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

CLOSE = 1e-6  # relative gap of two poles below which their divided difference is a derivative
CANCELLING = 1e-4  # |z - e^{pT}| below which the difference loses digits, and expm1 does not


@dataclass(frozen=True)
class PlantSet:
    """All plants in the units of the first: ω₀ in rad/s, force in N/m; T and τ in 1/ω₀.

    `poles` and `residues` (P, n) are those of the continuous plants, the shorter ones with zeros.
    """

    plants: tuple[LoopPlant, ...]
    omega_0: float
    force: float
    period: float | None
    delay: float
    poles: np.ndarray
    residues: np.ndarray
    zeros: tuple[np.ndarray, ...]
    A: Array
    B: Array
    C: Array
    D: Array

    @cached_property
    def held(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of hold and delay: d (P,), and a mode's two moments and e^{pT}, (P, n)."""
        assert self.period is not None
        d, late, early = moments(self.poles, self.period, self.delay)
        return np.full(len(self.poles), d), late, early, np.exp(self.poles * self.period)

    def frequency(self, v: Array) -> Array:
        """ω of v, both over ω₀."""
        if self.period is None:
            return v
        return np.asarray(2.0 / self.period * np.arctan(0.5 * self.period * v))

    def variable(self, omega: Array) -> Array:
        """v of ω, both over ω₀; infinite from half the sampling rate on."""
        if self.period is None:
            return omega
        half = np.minimum(0.5 * self.period * omega, 0.5 * np.pi)
        return np.asarray(2.0 / self.period * np.tan(half))

    def responses(self, which: np.ndarray, v: Array) -> tuple[np.ndarray, np.ndarray]:
        """G of the plants `which` at jv and ∂G/∂ln v; both indices of one shape."""
        value, slope = self.modal_terms(which, v)
        r = self.residues[which]
        return (r * value).sum(-1), (r * slope).sum(-1)

    def values(self, which: np.ndarray, v: Array, *, free: bool = False) -> np.ndarray:
        """G of the plants `which` at jv alone; `free` of hold and delay."""
        value = self.modal_values(which, v, free=free)
        return np.asarray((self.residues[rows_alike(which)] * value).sum(-1))

    def modal_values(self, which: np.ndarray, v: Array, *, free: bool = False) -> np.ndarray:
        """f(p; jv) (..., n), with which modes of unit residue answer; `free` of hold and delay."""
        s, which = 1j * self.frequency(v)[..., None], rows_alike(which)
        if self.period is None or free:
            return np.asarray(1.0 / (s - self.poles[which]))
        d, late, early, _ = (part[which] for part in self.held)
        z, gap = self._gaps(which, s)
        return np.asarray((late + early / z) / gap * np.exp(-s * self.period * d[..., None]))

    def _gaps(self, which: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z = e^{sT} and z - e^{pT}, without loss of digits where they are close."""
        assert self.period is not None
        p, grown = self.poles[which], self.held[3][which]
        z = np.exp(s * self.period)
        gap = z - grown
        near = np.abs(gap) < CANCELLING
        at_s, at_p, own = (np.broadcast_to(part, gap.shape)[near] for part in (s, p, grown))
        gap[near] = own * np.expm1((at_s - at_p) * self.period)
        return z, gap

    def modal_terms(
        self, which: np.ndarray, v: Array, *, free: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same with ∂f/∂ln v."""
        s = 1j * self.frequency(v)[..., None]
        T = self.period
        if T is None or free:
            warp = v if T is None else v / (1.0 + (0.5 * T * v) ** 2)
            f = 1.0 / (s - self.poles[which])
            return f, -f * f * (1j * warp)[..., None]
        d, late, early, _ = (part[which] for part in self.held)
        d = d[..., None]
        z, gap = self._gaps(which, s)
        value = (late + early / z) / gap
        slope = early / (z * gap) + value * z / gap + d * value
        shift = np.exp(-s * T * d)
        chain = -1j * T * v / (1.0 + (0.5 * T * v) ** 2)
        return value * shift, slope * shift * chain[..., None]

    def free_responses(self, which: np.ndarray, v: Array) -> tuple[np.ndarray, np.ndarray]:
        """G(jω) of the continuous plant without hold and delay, and ∂G/∂ln v.

        A disturbing force d e^{jωt} shows in the samples as G(jω) d, whatever the sampling.
        """
        value, slope = self.modal_terms(which, v, free=True)
        r = self.residues[which]
        return (r * value).sum(-1), (r * slope).sum(-1)

    def to_theta(self, which: int, v: Array, *, free: bool = False) -> np.ndarray:
        """∂G/∂θ (len(v), n_θ) of one plant at jv; `free` of hold and delay."""
        one = np.ones((len(v), 1))
        return self.form_to_theta(which, v, one, one, free=free)

    def form_to_theta(
        self, which: int, v: Array, left: np.ndarray, right: np.ndarray, *, free: bool = False
    ) -> np.ndarray:
        """∂(x G y)/∂θ (k, n_θ) of one plant at jv with rows x (k, p) and columns y (k, m).

        x (dC f(A) B + C f(A) dB + C V (f[p_i, p_j] ∘ V⁻¹dA V) V⁻¹B) y   (Daleckii and Krein)
        """
        plant = self.plants[which]
        p = plant.poles
        omega = self.frequency(np.asarray(v, float))
        period = None if free else self.period
        f, slope = transfer(p, omega, period, self.delay)
        gap = p[:, None] - p[None, :]
        near = np.abs(gap) <= CLOSE * np.maximum(np.abs(p)[:, None], np.abs(p)[None, :])
        middle = 0.5 * (p[:, None] + p[None, :])
        between = np.where(
            near,
            transfer(middle.ravel(), omega, period, self.delay)[1].reshape(-1, *gap.shape)
            if (near.sum() > len(p))
            else slope[:, :, None] * np.ones(len(p)),
            (f[:, :, None] - f[:, None, :]) / np.where(near, 1.0, gap),
        )
        c, b = left @ plant.reading, right @ plant.drive.T
        out = np.einsum("ki,kij,kj,tij->kt", c, between, b, plant.dA, optimize=True)
        out += np.einsum("kp,tpi,ki,ki->kt", left, plant.dC, f, b, optimize=True)
        out += np.einsum("ki,ki,tim,km->kt", c, f, plant.dB, right, optimize=True)
        return np.asarray(out)


def rows_alike(which: np.ndarray) -> np.ndarray:
    """Numbers of plants (P, k) as (P, 1) where every row is one plant: nothing is copied k times.

    That is how they come for a grid: broadcast, with a stride of 0.
    """
    return which[..., :1] if which.ndim > 1 and which.strides[-1] == 0 else which


def plant_set(plants: Sequence[ScaledPlant], sampling: Sampling | None = None) -> PlantSet:
    """The plants in common units, with hold and delay where the loop is sampled.

    Raises PlantError for a plant that is not SISO, not stable, or not diagonalisable.
    """
    for number, plant in enumerate(plants, 1):
        if plant.B.shape[1] != 1 or plant.C.shape[0] != 1:
            raise PlantError(f"plant {number} is not SISO; give one of its channels")
    found, units = loop_plants(plants, sampling)
    poles, residues = padded_modes(found)
    zeros = tuple(finite_zeros(loop) for loop in found)
    return PlantSet(tuple(found), *units, poles, residues[:, :, 0, 0], zeros,
                    *padded_states(found))  # fmt: skip


def closed_loops(plants: PlantSet, structure: Structure, kappa: Array) -> np.ndarray:
    """Poles (N, P, n) in w of every plant's loop with N controllers κ (N, n_κ); NaN if ill-posed.

    An algebraic loop with 1 + D_G D_K = 0 has a pole at z = -1: it counts as not stable.
    """
    a, b, c, d = state_spaces(structure, np.atleast_2d(kappa))
    N, P, n, k = len(a), len(plants.A), plants.A.shape[1], a.shape[1]
    Dg, Dk = plants.D[None, :, 0, 0], d[:, None, 0, 0]
    well = 1.0 + Dg * Dk
    m = (1.0 / np.where(well == 0.0, 1.0, well))[..., None, None]
    A, B, C = plants.A[None], plants.B[None], plants.C[None]
    a, b, c = a[:, None], b[:, None], c[:, None]
    Dg, Dk = Dg[..., None, None], Dk[..., None, None]
    joint = np.empty((N, P, n + k, n + k))
    joint[:, :, :n, :n] = A - m * Dk * (B @ C)
    joint[:, :, :n, n:] = m * (B @ c)
    joint[:, :, n:, :n] = -m * (b @ C)
    joint[:, :, n:, n:] = a - m * Dg * (b @ c)
    values = np.linalg.eigvals(joint)
    return np.where((well != 0.0)[..., None], values, np.nan)


def stable(poles: np.ndarray) -> np.ndarray:
    """Whether all poles (..., n) lie in the open left half plane."""
    with np.errstate(invalid="ignore"):
        return np.asarray((poles.real < 0.0).all(-1))
