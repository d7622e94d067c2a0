"""Matrices of a slow plant while one drags: a surrogate of its modes, or the nearest exact θ.

The plant is one in modal coordinates whose modes keep their order (M = I, K = diag(λ), as the rib
stage has them, symmetry by symmetry). Gaussian processes of ln θ give ln λ of each mode, and its
row of B and of Cᵀ in the few directions that these rows have. What is made of them is a plant close
to the model, and says so; the model itself is solved where the slider is let go.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ccd_casadi.explorer.designs import Elements
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess, fit, sobol

SIZES = (32, 64, 128)  # samples at which the surrogate is fitted anew
RANK = 1e-9  # share of the largest entry below which a direction of a row is none
FILE = "modes.npz"

Theta = tuple[float, ...]


def in_modal_form(system: Mechanics) -> bool:
    """Whether M = I, K is diagonal and the damping is a ratio, so that each mode is a row."""
    K = system.K
    return (
        system.damping_ratio is not None
        and np.array_equal(system.M, np.eye(len(K)))
        and np.array_equal(K, np.diag(np.diag(K)))
    )


@dataclass(frozen=True)
class Row:
    """A mode's row of (B, Cᵀ) along one direction (m + p,), as a function of ln θ."""

    mode: int
    direction: Array
    process: GaussianProcess


@dataclass(frozen=True)
class ModeSurrogate:
    """ω of each flexible mode and the rows of B and C over the box.

    `errors`: relative error of each frequency where a sample is left out, root mean square.
    """

    pattern: Mechanics
    frequencies: tuple[GaussianProcess, ...]
    rows: tuple[Row, ...]
    samples: int
    errors: Array

    @property
    def words(self) -> str:
        """What it is, and how far off it is where a sample is left out."""
        middle, worst = 100.0 * np.median(self.errors), 100.0 * self.errors.max()
        return (
            f"a surrogate of the modes from {self.samples} exact θ; left out, their frequencies "
            f"are off by {middle:.2g} % RMS, by {worst:.2g} % in the worst mode"
        )

    def at(self, theta: Sequence[float]) -> Mechanics:
        """The matrices at θ, without derivatives."""
        x = np.log(np.array(theta, float))[None]
        rigid = len(self.pattern.M) - len(self.frequencies)
        ln_omega = np.array([process.predict(x)[0] for process in self.frequencies])
        lam = np.concatenate([np.zeros(rigid), np.exp(2.0 * ln_omega)])
        m = self.pattern.B.shape[1]
        both = np.zeros((len(lam), m + len(self.pattern.C)))
        for row in self.rows:
            both[row.mode] += row.process.predict(x)[0] * row.direction
        return replace(self.pattern, K=np.diag(lam), B=both[:, :m].copy(), C=both[:, m:].T.copy())


def fit_modes(thetas: Sequence[Theta], systems: Sequence[Mechanics]) -> ModeSurrogate:
    """The surrogate of so many exact θ; all positive, λ of the flexible modes too."""
    X = np.log(np.array(thetas))
    lam = np.array([np.diag(system.K) for system in systems])
    flexible = np.flatnonzero((lam > 0.0).all(axis=0))
    both = np.array([np.hstack([system.B, system.C.T]) for system in systems])
    known: dict[bytes, GaussianProcess] = {}

    def process(y: Array) -> GaussianProcess:
        key = y.tobytes()  # both modes of a pair have the same
        if key not in known:
            known[key] = fit(X, y, kernel="rbf", noise=0.0, starts=1)
        return known[key]

    frequencies = tuple(process(0.5 * np.log(lam[:, i])) for i in flexible)
    rows = []
    for mode in range(lam.shape[1]):
        _, size, directions = np.linalg.svd(both[:, mode], full_matrices=False)
        for level, direction in zip(size, directions, strict=True):
            if level > RANK * np.abs(both).max() * len(X):
                rows.append(Row(mode, direction, process(both[:, mode] @ direction)))
    pattern = replace(systems[0], derivatives=_none(systems[0]))
    errors = np.array([found.loo.rms for found in frequencies])
    return ModeSurrogate(pattern, frequencies, tuple(rows), len(X), errors)


