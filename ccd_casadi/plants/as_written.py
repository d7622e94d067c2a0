"""A plant as its function returned it, in first order: what a finished loop is judged on.

    M q̈ + D q̇ + K q = B u,   y = C q;   ẋ = [0 1; -M⁻¹K -M⁻¹D] x + [0; M⁻¹B] u,   x = (q, q̇)

in the person's own coordinates and units, free bodies free, nothing reduced, scaled or put in modal
form, with its actuators and sensors around it, but for one case: beside a link so stiff that
λ_max > 1e7 λ_min the eigenvalues of A err by ε λ_max in squares of rates, which moves the soft
poles and hides free bodies. There x = (η, η̇), q = Φ η with `natural_modes`, which know the soft
modes, M = 1 and K = Λ.

Off the model, with a common shift s of the resonances, shifts s_i of single modes, a factor d of
the damping and a gain g of what u moves,

    K' = (1 + s)²(K + Σ_i ((1 + s_i)² - 1) λ_i M φ_i (M φ_i)ᵀ),
    D' = d (D + Σ_i 2 ζ (1 + s)(1 + s_i) ω_i M φ_i (M φ_i)ᵀ),   b_j' = (1 + g) b_j.

A plant of first order is as its function returned it, and off its model as `first_order` has it.
A motion that K drives away, λ_i < 0, has ω_i = 0 here: ζ damps none.
"""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.lti.wiring import Slopes
from ccd_casadi.plants.first_order import first_order
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.rigid_modes import driven_and_measured, natural_modes, number_modes
from ccd_casadi.support.arrays import Array


def as_written(
    system: Mechanics,
    *,
    shift: float = 0.0,
    modes: Sequence[float] = (),
    damping: float = 1.0,
    gain: float = 0.0,
    inputs: int | None = None,
    rigid_modes: int | None = None,
    stiff: float = 1e7,
) -> StateSpace:
    """The state space of a plant's matrices, on or off the model.

    Parameters
    ----------
    system : Mechanics
        M, D, K, B, C at one θ, SI, and the damping ratio ζ where the model gives one.
    shift, modes, damping, gain : float, sequence of float, float, float
        s, s_i in the order of the modes' numbers, d and g; of a given D the matrix is kept.
    inputs : int, optional
        How many columns b_j of B are those of u, the first; None: all.
    rigid_modes : int, optional
        How many there are, where the case states it.
    stiff : float
        λ_max/λ_min of the flexible modes above which these are the coordinates: rounding would
        cost the low ones their digits.

    Returns
    -------
    StateSpace
        Force to displacement. Free bodies that are neither driven nor measured are left out.

    Raises
    ------
    PlantError
        Where it is not known which modes are rigid, or no controller can hold one.
    """
    B = system.B.copy()
    B[:, :inputs] *= 1.0 + gain
    if system.first_order:
        system_of = strictly_proper(-system.K, B, system.C)
        if shift or damping != 1.0 or any(modes):
            none = Slopes(*(np.zeros((0, *part.shape)) for part in (system.K, system.B, system.C)))
            states = first_order(system_of.A, system_of.B, system_of.C, none)
            system_of = states.off(shift, damping, modes).system
        return system.wiring.around(system_of)
    lam, shapes, rigid = natural_modes(system.K, system.M, rigid_modes)
    own = np.zeros(len(lam))
    single = number_modes(shapes, rigid)[: len(modes)]
    own[single] = list(modes)[: len(single)]
    pushes = system.M @ shapes
    ratio = (1.0 + shift) * (1.0 + own)
    K = (1.0 + shift) ** 2 * (system.K + (pushes * (((1.0 + own) ** 2 - 1.0) * lam)) @ pushes.T)
    zeta = system.damping_ratio or 0.0
    omega = ratio * np.sqrt(np.maximum(lam, 0.0))
    D = damping * (system.D + (pushes * (2.0 * zeta * omega)) @ pushes.T)
    M, C = system.M, system.C
    sides, soft = _seen(shapes, rigid, B, C), np.abs(lam[~rigid])
    spread = bool(len(soft)) and soft.max() > stiff * soft.min()
    if sides is None and spread:
        sides = shapes, shapes
    if sides is not None:
        left, right = sides
        M, K, D = (left.T @ part @ right for part in (M, K, D))
        B, C = left.T @ B, C @ right
    if spread:  # exactly, where products with K would lose it
        M, K = (
            np.eye(len(M)),
            np.diag(np.append(np.zeros(len(M) - len(soft)), (ratio**2 * lam)[~rigid])),
        )
    n, rates = len(M), np.linalg.solve(M, np.hstack([K, D, B]))
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.eye(n)
    A[n:] = -rates[:, : 2 * n]
    drive = np.vstack([np.zeros_like(B), rates[:, 2 * n :]])
    plant = strictly_proper(A, drive, np.hstack([C, np.zeros_like(C)]))
    return system.wiring.around(plant)


def _seen(shapes: Array, rigid: np.ndarray, B: Array, C: Array) -> tuple[Array, Array] | None:
    """Test and trial shapes (n, k) without the rigid-body motions that are neither driven nor
    measured; None where all are: then the person's own coordinates stay."""
    free, flexible = shapes[:, rigid], shapes[:, ~rigid]
    sizes = np.linalg.norm(shapes.T @ B, 2), np.linalg.norm(C @ shapes, 2)
    if not free.size or not all(sizes):
        return None
    T, back = driven_and_measured(free.T @ B / sizes[0], C @ free / sizes[1])
    if T.shape[1] == free.shape[1]:
        return None
    return np.hstack([free @ back.T, flexible]), np.hstack([free @ T, flexible])
