"""The largest bandwidth of a fixed structure on measured responses, without a model.

    max ω_b   s.t.  det(I + GK) winds as a stable loop's does on every response, and on every line
                    |S| <= S_max,  |S| within the shape (`Bounds`),
                    |S(jω_low)| <= S_low,
                    |W_KS KS|, |W_T T| <= weighted_level,  |GS| <= compliance_max

with |M| the largest singular value. Starts and searches are those of models, on `line_problem`; the
judge is `measured_loop.judge`. Of several channels each is designed on its own entry of
Uᵀ G V first, and the search on the whole begins where these are stable together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import cast

import numpy as np

from ccd_casadi.extensions.measured.line_problem import LineProblem, line_problem
from ccd_casadi.extensions.measured.measured_loop import MeasuredFigures, judge
from ccd_casadi.fixed_structure.bounds import Bounds, key_words
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure, Decoupling
from ccd_casadi.fixed_structure.design import DesignOptions, in_problem_units
from ccd_casadi.fixed_structure.local_search import LoopModel, Point, ascend, descend
from ccd_casadi.fixed_structure.loop_problem import Problem
from ccd_casadi.fixed_structure.multi_start import search_from_starts, select_ends
from ccd_casadi.fixed_structure.starts import at_random, by_rules
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Log, silent, with_title
from ccd_casadi.support.text import HZ

NEGATIVE = "K has a negative gain, by the sign of the plant's"
NO_START = "no start is stable by its winding: this structure may not stabilise the plant"
OF_DATA = (
    "; or state its unstable poles (--unstable-poles, unstable_poles) and those at zero "
    "(--poles-at-zero, poles_at_zero), or measure lower lines"
)


@dataclass(frozen=True)
class MeasuredDesign:
    """A controller found on measured lines; SI, frequencies in rad/s."""

    structure: Structure | ChannelStructure
    kappa: Array  # (n,) of |K|
    controller: StateSpace | None  # K(s)
    bandwidth: float  # the judge's
    figures: MeasuredFigures | None  # the judge's
    usable: bool  # whether it is stable, surely so, and within every bound on every line
    words: str  # what is missing
    steps: int
    sign: float = 1.0  # of K: -1 where the plant of one channel has a negative gain

    def __repr__(self) -> str:
        order = "none" if self.controller is None else f"order {len(self.controller.A)}"
        return f"{type(self).__name__}({order}, {self.bandwidth / HZ:.6g} Hz, {self.words!r})"


def design_on_data(
    measured: MeasuredResponse | Sequence[MeasuredResponse],
    structure: Structure | ChannelStructure,
    bounds: Bounds,
    *,
    period: float | None = None,
    starts: int = 12,
    seed: int = 0,
    effort: float | None = None,
    given_up: float = 0.0,
    initial: Array | None = None,
    progress: Log = silent,
    workers: Pool | None = None,
) -> MeasuredDesign:
    """Maximise ω_b over the parameters of a structure, with every bound on every measured line.

    Parameters
    ----------
    measured, structure, bounds : MeasuredResponse or sequence of them, Structure, Bounds
        A structure of one channel on responses of several is that of each channel of
        `static_decoupling`.
    period : float, optional
        s: K is sampled and the responses hold hold and delay, as the controller sees them.
    starts, seed : int
        Of the multi-start search.
    effort : float, optional
        |KS| <= effort/|G|, the mean over the two octaves about ω_b of G's least singular value.
    given_up : float
        Share of the bandwidth that is given in the end for integral gain.
    initial : array (n,), optional
        κ in SI; the only start if it is stable.
    progress, workers : callable, Pool, optional

    Returns
    -------
    MeasuredDesign

    Raises
    ------
    UserError
        Responses of unlike shape or sign, derivatives of a displacement, phases that rise as of no
        causal plant, or lines beyond half the sampling rate.
    """
    responses = [measured] if isinstance(measured, MeasuredResponse) else list(measured)
    shapes = {one.matrix.shape[1:] for one in responses}
    if len(shapes) != 1:
        raise UserError("the measured responses have different numbers of channels; give one kind")
    if period is not None and any(one.hz[-1] > 0.5 / period for one in responses):
        raise UserError("the lines reach beyond half the sampling rate; drop those above")
    if shapes != {(1, 1)} and isinstance(structure, Structure):
        decoupling = static_decoupling(responses[0])
        structure = ChannelStructure(decoupling, (structure,) * len(decoupling.names))
    for one in responses:
        if one.derivative:
            raise UserError(
                f"the measured response is {one.derivative}; G is displacement over force"
            )
        one.require_causal()
        _require_known_gain(one)
    sign = 1.0
    if shapes == {(1, 1)}:
        sign = _sign(responses)
        responses = [replace(one, G=sign * one.G) for one in responses]
    problem = line_problem(responses, structure, bounds, period, DesignOptions.margin, effort)
    again = None if initial is None else np.clip(in_problem_units(problem, initial), *problem.box)
    if again is not None and problem.stable(again):
        pool, spent = [again], 0
    elif isinstance(structure, ChannelStructure):
        pool, spent = _channels_stacked(problem, structure, period, starts, seed, progress, workers)
    else:
        pool, spent = _pool(problem, starts, np.random.default_rng(seed)), 0
    if not len(pool):
        nothing = np.full(len(structure.names), np.nan)
        words = NO_START if all(one.modelled for one in responses) else NO_START + OF_DATA
        return MeasuredDesign(structure, nothing, None, np.nan, None, False, words, spent, sign)
    best: MeasuredDesign | None = None
    for runner in select_ends(search_from_starts(problem, np.array(pool), progress, workers)):
        end = ascend(problem, runner.point, iterations=60, radius=1e-2, restoring=True)
        spent += runner.evaluations + end.evaluations
        kappa = _more_integral(problem, end.point, given_up) if given_up else end.point.kappa
        design = _judge(problem, kappa, period, spent)
        if best is None or design.usable:
            best = design
        if best.usable:
            break
    assert best is not None
    return best if sign > 0.0 else _turn_sign(best)


def _require_known_gain(measured: MeasuredResponse) -> None:
    """Raise UserError where the spread lets G be singular from the first line on: there |L| is
    large, KS is all but G⁻¹, and no such controller is safe."""
    least = np.linalg.norm(measured.matrix, -2, axis=(1, 2))
    known = measured.unsure < least
    if not known[0]:
        first = f"{measured.hz[0]:.4g} Hz"
        next_ = measured.hz[np.argmax(known)] if known.any() else np.inf
        share = measured.unsure[0] / least[0]
        raise UserError(
            f"at the first line, {first}, the spread is {share:.3g} times the least gain, so its "
            f"sign is not known: measure longer there, drop the lines below {next_:.4g} Hz, or "
            "state a factor on the spread (--spread, spread)"
        )


def _sign(responses: Sequence[MeasuredResponse]) -> float:
    """Return the sign of K: with an integrator the closed loop's characteristic polynomial has at 0
    the sign of K G there times -1 for each unstable pole, and has to be positive."""
    signs = {float(np.sign(one.static[0, 0])) * (-1.0) ** one.unstable_poles for one in responses}
    if len(signs - {0.0}) > 1:
        words = "the plants have gains of both signs, which no controller with an integrator holds"
        raise UserError(f"{words}; change the sign of some")
    return -1.0 if -1.0 in signs else 1.0


def _turn_sign(design: MeasuredDesign) -> MeasuredDesign:
    """Turn the sign of K."""
    K, words = design.controller, f"{design.words}; {NEGATIVE}"
    if K is not None:
        K = replace(K, C=-K.C, D=-K.D)
    return replace(design, controller=K, words=words, sign=-1.0)


def _more_integral(problem: LineProblem, point: Point, share: float) -> Array:
    """κ with the largest Π k ω_i = lim sK of the channels at this share of ω_b less.

    ω_b asks for no more of it than S needs; a slow force moves the plant by its inverse.
    """
    parts = [name.endswith(("gain", "integrator")) for name in problem.structure.names]
    slope, floor = -np.array(parts, float), point.tau + float(np.log(1.0 - share))
    model = LoopModel(problem, lambda kappa: (float(slope @ kappa), slope), 0.0, floor)
    begin = model.make_iterate(point.kappa, point.tau, point.assessment)
    if begin is None:
        return point.kappa
    end, _ = descend(model, begin, np.zeros(2 * begin.x.shape), problem.margin)
    return point.kappa if end.violation > problem.margin else end.x[:-1]


def static_decoupling(measured: MeasuredResponse) -> Decoupling:
    """Directions in which a response of several channels moves in its first decade, by falling
    gain: the singular vectors of R in G ~ R (f₁/jf)^n, the mean over the lines."""
    hz = measured.hz
    first = hz <= 10.0 * hz[0]
    turned = measured.matrix[first] * ((1j * hz[first] / hz[0]) ** measured.slope)[:, None, None]
    U, _, Vt = np.linalg.svd(turned.real.mean(axis=0))
    if U.shape != Vt.shape:
        raise UserError("the response has not as many inputs as outputs; leave some out")
    names = tuple(str(i + 1) for i in range(len(U)))
    return Decoupling(names, U, Vt.T)


def _judge(problem: LineProblem, kappa: Array, period: float | None, spent: int) -> MeasuredDesign:
    """The controller at κ with the judge's figures, which may exceed a bound by 1e-5 (rounding)."""
    structure, bounds, plants = problem.structure, problem.bounds, problem.plants
    si = structure.in_units(kappa, plants.omega_0, plants.force)
    K = structure.state_space(si).balance()
    figures = judge(problem.responses, K, bounds, period=period, integrator=structure.integrator)
    shares = bounds.shares(figures).items()
    broken = [f"{key_words(name)} by {100.0 * (ratio - 1.0):.2g} %" for name, ratio in shares
              if figures.stable and not ratio <= 1.0 + 1e-5]  # fmt: skip
    words = figures.words
    if broken:
        words = f"exceeds its bound on {', '.join(broken)}; {words}"
    usable = figures.stable and figures.sure and not broken
    return MeasuredDesign(structure, si, K, figures.bandwidth, figures, usable, words, spent)


