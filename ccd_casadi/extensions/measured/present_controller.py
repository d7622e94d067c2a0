"""The controller that runs at present, judged on the lines that a new one is tuned on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ccd_casadi.deployment.given_controller import read_controller
from ccd_casadi.extensions.measured.measured_loop import judge
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class PresentOptions:
    """Numbers of the reading of a controller.

    Attributes
    ----------
    at_rest : float
        Size of a pole over the fastest below which it is an integrator.
    """

    at_rest: float = 1e-6


@dataclass(frozen=True)
class PresentLoop:
    """The loop of the present controller, the worst of several responses.

    Attributes
    ----------
    stable : bool
        By the winding on the lines.
    bandwidth_hz, peak, peak_hz : float
        First -3 dB of S, the largest |S| on the lines and where; NaN where it is not stable.
    """

    stable: bool
    bandwidth_hz: float
    peak: float
    peak_hz: float

    @property
    def words(self) -> str:
        """In words."""
        if not self.stable:
            return "now not stable by its winding on these lines: is its sign e = r - y to force?"
        peak = f"|S| at most {self.peak:.4g} at {self.peak_hz:.4g} Hz"
        return f"now {self.bandwidth_hz:.4g} Hz, {peak}"


def present_loop(
    path: Path, responses: Sequence[MeasuredResponse], bounds: Bounds, period: float | None,
    options: PresentOptions = PresentOptions(),
) -> PresentLoop:  # fmt: skip
    """Judge the controller of a file on responses as they were measured, without their spread.

    Parameters
    ----------
    path : Path
        As `read_controller` takes it: state space (.json, .mat) or filters (.toml).
    responses, bounds : sequence of MeasuredResponse, Bounds
    period : float or None
        s; a continuous controller runs by Tustin's rule.
    options : PresentOptions

    Returns
    -------
    PresentLoop

    Raises
    ------
    UserError
        The file holds no controller of these channels, or one of another rate.
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
                  integrator=_integrates(K, options))  # fmt: skip
    peak_hz = found.S_peak_frequency / HZ
    return PresentLoop(found.stable, found.bandwidth / HZ, found.S_peak, peak_hz)


def _integrates(K: StateSpace, options: PresentOptions) -> bool:
    """Whether K has a pole at rest."""
    if not len(K.A):
        return False
    rates = np.abs(K.poles - 1.0) if K.period else np.abs(K.poles)
    return bool(rates.min() <= options.at_rest * max(float(rates.max()), 1e-300))
