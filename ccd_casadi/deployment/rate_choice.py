"""At which rate a controller runs."""

from collections.abc import Callable, Sequence
from functools import partial

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.channels import LoopChannel
from ccd_casadi.deployment.discretise import (
    FASTEST,
    Conversion,
    Target,
    loop_at,
    needed_rate,
    nice_rate,
)
from ccd_casadi.deployment.robust_set import Member, WorstFirst
from ccd_casadi.deployment.timing import Timing
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.robust.sampled import SampledFigures, worst_figures
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ


def loops_meet(
    loops: Sequence[tuple[LoopChannel, StateSpace]], target: Target, conversion: Conversion,
    rate: float, timing: Timing, order: WorstFirst,
) -> bool:  # fmt: skip
    """Whether the nominal loop of all channels, each with its controller, meets the target at a
    rate, and those of all members hold it."""
    delay = timing.delay_at(rate)

    def at(member: Member | None = None) -> SampledFigures:
        return worst_figures([
            loop_at((c.plant if member is None else member.seen_by(c)).plant_si(), K, conversion,
                    1.0 / rate, delay)
            for c, K in loops
        ])  # fmt: skip

    return target.met(at()) and order.all(lambda member: target.held(at(member)))


def choose(
    run: FinishedRun, timing: Timing, loops: Sequence[tuple[LoopChannel, StateSpace]],
    target: Target, family: tuple[Member, ...], progress: Callable[[str], None], attempt: int,
    remedy: str,
) -> tuple[Conversion, float | None, float]:  # fmt: skip
    """The conversion, the rate in Hz that it needs (None: no rate will do), and the rate to take.

    Raises UserError where no rate is given and none will do.
    """
    bandwidth_hz = run.figures.bandwidth / HZ
    conversion = Conversion.LEAD if timing.lead else Conversion.RAMP
    again = f", once more for a plant in between ({attempt})" if attempt else ""
    progress(f"rate for {conversion.value}{again}")
    met = partial(loops_meet, loops, target, conversion, timing=timing, order=WorstFirst(family))
    needed = needed_rate(met, bandwidth_hz, () if timing.rate_hz is None else (timing.rate_hz,))
    if timing.rate_hz is not None:
        return conversion, needed, timing.rate_hz
    if needed is None:
        words = f"no sampling rate up to {FASTEST * bandwidth_hz:.3g} Hz keeps S_max to 5 %"
        where = " on all plants of its [robust] set" if family else ""
        raise UserError(
            f"{run.folder}: {words} and omega_b to 3 %{where} with this delay; {remedy}"
        )
    return conversion, needed, nice_rate(needed)
