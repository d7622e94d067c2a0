"""SLICOT's SB10AD: two Riccati equations (Glover & Doyle 1988), any standard plant.

SB10AD accepts a γ when its Riccati solver reports no error and the loop is stable; it tests
neither X >= 0 nor the norm. Its γ is therefore only a search variable: a design counts when the
certificate passes, and not otherwise. Left to itself it starts at 1e100 and goes on in steps of
0.1, which does not end; here the search starts at a finite γ and bisects. It is still Fortran
that nothing can interrupt: call it through `worker_process.Runner` where the plant is not known.
"""

import warnings

import numpy as np

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.errors import require
from ccd_casadi.synthesis.backends.standard_plant import Attempt, StandardPlant, balance

STARTS = (1e3, 1e6)  # finite γ to bisect from; the second where the first is too low
BISECT, SUBOPTIMAL = 1, 4  # SB10AD's jobs


def solve(plant: StandardPlant, *, gamma_backoff: float = 1.02, tolerance: float = 0.0) -> Attempt:
    """Bisection for γ_opt (job 1), then a controller at gamma_backoff·γ_opt (job 4).

    `tolerance` is absolute in γ (0: SLICOT's own, 1.5e-8). Raises MissingPackage without slycot.
    """
    slycot = require("slycot", "slicot")
    whole = balance(plant).whole()
    p, m = plant.C2.shape[0], plant.B2.shape[1]
    size = (len(whole.A), whole.B.shape[1], whole.C.shape[0], m, p)
    parts = (whole.A, whole.B, whole.C, whole.D)
    reason = ""
    for start in STARTS:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # ill-conditioning is for the certificate to judge
                found = slycot.sb10ad(*size, start, *parts, job=BISECT, gtol=tolerance)
                gamma = gamma_backoff * float(found[0])
                made = slycot.sb10ad(*size, gamma, *parts, job=SUBOPTIMAL, gtol=tolerance)
        except (slycot.exceptions.SlycotError, ValueError) as error:
            reason = " ".join(str(error).split()).rstrip(".")
            continue
        K = StateSpace(*(np.array(part) for part in made[1:5]))
        return Attempt(float(found[0]), gamma, K)
    return Attempt(np.nan, np.nan, None, reason[:1].lower() + reason[1:])
