"""Plants off their model over a box: common and single resonance shifts, damping, gain, options.

A point p of the box is a vector; with the option sets of the plant it makes one scaled plant.
Frequencies of flexible modes are multiplied by (1 + p_common)(1 + p_mode), modal damping ratios by
the damping factor, what u moves by 1 + p_gain: the force constant of an actuator, or the scale of a
sensor, of which the loop knows the product alone. Disturbing forces move the machine as they do on
the model. Mode shapes stay, and free bodies stay free.

For a proof it is a sum of modes, poles and residues as affine forms of what is uncertain:

    G(s) = Σ b_i c_i/(s² + g_i s + k_i) = Σ r_i/(s - p_i) - r_i/(s - q_i),   r = b c/(p - q)

b_i c_i/s² of free bodies, and b_i c_i/(s² - w_i²) of what the stiffness drives away.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import casadi as ca
import numpy as np
from scipy.linalg import hadamard

from ccd_casadi.fixed_structure.affine import Affine, inverse, moving_modes, root, variable
from ccd_casadi.fixed_structure.boxes import Pair
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.lti.wiring import ForcedPlant, OwnPorts, Slopes
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.first_order import FirstOrderPlant
from ccd_casadi.plants.modal import (
    FREE,
    ModalPlant,
    Perturbation,
    Suspension,
    modal_plant,
    without_hidden_rigid_modes,
)
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_at_ports, scale_plant
from ccd_casadi.support.arrays import Array

SLOPES = ("dM", "dK", "dD", "dB", "dC")  # of a modal plant


def no_graph(option: int) -> None:
    """The modes of no option are known as functions of what varies."""


@dataclass(frozen=True)
class UncertainPlant:
    """The plants off their model: a box of parameters for each of some options.

    Attributes
    ----------
    options : tuple of Mechanics
        The same plant with other loads or positions, by their matrices; the model first.
    M_K : float
        N/m: scales all of them alike.
    resonance_shift, mode_shift, gain : float
        Relative, to either side: of all modes, of each, and of what u moves; 0: none.
    damping : tuple of two floats
        The least and the largest factor on modal damping.
    ranges : tuple of (name, least, nominal, largest)
        Parameters of the model itself.
    along : callable, optional
        An option at values of these, with derivatives to θ and, last, to these.
    graph : callable
        An option's matrices as expressions of these, where there are any.
    rigid_modes : int, optional
        How many, where that is stated.
    own : OwnPorts, optional
        Of options whose further inputs and outputs are where forces act and what counts.
    inputs : int, optional
        How many inputs are those of u, the first; None: all.
    """

    options: tuple[Mechanics, ...]
    M_K: float
    resonance_shift: float = 0.0
    mode_shift: float = 0.0
    damping: tuple[float, float] = (1.0, 1.0)
    gain: float = 0.0
    ranges: tuple[tuple[str, float, float, float], ...] = ()
    along: Callable[[int, Array], Mechanics] | None = None
    graph: Callable[[int], ca.Function | None] = no_graph
    rigid_modes: int | None = None
    own: OwnPorts | None = None
    inputs: int | None = None

    @cached_property
    def modes(self) -> int:
        """The largest number of flexible modes of any option."""
        plants = [modal_plant(option, self._free) for option in self.options]
        return max(len(plant.numbered) for plant in plants)

    @property
    def encloses_forces(self) -> bool:
        """Whether what forces move is enclosed over the box: of modes that do not move, without a
        filter between what counts and the sensor, and of one free body at most."""
        if self.own is None or not self.own.counted:
            return self.own is None or not self.ranges
        filtered = any(option.wiring.sensor for option in self.options)
        bodies = max(int(self.modal(i).rigid.sum()) for i in range(len(self.options)))
        return not self.ranges and not filtered and bodies <= 1

    @property
    def _free(self) -> Suspension:
        return replace(FREE, rigid_modes=self.rigid_modes)

    @property
    def names(self) -> tuple[str, ...]:
        """The uncertain parameters, those whose range is not zero."""
        found = ["resonance_shift"] if self.resonance_shift else []
        if self.mode_shift:
            found += [f"mode_shift {i}" for i in range(1, self.modes + 1)]
        if self.damping != (1.0, 1.0):
            found.append("damping")
        if self.gain:
            found.append("gain")
        return (*found, *(f"theta.{name}" for name, *_ in self.ranges))

    @property
    def box(self) -> Array:
        """Lower and upper ends (2, n)."""
        ends = {
            "resonance_shift": (-self.resonance_shift, self.resonance_shift),
            "damping": self.damping,
            "gain": (-self.gain, self.gain),
            **{f"theta.{name}": (low, high) for name, low, _, high in self.ranges},
        }
        found = [ends.get(name, (-self.mode_shift, self.mode_shift)) for name in self.names]
        return np.array(found).reshape(-1, 2).T

    @property
    def nominal(self) -> Array:
        """The model's own point."""
        own = {"damping": 1.0} | {f"theta.{name}": value for name, _, value, _ in self.ranges}
        return np.array([own.get(name, 0.0) for name in self.names])

    def modal(self, option: int) -> ModalPlant:
        """The model of an option in modal coordinates."""
        return self._modal(self.nominal, option)

    def plant(self, point: Array, option: int = 0) -> ScaledPlant:
        """The scaled plant at a point of the box; its derivatives are those to θ."""
        modal, count = self._modal(point, option), len(self.ranges)
        if count:
            if (states := modal.states) is not None:
                dA, dB, dC = (d[:-count] for d in states.slopes)
                own = Slopes(dA, dB, dC)
                modal = replace(modal, states=replace(states, slopes=own))
            else:
                modal = replace(modal, **{d: getattr(modal, d)[:-count] for d in SLOPES})
        return self._scaled(modal, point)

    def _scaled(self, modal: ModalPlant, point: Array, to_point: bool = False) -> ScaledPlant:
        """Scale a modal plant, with what disturbing forces move where an error of the gain leaves
        it alone; `to_point`: its derivatives are those to `names`."""
        if self.own is not None:
            found = scale_at_ports(modal, self.M_K, self.own)
        else:
            found = scale_plant(modal, self.M_K, bare=True)
        if not self._forces_at_u(modal.B.shape[1]):
            return found
        row = self.names.index("gain")
        return with_forces_of_model(found, 1.0 + float(point[row]), row if to_point else None)

    @property
    def _of_u(self) -> int | None:
        """How many inputs are those of u; None: all."""
        return self.inputs if self.own is None else self.own.inputs

    def _forces_at_u(self, inputs: int) -> bool:
        """Whether disturbing forces act where u does, on plants whose gain errs."""
        return bool(self.gain) and inputs == (self._of_u or inputs)

    def with_slopes(self, point: Array, option: int = 0) -> ScaledPlant:
        """The same with derivatives to the point itself, one for each of `names`.

            ∂k_i = 2 k_i ∂r_i/r_i,   ∂d_i = d_i ∂r_i/r_i,   r_i = (1 + p_common)(1 + p_i)

        of flexible modes with stiffness k_i and damping d_i; all d_i are as the damping factor.
        Those to parameters of the model are the model's own.
        """
        modal, values = self._modal(point, option), np.asarray(point, float)
        if modal.states is not None:
            states = self._to_point(modal.states, values)
            return self._scaled(replace(modal, states=states), values, True)
        flexible = np.flatnonzero(~modal.rigid)
        count, n, m = len(self.names), len(modal.K), modal.B.shape[1]
        dM, dK, dD = np.zeros((3, count, n, n))
        dB, dC = np.zeros((count, n, m)), np.zeros((count, *modal.C.shape))
        first = count - len(self.ranges)
        for whole, d in zip((dM, dK, dD, dB, dC), SLOPES, strict=True):
            whole[first:] = getattr(modal, d)[len(getattr(modal, d)) - count + first :]
        given = self.options[option].damping_ratio is None  # a matrix, which no shift moves
        for row, (name, value) in enumerate(zip(self.names[:first], values.tolist(), strict=False)):
            word, _, number = name.partition(" ")
            if word == "gain":
                dB[row][:, : self._of_u] = modal.B[:, : self._of_u] / (1.0 + value)
                continue
            if word == "damping":
                own = np.ix_(flexible, flexible)
                dD[row][own] = modal.D[own] / value
                continue
            at = modal.numbered[int(number) - 1 : int(number)] if number else flexible
            dK[row, at, at] = 2.0 * modal.K[at, at] / (1.0 + value)
            if not given:
                dD[row, at, at] = modal.D[at, at] / (1.0 + value)
        moved = replace(modal, dM=dM, dK=dK, dD=dD, dB=dB, dC=dC)
        return self._scaled(moved, values, True)

    def _to_point(self, states: FirstOrderPlant, values: Array) -> FirstOrderPlant:
        """A plant of first order with derivatives to the point; see `sloped`."""
        system, first = states.system, len(self.names) - len(self.ranges)
        of_u = np.arange(system.B.shape[1]) < (self._of_u or system.B.shape[1])
        rows = [
            (0.0 * system.A, system.B * of_u / (1.0 + value)) if name == "gain"
            else states.to_point(name, value)
            for name, value in zip(self.names[:first], values.tolist(), strict=False)
        ]  # fmt: skip
        own = len(states.slopes.dA) - len(self.ranges)  # to θ; after it to parameters of the model
        dA, dB, dC = (d[own:] for d in states.slopes)
        whole = Slopes(
            np.array([*[row[0] for row in rows], *dA]).reshape(-1, *system.A.shape),
            np.array([*[row[1] for row in rows], *dB]).reshape(-1, *system.B.shape),
            np.concatenate([np.zeros((first, *system.C.shape)), dC]),
        )
        return replace(states, slopes=whole)

    def _off(self, point: Array, option: int) -> tuple[dict[str, float], Mechanics, Perturbation]:
        """A point's values by name, the matrices of its option there, and how modes are off."""
        values = dict(zip(self.names, np.asarray(point, float).tolist(), strict=True))
        shift, factor = values.get("resonance_shift", 0.0), values.get("damping", 1.0)
        system = self.options[option]
        if self.along is not None and self.ranges:
            system = self.along(option, np.asarray(point, float)[-len(self.ranges) :])
        own: tuple[float, ...] = ()
        if self.mode_shift:
            own = tuple(values.get(f"mode_shift {i}", 0.0) for i in range(1, self.modes + 1))
        return values, system, Perturbation(shift, factor, own if any(own) else ())

    def _modal(self, point: Array, option: int) -> ModalPlant:
        values, system, off = self._off(point, option)
        modal = modal_plant(system, self._free, off)
        modal = without_hidden_rigid_modes(modal)
        gain = 1.0 + values.get("gain", 0.0)
        return modal if gain == 1.0 else modal.scale_input(gain, self._of_u)

    def plants(self, points: Sequence[tuple[int, Array]]) -> list[ScaledPlant]:
        """The plants of (option, point) pairs."""
        return [self.plant(point, option) for option, point in points]

    def as_written(self, points: Sequence[tuple[int, Array]]) -> list[StateSpace]:
        """The plants of (option, point) pairs from the matrices as their function returned them."""
        found = []
        for option, point in points:
            values, system, off = self._off(point, option)
            gain = values.get("gain", 0.0)
            plant = as_written(
                system, shift=off.shift, modes=off.modes, damping=off.damping, gain=gain,
                inputs=self._of_u, rigid_modes=self.rigid_modes,
            )  # fmt: skip
            plant = plant if self.own is None else self.own.apart(plant)
            if self._forces_at_u(system.B.shape[1]):
                body = plant.mechanics if isinstance(plant, ForcedPlant) else plant
                body = strictly_proper(body.A, body.B / (1.0 + gain), body.C)
                counted = plant.counted if isinstance(plant, ForcedPlant) else None
                plant = ForcedPlant.of(plant, body, counted)
            found.append(plant)
        return found

    def drawn(self, rng: np.random.Generator, count: int) -> list[tuple[int, Array]]:
        """(option, point) pairs, uniformly from the box, the options alike often."""
        option, (low, high) = rng.integers(len(self.options), size=count).tolist(), self.box
        return [*zip(option, rng.uniform(low, high, (count, len(low))), strict=True)]

    def corners(self, full: int = 6) -> list[tuple[int, Array]]:
        """The model of every option, then the corners of its box.

        With more than three parameters single modes' shifts go together, with the least damping,
        and of more than `full` that are left each pair meets at all four of its ends (the rows of
        a Hadamard matrix and their opposites): there are too many other corners to assess, and a
        search finds those that matter.

        Parameters
        ----------
        full : int
            Parameters of which every corner is taken.

        Returns
        -------
        list of (int, array (n,))
            Number of an option, and a point of its box.
        """
        box, centre = self.box, self.nominal
        found = [(option, centre) for option in range(len(self.options))]
        goes_with = list(self.names)  # the parameter that each one is at the same end as
        if len(centre) > 3:
            goes_with = ["modes" if name.startswith("mode_shift") else name for name in goes_with]
        free = [name for name in dict.fromkeys(goes_with) if len(centre) <= 3 or name != "damping"]
        if len(free) <= full:
            ends = np.array(list(itertools.product((0, 1), repeat=len(free))))[:, ::-1]
        else:
            signs = hadamard(1 << len(free).bit_length())[:, 1 : 1 + len(free)]
            ends = (np.vstack([signs, -signs]) + 1) // 2
        for option in range(len(self.options)):
            for row in ends if free else []:
                at = dict(zip(free, row.tolist(), strict=True))
                points = [at.get(name, 0) for name in goes_with]
                found.append((option, box[points, np.arange(len(centre))]))
        return found


