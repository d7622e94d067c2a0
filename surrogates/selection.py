"""The kind of surrogate that cross-validation prefers for given samples."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surrogates.fitting import Kind, fit_samples
from surrogates.gaussian_process import conditioned
from surrogates.interface import Surrogate, SurrogateFitError
from surrogates.kernels import Kernel
from surrogates.maximum_likelihood import EXACT_LIMIT, estimate, uneven_noise
from surrogates.network import fit_network
from surrogates.samples import Samples
from surrogates.validation import Errors, errors, held_out

FOLDS = 10
STARTS = 3
# Samples that enter the comparison: the order of the candidates seldom changes beyond.
COMPARED = 1000


@dataclass(frozen=True)
class Candidate:
    """A kind to try; the kernel matters to the processes only."""

    kind: Kind
    kernel: Kernel = Kernel.MATERN52

    @property
    def name(self) -> str:
        """The kind, with the kernel where it has one."""
        process = self.kind in (Kind.GAUSSIAN_PROCESS, Kind.SPARSE_PROCESS)
        return f"{self.kind.value}/{self.kernel.value}" if process else self.kind.value


@dataclass(frozen=True)
class Choice:
    """The candidate of least k-fold rms error, and the errors of all that could be fitted."""

    best: Candidate
    errors: dict[str, Errors]


def choose(samples: Samples, folds: int = FOLDS, seed: int = 0) -> Choice:
    """Return the candidate with the least rms error on samples held out.

    Exact processes of both kernels (sparse ones beyond 5,000 observations), a
    polynomial and, if there are no gradients, radial basis functions and a network;
    with k folds of at most 1,000 of the samples. The processes keep the hyperparameters of
    all samples on every fold, which favours them a little: estimated anew they cost ten
    times as much, and a poor local optimum on one fold of forty samples outweighs the rest
    (seen on the Branin function: 0.03 against 0.003). A candidate that cannot be fitted is passed
    over.

    Raises:
        SurrogateFitError: none can be fitted.
    """
    few = samples
    if samples.Y.size > COMPARED:
        rows = np.random.default_rng(seed).permutation(samples.Y.size)[:COMPARED]
        few = samples.rows(rows)
    found: dict[str, Errors] = {}
    known: dict[str, Candidate] = {}
    for candidate in candidates(samples):
        try:
            fitter = _fitter(few, candidate, seed)
            residuals, _ = held_out(fitter, few, min(folds, few.Y.size), seed)
        except (SurrogateFitError, np.linalg.LinAlgError):
            continue
        found[candidate.name] = errors(residuals, few.Y)
        known[candidate.name] = candidate
    if not found:
        raise SurrogateFitError(
            "no kind of surrogate can be fitted to these samples: they are too few, or "
            "repeated samples contradict each other without noise"
        )
    return Choice(known[min(found, key=lambda name: found[name].rms)], found)


def candidates(samples: Samples) -> list[Candidate]:
    """Return what can be fitted to as many samples, with gradients or without."""
    large = samples.observations > EXACT_LIMIT
    process = Kind.SPARSE_PROCESS if large else Kind.GAUSSIAN_PROCESS
    tried = [Candidate(Kind.POLYNOMIAL)]
    if not large or samples.dY is None:
        tried = [Candidate(process, kernel) for kernel in Kernel] + tried
    if samples.dY is None:
        tried += [Candidate(Kind.NETWORK)] + ([] if large else [Candidate(Kind.RADIAL_BASIS)])
    return tried


def _fitter(samples: Samples, candidate: Candidate, seed: int) -> Callable[[Samples], Surrogate]:
    """What fits the candidate to the rest of a fold, without validation within validation."""
    if candidate.kind in (Kind.GAUSSIAN_PROCESS, Kind.SPARSE_PROCESS):
        kernel = candidate.kernel
        parameters = estimate(samples, kernel, seed=seed, starts=STARTS)
        return lambda part: conditioned(parameters, part, kernel, uneven_noise(part))
    if candidate.kind is Kind.NETWORK:
        return lambda part: fit_network(part, seed=seed, validate=False)
    return lambda part: fit_samples(part, candidate.kind, seed=seed)
