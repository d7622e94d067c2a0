"""Compiling kernels once, on two processes, with words; and doing so when a user comes first.

Numba compiles a function when it is first called and keeps it on disk, beside the sources or,
where these cannot be written, in the user's own cache. There are two groups, of which most jobs
need one: the synthesis (search for γ_opt, certificate) and structured loops (rows, curvature). A
group is compiled when its first kernel is called, on two processes; each loads from disk what the
other has already left there.

A stamp for each group beside the compiled kernels names the sources, Numba and the processor that
they are for. The first compilation that finds no such stamp starts the two processes, says so on
stderr, and waits: so does a program that imports this package as a library. A lock lets one process
compile; others wait for it. Ctrl-C leaves whole files only, and the next one goes on from these.
"""

import contextlib
import gc
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import binding
from numba.core.dispatcher import Dispatcher

from ccd_casadi.kernels import sources
from ccd_casadi.support.options import usable_cores
from ccd_casadi.support.terminal import Progress, say
from surrogates.files import write_whole

PACKAGE = __name__.rpartition(".")[0]
GROUPS = {"synthesis": ("search", "certificate"), "loops": ("rows", "curvature")}
PARTS = tuple(part for parts in GROUPS.values() for part in parts)
LOOPS = ("loop_grid", "loop_point", "modes", "sections")  # modules of that group
# Of both groups, and all that `check` needs: a few seconds, compiled where they are called.
SHARED = ("frequency", "linear_algebra")
WORKER = "CCD_CASADI_COMPILES"  # set in the processes that compile


@dataclass(frozen=True)
class CompilationOptions:
    """Seconds of one core, as measured, that each group is announced with."""

    synthesis: float = 37.0
    loops: float = 23.0


def compile_part(part: str) -> None:
    """Call the entry points of one part with arrays laid out as the Python layer passes them.

    One tiny problem serves all: SISO and MIMO have the same types.
    """
    if part in ("rows", "curvature"):
        return _compile_rows(part == "curvature")
    from ccd_casadi.kernels import certified_design as design
    from ccd_casadi.kernels import frequency, gamma, riccati, sensitivity
    from ccd_casadi.kernels import riccati_synthesis as synthesis
    from ccd_casadi.kernels.generalized_plant import generalized_plant, squared_weights
    from ccd_casadi.kernels.linear_algebra import lyapunov_triangular, stable_subspace

    # 1/(s² + 0.1 s + 1) with the paper's weights
    A, B, C = np.array([[0.0, 1.0], [-1.0, -0.1]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    w = np.array([2.0, 1e-4, 4.0, 1e4, 1.0, 1.0, 1e-2, 1.0])
    grid, none = np.geomspace(1e-2, 1e2, 41), np.zeros((1, 1))
    if part == "search":
        gp = generalized_plant(A, B, C, w)
        H0 = riccati.lqr_hamiltonian(gp)
        squared_weights(w, 1.0)
        stable_subspace(H0)
        lyapunov_triangular(-np.eye(2), np.eye(2), False)
        gamma.optimal_gamma(H0, gp.B1, gp.C1, gp.d1, 0.6, 0.0, 1e-11, 1e-7)
        synthesis.central_controller(gp, H0, 10.0)
        gamma.plant_gain(A, B, C, grid)
        gamma.gamma_lower_bound(frequency.prepare(A, B, C), w, grid, np.ones(41))
        squared_weights(w, grid)
        row = synthesis.synthesise(A, B, C, w, grid, np.ones(41), 1.02, 0.0, False)[0]
        if row[0] != 0.0:
            raise SystemExit("the compiled kernels find no controller where there is one")
    else:
        row = np.empty(int(design.Column.COUNT))
        judged = (A, B, C, -np.eye(5), np.ones((5, 1)), np.zeros((1, 5)), none)
        for delta in (0.0, 1.0):
            design.judge(*judged, w, delta, 1e5, 1e-2, row)
            if row[0] != design.Code.NO_BANDWIDTH:
                raise SystemExit("the compiled kernels refuse a loop that is open")
        G = frequency.prepare(A, B, C)
        sensitivity.sensitivity_gain(G, G, none, 1.0)
        frequency.response(G, 1.0)
        sensitivity.axis_frequencies(A, B, C, none, 1.0)


def _compile_rows(curvature: bool) -> None:
    from ccd_casadi.kernels import loop_grid, loop_point, modes
    from ccd_casadi.kernels.sections import Limit

    one, first, square = np.ones(1), np.zeros(1, np.int64), np.eye(1)
    plants = modes.Plants(np.full((1, 1, 4), -1.0 + 1.0j), np.ones((1, 1, 2, 1, 1)), 0.0, 0.0)
    controller = (np.zeros((1, 4), np.int64), one, first, square, square)
    limits = (np.ones((int(Limit.COUNT), 1)), np.zeros((3, 0, 1)), first[:0])
    loop = loop_point.LoopArrays(*controller, *plants, *limits, plants[:2], np.ones((1, 0, 1)))
    if curvature:
        modes.responses(plants, first, one)
        loop_grid.second(first, first, first, one, loop)
        side, four = np.ones((1, 1, 1), complex), np.ones((1, 1, 1, 1), complex)
        terms, apart = plants.terms[..., [0] * 6], four.real[..., None]
        kinds = np.zeros((1, 1), np.int8)
        slopes = modes.PlantSlopes(terms, side, side, side, apart, four, four, 0.0, 0.0, kinds)
        modes.form_slopes(slopes, first, one, side[0], side[0], False)
    else:
        loop_point.levels(first[None], first, square, loop, 0.0, loop_grid.NONE)
        loop_grid.merge(square, one + 0j, square + 0j, one, (0.5, 2.0), 1e-8, 1e3)
        loop_grid.maxima(square[..., None, None], square, square, 0.0)
        loop_grid.find_unseen(square[..., None, None], square, 0.0)
        loop_point.rows(first, first, first, one, loop)
        loop_point.close(first, first, first, one, one, one, loop, (1e-9, 1e-6, 40.0))


def group_of(module: str) -> str:
    """The group of a kernel, by the name of its module; empty of a shared one."""
    name = module.rpartition(".")[2]
    return "" if name in SHARED else "loops" if name in LOOPS else "synthesis"


def is_compiled(group: str) -> bool:
    """Whether the group's stamp says so."""
    return _read(_stamp(_folder(), group)) == _state()


def ensure_compiled(*groups: str, options: CompilationOptions = CompilationOptions()) -> None:
    """Compile groups of kernels on two processes unless their stamps say that they are.

    Words are on stderr. What a process leaves undone is compiled where it is needed, in silence.

    Parameters
    ----------
    groups : str
        Names; all groups if none is given.
    options : CompilationOptions
    """
    groups = groups or tuple(GROUPS)
    if all(map(is_compiled, groups)):
        return
    folder = _folder()
    state = _state()  # before: sources may change meanwhile
    with _alone(folder / "compiled.lock"):
        missing = [group for group in groups if _read(_stamp(folder, group)) != state]
        if not missing:  # another process has done it
            return
        parts = tuple(part for group in missing for part in GROUPS[group])
        count, seconds = (
            min(len(parts), usable_cores()),
            sum(getattr(options, group) for group in missing),
        )
        kernels = {name: kernel for name, kernel in _kernels().items()
                   if group_of(name.rpartition(".")[0]) in ("", *missing)}  # fmt: skip
        _say(
            "ccd_casadi: compiling its numerical kernels, once for this installation and processor:"
            f" about {seconds / count:.0f} s on {count} core{'s' if count > 1 else ''}"
        )
        try:
            done = _compile(kernels, folder, parts, count)
        except OSError as error:  # no process to be had: the kernels compile as they are called
            _say(f"ccd_casadi: not done beforehand ({error})")
            return
        for group in missing if done else ():
            with contextlib.suppress(OSError):
                write_whole(_stamp(folder, group), state)


def _stamp(folder: Path, group: str) -> Path:
    return folder / f"compiled_{group}.stamp"


def _compile(kernels: dict[str, Any], folder: Path, parts: tuple[str, ...], count: int) -> bool:
    """Run the parts on `count` processes, with a bar of kernels; whether all ended well."""
    root = str(Path(__file__).parents[PACKAGE.count(".") + 1])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))
    settings = os.environ | {WORKER: "1", "PYTHONPATH": path}
    began, workers = time.time(), []
    # not -m, with which the package would import all that its commands need
    start = [sys.executable, "-c", f"from {PACKAGE} import compilation as c; c.work()"]
    with Progress(len(kernels), "compiling kernels") as bar:
        try:
            for first in range(count):
                command = [*start, *parts[first::count]]
                workers.append(subprocess.Popen(command, env=settings, stdout=subprocess.DEVNULL))
            while any(worker.poll() is None for worker in workers):
                time.sleep(0.1)
                written = sum(file.stat().st_mtime > began for file in folder.glob("*.nbi"))
                bar.advance(written - bar.done)
            done = all(worker.wait() == 0 for worker in workers)
            bar.advance(len(kernels) - bar.done if done else 0)  # what was on disk already
        finally:
            for worker in workers:
                worker.kill()
                worker.wait()
    return done


