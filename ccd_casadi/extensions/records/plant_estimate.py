"""The plant's response from records of a loop: by the excitation as the instrument.

With the excitation r (a force that is injected, or the reference) as the instrument

    G = G_yr / G_ur

has no bias of the noise in the loop, which y/u has: there noise goes round the loop into the force
u (Söderström and Stoica, System Identification, 1989, section 8; Pintelon and Schoukens, 2012,
section 2.6). G_yr and G_ur with their joint covariance C are those of `local_polynomial`, of first
differences: these do not change G, and make of a drift an offset and of a step a pulse. Then

    σ² = [1 -G] C [1 -G]ᴴ / |G_ur|²,     spread² = σ² F,   F the quantile of Fisher's F(2, 2ν)

is the variance of Ĝ with ν degrees of freedom, and the radius of the disc about Ĝ that holds G with
the stated probability, at each line alone.

Of several forces and positions there is one record or more a force. In record i the excitation r_i
drives all forces u and positions y of the loop. With the responses Y = [G_yr1 G_yr2 …] and
U = [G_ur1 G_ur2 …] of all records, each with its covariance C_i,

    G = Y U⁺,     var G_ab = Σ_i ([I -G] C_i [I -G]ᴴ)_aa |U⁺_ib|²,

as for one channel; the spread is that of each entry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d

from ccd_casadi.extensions.records.local_polynomial import WindowOptions, fit_locally
from ccd_casadi.extensions.records.time_series import SignalNames, TimeSeries, read_record
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class EstimateOptions:
    """Numbers of the estimate.

    Attributes
    ----------
    confidence : float
        Probability with which the plant lies within the spread, at each line.
    allowance : float
        Factor on the spread for what the polynomials leave of G; without it 94 % of lines lie
        within a spread of 95 % (`benchmarks/oracle.py closed_loops`).
    weak : float
        Spread over |G| above which a line has too little excitation.
    around : int
        Lines about one over which a share of good ones is taken.
    apart : float
        Relative distance of the lines that are kept; all of them where the record has fewer.
    least_samples : int
        Of a record.
    same_rate : float
        Relative difference of the rates of records, at most.
    repeats : float
        Relative difference of an excitation and itself one period later, at most.
    most_periods : int
        Of a periodic record.
    through : float
        |G_ur| below which an injected force is not in the force.
    drift : float
        Offset between the ends of a record over the range of the position from which it is named.
    alike : float
        Of several channels: least singular value of U over the largest, below which two records
        excite alike.
    """

    confidence: float = 0.95
    allowance: float = 1.1
    weak: float = 1.0
    around: int = 31
    apart: float = 2e-3
    least_samples: int = 256
    same_rate: float = 1e-3
    repeats: float = 1e-6
    most_periods: int = 64
    through: float = 0.5
    drift: float = 0.02
    alike: float = 1e-3


@dataclass(frozen=True)
class PlantEstimate:
    """A plant's response by a record.

    Attributes
    ----------
    hz, G, spread : array (k,)
        Lines in Hz, the response in m/N as the controller sees it, and the radius in m/N within
        which the plant lies with the stated probability.
    coherence : array (k,)
        Share of the power of the position that the excitation explains.
    periods : int
        Whole periods of the excitation in the record; 1: it is not periodic.
    resolution : float
        Hz from line to line of the record.
    weak : array (k,)
        Whether a line has too little excitation: the spread is above |G|.
    through : float
        |G_ur| at the upper half of the coherent lines: 1 if the force contains what is injected,
        0 if it is the controller's alone.
    leakage : array (k,)
        Share of the position's power about a line that the ends of the record explain.
    drift : float
        Offset of the position between the ends of the record over its range.
    """

    hz: Array
    G: np.ndarray
    spread: Array
    coherence: Array
    periods: int
    resolution: float
    weak: np.ndarray
    through: float
    leakage: Array
    drift: float

    @property
    def used(self) -> "PlantEstimate":
        """The estimate without the lines before the first good one, and without those beyond the
        last around which half of the lines are good."""
        good = np.flatnonzero(~self.weak)
        near = uniform_filter1d(1.0 - self.weak, EstimateOptions.around, mode="nearest") >= 0.5
        last = np.flatnonzero(near & ~self.weak)
        if not len(last):
            return self.only(np.zeros(0, int))
        return self.only(np.arange(good[0], last[-1] + 1))

    def only(self, lines: np.ndarray) -> "PlantEstimate":
        """Keep these lines alone."""
        own = ("hz", "G", "spread", "coherence", "weak", "leakage")
        return replace(self, **{name: getattr(self, name)[lines] for name in own})


def estimate_plant(
    series: TimeSeries | Sequence[TimeSeries],
    options: EstimateOptions = EstimateOptions(),
    windows: WindowOptions = WindowOptions(),
) -> PlantEstimate:
    """Estimate the plant's response from records of one plant.

    In open loop the force is the excitation. Several are cut to the length of the shortest; where
    they differ, as with another amplitude, the spread is wider. Raises UserError where a record is
    too short, nothing excites the plant, or rates or periods differ.
    """
    records = [series] if isinstance(series, TimeSeries) else list(series)
    step = records[0].period
    for one in records:
        require_alive(one)
        if abs(one.period / step - 1.0) > options.same_rate:
            rates = f"{1.0 / step:.6g} and {1.0 / one.period:.6g} Hz"
            raise UserError(f"the records have {rates}; give records of one rate")
    shortest = min(len(one.force) for one in records)
    signals = np.array([(one.position[:shortest], one.force[:shortest], one.excitation[:shortest])
                        for one in records], float)  # fmt: skip
    periods = 1
    every = {_period(one[2], options) for one in signals}
    if every != {0}:
        if len(every) > 1:
            raise UserError("the excitations of the records repeat after different times, or one "
                            "does not; give records of one excitation")  # fmt: skip
        period, last = every.pop(), shortest - 1
        begin = max(int(np.argmax(np.abs(np.diff(one[2])) > 0.0)) for one in signals)
        periods = min((last - begin) // period, options.most_periods)
        signals = signals[:, :, last - periods * period :]
    count = signals.shape[2]
    if count < options.least_samples:
        words = f"has {count} samples; a response needs {options.least_samples} or more"
        raise UserError(f"the record {words}")
    ends, positions = max(1, count // 50), signals[:, 0]
    offset = np.abs(positions[:, -ends:].mean(axis=1) - positions[:, :ends].mean(axis=1))
    drift = float((offset / np.ptp(positions, axis=1)).max())
    changes = np.diff(signals, axis=2)
    spectra = np.fft.rfft(changes, axis=2) / np.sqrt(count - 1)
    resolution = 1.0 / ((count - 1) * step)
    lines = kept_lines(spectra.shape[2], periods, options)
    fit = fit_locally(spectra[:, :2], spectra[:, 2], lines, periods, windows)
    with np.errstate(divide="ignore", invalid="ignore"):
        G = fit.G[:, 0] / fit.G[:, 1]
        side = np.stack([np.ones_like(G), -G], axis=1)
        variance = np.einsum("ki,kij,kj->k", side, fit.covariance, side.conj()).real
        variance = variance / np.abs(fit.G[:, 1]) ** 2
        quantile = quantile_of(fit.degrees, options)
        spread = options.allowance * np.sqrt(np.maximum(variance, 0.0) * quantile)
    known = np.isfinite(G) & np.isfinite(spread) & (G != 0.0)
    hz, G, spread = resolution * lines[known], G[known], spread[known]
    coherence = fit.coherence[known].min(axis=1)
    if not len(hz):
        raise UserError("no line of the record is excited enough to part the plant from noise; "
                        "inject more force, or for longer")  # fmt: skip
    weak = spread > options.weak * np.abs(G)
    good = np.flatnonzero(~weak)
    upper = good[len(good) // 2 :]
    through = float(np.median(np.abs(fit.G[known, 1][upper]))) if len(upper) else np.nan
    leakage = fit.transient[known, 0]
    return PlantEstimate(hz, G, spread, coherence, periods, resolution, weak, through, leakage,
                         drift)  # fmt: skip


def quantile_of(degrees: Array, options: EstimateOptions) -> Array:
    """Find the quantile of |e|²/σ² of an error e at the stated confidence, of Fisher's F(2, 2ν).

    `degrees` (k,) are those of freedom behind σ², complex.
    """
    freedom = np.maximum(degrees, 1.0)
    return np.asarray(freedom * ((1.0 - options.confidence) ** (-1.0 / freedom) - 1.0))


def require_alive(series: TimeSeries) -> None:
    """Raise UserError where a signal is constant."""
    if not np.ptp(series.excitation) > 0.0:
        raise UserError("the excitation is constant, so nothing moves the plant; name another "
                        "column (--injected, --reference)")  # fmt: skip
    for name in ("force", "position"):
        if not np.ptp(getattr(series, name)) > 0.0:
            raise UserError(f"the {name} is constant; name another column (--{name})")


def kept_lines(count: int, periods: int, options: EstimateOptions) -> np.ndarray:
    """Find the lines of a transform of `count` lines that are kept.

    With `periods` whole periods of the excitation in it (1: not periodic) these are the excited
    ones, thinned where they are closer than `apart`.
    """
    lines = np.arange(periods, count - 1, periods)
    lines = lines[lines > 1] if periods == 1 else lines
    kept, last = [], 0.0
    for line in lines.tolist():
        if line >= last * (1.0 + options.apart):
            kept.append(line)
            last = float(line)
    return np.array(kept, int)


def _period(excitation: Array, options: EstimateOptions) -> int:
    """Samples after which the excitation repeats itself, at least twice in the record; 0: never."""
    change = np.diff(excitation)
    change = change[int(np.argmax(np.abs(change) > 0.0)) :]
    size = len(change)
    spectrum = np.fft.rfft(change, 2 * size)
    product = np.fft.irfft(np.abs(spectrum) ** 2)[:size]
    squares = np.concatenate([[0.0], np.cumsum(change**2)])
    lags = np.arange(2, size // 2 + 1)
    if not len(lags):
        return 0
    own = squares[size - lags] + (squares[-1] - squares[lags])  # of both parts that are compared
    differs = own - 2.0 * product[lags]
    repeats = np.flatnonzero((differs <= options.repeats * own) & (own > 0.5 * squares[-1]))
    return int(lags[repeats[0]]) if len(repeats) else 0


@dataclass(frozen=True)
class MatrixEstimate:
    """A plant's response by records of several channels."""

    hz: Array  # (k,) lines
    G: np.ndarray  # (k, p, m) unit of y over N
    spread: Array  # (k, p, m) radius of each entry
    coherence: Array  # (k,) the least of all signals and records


def read_channels(
    path: Path, names: SignalNames, forces: Sequence[str], positions: Sequence[str]
) -> list[list[TimeSeries]]:
    """Read a record as one of every force (rows) and every position (columns)."""
    return [[read_record(path, replace(names, force=force, position=position))
             for position in positions] for force in forces]  # fmt: skip


def estimate_channels(
    records: Sequence[list[list[TimeSeries]]], options: EstimateOptions = EstimateOptions()
) -> MatrixEstimate:
    """Estimate the response of all forces to all positions.

    Records are as `read_channels` gives them, at least one a force, of unlike excitations. Raises
    UserError where there are fewer records than forces, two excite alike, or rates and lengths
    differ.
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
    unlike = size[:, m - 1] > options.alike * size[:, 0]
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
    """List what is to be known of an estimate of several channels: subject and words."""
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
