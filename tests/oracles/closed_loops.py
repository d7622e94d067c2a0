"""Simulated closed loops with noise: `python benchmarks/oracle.py closed_loops [LOOPS] [SEEDS]`.

A two-mass stage with random masses, friction and resonance under a random PD controller with a lag,
sampled with one period of delay; a random force is injected and coloured noise disturbs the
position. For every loop: the bias of the estimate of `ccd record` and that of y/u alone (spectra of
position and force, averaged), on the lines whose coherence is above `COHERENT`, over SEEDS noises.
"""

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, csd, welch

from ccd_casadi.extensions.records.plant_estimate import (
    EstimateOptions,
    PlantEstimate,
    estimate_plant,
)
from ccd_casadi.extensions.records.time_series import TimeSeries

COHERENT = 0.8
RATE = 2000.0


@dataclass(frozen=True)
class Loop:
    """x⁺ = A x + B w, outputs y, u of w = (r, noise); `plant`: its discrete A, B, C."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    plant: tuple[np.ndarray, np.ndarray, np.ndarray]
    size: float

    def response(self, hz: np.ndarray) -> np.ndarray:
        """G as the controller sees it."""
        A, B, C = self.plant
        z = np.exp(2j * np.pi * hz / RATE)[:, None, None]
        return np.asarray((C @ np.linalg.solve(z * np.eye(len(A)) - A, B.astype(complex)))[:, 0, 0])


def random_loop(rng: np.random.Generator) -> Loop:
    """A stable loop of a random stage."""
    while True:
        m1, m2, c = rng.uniform(0.5, 3.0), rng.uniform(0.5, 3.0), rng.uniform(1.0, 20.0)
        mu, m = m1 * m2 / (m1 + m2), m1 + m2
        w = 2.0 * np.pi * rng.uniform(60.0, 300.0)
        k, d = mu * w**2, 2.0 * rng.uniform(0.01, 0.05) * mu * w
        M_inv = np.diag([1.0 / m1, 1.0 / m2])
        K = k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        D = d * np.array([[1.0, -1.0], [-1.0, 1.0]]) + np.diag([c, 0.0])
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-M_inv @ K, -M_inv @ D]])
        B = np.concatenate([np.zeros(2), M_inv[:, 0]])[:, None]
        C = np.array([[1.0, 0.0, 0.0, 0.0]])
        Ad, Bd, Cd, _, _ = cont2discrete((A, B, C, np.zeros((1, 1))), 1.0 / RATE)
        Ap = np.block([[Ad, Bd], [np.zeros((1, 5))]])  # one period of delay
        Bp = np.append(np.zeros(4), 1.0)[:, None]
        Cp = np.append(Cd, 0.0)[None]
        wb = 2.0 * np.pi * rng.uniform(5.0, 20.0)
        lag = 6.0 * wb  # K = m wb²/3 (1 + 3 s/wb)/(1 + s/lag), bilinear
        s = 2.0 * RATE
        gain = m * wb**2 / 3.0
        b = gain * np.array([1.0 + 3.0 * s / wb, 1.0 - 3.0 * s / wb]) / (1.0 + s / lag)
        a = (1.0 - s / lag) / (1.0 + s / lag)
        # xc⁺ = -a xc - (y + v), u = r + (b1 - a b0) xc - b0 (y + v)
        ck, dk = b[1] - a * b[0], b[0]
        A_ = np.block([[Ap - dk * Bp @ Cp, ck * Bp], [-Cp, np.array([[-a]])]])
        B_ = np.block([[Bp, -dk * Bp], [np.zeros((1, 1)), -np.ones((1, 1))]])
        C_ = np.block([[Cp, np.zeros((1, 1))], [-dk * Cp, np.array([[ck]])]])
        D_ = np.array([[0.0, 1.0], [1.0, -dk]])
        if np.abs(np.linalg.eigvals(A_)).max() < 0.998:
            size = gain / m
            return Loop(A_, B_, C_, D_, (Ap, Bp, Cp), size)


def recorded(loop: Loop, rng: np.random.Generator, samples: int, noise: float) -> TimeSeries:
    """One record: `noise` is the standard deviation of the disturbance over that of the answer."""
    r = rng.standard_normal(samples)
    white = rng.standard_normal(samples)
    v = np.empty(samples)
    v[0] = white[0]
    for i in range(1, samples):  # first-order noise
        v[i] = 0.9 * v[i - 1] + white[i]
    clean = _run(loop, np.stack([r, 0.0 * v]))
    v *= noise * clean[0].std() / v.std()
    y, u = _run(loop, np.stack([r, v]))
    return TimeSeries(1.0 / RATE, r, u, y)


def _run(loop: Loop, w: np.ndarray) -> np.ndarray:
    """By modes, each a first-order filter."""
    from scipy.signal import lfilter

    poles, V = np.linalg.eig(loop.A)
    B, C = np.linalg.solve(V, loop.B.astype(complex)), loop.C @ V
    rows = (row @ w for row in B)
    pairs = zip(poles, rows, strict=True)
    states = np.array([lfilter([0.0, 1.0], [1.0, -p], own) for p, own in pairs])
    return np.asarray((C @ states).real + loop.D @ w)


def by_ratio(series: TimeSeries, hz: np.ndarray) -> np.ndarray:
    """S_uy/S_uu at some lines: what holds in open loop alone."""
    n = 512
    f, cross = csd(series.force, series.position, RATE, nperseg=n)
    _, power = welch(series.force, RATE, nperseg=n)
    found = cross / power
    return np.interp(hz, f, found.real) + 1j * np.interp(hz, f, found.imag)


def biases(
    seed: int, seeds: int, samples: int = 16384, noise: float = 0.3
) -> tuple[float, float, float]:
    """Median |bias| over the coherent lines: of the estimate and of y/u; and the share of lines and
    noises with the true response within the spread."""
    rng = np.random.default_rng(seed)
    loop = random_loop(rng)
    ours, ratio, inside = [], [], []
    found: PlantEstimate | Any = None
    for _ in range(seeds):
        series = recorded(loop, rng, samples, noise)
        found = estimate_plant(series, EstimateOptions())
        kept = (found.hz > 2.0) & (found.hz < 0.4 * RATE)
        hz = found.hz[kept]
        G = loop.response(hz)
        ours.append(found.G[kept] / G - 1.0)
        ratio.append(by_ratio(series, hz) / G - 1.0)
        inside.append(np.abs(found.G[kept] - G) <= found.spread[kept])
        coherent = found.coherence[kept] > COHERENT
    mine, theirs = np.mean(ours, axis=0)[coherent], np.mean(ratio, axis=0)[coherent]
    # over bands of neighbouring lines: a bias is smooth, what is left of the noise is not
    bands = max(1, len(mine) // 40)
    smooth = [
        float(np.median([abs(part.mean()) for part in np.array_split(one, bands)]))
        for one in (mine, theirs)
    ]
    return smooth[0], smooth[1], float(np.mean(inside))


def main() -> None:
    given = [int(word) for word in sys.argv[1:]]
    loops, seeds = (*given, *(50, 20)[len(given) :])
    print("loop   bias   of y/u   within the spread")
    good = 0
    for seed in range(loops):
        ours, ratio, inside = biases(seed, seeds)
        good += ours <= 0.02 < ratio
        figures = f"{100 * ours:5.2f} % {100 * ratio:6.1f} % {100 * inside:6.1f} %"
        print(f"{seed:4d} {figures}", flush=True)
    print(f"{good} of {loops}: at most 2 % where y/u is off by more")


if __name__ == "__main__":
    main()
