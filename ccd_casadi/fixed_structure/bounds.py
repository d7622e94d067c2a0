"""What a loop has to keep on every plant of a set."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import log, nan

import numpy as np

from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.weights import Weights

# Rows of a loop's bounds, as a reader knows them: by keys of a case.
BINDS = {
    "S_MAX": "S_max",
    "SHAPE": "shape",
    "LEVEL": "|S| below omega_b",
    "S_LOW": "S_low",
    "KS": "weighted_level of KS",
    "T": "weighted_level of T",
    "GS": "compliance_max",
}
WORDS = {**BINDS, "CROSSING": "|S| at omega_b"}  # that row defines ω_b and is not a bound of a case


def kind_and_channel(name: str) -> tuple[str, str]:
    """Split a multiplier's name.

    Parameters
    ----------
    name : str
        A kind of bound, or "kind of channel".

    Returns
    -------
    kind, channel : str
        The channel is empty where the bound is the whole loop's.

    >>> kind_and_channel("S_MAX"), kind_and_channel("S_MAX of tilt")
    (('S_MAX', ''), ('S_MAX', 'tilt'))
    """
    kind, _, channel = name.partition(" of ")
    return kind, channel


def key_words(name: str) -> str:
    """Name a bound by its key of a case file.

    Parameters
    ----------
    name : str
        As for `kind_and_channel`, or the name of a figure over its bound.

    Returns
    -------
    str

    >>> key_words("CROSSING"), key_words("S_MAX of tilt")
    ('|S| at omega_b', 'S_max of channel tilt')
    """
    kind, channel = kind_and_channel(name)
    return WORDS.get(kind, kind) + (f" of channel {channel}" if channel else "")


@dataclass(frozen=True, kw_only=True)
class ChannelPeaks:
    """The figures that are held against a channel's own bounds; NaN where unknown.

    Attributes
    ----------
    S_peak, S_peak_frequency : float
        The largest value of its row of S, uᵀS, over frequency, and where, rad/s.
    bandwidth : float
        rad/s.
    weighted_KS : float
        The largest value of KS with its own M_K.
    """

    S_peak: float = nan
    S_peak_frequency: float = nan
    bandwidth: float = nan
    weighted_KS: float = nan


@dataclass(frozen=True, kw_only=True)
class LoopPeaks(ChannelPeaks):
    """The same of a whole loop: largest singular values.

    Attributes
    ----------
    S_low : float
        S at ω_low.
    KS, T, GS : float
        Peaks, in N/m, without unit, in m/N.
    weighted_T : float
        T over the bound that the weight gives.
    """

    S_low: float = nan
    KS: float = nan
    T: float = nan
    GS: float = nan
    weighted_T: float = nan


class ShapeEnd(StrEnum):
    """The frequency up to which the shape bounds |S|.

    Attributes
    ----------
    S_MAX
        Where it meets S_max, thus at every frequency; its room opens from ω_b on.
    CROSSING
        ω_b, with all of its room open.
    """

    S_MAX = "S_max"
    CROSSING = "crossing"


class BrokenAt(StrEnum):
    """The place where a channel's own |S| is taken.

    Attributes
    ----------
    WHOLE
        ‖uᵀS‖: its error, for references at every output together.
    SENSOR
        |uᵀS r|, u and r of this channel: the loop is broken at its sensor alone.
    ACTUATOR
        |wᵀ(I + KG)⁻¹w|: the loop is broken at an actuator.
    """

    WHOLE = "whole"
    SENSOR = "sensor"
    ACTUATOR = "actuator"


@dataclass(frozen=True)
class ChannelBounds:
    """The bounds of one channel besides those of the whole loop.

    For references of length 1 in any direction, with ω_i = bandwidth_ratio ω_b,

        ‖uᵀS(jω)‖ <= S_max,   ‖uᵀS(jω)‖ within the shape with ω_i in place of ω_b
        |W_KS| ‖wᵀKS‖ <= weighted_level,   W_KS with this M_K

    Attributes
    ----------
    name : str
    output, force : tuple of float (p,), (m,)
        u makes its error uᵀe of the plant's, w its force wᵀf.
    place, reference : BrokenAt, tuple of float (p,)
        Where |S| is taken; r of a sensor.
    S_max, bandwidth_ratio, M_K : float or None, float, float or None
        None, or a ratio of 1: no such bound. M_K in N/m.
    """

    name: str
    output: tuple[float, ...]
    force: tuple[float, ...]
    S_max: float | None = None
    bandwidth_ratio: float = 1.0
    M_K: float | None = None
    place: BrokenAt = BrokenAt.WHOLE
    reference: tuple[float, ...] = ()

    @property
    def lead(self) -> float:
        """ln of the channel's bandwidth over ω_b."""
        return log(self.bandwidth_ratio)

    @property
    def given(self) -> bool:
        """Whether the channel has any bound besides the whole loop's."""
        return (self.S_max, self.M_K, self.bandwidth_ratio) != (None, None, 1.0)


