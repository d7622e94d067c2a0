"""The second kind of inner problem: a controller of fixed structure on a set of plants.

    ω_b*(θ) = max ω_b over κ  s.t. on every plant: stable, ‖S‖∞ <= S_max, σ_max(S(jω_low)) <= S_low,
              |S(jω)| <= 1/√2 below ω_b, |S(jω)| <= shape (ω/ω_b)/√2 at every ω, or below ω_b,
              |W_KS KS| and |W_T T| <= weighted_level, |GS| <= compliance_max

Everything is plain values, as in `problem`: it is hashed, sent to workers and kept in the store.
"""

from dataclasses import dataclass, field
from typing import Any

from ccd_casadi.fixed_structure import Sampling, ShapeEnd, Structure
from ccd_casadi.inner_problem.figure import BANDWIDTH, RMS_ERROR, Figure

Options = tuple[tuple[str, object], ...]
Member = tuple[int, tuple[float, ...]]


@dataclass(frozen=True)
class Uncertainty:
    """What may differ from the model; the defaults are: nothing.

    `damping`: least and largest factor. `options`: further option sets of the plant (loads,
    positions), each what differs from the case's own.
    """

    resonance_shift: float = 0.0
    mode_shift: float = 0.0
    damping: tuple[float, float] = (1.0, 1.0)
    gain: float = 0.0
    options: tuple[Options, ...] = ()


@dataclass(frozen=True)
class ChannelProblem:
    """One channel of a plant with several: its structure, and its directions of outputs and inputs
    (None: not given; those that are found at the start hold then for every θ). `like` names the
    channel whose parameters it has. What it keeps besides the whole loop, see `ChannelBounds`:
    `S_max`, `M_K` (None: nothing), and `bandwidth_ratio` times ω_b."""

    name: str
    structure: Structure
    outputs: tuple[float, ...] | None = None
    inputs: tuple[float, ...] | None = None
    like: str | None = None
    S_max: float | None = None
    M_K: float | None = None
    bandwidth_ratio: float = 1.0

    def identity(self) -> dict[str, Any]:
        """Its values; of what came later only those that are not the default."""
        later = {"like": None, "S_max": None, "M_K": None, "bandwidth_ratio": 1.0}
        found = {key: value for key, value in vars(self).items() if value != later.get(key, ...)}
        return found | {"structure": vars(self.structure)}


@dataclass(frozen=True)
class SectionsProblem:
    """Structure, bounds beyond S_max and S_low, hold and delay, the uncertainty, and the search.

    `weighted_level` is of |W_KS KS| and |W_T T|, W_T at the lower end of ω_T; None: no bound, as
    with `shape` and `compliance_max` (m/N). A race of `starts` searches from `seed` finds the
    `anchors` (κ in SI) and the `members` of the plant set (option, point of the box): from these
    on ω_b*(θ) is the best of the climbs from the anchors, on the members, whatever was asked
    before. Both are empty before the race. `frequencies` (rad/s) bound those of K, alike at every
    θ; None: by the plant at the start. `minimise` "rms_error": at a θ the search goes on from there
    to the least RMS error under the problem's budget, at `bandwidth_least` (rad/s) or more, from
    that controller and the `error_anchors` (κ in SI).
    `channels` of a plant with several outputs; where the case names none they are found, with
    `structure` for each.
    """

    structure: Structure = field(default_factory=Structure)
    shape: float | None = 1.1
    shape_ends: ShapeEnd = ShapeEnd.S_MAX
    weighted_level: float | None = None
    compliance_max: float | None = None
    sampling: Sampling | None = None
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    starts: int = 12
    seed: int = 0
    frequencies: tuple[float, float] | None = None
    anchors: tuple[tuple[float, ...], ...] = ()
    members: tuple[Member, ...] = ()
    minimise: str = "bandwidth"
    bandwidth_least: float = 0.0
    channels: tuple[ChannelProblem, ...] = ()
    error_anchors: tuple[tuple[float, ...], ...] = ()

    @property
    def figure(self) -> Figure:
        """What J counts of the controller."""
        return RMS_ERROR if self.of_error else BANDWIDTH

    @property
    def of_error(self) -> bool:
        """Whether the inner problem's value is the least RMS error in m, not ω_b*."""
        return self.minimise == "rms_error"

    def identity(self) -> dict[str, Any]:
        """What determines ω_b*(θ), as plain values."""
        structure, sampling = self.structure, self.sampling
        found: dict[str, Any] = {
            "structure": vars(structure),
            "shape": self.shape,
            "weighted_level": self.weighted_level,
            "compliance_max": self.compliance_max,
            "sampling": None if sampling is None else vars(sampling),
            "uncertainty": vars(self.uncertainty)
            | {"options": [dict(options) for options in self.uncertainty.options]},
            "starts": self.starts,
            "seed": self.seed,
            "frequencies": self.frequencies,
            "anchors": self.anchors,
            "members": self.members,
        }
        if self.shape_ends is not ShapeEnd.CROSSING:  # which stores knew first
            found["shape_ends"] = self.shape_ends.value
        if self.channels:
            found["channels"] = [channel.identity() for channel in self.channels]
        if self.of_error:
            found["least_error"] = [self.bandwidth_least, self.error_anchors]
        return found
