"""How the code is cut: modules, functions, constants, documentation, names; beside other packages.

    python benchmarks/structure.py [FOLDER ...]

Counts by the syntax tree alone, of the two packages and of each folder that is named (a checkout of
scikit-fem, optimistix, pyMOR, python-control, ...). A *bare constant* is an upper-case name of a
module that is bound to numbers; *of algorithms*, counted of ours alone, is one that is neither of
drawing nor in `EXEMPT` (physics, units, indices). *Used across rooms*: public functions and classes
that another package folder imports, but exceptions, enumerations and tables of a case file, whose
keys say what they mean; documented is one whose docstring has a section of NumPy's (Parameters,
Returns, Attributes, Raises). A function that takes and returns nothing needs a sentence alone.
"""

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from statistics import mean, median

ROOT = Path(__file__).parents[1]
OURS = [ROOT / "ccd_casadi", ROOT / "surrogates"]
# Rooms and modules whose numbers are sizes, colours and positions on a page.
DRAWING = (
    "ccd_casadi.drawing.", "ccd_casadi.reporting.", "ccd_casadi.extensions.explorer.",
    "ccd_casadi.extensions.rib_stage.pictures", "ccd_casadi.support.terminal",
)  # fmt: skip
# Numbers that no algorithm could take otherwise: of physics, units, file formats and other
# programs' interfaces, of the machine's rounding; indices; nodes of a quadrature; sizes.
EXEMPT: dict[str, tuple[str, ...]] = {
    "ccd_casadi.budget.evaluation": ("COMPLEX_STEP",),
    "ccd_casadi.budget.error_density": ("_X", "_W", "_G", "NODES", "KRONROD", "GAUSS"),
    "ccd_casadi.extensions.rib_stage.assembly": ("COPIES", "PAIRS"),
    "ccd_casadi.extensions.rib_stage.geometry": ("LOWER", "UPPER"),
    "ccd_casadi.extensions.rib_stage.model": ("ROWS",),
    "ccd_casadi.extensions.rib_stage.reduced": ("RIGID",),
    "ccd_casadi.cases.checks": ("LARGEST", "SMALLEST"),
    "ccd_casadi.cases.plant_findings": ("MASS", "STIFFNESS"),
    "ccd_casadi.codesign.optimality": ("HALF_POWER",),
    "ccd_casadi.codesign.result": ("FORMAT",),
    "ccd_casadi.fixed_structure.certificate_curves": ("HALF_POWER",),
    "ccd_casadi.fixed_structure.discs": ("GUARD",),
    "ccd_casadi.inner_problem.kinds": ("ENDS",),
    "ccd_casadi.inner_problem.problem": ("NUMERICS",),
    "ccd_casadi.extensions.limitations.multiplier": ("ROOT_HALF",),
    "ccd_casadi.kernels.adjoint": ("ROUNDING",),
    "ccd_casadi.kernels.loop_certificate": ("EPS",),
    "ccd_casadi.kernels.gamma": ("BACKWARD",),
    "ccd_casadi.kernels.loop_point": (
        "G", "DG", "FREE", "DFREE", "GV", "GK", "S", "US", "M", "V", "K", "RATE", "U", "W",
        "LEFT", "RIGHT", "SHARE", "X", "Y", "SEEN",
    ),
    "ccd_casadi.kernels.modes": ("SIMPLE", "POSITION", "VELOCITY"),
    "ccd_casadi.kernels.sections": ("HALF_POWER", "GAIN", "INTEGRATOR", "REAL", "PAIR"),
    "ccd_casadi.kernels.sensitivity": ("HALF_POWER",),
    "ccd_casadi.extensions.cad.elastic_body": ("AXES", "OUTWARD"),
    "ccd_casadi.extensions.cad.solid": ("TRIANGLE", "TETRAHEDRON", "MILLIMETRE"),
    "ccd_casadi.plants.as_written": ("EPS",),
    "ccd_casadi.plants.table_columns": ("COMPLIANCE", "RATES", "RATE_NAMES"),
    "ccd_casadi.extensions.measured.measured_answer": ("HEIGHT",),
    "ccd_casadi.extensions.records.record_findings": ("WIDTH", "LEFT", "RIGHT", "ROWS"),
    "ccd_casadi.extensions.records.log_files": ("UNITS",),
    "ccd_casadi.sampling.store": ("SCHEMA",),
    "ccd_casadi.extensions.cross_check.backends": ("BISECT", "SUBOPTIMAL"),
    "ccd_casadi.synthesis.closed_loop": ("EPS",),
    "ccd_casadi.synthesis.matlab_systems": ("SECONDS",),
    "ccd_casadi.support.text": ("HZ",),
    "ccd_casadi.support.command_line": ("DIES_WITH_PARENT",),
    "surrogates.gaussian_process": ("ROOT5", "NO_NOISE", "TWO_SIDED_95"),
}  # fmt: skip
OF_NUMBERS = ("np.", "math.", "float", "int", "range", "tuple")
SECTIONS = ("Parameters\n", "Returns\n", "Attributes\n", "Raises\n")
Tree = tuple[Path, ast.Module, list[str]]
Definition = ast.FunctionDef | ast.ClassDef


