"""From a measured response to a robust design, judged on the plant that nobody told: how often?

    python benchmarks/measured_modes.py [--draws 100]

Each draw: 800 lines of an unknown stage (its suspension and its modes above the band are in no
model) with 1 % complex noise; modes and their covariance; a controller of sections on the ends of
the 99.9 % ellipsoid, at 10 kHz with 100 us; and the judge on the true plant.
"""

import argparse

import control
import numpy as np

import ccd_casadi as ccd
from ccd_casadi.fixed_structure.measured import MeasuredResponse
from ccd_casadi.fixed_structure.modal_fit import fit_modes

MODES = ((180.0, 0.008, 0.03), (420.0, 0.012, -0.02), (790.0, 0.006, 0.015),
         (2600.0, 0.02, 0.03), (5200.0, 0.01, -0.01))  # fmt: skip
LINES = np.geomspace(3.0, 1500.0, 800)  # Hz
BOUNDS = ccd.Bounds(S_max=1.8, S_low=0.1, omega_low=2.0 * ccd.HZ, shape=1.1)
STRUCTURE = ccd.Structure(lead=1, biquads=0, roll_off=2)
SAMPLING = ccd.Sampling(rate_hz=10e3, delay_us=100.0)
M_K = 2e6
FEW, ROUNDS = 5, 6  # plants of the set that a design begins with; worst ones added so often


def true_plant() -> control.StateSpace:
    """20 kg on a soft suspension, and five modes of which the band shows three."""
    mode = 2.0 * np.pi * 0.5
    parts = [control.tf([1.0], [20.0, 20.0 * 0.6 * mode, 20.0 * mode**2])]
    for hz, damping, gain in MODES:
        omega = ccd.HZ * hz
        parts.append(control.tf([gain], [1.0, 2.0 * damping * omega, omega**2]))
    return control.parallel(*(control.ss(part) for part in parts))


def measured(seed: int, noise: float = 0.01) -> MeasuredResponse:
    rng = np.random.default_rng(seed)
    parts = rng.normal(size=(2, len(LINES))) / np.sqrt(2.0)
    G = true_plant()(2j * np.pi * LINES)
    return MeasuredResponse(LINES, G * (1.0 + noise * (parts[0] + 1j * parts[1])))


def designed(
    response: MeasuredResponse, initial: list[np.ndarray], starts: int, members: list[int]
) -> tuple:
    """A design on `members` of the set, and the judge's word on all; those that break one join.

    `members` grows: the next draw begins with the plants that were worst in this one.
    """
    plants = fit_modes(response).set_of_plants()
    scaled = [ccd.plant_from_control(plant, M_K) for plant in plants]
    for _ in range(ROUNDS):
        design = ccd.synthesise_sections(
            [plants[i] for i in members if i < len(plants)], STRUCTURE, BOUNDS,
            sampling=SAMPLING, M_K=M_K, starts=starts, initial=initial,
        )  # fmt: skip
        if not design.certified:
            return design, None
        on_set = ccd.certify(scaled, design.controller, BOUNDS, SAMPLING)
        if on_set.passed:
            break
        shares = [max(BOUNDS.shares(figures).values()) for figures in on_set.plants]
        broken = sorted(
            (i for i in range(len(plants)) if shares[i] > 1.0), key=lambda i: -shares[i]
        )
        members += [i for i in broken if i not in members][:3]
        initial, starts = [design.kappa], 1
    return design, on_set


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--draws", type=int, default=100)
    draws = arguments.parse_args().draws
    truth = [ccd.plant_from_control(true_plant(), M_K)]
    kappa: list[np.ndarray] = []
    held, hz, excess, members = 0, [], [], list(range(FEW))
    for seed in range(draws):
        design, on_set = designed(measured(seed), kappa, 1 if kappa else 4, members)
        if on_set is None:
            print(f"draw {seed}: {design.words}")
            continue
        kappa = kappa or [design.kappa]
        judged = ccd.certify(truth, design.controller, BOUNDS, SAMPLING)
        held += judged.passed
        hz.append(design.bandwidth / ccd.HZ)
        excess.append(max(judged.worst.values(), default=np.inf))
        if not (judged.passed and on_set.passed):
            print(f"draw {seed}: true plant: {judged.words}; whole set: {on_set.words}")
    print(f"{held} of {draws} hold on the true plant; {min(hz):.2f} to {max(hz):.2f} Hz, "
          f"at most {max(excess):.6f} of a bound there")  # fmt: skip


if __name__ == "__main__":
    main()
