"""The array type, and linear recurrences of arrays."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def states(A: Array, driven: Array) -> Array:
    """Compute the states of x_{k+1} = A x_k + d_k from rest.

    About √N pieces of √N steps advance side by side from rest; the state at the start of each piece
    follows from the piece before, and its decay is added: 3√N products instead of N.

    Parameters
    ----------
    A : array (n, n)
    driven : array (N, n)
        d.

    Returns
    -------
    array (N, n)
        x_k, k = 0 … N-1.
    """
    steps = max(int(np.ceil(np.sqrt(len(driven)))), 1)
    pieces = -(-len(driven) // steps)
    padded = np.zeros((pieces * steps, len(A)))
    padded[: len(driven)] = driven
    d = padded.reshape(pieces, steps, len(A))
    x = np.zeros((pieces, steps + 1, len(A)))
    for k in range(steps):
        x[:, k + 1] = x[:, k] @ A.T + d[:, k]
    start = np.zeros((pieces, len(A)))
    whole = np.linalg.matrix_power(A, steps)
    for i in range(pieces - 1):
        start[i + 1] = whole @ start[i] + x[i, steps]
    for k in range(steps):
        x[:, k] += start
        start = start @ A.T
    return x[:, :steps].reshape(-1, len(A))[: len(driven)]
