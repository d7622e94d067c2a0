"""The final judgement of a controller on plants as they were written, or on lines as measured.

What is judged is what runs: the coefficients of the difference equation, in z. Models are closed
with it behind their own hold and delay (`certificate`); on measured lines S is taken from G as the
file has it, and stability from the winding of det(I + GK),

    Z = P + q/2 - Δ/π

with P unstable poles of G, q poles of GK at 0, and Δ the growth of its angle from 0 on. Nothing
that a search has made of the plant takes part. What cannot be judged is unknown: it has not passed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import JudgeOptions, SetCertificate, certify
from ccd_casadi.fixed_structure.certificate_responses import as_run, holds
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.errors import UserError, describe
from ccd_casadi.support.text import HZ, plural

if TYPE_CHECKING:
    from ccd_casadi.plants.measured import MeasuredResponse

ENGINE = "NumPy, on the matrices as the plant function returned them, free bodies free"
AS_GIVEN = "NumPy, on the plants as they were given, with the coefficients of the code"


@dataclass(frozen=True)
class JudgementOptions:
    """Numbers of the final judgement."""

    slower: float = 2e-3  # relative: by how much a claimed bandwidth may be above the judge's
    lowest: float = 1e-6  # of half the rate: from there on K and its code are compared
    frequencies: int = 600  # at which they are compared
    decades: float = 4.0  # below the first line, where G is (jω)^-n
    per_decade: int = 40  # points of these
    unclear: float = 0.9 * np.pi  # rad from line to line: a larger turn may be one backwards


@dataclass(frozen=True)
class Judgement:
    """The final judgement of a controller.

    Attributes
    ----------
    plants : int
        How many were judged.
    figures : mapping
        The largest figures over their bounds, by name.
    passed : bool or None
        None where it could not be judged.
    words, engine : str
        The finding, and what found it.
    """

    plants: int
    figures: Mapping[str, float]
    passed: bool | None
    words: str
    engine: str = field(default=ENGINE, kw_only=True)

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of result.json."""
        return {**vars(self)}


def judgement_of(certificate: SetCertificate, plants: int) -> Judgement:
    """Make the judgement of a certificate.

    Parameters
    ----------
    certificate, plants : SetCertificate, int
        On the plants as they were written, and their number.

    Returns
    -------
    Judgement
    """
    return Judgement(plants, certificate.worst, certificate.passed, certificate.words)


