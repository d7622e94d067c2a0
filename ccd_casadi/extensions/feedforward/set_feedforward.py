"""Feedforward and shaper of a run's move for every plant of its set.

The model's inverse settles on the model; on the plants beside it what it leaves rings. Here the
coefficients are those with which the latest plant of the set settles at the earliest
(`least_time`), with no more heat and no more peak force than the inverse needs. Plants that are
drawn join the design where they settle later; others, which no step has seen, judge it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.analysis.setpoint_feedforward import forward_of
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.robust_set import members
from ccd_casadi.extensions.feedforward.coefficients import (
    ForceLimits,
    LeastTime,
    LeastTimeOptions,
    MoveResponses,
    Shape,
    contraction,
    learning_gain,
    least_time,
    responses_of,
)
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class FeedforwardSetOptions:
    """Numbers of the design for a set."""

    drawn: int = 200  # plants that are drawn after a design
    added: int = 5  # those of them that join it at most
    rounds: int = 4  # how often
    judges: int = 500  # plants that judge the last design
    tail: float = 3.0  # what is simulated after the setpoint, over its duration
    doublings: int = 4  # of the tail at most, until the model's inverse has settled on every plant
    spreads: tuple[float, ...] = (0.5, 1.0)  # delays of the last tap, in periods of the lowest mode
    worth: float = 0.05  # more taps have to settle earlier by this share


@dataclass(frozen=True)
class SetFeedforward:
    """A feedforward and what it does."""

    found: LeastTime
    inverse: Array  # (c,) the model's inverse as coefficients of one tap
    profile: Setpoint
    window: float  # unit of y
    responses: tuple[MoveResponses, ...]  # of one tap, of the design's plants, the model's first
    settled: Array  # (plants,) when each has settled, s
    settled_inverse: Array  # the same with the inverse
    judged: Array  # (draws,) of the plants that judge; empty where the run has no box to draw from
    judged_inverse: Array  # the same with the inverse
    limits: ForceLimits  # what the inverse needs
    heat: float  # N² s, the largest of all plants, those that judge too
    peak: float  # N, the same
    contraction: float  # ρ of `coefficients`, of the design's plants

    @property
    def latest(self) -> float:
        """The time at which the last plant has settled, s; those that judge count too."""
        return float(max(self.settled.max(), self.judged.max(initial=0.0)))

    @property
    def latest_inverse(self) -> float:
        """The same with the model's inverse."""
        return float(max(self.settled_inverse.max(), self.judged_inverse.max(initial=0.0)))

    @property
    def kept(self) -> int:
        """The number of judging plants that have settled by the time of the design."""
        return int((self.judged <= self.found.time).sum())


def set_feedforward(
    run: FinishedRun,
    profile: Setpoint,
    window: float,
    *,
    axis: int = 0,
    taps: int = 3,
    seed: int = 0,
    options: FeedforwardSetOptions = FeedforwardSetOptions(),
) -> SetFeedforward:
    """Find the feedforward, and at most `taps` taps of the shaper, for the set of a run.

    `profile` is of the output `axis` (from 0), `window` that in which the move has settled, in the
    unit of y; `seed` is of the plants that are drawn. Raises UserError where the loop is
    continuous, or no coefficients settle on all plants.
    """
    model, orders, inverse = _inverse(run, axis)
    plants = [model, *(member.plant.plant_si() for member in members(run, dense=True))]
    one, samples = Shape(orders, model.B.shape[1]), 0
    x = one.join(np.ones(1), inverse[None])
    respond = partial(_responses, run, profile=profile, orders=orders, axis=axis)
    least = window * (1.0 - LeastTimeOptions().margin)  # in which the inverse is a solution, too
    for doubling in range(options.doublings + 1):
        length = profile.duration * (1.0 + options.tail * 2.0**doubling)
        samples = int(np.ceil(length * _rate(run)))
        responses = respond(plants, samples=samples)
        late = np.array([response.settling_time(x, least) for response in responses])
        if (late < 0.75 * length).all():  # no beat comes after it
            break
    limits = ForceLimits(max(item.peak(x) for item in responses),
                         max(item.heat(x) for item in responses))  # fmt: skip
    latest = float(np.minimum(late, length).max())
    found = _best(
        responses, _shapes(run, one, taps, samples, options), x, window, limits, latest, options
    )
    for i in range(options.rounds):
        more = respond(_draw_plants(run, options.drawn, [seed, 1 + i]), samples=samples)
        times = np.array(
            [one.with_taps(found.shape).settling_time(found.x, window) for one in more]
        )
        worst = np.argsort(-times)[: options.added]
        worst = worst[times[worst] > found.time]
        if not worst.size:
            break
        responses += [more[i] for i in worst]
        found = _best(responses, [found.shape], x, window, limits, length, options)
    judges = respond(_draw_plants(run, options.judges, [seed, 0]), samples=samples)

    def times_of(some: Sequence[MoveResponses], shape: Shape, x: Array) -> Array:
        return np.array([each.with_taps(shape).settling_time(x, window) for each in some])

    shaped = [each.with_taps(found.shape) for each in responses]
    everyone = [*shaped, *(each.with_taps(found.shape) for each in judges)]
    gain = learning_gain(shaped[0], found.shape)
    return SetFeedforward(
        found, x, profile, window, tuple(responses),
        times_of(responses, found.shape, found.x), times_of(responses, one, x),
        times_of(judges, found.shape, found.x), times_of(judges, one, x), limits,
        max(each.heat(found.x) for each in everyone), max(each.peak(found.x) for each in everyone),
        contraction(shaped, gain, found.shape),
    )  # fmt: skip


