"""The compiled kernels.

Numba's cache on disk notices a change in a kernel's own file, not in one that it calls. So the
whole cache is dropped here when any source of this package is not the one it was made from.
"""

import contextlib
from pathlib import Path

from surrogates.files import write_whole


def sources() -> str:
    """Names, sizes and times of all sources of the kernels, a line each."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return "\n".join(f"{f.name} {f.stat().st_size} {f.stat().st_mtime_ns}" for f in files)


def _drop_stale_cache() -> None:
    cache, now = Path(__file__).parent / "__pycache__", sources()
    stamp = cache / "sources.stamp"
    with contextlib.suppress(OSError):
        if stamp.read_text() == now:
            return
    # Several processes may do this at once: each deletes what is there and writes the same stamp,
    # in one step. A directory that cannot be written keeps a cache that numba checks by itself.
    with contextlib.suppress(OSError):
        cache.mkdir(exist_ok=True)
        for file in (*cache.glob("*.nbi"), *cache.glob("*.nbc")):
            file.unlink(missing_ok=True)
        write_whole(stamp, now)


_drop_stale_cache()
