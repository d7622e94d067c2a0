"""Where a plant comes from: a shipped model, or a function in a file of the user and the files
that it depends on."""

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.machinery import PathFinder, SourceFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ccd_casadi.analysis import Loads
from ccd_casadi.lti.wiring import UNWIRED, Wiring
from ccd_casadi.plants.model_function import ModelFunction, widen
from ccd_casadi.plants.plant import Plant
from ccd_casadi.plants.registry import model_named
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.user_code import (
    MODULE,
    GivenFunction,
    raised_words,
    require_user_code,
    with_time_limit,
)

if TYPE_CHECKING:
    from ccd_casadi.analysis.motor import Motion
    from ccd_casadi.plants.places import Places

INSTALLED = {"site-packages", "dist-packages"}
STANDARD = Path(ast.__file__).parent
OURS = Path(__file__).parents[1]


def files_of(path: Path, words: Iterable[str] = ()) -> tuple[Path, ...]:
    """The file at a path first, then what it depends on, by name; `words` may name files too.

    Of a folder that is named, the files in it. Raises OSError where the first cannot be read.
    """
    first = path.resolve()
    first.read_bytes()
    found, waiting = {first: None}, [first]
    named = list(_beside(words, (first.parent, Path.cwd())))
    while waiting:
        module = waiting.pop()
        try:
            tree = ast.parse(module.read_bytes())
        except (OSError, SyntaxError, ValueError, RecursionError):
            continue  # reported where the file is loaded
        strings = [
            node.value for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]  # fmt: skip
        named += _beside(strings, (module.parent, Path.cwd()))
        for other in _find_imported(tree, module, first.parent):
            if other not in found:
                found[other] = None
                waiting.append(other)
    return (first, *sorted({*list(found)[1:], *named} - {first}))


def digest_of(files: tuple[Path, ...]) -> str:
    """SHA-256 of a file; of several by where they lie from the first, and their content."""
    each = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    if len(each) == 1:
        return each[0]
    base = files[0].parent
    lines = (
        f"{file.relative_to(base) if file.is_relative_to(base) else file.name}\0{one}\n"
        for file, one in zip(files, each, strict=True)
    )
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def find_loaded(files: Iterable[Path]) -> list[str]:
    """Names of modules in this process that come from these files."""
    known = set(files)
    return [name for name, place in _own_modules() if place in known] if known else []


def find_unseen(files: Iterable[Path], before: Iterable[str]) -> list[Path]:
    """Modules in the folder of the first file that were loaded since, and are not among these."""
    known, old = list(files), set(before)
    return [
        place for _, place in _own_modules(old)
        if place not in known and place.is_relative_to(known[0].parent)
    ]  # fmt: skip


def _own_modules(but: Set[str] = frozenset()) -> Iterator[tuple[str, Path]]:
    """The user's modules in this process; to resolve a place is dear, with thousands of them."""
    for name, module in list(sys.modules.items()):
        origin = None if name in but else getattr(module, "__file__", None)
        if name != "__main__" and isinstance(origin, str) and _own(place := Path(origin).resolve()):
            yield name, place


def _own(place: Path) -> bool:
    """Whether a module's file is neither installed, nor of Python's library, nor ours."""
    if INSTALLED & set(place.parts) or place.suffix != ".py":
        return False
    return not (place.is_relative_to(STANDARD) or place.is_relative_to(OURS))


