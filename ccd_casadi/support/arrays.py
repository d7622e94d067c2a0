"""The array type, and linear recurrences of arrays."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def states(A: Array, driven: Array) -> Array:
    """Compute the states of x_{k+1} = A x_k + d_k from rest.

    Those of even k are a recurrence of half the length, x_{k+2} = A² x_k + (A d_k + d_{k+1}), and
    those of odd k follow from them: log N products of matrices instead of N of vectors.

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
    count = len(driven)
    d = np.zeros((count + count % 2, len(A)))
    d[:count] = driven
    x = np.zeros_like(d)
    if count <= 16:  # as many powers of A would lose digits, and win no time
        for k in range(count - 1):
            x[k + 1] = A @ x[k] + d[k]
    else:
        x[::2] = states(A @ A, d[::2] @ A.T + d[1::2])
        x[1::2] = x[::2] @ A.T + d[::2]
    return x[:count]
