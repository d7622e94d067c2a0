"""What a co-design ends with: the JSON result, and the objects behind it."""

from dataclasses import dataclass
from typing import Any

from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.verified import Verified
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.support.notebook import Shown
from surrogates import Quality


@dataclass(frozen=True)
class Solution(Shown):
    """Everything a run found: the JSON result, and the objects behind it (None: infeasible).

    `problem` is the one solved: of a robust case that leaves its design plant open, the best one's.
    """

    result: dict[str, Any]
    outcome: FormulationResult
    verified: Verified | None
    quality: tuple[Quality, ...] = ()
    problem: CoDesignProblem | None = None
