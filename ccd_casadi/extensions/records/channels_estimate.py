"""The response of a plant with several forces and positions, from one record or more a force.

In record i the excitation r_i drives all forces u and positions y of the loop. With the responses
Y = [G_yr1 G_yr2 …] and U = [G_ur1 G_ur2 …] of all records, each with its covariance C_i,

    G = Y U⁺,     var G_ab = Σ_i ([I -G] C_i [I -G]ᴴ)_aa |U⁺_ib|²,

as for one channel (`plant_estimate`); the spread is that of each entry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ccd_casadi.extensions.records.local_polynomial import fit_locally
from ccd_casadi.extensions.records.plant_estimate import (
    EstimateOptions,
    kept_lines,
    quantile_of,
    require_alive,
)
from ccd_casadi.extensions.records.time_series import SignalNames, TimeSeries, read_record
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class ChannelOptions:
    """Numbers of the estimate of several channels.

    Attributes
    ----------
    apart : float
        Least singular value of U over the largest: below it two records excite alike.
    """

    apart: float = 1e-3


@dataclass(frozen=True)
class MatrixEstimate:
    """A plant's response by records of several channels.

    Attributes
    ----------
    hz, G, spread : array (k,), (k, p, m), (k, p, m)
        Lines in Hz; unit of y over N, and the radius of each entry.
    coherence : array (k,)
        The least of all signals and records.
    """

    hz: Array
    G: np.ndarray
    spread: Array
    coherence: Array


def read_channels(
    path: Path, names: SignalNames, forces: Sequence[str], positions: Sequence[str]
) -> list[list[TimeSeries]]:
    """Read a record as one of every force (rows) and every position (columns)."""
    return [[read_record(path, replace(names, force=force, position=position))
             for position in positions] for force in forces]  # fmt: skip


def estimate_channels(
    records: Sequence[list[list[TimeSeries]]], options: EstimateOptions = EstimateOptions(),
    channels: ChannelOptions = ChannelOptions(),
) -> MatrixEstimate:  # fmt: skip
    """Estimate the response of all forces to all positions.

    Parameters
    ----------
    records : sequence of lists of TimeSeries
        As `read_channels` gives them, at least one a force, of unlike excitations.
    options, channels : EstimateOptions, ChannelOptions

    Returns
    -------
    MatrixEstimate

    Raises
    ------
    UserError
        There are fewer records than forces, two excite alike, or rates and lengths differ.
    """
    m, p = len(records[0]), len(records[0][0])
    if len(records) < m:
        raise UserError(f"{m} forces need {m} records, each with another excitation, and there "
                        f"are {len(records)}")  # fmt: skip
    every = [one for record in records for row in record for one in row]
    for one in every:
        require_alive(one)
    if max(abs(one.period / every[0].period - 1.0) for one in every) > options.same_rate:
        raise UserError("the records have several rates; give records of one rate")
    count = min(len(one.force) for one in every)
    fits, lines = [], np.zeros(0, int)
    for record in records:
        signals = [*(one.position for one in record[0]), *(row[0].force for row in record)]
        whole = np.array([*signals, record[0][0].excitation])[:, :count]
        spectra = np.fft.rfft(np.diff(whole), axis=1)[None] / np.sqrt(count - 1)
        lines = kept_lines(spectra.shape[2], 1, options)
        fits.append(fit_locally(spectra[:, :-1], spectra[:, -1], lines))
    hz = lines / ((count - 1) * every[0].period)
    Y, U = (np.stack([fit.G[:, part] for fit in fits], axis=2)
            for part in (slice(None, p), slice(p, None)))  # fmt: skip
    good = np.isfinite(Y).all(axis=(1, 2)) & np.isfinite(U).all(axis=(1, 2))
    size = np.linalg.svd(np.where(good[:, None, None], U, 0.0), compute_uv=False)
    unlike = size[:, m - 1] > channels.apart * size[:, 0]
    if not (good & unlike).any():
        raise UserError("two records excite the forces alike; inject at another force in each")
    kept = np.flatnonzero(good & unlike)
    back = np.linalg.pinv(U[kept])
    G = Y[kept] @ back
    side = np.concatenate([np.broadcast_to(np.eye(p), (len(kept), p, p)), -G], axis=2)
    variance, freedom = np.zeros(G.shape), np.zeros(len(kept))
    for i, fit in enumerate(fits):
        own = np.einsum("kai,kij,kaj->ka", side, fit.covariance[kept], side.conj()).real
        variance += np.maximum(own, 0.0)[:, :, None] * np.abs(back[:, i])[:, None, :] ** 2
        freedom += fit.degrees[kept] / len(fits)
    spread = options.allowance * np.sqrt(variance * quantile_of(freedom, options)[:, None, None])
    coherence = np.min([fit.coherence[kept].min(axis=1) for fit in fits], axis=0)
    strong = np.linalg.norm(spread, axis=1) <= options.weak * np.linalg.norm(G, axis=1)
    used = np.flatnonzero(strong.all(axis=1) & np.isfinite(spread).all(axis=(1, 2)))
    if not len(used):
        raise UserError("on no line is the spread below |G|: excite more, or record longer")
    return MatrixEstimate(hz[kept][used], G[used], spread[used], coherence[used])


def channel_findings(found: MatrixEstimate, options: EstimateOptions) -> list[tuple[str, str]]:
    """List what is to be known of an estimate of several channels.

    Parameters
    ----------
    found, options : MatrixEstimate, EstimateOptions

    Returns
    -------
    list of (subject, words)
    """
    _, p, m = found.G.shape
    ratio = np.median(found.spread / np.abs(found.G), axis=0)
    worst = np.unravel_index(int(ratio.argmax()), ratio.shape)
    at = f"position {worst[0] + 1} by force {worst[1] + 1}"
    return [
        ("response", f"{p} positions by {m} forces, {len(found.hz)} lines from {found.hz[0]:.4g} "
                     f"to {found.hz[-1]:.4g} Hz, hold and delay in it; lines whose spread is above "
                     "|G| are left out"),
        ("spread", f"{100.0 * options.confidence:g} % confidence at each line and entry: "
                   f"{100.0 * np.median(ratio):.2g} % of |G| in the median, "
                   f"{100.0 * ratio.max():.3g} % of {at}"),
        ("coherence", f"{np.median(found.coherence):.3f} in the median, least "
                      f"{found.coherence.min():.3f}"),
    ]  # fmt: skip
