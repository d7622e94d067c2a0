"""`ccd WORD ...`: every command under one name; `ccd new NAME` begins a stage of your own."""

import json
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

from ccd_casadi.support import extensions
from ccd_casadi.support.command_line import ExitCode
from ccd_casadi.support.errors import raise_on_ctrl_c
from ccd_casadi.support.options import one_line
from ccd_casadi.support.terminal import say
from ccd_casadi.support.text import package_text, template

# Of the core: word -> the module of its `main`, and what it does.
COMMANDS = {
    "check": ("ccd_casadi.check", "examine a case's plant before anything is designed"),
    "inner": ("ccd_casadi.inner", "find the best controller at one theta, as JSON"),
    "solve": ("ccd_casadi.solve", "design stage and controller together, verify, report"),
    "compare": ("ccd_casadi.compare", "run every method on a case, side by side"),
    "retrain": ("ccd_casadi.retrain", "add true samples to a run where they help most"),
    "insight": ("ccd_casadi.insight", "trade hardware cost against bandwidth"),
    "robustness": ("ccd_casadi.robustness", "find what a run's design survives"),
    "deploy": ("ccd_casadi.deploy", "write a run's controller as C, .mat and structured text"),
    "report": ("ccd_casadi.report", "draw the pages of a finished folder again"),
}
ALIASES = {"import": "imported"}
TEMPLATE = {"plant.py": "new_plant.py", "case.toml": "case.toml"}  # file -> in templates/
SCHEMA = "case.schema.json"
# Words that are answered here, each with what it does.
OWN = {
    "new": "write a plant and a case to begin with into a new folder",
    "keys": "list every table and key of a case file, as Markdown",
    "schema": "print them as JSON Schema; with --result that of result.json",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command that the first word names; without one, say what there is to do here."""
    words = list(sys.argv[1:] if argv is None else argv)
    command = ALIASES.get(words[0], words[0]) if words else ""
    if command in COMMANDS:
        return int(import_module(COMMANDS[command][0]).main(words[1:]))
    if command in extensions.SHIPPED["commands"] or _is_foreign(command):
        return extensions.command(command)(words[1:])  # which names an extension that was removed
    raise_on_ctrl_c()
    match words:
        case [] | ["--help" | "-h" | "help"]:
            say(overview(Path()))
        case ["--version"]:
            import ccd_casadi

            print(f"ccd-casadi {ccd_casadi.__version__}")
        case ["keys"]:
            print(_schema().keys_page(), end="")
        case ["schema"]:
            print(json.dumps(_schema().case_schema(), indent=1))
        case ["schema", "--result"]:
            print(package_text("templates/result.schema.json"), end="")
        case ["new", name] if not name.startswith("-"):
            return new(Path(name))
        case [word, *more] if word in OWN:
            usage = f"ccd {word}{' NAME' if word == 'new' else ''}: {OWN[word]}"
            if more not in (["--help"], ["-h"]):
                return _refuse(usage)
            print(usage)
        case _:
            there = ", ".join((*commands(), *OWN))
            return _refuse(f"{words[0]!r} is not a command; there are {there}")
    return ExitCode.DONE


def commands() -> dict[str, tuple[str, str]]:
    """Every command that is installed: word -> the module of its `main`, and what it does."""
    return COMMANDS | extensions.collect_declared("commands")


def _is_foreign(word: str) -> bool:
    """Whether a word is a command of another distribution; only then are its tables read."""
    may_be = word.isidentifier() and word not in OWN and word != "help"
    return may_be and extensions.find("commands", word) is not None


def _refuse(words: str) -> int:
    """Write one line on stderr."""
    say(one_line(words), sys.stderr)
    return ExitCode.BAD_INPUT


def _schema() -> ModuleType:
    """The module of `keys_page` and `case_schema`; it loads the models of the package."""
    return import_module("ccd_casadi.cases.case")


def new(folder: Path) -> int:
    """Write a plant and a case to begin with into a folder; one that is there already is kept."""
    there = [name for name in TEMPLATE if (folder / name).exists()]
    if there:
        words = f"{' and '.join(there)} would be overwritten"
        return _refuse(f"{folder}: {words}; choose another name")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, own in TEMPLATE.items():
            (folder / name).write_text(package_text(f"templates/{own}"), encoding="utf-8")
        schema = json.dumps(_schema().case_schema(), indent=1)
        (folder / SCHEMA).write_text(f"{schema}\n", encoding="utf-8")
    except OSError as error:
        return _refuse(f"{folder}: cannot be written: {error.strerror}; choose another name")
    case = folder / "case.toml"
    print(f"{folder / 'plant.py'}: the stage\n{case}: what is wanted")
    print(f"{folder / SCHEMA}: its keys, for an editor\nnext: ccd check {case}")
    return ExitCode.DONE


def overview(folder: Path) -> str:
    """The commands, and the cases and finished runs that lie in a folder."""
    near = [*sorted(folder.glob("*/result.json")), *sorted(folder.glob("*/*/result.json"))]
    runs = [path.parent for path in near]
    files = [*sorted(folder.glob("*.toml")), *sorted(folder.glob("*/*.toml"))]
    words = [*((word, does) for word, (_, does) in commands().items()), *OWN.items()]
    cases = [path for path in files if _is_case(path)]
    made = template("templates/overview.txt").render(words=words, cases=cases, runs=runs)
    return made.rstrip()


def _is_case(path: Path) -> bool:
    """Whether a TOML file reads like a case that a person wrote: not a run's resolved copy."""
    if (path.parent / "result.json").exists():
        return False
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    heads = [line.split("#")[0].strip() for line in text.splitlines()]
    return "[plant]" in heads and "[objective]" in heads


if __name__ == "__main__":
    raise SystemExit(main())
