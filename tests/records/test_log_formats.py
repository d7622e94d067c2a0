"""Logs of LabVIEW, TwinCAT and MATLAB 7.3 are read as what they hold, or refused by cause."""

from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.extensions.records.log_files import read_columns
from ccd_casadi.extensions.records.time_series import SignalNames, read_record
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import mat_variables

FOREIGN = Path(__file__).parents[1] / "data" / "foreign"
PERIOD, COUNT = 5e-4, 64


def signals() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {name: rng.normal(size=COUNT) for name in ("Injected", "Force", "Position")}


def scope(mark: str = "\t", comma: bool = False, second: float = 0.5) -> str:
    """Two groups as a scope exports them: channels of `PERIOD`, and one of `second` ms."""

    def number(value: float) -> str:
        return repr(value).replace(".", ",") if comma else repr(value)

    own = signals()
    named = ["Name", *own, "Name", "Slow"]
    rows = [
        ["Name", "a scope"], ["File", "a.csv"], ["Starttime of export", "1"], [],
        named,
        [cell if cell == "Name" else "" for cell in named],
        ["SampleTime[ms]", *["0.5"] * 3, "SampleTime[ms]", repr(second)],
        ["Unit", "N (Force)", "N (Force)", "mm (Position)", "Unit", "(None)"], [],
    ]  # fmt: skip
    rows[5] = ["SymbolComment" if cell == "Name" else cell for cell in rows[5]]
    for k in range(COUNT):
        row = [number(1e3 * PERIOD * k), *(number(float(v[k])) for v in own.values())]
        ended = k * PERIOD * 1e3 > (COUNT - 1) * PERIOD * 1e3 * 0.5 / second + 1e-9
        row += [" ", " "] if ended else [number(second * k), "1"]
        rows.append(row)
    return "\n".join(mark.join(row) for row in rows) + "\nEOF\n"


@pytest.mark.parametrize(("mark", "comma"), [("\t", False), ("\t", True), (";", True)])
def test_a_twincat_scope_is_a_record(tmp_path: Path, mark: str, comma: bool) -> None:
    (tmp_path / "log.csv").write_text(scope(mark, comma))
    found = read_record(tmp_path / "log.csv")
    own = signals()
    assert found.period == pytest.approx(PERIOD, rel=1e-12)
    assert found.injected
    np.testing.assert_allclose(found.position, 1e-3 * own["Position"], rtol=1e-15)
    np.testing.assert_allclose(found.force, own["Force"], rtol=1e-15)
    assert "a TwinCAT scope" in found.words


