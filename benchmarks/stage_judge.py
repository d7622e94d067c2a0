"""The stage plants of control_benchmark (W. Ohnishi, University of Tokyo), by its own scores.

    python benchmarks/stage_judge.py

P8th: a ball-screw stage of order 8; |S| at most 2, and the 2-norm of the position after a unit step
of force, sampled at 1 kHz for 50 s (`prob1_posPID.m`), beside the PID that the file comes with.
P4th: a stage measured at three heights, of which the file gives no controller: one for each, and
one for the first two. Numbers from github.com/WataruOhnishi/control_benchmark (MIT), no code.
"""

import control
import numpy as np
from peer_table import keep

import ccd_casadi as ccd

RATE, DELAY, S_MAX = 1e4, 1e-3, 2.0  # Hz, s: without a delay the score has no end
ZEROS = 1e3 * np.array([-0.153329147774075 + 1.825673570553010j,
                        -0.039126477290724 + 0.601973241891408j,
                        -0.003170161097733 + 0.273922740595655j])  # fmt: skip
POLES = 1e3 * np.array([-0.131098843525143 + 1.868124153338216j,
                        -0.022700067819691 + 0.559791345771639j,
                        -0.005446668039055 + 0.191363603871908j])  # fmt: skip
SLOW, GAIN = -2.100774089528, 0.990921091595854
HEIGHTS = (0.0, 0.085, 0.3)  # m


def eighth() -> control.StateSpace:
    """P8th, force to position."""
    zeros, poles = (np.concatenate([x, x.conj()]) for x in (ZEROS, POLES))
    return control.ss(control.zpk(zeros, np.concatenate([[0.0, SLOW], poles]), GAIN))


def fourth(height: float) -> control.StateSpace:
    """P4th measured at a height."""
    M, m, J, C, k, mu, L, g = 7.7, 5.3, 0.015, 24.0, 1700.0, 0.20, 0.092, 9.8
    a4 = M * m * L**2 + M * J + m * J
    a3 = M * mu + m * mu + (m * L**2 + J) * C
    a2 = M * k + m * k - M * m * g * L - m**2 * g * L + mu * C
    a1 = (k - m * g * L) * C
    above = [m * L**2 + J - m * L * height, mu, k - m * g * L]
    return control.ss(control.tf(above, [a4, a3, a2, a1, 0.0]))


def scores(G: control.StateSpace, K: control.StateSpace) -> tuple[bool, float, float, float]:
    """Stable, max |S|, -3 dB of S in rad/s, 2-norm of y after a step of force."""
    omega = np.geomspace(1e-2, 1e5, 40000)
    S = np.abs(1.0 / (1.0 + (G(1j * omega) * K(1j * omega))))
    loop = control.feedback(G, K)
    t = np.arange(0.0, 50.0 + 5e-4, 1e-3)
    y = control.step_response(loop, t).outputs
    stable = bool((loop.poles().real < 0.0).all())
    return (
        stable,
        float(S.max()),
        float(omega[np.argmax(2.0 * S**2 > 1.0)]),
        float(np.linalg.norm(y)),
    )


def tuned(plants: list[control.StateSpace], biquads: int) -> control.StateSpace:
    """Sections by `ccd.tune`."""
    structure = ccd.Structure(lead=1, biquads=biquads)
    K = ccd.tune(
        plants, rate_hz=RATE, delay=DELAY, S_max=S_MAX, structure=structure, starts=12
    ).controller
    return control.ss(K.A, K.B, K.C, K.D)


def main() -> None:
    s = control.tf("s")
    pid = control.ss(25.0 + 40.0 / s + 4.0 * s / (0.01 * s + 1.0))
    rows = []
    theirs, ours = (scores(eighth(), K) for K in (pid, tuned([eighth()], 3)))
    for own in (theirs, ours):
        print("P8th: stable {}, |S| {:.3f}, -3 dB at {:.4g} rad/s, step {:.4g}".format(*own))
    rows.append(["P8th: \\|S\\| at most 2; norm of the step of force",
                 f"{theirs[1]:.2f}; {theirs[3]:.3g} (PID as given)",
                 f"{ours[1]:.2f}; {ours[3]:.3g}"])  # fmt: skip
    for heights in ((HEIGHTS[0],), (HEIGHTS[1],), (HEIGHTS[2],), HEIGHTS[:2]):
        K = tuned([fourth(h) for h in heights], 1)
        found = [scores(fourth(h), K) for h in heights]
        for one in found:
            print(heights, "stable {}, |S| {:.3f}, -3 dB at {:.4g} rad/s".format(*one[:3]))
        at = " and ".join(f"{h:g}" for h in heights)
        width, peak = min(one[2] for one in found), max(one[1] for one in found)
        rows.append([f"P4th at {at} m: -3 dB of S; \\|S\\|", "no controller given",
                     f"{width:.3g} rad/s; {peak:.2f}"])  # fmt: skip
        assert all(one[0] for one in found)
    keep("nano stage", rows)


if __name__ == "__main__":
    main()
