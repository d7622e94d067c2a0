"""A second engine for a finished loop: SLICOT's norm, beside the package's own kernels and judges.

From the matrices of the plant and of the controller alone the loop is closed once more (`lti`);
its poles decide stability, and ab13dd gives ‖S‖∞ and the norm of the weighted closed loop, without
a grid. Where two engines differ one of them is wrong, so the design is not to be used.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, nan
from typing import Any

import numpy as np
import slycot

from ccd_casadi.lti.frequency_grid import root_flanks
from ccd_casadi.lti.loop import Sampling, in_w, tustin, zoh
from ccd_casadi.lti.norms import gains
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import (
    ClosedLoop,
    StateSpace,
    balance_system,
    closed_loop,
    filter_outputs,
)
from ccd_casadi.support.errors import describe
from ccd_casadi.support.text import plural
from ccd_casadi.synthesis.weights import Weights


@dataclass(frozen=True)
class SecondEngineOptions:
    """Numbers of the comparison with SLICOT."""

    agreement: float = 1e-5  # relative: by how much two engines may differ in a norm
    accuracy: float = 1e-9  # relative, of SLICOT's norm
    rounding: float = 1e-3  # relative: above the gain at its own frequency, its norm contradicts
    # of the inputs: the first of the system as it is, the others of one of norm 1
    scales: tuple[float, ...] = (1.0, 1.0, 0.1, 0.01)
    per_decade: int = 40  # frequencies of a grid
    widths: tuple[float, ...] = (0.06, 4e-3, 2e-4, 1e-5)  # relative: about its peak, refined


@dataclass(frozen=True)
class SecondOpinion:
    """The findings of SLICOT on one loop.

    `norms` by name: "S", ‖S‖∞, "KS", "T", of a continuous loop "GS", and with weights "weighted
    loop"; infinite where the loop is
    not stable, NaN where SLICOT has no answer: `reason` says why. `max_real_pole` in 1/s (sampled:
    ln of the spectral radius over the period).
    """

    stable: bool
    max_real_pole: float
    norms: Mapping[str, float] = field(default_factory=dict)
    reason: str = ""

    def contradictions(self, **claims: float) -> tuple[str, ...]:
        """List the claims of another engine that this one denies: norms by name, `_` for a space.

        A loop that is not stable denies all of them.
        """
        if not self.stable and isfinite(self.max_real_pole):
            return (f"SLICOT finds a pole with real part {self.max_real_pole:.3g}/s",)
        found = []
        for key, claimed in claims.items():
            name, norm = key.replace("_", " "), self.norms.get(key.replace("_", " "), nan)
            if abs(norm - claimed) > SecondEngineOptions().agreement * abs(claimed) or np.isnan(
                claimed
            ):
                found.append(f"SLICOT finds a norm of the {name} of {norm:.8g}, not {claimed:.8g}")
        return tuple(found)


def second_opinion(
    plant: StateSpace,
    controller: StateSpace,
    sampling: Sampling | None = None,
    weights: Weights | None = None,
    places: Sequence[BreakPoint] = (),
) -> SecondOpinion:
    """SLICOT on the loop of a plant (u to y) and a controller K(s) (e = r - y to u), both in SI.

    Parameters
    ----------
    plant, controller : StateSpace
        Continuous, the plant without feedthrough.
    sampling : Sampling, optional
        The plant behind its hold and delay, K by Tustin's rule; then there is no weighted norm.
    weights : Weights, optional
        Those of mixed sensitivity, with their disturbance where they have one.
    places : sequence of BreakPoint
        Of several sensors on one actuator: "S", "T" and "GS" are of the first place, "S of NAME" of
        each.

    Returns
    -------
    SecondOpinion
        Stability and norms.
    """
    try:
        if sampling is None:
            loop = closed_loop(plant, controller)
        else:
            G = zoh(plant, sampling.period, sampling.delay)
            loop = closed_loop(G, tustin(controller, sampling.period))
        poles = np.linalg.eigvals(loop.A)
        rate = float(poles.real.max())
        if loop.period:
            rate = float(np.log(max(float(np.abs(poles).max()), 1e-300))) / loop.period
        if not rate < 0.0:
            return SecondOpinion(False, rate, {"S": inf})
        parts = {"S": loop.S, "KS": loop.KS, "T": loop.T}
        if places:
            whole, loop = loop, places[0].close_loop(loop)
            parts = {"S": loop.S, "KS": whole.KS, "T": loop.T}
            parts |= {f"S of {place.name}": place.close_loop(whole).S for place in places}
        if not loop.period:  # sampled it is a product of functions of z and of s
            parts["GS"] = loop.GS
        norms = {name: _norm(part) for name, part in parts.items()}
        if weights is not None and not loop.period:
            norms["weighted loop"] = _norm(weighted_loop(loop, weights))
    except (slycot.exceptions.SlycotError, np.linalg.LinAlgError, ValueError) as error:
        return SecondOpinion(False, nan, {}, f"SLICOT has no answer ({describe(error)})")
    lost = [name for name, norm in norms.items() if not isfinite(norm)]
    reason = f"SLICOT has no norm of the {' and the '.join(lost)}" if lost else ""
    return SecondOpinion(True, rate, norms, reason)


def weighted_loop(loop: ClosedLoop, weights: Weights) -> StateSpace:
    """r to [W_S e; W_KS u; W_T y], or with a disturbance (r, W_d d) to [W_S e; W_KS u; W_T u/M_K],
    of a continuous loop, a state for each filter of each channel."""
    w, p, m = weights, len(loop.C_y), len(loop.C_u)
    outputs = [(-loop.C_y, np.eye(p)), (loop.C_u, loop.D_u), (loop.C_y, np.zeros((p, p)))]
    if w.disturbance:
        outputs[2] = loop.C_u / w.M_K, loop.D_u / w.M_K
    B, C, D = loop.B_r, np.vstack([C for C, _ in outputs]), np.vstack([D for _, D in outputs])
    if w.disturbance:
        B, D = np.hstack([B, w.disturbance * loop.B_d]), np.hstack([D, np.zeros((len(D), m))])
    rows = np.repeat(w.filters(), [p, m, len(outputs[2][0])], axis=0)
    return filter_outputs(StateSpace(loop.A, B, C, D), rows)


def _norm(system: StateSpace, options: SecondEngineOptions = SecondEngineOptions()) -> float:
    """ab13dd of a stable system, over w where it is in discrete time: the largest of all `scales`.

    Its search may end short of the norm: by 3e-5 of a weighted loop of 128 and 6e-4 of KS in one
    scale of the inputs, by less than 1e-9 in another. So a gain that is met on a grid through the
    poles counts as well: a stiff link left ab13dd up to 0.7 % short. Beside a pole of 5e8 rad/s its
    value was 2e-4 above every gain: within `rounding` the gain at its own frequency counts.

    Balanced beforehand: ab13dd's own scaling left norms of loops of case study 1 7 % off in z, and
    none at all 45 % in w; balanced they agree to 1e-11.
    """
    over = in_w(system) if system.period else system
    A, B, C = balance_system(over.A, over.B, over.C)
    size, named = (len(A), B.shape[1], len(C)), []
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of its own accuracy
        norm = 0.0
        for scale in options.scales:
            one = scale / (norm or 1.0)
            found = slycot.ab13dd("C", "I", "S", "D", *size, A, np.eye(len(A)), one * B, C,
                                  one * over.D, tol=options.accuracy)  # fmt: skip
            norm = float(np.maximum(norm, found[0] / one))  # NaN stays NaN
            named.append(found[1])
    one_system = StateSpace(A, B, C, over.D)
    if isfinite(norm):
        met = float(gains(one_system, np.array(named)).max())
        norm = met if norm <= (1.0 + options.rounding) * met else norm
    poles = np.linalg.eigvals(A)
    low, high = 0.01 * np.abs(poles).min(), 100.0 * np.abs(poles).max()
    count = int(options.per_decade * np.log10(high / low)) + 2
    grid = np.concatenate([np.geomspace(low, high, count), root_flanks(poles)])
    for width in options.widths:
        found = gains(one_system, grid[grid > 0.0])
        best = int(np.argmax(found))
        norm, at = float(np.maximum(norm, found[best])), grid[grid > 0.0][best]
        grid = at * np.linspace(1.0 - width, 1.0 + width, 41)
    return norm


@dataclass(frozen=True)
class EngineComparison:
    """A second engine on the loops of a design.

    Attributes
    ----------
    loops : int
        How many.
    denied, unknown : str
        What it denies, and what it has no answer to, in words.
    """

    loops: int
    denied: str = ""
    unknown: str = ""

    @property
    def agrees(self) -> bool | None:
        """Whether it confirms every loop; None where it has no answer to one."""
        if self.denied:
            return False
        return None if self.unknown or not self.loops else True

    @property
    def words(self) -> str:
        """The comparison in one line."""
        if self.agrees:
            return f"SLICOT agrees on {plural(self.loops, 'loop')}"
        return self.denied or self.unknown or "no loop was given to SLICOT"

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of result.json."""
        return {"engine": "SLICOT ab13dd", "loops": self.loops, "agrees": self.agrees,
                "words": self.words}  # fmt: skip


NOT_COMPARED = EngineComparison(0)


def compare_engines(loops: Iterable[tuple[SecondOpinion, Mapping[str, float]]]) -> EngineComparison:
    """Compare the opinion on each loop with another engine's claims on it.

    Parameters
    ----------
    loops : iterable of (SecondOpinion, mapping)
        Claimed norms by name, see `SecondOpinion.contradictions`.

    Returns
    -------
    EngineComparison
        The first contradiction.
    """
    denied, unknown, count = "", "", 0
    for count, (opinion, claims) in enumerate(loops, 1):
        where = f"on loop {count}: "
        unknown = unknown or (f"{where}{opinion.reason}" if opinion.reason else "")
        found = () if opinion.reason else opinion.contradictions(**claims)
        denied = denied or (f"{where}{found[0]}" if found else "")
    return EngineComparison(count, denied, unknown)
