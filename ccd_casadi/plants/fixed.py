"""A plant with some of its parameters at given values: the rest of θ is free; and a builder's own
order of θ beside the order that a case gives it in.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.plants.plant import Evaluate, Mechanics, ModelFunction, Plant
from ccd_casadi.support.arrays import Array


def fixed_model(model: ModelFunction, fixed: Mapping[str, float]) -> ModelFunction:
    """The model as a function of the free parameters alone."""
    if not fixed:
        return model

    def of_free(theta: Mapping[str, Any], **options: Any) -> Mapping[str, Any]:
        return model({**theta, **fixed}, **options)

    return of_free


class Reparametrised:
    """Free θ -> Mechanics of a plant at all of θ, with the derivatives to the free ones.

    `place` is where the free parameters are in the whole θ, whose others are those of `whole`.
    """

    def __init__(self, evaluate: Evaluate, place: Sequence[int], whole: Array) -> None:
        self.evaluate, self.place, self._whole = evaluate, list(place), whole

    def own(self, theta: Sequence[float]) -> tuple[float, ...]:
        """The whole θ, in the plant's own order."""
        out = self._whole.copy()
        out[self.place] = theta
        return tuple(out.tolist())

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        found = self.evaluate(self.own(theta))
        if not len(found.derivatives[0]):  # values alone
            return found
        M, D, K, B, C = (array[self.place] for array in found.derivatives)
        return replace(found, derivatives=(M, D, K, B, C))


def with_fixed(plant: Plant, fixed: Mapping[str, float]) -> Plant:
    """The plant as a function of the parameters that `fixed` does not name.

    >>> from ccd_casadi.plants.plant import build_plant, mechanics
    >>> from ccd_casadi.plants.two_mass import two_mass
    >>> both = build_plant(two_mass, ["m1", "m2"], {})
    >>> one = with_fixed(both, {"m1": 60.0})
    >>> one.names, mechanics(one, (50.0,)).M.diagonal().tolist()
    (('m2',), [60.0, 50.0])
    """
    place = [i for i, name in enumerate(plant.names) if name not in fixed]
    whole = np.array([fixed.get(name, np.nan) for name in plant.names])

    def of(evaluate: Evaluate) -> Reparametrised:
        return Reparametrised(evaluate, place, whole)

    own = of(plant.evaluate)
    free = ca.MX.sym("theta", len(place))
    entries = iter(ca.vertsplit(free))
    theta = [fixed[name] if name in fixed else next(entries) for name in plant.names]
    domain = plant.domain
    return reparametrised(
        plant, of, own.own,
        names=tuple(plant.names[i] for i in place),
        hardware=ca.Function("hardware", [free], plant.hardware.call([ca.vertcat(*theta)])),
        domain=None if domain is None else (domain[0][place], domain[1][place]),
    )  # fmt: skip


def reparametrised(
    plant: Plant,
    of: Callable[[Evaluate], Evaluate],
    own: Callable[[Sequence[float]], tuple[float, ...]],
    **others: Any,
) -> Plant:
    """The plant as a function of another θ: `own` makes its own of that, `of` wraps what evaluates.

    `others`: fields that are given as they are, of the new θ.
    """
    shapes, drawing, nearby = plant.shapes, plant.drawing, plant.nearby
    seen: dict[str, Any] = {
        "evaluate": of(plant.evaluate),
        "references": {name: of(closer) for name, closer in plant.references.items()},
        "values": plant.values and of(plant.values),
        "nearby": nearby and (lambda known: of(nearby([own(theta) for theta in known]))),
        "notes": lambda theta: plant.notes(own(theta)),
        "doubt": lambda theta: plant.doubt(own(theta)),
        "shapes": shapes and (lambda theta, count: shapes(own(theta), count)),
        "drawing": drawing and (lambda thetas: drawing({k: own(v) for k, v in thetas.items()})),
    }
    return replace(plant, **(seen | others))


REMEMBERED = 64  # θ whose matrices are kept


class Ordered(Reparametrised):
    """θ in the order of `names` -> Mechanics, of `mechanics(θ in the order `own`, derivatives)`."""

    keep: object = None  # what has to live as long

    def __init__(
        self,
        mechanics: Callable[[tuple[float, ...], bool], Mechanics],
        own: Sequence[str],
        names: Sequence[str],
        derivatives: bool = True,
    ) -> None:
        evaluate = lru_cache(maxsize=REMEMBERED)(lambda theta: mechanics(theta, derivatives))
        super().__init__(evaluate, [list(own).index(name) for name in names], np.zeros(len(own)))