def attempt_judgement(judge: Callable[..., Judgement], *of: Any) -> Judgement:
    """Call a judge and make its failure an unknown judgement.

    Parameters
    ----------
    judge, of : callable, arguments
        Such as `judge_loops`.

    Returns
    -------
    Judgement
        `passed` is None where the judge raised an error of its numbers or input.
    """
    try:
        return judge(*of)
    except (UserError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return Judgement(0, {}, None, f"the judge has no answer: {describe(error)}")


def judge_loops(
    plants: Sequence[StateSpace], controller: StateSpace, coded: StateSpace, bounds: Bounds,
    sampling: Sampling, bandwidth: float, integrator: bool, on_all: bool = True,
    options: JudgementOptions = JudgementOptions(),
) -> Judgement:  # fmt: skip
    """Judge a difference equation on plants: it holds every plant and keeps the bounds.

    Where its response is the controller's, figures are those of the controller: poles that nearly
    coincide cost a level test its digits in the form that is coded. Else what is written is judged:
    where |K| is small, as at half the rate, rounding is a large share of it and moves no bound.

    Parameters
    ----------
    plants : sequence of StateSpace
        Force to displacement, SI; continuous, or in discrete time at the rate of `sampling`.
    controller, coded : StateSpace
        K, e in, u out, SI; the difference equation of the code.
    bounds, sampling, integrator : Bounds, Sampling, bool
        As for `certify`.
    bandwidth, on_all : float, bool
        ω_b that is claimed, rad/s: on each plant, or on the first alone.
    options : JudgementOptions

    Returns
    -------
    Judgement
        With the claimed bandwidth over the judge's among its figures; `code` is the largest
        relative difference of the responses.
    """
    tolerance = JudgeOptions.tolerance
    omega = np.geomspace(options.lowest, 0.999, options.frequencies) * np.pi / sampling.period
    K, own_K = coded.response(omega), as_run(controller, sampling).response(omega)
    off = float((np.linalg.norm(K - own_K, 2, (1, 2)) / np.linalg.norm(own_K, 2, (1, 2))).max())
    same = off <= tolerance
    known = controller if same else coded
    found = certify(plants, known, bounds, sampling, integrator=integrator)
    if not (found.worst and all(holds(plant, coded, sampling) for plant in plants)):
        words = "unstable with the coefficients of the code" if found.worst else found.words
        return Judgement(len(plants), {}, False, words, engine=AS_GIVEN)
    own = found.bandwidth if on_all else found.plants[0].bandwidth
    figures = found.worst | {"bandwidth": bandwidth / own if own > 0.0 else np.inf}
    figures |= {} if same else {"code": off}
    slow = not own >= bandwidth * (1.0 - options.slower)
    words = f"the bandwidth is {own / HZ:.6g} Hz, not {bandwidth / HZ:.6g} Hz"
    words = words if slow and found.passed else found.words
    if not same:
        words += f", judged by the coefficients of the code, {100.0 * off:.2g} % off the controller"
    return Judgement(len(plants), figures, found.passed and not slow, words, engine=AS_GIVEN)


def judge_lines(
    measured: "MeasuredResponse", controller: StateSpace, bounds: Bounds, delay: float,
    bandwidth: float, integrator: bool, options: JudgementOptions = JudgementOptions(),
) -> Judgement:  # fmt: skip
    """A controller, continuous or a difference equation, on a response as its file has it.

    `delay`: in s, besides that in the response; `integrator`: of K, in each channel.
    """
    hz, n = measured.hz, measured.slope
    if controller.period:
        hz = hz[hz < 0.5 / controller.period]
    G, p = measured.matrix[: len(hz)], len(measured.matrix[0])
    count = int(options.decades * options.per_decade)
    below = np.geomspace(10.0**-options.decades, 1.0, count, endpoint=False)
    asymptote = measured.static * ((-1j / below) ** n)[:, None, None]
    omega = HZ * np.concatenate([below * hz[0], hz])
    lag = np.exp(-1j * omega * delay)[:, None, None]
    L = np.concatenate([asymptote, G]) @ controller.response(omega) * lag
    F = np.linalg.det(np.eye(p) + L)
    q = (n + int(integrator)) * p
    half = -0.5 * np.pi * q  # the angle of F at 0, but for half turns
    first = half + np.pi * np.round((np.angle(F[0]) - half) / np.pi)
    turns = np.append(np.angle(F[1:] / F[:-1]), -np.angle(F[-1]))
    unclear, begins = options.unclear, np.angle(F[0])
    if np.abs(turns).max() > unclear or abs(begins - first) > unclear - 0.5 * np.pi:
        words = "the angle of det(I + GK) turns too fast from line to line to be followed"
        return Judgement(1, {}, None, words, engine=AS_GIVEN)
    grown = np.angle(F[0]) - first + turns.sum()
    unstable = round(measured.unstable_poles + 0.5 * q - grown / np.pi)
    if unstable:
        words = f"unstable: {unstable} poles in the right half plane"
        return Judgement(1, {}, False, words, engine=AS_GIVEN)
    of_S = np.linalg.inv(np.eye(p) + L[len(below) :])
    S = np.linalg.norm(of_S, 2, axis=(1, 2))
    if measured.spread is not None:  # all plants within it: ‖S‖/(1 - ‖KS‖ ‖Δ‖)
        of_KS = np.linalg.norm(controller.response(HZ * hz) @ of_S, 2, axis=(1, 2))
        S = S / np.maximum(1.0 - of_KS * measured.unsure[: len(hz)], 1e-12)
    x = np.maximum(HZ * hz, 0.0 if integrator else bounds.omega_low) / bandwidth
    x = x * (1.0 + options.slower)
    room = np.where(x <= 1.0, 1.0 / x, np.inf) if bounds.shape is None else bounds.room(x)
    shares = S / np.minimum(np.sqrt(0.5) * x * room, bounds.S_max)
    figures = {"S_max": float(S.max()) / bounds.S_max, "bandwidth": float(shares.max())}
    broken = [f"{name} by {100.0 * (ratio - 1.0):.2g} %" for name, ratio in figures.items()
              if not ratio <= 1.0 + JudgeOptions.tolerance]  # fmt: skip
    words = f"stable and within every bound on {plural(len(hz), 'line')}"
    if broken:
        words = f"exceeds its bound on {', '.join(broken)}"
    return Judgement(1, figures, not broken, words, engine=AS_GIVEN)


def together(each: Sequence[Judgement]) -> Judgement:
    """Join the judgements of one controller on several plants: passed where it is on all, unknown
    where on one."""
    if len(each) == 1:
        return each[0]
    names = dict.fromkeys(name for one in each for name in one.figures)
    worst = {name: float(np.max([one.figures.get(name, 0.0) for one in each])) for name in names}
    first = next((one for one in each if not one.passed), each[0])
    words = f"of {len(each)} plants: {first.words}"
    passed = False if any(one.passed is False for one in each) else first.passed
    return Judgement(sum(one.plants for one in each), worst, passed, words, engine=AS_GIVEN)