@dataclass(frozen=True)
class Bounds:
    """Bounds that hold on every plant; SI, None: no such bound.

        |S(jω)| <= S_max,   |S(jω_low)| <= S_low
        |S(jω)| <= (ω/ω_b)/√2                       for ω <= ω_b
        |S(jω)| <= (shape x - (shape - 1)/x)/√2     for ω > ω_b, x = ω/ω_b
        |W_KS KS|, |W_T T| <= weighted_level        with W_KS, W_T of `weights`
        |GS| <= compliance_max                      m/N

    Without a shape, or where it ends at ω_b (`shape_ends`), |S| <= 1/√2 for ω <= ω_b, and there
    |S| <= shape (ω/ω_b)/√2.

    The shape makes ω_b a bandwidth: a narrow filter at ω_b could hold |S| at 1/√2 up to there and
    let it leap to S_max above. Its room opens from ω_b on, three quarters of it up to 2 ω_b: a
    template with a step at ω_b, of whatever height, pays for a dip of |S| there. Without an
    integrator S does not fall to zero: the shape then counts from ω_low on.

    Parameters
    ----------
    S_max, S_low, omega_low : float
        Peak of |S|; |S| at ω_low (rad/s).
    shape, shape_ends : float or None, ShapeEnd
        Slope of |S| in units of the line through 1/√2 at ω_b, and where it ends.
    weighted_level, weights : float or None, Weights or None
        Of W_KS KS and W_T T.
    compliance_max : float or None
        m/N.
    channels : tuple of ChannelBounds
        Empty, or tighter bounds for each channel, in the structure's order.
    error : int or None
        Where sensors share an actuator: the channel whose error r - y counts. |S| then stands for
        S of the loop that is broken at that sensor alone, and S_max bounds it wherever the loop may
        be broken: `channels` are every sensor's, then the actuator's (`sensors_on_one_actuator`).
    """

    S_max: float
    S_low: float
    omega_low: float
    shape: float | None = None
    weighted_level: float | None = None
    weights: Weights | None = None
    compliance_max: float | None = None
    channels: tuple[ChannelBounds, ...] = ()
    shape_ends: ShapeEnd = ShapeEnd.S_MAX
    error: int | None = None

    def __post_init__(self) -> None:
        if not self.S_max > 1.0:
            raise ValueError(f"S_max is {self.S_max}; no loop with roll-off stays below 1")
        if not self.S_low > 0.0 or not self.omega_low > 0.0:
            raise ValueError("S_low and omega_low have to be above 0")
        if self.shape is not None and not self.shape >= 1.0:
            raise ValueError(f"shape is {self.shape}; below 1 no loop reaches -3 dB at ω_b")
        if self.weighted_level is not None and self.weights is None:
            raise ValueError("weighted_level needs the weights that KS and T are weighted with")
        for own in self.channels:
            if own.S_max is not None and not 1.0 < own.S_max <= self.S_max:
                words = f"S_max of channel {own.name} is {own.S_max}"
                raise ValueError(f"{words}; give more than 1, at most that of the whole")
            if own.bandwidth_ratio < 1.0:
                words = f"bandwidth_ratio of channel {own.name} is {own.bandwidth_ratio}"
                raise ValueError(f"{words}; give 1 or more: ω_b is that of the slowest")
            if own.M_K is not None and self.weighted_level is None:
                raise ValueError(f"M_K of channel {own.name} needs a weighted_level")
            if own.M_K is not None and self.weights and not 0.0 < own.M_K <= self.weights.M_K:
                words = f"M_K of channel {own.name} is {own.M_K}"
                raise ValueError(f"{words}; give more than 0, at most that of the weights")

    @property
    def places(self) -> tuple[BreakPoint, ...]:
        """The places where loops of several sensors on one actuator are broken, that whose error
        counts first; empty of other loops."""
        if self.error is None:
            return ()
        found = [BreakPoint(own.name, own.output, own.reference)
                 if own.place is BrokenAt.SENSOR else BreakPoint(own.name)
                 for own in self.channels]  # fmt: skip
        return (found[self.error], *found[: self.error], *found[self.error + 1 :])

    @property
    def opens(self) -> bool:
        """Whether the room of a shape opens from ω_b on."""
        return self.shape is not None and self.shape_ends is ShapeEnd.S_MAX

    def room(self, x: Array) -> Array:
        """Compute how far above the line |S| = x/√2 through ω_b, x = ω/ω_b, the shape lets |S|
        be."""
        assert self.shape is not None
        closed = (self.shape - 1.0) / np.maximum(x, 1.0) ** 2 if self.opens else 0.0 * x
        return np.asarray(self.shape - closed)

    def reached(self, s: Array) -> Array:
        """The least ω/ω_b at which the shape lets √2|S| be s."""
        assert self.shape is not None
        if not self.opens:
            return s / self.shape
        root = np.sqrt(s * s + 4.0 * self.shape * (self.shape - 1.0))
        return np.asarray(np.where(s <= 1.0, s, 0.5 * (s + root) / self.shape))

    def of_channel(self, number: int) -> "Bounds":
        """The bounds of a channel that is not coupled to the others, ω_b being its bandwidth."""
        if not self.channels:
            return self
        own = self.channels[number]
        weights = self.weights
        if weights is not None and own.M_K is not None:
            weights = replace(weights, M_K=own.M_K)
        peak = self.S_max if own.S_max is None else own.S_max
        return replace(self, S_max=peak, weights=weights, channels=(), error=None)

    def lead(self, number: int) -> float:
        """ln of a channel's bandwidth over ω_b."""
        return self.channels[number].lead if self.channels else 0.0

    def looser(self, by: float) -> "Bounds":
        """Every bound but the shape times 1 + by."""

        def times(value: float | None) -> float | None:
            return None if value is None else value * (1.0 + by)

        return replace(
            self,
            S_max=self.S_max * (1.0 + by),
            S_low=self.S_low * (1.0 + by),
            weighted_level=times(self.weighted_level),
            compliance_max=times(self.compliance_max),
            channels=tuple(replace(own, S_max=times(own.S_max)) for own in self.channels),
        )

    def missed_words(self, name: str, ratio: float) -> str:
        """Describe how a controller misses a bound by a factor, and the value of its key that it
        meets."""
        kind, channel = kind_and_channel(name)
        known = {"S_MAX": self.S_max, "S_LOW": self.S_low, "KS": self.weighted_level,
                 "T": self.weighted_level, "GS": self.compliance_max}  # fmt: skip
        own = next((one for one in self.channels if one.name == channel), None)
        given = own.S_max if own is not None and kind == "S_MAX" else known.get(kind)
        words = f"{key_words(name)} by a factor {ratio:.6g}"
        return words if given is None else f"{words} ({given:g} is given, {given * ratio:.4g} met)"

    def shares(self, peaks: LoopPeaks) -> dict[str, float]:
        """Every bound's figure over the bound; above 1 where it is not met."""
        shares = {"S_max": peaks.S_peak / self.S_max, "S_low": peaks.S_low / self.S_low}
        if self.weighted_level is not None:
            shares["KS"] = peaks.weighted_KS / self.weighted_level
            shares["T"] = peaks.weighted_T / self.weighted_level
        if self.compliance_max is not None:
            shares["GS"] = peaks.GS / self.compliance_max
        return shares

    def channel_shares(self, peaks: Sequence[ChannelPeaks]) -> dict[str, float]:
        """The same for the bounds of the channels; `peaks` in the order of `channels`."""
        shares = {}
        for own, figures in zip(self.channels, peaks, strict=True):
            if own.S_max is not None:
                shares[f"S_max of {own.name}"] = figures.S_peak / own.S_max
            if own.M_K is not None and self.weighted_level is not None:
                shares[f"KS of {own.name}"] = figures.weighted_KS / self.weighted_level
        return shares
