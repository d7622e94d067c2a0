"""One response in tables of 20 dialects: each is read as that response, with a line that says how,
or refused with both readings."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from ccd_casadi.plants.measured import read_frequency_response
from ccd_casadi.support.errors import UserError

F = np.geomspace(1.0, 100.0, 40)
S = 2j * np.pi * F
G = 1e-3 / (S**2 / 400.0 + 0.02 * S + 1.0)
DB, DEG = 20.0 * np.log10(np.abs(G)), np.degrees(np.angle(G))


def table(head: str, *columns: np.ndarray, mark: str = ",", comma: bool = False) -> str:
    rows = "\n".join(mark.join(f"{x:.10g}" for x in row) for row in zip(*columns, strict=True))
    return f"{head}\n{rows.replace('.', ',') if comma else rows}\n"


REAL = (G.real, G.imag)
BODE = (DB, DEG)


@pytest.mark.parametrize(
    ("text", "words", "encoding"),
    [
        (table("f_hz;re;im", F, *REAL, mark=";", comma=True), "decimals by commas", "utf-8"),
        (table("Frequency [Hz]|Mag [dB]|Phase [deg]", F, *BODE, mark="|"), "by bars", "utf-8"),
        (table("f_hz magnitude_db phase_deg", F, *BODE, mark=" "), "by spaces", "utf-8"),
        (table("Hz\tdB\tdeg", F, *BODE, mark="\t"), "by tabs", "utf-16"),
        (table("omega,re,im", 2.0 * np.pi * F, *REAL), "of omega, re", "utf-8"),
        (table("w (Hz),Gain (dB),Phase (°)", F, *BODE), "Gain", "latin-1"),
        (table("Frequenz [Hz];Betrag [µm/N];Phase [deg]", F, 1e6 * np.abs(G), DEG, mark=";",
               comma=True), "Latin-1", "latin-1"),
        (table("# f_hz, magnitude_db, phase_deg", F, *BODE), "line 1 is the header", "utf-8"),
        (table("Instrument: X\n\nf_hz,re,im", F, *REAL), "above the header", "utf-8"),
        (table("f,mag,phase\nHz,dB,deg", F, *BODE), "holds the units", "utf-8"),
        (table("f_hz,Accelerance ((m/s^2)/N),Phase (deg)", F, np.abs(G * S**2),
               np.degrees(np.angle(G * S**2))), "an accelerance, divided by", "utf-8"),
        (table("f_hz,re (m/s/N),im (m/s/N)", F, (G * S).real, (G * S).imag), "mobility", "utf-8"),
        (table("f_hz,Mobility (dB),phase_deg", F, 20.0 * np.log10(np.abs(G * S)),
               np.degrees(np.angle(G * S))), "mobility", "utf-8"),
    ],
)  # fmt: skip
def test_a_dialect_is_read_as_the_response(
    tmp_path: Path, text: str, words: str, encoding: str
) -> None:
    (tmp_path / "x.csv").write_text(text, encoding=encoding)
    found = read_frequency_response(tmp_path / "x.csv")
    np.testing.assert_allclose(found.hz, F, rtol=1e-8)
    np.testing.assert_allclose(found.G, G, rtol=1e-7)
    assert words in found.words


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (table("Freq,Mag(dB),Phase(deg)", F, *BODE), "may be Hz or rad/s"),
        (table("f_hz,Mag (dB),Phase", F, *BODE), "may be deg or rad"),
        (table("f_hz,Mag (dB),Phase (rad)", F, *BODE), "degrees may be meant"),
        (table("f_hz,Mobility (m/N),phase_deg", F, np.abs(G), DEG), "a mobility is not in m/n"),
        (table("f_hz,re (m/s/N),im", F, *REAL), "different derivatives"),
        (table("f_hz,gain,phase_deg", F, np.abs(G), DEG), "'gain': is not understood"),
        (table("f_hz,re,im,coherence,averages", F, *REAL, 1.5 + 0.0 * F, F), "in 0 to 1"),
    ],
)
def test_two_readings_are_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(UserError, match=words):
        read_frequency_response(tmp_path / "x.csv")


def test_coherence_and_averages_are_a_spread(tmp_path: Path) -> None:
    """It holds 95 % of estimates of n averages."""
    rng, n, noise = np.random.default_rng(3), 16, 0.5
    x, v = (rng.standard_normal((2000, n)) + 1j * rng.standard_normal((2000, n)) for _ in range(2))
    y = x + noise * v
    found = (y * x.conj()).sum(axis=1) / (np.abs(x) ** 2).sum(axis=1)
    coherence = 1.0 / (1.0 + noise**2)
    columns = (F, *REAL, coherence + 0.0 * F, n + 0.0 * F)
    (tmp_path / "x.csv").write_text(table("f_hz,re,im,coherence,averages", *columns))
    read = read_frequency_response(tmp_path / "x.csv")
    assert "spread of 95 % by coherence" in read.words
    share = read.spread / np.abs(read.G)
    assert np.mean(np.abs(found - 1.0) <= share[0]) == pytest.approx(0.95, abs=0.02)


def test_universal_files(tmp_path: Path) -> None:
    pyuff = pytest.importorskip("pyuff")
    units = {
        f"{axis}_{part}": 0
        for axis in ("abscissa", "ordinate", "orddenom", "z_axis")
        for part in ("spec_data_type", "len_unit_exp", "force_unit_exp", "temp_unit_exp")
    }
    labels = {f"{axis}_axis_lab": "NONE" for axis in ("abscissa", "ordinate", "orddenom", "z_axis")}
    hz = np.arange(1.0, 101.0)
    s = 2j * np.pi * hz
    data = 1.0 / (s**2 + 30.0 * s + 3e4)
    one = {
        "type": 58, "binary": 0, "func_type": 4, "ver_num": 1, "load_case_id": 0,
        "rsp_ent_name": "NONE", "rsp_node": 1, "rsp_dir": 3, "ref_ent_name": "NONE", "ref_node": 2,
        "ref_dir": -3, "ord_data_type": 6, "num_pts": 100, "abscissa_spacing": 1,
        "abscissa_min": 1.0, "abscissa_inc": 1.0, "z_axis_value": 0.0, **units, **labels,
        "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13,
        "abscissa_axis_units_lab": "Hz", "ordinate_axis_units_lab": "m/s^2",
        "orddenom_axis_units_lab": "N", "z_axis_axis_units_lab": "NONE", "data": data * s**2,
        "x": hz, **{f"id{i}": "" for i in range(1, 6)},
    }  # fmt: skip
    path = tmp_path / "a.uff"
    pyuff.UFF(str(path)).write_sets(one, "overwrite")
    found = read_frequency_response(path)
    np.testing.assert_allclose(found.G, data, rtol=1e-4)
    assert "node and direction 1:+3 over 2:-3" in found.words
    for change, words in (
        ({"ordinate_axis_units_lab": "mm"}, "not understood as a unit of acceleration"),
        ({"orddenom_spec_data_type": 8}, "not over a force"),
        ({"func_type": 6}, "holds 0 frequency responses"),
    ):
        pyuff.UFF(str(path)).write_sets(one | change, "overwrite")
        with pytest.raises(UserError, match=words):
            read_frequency_response(path)
    inches = {
        "type": 164, "units_code": 7, "units_description": "IN", "temp_mode": 1, "length": 39.37,
        "force": 0.2248, "temp": 1.0, "temp_offset": 273.15,
    }  # fmt: skip
    pyuff.UFF(str(path)).write_sets([inches, one], "overwrite")
    with pytest.raises(UserError, match=r"the units IN.*may be in these or in SI"):
        read_frequency_response(path)
    pyuff.UFF(str(path)).write_sets(one, "overwrite")
    pyuff.UFF(str(path)).write_sets(one, "add")
    with pytest.raises(UserError, match="holds 2 frequency responses"):
        read_frequency_response(path)
    (tmp_path / "b.uff").write_text("    -1\n    58\nhello\n    -1\n")
    with pytest.raises(UserError):
        read_frequency_response(tmp_path / "b.uff")


def test_the_struct_of_an_frd(tmp_path: Path) -> None:
    """As MATLAB's get(frd) has it: (outputs, inputs, lines) over rad/s."""
    both = np.moveaxis(G[:, None, None] * np.array([[1.0, 0.2], [0.1, 0.9]]), 0, -1)
    empty = np.array([], object)
    struct = {
        "ResponseData": both, "Frequency": 2.0 * np.pi * F, "FrequencyUnit": "rad/TimeUnit",
        "Ts": 0.0,
        "IODelay": np.zeros((2, 2)), "InputDelay": np.zeros((2, 1)), "TimeUnit": "seconds",
        "OutputDelay": np.zeros((2, 1)), "Name": "", "Notes": empty, "UserData": empty,
    }  # fmt: skip
    savemat(tmp_path / "sys.mat", {"sys": struct})
    found = read_frequency_response(tmp_path / "sys.mat")
    np.testing.assert_allclose(found.hz, F)
    np.testing.assert_allclose(found.G, np.moveaxis(both, -1, 0))
    late = struct | {"IODelay": 1e-3 * np.ones((2, 2))}
    savemat(tmp_path / "late.mat", {"sys": late})
    with pytest.raises(UserError, match="IODelay"):
        read_frequency_response(tmp_path / "late.mat")
