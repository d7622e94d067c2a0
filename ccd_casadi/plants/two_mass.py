"""Case study 1: two masses and a spring whose stiffness follows the masses."""

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

from ccd_casadi.plants.plant import Plant, build_plant


def two_mass(theta: Mapping[str, Any], zeta: float = 0.01) -> dict[str, Any]:
    """The paper's two-mass system, k = 2 m1⁴ + 2 m2⁴, force and sensor on m1 (equation (14)).

    θ: m1, m2 in kg; u in N, y in m. The damper b = 2 ζ √(k μ), μ = m1 m2/(m1 + m2), keeps the
    damping ratio of the flexible mode at `zeta`. Hardware cost: m1 + m2 in kg.
    """
    m1, m2 = theta["m1"], theta["m2"]
    k = 2 * m1**4 + 2 * m2**4
    b = 2 * zeta * ca.sqrt(k * m1 * m2 / (m1 + m2))
    spring = ca.DM([[1, -1], [-1, 1]])
    return {
        "mass": ca.diag(ca.vertcat(m1, m2)),
        "damping": b * spring,
        "stiffness": k * spring,
        "input": ca.DM([1, 0]),
        "output": ca.DM([[1, 0]]),
        "hardware_cost": m1 + m2,
    }


def two_mass_plant(names: Sequence[str], zeta: float = 0.01) -> Plant:
    """The plant of `two_mass`, θ in the order of `names`."""
    return build_plant(two_mass, names, {"zeta": zeta})
