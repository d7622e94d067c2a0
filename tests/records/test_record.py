"""Logs in files, and `ccd record`: each is read as it is meant or refused by name."""

from pathlib import Path

import numpy as np
import pytest
from oracles.closed_loops import RATE, Loop, random_loop, recorded
from scipy.io import savemat, wavfile

from ccd_casadi.extensions.records import main
from ccd_casadi.extensions.records.time_series import SignalNames, TimeSeries, read_record
from ccd_casadi.plants.measured import read_frequency_response
from ccd_casadi.support.errors import UserError


@pytest.fixture(scope="module")
def loop() -> Loop:
    return random_loop(np.random.default_rng(3))


@pytest.fixture(scope="module")
def series(loop: Loop) -> TimeSeries:
    return recorded(loop, np.random.default_rng(1), 4096, 0.02)


def table(series: TimeSeries, **more: np.ndarray) -> dict[str, np.ndarray]:
    t = series.period * np.arange(len(series.force))
    signals = {"injected": series.excitation, "force": series.force, "position": series.position}
    return {"t": t, **signals, **more}


def text_of(
    columns: dict[str, np.ndarray], mark: str = ",", comma: bool = False, head: str = ""
) -> str:
    rows = [mark.join(f"{x:.12g}" for x in row) for row in zip(*columns.values(), strict=True)]
    lines = "\n".join(rows)
    return f"{head or mark.join(columns)}\n{lines.replace('.', ',') if comma else lines}\n"


def written(folder: Path, name: str, series: TimeSeries) -> Path:
    path, columns = folder / name, table(series)
    match name:
        case "a.npz":
            np.savez(path, **columns)
        case "a.mat":
            savemat(path, columns)
        case "struct.mat":
            savemat(path, {"log": columns})
        case "rate.npz":
            np.savez(path, **{key: columns[key] for key in list(columns)[1:]}, fs=RATE)
        case "a.csv":
            path.write_text(text_of(columns))
        case "comma.csv":
            path.write_text("Scope 3\nmade by hand\n" + text_of(columns, ";", True))
        case "tabs.txt":
            path.write_text(text_of(columns, "\t"), encoding="utf-16")
        case "units.csv":
            scaled = columns | {"t": 1e3 * columns["t"], "position": 1e6 * columns["position"]}
            path.write_text(text_of(scaled, head="Time,Injected,Force,Position\nms,N,N,um"))
        case "names.csv":
            scaled = columns | {"position": 1e3 * columns["position"]}
            path.write_text(text_of(scaled, ";", head="Time [s];Excitation [N];u;ActPos (mm)"))
    return path


@pytest.mark.parametrize(
    "name",
    ["a.npz", "a.mat", "struct.mat", "rate.npz", "a.csv", "comma.csv", "tabs.txt", "units.csv",
     "names.csv"],
)  # fmt: skip
def test_every_dialect_is_the_same_record(tmp_path: Path, series: TimeSeries, name: str) -> None:
    found = read_record(written(tmp_path, name, series))
    assert found.period == pytest.approx(series.period, rel=1e-9)
    assert found.injected
    for own in ("excitation", "force", "position"):
        np.testing.assert_allclose(getattr(found, own), getattr(series, own), rtol=1e-9, atol=1e-15)
    assert f"{len(series.force)} samples at 2000 Hz" in found.words


