"""The files that a user's plant function depends on, as far as its text shows them.

Its own file, each module of the user that it imports (not those of installed packages), and each
file that one of these names in a string, beside it or in the current folder. What a program makes
up while it runs is not seen.
"""

import ast
import hashlib
import sys
from collections.abc import Iterable, Iterator
from importlib.machinery import PathFinder
from pathlib import Path

INSTALLED = {"site-packages", "dist-packages"}
STANDARD = Path(ast.__file__).parent
OURS = Path(__file__).parents[1]
LONGEST = 255  # letters: a longer string names no file


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
            continue  # it is told where the file is loaded
        strings = [
            node.value for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]  # fmt: skip
        named += _beside(strings, (module.parent, Path.cwd()))
        for other in _imported(tree, module, first.parent):
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


def loaded_from(files: Iterable[Path]) -> list[str]:
    """Names of modules in this process that come from these files."""
    known = set(files)
    return [name for name, place in _own_modules() if place in known]


def unseen(files: Iterable[Path], before: Iterable[str]) -> list[Path]:
    """Modules in the folder of the first file that were loaded since, and are not among these."""
    known, old = list(files), set(before)
    return [
        place for name, place in _own_modules()
        if name not in old and place not in known and place.is_relative_to(known[0].parent)
    ]  # fmt: skip


def _own_modules() -> Iterator[tuple[str, Path]]:
    for name, module in list(sys.modules.items()):
        origin = getattr(module, "__file__", None)
        if name != "__main__" and isinstance(origin, str) and _own(Path(origin).resolve()):
            yield name, Path(origin).resolve()


def _own(place: Path) -> bool:
    """Whether a module's file is neither installed, nor of Python's library, nor ours."""
    if INSTALLED & set(place.parts) or place.suffix != ".py":
        return False
    return not (place.is_relative_to(STANDARD) or place.is_relative_to(OURS))


def _imported(tree: ast.AST, module: Path, folder: Path) -> Iterator[Path]:
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


def _beside(words: Iterable[str], folders: Iterable[Path]) -> Iterator[Path]:
    """The files that strings name, those of a folder that they name included."""
    for word in set(words):
        if not word.strip("./ ") or len(word) > LONGEST or "\0" in word or "\n" in word:
            continue
        for folder in folders:
            place = (folder / word).resolve()
            if folder.resolve().is_relative_to(place):
                continue  # a folder above says nothing
            if place.is_file():
                yield place
            elif place.is_dir():
                yield from (item for item in place.iterdir() if item.is_file())
