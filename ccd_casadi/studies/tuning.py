"""`tune`: the fastest PID with notches for plants that exist, measured or modelled.

A model becomes lines, hold and delay exact, and is designed on as a measured response is. At the
end it is a model again: the poles of the sampled loop and ‖S‖∞ by a Hamiltonian matrix decide.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.measured_design import MeasuredDesign, design_on_data
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.grid import frequency_grid, root_flanks
from ccd_casadi.lti.hold import delay_parts, delayed, sampled, tustin
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.measured import MeasuredResponse, from_control, read_frequency_response
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.progress import Tell, silent
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis import interchange

NOTCHES = 3  # at most, where none are asked for
INSIDE = 2e-3  # of S_max - 1: so far inside it the lines of a model are kept
PER_DECADE = 60
BELOW, ABOVE = 3e-3, 0.98  # first line over the slowest root, last line over half the rate
GIVEN_UP = 0.03  # of the bandwidth, for integral gain
ROUNDS = 5  # of adding lines where the loop on the model is worse than on the lines
NEARBY = np.linspace(0.98, 1.02, 9)
APART = 1e-6  # relative, of lines
AT_REST = 1e-7  # of the largest root: below, it lies at 0


@dataclass(frozen=True)
class Tuned:
    """A tuned controller.

    Parameters
    ----------
    case, design : MeasuredCase, MeasuredDesign
        The lines, and the design on them.
    models, norms : tuple of StateSpace, tuple of float
        Plants in discrete time, and ‖S‖∞ of their loops, infinite where poles are not stable.
    """

    case: MeasuredCase
    design: MeasuredDesign
    models: tuple[StateSpace | None, ...]
    norms: tuple[float | None, ...]

    @property
    def controller(self) -> StateSpace | None:
        """K(s) in SI, e = r - y to u; it runs by Tustin's rule."""
        return self.design.controller


def tune(
    plants: Any,
    *,
    rate_hz: float | None = None,
    delay: float = 0.0,
    S_max: float = 1.8,
    shape: float = 1.1,
    effort: float | None = 20.0,
    structure: Structure | None = None,
    starts: int = 24,
    seed: int = 0,
    progress: Tell | None = None,
    workers: Pool | None = None,
) -> Tuned:
    """The largest bandwidth of integrator, lead, notches and a second-order roll-off.

        max ω_b   s.t.  on each plant: stable, |S| <= S_max, |S(jω)| <= (ω/ω_b)/√2 for ω <= ω_b,
                        |S(jω)| within the shape above,   |KS| <= effort/|G| about ω_b

    Parameters
    ----------
    plants : path, MeasuredResponse or system of python-control, or a list of them
        A file as `read_frequency_response` takes it or .mat with A, B, C, D (and Ts), or an FRD, a
        TransferFunction, a StateSpace; of a list one controller for all.
    rate_hz, delay : float
        Of K, Hz (models, stable or not, are held; responses have the hold in them); besides, s.
    S_max, shape, effort : float
        The bounds; `effort` keeps noise and lead in bounds.
    structure : Structure, optional
        Left out, a biquad for each resonance, three at most.
    starts, seed : int
        Of the multi-start search.
    progress, workers
        As for `synthesise_sections`; a pool of processes.

    Returns
    -------
    Tuned
        The design, and its loops on the models.

    Raises
    ------
    UserError
        Something is no such plant, or a model comes without a rate.

    Examples
    --------
    >>> import ccd_casadi as ccd, control
    >>> found = ccd.tune(control.tf([1.0], [1.0, 3.0, 3.0, 1.0]), rate_hz=10.0, starts=2)
    >>> found.design.usable, found.design.structure.biquads
    (True, 0)
    """
    given = list(plants) if isinstance(plants, list | tuple) else [plants]
    if not given:
        raise UserError("there is no plant to tune for; give one")
    read = [_plant(item, rate_hz, delay) for item in given]
    responses = tuple(response for response, _ in read)
    models = tuple(model for _, model in read)
    if structure is None:
        biquads = min(NOTCHES, len(responses[0].resonances))
        structure = Structure(biquads=biquads, least_damping=0.1)
    periods = [model.period for model in models if model is not None]
    period = 1.0 / rate_hz if rate_hz else periods[0] if periods else None
    bounds = Bounds(S_max, S_max, HZ * max(one.hz[0] for one in responses), shape)
    names = [Path(item).name if isinstance(item, str | Path) else "" for item in given]
    name = ", ".join(n or f"plant {i}" for i, n in enumerate(names, 1))
    inside = INSIDE * (S_max - 1.0) if periods else 0.0
    for _ in range(ROUNDS):
        aim = replace(bounds, S_max=S_max - inside)
        design = design_on_data(responses, structure, aim, period=period, starts=starts, seed=seed,
                                effort=effort, given_up=GIVEN_UP, progress=progress or silent,
                                workers=workers)  # fmt: skip
        peaks = [None if G is None else _peak(G, design.controller) for G in models]
        over = [(i, *peak) for i, peak in enumerate(peaks) if peak and not peak[0] <= S_max]
        if not (design.usable and over):
            break
        inside *= 2.0
        responses = tuple(one if G is None else _finer(one, G, [omega for _, _, omega in over])
                          for one, G in zip(responses, models, strict=True))  # fmt: skip
    if design.usable and over:
        words = f"the closed loop with plant {over[0][0] + 1} has ‖S‖∞ = {over[0][1]:.4g}"
        design = replace(design, usable=False, words=f"{words}; {design.words}")
    case = MeasuredCase(Path(name), name, responses, structure, bounds, period, starts)
    return Tuned(case, design, models, tuple(peak and peak[0] for peak in peaks))


