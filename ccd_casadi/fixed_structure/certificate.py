"""The judge of a controller on a set of plants; it shares nothing with the synthesis.

Of plants with several inputs and outputs the whole loop is judged, by largest singular values.

From the SI matrices of K and of every plant: the closed loop is rebuilt, its eigenvalues decide
stability; S, KS, T and GS are evaluated (`certificate_responses`) on grids through every pole and
zero of plant, controller and closed loop (`certificate_curves`), those of many plants at once. Of
every figure the largest gain is confirmed by a Hamiltonian matrix (`norms`, `_raise_tops`). A
sampled loop is judged in z, its hold and delay exact, K by Tustin's rule (S between the samples:
`lti.norms`). Its GS and weighted KS and T are products of functions of z and of s, which
no Hamiltonian is of: they are known on the grid (`grid_only`), and where a proof has them between.
GS of a wired plant is S times its mechanics, of a force on these, and known there too; where
forces act elsewhere or something else counts it is theirs, of a continuous loop by its states.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import matrix_balance

from ccd_casadi.fixed_structure.bounds import (
    Bounds,
    BrokenAt,
    ChannelBounds,
    ChannelPeaks,
    LoopPeaks,
    key_words,
    kind_and_channel,
)
from ccd_casadi.fixed_structure.certificate_curves import (
    CurveOptions,
    crossing_and_bandwidth,
    grid_through,
    pad,
    peaks,
    with_crossings,
)
from ccd_casadi.fixed_structure.certificate_responses import (
    LoopResponses,
    LoopsAsRun,
    balanced_system,
    error_response,
    loops_as_run,
    norms,
)
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, filter_outputs, strictly_proper
from ccd_casadi.lti.wiring import ForcedPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.text import HZ, plural
from ccd_casadi.support.worker_process import one_blas_thread

if TYPE_CHECKING:
    from ccd_casadi.plants.scaling import ScaledPlant


@dataclass(frozen=True)
class JudgeOptions:
    """Numbers of the judge.

    Attributes
    ----------
    tolerance : float
        Relative: by how much a figure may exceed its bound and count as met.
    batch : int
        Plants of one task: the last ones keep all workers busy.
    rounding : float
        Of a balanced matrix; poles showed 31 eps.
    half_widths : float
        To either side of a resonance beyond half the rate.
    points : int
        Of the grid there.
    rest : tuple of float
        Shares of the grid's lowest frequency: the least that keeps its digits counts as 0 Hz.
    lost : float
        Relative: rounding of S there, at most.
    curves : CurveOptions
    """

    tolerance: float = 1e-5
    batch: int = 16
    rounding: float = 1e3 * float(np.finfo(float).eps)
    half_widths: float = 3.0
    points: int = 240
    rest: tuple[float, ...] = (0.5, 0.1, 0.01, 1e-3)
    lost: float = 1e-7
    curves: CurveOptions = field(default_factory=CurveOptions)


@dataclass(frozen=True)
class ChannelFigures(ChannelPeaks):
    """One channel's; `bandwidth`: the largest ω_i that the shape allows it."""

    name: str


@dataclass(frozen=True)
class PlantFigures(LoopPeaks):
    """One plant's loop in SI; NaN where it is unstable.

    Attributes
    ----------
    stable : bool
    stability : float
        The largest real part of a pole in 1/s; sampled the spectral radius less 1.
    crossing, bandwidth : float
        The first -3 dB of S, and the largest ω_b that the shape allows, rad/s.
    static_compliance, low_compliance : float
        GS towards 0 Hz, 0 with an integrator; at ω_low, m/N.
    GS_beyond : float
        rad/s of a resonance beyond half the rate where |GS| is largest; 0: it is below.
    confirmed : bool
        S's peaks by Hamiltonians.
    channels : tuple of ChannelFigures
        As those of the bounds.
    """

    stable: bool
    stability: float
    crossing: float = np.nan
    static_compliance: float = np.nan
    low_compliance: float = np.nan
    GS_beyond: float = 0.0
    confirmed: bool = False
    channels: tuple[ChannelFigures, ...] = ()


@dataclass(frozen=True)
class SetCertificate:
    """The judgement of a controller on every plant.

    Attributes
    ----------
    passed : bool
        Whether all bounds hold.
    bandwidth : float
        The least, rad/s.
    plants : tuple of PlantFigures
    worst : dict
        The largest figure over its bound, by name.
    words : str
    grid_only : tuple of str
        Names of `worst` that no level test is of.
    """

    passed: bool
    bandwidth: float
    plants: tuple[PlantFigures, ...]
    worst: dict[str, float]
    words: str
    grid_only: tuple[str, ...] = ()  # names of `worst` that no level test is of


