"""What `tune` is given: plants as lines of a response, and the controller that runs at present."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.deployment.given_controller import read_controller
from ccd_casadi.extensions.measured.measured_loop import judge
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.lti.frequency_grid import RootOptions, frequency_grid, root_flanks
from ccd_casadi.lti.loop import delay_parts, with_delays, zoh
from ccd_casadi.lti.state_space import StateSpace, balance_system
from ccd_casadi.plants.measured import MeasuredResponse, from_control, read_frequency_response
from ccd_casadi.plants.response_table import lines_in
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import mat_variables
from ccd_casadi.support.terminal import Log
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis import interchange
from ccd_casadi.synthesis.matlab_systems import HINT, appears_discrete, bare

Plant = MeasuredResponse | StateSpace


@dataclass(frozen=True)
class LineOptions:
    """Numbers of the lines on which a model is tuned."""

    per_decade: int = 60  # lines, besides those around roots
    lowest: float = 3e-3  # first line over the slowest root
    highest: float = 0.98  # last line over half the rate
    on_axis: float = 1e-8  # |Re p|/|p| up to which a pole has no damping
    half_width: float = 1e-3  # relative, that such a pole is given for its lines
    hidden: float = 1e-12  # relative singular value of a mode that is not driven, or not measured
    apart: float = 1e-6  # least relative distance of two lines
    at_rest: float = 1e-7  # share of the largest root below which a root lies at 0
    most_samples: int = 1000  # of a delay
    nearby: float = 0.02  # relative distance of the outermost line that is added beside a frequency
    halvings: int = 6  # lines added on each side, each at half the distance of the one before


def read_plant(item: Any, delay: float, log: Log) -> tuple[Plant, float]:
    """A plant as it was given, and what it is behind in s."""
    if isinstance(item, str | Path):
        name, item = Path(item).name, _of_file(Path(item))
        log(f"{name}: {item.words}")
    elif hasattr(item, "frdata"):
        item = from_control(item)
    if isinstance(item, MeasuredResponse):
        return item, delay
    if isinstance(item, interchange.NamedSystem):
        return item.system, delay + item.delay
    found = interchange.from_control(item)
    if not found.period and appears_discrete(found.A):  # 0 is the default of dt
        log(f"warning: {HINT}; give dt in s, or convert with d2c")
    return found, delay


def as_lines(
    item: Plant, rate_hz: float | None, delay: float, *, options: LineOptions = LineOptions()
) -> tuple[MeasuredResponse, StateSpace | None]:
    """The response as the controller sees it; of a model also itself in discrete time."""
    _require_short(item, rate_hz, delay, options)
    if isinstance(item, MeasuredResponse):
        kept = item.hz < (np.inf if rate_hz is None else 0.5 * rate_hz)
        spread = item.spread if item.spread is None else item.spread[kept]
        seen = replace(item, hz=item.hz[kept], G=item.G[kept], spread=spread)
        seen.require_causal()
        lag = np.exp(-1j * HZ * seen.hz * delay)[:, None, None]
        return replace(seen, G=(seen.matrix * lag).reshape(seen.G.shape)), None
    system = item
    own = system.period
    if own and rate_hz is None:
        rate_hz = 1.0 / own
    if rate_hz is None:
        words = "rate_hz is missing: nothing else limits the bandwidth of a controller for a model"
        raise UserError(f"{words}; give the controller's rate (--rate-hz) and its delay (--delay)")
    if system.D.any():
        raise UserError("the plant has feedthrough; give it the lag of its sensor or actuator")
    T = 1.0 / rate_hz
    if not own:
        model = zoh(system, T, delay)
    elif not np.isclose(own, T):
        words = f"the plant is sampled at {1.0 / own:.6g} Hz and the controller at {rate_hz:.6g} Hz"
        raise UserError(f"{words}; give the plant's rate (--rate-hz) or the continuous plant")
    elif not np.isclose(delay_parts(T, delay)[1], 0.0, atol=1e-6 * T):
        words = f"the delay is {delay:.6g} s, {delay / T:.4g} periods of {T:.6g} s, and the plant"
        raise UserError(f"{words} is sampled; give whole periods (--delay) or the continuous plant")
    else:
        whole = delay_parts(T, delay)[0]
        model = with_delays(system.A, [0.0 * system.B] * whole + [system.B], system.C, T)
    _require_seen(system, options)
    top, rates = np.pi / T, system.rates
    rest = np.abs(rates) <= options.at_rest * np.abs(rates).max(initial=0.0)
    zeros = system.rates_of(system.zeros(1.0 if own else top))
    if (np.abs(zeros) <= options.at_rest * top).any():
        raise UserError("the plant has a zero at 0: no controller holds its output at rest")
    roots = np.concatenate([rates[~rest], zeros, [top]])
    low = options.lowest * np.abs(roots[np.abs(roots) > 1e-9 * top]).min()
    roots = _fold(roots, T)
    undamped = np.abs(rates.real) <= options.on_axis * np.abs(rates)
    axis = _fold(rates[undamped & ~rest & (rates.imag > 0.0)], T).imag
    narrow = np.abs(roots.real) <= options.on_axis * np.abs(roots)
    widened = options.half_width * np.abs(roots[narrow]) + 1j * roots[narrow].imag
    beside = root_flanks(widened, [x for x in RootOptions.flanks if x])
    count = int(options.per_decade * np.log10(top / low))
    omega = frequency_grid(low, options.highest * top, count, root_flanks(roots[~narrow]), beside,
                           apart=options.apart)  # fmt: skip
    close = np.abs(omega[:, None] - axis) <= 0.1 * options.half_width * axis
    omega = omega[~close.any(axis=1)]
    unstable = int((rates[~rest & ~undamped].real > 0.0).sum())
    G = model.response(omega)
    one = G.shape[1:] == (1, 1)
    found = MeasuredResponse(omega / HZ, G[:, 0, 0] if one else G, unstable, modelled=True,
                             undamped_hz=tuple((axis / HZ).tolist()))  # fmt: skip
    return found, model


def _require_short(item: Plant, rate_hz: float | None, delay: float, options: LineOptions) -> None:
    """Raise UserError where a delay is not one that a loop can have."""
    if not (np.isfinite(delay) and delay >= 0.0):
        raise UserError(f"delay: is {delay:.6g}; give it in s, 0 or more")
    if isinstance(item, MeasuredResponse):
        rate = rate_hz or 2.0 * float(item.hz[-1])
    else:
        rate = rate_hz or 1.0 / (item.period or np.inf)
    if delay * rate > options.most_samples:
        words = f"delay {delay:.6g} s is {delay * rate:.6g} samples at {rate:.6g} Hz"
        raise UserError(f"{words}: is it in microseconds? give it in s")


def _fold(rates: np.ndarray, T: float) -> np.ndarray:
    """Rates in 1/s with their frequencies where a sampled system has them, up to half the rate."""
    turns = np.abs(rates.imag) * T
    return np.asarray(
        rates.real + 1j * np.abs(turns - 2.0 * np.pi * np.round(turns / (2.0 * np.pi))) / T
    )


def _require_seen(system: StateSpace, options: LineOptions) -> None:
    """Raises UserError where a mode that is not stable is not driven or not measured: Hautus."""
    if not system.B.any() or not system.C.any():
        raise UserError("the plant is 0: no input moves what is measured")
    A, B, C = balance_system(system.A, system.B, system.C)
    size = np.linalg.norm(A, 2) or 1.0
    parts = {"driven by no input": (B * (size / np.linalg.norm(B, 2)), 1),
             "seen at no output": (C * (size / np.linalg.norm(C, 2)), 0)}  # fmt: skip
    rates = np.log(system.poles.astype(complex) + 0j) if system.period else system.poles
    for root, rate in zip(system.poles, rates, strict=True):
        if not rate.real >= -options.on_axis * max(abs(rate), options.at_rest * size):
            continue
        for words, (beside, axis) in parts.items():
            joined = np.concatenate([root * np.eye(len(A)) - A, beside], axis=axis)
            if np.linalg.svd(joined, compute_uv=False)[-1] <= options.hidden * size:
                at = f"{abs(rate) / (system.period or 1.0) / HZ:.4g} Hz"
                raise UserError(f"a mode of the plant at {at} is not stable and {words}: no "
                                "controller changes it; leave it out")  # fmt: skip


def _of_file(path: Path) -> MeasuredResponse | interchange.NamedSystem:
    """A measured response, or the one model of a .mat file."""
    try:
        content = mat_variables(path) if path.suffix.lower() == ".mat" else {}
    except UserError:  # what reads it states why
        content = {}
    structs = any(getattr(value, "dtype", np.dtype(float)).names for value in content.values())
    if lines_in(content) or not (bare(content) or structs):
        return read_frequency_response(path)
    systems = interchange.read_mat(path).systems
    if len(systems) != 1:
        raise UserError(f"{path}: holds the systems {', '.join(systems)}; save one plant a file")
    return next(iter(systems.values()))


def with_lines_near(
    response: MeasuredResponse,
    G: StateSpace,
    omega: list[float],
    *,
    options: LineOptions = LineOptions(),
) -> MeasuredResponse:
    """Add lines where |S| was too large between two, or the bandwidth ends, and nearby."""
    # Closer by halves: what is narrow beside a light resonance of the plant moves with each design.
    offsets = options.nearby * 0.5 ** np.arange(options.halvings)
    nearby = np.concatenate([1.0 - offsets, [1.0], 1.0 + offsets])
    more = (np.array(omega)[:, None] * nearby).ravel() / HZ
    known = response.hz
    hz = frequency_grid(float(known[0]), float(known[-1]), 2, known, more, apart=options.apart)
    axis = np.array(response.undamped_hz)
    hz = hz[~(np.abs(hz[:, None] - axis) <= 0.1 * options.half_width * axis).any(axis=1)]
    return replace(response, hz=hz, G=G.response(HZ * hz).reshape(len(hz), *response.G.shape[1:]))


@dataclass(frozen=True)
class PresentLoop:
    """The loop of the present controller, the worst of several responses."""

    stable: bool  # by the winding on the lines
    bandwidth_hz: float  # first -3 dB of S; NaN where it is not stable, as the next two
    peak: float  # the largest |S| on the lines
    peak_hz: float  # where

    @property
    def words(self) -> str:
        """The present loop in words."""
        if not self.stable:
            return "now not stable by its winding on these lines: is its sign e = r - y to force?"
        peak = f"|S| at most {self.peak:.4g} at {self.peak_hz:.4g} Hz"
        return f"now {self.bandwidth_hz:.4g} Hz, {peak}"


def present_loop(
    path: Path, responses: Sequence[MeasuredResponse], bounds: Bounds, period: float | None
) -> PresentLoop:
    """Judge the controller of a file on responses as they were measured, without their spread.

    The file is as `read_controller` takes it; with a period in s a continuous controller runs by
    Tustin's rule. Raises UserError where it holds no controller of these channels, or one of
    another rate.
    """
    K, _ = read_controller(path)
    outputs, inputs = responses[0].matrix.shape[1:]
    if (len(K.C), K.B.shape[1]) != (inputs, outputs):
        sizes = f"{K.B.shape[1]} inputs and {len(K.C)} outputs"
        raise UserError(f"{path}: has {sizes}; this plant needs {outputs} and {inputs}")
    if K.period and period and not np.isclose(K.period, period):
        raise UserError(f"{path}: runs at {1.0 / K.period:.6g} Hz and the new controller at "
                        f"{1.0 / period:.6g} Hz; give the continuous one")  # fmt: skip
    plain = [replace(one, spread=None) for one in responses]
    found = judge(plain, K, replace(bounds, shape=None), period=None if K.period else period,
                  integrator=_integrates(K))  # fmt: skip
    peak_hz = found.S_peak_frequency / HZ
    return PresentLoop(found.stable, found.bandwidth / HZ, found.S_peak, peak_hz)


def _integrates(K: StateSpace, *, at_rest: float = 1e-6) -> bool:
    """Whether K has a pole at rest: smaller than the fastest by the factor `at_rest`."""
    if not len(K.A):
        return False
    rates = np.abs(K.poles - 1.0) if K.period else np.abs(K.poles)
    return bool(rates.min() <= at_rest * max(float(rates.max()), 1e-300))