def trees(folders: list[Path]) -> list[Tree]:
    """Every module: its path, syntax tree and lines."""
    found = []
    for path in sorted(p for folder in folders for p in folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        found.append((path, ast.parse(text), text.splitlines()))
    return found


def is_numbers(node: ast.AST | None, known: set[str]) -> bool:
    """Whether an expression is made of numbers alone: literals, arithmetic, NumPy of these."""

    def all_numbers(nodes: list[ast.expr]) -> bool:
        return bool(nodes) and all(is_numbers(n, known) for n in nodes)

    match node:
        case ast.Constant(value):
            return type(value) in (int, float, complex)
        case ast.UnaryOp(operand=inner) | ast.Attribute(value=ast.Call() as inner):
            return is_numbers(inner, known)
        case ast.BinOp(left=left, right=right):
            return all_numbers([left, right])
        case ast.Tuple(elts) | ast.List(elts) | ast.Set(elts):
            return all_numbers(elts)
        case ast.Subscript(value=inner):
            return is_numbers(inner, known)
        case ast.Dict(values=values):
            return all_numbers(values)
        case ast.Call(func=func, args=args):
            return ast.unparse(func).startswith(OF_NUMBERS) and all_numbers(args)
        case ast.Attribute():
            return ast.unparse(node) in ("np.pi", "math.pi")
        case ast.Name(id=name):
            return name in known or name == "float"
    return False


def bare_constants(tree: ast.Module, module: str = "") -> Iterator[str]:
    """Upper-case names of a module that are bound to numbers, and belong to no algorithm's options.

    With the dotted name of one of our modules, those of `EXEMPT` and `DRAWING` are left out.
    """
    if module.startswith(DRAWING):
        return
    known = set[str]()
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.AnnAssign):
            targets = [node.target]
        if not targets or not is_numbers(getattr(node, "value", None), known):
            continue
        for name in getattr(targets[0], "elts", targets[:1]):
            if isinstance(name, ast.Name) and name.id.isupper():
                known.add(name.id)
                if name.id not in EXEMPT.get(module, ()):
                    yield name.id


def module_name(path: Path) -> str:
    """The dotted name of one of our modules; of a file elsewhere its stem."""
    inside = path.relative_to(ROOT) if path.is_relative_to(ROOT) else Path(path.name)
    return ".".join(inside.with_suffix("").parts)


def across_rooms(modules: list[Tree]) -> set[tuple[str, str]]:
    """(module, name) of what a module of another folder imports."""
    return {
        (node.module, alias.name)
        for path, tree, _ in modules
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        and node.module.split(".")[-2:-1] != [path.parent.name]
        for alias in node.names
    }  # fmt: skip