def _none(system: Mechanics) -> tuple[Array, Array, Array, Array, Array]:
    M, D, K, B, C = (np.zeros((0, *part.shape)) for part in (
        system.M, system.D, system.K, system.B, system.C))  # fmt: skip
    return M, D, K, B, C


def frequency_error(near: Mechanics, exact: Mechanics) -> float:
    """Largest relative difference of the flexible frequencies of two plants in modal form."""
    a, b = np.diag(near.K), np.diag(exact.K)
    flexible = b > 0.0
    return float(np.abs(np.sqrt(a[flexible] / b[flexible]) - 1.0).max())


def plan(lower: Sequence[float], upper: Sequence[float]) -> list[Theta]:
    """The θ to be solved for a surrogate, in an order of which every beginning fills the box."""
    found = sobol(np.array(lower), np.array(upper), max(SIZES), seed=0)
    return [tuple(map(float, x)) for x in found]


@dataclass
class KnownModes:
    """Exact matrices by θ, and the newest surrogate of them; `key` says of which plant."""

    lower: Theta
    upper: Theta
    key: str
    exact: dict[Theta, Mechanics] = field(default_factory=dict)
    missing: int = 0  # of the samples that a surrogate is made of
    surrogate: ModeSurrogate | None = None

    def at(self, theta: Theta) -> Elements:
        """What there is at θ without solving the model: exact, surrogate, or nearest exact θ.

        Raises KeyError where nothing is known yet.
        """
        if theta in self.exact:
            return Elements(self.exact[theta])
        if self.surrogate is not None:
            worst = float(self.surrogate.errors.max())
            return Elements(self.surrogate.at(theta), worst, self.surrogate.words)
        nearest = min(self.exact, key=lambda other: self.distance(theta, other), default=None)
        if nearest is None:
            raise KeyError(theta)
        share = 100.0 * self.distance(theta, nearest)
        words = f"those of the nearest exact θ, {share:.2g} % of the box away"
        return Elements(self.exact[nearest], np.inf, words)

    @property
    def progress(self) -> str:
        """How far the samples are; empty when all are there."""
        if not self.missing:
            return ""
        done = max(SIZES) - self.missing
        last = "" if self.surrogate is None else f"; surrogate of {self.surrogate.samples}"
        return (
            f"the model is being solved behind this page: {done} of {max(SIZES)} θ{last}. Drawn in "
            "grey is what is not the model's own; let a slider go to have the model itself solved"
        )

    def distance(self, one: Theta, other: Theta) -> float:
        """Largest difference as a share of the box."""
        width = np.array(self.upper) - np.array(self.lower)
        return float(np.abs((np.array(one) - np.array(other)) / width).max())

    def due(self, before: int) -> bool:
        """Whether a surrogate should be fitted, the last one having had `before` samples."""
        return any(before < size <= len(self.exact) for size in SIZES)

    def save(self, folder: Path) -> None:
        """Keep the exact matrices in the folder, as plain arrays."""
        systems = list(self.exact.values())
        K, B, C = (np.array([getattr(s, name) for s in systems]) for name in ("K", "B", "C"))
        draft = folder / f".{FILE}"
        with draft.open("wb") as file:
            np.savez(file, key=self.key, theta=np.array(list(self.exact)), K=K, B=B, C=C)
        draft.replace(folder / FILE)

    def load(self, folder: Path, pattern: Mechanics) -> None:
        """Take what the folder holds of the same plant; nothing where it is of another."""
        try:
            with np.load(folder / FILE, allow_pickle=False) as found:
                if str(found["key"]) != self.key:
                    return
                rows = zip(found["theta"], found["K"], found["B"], found["C"], strict=True)
                for theta, K, B, C in rows:
                    system = replace(pattern, K=K, B=B, C=C, derivatives=_none(pattern))
                    self.exact.setdefault(tuple(map(float, theta)), system)
        except (OSError, KeyError, ValueError):
            return  # none, or damaged: it is made anew
