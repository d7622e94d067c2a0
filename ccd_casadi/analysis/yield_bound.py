"""What random plants that no search has seen prove of all of them."""

from dataclasses import dataclass

import scipy


@dataclass(frozen=True)
class YieldOptions:
    """Numbers of a yield estimated by random plants."""

    confidence: float = 1.0 - 1e-6


def yield_bound(survived: int, draws: int, confidence: float = YieldOptions().confidence) -> float:
    """Bound from below the share of all plants that survive, by independent draws.

    It is exact for the binomial: the q with P(at least `survived` of `draws` | q) = 1 - confidence
    (Clopper and Pearson 1934):

        I_q(survived, draws - survived + 1) = 1 - confidence

    Of none that fails it is (1 - confidence)^(1/draws). The draws must not have been chosen, and
    the design must not have been changed by them.

    Parameters
    ----------
    survived, draws : int
        Of independent draws.
    confidence : float
        Between 0 and 1.

    Returns
    -------
    float
        q from 0 to 1.

    Raises
    ------
    ValueError
        A count or the confidence is out of range.

    >>> round(yield_bound(13_809, 13_809), 5), round(yield_bound(199, 200, 0.95), 4)
    (0.999, 0.9765)
    """
    if not 0 <= survived <= draws:
        raise ValueError(f"{survived} of {draws} draws survived; give 0 up to all of them")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence is {confidence}; give more than 0 and less than 1")
    if survived == 0:
        return 0.0
    return float(scipy.special.betaincinv(survived, draws - survived + 1, 1.0 - confidence))


@dataclass(frozen=True)
class Yield:
    """The share of fresh random plants that survived.

    Attributes
    ----------
    survived, draws : int
        Of these draws.
    turns : int
        Sets of draws in all, these the last: those before changed the design, and each set may be
        wrong.
    """

    survived: int
    draws: int
    turns: int = 1

    @property
    def least(self) -> float:
        """The share of all that survives, at least, as one set of draws shows it."""
        return yield_bound(self.survived, self.draws)

    @property
    def _risk(self) -> float:
        """The probability that one set of draws is wrong."""
        return 1.0 - YieldOptions().confidence

    @property
    def words(self) -> str:
        """The yield in words, its share rounded down."""
        percent = int(1e4 * self.least) / 100.0
        wrong = f"{self.turns * self._risk:.2g}".replace("e-0", "e-")
        return (
            f"{self.survived} of {self.draws} random plants survive, and so do at least "
            f"{percent:g} % of all (confidence 1 - {wrong})"
        )

    @property
    def entry(self) -> dict[str, float]:
        """The entry of result.json."""
        return {
            "survived": self.survived, "draws": self.draws, "least": self.least,
            "confidence": 1.0 - self.turns * self._risk,
        }  # fmt: skip
