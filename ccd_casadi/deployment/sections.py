"""A scalar controller as a motion engineer reads it: gain, and sections in Hz and damping ratios.

    K(s) = K₀ Π_i H_i(s),   H_i(0) = 1

Each H_i is a fraction of polynomials 1 + s/ω or 1 + 2ζ s/ω + s²/ω². A damping ratio below zero
marks roots in the right half plane, as a frequency below zero does for a single root; two real
poles that share a section with a pair of zeros show as one with ζ >= 1.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.units import HZ

NEAR = 1.5  # ratio of zero to pole frequency up to which a pair is a notch
FAR = 5.0  # ratio beyond which a complex pair of zeros and one of poles are not one section
RESONANT = 0.3  # damping ratio of a pole pair under which it is no roll-off
SLOW = 0.02  # share of ω_b under which a pole acts as an integrator


@dataclass(frozen=True)
class Root:
    """A real root (damping None) or a pair: 1 + s/ω, or 1 + 2ζ s/ω + s²/ω²; ω = 2π·hz."""

    hz: float
    damping: float | None = None

    def response(self, s: np.ndarray) -> np.ndarray:
        """The polynomial at s."""
        x = s / (HZ * self.hz)
        return 1.0 + x if self.damping is None else 1.0 + 2.0 * self.damping * x + x * x


@dataclass(frozen=True)
class Section:
    """One section: what it is, its zero, its pole (either may be missing), its depth.

    `depth_db` is the gain at the zero's frequency over that at s = 0, of notches only.
    """

    kind: str
    zero: Root | None
    pole: Root | None
    depth_db: float | None = None


@dataclass(frozen=True)
class Sections:
    """K₀ = K(0) in N/m, |K(jω_b)|, and the sections, slowest pole first."""

    gain: float
    gain_at_bandwidth: float
    sections: tuple[Section, ...]


def sections_of(K: StateSpace, bandwidth: float) -> Sections:
    """The sections of a scalar K(s) with K(0) finite and not zero; ω_b in rad/s tells slow poles.

    Complex zeros are paired with the complex poles nearest to them on a logarithmic scale, those
    left over with two real poles, real zeros with real poles; the rest stands alone, far zeros
    (which reduction puts above every frequency of use) among it.
    """
    poles, zeros = _roots(K.poles), _roots(K.zeros(float(np.abs(K.poles).max())))
    gain = float((K.D - K.C @ np.linalg.solve(K.A, K.B))[0, 0])
    pairs: list[tuple[Root | None, Root | None]] = [*_matched(zeros, poles, True, FAR)]
    for zero in [z for z in zeros if z.damping is not None]:
        partner = _two_real(poles)
        if partner is not None:
            zeros.remove(zero)
            pairs.append((zero, partner))
    pairs += _matched(zeros, poles, False)
    pairs += [*((zero, None) for zero in zeros), *((None, pole) for pole in poles)]
    found = [_section(zero, pole, bandwidth / HZ) for zero, pole in pairs]
    found.sort(key=lambda s: abs((s.pole or s.zero or Root(0.0)).hz))
    at = K.response(np.array([bandwidth]))[0]
    return Sections(gain, float(abs(at[0, 0])), tuple(found))


def _roots(values: np.ndarray) -> list[Root]:
    found = []
    for value in values:
        if abs(value.imag) <= 1e-9 * abs(value):
            found.append(Root(float(-value.real) / HZ))
        elif value.imag > 0.0:
            size = float(abs(value))
            found.append(Root(size / HZ, float(-value.real) / size))
    return found


def _matched(
    zeros: list[Root], poles: list[Root], paired: bool, most: float = np.inf
) -> list[tuple[Root, Root]]:
    """Pairs of a zero and a pole, both complex (`paired`) or both real, the nearest first and none
    further apart than the ratio `most`; taken out of both lists."""
    apart = sorted(
        (abs(np.log(abs(z.hz / p.hz))), i, j)
        for i, z in enumerate(zeros)
        for j, p in enumerate(poles)
        if (z.damping is not None) == (p.damping is not None) == paired
    )
    taken: dict[int, int] = {}
    for distance, i, j in apart:
        if distance <= np.log(most) and i not in taken and j not in taken.values():
            taken[i] = j
    found = [(zeros[i], poles[j]) for i, j in taken.items()]
    zeros[:] = [z for i, z in enumerate(zeros) if i not in taken]
    poles[:] = [p for j, p in enumerate(poles) if j not in taken.values()]
    return found


def _two_real(roots: list[Root]) -> Root | None:
    """The two fastest real roots of one sign as a pair, taken out of `roots`; None if none."""
    real = sorted((r for r in roots if r.damping is None), key=lambda r: -abs(r.hz))
    for i, first in enumerate(real):
        for second in real[i + 1 :]:
            if first.hz * second.hz > 0.0:
                roots.remove(first)
                roots.remove(second)
                hz = float(np.sqrt(first.hz * second.hz))
                return Root(hz, float(0.5 * (first.hz + second.hz) / hz))
    return None


def _section(zero: Root | None, pole: Root | None, bandwidth_hz: float) -> Section:
    if zero is None or pole is None:
        root = zero or pole
        assert root is not None
        order = "first-order" if root.damping is None else "second-order"
        if pole is None:
            return Section(f"{order} zero", zero, None)
        if root.damping is not None and abs(root.damping) < RESONANT:
            return Section("resonance", None, pole)
        slow = root.damping is None and abs(root.hz) < SLOW * bandwidth_hz
        return Section("integrator" if slow else f"{order} roll-off", None, pole)
    if zero.damping is None or pole.damping is None:
        if abs(pole.hz) < SLOW * bandwidth_hz:
            return Section("integrator with zero", zero, pole)
        return Section("lead" if abs(zero.hz) < abs(pole.hz) else "lag", zero, pole)
    at_zero = 1j * HZ * np.array([zero.hz])
    depth = abs(zero.response(at_zero) / pole.response(at_zero))[0]
    if 1.0 / NEAR < zero.hz / pole.hz < NEAR:
        kind = "notch" if abs(zero.damping) < abs(pole.damping) else "inverse notch"
        return Section(kind, zero, pole, float(20.0 * np.log10(max(depth, 1e-300))))
    return Section("complex lead" if zero.hz < pole.hz else "complex lag", zero, pole)
