"""Where new truth helps most: the predicted optimum, expected improvement, and exploration.

With y ~ N(μ(x), diag σ²(x)), J and g are linearised in y,

    σ_J² = Σ_i (∂J/∂y_i)² σ_i²,      σ_g² = Σ_i (∂g/∂y_i)² σ_i²,

and the merit of a point is EI(x) Π_j P(g_j <= 0), times the chance of a value there, where with
the best known J* and u = (J* - J(x, μ)) / σ_J the expected improvement is
EI = σ_J (u Φ(u) + φ(u)).
Source: Schonlau, Welch and Jones (1998); batches by the kriging believer of Ginsbourger,
Le Riche and Carraro (2010).
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ccd_casadi.codesign.truth import Observations, Truth
from ccd_casadi.optim.ipopt import end_points
from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess, sobol, to_casadi
from surrogates.gaussian_process import condition

NEAR = 1e-4  # of the box, largest component: nearer to a known point nothing is evaluated
AVOID = 0.02  # of the box: so near to a point without truth nothing is asked or designed
SLACK = 0.1  # share of the tolerance that a constraint of the best known point may be off by
SPREAD, CLOUD = 512, 128  # candidates over the box, and around what is promising
SCALES = (0.1, 0.03, 0.01)
EXACT = 1e-9  # violation allowed of a constraint without any deviation


@dataclass(frozen=True, eq=False)
class Posterior:
    """Surrogates of a truth, one an output, conditioned on observations that all have a value.

    failed (f, d): points where the truth was asked and has no value.
    """

    truth: Truth
    surrogates: tuple[GaussianProcess, ...]
    observed: Observations
    failed: Array

    def values(self) -> tuple[Array, Array]:
        """True J (n,) and largest constraint (n,) of the observations."""
        return objective_and_violation(self.truth, self.observed.X, self.observed.Y)

    def incumbent(self) -> int | None:
        """The observation with the best J among those within the slack; None without one."""
        J, violation = self.values()
        allowed = violation <= SLACK * self.truth.tolerance
        return int(np.flatnonzero(allowed)[np.argmin(J[allowed])]) if allowed.any() else None

    def distance(self, X: Array) -> Array:
        """Distances (m,) of X (m, d) to the nearest point asked before, shares of the box."""
        return distances(self.truth, X, np.vstack([self.observed.X, self.failed]))

    def chance_of_value(self, X: Array) -> Array:
        """A guess (m,) at the probability that the truth has a value at X (m, d).

        r_f² / (r_f² + r_k²) of the distances to the nearest failed and known point, 0 within
        AVOID of a failed one: regions without truth are left alone once they are found.
        """
        if not len(self.failed):
            return np.ones(len(X))
        to_failed = distances(self.truth, X, self.failed)
        to_known = distances(self.truth, X, self.observed.X)
        guess = to_failed**2 / np.maximum(to_failed**2 + to_known**2, 1e-300)
        return np.where(to_failed < AVOID, 0.0, guess)

    def with_prediction_at(self, x: Array) -> "Posterior":
        """The same with its own prediction at x (d,) taken for an observation."""
        truth, old, symbol = self.truth, self.observed, ca.MX.sym("x", len(x))
        mean = to_casadi(list(self.surrogates), std=False)(symbol)
        y, slope = map(np.array, ca.Function("y", [symbol], [mean, ca.jacobian(mean, symbol)])(x))
        dY = None if old.dY is None else np.concatenate([old.dY, slope[None]])
        new = Observations(np.vstack([old.X, x]), np.vstack([old.Y, y.ravel()]), dY)
        surrogates = tuple(
            condition(
                process.hyperparameters, new.X, new.Y[:, i], lower=truth.lower, upper=truth.upper,
                kernel=process.kernel, dY=None if dY is None else dY[:, i],
            )
            for i, process in enumerate(self.surrogates)
        )  # fmt: skip
        return replace(self, surrogates=surrogates, observed=new)


def distances(truth: Truth, X: Array, others: Array) -> Array:
    """Distances (m,) of X (m, d) to the nearest of `others`, largest component in the unit box."""
    if not len(others):
        return np.full(len(X), np.inf)
    width = truth.upper - truth.lower
    return np.array([np.abs((others - x) / width).max(axis=1).min() for x in X])


def objective_and_violation(truth: Truth, X: Array, Y: Array) -> tuple[Array, Array]:
    """J (m,) and the largest constraint (m,), -inf without any, at X (m, d) and Y (m, k)."""
    J = np.array(truth.objective(X.T, Y.T)).ravel()
    if not truth.constraints.numel_out():
        return J, np.full(len(X), -np.inf)
    return J, np.array(truth.constraints(X.T, Y.T)).max(axis=0)


def expected_improvement(posterior: Posterior, X: Array, best: float | None) -> Array:
    """EI of J under `best`, times the probability of feasibility, (m,) at X (m, d), in units of J.

    Without a best known J the probability alone, times the spread of J.
    """
    from scipy.special import ndtr

    pairs = [process.predict(X, return_std=True) for process in posterior.surrogates]
    mean, std = (np.array(part).T for part in zip(*pairs, strict=True))
    J, J_std, g, g_std = _linearised(posterior.truth, X, mean, std)
    certain = g_std <= EXACT
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        each = np.where(certain, g <= EXACT, ndtr(-g / np.where(certain, 1.0, g_std)))
        feasible = each.prod(axis=0)
        if best is None:
            return feasible * float(np.ptp(posterior.values()[0]))
        u = (best - J) / J_std
        gain = J_std * (u * ndtr(u) + np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi))
    gain = np.where(J_std > 0.0, gain, np.maximum(best - J, 0.0))
    return np.nan_to_num(gain * feasible, nan=0.0)


def _linearised(truth: Truth, X: Array, mean: Array, std: Array) -> tuple[Array, ...]:
    """J, σ_J (m,) and g, σ_g (constraints, m) by ∂/∂y."""
    x, y = (ca.MX.sym(name, part.shape[1]) for name, part in (("x", X), ("y", mean)))
    J, g = truth.objective(x, y), truth.constraints(x, y)
    slopes = [ca.vec(ca.jacobian(J, y)), ca.vec(ca.jacobian(g, y))]
    outputs = [np.array(o) for o in ca.Function("j", [x, y], [J, g, *slopes])(X.T, mean.T)]
    variance = (std**2).T
    J_std = np.sqrt((outputs[2] ** 2 * variance).sum(axis=0))
    # column-major: the constraints run fastest
    to_y = outputs[3].reshape(len(variance), g.numel(), len(X))
    return outputs[0].ravel(), J_std, outputs[1], np.sqrt((to_y**2 * variance[:, None]).sum(axis=0))


def scaled_deviation(posterior: Posterior, X: Array) -> Array:
    """Root of the mean square deviation of the outputs, in units of their own spread, (m,)."""
    scale = np.maximum(np.ptp(posterior.observed.Y, axis=0), 1e-100)
    each = [
        process.predict(X, return_std=True)[1] / size
        for process, size in zip(posterior.surrogates, scale, strict=True)
    ]
    return np.nan_to_num(np.sqrt(np.mean(np.square(each), axis=0)))


def maximiser(
    posterior: Posterior, explore: bool, near: list[Array], seed: int
) -> tuple[Array, float]:
    """The point (d,) of largest merit that is not known yet, and its merit; 0 where none helps.

    Merit is the expected improvement, or the deviation to `explore`. Seeded candidates over the
    box and around `near`, then ever closer around the best of them.
    """
    lower, upper = posterior.truth.lower, posterior.truth.upper
    rng = np.random.default_rng(seed)
    at = posterior.incumbent()
    best = None if at is None else float(posterior.values()[0][at])

    def merit(X: Array) -> Array:
        found = (
            scaled_deviation(posterior, X) if explore else expected_improvement(posterior, X, best)
        )
        return np.where(posterior.distance(X) > NEAR, found * posterior.chance_of_value(X), 0.0)

    def cloud(centre: Array, scale: float) -> Array:
        step = scale * rng.standard_normal((CLOUD, len(lower))) * (upper - lower)
        return np.clip(centre + step, lower, upper)

    X = np.vstack([sobol(lower, upper, SPREAD, seed), *(cloud(c, s) for c in near for s in SCALES)])
    score = merit(X)
    for scale in SCALES:
        more = cloud(X[np.argmax(score)], scale)
        X, score = np.vstack([X, more]), np.append(score, merit(more))
    top = int(np.argmax(score))
    return X[top], float(score[top])


def choose(
    posterior: Posterior, near: list[Array], count: int, explore: int, seed: int
) -> Array:
    """A batch (<= count, d): the first of `near` if it is new, then by improvement.

    The last `explore` are by deviation. The prediction at each counts as true before the next is
    sought (kriging believer).
    """
    chosen = [x for x in near[:1] if posterior.distance(x[None])[0] > NEAR]
    for number in range(count):
        if number >= len(chosen):
            x, merit = maximiser(posterior, number >= count - explore, near, seed + number)
            if merit <= 0.0:  # nothing to be gained: then to be learnt
                x, merit = maximiser(posterior, True, near, seed + number)
            if merit <= 0.0:
                break
            chosen.append(x)
        posterior = posterior.with_prediction_at(chosen[number])
    return np.array(chosen[:count]).reshape(-1, len(posterior.truth.lower))


def predicted_optimum(posterior: Posterior, starts: Array) -> tuple[Array, float] | None:
    """The best local optimum of the means and its J, by IPOPT from `starts` (m, d); None without.

    min J(x, s(x))  s.t.  g(x, s(x)) <= 0,  lower <= x <= upper,  ‖x̂ - x̂_f‖ >= AVOID

    with s the means, x̂ in the unit box and x_f the points where the truth had no value.
    """
    truth = posterior.truth
    lower, width = truth.lower, truth.upper - truth.lower
    z = ca.MX.sym("z", len(lower))
    x = lower + width * z
    y = to_casadi(list(posterior.surrogates), std=False)(x)
    free = [AVOID**2 - ca.sumsqr(z - point) for point in (posterior.failed - lower) / width]
    program = {
        "x": z, "f": truth.objective(x, y), "g": ca.vertcat(truth.constraints(x, y), *free)
    }  # fmt: skip
    ends = [end for end in end_points(program, (starts - lower) / width) if end.converged]
    best = min(ends, key=lambda end: end.objective, default=None)
    return None if best is None else (lower + width * best.z, best.objective)
