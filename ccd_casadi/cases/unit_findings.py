"""Numbers that look like those of another unit: M_K, stiffness, S_max, told by name.

What is compared are frequencies that a consistent case has close together: where the plant falls
through 1/M_K, its first resonance, and where [inner] looks.
"""

import numpy as np

from ccd_casadi.cases.findings import Finding, Severity, Topic
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.plants.facts import PlantFacts
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.units import HZ

FAR = 3.0  # how far outside the frequencies that [inner] searches effort may end
DECIBEL = 3.0  # from here on a peak of S is more likely one in dB
# in SI, by how a person writes them
MASS = {"t": 1e3, "kg": 1.0, "g": 1e-3, "mg": 1e-6}
STIFFNESS = {"MN/m": 1e6, "kN/mm": 1e6, "N/um": 1e6, "N/µm": 1e6, "kN/m": 1e3, "N/mm": 1e3,
             "N/m": 1.0}  # fmt: skip
SI = "all values are taken in SI (kg, N/m, m; 1 N/um is 1e6 N/m, 1 N/mm is 1e3 N/m)"


def unit_findings(problem: CoDesignProblem, facts: PlantFacts, plant: ScaledPlant) -> list[Finding]:
    """Warnings about M_K, the resonances and S_max, from the plant at the start."""
    words = [
        *_effort(problem, facts, plant),
        *_resonances(problem, facts),
        *peak_words(problem.inner.S_max),
    ]
    return [Finding(Severity.WARNING, Topic.UNITS, item, 0) for item in words]


def entry_findings(problem: CoDesignProblem, system: Mechanics) -> list[Finding]:
    """Warnings of a θ in a unit of mass or stiffness that stands in the matrix in that unit.

    The entries' slopes tell: of a mass in g that is told in kg they are 0.001.
    """
    found = []
    for key, units, slopes in (
        ("mass", MASS, system.derivatives[0]),
        ("stiffness", STIFFNESS, system.derivatives[2]),
    ):
        for name, unit, slope in zip(problem.names, problem.units, slopes, strict=True):
            entries = np.abs(slope[np.abs(slope) > 1e-6 * np.abs(slope).max(initial=0.0)])
            if unit not in units or not entries.size:
                continue
            powers = np.log10(entries / units[unit]) / 3.0
            times = round(float(powers[0]))
            if times == 0 or not np.allclose(powers, times, atol=1e-4):
                continue
            words = (
                f"theta.{name} is in {unit}, and {key} grows by {entries[0]:.4g} with each, where "
                f"{units[unit]:g} is meant: is the matrix in another unit? {SI}"
            )
            found.append(Finding(Severity.WARNING, Topic.UNITS, words, 0))
    return found


def _searched(problem: CoDesignProblem) -> tuple[float, float]:
    """From where to where, in Hz, a bandwidth can be meant."""
    inner = problem.inner
    low = max(inner.omega_low, min(inner.omega_S[0], inner.omega_T[0]) / 4.0)
    return low / HZ, max(inner.omega_S[1], inner.omega_T[1]) / HZ


def _effort(problem: CoDesignProblem, facts: PlantFacts, plant: ScaledPlant) -> list[str]:
    low, high = _searched(problem)
    M_K, effort = problem.weights.M_K, facts.effort_hz
    if np.isfinite(effort) and low / FAR <= effort <= FAR * high:
        return []
    first = [mode.frequency_hz for mode in facts.modes if not mode.rigid]
    aim = float(np.clip(first[0] / 3.0 if first else np.sqrt(low * high), low, high))
    gain = float(np.exp(np.interp(
        np.log(aim * HZ / plant.omega_0), np.log(plant.grid), np.log(np.maximum(plant.gain, 1e-300))
    )))  # fmt: skip
    where = (
        f"the plant's gain falls through 1/M_K at {effort:.3g} Hz"
        if np.isfinite(effort)
        else "the plant's gain falls through 1/M_K nowhere"
    )
    side = "small" if gain < 1.0 else "large"
    return [
        f"weights.M_K = {M_K:.3g} looks {max(gain, 1.0 / gain):.1g} times too {side}: {where}, "
        f"and [inner] searches {low:.3g} to {high:.3g} Hz; {M_K / gain:.2g} would suit a bandwidth "
        f"of {aim:.3g} Hz. Check the units of M_K (force over displacement) and of mass and "
        f"stiffness: {SI}"
    ]


def _resonances(problem: CoDesignProblem, facts: PlantFacts) -> list[str]:
    low, high = _searched(problem)
    flexible = [mode.frequency_hz for mode in facts.modes if not mode.rigid]
    if not flexible or not any(mode.rigid for mode in facts.modes):
        return []
    if flexible[-1] < low:
        side = f"all resonances lie below {flexible[-1]:.3g} Hz"
    elif flexible[0] > 100.0 * high:
        side = f"the first resonance is at {flexible[0]:.3g} Hz"
    else:
        return []
    return [
        f"{side}, and [inner] searches {low:.3g} to {high:.3g} Hz: is the stiffness in another "
        f"unit? {SI}"
    ]


def peak_words(S_max: float) -> list[str]:
    """Whether S_max looks like one in dB."""
    if S_max <= DECIBEL:
        return []
    factor = 10.0 ** (S_max / 20.0)
    return [
        f"inner.S_max = {S_max:g} is a factor: was {S_max:g} dB meant? Then write {factor:.4g}; "
        "loops on hardware have 1.4 to 2"
    ]