def _rate(run: FinishedRun) -> float:
    sampling = run.loop.sampling
    if sampling is None:
        words = "the loop of this run is continuous; deploy it and give its controller.json"
        raise UserError(f"{run.folder}: {words} by --controller")
    return sampling.rate_hz


def _inverse(run: FinishedRun, axis: int) -> tuple[StateSpace, tuple[int, ...], Array]:
    """The model, the derivatives that its inverse has a force of, and that (5, m)."""
    loop = run.loop
    _rate(run)
    assert loop.sampling is not None
    forward = forward_of(loop.plant, loop.sampling.period, loop.sampling.delay, loop.at)
    F = forward.sum(axis=2) if loop.at else forward[:, :, axis]
    return loop.plant, tuple(np.flatnonzero(F.any(axis=1)).tolist()), F


def _responses(
    run: FinishedRun, plants: Sequence[StateSpace], *, profile: Setpoint,
    orders: tuple[int, ...], axis: int, samples: int,
) -> list[MoveResponses]:  # fmt: skip
    return [responses_of(run.loop_on(plant), profile, orders, axis=axis, samples=samples)
            for plant in plants]  # fmt: skip


def _draw_plants(run: FinishedRun, count: int, seed: list[int]) -> list[StateSpace]:
    """Plants from the box of a run; none where it has none."""
    if not kind_of(run.problem).as_designed:
        return _draw_shifted(run, count, seed)
    uncertain = uncertain_plant(run.problem, run.theta)
    if not uncertain.names and len(uncertain.options) == 1:
        return []
    points = uncertain.drawn(np.random.default_rng(seed), count)
    return [plant.plant_si() for plant in uncertain.plants(points)]


def _draw_shifted(run: FinishedRun, count: int, seed: list[int]) -> list[StateSpace]:
    """Plants from the ranges of resonances and damping of a full-order run."""
    robust, rng = run.problem.robust, np.random.default_rng(seed)
    if robust is None:
        return []
    shifts = rng.uniform(-robust.shift, robust.shift, count).tolist()
    damping = (1.0, *robust.damping)
    factors = rng.uniform(min(damping), max(damping), count).tolist()
    return [scale_plant(run.modal(Perturbation(*at)), run.weights.M_K).plant_si()
            for at in zip(shifts, factors, strict=True)]  # fmt: skip


def _shapes(
    run: FinishedRun, one: Shape, taps: int, samples: int, options: FeedforwardSetOptions
) -> list[Shape]:
    """List the shapes without a shaper, and with the taps spread over parts of a period of the
    lowest resonance, all of them within the samples."""
    modal = run.modal()
    flexible = np.diag(modal.K)[modal.numbered]
    flexible = flexible[flexible > 0.0]
    if taps == 1 or not flexible.size:
        return [one]
    period = 2.0 * np.pi / float(np.sqrt(flexible.min()))
    spacings = [round(share * period * _rate(run) / (taps - 1)) for share in options.spreads]
    within = dict.fromkeys(d for d in spacings if (taps - 1) * d < samples)
    return [one, *(replace(one, taps=taps, spacing=max(d, 1)) for d in within)]


def _best(
    responses: Sequence[MoveResponses], shapes: Sequence[Shape], inverse: Array, window: float,
    limits: ForceLimits, latest: float, options: FeedforwardSetOptions,
) -> LeastTime:  # fmt: skip
    """The earliest of some shapes; one with more taps where it is earlier by its worth."""
    best: LeastTime | None = None
    for shape in shapes:
        h, F = replace(shape, taps=1).split(inverse)
        end = latest if best is None else best.time * (1.0 - options.worth)
        found = least_time(responses, shape, window, limits, end, shape.join(h, F))
        best = found or best
    if best is None:
        raise UserError(
            f"feedforward: no coefficients settle within {window:g} on all plants by "
            f"{1e3 * latest:.4g} ms with the forces of the model's inverse; give a wider --window "
            "or a slower move"
        )
    return best