def with_forces_of_model(
    plant: ScaledPlant, strength: float, row: int | None = None
) -> ScaledPlant:
    """Add what disturbing forces at u move to a plant that u moves otherwise than on the model.

    Parameters
    ----------
    plant : ScaledPlant
        With all of B times a factor.
    strength : float
        The factor.
    row : int, optional
        Which of its derivatives is that to the factor; forces have none to it.

    Returns
    -------
    ScaledPlant
        Its `mechanics` are those of the model.
    """
    body = plant.mechanics or plant
    dB = body.dB / strength
    if row is not None:
        dB[row] = 0.0
    return replace(plant, mechanics=replace(body, B=body.B / strength, dB=dB))


@dataclass(frozen=True)
class ModalSum:
    """One option of an uncertain plant as Σ c_i b_iᵀ/(s² + g_i s + k_i), time in 1/`unit`, SI else.

        k = (ω (1 + shift)(1 + own shift))²
        g = factor (given + 2 ζ ω (1 + shift)(1 + own shift))

    Attributes
    ----------
    omega : array (n,)
    rigid : array (n,) of bool
        Free ones, k = g = 0, which come first; the others are in the order of their numbers.
    given, zeta : array (n,), float
        Of g.
    drive, reading : array (n, m), (n, p)
        b_i and c_i.
    away : array (n,) of bool
        The stiffness drives it away: k = -w², g = 0, with w (1/s) in place of ω.
    moving : callable or None
        ω and b_i c_i over boxes of the parameters that modes move with, the last ones; see
        `moving_modes`.
    forced, counted : array (n, q), (n, z) or None
        b_i of disturbing forces and c_i of what counts; None: those of `drive` and `reading`.
    """

    omega: Array
    rigid: np.ndarray
    given: Array
    zeta: float
    drive: Array
    reading: Array
    away: np.ndarray
    moving: Callable[[Array, Array], tuple[list[list[Affine]], np.ndarray]] | None = None
    forced: Array | None = None
    counted: Array | None = None

    @property
    def pushed(self) -> Array:
        """b_i of disturbing forces (n, q)."""
        return self.drive if self.forced is None else self.forced

    def shift_of(self, i: int) -> str:
        """The parameter that shifts mode i alone; none shifts a rigid one."""
        return "" if self.rigid[i] else f"mode_shift {int((~self.rigid[: i + 1]).sum())}"

    def strength(self, names: tuple[str, ...], low: Array, high: Array) -> Affine:
        """1 + p_gain over boxes (n_p, N) of `names`, with the variables of `poles`.

        It is of b_i, and of f_i too where u and a force move the modes alike: what a force moves
        is then enclosed as that many times as large.
        """
        n, m = len(low) + 1, low.shape[1]
        one = Affine(np.ones(m), np.zeros((n, m)), np.zeros(m))
        if "gain" not in names:
            return one
        k = names.index("gain")
        return variable(low[k], high[k], k + 1, n) + 1.0

    def rate_squared(
        self, i: int, names: tuple[str, ...], low: Array, high: Array
    ) -> tuple[Affine, Array]:
        """w² of a mode i that the stiffness drives away, with the variables of `poles`, and a bound
        (N,) below w."""
        n, m = len(low) + 1, low.shape[1]
        w = Affine(np.full(m, self.omega[i]), np.zeros((n, m)), np.zeros(m))
        for k, name in enumerate(names):
            if name in ("resonance_shift", self.shift_of(i)):
                w = w * (variable(low[k], high[k], k + 1, n) + 1.0)
        return w * w, _least(w)

    def poles(
        self, i: int, names: tuple[str, ...], low: Array, high: Array, moved: Affine | None = None
    ) -> tuple[list[Pair], Array]:
        """(p, residue) of flexible mode i's two poles over boxes (n_p, N) of the parameters
        `names`, of unit strength; not above the rate (N,) at which they decay, 0 where none is
        known and below it where they may not. Variable 0 of the forms is left to the frequency;
        `moved` is its ω.
        """
        n, m = len(low) + 1, low.shape[1]
        one = Affine(np.ones(m), np.zeros((n, m)), np.zeros(m))
        w = one * self.omega[i] if moved is None else moved
        values = {name: variable(low[k], high[k], k + 1, n) for k, name in enumerate(names)}
        factor = values.get("damping", one)
        for name in ("resonance_shift", self.shift_of(i)):
            w = w * (values[name] + 1.0) if name in values else w
        own = w * (2.0 * self.zeta) + self.given[i]
        k, g = w * w, factor * own
        damped = (_least(w) > 0.0) & (_least(own) > 0.0) & (_least(factor) > 0.0)
        half = g * 0.5
        under = k - half * half
        light = under.centre.real > 0.0
        swing = root(under * np.where(light, 1.0, -1.0)) * np.where(light, 1j, 1.0)
        residue = self.strength(names, low, high) * inverse(swing * 2.0)
        known = np.where(light & np.isfinite(swing.rest), _least(half), 0.0) * (1.0 - 1e-12)
        poles = [(swing - half, residue), (-swing - half, -residue)]
        return poles, np.where(damped, known, -1.0)


