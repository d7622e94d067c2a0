"""How the code is cut: numbers of algorithms belong to the options of these."""

import ast
import re
import sys
from pathlib import Path

import pytest
from oracles.sources import SOURCES, nodes

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import structure


def modules() -> dict[str, ast.Module]:
    """Every module of both packages by its dotted name."""
    return {structure.module_name(path): nodes(path)[0] for path in SOURCES}  # type: ignore[misc]


def test_numbers_of_algorithms_are_fields_of_options() -> None:
    bare = {
        f"{module}.{name}"
        for module, tree in modules().items()
        for name in structure.bare_constants(tree, module)
    }
    assert not bare, "make them fields of the algorithm's `...Options`"


def test_exempt_constants_are_there() -> None:
    of = {module: set(structure.bare_constants(tree)) for module, tree in modules().items()}
    for module, names in structure.EXEMPT.items():
        assert set(names) <= of[module], f"{module}: delete from EXEMPT what is gone"


@pytest.mark.parametrize(
    "line",
    [
        "X = 1.0", "X: Final = -2", "X = (1e-3, 2.0)", "X, Y = 1, 2", "X = [1, 2]", "X = {1, 2}",
        "X = float(np.log(0.1))", "X = 4.0 * np.pi", "X = np.array([1.0, 2.0])[:1]",
        "X = 4.0 * np.finfo(float).eps", "X, Y = range(2)", "X = {'a': 1e-3}",
        "Y = 2.0\nX = 3.0 * Y", "_X = 1", "X = np.radians(20.0)",
    ],
)  # fmt: skip
def test_bare_numbers_are_seen(line: str) -> None:
    assert {"X", "_X"} & set(structure.bare_constants(ast.parse(line)))


@pytest.mark.parametrize(
    "line",
    [
        "X = XOptions()", "X = 'a'", "X = ('a', 1.0)", "x = lambda: 1.0", "X = True", "X = ()",
        "class X:\n    A: float = 1.0", "def f():\n    X = 1.0",
    ],
)  # fmt: skip
def test_what_is_no_bare_number(line: str) -> None:
    assert not list(structure.bare_constants(ast.parse(line)))


def test_a_bare_number_outside_drawing_is_counted() -> None:
    tree = ast.parse("HZ = 6.28\nSTEP = 1e-3")
    assert list(structure.bare_constants(tree, "ccd_casadi.support.text")) == ["STEP"]
    assert list(structure.bare_constants(tree, "ccd_casadi.lti.norms")) == ["HZ", "STEP"]
    assert not list(structure.bare_constants(tree, "ccd_casadi.drawing.svg"))


def documented(text: str) -> list[str]:
    """Names in the section Parameters of a docstring."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", text, re.M | re.S)
    lines = section[1].splitlines() if section else []
    heads = (line.split(" :")[0] for line in lines if line and not line.startswith(" "))
    return [name.strip().lstrip("*") for head in heads for name in head.split(",")]


def test_documented_parameters_are_those_of_the_signature() -> None:
    wrong = {}
    for module, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                own = {arg.arg for arg in ast.walk(node.args) if isinstance(arg, ast.arg)}
                found = set(documented(ast.get_docstring(node) or "")) - own
                wrong |= {f"{module}.{node.name}": found} if found else {}
    assert wrong == {}


def test_what_another_room_uses_says_what_it_takes_and_returns() -> None:
    assert structure.undocumented(structure.trees(structure.OURS)) == []


# Words of conversation that name nothing; each has a term of the field.
NO_NAMES = {"told", "asked", "look", "looks", "looked", "bent", "begun", "race", "raced", "stands",
            "tell", "tells"}  # fmt: skip


def test_names_are_words_of_the_field() -> None:
    found = {
        name
        for _, tree, _ in structure.trees(structure.OURS)
        for node in ast.walk(tree)
        for name in (getattr(node, field, None) for field in ("name", "id", "arg", "attr"))
        if isinstance(name, str) and NO_NAMES & set(name.lower().strip("_").split("_"))
    }
    assert sorted(found) == []


DECIDE = ("codesign", "deployment", "reporting", "robust", "studies")
SENTENCE = {"words", "sentence", "clauses"}
READING = {"split", "startswith", "endswith", "partition", "rpartition", "removeprefix", "find"}


def parsed_sentences(tree: ast.AST) -> set[str]:
    """Where code reads sentences of its own: searches in them, compares them, takes them apart."""

    def is_sentence(node: ast.AST) -> bool:
        match node:
            case ast.Subscript(slice=ast.Constant(name)):  # of result.json
                return name in {*SENTENCE, "reason"}
            case ast.Name(name) | ast.Attribute(attr=name):
                return name in SENTENCE
            case ast.Call(ast.Name(name)):
                return name.endswith("_words")
        return False

    found = set()
    for node in ast.walk(tree):
        match node:
            case ast.Call(ast.Attribute(value, attr)) if attr in READING and is_sentence(value):
                found.add(ast.unparse(node))
            case ast.Call(ast.Attribute(ast.Name("re")), args) if any(map(is_sentence, args)):
                found.add(ast.unparse(node))
            case ast.Compare(left, ops, sides):
                of_text = any(isinstance(op, ast.In | ast.NotIn | ast.Eq | ast.NotEq) for op in ops)
                empty = any(isinstance(one, ast.Constant) and not one.value for one in sides)
                if of_text and not empty and any(map(is_sentence, (left, *sides))):
                    found.add(ast.unparse(node))
    return found


def test_no_decision_hangs_on_a_sentence() -> None:
    found = {
        f"{module}: {line}"
        for module, tree in modules().items()
        if module.startswith(tuple(f"ccd_casadi.{room}." for room in DECIDE))
        for line in parsed_sentences(tree)
    }
    assert not found, "decide by an enumerated reason or a state; words are rendered from these"


@pytest.mark.parametrize(
    "line",
    [
        "x.words.split('; ')", "line['reason'].startswith('none')", "'proven' in found.words",
        "words in current", "re.search('a', x.words)", "reason_words(a, b).split('; ')",
        "a.words == 'none'",
    ],
)  # fmt: skip
def test_parsed_sentences_are_seen(line: str) -> None:
    assert parsed_sentences(ast.parse(line))


@pytest.mark.parametrize(
    "line", ["x.words == ''", "name.split(' ')", "f(x.words)", "x.reason in {R.A}"]
)
def test_what_is_no_parsed_sentence(line: str) -> None:
    assert not parsed_sentences(ast.parse(line))


def test_no_two_classes_have_one_name() -> None:
    """A reader who finds `Figure` has found the one."""
    names = [
        node.name for tree in modules().values() for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    ]  # fmt: skip
    assert sorted({name for name in names if names.count(name) > 1}) == []
