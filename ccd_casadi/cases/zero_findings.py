"""What a plant's transmission zeros say about the bandwidth, as findings."""

from collections.abc import Sequence

from ccd_casadi.cases.findings import Finding, Severity, Topic
from ccd_casadi.plants.facts import PlantFacts, Zero
from ccd_casadi.plants.rhp_zeros import bandwidth_limit_hz

LIGHT = 0.3  # damping ratio below which a zero is a dip in the frequency response
LIMIT = "no bandwidth above "


def zero_findings(facts: PlantFacts, S_max: float, index: int, place: str) -> list[Finding]:
    """The right half-plane zero that limits most, and the dips; `place` names the θ."""
    found = []
    right = [zero for zero in facts.zeros if zero.damping_ratio < -1e-9]
    true = [zero for zero in right if not zero.artefact]
    if true:
        found.append(_right(min(true, key=lambda z: z.frequency_hz), facts, S_max, index, place))
    elif right:
        z = right[0].frequency_hz
        words = (
            f"a transmission zero in the right half-plane at {z:.4g} Hz {place} is the "
            "suspension's: without it the plant has none there; a softer suspension "
            "(suspension.frequency_hz) moves it away"
        )
        found.append(Finding(Severity.NOTE, Topic.ZERO, words, index))
    for zero in facts.zeros:
        if -1e-9 <= zero.damping_ratio < LIGHT:
            found.append(_dip(zero, index))
    return found


def _right(zero: Zero, facts: PlantFacts, S_max: float, index: int, place: str) -> Finding:
    z, limit = zero.frequency_hz, bandwidth_limit_hz(zero, S_max)
    words = (
        f"a transmission zero in the right half-plane at {z:.4g} Hz {place}: with a peak of S of "
        f"{S_max:g} {LIMIT}{limit:.3g} Hz is possible there (Poisson integral), and well before "
        f"it, from about {0.5 * z:.3g} Hz on, robustness is lost; move sensor and actuator closer "
        "together"
    )
    severe = z < 2.0 * facts.effort_hz
    return Finding(Severity.WARNING if severe else Severity.NOTE, Topic.ZERO, words, index)


def _dip(zero: Zero, index: int) -> Finding:
    z = zero.frequency_hz
    words = (
        f"a transmission zero at {z:.4g} Hz, damping {100 * zero.damping_ratio:.2g} %: the "
        f"plant's gain falls to {100 * zero.dip:.2g} % of its surroundings, and so much "
        f"more force is needed there; |S| returns to about 1, so ω_b stays below {z:.4g} "
        "Hz unless M_K pays for it"
    )
    return Finding(Severity.NOTE, Topic.ZERO, words, index)


def most_limiting(findings: Sequence[Finding]) -> list[Finding]:
    """All findings, of the right half-plane warnings only that with the lowest limit."""
    severe = [f for f in findings if f.severity is Severity.WARNING and LIMIT in f.words]
    if not severe:
        return list(findings)
    worst = min(severe, key=lambda f: float(f.words.split(LIMIT)[1].split()[0]))
    return [f for f in findings if f is worst or f not in severe]
