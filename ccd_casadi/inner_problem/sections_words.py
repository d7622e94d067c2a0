"""A controller of fixed structure as a motion engineer reads it: sections in Hz and damping."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.fixed_structure.structure import ParameterKind, Structure
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, spoken

if TYPE_CHECKING:
    from ccd_casadi.fixed_structure.channel_structure import ChannelStructure


@dataclass(frozen=True)
class SectionWords:
    """A section of a controller in words.

    Attributes
    ----------
    kind : str
    zero_hz, zero_damping, pole_hz, pole_damping : float or None
        Frequencies in Hz, damping ratios; None where it has none.
    """

    kind: str
    zero_hz: float | None = None
    zero_damping: float | None = None
    pole_hz: float | None = None
    pole_damping: float | None = None

    @property
    def text(self) -> str:
        """`notch: zeros 176.3 Hz (0.05), poles 190 Hz (0.7)`."""
        parts = []
        for name, hz, damping in (
            ("zero", self.zero_hz, self.zero_damping),
            ("pole", self.pole_hz, self.pole_damping),
        ):
            if hz is not None:
                pair = "" if damping is None else f" (damping {damping:.3g})"
                parts.append(f"{name}{'' if damping is None else 's'} {hz:.4g} Hz{pair}")
        return f"{self.kind}: {', '.join(parts)}"


def section_words(structure: Structure, kappa: Array) -> list[SectionWords]:
    """Describe the sections of a controller of one channel.

    Parameters
    ----------
    structure, kappa : Structure, array (n,)
        κ in SI.

    Returns
    -------
    list of SectionWords
        In the order of the structure.
    """
    values = dict(zip(structure.names, np.exp(np.asarray(kappa, float)).tolist(), strict=True))
    hz = {name: value / HZ for name, value in values.items()}
    found = []
    if structure.integrator:
        found.append(SectionWords("integrator with zero", zero_hz=hz["integrator"], pole_hz=0.0))
    for i in range(1, structure.lead + 1):
        zero, pole = hz[f"lead {i} zero"], hz[f"lead {i} pole"]
        found.append(SectionWords("lead" if zero < pole else "lag", zero, None, pole))
    for i in range(1, structure.biquads + 1):
        zero, pole = hz[f"biquad {i} zeros"], hz[f"biquad {i} poles"]
        dampings = values[f"biquad {i} zeros damping"], values[f"biquad {i} poles damping"]
        found.append(SectionWords(_biquad(zero, pole, *dampings), zero, dampings[0], pole,
                                  dampings[1]))  # fmt: skip
    for i in range(1, structure.roll_off // 2 + 1):
        found.append(SectionWords("roll-off", pole_hz=hz[f"roll-off {i}"],
                                  pole_damping=values[f"roll-off {i} damping"]))  # fmt: skip
    if structure.roll_off % 2:
        found.append(SectionWords("roll-off", pole_hz=hz["roll-off real"]))
    return found


def _biquad(zero: float, pole: float, zero_damping: float, pole_damping: float) -> str:
    if max(zero / pole, pole / zero) <= 1.1:  # of nearly one frequency
        return "notch" if zero_damping < pole_damping else "resonance filter"
    return "skewed notch, lead" if zero < pole else "skewed notch, lag"


def sampled_words(
    sections: Sequence[SectionWords], rate_hz: float | None, *, least: float = 0.02
) -> str:
    """Write where the fastest root acts in the sampled controller.

    Tustin's rule takes s = 2/T (z - 1)/(z + 1), so that what K has at f K(z) has at

        f' = atan(π f T) / (π T)

    Parameters
    ----------
    sections : sequence of SectionWords
    rate_hz : float or None
        1/T in Hz; None of a continuous loop.
    least : float
        Share of a frequency by which it moves, below which nothing is written.

    Returns
    -------
    str
        Empty of a continuous loop, and where no root moves by `least`.

    Examples
    --------
    >>> sampled_words([SectionWords("roll-off", pole_hz=1000.0 / np.pi)], 1000.0)
    "at 1000 Hz Tustin's rule takes 318.3 Hz to 250 Hz"
    """
    fastest = max((hz for item in sections for hz in (item.zero_hz, item.pole_hz) if hz), default=0)
    if rate_hz is None or not fastest:
        return ""
    acts = float(np.arctan(np.pi * fastest / rate_hz)) * rate_hz / np.pi
    if acts > (1.0 - least) * fastest:
        return ""
    return f"at {rate_hz:g} Hz Tustin's rule takes {fastest:.4g} Hz to {acts:.4g} Hz"


def gain_of(kappa: Array) -> float:
    """Find the gain of a controller of one channel.

    Parameters
    ----------
    kappa : array (n,)
        In SI.

    Returns
    -------
    float
        k in N/m: |K| between the integrator's zero and the first other section.
    """
    return float(np.exp(kappa[0]))


def sections_dict(structure: "Structure | ChannelStructure", kappa: Array) -> dict[str, Any]:
    """Make the entry `controller` of result.json and `sections` of controller.json.

    Parameters
    ----------
    structure, kappa : Structure or ChannelStructure, array (n,)
        κ in SI.

    Returns
    -------
    dict
        Of several channels each is under `channels` with its directions, and all sections are in
        one list.
    """
    if not isinstance(structure, Structure):
        return _channels_dict(structure, kappa)
    units = dict(zip(ParameterKind, (spoken("N/m"), "Hz", "1"), strict=True))
    rows = zip(structure.names, structure.kinds, np.exp(kappa).tolist(), strict=True)
    return {
        "structure": asdict(structure),
        "order": structure.order,
        "parameters": [
            {"name": name, "value": value / HZ if kind is ParameterKind.FREQUENCY else value,
             "unit": units[kind]}
            for name, kind, value in rows
        ],
        "gain": gain_of(kappa),
        "sections": [vars(item) for item in section_words(structure, kappa)],
    }  # fmt: skip


def _channels_dict(structure: "ChannelStructure", kappa: Array) -> dict[str, Any]:
    own = structure.decoupling
    channels = [
        {"name": name, "outputs": own.outputs[:, i].tolist(), "inputs": own.inputs[:, i].tolist()}
        | sections_dict(part, values)
        for i, (name, (part, values)) in enumerate(
            zip(own.names, structure.split(np.asarray(kappa, float)), strict=True)
        )
    ]

    def joined(key: str, word: str) -> list[dict[str, Any]]:
        return [
            item | {word: f"{channel['name']}: {item[word]}"}
            for channel in channels
            for item in channel[key]
        ]

    return {
        "order": structure.order,
        "parameters": joined("parameters", "name"),
        "sections": joined("sections", "kind"),
        "channels": channels,
    }