@one_blas_thread
def certify(
    plants: "Sequence[ScaledPlant | StateSpace]",
    controller: StateSpace,
    bounds: Bounds,
    sampling: Sampling | None = None,
    *,
    integrator: bool = True,
    workers: Pool | None = None,
    options: JudgeOptions = JudgeOptions(),
) -> SetCertificate:
    """Judge an SI controller on plants against the bounds, σ_max of each matrix.

    Parameters
    ----------
    plants, controller : sequence of ScaledPlant or StateSpace, StateSpace
        All of the set, force to displacement, SI; e in, u out. In discrete time, at the rate of
        `sampling`, they run as they are; a plant is then delayed by whole periods.
    bounds, integrator : Bounds, bool
        With the bounds of single channels. The shape counts from 0 on, or from ω_low.
    sampling, workers : Sampling, Pool, optional
        None: a continuous loop; the plants are spread over them.
    options : JudgeOptions

    Returns
    -------
    SetCertificate
        Stability, figures over bounds, and ω_b in rad/s, the least of all plants.
    """
    systems = [own if isinstance(own, StateSpace) else own.plant_si() for own in plants]
    bare = any(isinstance(G, ForcedPlant) and not _same_states(G) for G in systems)
    sizes = [(G.A.shape, G.B.shape, G.C.shape) for G in systems]
    alike = [[i for i, own in enumerate(sizes) if own == size] for size in dict.fromkeys(sizes)]
    batch = options.batch
    parts = [same[i : i + batch] for same in alike for i in range(0, len(same), batch)]
    tasks = {
        tuple(part): ([systems[i] for i in part], controller, bounds, sampling, integrator, options)
        for part in parts
    }
    each: dict[int, PlantFigures] = {}
    for part, figures_of in results(workers, judge_plants, tasks):
        each |= zip(part, figures_of, strict=True)
    found = [each[i] for i in range(len(systems))]
    unstable = [i for i, figures in enumerate(found, 1) if not figures.stable]
    if unstable:
        words = f"unstable on plant {unstable[0]} of {len(found)}"
        return SetCertificate(False, np.nan, tuple(found), {}, words)
    bandwidth = float(np.min([figures.bandwidth for figures in found]))
    worst: dict[str, float] = {}
    for figures in found:
        shares = bounds.shares(figures) | bounds.channel_shares(figures.channels)
        for name, ratio in shares.items():
            worst[name] = float(np.maximum(worst.get(name, 0.0), ratio))  # NaN stays NaN
    broken = [f"{key_words(name)} by {100.0 * (ratio - 1.0):.2g} %" for name, ratio in worst.items()
              if not ratio <= 1.0 + options.tolerance]  # fmt: skip
    lost = [i for i, figures in enumerate(found, 1) if not figures.confirmed]
    if broken:
        words = f"exceeds its bound on {', '.join(broken)}"
        beyond = max(found, key=lambda figures: figures.GS).GS_beyond
        if beyond and not worst.get("GS", 0.0) <= 1.0 + options.tolerance:
            words += (f"; |GS| is largest at {beyond / HZ:.4g} Hz, at a resonance beyond half the "
                      "sampling rate, which the search does not see: raise the rate, or damp that "
                      "resonance")  # fmt: skip
    elif not bandwidth > 0.0:
        words = "S does not start below -3 dB on every plant"
    elif lost:
        words = f"the peak of S on plant {lost[0]} is not confirmed by the level test"
    else:
        words = f"stable and within every bound on {plural(len(found), 'plant')}"
    passed = not broken and not lost and bandwidth > 0.0
    products = ("KS", "T", "GS") if sampling is not None else ("GS",) if bare else ()
    untested = tuple(name for name in worst if kind_and_channel(name)[0] in products)
    return SetCertificate(passed, bandwidth, tuple(found), worst, words, untested)