def _pool(problem: LineProblem, starts: int, rng: np.random.Generator) -> list[Array]:
    """Half by rules, the fastest, half at random, of those whose winding is a stable loop's."""
    single = cast(Problem, problem)  # of one channel
    crossovers = np.geomspace(1e-4, 1.0, 24)  # over ω₀
    inside = crossovers[2.0 * problem.base[0] < crossovers]
    rules = by_rules(single, inside)[::-1]
    _, first = np.unique(rules, axis=0, return_index=True)  # without notches many are alike
    found = _some(problem, rules[np.sort(first)], max(starts // 2, 1))
    slowest = np.exp(problem.begin(found[0])) if found else inside[0]
    draws = np.exp(rng.uniform(np.log(slowest), np.log(inside[-1]), 12 * starts))
    return found + _some(problem, at_random(single, draws, rng), starts - len(found))


def _some(problem: LineProblem, kappa: Array, most: int) -> list[Array]:
    """The first `most` that are stable."""
    return list(islice(filter(problem.stable, kappa), max(most, 0)))


def _channels_stacked(
    problem: LineProblem,
    structure: ChannelStructure,
    period: float | None,
    starts: int,
    seed: int,
    log: Log,
    workers: Pool | None,
    lines: int = 600,
) -> tuple[list[Array], int]:
    """The channels' designs on `lines` lines as one κ, with ever tighter S_max until it is
    stable."""
    U, V = structure.directions
    spent = 0
    for share in DesignOptions.peak_shares:
        parts = []
        for i in structure.free:
            limits = problem.bounds.of_channel(i)
            limits = replace(limits, S_max=1.0 + share * (limits.S_max - 1.0))
            entries = [one.entry(U[:, i], V[:, i], lines) for one in problem.responses]
            name = structure.decoupling.names[i]
            design = design_on_data(
                entries, structure.structures[i], limits, period=period, starts=starts, seed=seed,
                effort=problem.effort, progress=with_title(log, f"channel {name}"), workers=workers,
            )  # fmt: skip
            spent += design.steps
            parts.append(design.kappa)
        stack = np.concatenate(parts)
        if not np.isfinite(stack).all():
            return [], spent
        kappa = np.clip(in_problem_units(problem, stack), *problem.box)
        if problem.stable(kappa):
            return [kappa], spent
    return [], spent
