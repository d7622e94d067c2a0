"""The weighting filters W_S, W_KS, W_T of the paper, diagonal for any number of channels."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Weights:
    """Parameters of W1, W2, W3 (paper, equations (4) to (6)).

        W1 = (s/M_S + ω_S)/(s + ω_S A_S)
        W2 = c_K (s + ω_K)/(M_K (s + c_K ω_K))
        W3 = (s + ω_T/A_l)/(A_u s + ω_T)

    With `disturbance` W_d > 0 the problem is the one with input disturbance d, in which W_d newtons
    weigh as much as one metre of reference:

        ‖[W1 I; W2 K; (W3/M_K) K] S [I  W_d G]‖∞

    Parameters
    ----------
    omega_S, omega_K, omega_T : float
        rad/s.
    M_K, disturbance : float
        N/m.
    M_S, A_S, c_K, A_l, A_u : float
        Without unit.

    Examples
    --------
    >>> w = Weights(M_S=2.0, A_S=1e-4, omega_S=100.0, c_K=1e4, omega_K=600.0, M_K=2e7,
    ...             A_l=1.0, A_u=1e-2, omega_T=250.0)
    >>> tuple(round(float(v), 4) for v in abs(w.responses(np.array([100.0]))[:, 0]))
    (1.118, 0.0, 1.077)
    """

    M_S: float
    A_S: float
    omega_S: float
    c_K: float
    omega_K: float
    M_K: float
    A_l: float
    A_u: float
    omega_T: float
    disturbance: float = 0.0

    @property
    def delta(self) -> float:
        """δ = W_d/M_K, the disturbance's weight in the units of the scaled plant; 0 without."""
        return self.disturbance / self.M_K

    def at(self, omega_S: float, omega_T: float) -> "Weights":
        """The same weights with other break frequencies, rad/s."""
        return replace(self, omega_S=omega_S, omega_T=omega_T)

    def scale(self, omega_0: float) -> NDArray[np.float64]:
        """The vector that the kernels take: frequencies over ω₀, M_K absorbed in the force."""
        return np.array(
            [
                self.M_S,
                self.A_S,
                self.omega_S / omega_0,
                self.c_K,
                self.omega_K / omega_0,
                self.A_l,
                self.A_u,
                self.omega_T / omega_0,
            ]
        )

    def filters(self) -> NDArray[np.float64]:
        """Pole, feedthrough and zero (3, 3) of W1, W2 and W3: each is feedthrough times
        (s + zero)/(s + pole)."""
        return np.array([
            (self.omega_S * self.A_S, 1.0 / self.M_S, self.omega_S * self.M_S),
            (self.c_K * self.omega_K, self.c_K / self.M_K, self.omega_K),
            (self.omega_T / self.A_u, 1.0 / self.A_u, self.omega_T / self.A_l),
        ])  # fmt: skip

    def responses(self, omega: NDArray[np.float64]) -> NDArray[np.complex128]:
        """The weights of S, KS and T at jω as rows (3, len(omega)); omega in rad/s.

        With a disturbance that of T (one channel: KSG) is δ W3.
        """
        pole, through, zero = self.filters().T[..., None]
        s = 1j * np.asarray(omega)
        found = through * (s + zero) / (s + pole)
        found[2] *= self.delta or 1.0
        return np.asarray(found)
