"""The designed controller on the nonlinear axis, sample by sample, with nothing of the package.

    python examples/magnetic_axis/simulate.py RUN_DIR

lets go of the body 10 µm off the middle and prints where it is. The magnets' force is the whole
square law, amplifier and sensor are differential equations, K is its difference equation, and the
current comes a period late.
"""

import json
import sys
from pathlib import Path

import numpy as np

MAGNET, AMPLIFIER, SENSOR, DAMPING = 6e-6, 2.0 * np.pi * 2000.0, 2.0 * np.pi * 5000.0, 0.7
PERIOD, STEPS = 1e-4, 20  # s, and steps of Runge and Kutta in each


def simulate(folder: Path, off: float = 1e-5, samples: int = 2000) -> np.ndarray:
    """Positions (m) at the samples, from `off` at rest."""
    theta = json.loads((folder / "result.json").read_text())["theta"]
    stored = json.loads((folder / "controller.json").read_text())
    A, B, C, D = (np.array(stored[name], float) for name in "ABCD")
    left = np.linalg.inv(np.eye(len(A)) - 0.5 * PERIOD * A)
    A, B, C, D = (
        left @ (np.eye(len(A)) + 0.5 * PERIOD * A), left @ B * PERIOD,
        C @ left, D + 0.5 * PERIOD * C @ left @ B,
    )  # fmt: skip
    mass, gap, bias = theta["mass"], 1e-3 * theta["gap"], theta["bias"]

    def rates(x: np.ndarray, command: float) -> np.ndarray:
        """Of current, position, velocity, reading and its rate."""
        i, q, v, y, w = x
        pull = MAGNET * ((bias + i) ** 2 / (gap - q) ** 2 - (bias - i) ** 2 / (gap + q) ** 2)
        filtered = SENSOR**2 * (q - y) - 2.0 * DAMPING * SENSOR * w
        return np.array([AMPLIFIER * (command - i), v, pull / mass, w, filtered])

    x, state, late, found = np.array([0.0, off, 0.0, off, 0.0]), np.zeros((len(A), 1)), 0.0, []
    h = PERIOD / STEPS
    for _ in range(samples):
        error = -x[3]
        command, state = float((C @ state + D * error)[0, 0]), A @ state + B * error
        for _ in range(STEPS):
            a = rates(x, late)
            b = rates(x + 0.5 * h * a, late)
            c = rates(x + 0.5 * h * b, late)
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + rates(x + h * c, late))
        late = command
        found.append(x[1])
    return np.array(found)


if __name__ == "__main__":
    moved = 1e6 * simulate(Path(sys.argv[1]))
    for ms in (1, 2, 5, 10, 20, 50, 100):
        print(f"after {ms:3d} ms: {moved[10 * ms - 1]:10.5f} um")
