"""A builder's own order of θ, and the order that a case gives it in."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

from ccd_casadi.plants.plant import Mechanics

REMEMBERED = 64  # θ whose matrices are kept


class Ordered:
    """θ in the order of `names` -> Mechanics, of `mechanics(θ in the order of own, derivatives)`.

    Derivatives, where they are asked for, are in the order of `names` too.
    """

    keep: object = None  # what has to live as long

    def __init__(
        self,
        mechanics: Callable[[tuple[float, ...], bool], Mechanics],
        own: Sequence[str],
        names: Sequence[str],
        derivatives: bool = True,
    ) -> None:
        self.place = [list(names).index(name) for name in own]
        self._mechanics, self._derivatives = mechanics, derivatives
        self._back = [list(own).index(name) for name in names]
        self._read = lru_cache(maxsize=REMEMBERED)(self._evaluated)

    def own(self, theta: Sequence[float]) -> tuple[float, ...]:
        """θ in the builder's order."""
        return tuple(float(theta[i]) for i in self.place)

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        return self._read(self.own(theta))

    def _evaluated(self, theta: tuple[float, ...]) -> Mechanics:
        found = self._mechanics(theta, self._derivatives)
        if not self._derivatives or self._back == sorted(self._back):
            return found
        M, D, K, B, C = (array[self._back] for array in found.derivatives)
        return replace(found, derivatives=(M, D, K, B, C))
