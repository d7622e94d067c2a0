"""The inner problem by derivatives: the global optimum in a tenth of a sweep's syntheses.

A few designs spread over the box, each with exact derivatives, determine an interpolant of
ln ω_b and of every bounded figure (ln‖S‖∞, ln σ_max(S(jω_low)), ln‖GS‖∞); its constrained maxima
are synthesised and added until the interpolant has no better place to offer. A local constrained
solve then ends on the true functions, as after a sweep.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ccd_casadi.inner_problem.sweep import InnerBounds, InnerResult, Point, evaluate, refine
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.worker_process import side_by_side
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import DesignFigures
from ccd_casadi.synthesis.weights import Weights
from surrogates import Kernel
from surrogates.gaussian_process import covariance


@dataclass(frozen=True)
class InnerSearchOptions:
    """Numbers of the search by derivatives."""

    initial: tuple[int, int] = (4, 4)  # designs along ln ω_S and ln ω_T
    mesh: int = 81  # points a side on which the interpolant is searched
    added: int = 8  # designs at maxima of the interpolant, at most
    syntheses: int = 40  # certified ones in all, the local solve included
    lengths: tuple[float, float] = (0.35, 0.6)  # correlation lengths as fractions of the box


def search_inner(
    plant: ScaledPlant,
    weights: Weights,
    problem: InnerBounds,
    options: InnerSearchOptions = InnerSearchOptions(),
) -> InnerResult:
    """ω_b*(θ) from derivatives, some forty syntheses, those apart that are not certified."""
    bounds = np.log([problem.omega_S, problem.omega_T])
    width = bounds[:, 1] - bounds[:, 0]
    grids = [np.linspace(0.0, 1.0, n) for n in options.initial]
    points = [np.array([a, b]) for a in grids[0] for b in grids[1]]
    at = partial(evaluate, plant, weights, problem)

    def design(point: Array) -> Sensitivities:
        return at(problem.frequencies(bounds[:, 0] + point * width))

    designs = side_by_side(design, points)
    fine = np.linspace(0.0, 1.0, options.mesh)
    for _ in range(options.added):
        usable = [i for i, design in enumerate(designs) if design.figures.certified]
        if not usable:
            break
        X = np.array([points[i] for i in usable])
        Y = np.array([designs[i].values[:-1] for i in usable])
        dY = np.array([designs[i].to_break_frequencies[:-1] * width for i in usable])
        dY[:, 0] /= Y[:, :1]
        Y[:, 0] = np.log(Y[:, 0])
        predicted = _interpolate(X, Y, dY, fine, np.array(options.lengths))
        new = _next_point(problem, fine, predicted, np.array(points), designs)
        if new is None:
            break
        points.append(new)
        designs.append(design(new))
    rows = [design.figures for design in designs]
    left = options.syntheses - sum(row.certified for row in rows)
    return refine(at, problem, rows, _starts(problem, rows), left)


def _starts(problem: InnerBounds, rows: list[DesignFigures]) -> list[Point]:
    """The best feasible design, else the best within 2 % of feasible, else the nearest to it."""

    def rank(row: DesignFigures) -> tuple[int, float]:
        if problem.feasible(row):
            return 0, -row.bandwidth
        excess = problem.excess(row)
        return (1, -row.bandwidth) if excess < 0.02 else (2, excess)

    chosen = min((row for row in rows if row.certified), key=rank, default=None)
    return [] if chosen is None else [(chosen.omega_S, chosen.omega_T)]


def _interpolate(X: Array, Y: Array, dY: Array, fine: Array, lengths: Array) -> Array:
    """Gaussian radial-basis interpolant of values and gradients (n, q) on the mesh, (q, f, f).

    A Gaussian of two variables is the product of one of each: on a mesh φ = e_1 e_2ᵀ, and
    cov(f, ∂_j f_b) = z_j φ, so that matrix products of (f, n) give every point. The lengths are
    given, and one factor serves all outputs.
    """
    x, one = X / lengths, np.ones(X.shape[1])
    K = covariance(Kernel.RBF, x, x, one, gradients_of_a=True, gradients_of_b=True)
    K[np.diag_indices_from(K)] += 1e-8
    mean = Y.mean(axis=0)
    data = np.vstack([Y - mean] + [dY[:, :, i] * lengths[i] for i in range(X.shape[1])])
    by_value, by_S, by_T = cho_solve(cho_factor(K), data).T.reshape(-1, 3, 1, len(X)).swapaxes(0, 1)
    z_S, z_T = (fine[:, None] / lengths[i] - x[:, i] for i in range(2))
    e_S, e_T = np.exp(-0.5 * z_S**2), np.exp(-0.5 * z_T**2)
    found = (e_S * (by_value + z_S * by_S)) @ e_T.T + (e_S * by_T) @ (z_T * e_T).T
    return mean[:, None, None] + found


def _next_point(
    problem: InnerBounds, fine: Array, predicted: Array, X: Array, designs: list[Sensitivities]
) -> Array | None:
    """The best predicted point over the connected parts of the predicted feasible set.

    Points that are nearer to an uncertified design than to any other are no part of it. None when
    every part's best is no better than the incumbent or next to a known design.
    """
    levels = problem.levels
    excess = (predicted[1:] - levels[:, None, None]).max(axis=0)
    certified = np.array([design.figures.certified for design in designs])
    if not certified.all():
        to_S, to_T = (np.square(fine[:, None] - X[:, i]) for i in range(2))
        nearest = (to_S[:, None] + to_T[None]).argmin(axis=-1)
        excess[~certified[nearest]] = np.inf
    inside = excess <= 0.0
    best = max(
        (np.log(d.figures.bandwidth) for d in designs if problem.feasible(d.figures)),
        default=-np.inf,
    )
    if not inside.any():
        least = np.unravel_index(int(np.argmin(excess)), excess.shape)
        candidates = [least] if best == -np.inf else []
    else:
        from scipy.ndimage import label, maximum_position  # slow to import

        parts, count = label(inside)
        places = maximum_position(predicted[0], parts, range(1, count + 1))
        candidates = [place for place in places if predicted[0][place] > best + 1e-4]
        candidates.sort(key=lambda place: -predicted[0][place])
    for place in candidates:
        point = fine[list(place)]
        if np.abs(X - point).max(axis=1).min() > 0.6 / (len(fine) - 1):
            return point
    return None
