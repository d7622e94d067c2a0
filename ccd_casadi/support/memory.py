"""Memory that the C library holds back after large arrays are gone."""

import ctypes
import sys


def give_back() -> None:
    """Return it to the system; of glibc alone, which keeps what lies between blocks in use."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