def _find_imported(tree: ast.AST, module: Path, folder: Path) -> Iterator[Path]:
    """Files of the user's modules that a text imports anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _modules(alias.name, None, folder)
        elif isinstance(node, ast.ImportFrom):
            base = [str(module.parents[node.level - 1])] if node.level else None
            head = f"{node.module}." if node.module else ""
            for name in {head.rstrip("."), *(head + alias.name for alias in node.names)} - {""}:
                yield from _modules(name, base, folder)


def _modules(name: str, base: list[str] | None, folder: Path) -> Iterator[Path]:
    """The file of a dotted name and of each package above it; nothing is executed."""
    places = base
    for part in name.split("."):
        spec = PathFinder.find_spec(part, places)
        if spec is None and places is None:
            spec = PathFinder.find_spec(part, [str(folder)])
        if spec is None:
            return
        if spec.origin is not None and _own(Path(spec.origin).resolve()):
            yield Path(spec.origin).resolve()
        if spec.submodule_search_locations is None:
            return
        places = list(spec.submodule_search_locations)


def _beside(words: Iterable[str], folders: Iterable[Path], *, longest: int = 255) -> Iterator[Path]:
    """The files that strings (of `longest` letters at most) name, those in a named folder too."""
    for word in set(words):
        if not word.strip("./ ") or len(word) > longest or "\0" in word or "\n" in word:
            continue
        for folder in folders:
            place = (folder / word).resolve()
            if folder.resolve().is_relative_to(place):
                continue  # a folder above says nothing
            if place.is_file():
                yield place
            elif place.is_dir() and not _holds_run(place):
                yield from (item for item in place.iterdir() if item.is_file())


def _holds_run(folder: Path) -> bool:
    """Whether a folder is that of a run, which is written while the plant is in use: a case
    table.toml with the option "table" names its own."""
    results = folder / "case.toml", folder / "result.json"
    return any(folder.glob("samples*.sqlite")) or all(file.is_file() for file in results)


Names = tuple[str, ...]
Ends = tuple[float, ...]


@dataclass(frozen=True)
class PlantSource:
    """The origin of a plant: a shipped model, or a function in a file, and its options.

    Attributes
    ----------
    model, file, function : str or None
        A name of the registry, or `file.py` and the function in it.
    options : tuple of (str, object)
        Keyword arguments.
    seconds : float
        Time limit of a function; it is not part of the plant's identity.
    content : str or None
        SHA-256 of its files as the case was read; None: as they are now.
    fixed : tuple of (name, value, unit)
        Parameters that are not in θ.
    places : Places or None
        Positions of its forces and sensors, if these are not at nodes.
    motion : Motion or None
        The move that it is for, and its motors.
    wiring : Wiring
        What lies before its forces and behind its sensors.
    given : GivenFunction or None
        A function of a program, whose `content` the program states.
    wide : bool
        With its disturbance as further inputs, and its performance as further outputs; of a wired
        plant with those of the mechanics where it has none, and with the actuators' forces.
    """

    model: str | None
    file: str | None
    function: str | None
    options: tuple[tuple[str, object], ...]
    seconds: float = 60.0
    content: str | None = None
    fixed: tuple[tuple[str, float, str], ...] = ()
    places: "Places | None" = None
    motion: "Motion | None" = None
    wiring: Wiring = UNWIRED
    given: GivenFunction | None = field(default=None, compare=False)
    wide: bool = False

    @property
    def name(self) -> str:
        """The name of the model, or of the function and its file."""
        return self.model or ":".join(filter(None, (self.file, self.function)))

    @property
    def held(self) -> dict[str, float]:
        """The fixed parameters' values."""
        return {name: value for name, value, _ in self.fixed}

    def with_options(self, options: Iterable[tuple[str, object]]) -> "PlantSource":
        """The same with some options replaced."""
        merged = tuple(sorted((dict(self.options) | dict(options)).items()))
        return replace(self, options=merged)

    def pin(self) -> "PlantSource":
        """The same, with the hash of its files' content: a process must not keep an older one."""
        if self.file is None or self.content is not None:
            return self
        try:
            content = digest_of(self.files())
        except OSError as error:
            raise PlantError(f"{self.file}: cannot be read: {error.strerror}") from None
        return replace(self, content=content)

    def files(self) -> tuple[Path, ...]:
        """List its file, and those that this depends on (`plant_files`)."""
        assert self.file is not None
        words = [value for _, value in self.options if isinstance(value, str)]
        return files_of(Path(self.file), words)

    def identity(self) -> dict[str, object]:
        """Return what determines the plant; a file counts by its content, not by its place."""
        digest = self.pin().content
        options = dict(self.options)
        model = model_named(self.model)
        if data := model.data if model else "":
            digest = _digest(Path(str(options.pop(data, ""))))
        return {
            "model": self.model,
            "function": self.function,
            "source": digest,
            "options": options,
            **({"fixed": self.held} if self.fixed else {}),
            **({"places": self.places.identity} if self.places else {}),
            **({"motion": repr(self.motion)} if self.motion else {}),
            **self._identity_of_loads(),
            **({"wiring": repr(self.wiring)} if self.wiring else {}),
        }

    def _identity_of_loads(self) -> dict[str, str]:
        """What its motors move beside the model, where they limit the move."""
        motion = self.motion
        if motion is None or motion.motor is None or motion.loads == Loads():
            return {}
        return {"loads": repr(motion.loads)}


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of every file in a folder, by name and content."""
    found = hashlib.sha256()
    for file in [path] if path.is_file() else sorted(item for item in path.glob("*")):
        if file.is_file():
            content = hashlib.sha256(file.read_bytes()).hexdigest()
            found.update(f"{'' if file == path else file.name}\0{content}\n".encode())
    return found.hexdigest()


def plant_from(source: PlantSource, names: Names, lower: Ends, upper: Ends) -> Plant:
    """The plant with parameters `names`, built once in a process.

    The box is where a function of plain numbers is tried, and what its differences do not leave.
    Raises UserError where the plant cannot be built, and UserCodeRefused where a user's function
    must not run.
    """
    if source.model is None:
        require_user_code(source.name)
    elif source.motion is None and source.places is None and not source.wiring:
        lower = upper = ()  # a shipped model is the same in any box
    return _build(source.pin(), names, lower, upper)


@lru_cache(maxsize=24)
def _build(source: PlantSource, names: Names, lower: Ends, upper: Ends) -> Plant:
    """Build the plant by its move, its places or its fixed parameters from the plant below."""
    if source.motion is not None:
        motion = source.motion
        size = () if motion.motor is None else (motion.motor.size,)
        plant = _below(replace(source, motion=None), size, names, lower, upper)
        own = replace(source, motion=None, wide=False)  # motors are where its own inputs are
        count = _below(own, size, names, lower, upper).inputs if source.wide else plant.inputs
        from ccd_casadi.analysis.driven_plant import with_motion

        def loads() -> list[Plant]:
            """The plant of every option, over θ and what varies, as a set of plants has them."""
            ranges = motion.loads.ranges
            varying = tuple(name for name, *_ in ranges)
            alone = replace(own, fixed=tuple(f for f in own.fixed if f[0] not in varying))
            return [
                _below(alone.with_options(options), size, (*names, *varying),
                       (*lower, *(low for _, low, *_ in ranges)), (*upper, *(r[3] for r in ranges)))
                for options in ((), *motion.loads.options)
            ]  # fmt: skip

        return with_motion(plant, motion, names, source.held, count, loads)
    if wiring := source.wiring:
        from ccd_casadi.plants.fixed_parameters import with_wiring

        bare = replace(source, wiring=UNWIRED)
        plant = plant_from(bare, names, lower, upper)
        if source.wide:
            narrow = plant_from(replace(bare, wide=False), names, lower, upper)
            wiring = replace(wiring, own=(narrow.outputs, narrow.inputs))
        return with_wiring(plant, wiring)
    held = source.held
    if source.places is not None:
        from ccd_casadi.plants.places import place_ports

        places = source.places
        held = {name: value for name, value in held.items() if name in places.names}
        plant = _below(replace(source, places=None), places.names, names, lower, upper)
        plant = place_ports(plant, places, (*names, *held))
    elif source.model is not None:
        model = model_named(source.model)
        assert model is not None
        plant = model.build((*names, *held), **dict(source.options))
    else:
        function = _own_function(source)
        from ccd_casadi.plants.differenced import user_plant
        from ccd_casadi.plants.fixed_parameters import fixed_model

        function = fixed_model(widen(function) if source.wide else function, held)
        plant = user_plant(function, names, dict(source.options), lower, upper)
        if not plant.ports:
            return plant
        words = f"compliance and error budget are {plant.between}; the move's error too"
        return replace(plant, notes=lambda theta: (*plant.notes(theta), words))
    if not held:
        return plant
    from ccd_casadi.plants.fixed_parameters import with_fixed

    return with_fixed(plant, held)


def _below(
    source: PlantSource, taken: Sequence[str], names: Names, lower: Ends, upper: Ends
) -> Plant:
    """The plant of a source as a function of the parameters that are not `taken`."""
    at = [i for i, name in enumerate(names) if name not in taken]
    fixed = tuple(item for item in source.fixed if item[0] not in taken)
    return plant_from(
        replace(source, fixed=fixed), tuple(names[i] for i in at), tuple(lower[i] for i in at),
        tuple(upper[i] for i in at),
    )  # fmt: skip


class _PlantFile(SourceFileLoader):
    """A plant's file, read once: what runs is the text that was hashed.

    Bytecode beside it is neither used nor written: it could be of an older text, or of another.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(MODULE + path.stem, str(path))
        self._text = path.read_bytes()

    def get_data(self, path: str) -> bytes:
        return self._text

    def path_stats(self, path: str) -> Mapping[str, Any]:
        raise OSError("no bytecode")


