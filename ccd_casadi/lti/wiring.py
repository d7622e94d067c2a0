"""What lies between a controller and the mechanics: amplifiers before, filters behind them.

Each input has an actuator a_j(s) and each output a sensor c_i(s), of static gain 1,

    y = diag(c_i) C (M s² + D s + K)⁻¹ B diag(a_j) u,
    a, c = 1/(1 + s/ω₁) · 1/(1 + 2ζ s/ω₂ + (s/ω₂)²)      either factor, both or none,

in the loop of every search, figure, judge and deployed controller, exact at the instants behind a
hold. Disturbing forces act on the mechanics, z = C q is what counts, a motor's force is a_j u_j; a
plant with these as further inputs and outputs says which channels are its `own`.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, solve_sylvester

from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.text import HZ


class Slopes(NamedTuple):
    """Derivatives of a system to θ, n_θ of them.

    Attributes
    ----------
    dA, dB, dC : array (n_θ, n, n), (n_θ, n, m), (n_θ, p, n)
    """

    dA: Array
    dB: Array
    dC: Array


@dataclass(frozen=True)
class ForcedPlant(StateSpace):
    """A plant that disturbing forces move otherwise than u does.

    Attributes
    ----------
    mechanics : StateSpace
        What they move: the outputs, or without its sensors; then what counts, where that is given.
    counted : StateSpace, optional
        From u to the same.
    """

    mechanics: StateSpace = field(kw_only=True)
    counted: StateSpace | None = field(default=None, kw_only=True)

    @classmethod
    def of(
        cls, plant: StateSpace, mechanics: StateSpace, counted: StateSpace | None = None
    ) -> "ForcedPlant":
        """The matrices of `plant`."""
        return cls(plant.A, plant.B, plant.C, plant.D, mechanics=mechanics, counted=counted)


@dataclass(frozen=True)
class OwnPorts:
    """Which inputs and outputs of a wide plant are those of actuators and sensors: the first.

    Attributes
    ----------
    outputs, inputs : int
        p and m. Further inputs are disturbing forces (none: those of the actuators).
    counted : int
        Outputs after these that count; 0: the sensors', and S moves with a force as they do.
    """

    outputs: int
    inputs: int
    counted: int = 0

    def drives(self, B: Array) -> tuple[Array, Array]:
        """Columns (..., n, m) of u and (..., n, q) of disturbing forces."""
        own, rest = B[..., : self.inputs], B[..., self.inputs :]
        return own, rest if rest.shape[-1] else own

    def readings(self, C: Array) -> tuple[Array, Array]:
        """Rows (..., p, n) of the sensors, and these with what counts below (..., p + z, n)."""
        return C[..., : self.outputs, :], C[..., : self.outputs + self.counted, :]

    def apart(self, plant: StateSpace) -> ForcedPlant:
        """A wide plant as what u moves, and beside it what disturbing forces move."""
        (B, E), (C, whole) = self.drives(plant.B), self.readings(plant.C)
        moved = strictly_proper(plant.A, E, whole)
        counted = strictly_proper(plant.A, B, whole) if self.counted else None
        return ForcedPlant.of(strictly_proper(plant.A, B, C), moved, counted)


@dataclass(frozen=True)
class Filters:
    """The low passes of the inputs, or of the outputs; each tuple has one entry, or one for each.

    Attributes
    ----------
    lag_hz : tuple of float
        Corners ω₁/2π of first order; empty: none.
    second_order_hz, damping : tuple of float
        ω₂/2π and ζ; empty: none.
    """

    lag_hz: tuple[float, ...] = ()
    second_order_hz: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.lag_hz or self.second_order_hz)

    @property
    def words(self) -> str:
        """Such as `1st order 2000 Hz, 2nd order 5000 Hz`."""
        orders = (("1st order", self.lag_hz), ("2nd order", self.second_order_hz))
        found = [f"{name} {', '.join(f'{hz:g}' for hz in given)} Hz"
                 for name, given in orders if given]  # fmt: skip
        return ", ".join(found)

    @property
    def delays(self) -> tuple[float, ...]:
        """How late a slow signal comes out, s: 1/ω₁ + 2ζ/ω₂ for each entry."""
        count = max(len(self.lag_hz), len(self.second_order_hz))
        late = np.zeros(count)
        if self.lag_hz:
            late += 1.0 / np.resize(self.lag_hz, count)
        if self.second_order_hz:
            late += 2.0 * np.resize(np.divide(self.damping, self.second_order_hz), count)
        return tuple((late / HZ).tolist())

    def system(self, channels: int, key: str) -> StateSpace:
        """The diagonal system (channels x channels), in rad/s. Raises PlantError where a list has
        another number of entries."""
        parts = []
        for i in range(channels):
            A, B, C, D = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1)
            own = StateSpace(A, B, C, D)
            if self.lag_hz:
                w = HZ * _entry(self.lag_hz, i, channels, f"{key}.lag_hz")
                own = own.series(StateSpace(*map(np.atleast_2d, (-w, w, 1.0, 0.0))))
            if self.second_order_hz:
                w = HZ * _entry(self.second_order_hz, i, channels, f"{key}.second_order_hz")
                zeta = _entry(self.damping, i, channels, f"{key}.damping")
                A = np.array([[0.0, w], [-w, -2.0 * zeta * w]])
                B, C = np.array([[0.0], [w]]), np.array([[1.0, 0.0]])
                own = own.series(StateSpace(A, B, C, np.zeros((1, 1))))
            parts.append(own)
        return StateSpace(*(block_diag(*(getattr(one, name) for one in parts)) for name in "ABCD"))

    def poles(self, channels: int, key: str) -> np.ndarray | None:
        """The poles λ in rad/s of what all channels share, 1/Π(1 - s/λ); None where they differ."""
        system = self.system(channels, key)
        each = np.split(np.arange(len(system.A)), channels)
        A = system.A[np.ix_(each[0], each[0])]
        if any((system.A[np.ix_(own, own)] != A).any() for own in each):
            return None
        return np.asarray(np.linalg.eigvals(A), complex)


def _entry(values: tuple[float, ...], i: int, channels: int, key: str) -> float:
    if len(values) not in (1, channels):
        raise PlantError(f"{key} has {len(values)} entries for {channels} channels; give one, or "
                         "one for each")  # fmt: skip
    return values[i % len(values)]


@dataclass(frozen=True)
class Wiring:
    """The actuators and the sensors of a plant.

    Attributes
    ----------
    actuator, sensor : Filters
        Before the forces; behind the sensors.
    own : tuple (p, m) or None
        How many outputs and inputs, the first ones, are wired; None: all. With them the actuators'
        forces (N) are the last outputs of all.
    """

    actuator: Filters = Filters()
    sensor: Filters = Filters()
    own: tuple[int, int] | None = None

    def __bool__(self) -> bool:
        return bool(self.actuator or self.sensor)

    @property
    def words(self) -> str:
        """The wiring in words, as a reader of figures must know it."""
        both = (("[actuator]", self.actuator), ("[sensor]", self.sensor))
        there = [f"{name} {own.words}" for name, own in both if own]
        words = "disturbing forces act on the machine, its unfiltered position counts"
        if self.sensor:
            late = " and ".join(f"{1e6 * delay:.3g}" for delay in dict.fromkeys(self.sensor.delays))
            words += (
                f"; the sensor is {late} us late: at a speed v the position leads the setpoint by "
                "v times that, unless the setpoint of the loop (not its feedforward) is as late"
            )
        return f"{' and '.join(there)} in every loop; {words}"

    def poles(self, outputs: int, inputs: int) -> np.ndarray | None:
        """The poles λ in rad/s of 1/Π(1 - s/λ) where the wiring is that of every channel alike."""
        actuator = self.actuator.poles(inputs, "actuator")
        sensor = self.sensor.poles(outputs, "sensor")
        return None if actuator is None or sensor is None else np.append(actuator, sensor)

    def of_output(self, row: Array) -> "Wiring":
        """Return the wiring of the one output rowᵀy. Raises PlantError where it mixes sensors that
        differ."""
        there, own = np.flatnonzero(row), {}
        for key in ("lag_hz", "second_order_hz", "damping"):
            values = getattr(self.sensor, key)
            seen = {values[i % len(values)] for i in there if values}
            if len(seen) > 1:
                raise PlantError(f"sensor.{key} differs in an output that moves; give one for both")
            own[key] = tuple(seen)
        return replace(self, sensor=Filters(**own))

    def around(self, plant: StateSpace) -> StateSpace:
        """The plant (p x m, time in s) with its actuators and sensors, a `ForcedPlant` with any."""
        if not self:
            return plant
        act, own, sen = self._parts(plant)
        return ForcedPlant.of(act.series(own).series(sen), plant)

    def _parts(
        self, plant: StateSpace, unit: float = 1.0
    ) -> tuple[StateSpace, StateSpace, StateSpace]:
        """Actuators, the plant and sensors, as wide as it; `unit` of its force in N."""
        (n, inputs), outputs = plant.B.shape, len(plant.C)
        p, m = self.own or (outputs, inputs)
        act, sen = self.actuator.system(m, "actuator"), self.sensor.system(p, "sensor")
        if self.own and self.actuator:
            C, D = np.zeros((m, n)), unit * np.eye(m, inputs)
            plant = replace(plant, C=np.vstack([plant.C, C]), D=np.vstack([plant.D, D]))
        return _beside(act, inputs - m), plant, _beside(sen, len(plant.C) - p)

    def states(
        self, plant: StateSpace, slopes: Slopes, rate: float, unit: float
    ) -> tuple[StateSpace, Slopes]:
        """The same of a plant whose time is in 1/`rate`, with derivatives; free bodies stay chains.

        Parameters
        ----------
        plant, slopes : StateSpace, Slopes
            The mechanics (n states): a zero column of A is a free body's position.
        rate, unit : float
            1/s, and of its force in N.

        Returns
        -------
        StateSpace, Slopes
            With the states (actuators, mechanics, sensors), free bodies parted from all others.
        """
        act, plant, sen = self._parts(plant, unit)
        act, sen = act.in_units(rate, 1.0), sen.in_units(rate, 1.0)
        n, m, p = len(plant.A), plant.B.shape[1], len(plant.C)
        a, s = len(act.A), len(sen.A)
        size, own, behind = a + n + s, slice(a, a + n), slice(a + n, a + n + s)

        def place(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
            """A, B, C of the mechanics, or of their derivatives, in the states of all."""
            lead = A.shape[:-2]
            whole, into = np.zeros((*lead, size, size)), np.zeros((*lead, size, m))
            out = np.zeros((*lead, p, size))
            whole[..., own, own], whole[..., own, :a], into[..., own, :] = A, B @ act.C, B @ act.D
            read = C.shape[-2]  # but the actuators' forces
            whole[..., behind, own] = sen.B[:, :read] @ C
            out[..., own] = sen.D[:, :read] @ C
            return whole, into, out

        A, B, C = place(plant.A, plant.B, plant.C)
        A[:a, :a], B[:a] = act.A, act.B
        A[behind, behind], C[:, behind], C[:, :a] = sen.A, sen.C, sen.D @ plant.D @ act.C
        dA, dB, dC = place(*slopes)
        bodies = np.flatnonzero(~plant.A.any(axis=0))
        if len(bodies):
            rates = (plant.A[bodies] != 0.0).argmax(axis=1)
            rates = rates[~plant.A[rates].any(axis=1)]  # that nothing brakes
            chain = np.union1d(bodies, rates) + a
            T, back = _apart(A, chain)
            A, B, C = back @ A @ T, back @ B, C @ T
            dA, dB, dC = back @ dA @ T, back @ dB, dC @ T
            rest = np.setdiff1d(np.arange(size), chain)
            A[np.ix_(chain, rest)] = A[np.ix_(rest, chain)] = 0.0  # but for rounding
            A[np.ix_(chain, chain)] = plant.A[np.ix_(chain - a, chain - a)]
        return StateSpace(A, B, C, sen.D @ plant.D @ act.D), Slopes(dA, dB, dC)


UNWIRED = Wiring()


def _beside(system: StateSpace, more: int) -> StateSpace:
    """A system with `more` channels that pass as they are."""
    B, C = np.pad(system.B, [(0, 0), (0, more)]), np.pad(system.C, [(0, more), (0, 0)])
    return StateSpace(system.A, B, C, block_diag(system.D, np.eye(more)))


def _apart(A: Array, chain: np.ndarray) -> tuple[Array, Array]:
    """T and T⁻¹ of x = T z that part the states `chain` of free bodies from all others.

    In the order (chain, rest) A = [N X; Y R]: X is what drives the bodies, Y reads them. With

        R Z - Z N = -Y,   N W - W R = X,   T = [1 -W; Z 1],   T⁻¹ = [1 W; -Z 1 - Z W]

    T⁻¹ A T is block diagonal, since nothing that reads a body drives one: X Z = W Y = W Z = 0. N is
    nilpotent and R regular, so that both equations have one solution.
    """
    rest = np.setdiff1d(np.arange(len(A)), chain)
    N, R, X, Y = (A[np.ix_(*pair)] for pair in
                  ((chain, chain), (rest, rest), (chain, rest), (rest, chain)))  # fmt: skip
    Z, W = solve_sylvester(R, -N, -Y), solve_sylvester(N, -R, X)
    T, back = np.eye(len(A)), np.eye(len(A))
    T[np.ix_(chain, rest)], T[np.ix_(rest, chain)] = -W, Z
    back[np.ix_(chain, rest)], back[np.ix_(rest, chain)] = W, -Z
    back[np.ix_(rest, rest)] -= Z @ W
    return T, back