def _kernels() -> dict[str, Any]:
    """Every kernel, by module and name."""
    names = ("certified_design", "gradients", "loop_grid", "loop_point", "modes")
    for name in names:  # with them all the others
        import_module(f"{PACKAGE}.{name}")
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith(PACKAGE + "."):
            for kernel in vars(module).values():
                # a part of others is compiled in these
                if isinstance(kernel, Dispatcher) and not kernel.targetoptions.get("inline"):
                    found[f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"] = kernel
    return found


def _folder() -> Path:
    """Return where Numba keeps the kernels, by one module whose import brings no other."""
    return Path(import_module(f"{PACKAGE}.linear_algebra").schur.stats.cache_path)


def _state() -> str:
    """Return what compiled kernels depend on: sources, versions, processor."""
    machine = [sys.version, binding.get_host_cpu_name()]
    return "\n".join([sources(), *machine, *(version(name) for name in ("numba", "llvmlite"))])


def _read(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""


@contextlib.contextmanager
def _alone(file: Path) -> Iterator[None]:
    """Hold a lock on a file; nothing where the system has no such locks or the file no place."""
    try:
        import fcntl

        file.parent.mkdir(parents=True, exist_ok=True)
        handle = file.open("a")
    except (ImportError, OSError):
        yield
        return
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            _say("ccd_casadi: waiting for another process that compiles the kernels")
            with contextlib.suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def _say(words: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # stderr is closed
        say(words, sys.stderr)


def work() -> None:
    """Compile the parts that the command line names; Ctrl-C ends it without words."""
    gc.set_threshold(100_000, 50, 1000)  # rarely: a seventh of the time, for 200 MB
    try:
        for part in sys.argv[1:]:
            compile_part(part)
    except KeyboardInterrupt:  # whoever started this process hears it as well
        os._exit(130)
