"""|S| of a cascade at every place over its bound, on some plants and a grid of frequencies.

Rows are ln of |S| over its bound, with the exact slopes of the drive's own difference equations. A
force d moves what counts, z, by

    z/d = G_zd - G_zu Σ_j K_j G_jd/(1 + L) = (G_zd (1 + L) - Σ_j K_j G_zu G_jd)/(1 + L)

with hold and delay in G_zu alone, as `lti.loop.Loop.force_responses` has it: one more row, where
bounded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ccd_casadi.extensions.drives.cascade import Cascade
from ccd_casadi.extensions.drives.drive_data import Filter, Number
from ccd_casadi.extensions.drives.two_rates import lift
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.lti.wiring import ForcedPlant
from ccd_casadi.support.arrays import Array

FORCE = "force"  # the place of z/d


@dataclass(frozen=True)
class SearchOptions:
    """Numbers of the search.

    Attributes
    ----------
    starts, stages, steps : int, tuple of (float, int), int
        Starting points; steps from each, and the share of them that is kept then; steps from these.
    refinements, finer : int, int
        Of the grid by the peaks between its points, and points of the finer one to one of its.
    alert, missed, met : float
        Share below a bound from which on a peak is added, and by how much it exceeds the grid's
        values beside it; ln of a figure over its bound that counts as met.
    points : int
        Of the grid of frequencies, as many again spread evenly; more lie about resonances.
    lowest, last : float
        Of the grid, over ω_low and over half the sampling rate.
    penalty : float
        ρ, per violation of one (natural) logarithm.
    radius, least_radius, grow, shrink : float
        Δ at first and at the end, and how it changes.
    rows, violated : int, float
        Rows that a programme begins with, and by which it grows; the least violation of one.
    room : float
        Share of every bound that is kept for what lies between the grid's points.
    dampings, frequencies : tuple of float
        Of the filters at a start: numerator and denominator damping, and Hz.
    spread : float
        Of gains at a start, in logarithms.
    retreats : int
        Halvings of a start's gains until every loop is stable.
    gains : float
        Kv over the frequency of the first bandwidth that is tried; Kp over mass times it.
    bandwidth : float
        Hz, of a start.
    highest : float
        Frequency of a filter over the sampling rate: next to half of it features are narrow.
    difference : float
        Of logarithms, for the slopes of fixed-point coefficients.
    least_damping, most_damping : float, float
        Of a filter's denominator, below which a filter is a needle; of all, above which one of its
        roots lies below its frequency.
    stable : float
        By which a pole's modulus is below 1.
    edge : float
        Relative, by which rounding may put a value at the end of its range beside it.
    """

    starts: int = 24
    stages: tuple[tuple[float, int], ...] = ((0.5, 50), (0.1, 50))
    steps: int = 40
    refinements: int = 10
    finer: int = 8
    alert: float = 5e-3
    missed: float = 5e-5
    last: float = 0.999999
    met: float = 4e-4
    points: int = 200
    lowest: float = 0.2
    penalty: float = 30.0
    radius: float = 0.3
    least_radius: float = 1e-5
    grow: float = 1.6
    shrink: float = 0.4
    rows: int = 60
    violated: float = 1e-6
    room: float = 5e-4
    dampings: tuple[float, float] = (0.6, 0.65)
    frequencies: tuple[float, float] = (80.0, 2500.0)
    spread: float = 0.3
    retreats: int = 10
    gains: float = 1.0
    bandwidth: float = 15.0
    highest: float = 0.4
    difference: float = 1e-5
    least_damping: float = 0.1
    most_damping: float = 1.0
    stable: float = 1e-9
    edge: float = 1e-9


class SensorResponses(NamedTuple):
    """A plant on a grid: G (p, k) of the sensors as they are sampled; where z/d is bounded G_zd
    (k,), G_zu G_jd (p, k) and the bound (k,)."""

    G: np.ndarray
    forces: tuple[np.ndarray, np.ndarray, Array] | None = None


class BoundedFigure(NamedTuple):
    """A figure |N/D| at a place, its bound, and the slopes (k, n) of its ln."""

    place: int | str | None
    size: Array
    limit: float | Array
    slopes: Array


def split(plant: StateSpace, cascade: Cascade) -> tuple[StateSpace, Array, Array]:
    """Take apart a plant with its ports: from the drive's force to the sensors, where forces act
    (n, q), and what counts (z, n); without ports the drive's force, and the position's sensor."""
    p = cascade.sensors
    body = plant.mechanics if isinstance(plant, ForcedPlant) else plant
    drive = plant.B[:, 1:] if plant.B.shape[1] > 1 else body.B
    counted = plant.C[p:] if len(plant.C) > p else plant.C[[cascade.position]]
    return strictly_proper(plant.A, plant.B[:, :1], plant.C[:p]), drive, counted


class CascadeRows:
    """Rows of a cascade on some plants.

    Parameters
    ----------
    cascade, bounds, sampling : Cascade, Bounds, Sampling
    plants : sequence of StateSpace
        SI, continuous; with their ports where z/d is bounded.
    options : SearchOptions
    """

    def __init__(
        self, cascade: Cascade, bounds: Bounds, sampling: Sampling, plants: Sequence[StateSpace],
        options: SearchOptions = SearchOptions(),
    ) -> None:  # fmt: skip
        self.cascade, self.bounds, self.options = cascade, bounds, options
        T = sampling.period
        self.sampling, self.plants = sampling, [split(plant, cascade) for plant in plants]
        self.systems = [zoh(plant, T, sampling.delay) for plant, *_ in self.plants]
        rates = np.concatenate([np.abs(plant.rates) for plant in plants])
        near = rates[(rates > bounds.omega_low) & (rates < np.pi / T)]
        about = (near[:, None] * np.linspace(0.9, 1.1, 21)).ravel()
        top, self.period = options.last * np.pi / T, T
        grid = np.geomspace(options.lowest * bounds.omega_low, top, options.points)
        even = np.linspace(0.0, top, options.points)[1:]
        parts = [grid, even, about[about < top], np.array([bounds.omega_low])]
        self.on(np.unique(np.concatenate(parts)))
        ranges = cascade.ranges.copy()
        for i, setting in enumerate(cascade.settings):
            if "denominator" in setting.name and not setting.unit:
                ranges[0, i] = max(ranges[0, i], options.least_damping)
            if "damping" in setting.name:
                ranges[1, i] = min(ranges[1, i], options.most_damping)
        hertz = cascade.hertz
        ranges[1, hertz] = np.minimum(ranges[1, hertz], options.highest / T)
        self.low, self.high = np.log(ranges)
        self.mass = self._mass(self.plants[0][0])

    def on(self, omega: Array) -> None:
        """Take another grid of frequencies."""
        self.omega, self.z = omega, np.exp(1j * omega * self.period)
        self.seen = self._responses(omega)

    def _responses(self, omega: Array) -> list[SensorResponses]:
        """Every plant at these frequencies."""
        found = []
        for system, (plant, drive, counted) in zip(self.systems, self.plants, strict=True):
            G = system.sweep(omega)[:, :, 0].T
            most = self.bounds.compliance_max
            if most is None:
                found.append(SensorResponses(G))
                continue
            C = np.vstack([plant.C, counted])
            d = strictly_proper(plant.A, drive, C).sweep(omega)[:, :, 0].T
            late = strictly_proper(plant.A, plant.B, counted)
            u = zoh(late, self.period, self.sampling.delay).sweep(omega)[:, 0, 0]
            limit = np.where(omega <= self.cascade.stiff_below, most, np.inf)
            found.append(SensorResponses(G, (d[-1], u * d[:-1], limit)))
        return found

    def _mass(self, plant: StateSpace) -> float:
        """kg that the force moves as seen by the position's sensor, by G at ω_low."""
        w = self.bounds.omega_low
        G = plant.at(1j * np.array([w]))[0, self.cascade.position, 0]
        return float(1.0 / (abs(G) * w * w))

    def inside(self, values: Array) -> bool:
        """Whether every value is within its range, as the search takes it."""
        edge, at = self.options.edge, np.log(np.fmax(values, 1e-300))
        return bool((at >= self.low - edge).all() and (at <= self.high + edge).all())

    def stable(self, values: Array) -> bool:
        """Whether every plant's loop is."""
        if self.cascade.slower > 1:
            loops = (lift(self.cascade, values, G) for G in self.systems)
            return all(loop.radius < 1.0 - self.options.stable for loop in loops)
        K = self.cascade.state_space(values)
        for G in self.systems:
            A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
            if not np.abs(np.linalg.eigvals(A)).max() < 1.0 - self.options.stable:
                return False
        return True

    def rows(self, kappa: Array, log_band: float) -> tuple[Array, Array]:
        """c (m,) and ∇c (m, n + 1) to the parameters' logarithms and ln ω_b."""
        b, w = self.bounds, self.omega
        K, dK = self.cascade.responses(np.exp(kappa), self.z)
        x = w / np.exp(log_band)
        above = x > 1.0
        if b.shape is not None:
            room = b.room(x)
            shape = np.log(room * x / np.sqrt(2.0))
            by_x = 1.0 + np.where(above & b.opens, 2.0 * (b.shape - 1.0) / x**2 / room, 0.0)
        else:
            shape, by_x = np.where(above, np.inf, -0.5 * np.log(2.0)), 0.0 * x
        values, slopes = [], []
        for one in self.seen:
            for place, size, limit, steep in self._figures(one, K, dK):
                S = np.log(size)
                values.append(S - np.log(limit))
                slopes.append(np.column_stack([steep, 0.0 * x]))
                if place == self.cascade.position:
                    values.append(S - shape)
                    slopes.append(np.column_stack([steep, by_x]))
                    at = int(np.searchsorted(w, b.omega_low))
                    values.append(S[at : at + 1] - np.log(b.S_low))
                    slopes.append(np.append(steep[at], 0.0)[None])
        if self.cascade.drive.number is Number.FIXED_30:
            for value, slope in self._coefficients(kappa):
                values.append(value)
                slopes.append(slope)
        for value, slope in self._filter_rows(kappa, log_band):
            values.append(value)
            slopes.append(slope)
        c = np.concatenate(values) + self.options.room
        good = np.isfinite(c)
        return c[good], np.concatenate(slopes)[good]

    def _filter_rows(self, kappa: Array, log_band: float) -> list[tuple[Array, Array]]:
        """List the rows that forbid filters, Kv and Tn to raise their gain beyond `filter_gain`, or
        to allow less than ω_b (`Cascade.allowed_bandwidths`)."""
        found, n = [], len(kappa)
        if np.isfinite(self.cascade.filter_gain):
            rise, steep = self.cascade.rises(np.exp(kappa), self.z)
            by_kappa = steep.reshape(n, -1).T
            value = (rise - np.log(self.cascade.filter_gain)).ravel()
            found.append((value, np.column_stack([by_kappa, np.zeros(len(by_kappa))])))
        places = np.concatenate([[0, 2], np.flatnonzero(self.cascade.hertz)])
        slope = np.zeros((len(places), n + 1))
        slope[np.arange(len(places)), places], slope[:, -1] = -1.0, 1.0
        slope[1, 2] = 1.0  # of Tn
        return [*found, (log_band - np.log(self.cascade.allowed_bandwidths(np.exp(kappa))), slope)]

    def _coefficients(self, kappa: Array) -> list[tuple[Array, Array]]:
        """ln of the largest coefficient of each filter over what fixed point holds, by central
        differences: it is a function of four numbers."""
        h, at, found = self.options.difference, 3, []
        blocks = self.cascade.filters
        for slot, block in zip(self.cascade.slots, blocks, strict=True):
            names = list(slot.settings)

            def most(own: Array, block: Filter = block, names: list[str] = names) -> float:
                values = dict(zip(names, np.exp(own).tolist(), strict=True))
                b, a = block.coefficients(values)
                return float(np.log(max(np.abs(b).max(), np.abs(a).max()) / block.largest_fixed))

            own = kappa[at : at + len(names)]
            slope = np.zeros((1, len(kappa) + 1))
            for i, step in enumerate(h * np.eye(len(names))):
                slope[0, at + i] = (most(own + step) - most(own - step)) / (2.0 * h)
            found.append((np.array([most(own)]), slope))
            at += len(names)
        return found

    def _places(self) -> list[int | None]:
        """Sensors that count, and None for the actuator."""
        used = {self.cascade.position, self.cascade.velocity}
        return [*sorted(used)] if len(used) == 1 else [*sorted(used), None]

    def _name(self, sensor: int) -> str:
        return self.bounds.channels[sensor].name if self.bounds.channels else ""

    def refine(self, values: Array) -> bool:
        """Add to the grid where |S| peaks above its bounds between its points."""
        coarse, T, o = self.omega, self.period, self.options
        fine = np.exp(np.interp(
            np.arange((len(coarse) - 1) * o.finer + 1) / o.finer, np.arange(len(coarse)),
            np.log(coarse),
        ))  # fmt: skip
        K = self.cascade.responses(values, np.exp(1j * fine * T))[0]
        new: list[float] = []
        for one in self._responses(fine):
            for _, S, limit, _ in self._figures(one, K):
                share = S / limit
                cells = share[:-1].reshape(-1, o.finer)
                ends = np.maximum(share[: -o.finer : o.finer], share[o.finer :: o.finer])
                top = cells.max(axis=1)
                high = (top > ends * (1.0 + o.missed)) & (top > 1.0 - o.alert)
                at = cells.argmax(axis=1) + o.finer * np.arange(len(cells))
                new += fine[at[high]].tolist()
        if not new:
            return False
        self.on(np.union1d(coarse, new))
        return True

    def judge(self, values: Array) -> tuple[float, float]:
        """ω_b by the shape, Kv, Tn and the filters, and the largest ln of a peak over its
        bound, on the grid."""
        K, b = self.cascade.responses(values, self.z)[0], self.bounds
        bandwidth = float(self.cascade.allowed_bandwidths(values).min())
        rise = self.cascade.rises(values, self.z)[0].max()
        worst = float(rise - np.log(self.cascade.filter_gain))
        for one in self.seen:
            for place, S, limit, _ in self._figures(one, K):
                worst = max(worst, float(np.log((S / limit).max())))
                if place == self.cascade.position:
                    bandwidth = min(bandwidth, self._band(S))
                    low = S[np.searchsorted(self.omega, b.omega_low)]
                    worst = max(worst, float(np.log(low / b.S_low)))
        return bandwidth, worst + self.options.room

    def _band(self, S: Array) -> float:
        """The largest ω_b that |S| on the grid allows."""
        if self.bounds.shape is not None:
            x = self.bounds.reached(np.sqrt(2.0) * S)
            return float((self.omega / x).min())
        over = np.flatnonzero(2.0 * S**2 > 1.0)
        return float(self.omega[over[0]]) if len(over) else float(self.omega[-1])

    def _figures(
        self, one: SensorResponses, K: np.ndarray, dK: np.ndarray | None = None
    ) -> list[BoundedFigure]:
        """|S| at every place, and |z/d|; with slopes where those of K are given."""
        dK = np.zeros((0, *K.shape)) if dK is None else dK
        L, dL, b = one.G * K, one.G * dK, self.bounds
        D, dD = 1.0 + L.sum(axis=0), dL.sum(axis=1)
        own = {c.name: c.S_max or b.S_max for c in b.channels}
        found: list[tuple[int | str | None, np.ndarray, np.ndarray, float | Array]] = []
        for place in self._places():
            rest = np.zeros(len(L), bool) if place is None else np.arange(len(L)) != place
            name = "actuator" if place is None else self._name(place)
            N, dN = 1.0 + L[rest].sum(axis=0), dL[:, rest].sum(axis=1)
            found.append((place, N, dN, own.get(name, b.S_max)))
        if one.forces is not None:
            free, through, limit = one.forces
            N = free * D - (K * through).sum(axis=0)
            dN = free * dD - (dK * through).sum(axis=1)
            found.append((FORCE, N, dN, limit))
        return [BoundedFigure(place, np.abs(N / D), limit, (dN / N - dD / D).real.T)
                for place, N, dN, limit in found]  # fmt: skip
