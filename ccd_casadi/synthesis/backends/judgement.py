"""Who is right where back ends differ: every claim held against the certificates.

A γ_opt below the bound γ_jω that no controller passes is wrong, a design that is not certified
does not count, and among those that are the lowest γ_opt is right.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ccd_casadi.synthesis.backends.mixed import RICCATI, BackendResult

AGREE = 1e-3  # relative: what an interior-point method is good for
BELOW = 1e-6  # relative: a claim this far below the bound is wrong


@dataclass(frozen=True)
class Verdict:
    """What the certificate says of one back end, and whether its claim and design hold."""

    result: BackendResult
    holds: bool | None  # None: it made no claim
    words: str


def verdicts(results: Sequence[BackendResult]) -> list[Verdict]:
    """Judge every claim by the certificates and by the bound γ_jω of the package's own design."""
    ours = next(item for item in results if item.backend == RICCATI)
    bound = ours.design.figures.gamma_lower_bound if ours.design is not None else math.nan
    proven = [item.gamma_opt for item in results if item.certified and item.gamma_opt > 0.0]
    lowest = min(
        (g for g in proven if not g < bound * (1.0 - BELOW)), default=math.nan
    )  # fmt: skip
    found = []
    for item in results:
        if item.design is None:
            found.append(Verdict(item, None, item.reason))
        elif item.gamma_opt < bound * (1.0 - BELOW):
            short = 100.0 * (1.0 - item.gamma_opt / bound)
            words = f"wrong: claims {short:.2g} % less than any controller reaches ({bound:.6g})"
            found.append(Verdict(item, False, words))
        elif not item.certified:
            found.append(Verdict(item, False, f"not certified: {item.reason}"))
        elif item.gamma_opt > lowest * (1.0 + AGREE):
            over = 100.0 * (item.gamma_opt / lowest - 1.0)
            found.append(Verdict(item, False, f"certified, but {over:.2g} % above the least"))
        else:
            found.append(Verdict(item, True, "certified"))
    return found