def test_channels_of_another_sampling_time_are_left_out_by_name(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(scope(second=1.0))
    found = read_record(tmp_path / "log.csv")
    assert len(found.force) == COUNT
    assert "of another sampling time than 0.5 ms and left out: Slow" in found.words


def test_decimals_that_are_the_separator_are_refused(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(scope(",", comma=True))
    with pytest.raises(UserError, match="its separator is in a decimal; export with tabs"):
        read_columns(tmp_path / "log.csv")


@pytest.mark.parametrize("kept", [2, 5, 9, 17, 24])
def test_a_scope_that_is_cut_off_is_refused_in_one_line(tmp_path: Path, kept: int) -> None:
    lines = (FOREIGN / "twincat_scope.csv").read_text().splitlines()[:kept]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(UserError) as caught:
        read_columns(tmp_path / "log.csv")
    assert len(str(caught.value).splitlines()) == 1


def test_the_scope_of_a_real_machine(tmp_path: Path) -> None:
    """Values as the scope has scaled them: the channel's own offset and factor are in them."""
    columns, rate, notes = read_columns(FOREIGN / "twincat_scope.csv")
    assert rate is None
    np.testing.assert_array_equal(columns["t (ms)"], np.arange(len(columns["t (ms)"])))
    count = columns["var_REAL64"]
    np.testing.assert_array_equal(columns["func_units_scaled (dV)"], 10.0 - 10.0 * count)
    np.testing.assert_array_equal(columns["func_scaled_int"], 1.0 - count)
    assert any("func_OS, func_freesample" in note for note in notes)


def test_a_scope_without_properties_has_units_in_its_names(tmp_path: Path) -> None:
    """As motion libraries name the channels of an axis; the last is not one of them."""
    own = signals()
    rows = ["Name,YT Scope,", "File,a.csv,", "Starttime of export,1", "",
            "Name,NoiseOut[0],ServoOutN[0],ActPosUm[0],ActVelMm[0]", ""]  # fmt: skip
    rows += [f"{0.125 * k!r},{','.join(repr(float(v[k])) for v in own.values())},0"
             for k in range(COUNT)]  # fmt: skip
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    found = read_record(tmp_path / "log.csv")
    assert found.period == pytest.approx(1.0 / 8000.0)
    np.testing.assert_allclose(found.position, 1e-6 * own["Position"], rtol=1e-15)
    np.testing.assert_allclose(found.force, own["Force"], rtol=1e-15)
    assert "position 'ActPosUm[0]' in Um" in found.words


def test_a_tdms_log_is_a_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nptdms = pytest.importorskip("nptdms")
    own, units = signals(), {"Injected": "N", "Force": "N", "Position": "um"}

    def written(name: str, **changed: float) -> Path:
        wave = {"wf_increment": PERIOD, "wf_start_offset": 0.0, "wf_samples": COUNT}
        channels = [
            nptdms.ChannelObject("log", key, value, {
                **wave, "unit_string": units[key], **(changed if key == "Force" else {})})
            for key, value in own.items()
        ]  # fmt: skip
        with nptdms.TdmsWriter(str(tmp_path / name)) as file:
            file.write_segment([nptdms.RootObject({}), *channels])
        return tmp_path / name

    found = read_record(written("a.tdms"))
    assert found.period == pytest.approx(PERIOD, rel=1e-12)
    np.testing.assert_allclose(found.position, 1e-6 * own["Position"], rtol=1e-15)
    np.testing.assert_allclose(found.excitation, own["Injected"], rtol=1e-15)
    for changed in ({"wf_increment": 1e-3}, {"wf_start_offset": PERIOD}):
        with pytest.raises(UserError, match="different sampling times"):
            read_record(written("b.tdms", **changed))
    raw = (tmp_path / "a.tdms").read_bytes()
    (tmp_path / "cut.tdms").write_bytes(raw[:-200])
    with pytest.raises(UserError, match="is cut off or damaged"):
        read_record(tmp_path / "cut.tdms")
    assert capsys.readouterr().err == ""
    (tmp_path / "c.tdms").write_bytes(b"TDSm" + bytes(40))
    with pytest.raises(UserError, match=r"is not a readable \.tdms file|cut off or damaged"):
        read_record(tmp_path / "c.tdms")


def matlab_73(path: Path, **values: object) -> None:
    """As MATLAB lays out `save -v7.3`: columns as rows, texts as codes, structs as groups."""
    h5py = pytest.importorskip("h5py")

    def put(place: object, name: str, value: object) -> None:
        if isinstance(value, dict):
            group = place.create_group(name)  # type: ignore[attr-defined]
            group.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, own in value.items():
                put(group, key, own)
            return
        text = isinstance(value, str)
        own = np.array([[ord(c)] for c in str(value)], np.uint16) if text else np.atleast_2d(value)
        if own.dtype.kind == "c":
            pairs = np.empty(own.shape, [("real", float), ("imag", float)])
            pairs["real"], pairs["imag"] = own.real, own.imag
            own = pairs
        made = place.create_dataset(name, data=own if text else own.T)  # type: ignore[attr-defined]
        made.attrs["MATLAB_class"] = np.bytes_("char" if text else "double")

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in values.items():
            put(file, name, value)
    raw = bytearray(path.read_bytes())
    raw[:128] = b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\x00\x02IM"
    path.write_bytes(raw)


def test_matlab_73_is_read_as_version_5(tmp_path: Path) -> None:
    own = signals()
    matlab_73(tmp_path / "log.mat", log={**{k: v[:, None] for k, v in own.items()},
                                         "fs": 1.0 / PERIOD})  # fmt: skip
    found = read_record(tmp_path / "log.mat")
    assert found.period == pytest.approx(PERIOD, rel=1e-12)
    np.testing.assert_array_equal(found.position, own["Position"])
    named = read_record(tmp_path / "log.mat", SignalNames(reference="Injected"))
    assert not named.injected
    G, A = np.array([[1.0 + 2.0j, 3.0 - 1.0j]]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    matlab_73(tmp_path / "g.mat", G=G, A=A, unit="mm/N", sys={"A": A, "name": "x"})
    content = mat_variables(tmp_path / "g.mat")
    np.testing.assert_array_equal(content["G"], G)
    np.testing.assert_array_equal(content["A"], A)
    assert content["unit"].tolist() == ["mm/N"]
    np.testing.assert_array_equal(content["sys"]["A"][0, 0], A)
    (tmp_path / "bad.mat").write_bytes((tmp_path / "g.mat").read_bytes()[:700])
    with pytest.raises(UserError, match=r"is not a readable MATLAB 7\.3 file"):
        mat_variables(tmp_path / "bad.mat")
