"""`ccd.tune` on 30 plants of the literature, each design judged apart: how many, and how fast?

    python benchmarks/tune_plants.py [--plots DIR] [--only NAME]

Nothing of the package judges: hold, delay and Tustin's rule are SciPy's, |S| is computed on 20,000
frequencies, and a step is simulated until 400/ω_b. A design is refuted where the step does not come
to 1 within 2 %, or |S| exceeds S_max by more than 0.1 %.

Batch: Åström and Hägglund, Advanced PID Control (2006), test batch P1 to P9. MathWorks: parameters
of the public examples of the Robust Control Toolbox. The others are textbook plants and those that
threads name (gnu-octave/pkg-control#13: 1/s²).
"""

import argparse
from pathlib import Path
from time import process_time

import control
import numpy as np
from scipy.signal import cont2discrete

import ccd_casadi as ccd
from ccd_casadi.support.errors import UserError

S_MAX = 1.8
s = control.tf("s")


def modes(rigid: control.TransferFunction, *parts: tuple[float, ...]) -> control.StateSpace:
    """A rigid part and modes of (Hz, damping, gain)."""
    flexible = []
    for hz, damping, gain in parts:
        omega = ccd.HZ * hz
        flexible.append(control.tf([gain], [1.0, 2.0 * damping * omega, omega**2]))
    return control.parallel(*(control.ss(part) for part in (rigid, *flexible)))


def beam() -> control.StateSpace:
    """The flexible beam: six modes of 1 % damping, signs as given."""
    gains = (9.72e-4, 0.0122, 0.0012, -0.0583, -0.0013, 0.1199)
    rates = (18.95, 118.76, 332.54, 651.66, 1077.2, 1609.2)
    return modes(control.tf([0.0], [1.0]), *(
        (w / ccd.HZ, 0.01, g) for w, g in zip(rates, gains, strict=True)
    ))  # fmt: skip


def positioning() -> control.TransferFunction:
    """Two inertias on a soft shaft, the far one measured."""
    J1, J2, b1, b2, b12, k = 1e-6, 1.15e-7, 1e-6, 1e-6, 5e-7, 0.013
    one, two, shaft = J1 * s**2 + b1 * s, J2 * s**2 + b2 * s, b12 * s + k
    return control.minreal(shaft / (one * two + shaft * (one + two)), verbose=False)


FREE = 1.0 / (10.0 * (s**2 + 2.0 * 0.1 * 6.0 * s + 36.0))  # 10 kg on its cables
# name: plant (or a set), rate in Hz, delay in s
PLANTS = {
    "P1 T=0.1, delay 1": (1 / (1 + 0.1 * s), 20.0, 1.0),
    "P1 T=1, delay 1": (1 / (1 + s), 20.0, 1.0),
    "P1 T=10, delay 1": (1 / (1 + 10 * s), 10.0, 1.0),
    "P2 T=1, delay 1": (1 / (1 + s) ** 2, 20.0, 1.0),
    "P2 T=10, delay 1": (1 / (1 + 10 * s) ** 2, 10.0, 1.0),
    "P3 T=0.1": (1 / ((s + 1) * (1 + 0.1 * s) ** 2), 100.0, 0.0),
    "P4 n=2": (1 / (s + 1) ** 2, 20.0, 0.05),
    "P4 n=3": (1 / (s + 1) ** 3, 20.0, 0.0),
    "P4 n=4": (1 / (s + 1) ** 4, 20.0, 0.0),
    "P4 n=8": (1 / (s + 1) ** 8, 10.0, 0.0),
    "P5 a=0.5": (1 / ((1 + s) * (1 + s / 2) * (1 + s / 4) * (1 + s / 8)), 40.0, 0.0),
    "P6 integrating, delay 0.1": (1 / (s * (1 + 0.9 * s)), 50.0, 0.1),
    "P7 delay 0.1": (10 / ((1 + 10 * s) * (1 + 0.9 * s)), 50.0, 0.1),
    "P8 a=0.5, non-minimum phase": ((1 - 0.5 * s) / (s + 1) ** 3, 20.0, 0.0),
    "P8 a=1.1, non-minimum phase": ((1 - 1.1 * s) / (s + 1) ** 3, 20.0, 0.0),
    "P9 T=0.5": (1 / ((s + 1) * ((0.5 * s) ** 2 + 0.7 * s + 1)), 20.0, 0.0),
    "oscillatory, damping 0.05": (1 / ((s + 1) * (s**2 + 0.1 * s + 1)), 20.0, 0.0),
    "oscillatory, delay 0.3": (9 / (s**2 + 0.6 * s + 9), 50.0, 0.3),
    "1/s², pkg-control#13": (1 / s**2, 100.0, 0.01),
    "1/s²(s + 10)": (1 / (s**2 * (s + 10)), 200.0, 0.0),
    "1/s³": (1 / s**3, 100.0, 0.0),
    "stage, modes collocated": (modes(FREE, (120.0, 0.01, 0.02), (400.0, 0.01, 0.02)), 5e3, 2e-4),
    "stage, mode non-collocated": (modes(FREE, (150.0, 0.02, -0.05)), 5e3, 2e-4),
    "stage, set of three": (
        [modes(FREE, (f, 0.01, 0.02)) for f in (110.0, 120.0, 130.0)],
        5e3,
        2e-4,
    ),
    "MathWorks positioning": (positioning(), 2e3, 5e-4),
    "MathWorks flexible beam": (beam(), 5e3, 0.0),
    "unstable 1/(s - 1)": (1 / (s - 1), 50.0, 0.0),
    "pendulum 1/(s² - 1)": (1 / (s**2 - 1), 50.0, 0.02),
    "unstable, delay 2": (1 / (s - 1), 50.0, 2.0),
    "zero at 0": (s / (s + 1) ** 2, 20.0, 0.0),
}