def test_sound_files_have_channels(tmp_path: Path, series: TimeSeries) -> None:
    signals = np.stack([series.excitation, series.force, series.position], axis=1)
    scaled = signals / np.abs(signals).max(axis=0)
    wavfile.write(tmp_path / "a.wav", 2000, scaled.astype(np.float32))
    found = read_record(tmp_path / "a.wav", SignalNames(injected="1", force="2", position="3"))
    np.testing.assert_allclose(found.force, scaled[:, 1], rtol=1e-6)
    with pytest.raises(UserError, match="no column is a force"):
        read_record(tmp_path / "a.wav")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c | {"force_command": c["t"]}, "may be 'force' or 'force_command'; .*--force"),
        (lambda c: c | {"reference": c["t"]}, "may be 'injected' or 'reference'"),
        (lambda c: {k: c[k] for k in ("t", "force", "position")}, "--open-loop, or .*--injected"),
        (lambda c: {k: c[k] for k in ("t", "injected", "position")}, "no column is a force"),
        (lambda c: {k: c[k] for k in ("injected", "force", "position")}, "--rate-hz"),
        (lambda c: c | {"t": np.delete(np.arange(4098) * 5e-4, [100, 101])}, "2 samples"),
        (lambda c: c | {"t": c["t"] + 1e-4 * np.sin(np.arange(4096))}, "sample evenly"),
        (lambda c: c | {"t": np.where(c["t"] == 0.5, 0.4, c["t"])}, "does not rise"),
        (lambda c: c | {"force": c["force"][:-1]}, "different lengths"),
        (lambda c: c | {"force": np.stack([c["force"]] * 2)}, "not one signal"),
    ],
)  # fmt: skip
def test_what_is_not_clear_is_refused_by_name(
    tmp_path: Path, series: TimeSeries, change: object, words: str
) -> None:
    np.savez(tmp_path / "a.npz", **change(table(series)))  # type: ignore[operator]
    with pytest.raises(UserError, match=words):
        read_record(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("1,2\n3,4\n", "no header"),
        ("t,force\nx,y\n", "not a table of numbers"),
        ("t,force,force\n0,1,2\n1,2,3\n", "is there twice"),
        ("t,u,y\n0,1,2\n1,2\n", "line 3: has 2 cells and the header 3"),
        ("t,u,y\n0,1,2\n1,nan,3\n", "line 3: 'nan' is not a finite number"),
        ("t;u;y\n0;1,234;2,345\n1;1,234;2,345\n", "decimal or part thousands"),
        ("t,r,u [lbf],y\n0,1,2,3\n1,2,3,4\n2,3,4,5\n", "the unit 'lbf' is not one of a force"),
    ],
)
def test_mistakes_in_texts(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(UserError, match=words):
        read_record(tmp_path / "a.csv")


def test_the_command_writes_what_tune_reads(
    tmp_path: Path, series: TimeSeries, loop: Loop, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "a.npz", **table(series))
    assert main([str(tmp_path / "a.npz"), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert "95 % confidence" in printed.out
    assert "a.npz: 4096 samples" in printed.err
    found, as_text = (
        read_frequency_response(tmp_path / "out" / f"response.{kind}") for kind in ("npz", "csv")
    )
    np.testing.assert_allclose(as_text.G, found.G, rtol=1e-6)
    assert found.spread is not None
    kept = (found.hz > 2.0) & (found.hz < 600.0)
    assert np.mean((np.abs(found.G - loop.response(found.hz)) <= found.spread)[kept]) > 0.9
    assert (tmp_path / "out" / "response.png").read_bytes()[1:4] == b"PNG"


def test_a_force_without_what_is_injected_is_found(
    tmp_path: Path, series: TimeSeries, loop: Loop, capsys: pytest.CaptureFixture[str]
) -> None:
    """The controller's force alone hardly follows what is injected above the bandwidth."""
    columns = table(series)
    np.savez(tmp_path / "a.npz", **columns | {"force": series.force - series.excitation})
    assert main([str(tmp_path / "a.npz"), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert "--add-injected" in capsys.readouterr().err
    words = [str(tmp_path / "a.npz"), "--add-injected", "--quiet", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    found = read_frequency_response(tmp_path / "out" / "response.npz")
    kept = (found.hz > 2.0) & (found.hz < 300.0)
    assert np.median(np.abs(found.G / loop.response(found.hz) - 1.0)[kept]) < 0.1
