"""What is told of a plant before anything is designed for it: severity, topic, one sentence."""

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How much a finding matters."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class Topic(StrEnum):
    """What a finding is about."""

    MATRICES = "matrices"
    RIGID_MODES = "rigid modes"
    HIDDEN_MODE = "hidden mode"
    ZERO = "transmission zero"
    DOMAIN = "domain"
    UNITS = "units"
    DERIVATIVES = "derivatives"


@dataclass(frozen=True)
class Finding:
    """One sentence about the plant; `index` of the θ where it was seen, among those looked at."""

    severity: Severity
    topic: Topic
    words: str
    index: int
