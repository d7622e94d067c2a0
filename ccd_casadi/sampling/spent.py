"""What a run spends, by purpose: every distinct design once, for what asked for it first."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any


class SynthesisCounts:
    """Counts of true syntheses; `purpose` is what is being done."""

    def __init__(self) -> None:
        self.purpose = "samples"
        self._units: dict[str, tuple[str, int]] = {}

    @contextmanager
    def on(self, purpose: str) -> Iterator[None]:
        """What is asked for inside is spent on this."""
        before, self.purpose = self.purpose, purpose
        try:
            yield
        finally:
            self.purpose = before

    def once(self, unit: str, count: int) -> bool:
        """Count a unit of work; whether it is a new one."""
        new = unit not in self._units
        if new:
            self._units[unit] = (self.purpose, count)
        return new

    @property
    def total(self) -> int:
        """Of all purposes."""
        return sum(count for _, count in self._units.values())

    @property
    def by_purpose(self) -> dict[str, int]:
        """In the order in which they came up."""
        found: dict[str, int] = {}
        for purpose, count in self._units.values():
            found[purpose] = found.get(purpose, 0) + count
        return found


def spent_entry(spent: Mapping[str, int], moved: bool = False) -> dict[str, Any]:
    """Of result.json: all syntheses, by purpose, and those without which the design was not there.

    A global check over the box that `moved` the design is part of the way to it.

    >>> spent_entry({"samples": 24, "box_look": 600})["syntheses_to_optimum"]
    24
    """
    total = sum(spent.values())
    beside = 0 if moved else spent.get("box_look", 0)
    return {"syntheses": total, "syntheses_to_optimum": total - beside, "spent": dict(spent)}


def with_all_spent(result: Mapping[str, Any], spent: Mapping[str, int]) -> dict[str, Any]:
    """A result of a run of several searches with what all of them took."""
    moved = bool(result.get("box_look", {}).get("moved"))  # the global check led to the design
    return {**result, **spent_entry(spent, moved)}