def loop(plant: object, rate: float, delay: float, K: object) -> tuple:
    """SciPy's sampled plant with its delay in whole periods, and K by Tustin's rule."""
    T = 1.0 / rate
    G = control.ss(plant)
    A, B, C, _, _ = cont2discrete((G.A, G.B, G.C, G.D), T)
    count = round(delay * rate)
    assert abs(count - delay * rate) < 1e-9
    return (A, B, C, count), cont2discrete((K.A, K.B, K.C, K.D), T, "bilinear")[:4]


def refutation(plant: object, rate: float, delay: float, design: object) -> tuple[str, dict]:
    """What is wrong with a design on one plant, and its figures and curves."""
    (A, B, C, count), (a, b, c, d) = loop(plant, rate, delay, design.controller)
    low = 1e-3 * design.bandwidth
    omega = np.geomspace(low, 0.9999 * np.pi * rate, 20000)
    fine = [np.abs(np.linalg.eigvals(control.ss(plant).A).imag)]
    omega = np.unique(np.concatenate([omega, *(x[(x > low) & (x < np.pi * rate)] for x in fine)]))
    z = np.exp(1j * omega / rate)
    G = (C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B + 0j))[:, 0, 0] * z**-count
    k = (c @ np.linalg.solve(z[:, None, None] * np.eye(len(a)) - a, b + 0j) + d)[:, 0, 0]
    S = 1.0 / np.abs(1.0 + G * k)
    steps = min(int(400.0 / design.bandwidth * rate), 400_000)
    x, w, line, y = np.zeros((len(A), 1)), np.zeros((len(a), 1)), [0.0] * count, np.zeros(steps)
    for i in range(steps):
        y[i] = (C @ x)[0, 0]
        e = 1.0 - y[i]
        line.append(float((c @ w + d * e)[0, 0]))
        w, x = a @ w + b * e, A @ x + B * line.pop(0)
    words = []
    if not abs(y[-steps // 10 :] - 1.0).max() < 0.02:
        words.append("the step does not come to 1")
    if S.max() > S_MAX * 1.001:
        words.append(f"|S| is {S.max():.4f}")
    curves = {"omega": omega, "gain": S, "L": np.abs(G * k), "y": y, "t": np.arange(steps) / rate}
    return ", ".join(words), {"S": S.max(), "overshoot": y.max() - 1.0, **curves}


def drawn(path: Path, name: str, design: object, found: dict) -> None:
    """|L|, |S| and the step."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.loglog(found["omega"], found["L"], label="|L|")
    left.loglog(found["omega"], found["gain"], label="|S|")
    left.axvline(design.bandwidth, lw=0.5)
    left.axhline(S_MAX, lw=0.5)
    left.set(xlabel="rad/s", ylim=(1e-4, 1e3), title=name)
    left.legend()
    shown = found["t"] < 40.0 / design.bandwidth
    right.plot(found["t"][shown], found["y"][shown])
    right.set(xlabel="s", title="step")
    figure.savefig(path, dpi=70)


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--plots", type=Path)
    options.add_argument("--only", default="")
    given = options.parse_args()
    ccd.tune(1 / (s + 1) ** 3, rate_hz=10.0, starts=2)  # compiles the kernels
    seconds, refuted, designed = [], [], 0
    print("| plant | rate Hz | delay s | notches | ω_b rad/s | |S| | overshoot | s | |")
    print("|---|---|---|---|---|---|---|---|---|")
    for number, (name, (plant, rate, delay)) in enumerate(PLANTS.items()):
        if given.only not in name:
            continue
        began = process_time()
        try:
            found = ccd.tune(plant, rate_hz=rate, delay=delay)
        except UserError as error:
            print(f"| {name} | {rate:g} | {delay:g} | | | | | | {error} |", flush=True)
            continue
        seconds.append(process_time() - began)
        design = found.design
        row = f"| {name} | {rate:g} | {delay:g} | {design.structure.biquads}"
        if not design.usable:
            print(f"{row} | | | | {seconds[-1]:.1f} | {design.words} |", flush=True)
            continue
        designed += 1
        plants = plant if isinstance(plant, list) else [plant]
        judged = [refutation(one, rate, delay, design) for one in plants]
        words = "; ".join(words for words, _ in judged if words)
        if words:
            refuted.append(name)
        S, over = (max(figures[key] for _, figures in judged) for key in ("S", "overshoot"))
        end = f"{seconds[-1]:.1f} | {words and 'REFUTED: ' + words} |"
        print(f"{row} | {design.bandwidth:.4g} | {S:.3f} | {100 * over:.0f} % | {end}", flush=True)
        if given.plots:
            given.plots.mkdir(exist_ok=True)
            drawn(given.plots / f"{number:02d}.png", name, design, judged[0][1])
    print(f"\n{designed} designed, {len(refuted)} refuted; CPU seconds: median "
          f"{np.median(seconds):.1f}, largest {max(seconds):.1f}")  # fmt: skip


if __name__ == "__main__":
    main()