def _own_function(source: PlantSource) -> ModelFunction:
    late = PlantError(
        f"{Path(source.name).name} did not return within {source.seconds:g} s; "
        "correct it, or give it longer with plant_seconds in a table [limits]"
    )
    if source.given is not None:
        return with_time_limit(source.given.call, source.seconds, late)
    assert source.file is not None
    assert source.function is not None
    path = Path(source.file)
    loader, files = _PlantFile(path), source.files()
    if digest_of(files) != source.content:
        words = "it or a file that it depends on was changed since the case was read"
        raise UserError(f"{path}: {words}; give the command again")
    for name in find_loaded(files[1:]):
        del sys.modules[name]  # it may be of an older text
    before, kept = list(sys.modules), sys.dont_write_bytecode
    spec = importlib.util.spec_from_loader(loader.name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    try:
        sys.dont_write_bytecode = True  # it is dated by the second: an edit may be sooner
        with_time_limit(loader.exec_module, source.seconds, late)(module)
        function = with_time_limit(getattr, source.seconds, late)(module, source.function, None)
    except PlantError:
        raise
    except Exception as error:
        raise UserError(f"{path}: cannot be loaded: {raised_words(error)}") from error
    finally:
        sys.dont_write_bytecode = kept
    if lost := find_unseen(files, before):
        words = f"loads {lost[0].name} by a way that its text does not show, so that a change of it"
        raise UserError(f"{path}: {words} would go unseen; write a plain import of it")
    if not callable(function):
        raise UserError(f"{path}: defines no function {source.function}; check plant.function")
    return with_time_limit(function, source.seconds, late)
