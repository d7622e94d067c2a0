"""Memory that is let go, and that the system gets back."""

import ctypes
from contextlib import suppress

LARGE = 24_000_000  # bytes of what has its own pages: at 8 MB page faults take 3 s of a solve
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of glibc's mallopt


def large_arrays_apart() -> None:
    """From now on the pages of a large array go back as it is freed, where the C library is glibc.

    By itself it takes up to 32 MB from the heap, where whatever small is made later keeps the pages
    of what was large: a quarter of a gigabyte after the matrices of some finite elements.
    """
    with suppress(AttributeError, OSError, TypeError):  # another library, another system
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_THRESHOLD, LARGE)
        mallopt(TRIM_THRESHOLD, 2 * LARGE)
