"""A plant with some parameters fixed, or as a function of others."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.lti.wiring import Wiring
from ccd_casadi.plants.model_function import ModelFunction
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant


def fixed_model(model: ModelFunction, fixed: Mapping[str, float]) -> ModelFunction:
    """Restrict a model to its free parameters.

    Parameters
    ----------
    model : callable
        model(theta, **options).
    fixed : mapping
        Values of the other parameters by name, SI.

    Returns
    -------
    callable
        The model as a function of the free parameters alone.
    """
    if not fixed:
        return model

    def of_free(theta: Mapping[str, Any], **options: Any) -> Mapping[str, Any]:
        return model({**theta, **fixed}, **options)

    return of_free


def with_fixed(
    plant: Plant, fixed: Mapping[str, float], names: Sequence[str] | None = None
) -> Plant:
    """Restrict a plant to the parameters that are not fixed.

    Parameters
    ----------
    plant : Plant
    fixed : mapping
        Values by name, SI.
    names : sequence of str, optional
        Order of the free parameters; by default that of the plant.

    Returns
    -------
    Plant

    Examples
    --------
    >>> from ccd_casadi.plants.plant import build_plant, mechanics
    >>> from ccd_casadi.plants.registry import two_mass
    >>> both = build_plant(two_mass, ["m1", "m2"], {})
    >>> one = with_fixed(both, {"m1": 60.0})
    >>> one.names, mechanics(one, (50.0,)).M.diagonal().tolist()
    (('m2',), [60.0, 50.0])
    """
    names = [name for name in plant.names if name not in fixed] if names is None else names
    if tuple(names) == plant.names:
        return plant
    place = [plant.names.index(name) for name in names]
    whole = np.array([fixed.get(name, np.nan) for name in plant.names])

    def own(theta: Sequence[float]) -> tuple[float, ...]:
        """The whole θ, in the plant's own order."""
        out = whole.copy()
        out[place] = theta
        return tuple(out.tolist())

    def of(evaluate: Evaluate) -> Evaluate:
        def at(theta: Sequence[float]) -> Mechanics:
            found = evaluate(own(theta))
            if not len(found.derivatives[0]):  # values alone
                return found
            M, D, K, B, C = (array[place] for array in found.derivatives)
            return replace(found, derivatives=(M, D, K, B, C))

        return at

    free, domain = ca.MX.sym("theta", len(place)), plant.domain
    known: dict[str, Any] = {**fixed, **dict(zip(names, ca.vertsplit(free), strict=True))}
    theta = ca.vertcat(*(known[name] for name in plant.names))
    return reparametrise(
        plant, of, own,
        names=tuple(names),
        hardware=ca.Function("hardware", [free], plant.hardware.call([theta])),
        domain=None if domain is None else (domain[0][place], domain[1][place]),
    )  # fmt: skip


def reparametrise(
    plant: Plant,
    of: Callable[[Evaluate], Evaluate],
    own: Callable[[Sequence[float]], tuple[float, ...]],
    **others: Any,
) -> Plant:
    """Make a plant a function of another θ.

    Parameters
    ----------
    plant : Plant
    of : callable
        Wraps a function θ -> Mechanics of the plant into one of the new θ.
    own : callable
        New θ -> θ of the plant.
    **others
        Fields that are given as they are, of the new θ.

    Returns
    -------
    Plant
    """
    shapes, drawing, nearby = plant.shapes, plant.drawing, plant.nearby
    seen: dict[str, Any] = {
        "evaluate": of(plant.evaluate),
        "references": {name: of(closer) for name, closer in plant.references.items()},
        "values": plant.values and of(plant.values),
        "nearby": nearby and (lambda known: of(nearby([own(theta) for theta in known]))),
        "notes": lambda theta: plant.notes(own(theta)),
        "doubt": lambda theta: plant.doubt(own(theta)),
        "mismatch": lambda theta: plant.mismatch(own(theta)),
        "shapes": shapes and (lambda theta, count: shapes(own(theta), count)),
        "drawing": drawing and (lambda thetas: drawing({k: own(v) for k, v in thetas.items()})),
    }
    return replace(plant, **(seen | others))


def with_wiring(plant: Plant, wiring: Wiring) -> Plant:
    """Give a plant its actuators and sensors.

    Parameters
    ----------
    plant : Plant
    wiring : Wiring
        Where it says which channels are its `own`, forces on the mechanics become further inputs,
        and positions that no sensor filters further outputs, unless the plant has its ports there.

    Returns
    -------
    Plant
        Of the same θ, whose matrices are the mechanics'.

    Raises
    ------
    PlantError
        A list has another number of entries than the plant has channels.
    """
    p, m = wiring.own or (plant.outputs, plant.inputs)
    wiring.actuator.system(m, "actuator")
    wiring.sensor.system(p, "sensor")
    more_u, more_y = (
        wiring.own is not None and count == own
        for count, own in ((plant.inputs, m), (plant.outputs, p))
    )

    def of(evaluate: Evaluate) -> Evaluate:
        def at(theta: Sequence[float]) -> Mechanics:
            found = evaluate(theta)
            B, C, (dM, dD, dK, dB, dC) = found.B, found.C, found.derivatives
            if more_u:
                B, dB = np.hstack([B, B]), np.concatenate([dB, dB], axis=2)
            if more_y:
                C, dC = np.vstack([C, C]), np.concatenate([dC, dC], axis=1)
            return replace(found, B=B, C=C, derivatives=(dM, dD, dK, dB, dC), wiring=wiring)

        return at

    return reparametrise(
        plant, of, lambda theta: tuple(map(float, theta)),
        inputs=plant.inputs + more_u * m, outputs=plant.outputs + more_y * p,
        notes=lambda theta: (*plant.notes(theta), wiring.words),
    )  # fmt: skip
