"""JSON files of surrogates: exact to the bit, light to load, clear when broken."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.draws import few

from surrogates import (
    GaussianProcess,
    Hyperparameters,
    SurrogateFileError,
    condition,
    design,
    load,
    save,
    to_casadi,
)


def process(gradients: bool = False, seed: int = 0, kernel: str = "matern52") -> GaussianProcess:
    X = design("lhs", [0, -1], [1, 1], 8, seed)
    Y, dY = np.sin(X.sum(1)), np.cos(X.sum(1))[:, None] * [1, 1]
    lengths = np.random.default_rng(seed).uniform(0.1, 3.0, 2)
    return condition(
        Hyperparameters(lengths, 1.0 / 3.0, 1e-7, 1e-6),
        X,
        Y,
        lower=[0, -1],
        upper=[1, 1],
        kernel=kernel,
        dY=dY if gradients else None,
    )


@few(max_examples=15)
@given(st.integers(0, 10**6), st.booleans(), st.sampled_from(["matern52", "rbf"]))
def test_round_trip_is_bit_exact(
    tmp_path_factory: pytest.TempPathFactory, seed: int, gradients: bool, kernel: str
) -> None:
    path = tmp_path_factory.mktemp("files") / "s.json"
    gp, other = process(gradients, seed, kernel), process(False, seed + 1)
    save([gp, other], path, {"unit": "rad/s", "seed": seed})
    (again, _), extra = load(path)
    assert isinstance(again, GaussianProcess)
    assert extra == {"unit": "rad/s", "seed": seed}
    assert again.kernel is gp.kernel
    assert again.loo == gp.loo
    assert again.hyperparameters.signal_variance == gp.hyperparameters.signal_variance
    T = design("lhs", [0, -1], [1, 1], 10, seed)
    for ours, theirs in zip(gp.predict(T, True), again.predict(T, True), strict=True):
        assert ours.tobytes() == theirs.tobytes()
    assert [float(v) for v in to_casadi(gp)(T[0])] == [float(v) for v in to_casadi(again)(T[0])]
    save([again, other], path.with_name("t.json"), extra)
    assert path.read_bytes() == path.with_name("t.json").read_bytes()


def test_loading_and_evaluating_does_not_import_scikit_learn(tmp_path: Path) -> None:
    save(process(), tmp_path / "s.json")
    code = (
        "import sys, surrogates\n"
        f"(s,), _ = surrogates.load({str(tmp_path / 's.json')!r})\n"
        "m, d = surrogates.to_casadi(s)([0.5, 0.5])\n"
        "s.predict([[0.5, 0.5]], return_std=True)\n"
        "heavy = {'sklearn', 'scipy.stats', 'scipy.optimize'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "print(float(m).hex())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == float(to_casadi(process())([0.5, 0.5])[0]).hex()


def test_every_truncation_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    save(process(), path)
    whole = path.read_bytes()
    for length in [0, 1, len(whole) // 3, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(SurrogateFileError, match="not a complete JSON"):
            load(path)


def damage(document: dict, where: str, value: object) -> dict:
    record = document["surrogates"][0]
    if where in document:
        document[where] = value
    elif value is None:
        del record[where]
    else:
        record[where] = value
    return document


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("schema", "surrogates/3", "expected schema"),
        ("schema", None, "found None"),
        ("surrogates", {"kind": "x"}, "damaged"),
        ("surrogates", 3, "damaged"),
        ("extra", [], "damaged"),
        ("kind", "polynomial", "is not gaussian_process; fit it again"),
        ("kind", ["x"], "damaged"),
        ("weights", None, "weights"),
        ("weights", [1.0, 2.0], "one weight"),
        ("weights", [1.0, None], "finite"),
        ("targets", [1.0], "targets"),
        ("X", [[1.0], [2.0]], "inputs of the box"),
        ("output_scale", "1", "finite number"),
        ("output_scale", True, "finite number"),
        ("kernel", "cubic", "cubic"),
        ("surplus", 1.0, "surplus"),
    ],
)
def test_damage_is_named(tmp_path: Path, where: str, value: object, message: str) -> None:
    path = tmp_path / "s.json"
    save(process(), path)
    path.write_text(json.dumps(damage(json.loads(path.read_text()), where, value)))
    with pytest.raises(SurrogateFileError, match=message):
        load(path)


@pytest.mark.parametrize("content", [b"[1, 2]", b"3", b"\x80\x04pickle", b'{"a": NaN}', b"{}"])
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s.json"
    path.write_bytes(content)
    with pytest.raises(SurrogateFileError):
        load(path)


def test_failed_save_leaves_the_old_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.json"
    save(process(), path)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        save(process(seed=1), path, {"function": print})
    with pytest.raises(ValueError, match="not JSON compliant"):
        save(process(seed=1), path, {"value": float("nan")})
    with pytest.raises(TypeError, match="dataclass"):
        save(["text"], path)  # type: ignore[list-item]

    def full(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="disk full"):
        save(process(seed=1), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["s.json"]
