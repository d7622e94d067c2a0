"""Scrambled Sobol points, bit for bit those of `scipy.stats.qmc.Sobol`, without its import.

`scipy.stats` takes half a second to import, as long as everything else that a solve needs of SciPy;
the sequence is thirty lines. Beyond `DIMENSIONS` inputs SciPy's own is called.

Source: Bratley & Fox, ACM Trans. Math. Softw. 14 (1988), algorithm 659; direction numbers of Joe &
Kuo, SIAM J. Sci. Comput. 30 (2008); scrambling by random linear maps and a shift: Matoušek,
J. Complexity 14 (1998).
"""

import numpy as np
from numpy.typing import NDArray

from surrogates.interface import Array

BITS = 30
# Of every dimension but the first: a primitive polynomial modulo 2, its coefficients the bits of a
# number, and the first direction numbers.
DIRECTIONS = (
    (3, (1,)),
    (7, (1, 3)),
    (11, (1, 3, 1)),
    (13, (1, 1, 1)),
    (19, (1, 1, 3, 3)),
    (25, (1, 3, 5, 13)),
    (37, (1, 1, 5, 5, 17)),
    (41, (1, 1, 5, 5, 5)),
    (47, (1, 1, 7, 11, 19)),
    (55, (1, 1, 5, 1, 1)),
    (59, (1, 1, 1, 3, 11)),
    (61, (1, 3, 5, 5, 31)),
    (67, (1, 3, 3, 9, 7, 49)),
    (91, (1, 1, 1, 15, 21, 21)),
    (97, (1, 3, 1, 13, 27, 49)),
)
DIMENSIONS = 1 + len(DIRECTIONS)


def scrambled_sobol(d: int, m: int, seed: int) -> Array:
    """The first 2^m points (2^m, d) of the sequence in the unit box, m <= 30."""
    rng = np.random.default_rng(seed)
    if d > DIMENSIONS:
        from scipy.stats import qmc

        return np.asarray(qmc.Sobol(d, scramble=True, rng=rng).random_base2(m))
    rng = rng.spawn(1)[0]  # as SciPy does
    powers = 2 ** np.arange(BITS, dtype=np.uint32)
    shift = rng.integers(2, size=(d, BITS), dtype=np.uint32) @ powers
    maps = np.tril(rng.integers(2, size=(d, BITS, BITS), dtype=np.uint32), -1)
    maps |= np.eye(BITS, dtype=np.uint32)
    # columns j of `digits`: the j-th direction number in binary, first digit first
    digits = (_direction_numbers(d)[:, None, :] // powers[::-1, None]) % 2
    numbers = np.einsum("dpj,p->dj", (maps @ digits) % 2, powers[::-1])
    # Gray code: the next point differs by the direction number of the lowest zero bit of its index
    index = np.arange(2**m - 1)
    lowest = np.log2((index + 1) & ~index).astype(int)
    steps = np.vstack([shift, numbers[:, lowest].T])
    return np.bitwise_xor.accumulate(steps, axis=0) / 2.0**BITS


def _direction_numbers(d: int) -> NDArray[np.uint32]:
    """(d, 30), each a multiple of its last binary place."""
    found = np.ones((d, BITS), dtype=np.uint32)
    for row, (polynomial, first) in zip(found[1:], DIRECTIONS, strict=False):
        degree = len(first)
        row[:degree] = first
        for j in range(degree, BITS):
            row[j] = row[j - degree]
            for k in range(1, degree + 1):
                if polynomial >> (degree - k) & 1:
                    row[j] ^= row[j - k] << k
    return found << np.arange(BITS - 1, -1, -1, dtype=np.uint32)
