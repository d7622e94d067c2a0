"""The decorators of the kernels: compiled, cached on disk, 1/0 = inf as in NumPy."""

import os
from importlib import import_module
from typing import Any

from numba import njit
from numba.core import event

# without an entry for C callbacks, which nobody calls: a tenth less to compile
_OPTIONS = {"cache": True, "error_model": "numpy", "no_cfunc_wrapper": True, "nogil": True}
compiled = njit(**_OPTIONS)
# A kernel's part under its own name. Of what a kernel calls Numba makes machine code first, and
# optimises it anew in the caller: a fifth more to compile.
inlined = njit(**_OPTIONS, inline="always")
PACKAGE = __name__.rpartition(".")[0]


class _FirstCompilation(event.Listener):
    """The listener for a kernel that is not on disk: all of its group are compiled at once, with
    words."""

    def __init__(self) -> None:
        self.alone = "CCD_CASADI_COMPILES" in os.environ  # by itself, one after the other
        self.seen: set[str] = set()

    def on_start(self, event: Any) -> None:
        module = event.data["dispatcher"].py_func.__module__
        if self.alone or not module.startswith(PACKAGE + "."):
            return
        compilation = import_module(f"{PACKAGE}.compilation")  # which itself imports the kernels
        group = compilation.group_of(module)
        if group and group not in self.seen:
            self.seen.add(group)
            compilation.ensure_compiled(group)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _FirstCompilation())