def _plant(
    item: Any, rate_hz: float | None, delay: float
) -> tuple[MeasuredResponse, StateSpace | None]:
    """The response as the controller sees it; of a model also itself in discrete time."""
    if isinstance(item, str | Path):
        item = _of_file(Path(item))
    elif hasattr(item, "frdata"):
        item = from_control(item)
    if isinstance(item, MeasuredResponse):
        kept = item.hz < (np.inf if rate_hz is None else 0.5 * rate_hz)
        lag = np.exp(-1j * HZ * item.hz * delay)[:, None, None]
        G = (item.matrix * lag).reshape(item.G.shape)
        spread = item.spread if item.spread is None else item.spread[kept]
        return replace(item, hz=item.hz[kept], G=G[kept], spread=spread), None
    if isinstance(item, interchange.NamedSystem):
        system = item.system
    else:
        system = interchange.from_control(item)
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
        model = sampled(system, T, delay)
    elif not np.isclose(own, T) or not np.isclose(delay_parts(T, delay)[1], 0.0, atol=1e-6 * T):
        raise UserError("a plant in discrete time runs at its rate, and a delay of whole periods")
    else:
        whole = delay_parts(T, delay)[0]
        model = delayed(system.A, [0.0 * system.B] * whole + [system.B], system.C, T)
    top, rates = np.pi / T, system.rates
    rest = np.abs(rates) <= AT_REST * np.abs(rates).max(initial=0.0)
    zeros = system.rates_of(system.zeros(1.0 if own else top))
    if (np.abs(zeros) <= AT_REST * top).any():
        raise UserError("the plant has a zero at 0: no controller holds its output at rest")
    roots = np.concatenate([rates[~rest], zeros, [top]])
    low = BELOW * np.abs(roots[np.abs(roots) > 1e-9 * top]).min()
    omega = frequency_grid(low, ABOVE * top, int(PER_DECADE * np.log10(top / low)),
                           root_flanks(roots), apart=APART)  # fmt: skip
    unstable = int((rates[~rest].real > 0.0).sum())
    G = model.response(omega)
    one = G.shape[1:] == (1, 1)
    found = MeasuredResponse(omega / HZ, G[:, 0, 0] if one else G, unstable, modelled=True)
    return found, model


def _of_file(path: Path) -> MeasuredResponse | interchange.NamedSystem:
    """A measured response, or the one model of a .mat file."""
    try:
        variables = scipy.io.whosmat(path) if path.suffix.lower() == ".mat" else []
    except Exception:  # a damaged file: what reads it says so
        variables = []
    names = {name for name, _, _ in variables}
    if not ({"A", "B", "C"} <= names or any(kind == "struct" for _, _, kind in variables)):
        return read_frequency_response(path)
    systems = interchange.read_mat(path).systems
    if len(systems) != 1:
        raise UserError(f"{path}: holds the systems {', '.join(systems)}; save one plant a file")
    return next(iter(systems.values()))


def _peak(G: StateSpace, K: StateSpace | None) -> tuple[float, float]:
    """‖S‖∞ of the sampled loop and its ω in rad/s; infinite where it is not stable."""
    if K is None:
        return np.inf, np.nan
    return hinf_norm(closed_loop(G, tustin(K, G.period)).S)


def _finer(response: MeasuredResponse, G: StateSpace, omega: list[float]) -> MeasuredResponse:
    """With lines where |S| was too large between two, and nearby."""
    more = (np.array(omega)[:, None] * NEARBY).ravel() / HZ
    known = response.hz
    hz = frequency_grid(float(known[0]), float(known[-1]), 2, known, more, apart=APART)
    return replace(response, hz=hz, G=G.response(HZ * hz).reshape(len(hz), *response.G.shape[1:]))
