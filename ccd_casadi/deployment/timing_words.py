"""Rate and delay of a deployment in words: what the loop needs, and what to change where it fails.

A loop that was designed as it runs is compared with its design first: a rate that it already has is
not a remedy for a delay that it was not designed for.
"""

from dataclasses import dataclass

from ccd_casadi.deployment.outcome import Deployment
from ccd_casadi.lti.loop import Sampling


@dataclass(frozen=True)
class TimingWordsOptions:
    """Numbers of the comparison with the design.

    Attributes
    ----------
    same : float
        Relative difference of two rates or delays up to which they are the same.
    """

    same: float = 1e-9


def needed_words(found: Deployment) -> str:
    """What the loop was designed for, or the least rate that it needs.

    Parameters
    ----------
    found : Deployment

    Returns
    -------
    str
        A few words, after the rate and the delay.
    """
    if found.designed is not None:
        return f"designed for {_own(found.designed)}"
    if found.needed_hz is None:
        return "no rate will do"
    return f"needed {found.needed_hz:.5g} Hz"


def shortfall_words(found: Deployment) -> str:
    """What is not kept, why, and what to change.

    Parameters
    ----------
    found : Deployment
        Not passed.

    Returns
    -------
    str
        One line.
    """
    if not found.shortfalls:
        return f"the run itself is not: {found.unverified}"
    missed, needed = found.shortfalls[0], found.needed_hz
    if found.designed is not None:
        at = f"at {found.rate_hz:.6g} Hz with a delay of {1e6 * found.delay:.4g} us"
        return f"{at}: {missed}; {_of_design(found, found.designed)}"
    rate = f"{found.rate_hz:.6g} Hz with {found.conversion.value}"
    if needed is None:
        return f"{rate} is not enough: {missed}; with this delay no rate is; shorten the delay"
    if found.rate_hz < needed:
        return f"{rate} is not enough: {missed}; {needed:.6g} Hz is needed"
    # the plants of the case's set allow this rate; one between them, or the judge, does not
    return f"{rate}: {missed}; leave out --rate-hz, or give one above {found.rate_hz:.6g} Hz"


def _own(designed: Sampling) -> str:
    return f"{designed.rate_hz:.6g} Hz and {designed.delay_us:.4g} us"


def _of_design(
    found: Deployment, designed: Sampling, options: TimingWordsOptions = TimingWordsOptions()
) -> str:
    """How the loop runs otherwise than it was designed to, and the remedy of that."""
    more, causes, keys = 1.0 + options.same, [], []
    if found.rate_hz * more < designed.rate_hz:
        causes.append(f"the rate is below the {designed.rate_hz:.6g} Hz")
        keys.append(f"loop.rate_hz = {found.rate_hz:.6g}")
    if found.delay > more * designed.delay:
        causes.append(f"the delay exceeds the {designed.delay_us:.4g} us")
        keys.append(f"loop.delay_us = {1e6 * found.delay:.4g}")
    if causes:
        why, write = " and ".join(causes), " and ".join(keys)
        return f"{why} of the design: keep to the design, or write {write} in the case and solve it"
    same = found.rate_hz <= more * designed.rate_hz and more * found.delay >= designed.delay
    if same:
        return "the loop runs as it was designed: solve the case again"
    return f"it was designed for {_own(designed)}: keep to these"
