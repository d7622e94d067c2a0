"""Every member of the family: its CasADi graph, its derivatives, its file, its C code."""

import shutil
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from oracles.surrogate_family import LOW, MAKERS, MEMBERS, SPAN, T, X, Y, f, flat, member

from surrogates import load, save, to_casadi


@MEMBERS
def test_function_equals_prediction(name: str) -> None:
    s = member(name)
    at = np.vstack([T, X[:5]])
    mean, std = s.predict(at, return_std=True)
    ours = to_casadi(s).map(len(at))(at.T)
    np.testing.assert_allclose(flat(ours[1]), std, atol=1e-9 * Y.std(), rtol=0)
    np.testing.assert_allclose(flat(ours[0]), mean, atol=1e-9 * Y.std(), rtol=0)
    assert mean.shape == (65,)
    assert np.sqrt(np.mean((s.predict(T) - f(T)) ** 2)) < 0.1 * Y.std()


@MEMBERS
@pytest.mark.parametrize("at_sample", [False, True])
def test_derivatives_match_differences(name: str, at_sample: bool) -> None:
    s = member(name)
    u = ca.MX.sym("u", 3)
    mean = to_casadi(s, std=False)(LOW + u * SPAN) / Y.std()
    H, g = ca.hessian(mean, u)
    values = ca.Function("v", [u], [mean, g, H])
    at = (X[7] - LOW) / SPAN if at_sample else np.array([0.31, 0.62, 0.44])
    _, gradient, hessian = (flat(v) for v in values(at))

    def central(e: np.ndarray) -> np.ndarray:
        up, down = values(at + e), values(at - e)
        return np.r_[flat(up[0] - down[0]), flat(up[1] - down[1])] / (2 * np.linalg.norm(e))

    for i, e in enumerate(1e-4 * np.eye(3)):
        difference = (4.0 * central(e) - central(2.0 * e)) / 3.0
        assert gradient[i] == pytest.approx(difference[0], abs=5e-8)
        np.testing.assert_allclose(hessian.reshape(3, 3)[i], difference[1:], atol=1e-5)


@MEMBERS
def test_deviation_slope_matches_differences(name: str) -> None:
    s = member(name)
    u = ca.MX.sym("u", 3)
    std = to_casadi(s)(LOW + u * SPAN)[1] / Y.std()
    values = ca.Function("v", [u], [std, ca.gradient(std, u)])
    at, h = np.array([0.9, 0.15, 0.8]), 1e-4
    for i, e in enumerate(h * np.eye(3)):
        up, down = values(at + e)[0], values(at - e)[0]
        assert flat(values(at)[1])[i] == pytest.approx(float(up - down) / (2 * h), abs=5e-6)


@MEMBERS
def test_file_round_trip_is_bit_exact(name: str, tmp_path: Path) -> None:
    s = member(name)
    save([s, member("rbf")], tmp_path / "s.json")
    (again, _), _ = load(tmp_path / "s.json")
    assert type(again) is type(s)
    assert again.loo == s.loo
    assert again.left_out.tobytes() == s.left_out.tobytes()
    assert again.predict(T).tobytes() == s.predict(T).tobytes()
    one, two = (to_casadi(each, std=False)(T[0]) for each in (again, s))
    assert float(one) == float(two)


def test_no_member_needs_scikit_learn_after_loading(tmp_path: Path) -> None:
    save([member(name) for name in MAKERS], tmp_path / "all.json")
    code = (
        "import sys, surrogates\n"
        f"members, _ = surrogates.load({str(tmp_path / 'all.json')!r})\n"
        f"values = [m.predict({T[0].tolist()})[0] for m in members]\n"
        f"values += [float(surrogates.to_casadi(m, std=False)({T[0].tolist()})) for m in members]\n"
        "heavy = {'sklearn', 'scipy.stats', 'scipy.optimize', 'scipy.interpolate', 'pickle5'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "print(len(values))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(2 * len(MAKERS))


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
def test_generated_c_code_compiles_and_agrees(tmp_path: Path) -> None:
    # One translation unit of all members: the compiler is started once.
    code = ca.CodeGenerator("members.c")
    functions = []
    for i, name in enumerate(MAKERS):
        s, x = member(name), ca.MX.sym("x", 3)
        outputs = to_casadi(s).call([x])
        function = ca.Function(f"m{i}", [x], [*outputs, ca.gradient(outputs[0], x)])
        code.add(function)
        functions.append(function)
    code.generate(f"{tmp_path}/")
    library = tmp_path / "members.so"
    subprocess.run(
        ["gcc", "-O1", "-fPIC", "-shared", "-o", str(library), str(tmp_path / "members.c"), "-lm"],
        check=True,
    )
    for function in functions:
        compiled = ca.external(function.name(), str(library))
        for at in T[:5]:
            for ours, theirs in zip(function.call([at]), compiled.call([at]), strict=True):
                np.testing.assert_allclose(flat(theirs), flat(ours), rtol=1e-11, atol=1e-10)


def test_files_of_schema_one_are_read(tmp_path: Path) -> None:
    save(member("rbf"), tmp_path / "s.json")
    text = (tmp_path / "s.json").read_text().replace('"surrogates/2"', '"surrogates/1"')
    (tmp_path / "s.json").write_text(text.replace(', "sample_noise": [], "band": 1.0', ""))
    (again,), _ = load(tmp_path / "s.json")
    assert again.predict(T).tobytes() == member("rbf").predict(T).tobytes()