def says_itself(node: Definition) -> bool:
    """Whether a sentence is all that there is to say: of what has no parts, or parts with words."""
    if isinstance(node, ast.FunctionDef):
        return not node.args.args and ast.unparse(node.returns or ast.Name("")) == "None"
    bases = " ".join(map(ast.unparse, node.bases))
    fields = [ast.unparse(n.value) for n in node.body if isinstance(n, ast.AnnAssign) and n.value]
    tables = bool(fields) and all(value.startswith("key(") for value in fields)
    return tables or any(word in bases for word in ("Enum", "Exception", "Error"))


def used_elsewhere(modules: list[Tree]) -> list[tuple[Path, Definition]]:
    """Functions and classes that another room imports and that a sentence does not say."""
    rooms: dict[str, set[str]] = {}
    for module, name in across_rooms(modules):
        rooms.setdefault(module.rpartition(".")[2], set()).add(name)
    return [
        (path, node)
        for path, tree, _ in modules
        for node in tree.body
        if isinstance(node, Definition) and node.name in rooms.get(path.stem, ())
        and not says_itself(node)
    ]  # fmt: skip


def undocumented(modules: list[Tree]) -> list[str]:
    """Those whose docstring has no section of NumPy's, as `path: name`."""
    return [
        f"{path}: {node.name}"
        for path, node in used_elsewhere(modules)
        if not any(section in (ast.get_docstring(node) or "") for section in SECTIONS)
    ]


def counted(folders: list[Path]) -> dict[str, str]:
    """What the table says of these folders."""
    modules = trees(folders)
    functions = [
        n for _, tree, _ in modules for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)
    ]
    lengths = [n.end_lineno - n.lineno + 1 for n in functions if n.end_lineno]
    lines = sum(len(text) for _, _, text in modules)
    constants = sum(len(list(bare_constants(tree))) for _, tree, _ in modules)
    of_algorithms = (list(bare_constants(tree, module_name(path))) for path, tree, _ in modules)
    bare = sum(map(len, of_algorithms)) if folders == OURS else "–"
    comments = sum(line.lstrip().startswith("#") for _, _, text in modules for line in text)
    public = used_elsewhere(modules)
    bare_ones = undocumented(modules)
    classes = Counter(
        n.name for _, tree, _ in modules for n in tree.body if isinstance(n, ast.ClassDef)
    )
    stems = Counter(path.stem for path, _, _ in modules if path.stem[0] != "_")
    sizes = [len(text) for _, _, text in modules]
    return {
        "modules": f"{len(modules)}",
        "lines": f"{lines}",
        "lines of a module, median": f"{median(sizes):g}",
        "most lines of a module": f"{max(sizes)}",
        "lines of a function, mean": f"{mean(lengths):.1f}",
        "bare constants": f"{constants} ({1e3 * constants / lines:.1f} a thousand lines)",
        "of algorithms": f"{bare}",
        "own-line comments": f"{100.0 * comments / lines:.1f} %",
        "used across rooms": f"{len(public)}",
        "documented of these": f"{100.0 * (1.0 - len(bare_ones) / max(len(public), 1)):.0f} %",
        "class names twice": f"{sum(count > 1 for count in classes.values())}",
        "module names twice": f"{sum(count > 1 for count in stems.values())}",
    }


def main() -> None:
    """Print the table, ours first."""
    columns = {"ours": counted(OURS)} | {Path(f).name: counted([Path(f)]) for f in sys.argv[1:]}
    names = list(columns)
    print("| | " + " | ".join(names) + " |\n|---|" + "---|" * len(names))
    for row in columns["ours"]:
        print(f"| {row} | " + " | ".join(columns[name][row] for name in names) + " |")
    scripts = sum(len(p.read_text().splitlines()) for p in (ROOT / "benchmarks").glob("*.py"))
    words = sum(len(p.read_text().split()) for p in (ROOT / "docs/development").glob("*.md"))
    patched = sum(
        p.read_text().count("monkeypatch.setattr") for p in (ROOT / "tests").rglob("*.py")
    )
    print(
        f"\nbenchmarks {scripts} lines; docs/development {words} words; tests patch {patched} times"
    )


if __name__ == "__main__":
    main()
