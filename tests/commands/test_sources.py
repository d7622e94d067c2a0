"""What the sources and the locked dependencies are: no code is read from data, all is pinned."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from oracles.sources import ROOT, SOURCES, nodes

# Pipes between the processes of one run.
LIVE = {
    "ccd_casadi/support/process_pool.py", "ccd_casadi/support/worker_process.py",
    "ccd_casadi/extensions/cluster/dask_pool.py",
}  # fmt: skip
# They import by names that sources spell out: optional packages, what a command or a worker needs.
# Processes of this Python with a module of the package; the person's C compiler on our own C code.
PROCESSES = {
    ("ccd_casadi/extensions/formats/code_formats.py", "subprocess.run"),
    ("ccd_casadi/kernels/compilation.py", "subprocess.Popen"),
    ("ccd_casadi/extensions/explorer/session.py", "subprocess.Popen"),
    ("ccd_casadi/reporting/brief.py", "subprocess.run"),  # a browser that prints the page
    ("ccd_casadi/support/command_line.py", "ctypes.CDLL"),  # of the process itself, for prctl
}
BY_NAME = {
    "ccd_casadi/support/errors.py",
    "ccd_casadi/support/command_line.py",
    "ccd_casadi/support/worker_process.py",
    "ccd_casadi/kernels/compilation.py",
    "ccd_casadi/kernels/compiled.py",
    "surrogates/lazy_names.py",
    "ccd_casadi/__main__.py",
    "ccd_casadi/support/extensions.py",
}


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    """Every call in a source file by its dotted name."""
    for node in nodes(path):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


FORBIDDEN = {
    "eval", "exec", "compile", "__import__", "importlib.import_module", "import_module",
    "os.system", "os.popen", "marshal.loads", "marshal.load", "shelve.open", "yaml.load",
    "joblib.load", "dill.loads", "cloudpickle.loads", "cloudpickle.load", "np.fromfile",
    "pickle.load", "ca.Function.load", "ca.Function.deserialize", "ca.external", "ca.Importer",
    "ctypes.CDLL", "runpy.run_path", "subprocess.run", "subprocess.Popen",
}  # fmt: skip


def test_no_source_reads_code_from_data() -> None:
    seen = []
    for path in SOURCES:
        name = path.relative_to(ROOT).as_posix()
        for called, node in calls(path):
            seen.append(called)
            if (
                not (name in BY_NAME and called == "import_module")
                and (name, called) not in PROCESSES
            ):
                assert called not in FORBIDDEN, f"{name}:{node.lineno}: {called}"
            if (
                called == "require" and name != "ccd_casadi/extensions/cross_check/backends.py"
            ):  # its constants
                assert isinstance(node.args[0], ast.Constant), f"{name}:{node.lineno}"
            for keyword in node.keywords:
                if keyword.arg in ("allow_pickle", "shell"):
                    assert ast.unparse(keyword.value) == "False", f"{name}:{node.lineno}"
            if called.startswith("pickle."):
                assert name in LIVE, f"{name}:{node.lineno}: {called}"
    assert "json.loads" in seen, "the scan sees calls"


def test_plant_files_are_loaded_where_permission_is_required() -> None:
    loading = {p.relative_to(ROOT).as_posix() for p in SOURCES if "exec_module" in p.read_text()}
    assert loading == {"ccd_casadi/inner_problem/plant_source.py"}
    text = (ROOT / "ccd_casadi" / "inner_problem" / "plant_source.py").read_text()
    assert text.count("exec_module") == 1
    assert "require_user_code(" in text


def test_every_dependency_is_pinned_to_one_version() -> None:
    for name in ("requirements.lock", "requirements-test.lock"):
        lines = (ROOT / name).read_text().splitlines()
        for line in lines:
            if line and not line.startswith(("#", "-r ")):
                package, _, version = line.partition(";")[0].strip().partition("==")
                assert version, f"{name}: {line}"
                assert package.strip() == package
                assert np.all([c.isalnum() or c in "-_.+" for c in package + version]), line


def test_what_is_installed_fits_together() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pip", "--disable-pip-version-check", "check"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