def modal_sum(
    uncertain: UncertainPlant, option: int, unit: float, *, uncoupled: float = 1e-12
) -> ModalSum | None:
    """None of a plant of first order, and where a given damping matrix couples the modes (by more
    than `uncoupled`, relative) or brakes a free body, or damps what the stiffness drives away.
    Modes that move need a graph, a damping ratio, one force, one sensor, a stiffness that holds
    them, and to be apart at the model."""
    system = uncertain.options[option]
    modal = uncertain.modal(option)
    if modal.states is not None:
        return None
    zeta = float(system.damping_ratio or 0.0)
    given, away = modal.D - np.diag(2.0 * zeta * modal.natural), modal.driven_away
    omega = np.where(away, np.sqrt(np.abs(np.diag(modal.K))), modal.natural)
    size = np.abs(np.diag(modal.D)).max()
    if np.abs(given - np.diag(np.diag(given))).max() > uncoupled * size:
        return None
    if given[modal.rigid | away].any():
        return None
    diagonal = np.diag(given)
    diagonal = np.where(np.abs(diagonal) > uncoupled * size, diagonal, 0.0)
    order = np.append(np.flatnonzero(modal.rigid), modal.numbered)
    B, C, E, F = modal.B[order] / unit**2, modal.C.T[order], None, None
    if (own := uncertain.own) is not None:
        (B, E), (C, F) = own.drives(B), np.split(C, [own.outputs], axis=1)
        F = F[:, : own.counted] if own.counted else None
    found = ModalSum(
        omega[order] / unit, modal.rigid[order], diagonal[order] / unit, zeta, B, C, away[order],
        forced=E, counted=F,
    )  # fmt: skip
    if not uncertain.ranges:
        return found
    graph, one = uncertain.graph(option), np.ones((len(order), 1))
    single = found.drive.shape == found.reading.shape == one.shape
    if graph is None or not zeta or away.any() or not single:
        return None
    moving = partial(moving_modes, graph, int(modal.rigid.sum()), unit)
    model = uncertain.nominal[-len(uncertain.ranges) :, None]
    known = moving(model, model)[1].all()
    alone = replace(found, forced=None, counted=None)
    return replace(alone, drive=one, reading=one, moving=moving) if known else None


def unmoved_words(uncertain: UncertainPlant) -> str:
    """Say why the modes of a plant with ranges are not enclosed (`modal_sum` is None), in a clause.

    Parameters
    ----------
    uncertain : UncertainPlant

    Returns
    -------
    str
    """
    for option, system in enumerate(uncertain.options):
        modal, own = uncertain.modal(option), uncertain.own
        outputs, inputs = (own.outputs, own.inputs) if own else (len(modal.C), modal.B.shape[1])
        if uncertain.graph(option) is None:
            return "its matrices are not made of expressions of theta alone"
        if not system.damping_ratio:
            return "it has no damping ratio"
        if modal.driven_away.any():
            return "its stiffness drives a motion away"
        if outputs > 1 or inputs > 1:
            return "it has several forces or sensors"
    return "two of its modes meet, or its function has an operation that is not enclosed"


def _least(f: Affine) -> Array:
    """Not above a real form anywhere."""
    return np.asarray(f.centre.real - np.abs(f.slope).sum(0) - f.rest)