def judge_plants(
    plants: Sequence[StateSpace],
    controller: StateSpace,
    bounds: Bounds,
    sampling: Sampling | None,
    integrator: bool,
    options: JudgeOptions = JudgeOptions(),
) -> list[PlantFigures]:
    """Judge the loop of every plant; the plants have matrices of one size.

    1. The loops are rebuilt, and their eigenvalues decide stability (`loops_as_run`).
    2. Of stable ones S, KS, T and GS are evaluated on a grid through their poles and zeros.
    3. Every peak is refined between its neighbours, and raised to what a Hamiltonian finds.

    Parameters
    ----------
    plants, controller : sequence of StateSpace, StateSpace
        SI.
    bounds, sampling, integrator : Bounds, Sampling or None, bool
        As of `certify`.
    options : JudgeOptions

    Returns
    -------
    list of PlantFigures
    """
    every = loops_as_run(plants, controller, sampling)
    growth = every.growth
    # A pole as close to the axis as rounding may move it may lie on it. Eigenvalues
    # are those of the balanced matrix: a large gain of K does not move them in proportion.
    sizes = [np.linalg.norm(matrix_balance(S.A)[0]) for S in every.S]
    good = [i for i, size in enumerate(sizes) if growth[i] < -options.rounding * size]
    found = [PlantFigures(False, one) for one in growth]
    if good:
        given = [plants[i] for i in good]
        figures = _compute_figures(every.only(good), given, bounds, integrator, options)
        for i, own in zip(good, figures, strict=True):
            found[i] = own
    return found


def _grid_of(loops: LoopsAsRun, bounds: Bounds, options: JudgeOptions) -> Array:
    """The frequencies (P, k) through the poles and zeros of every loop, rad/s."""
    corner, K = 0.0, loops.controller
    if (w := bounds.weights) is not None:
        corner = max(w.c_K * w.omega_K, w.omega_T / w.A_u)
    of_K, zeros = np.linalg.eigvals(loops.K.A), [] if K.D.any() or K.period else [K.zeros(_size(K))]
    grids = []
    for own, G, poles in zip(loops.plants, loops.G, loops.poles, strict=True):
        nulls = own.rates_of(own.zeros(_size(own)))
        roots = [poles, np.linalg.eigvals(G.A), of_K, nulls, *zeros]
        grids.append(
            grid_through(
                roots, loops.sampling, bounds.omega_low, _size(own), corner, options.curves
            )
        )
    return pad(grids)


def _compute_figures(
    loops: LoopsAsRun, given: Sequence[StateSpace], bounds: Bounds, integrator: bool,
    options: JudgeOptions,
) -> list[PlantFigures]:  # fmt: skip
    """The figures of stable loops; `given` has the plants as they were."""
    grid, rows = _grid_of(loops, bounds, options), np.arange(len(given))
    table = LoopResponses(loops.free, loops.G, loops.K, loops.sampling, bounds, integrator,
                          loops.driven)  # fmt: skip
    if not integrator:
        grid = np.concatenate([_at_rest(table, grid[:, :1], options), grid], axis=1)
    if len(given[0].C) > 1 and bounds.error is None:
        grid, values = with_crossings(table, grid, options.curves)
    else:
        values = table.at(rows, grid)
    low = table.at(rows, np.full((len(rows), 1), bounds.omega_low))
    tops, beyond = _find_tops(loops, given, bounds, table, grid, values, options)
    crossing, bandwidth = crossing_and_bandwidth(table, grid, values["S"], options=options.curves)
    whole = loops.S
    if bounds.error is not None:
        whole = [_entry(bounds.channels[bounds.error], S) for S in loops.S]
    norm, confirmed = norms(whole, table.period, *tops["S"])
    channels: list[tuple[ChannelFigures, ...]] = [() for _ in rows]
    for one in bounds.channels:
        broken = loops.S
        if one.place is BrokenAt.ACTUATOR:
            broken = [_at_the_actuator(S, G, loops.K)
                      for S, G in zip(loops.S, loops.G, strict=True)]  # fmt: skip
        found, certain = _rows(one, broken, table, grid, values, tops, options.curves)
        channels = [(*own, figures) for own, figures in zip(channels, found, strict=True)]
        if one.bandwidth_ratio > 1.0:
            share = np.array([figures.bandwidth for figures in found]) / one.bandwidth_ratio
            bandwidth = np.fmin(bandwidth, share)  # NaN where the channel has none
        confirmed &= certain
    missing = np.full(len(rows), np.nan)
    weighted = [tops.get(name, (missing, missing))[0] for name in ("weighted KS", "weighted T")]
    return [
        PlantFigures(
            stable=True,
            stability=loops.growth[k],
            S_peak=float(norm[k]),
            S_peak_frequency=float(tops["S"][1][k]),
            S_low=float(low["S"][k, 0]),
            crossing=float(crossing[k]),
            bandwidth=float(bandwidth[k]),
            KS=float(tops["KS"][0][k]),
            T=float(tops["T"][0][k]),
            GS=float(tops["GS"][0][k]),
            GS_beyond=float(beyond[k]),
            weighted_KS=float(weighted[0][k]),
            weighted_T=float(weighted[1][k]),
            # A channel with an integrator beside one without has a pole at 0 Hz: the limit there.
            static_compliance=0.0 if integrator and not loops.driven else float(values["GS"][k, 0]),
            low_compliance=float(low["GS"][k, 0]),
            confirmed=bool(confirmed[k]),
            channels=channels[k],
        )
        for k in rows
    ]


