"""The three rigid-body modes that vertical forces excite, in closed form: z, tip and tilt.

In free flight about the centre of gravity (x_c, y_c, z_c) the lower face moves by
u_z = z + a (y - y_c) + b (x - x_c). With kinetic energy ½ m ż² + ½ (ȧ ḃ) S (ȧ ḃ)ᵀ, S the inertia
left once yaw is free to follow (Schur complement of J_zz), the mass-normalised modes are

    1/√m    and    [y - y_c, x - x_c] R,    S = L Lᵀ, R = L⁻ᵀ.

The other three, sideways translations and yaw, are neither driven nor seen along z.
"""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from ccd_casadi.case_studies.rib_stage.geometry import NAMES, Geometry, Point, mass_properties
from ccd_casadi.support.arrays import Array

RIGID_NAMES = ("z", "tip", "tilt")


def rigid_fields(geometry: Geometry, points: Sequence[Point]) -> ca.Function:
    """θ -> u_z of the three modes at points of the lower face, (3, points) in 1/√kg, and ∂/∂θ."""
    theta = ca.SX.sym("theta", len(NAMES))
    modes = _coefficients(geometry, theta)
    x = ca.DM([[p[0] for p in points]])
    y = ca.DM([[p[1] for p in points]])
    one = ca.DM.ones(1, len(points))
    field = ca.densify(modes @ ca.vertcat(one, y, x))
    slope = ca.densify(ca.jacobian(ca.vec(field), theta))
    return ca.Function("rigid_fields", [theta], [field, slope])


def rigid_values(function: ca.Function, theta: Array) -> tuple[Array, Array]:
    """(3, points) and (θ, 3, points) from `rigid_fields`."""
    field, slope = (np.array(value) for value in function(theta))
    return field, slope.reshape(field.shape[1], field.shape[0], len(theta)).transpose(2, 1, 0)


def _coefficients(geometry: Geometry, theta: ca.SX) -> ca.SX:
    """(3, 3): u_z = c_0 + c_1 y + c_2 x of each mode."""
    body = mass_properties(geometry, [theta[i] for i in range(len(NAMES))])
    J, (x_c, y_c, _) = body.inertia, body.centre
    S_aa = J[0][0] - J[0][2] ** 2 / J[2][2]
    S_bb = J[1][1] - J[1][2] ** 2 / J[2][2]
    S_ab = -(J[0][1] - J[0][2] * J[1][2] / J[2][2])  # b turns about -y
    L_aa = ca.sqrt(S_aa)
    L_ba = S_ab / L_aa
    L_bb = ca.sqrt(S_bb - L_ba**2)
    tip_a = 1.0 / L_aa
    tilt_a, tilt_b = -L_ba / (L_aa * L_bb), 1.0 / L_bb
    return ca.vertcat(
        ca.horzcat(1.0 / ca.sqrt(body.mass), 0.0, 0.0),
        ca.horzcat(-tip_a * y_c, tip_a, 0.0),
        ca.horzcat(-tilt_a * y_c - tilt_b * x_c, tilt_a, tilt_b),
    )
