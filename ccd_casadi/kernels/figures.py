"""The figures of a design are one row of numbers, in scaled units; `Column` names the columns."""

from enum import IntEnum


class Code(IntEnum):
    """How a design ended; 0 is the only one that may be used."""

    CERTIFIED = 0
    GAMMA_NOT_CONVERGED = 1
    RICCATI_FAILED = 2
    NOT_FINITE = 3
    UNSTABLE_LOOP = 4
    NORM_EXCEEDED = 5
    LEVEL_TEST_FAILED = 6
    NO_BANDWIDTH = 7
    EIGENVALUES_FAILED = 8
    PEAK_NOT_CONFIRMED = 9
    FILTER_FAILED = 10


class Column(IntEnum):
    """Columns of a row of figures; frequencies over ω₀, poles over ω₀."""

    CODE = 0
    GAMMA_OPT = 1
    GAMMA_LOWER_BOUND = 2
    GAMMA = 3
    LIMITED_BY_BOUND = 4
    SCHUR_FORMS = 5
    BANDWIDTH = 6
    PEAK = 7
    PEAK_FREQUENCY = 8
    LOW = 9
    MAX_REAL_POLE = 10
    NORM = 11
    NORM_FREQUENCY = 12
    BALANCED = 13  # 1 where the synthesis needed balanced coordinates
    GAMMA_ERROR = 14  # relative, what rounding and search may leave in γ_opt; infinite: unknown
    COUNT = 15