def _find_tops(
    loops: LoopsAsRun, given: Sequence[StateSpace], bounds: Bounds, table: LoopResponses,
    grid: Array, values: dict[str, Array], options: JudgeOptions,
) -> tuple[dict[str, tuple[Array, Array]], Array]:  # fmt: skip
    """The largest of every gain and its ω (P,) by name, and the ω beyond half the rate at which a
    force moves most (P,), else 0."""
    tops, beyond_half_the_rate = peaks(table, grid, values, options.curves), np.zeros(len(given))
    if table.period is not None and table.free is not None and bounds.compliance_max is not None:
        beyond, at = _compliance_beyond(table, loops.free, options)
        larger = beyond > tops["GS"][0]
        tops["GS"] = np.where(larger, beyond, tops["GS"][0]), tops["GS"][1]
        beyond_half_the_rate = np.where(larger, at, 0.0)
    for k, (S, G, plant) in enumerate(zip(loops.S, loops.G, given, strict=True)):
        _raise_tops(tops, k, S, G, loops.K, bounds, table, plant)
    return tops, beyond_half_the_rate


def _at_rest(table: LoopResponses, lowest: Array, options: JudgeOptions) -> Array:
    """The frequency (P, 1) that counts as 0 Hz of every plant, below its `lowest` (P, 1), rad/s.

    Rounding of L of a size ‖L‖ changes S = (I + L)⁻¹ by S δL S, so by eps ‖L‖/(1 + σ_min(L)) of
    itself: without an integrator beside channels of free bodies, whose |L| grows without bound,
    nothing would be left of it at too low a frequency.
    """
    shares, rows = np.sort(options.rest), np.arange(len(lowest))
    sizes = table.open_loops(rows, lowest * shares)
    lost = sizes[..., -1] / (1.0 + sizes[..., 0]) + table.lost(rows, lowest * shares)
    kept = np.finfo(float).eps * lost <= options.lost
    first = np.where(kept.any(axis=1), kept.argmax(axis=1), len(shares) - 1)
    return np.asarray(lowest * shares[first][:, None])


def _raise_tops(
    tops: dict[str, tuple[Array, Array]], row: int, loop: StateSpace, G: StateSpace,
    K: StateSpace, bounds: Bounds, table: LoopResponses, plant: StateSpace,
) -> None:  # fmt: skip
    """Raise the largest KS, T and GS of plant `row`, weighted or not, to what a Hamiltonian finds
    above them; `loop` is its S. Of a sampled loop KS and T alone; no GS of a wired plant, and that
    of forces and errors elsewhere by the states of the `plant` as it was given."""
    period = table.period
    zero, p = np.zeros((len(G.C), len(K.A))), len(G.C)
    of_u, of_y = np.hstack([-K.D @ G.C, K.C]), np.hstack([G.C, zero])
    KS = StateSpace(loop.A, loop.B, of_u, K.D)
    T = StateSpace(loop.A, loop.B, of_y, np.zeros((p, p)))
    if bounds.error is not None:
        counts = bounds.channels[bounds.error]
        T, of_y = _entry(counts, T), np.array([counts.output]) @ of_y
        p = 1
    systems = {"KS": KS, "T": T}
    if period is None:
        d = np.vstack([G.B, np.zeros((len(K.A), G.B.shape[1]))])
        if table.free is None:
            systems["GS"] = StateSpace(loop.A, d, of_y, np.zeros((p, d.shape[1])))
        elif _same_states(plant):
            systems["GS"] = _moved(plant, K)
        if bounds.weights is not None:
            _, of_KS, of_T = bounds.weights.filters()
            systems["weighted KS"] = filter_outputs(KS, np.tile(of_KS, (len(K.C), 1)))
            of_T[1] *= bounds.weights.delta or 1.0
            systems["weighted T"] = filter_outputs(T, np.tile(of_T, (p, 1)))
            for own in bounds.channels:
                if own.M_K is not None:
                    one = np.array([own.force]) * (bounds.weights.M_K / own.M_K)
                    row_u = StateSpace(loop.A, loop.B, one @ of_u, one @ K.D)
                    systems[f"weighted KS of {own.name}"] = filter_outputs(row_u, of_KS[None])
    for name, system in systems.items():
        value, at = tops[name]
        norm, place = hinf_norm(replace(system, period=period or 0.0), at[row])
        if not norm <= value[row]:  # NaN stays NaN
            value[row], at[row] = norm, place


def _same_states(plant: StateSpace) -> bool:
    """Whether disturbing forces move a plant by the states that u does."""
    return isinstance(plant, ForcedPlant) and np.array_equal(plant.mechanics.A, plant.A)


def _moved(plant: StateSpace, K: StateSpace) -> StateSpace:
    """Disturbing forces to what counts, of a continuous loop."""
    assert isinstance(plant, ForcedPlant)
    A, own, k = error_response(plant, K).A, plant.mechanics, len(K.A)
    C = own.C if plant.counted is None else own.C[len(plant.C) :]
    B, C = np.vstack([own.B, np.zeros((k, own.B.shape[1]))]), np.hstack([C, np.zeros((len(C), k))])
    return balanced_system(strictly_proper(A, B, C))


def _compliance_beyond(
    table: LoopResponses, plants: Sequence[StateSpace], options: JudgeOptions
) -> tuple[Array, Array]:
    """|S G| of every plant (P,) beyond half the rate, at its resonances there, and their ω: a force
    of such a frequency moves it by G, and its samples are those of a slower one."""
    found, at = np.zeros(len(plants)), np.zeros(len(plants))
    for i, G in enumerate(plants):
        poles = np.linalg.eigvals(G.A)
        for p in poles[poles.imag > np.pi / (table.period or np.inf)]:
            width = options.half_widths
            around = p.imag + abs(p.real) * np.linspace(-width, width, options.points + 1)
            most = float(table.at(np.array([i]), around[None])["GS"].max())
            if not most <= found[i]:  # NaN stays NaN
                found[i], at[i] = most, p.imag
    return found, at


def _rows(
    bounds: ChannelBounds,
    loops: Sequence[StateSpace],
    table: LoopResponses,
    grid: Array,
    values: dict[str, Array],
    tops: dict[str, tuple[Array, Array]],
    options: CurveOptions,
) -> tuple[list[ChannelFigures], np.ndarray]:
    """The figures of one channel's row on every plant, and whether its peak is confirmed."""
    if not bounds.given:
        return [ChannelFigures(bounds.name)] * len(grid), np.ones(len(grid), bool)
    curve, u = f"S of {bounds.name}", np.array([bounds.output])
    missing = np.full(len(grid), np.nan)
    if bounds.place is BrokenAt.WHOLE:
        rows = [StateSpace(S.A, S.B, u @ S.C, u @ S.D) for S in loops]
        _, bandwidth = crossing_and_bandwidth(table, grid, values[curve], bounds.output, options)
    else:  # ω_b is of the one whose error counts
        rows, bandwidth = [_entry(bounds, S) for S in loops], missing
    norm, confirmed = norms(rows, table.period, *tops[curve])
    weighted = tops.get(f"weighted KS of {bounds.name}", (missing, missing))[0]
    columns = np.stack([norm, tops[curve][1], bandwidth, weighted], axis=1).tolist()
    names = ("S_peak", "S_peak_frequency", "bandwidth", "weighted_KS")
    found = [ChannelFigures(bounds.name, **dict(zip(names, row, strict=True))) for row in columns]
    return found, confirmed


def _entry(bounds: ChannelBounds, loop: StateSpace) -> StateSpace:
    """uᵀ S r of a sensor or wᵀ S w of an actuator, of what `loop` has of S."""
    at_sensor = bounds.place is BrokenAt.SENSOR
    left, right = (bounds.output, bounds.reference) if at_sensor else (bounds.force, bounds.force)
    row, column = np.array([left]), np.array([right]).T
    return StateSpace(loop.A, loop.B @ column, row @ loop.C, row @ loop.D @ column)


def _at_the_actuator(loop: StateSpace, G: StateSpace, K: StateSpace) -> StateSpace:
    """(I + KG)⁻¹, a force beside K's to their sum, in the states of S."""
    m = G.B.shape[1]
    B = np.vstack([G.B, np.zeros((len(K.A), m))])
    return StateSpace(loop.A, B, np.hstack([-K.D @ G.C, K.C]), np.eye(m))


def _size(system: StateSpace) -> float:
    return float(np.abs(np.linalg.eigvals(system.A)).max()) or 1.0  # of a free body alone
