"""200 files of a plant that is known: each is read as that plant, or refused by the name of what is
not understood; none is read as another one."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_matrix

from ccd_casadi.extensions.measured.tuned_plants import read_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.measured import MeasuredResponse, read_frequency_response
from ccd_casadi.support.errors import UserError
from ccd_casadi.synthesis.interchange import read_mat

HZ = 2.0 * np.pi
Fields = dict[str, object]


def random_model(rng: np.random.Generator) -> Fields:
    """A stage with modes, one or two channels."""
    n, p = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    w, zeta = 10.0 ** rng.uniform(0.0, 3.0, n), 10.0 ** rng.uniform(-3.0, 0.0, n)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(w**2), -np.diag(2.0 * zeta * w)]])
    B = np.vstack([np.zeros((n, p)), rng.normal(size=(n, p))])
    C = np.hstack([rng.normal(size=(p, n)), np.zeros((p, n))])
    return {"A": A, "B": B, "C": C, "D": np.zeros((p, p))}


def response(m: Fields, omega: np.ndarray) -> np.ndarray:
    A, B, C, D = (np.asarray(m[part]) for part in "ABCD")
    return np.stack([C @ np.linalg.solve(1j * o * np.eye(len(A)) - A, B + 0j) + D for o in omega])


def plain(m: Fields, rng: np.random.Generator) -> tuple[Fields, Callable[[np.ndarray], object]]:
    return {}, lambda omega: 1.0


def descriptor(m: Fields, rng: np.random.Generator) -> tuple[Fields, Callable]:
    n = len(np.asarray(m["A"]))
    E = np.eye(n) + 0.3 * rng.normal(size=(n, n))
    return {"E": E, "A": E @ m["A"], "B": E @ m["B"]}, lambda omega: 1.0


def input_delay(m: Fields, rng: np.random.Generator) -> tuple[Fields, Callable]:
    tau = rng.uniform(1e-3, 0.1)
    p = np.asarray(m["D"]).shape[0]
    key = str(rng.choice(["InputDelay", "OutputDelay", "IODelay", "ioDelay"]))
    shape = (p, p) if key.lower() == "iodelay" else (p, 1)
    return {key: np.full(shape, tau)}, lambda omega: np.exp(-1j * omega * tau)[:, None, None]


def unlike_delays(m: Fields, rng: np.random.Generator) -> tuple[Fields, Callable]:
    p = np.asarray(m["D"]).shape[0]
    tau = rng.uniform(1e-3, 0.1, p)
    late = {"OutputDelay": tau[:, None]}
    return late, lambda omega: np.exp(-1j * np.outer(omega, tau))[:, :, None]


def minutes(m: Fields, rng: np.random.Generator) -> tuple[Fields, Callable]:
    unit, word = [(1e-3, "milliseconds"), (60.0, "minutes")][rng.integers(2)]
    tau = rng.uniform(1e-3, 0.1)
    fields = {"A": unit * m["A"], "B": unit * m["B"], "TimeUnit": word, "InputDelay": tau / unit}
    return fields, lambda omega: np.exp(-1j * omega * tau)[:, None, None]


def sparse(m: Fields, rng: np.random.Generator) -> tuple[Fields, Callable]:
    chosen = [part for part in "ABCD" if rng.random() < 0.6] or ["C"]
    return {part: csc_matrix(m[part]) for part in chosen}, lambda omega: 1.0


def harmless(m: Fields, rng: np.random.Generator) -> tuple[Fields, Callable]:
    return {"Name": "stage", "StateName": "x", "InternalDelay": np.zeros((0, 1)), "UserData": [],
            "OutputDelay": np.zeros((1, 1)), "NoiseVariance": 0.0}, lambda omega: 1.0  # fmt: skip


def refused(name: str, value: object) -> Callable:
    return lambda m, rng: ({name: value}, None)


WAYS = {
    "": plain, "E": descriptor, "Delay": input_delay, "OutputDelay": unlike_delays,
    "TimeUnit": minutes, "sparse": sparse, "harmless": harmless,
    "InternalDelay": refused("InternalDelay", 0.01), "Offsets": refused("Offsets", {"x": [1.0]}),
    "Kalman": refused("Kalman", np.ones((2, 1))), "tau": refused("tau", 0.02),
    "timeunit": refused("TimeUnit", "fortnights"), "singular": refused("E", np.zeros((2, 2))),
    "Ts": refused("Ts", -1.0), "nan": refused("A", np.full((2, 2), np.nan)),
}  # fmt: skip


@pytest.mark.parametrize("seed", range(100))
def test_no_model_is_read_as_another(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    m = random_model(rng)
    word = list(WAYS)[seed % len(WAYS)]
    fields, factor = WAYS[word](m, rng)
    whole = m | fields
    path, nested = tmp_path / "x.mat", bool(rng.random() < 0.5)
    savemat(path, {"sys": whole} if nested else whole)
    known = {"nan": r"\bA: ", "singular": r"\bE: ", "timeunit": "TimeUnit", "Kalman": "Kalman"}
    if factor is None:
        if word == "Kalman" and not nested:
            return  # a vector beside matrices, of which nothing says that it is theirs
        if word == "Offsets" and not nested:
            return  # a struct beside them
        with pytest.raises(UserError, match=known.get(word, word)):
            read_mat(path)
        return
    omega = np.geomspace(0.1, 1e4, 60)
    truth = response(m, omega) * factor(omega)
    if word == "OutputDelay" and len(truth[0]) > 1:
        with pytest.raises(UserError, match="OutputDelay: differs between channels"):
            read_mat(path)
        return
    (found,) = read_mat(path).systems.values()
    read = found.system.response(omega) * np.exp(-1j * omega * found.delay)[:, None, None]
    assert np.abs(read - truth).max() <= 1e-6 * np.abs(truth).max()
    np.testing.assert_allclose(read, truth, rtol=1e-5, atol=1e-9 * np.abs(truth).max())
    assert "state" in found.words


def random_lines(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A stage with a resonance and a delay, on lines evenly or by decades apart."""
    hz = np.linspace(1.0, 800.0, 400) if rng.random() < 0.5 else np.geomspace(0.5, 900.0, 150)
    s = 1j * HZ * hz
    w, zeta = HZ * rng.uniform(100.0, 400.0), 10.0 ** rng.uniform(-2.0, -1.0)
    first = HZ * rng.uniform(1.0, 30.0)
    body = 1.0 / (s**2 + 2.0 * rng.uniform(0.05, 1.0) * first * s + first**2)
    G = body + 0.3 * rng.choice([-1.0, 1.0]) / (s**2 + 2.0 * zeta * w * s + w**2)
    G = 10.0 ** rng.uniform(-2.0, 4.0) * G * np.exp(-s * rng.uniform(0.0, 2e-3))
    return hz, G


def table_text(names: list[str], columns: list[np.ndarray], rng: np.random.Generator) -> bytes:
    """A dialect of CSV."""
    mark, comma = [(",", False), (";", False), (";", True), ("\t", False), ("\t", True)][
        rng.integers(5)
    ]
    rows = [mark.join(names)]
    for row in zip(*columns, strict=True):
        cells = [f"{v.real:.12g}" + (f"{v.imag:+.12g}j" if isinstance(v, complex) else "")
                 for v in row]  # fmt: skip
        rows.append(mark.join(c.replace(".", ",") if comma else c for c in cells))
    if rng.random() < 0.3:
        rows.insert(0, "# measured by hand")
    if rng.random() < 0.3:
        rows.insert(0, "Session 12")
    text = "\n".join([*rows, ""]) + ("\n \n" if rng.random() < 0.3 else "")
    return text.encode(str(rng.choice(["utf-8", "utf-16", "latin-1", "utf-8-sig"])))


FORMS = ("re, im", "mag, deg", "db, rad", "Unit (…)", "complex", "khz")
FAULTS = ("", "", "rad as deg", "unwrapped rad as deg", "deg as rad", "db as mag", "twice",
          "unknown", "phase dropped", "no unit", "both")  # fmt: skip


def table_of(
    form: str, fault: str, hz: np.ndarray, G: np.ndarray
) -> tuple[list[str], list[np.ndarray], str]:
    """Names, columns and the word that a refusal has to have."""
    size, angle = np.abs(G), np.angle(G)
    if fault in ("rad as deg", "unwrapped rad as deg"):
        turned = np.unwrap(angle) if fault.startswith("un") else angle
        return ["f_hz", "magnitude", "phase_deg"], [hz, size, turned], "phase_deg"
    if fault == "deg as rad":
        return ["f_hz", "magnitude", "phase_rad"], [hz, size, np.rad2deg(angle)], "phase_rad"
    if fault == "db as mag":
        db = 20.0 * np.log10(size)
        shifted = db - db.min() + 5.0  # of another unit: all above 0
        chosen = shifted if hz[1] - hz[0] > 0.5 else db
        return ["f_hz", "magnitude", "phase_deg"], [hz, chosen, np.rad2deg(angle)], "magnitude"
    if fault == "no unit":
        return ["f_hz", "magnitude", "phase"], [hz, size, np.rad2deg(angle)], "phase"
    if fault == "phase dropped":
        return ["f_hz", "G"], [hz, size], "phase"
    names, columns = {
        "re, im": (["f_hz", "re", "im"], [hz, G.real, G.imag]),
        "mag, deg": (["frequency_hz", "magnitude", "phase_deg"], [hz, size, np.rad2deg(angle)]),
        "db, rad": (["hz", "magnitude_db", "phase_rad"], [hz, 20.0 * np.log10(size), angle]),
        "Unit (…)": (["Frequency [Hz]", "Magnitude (dB)", "Phase (deg)"],
                     [hz, 20.0 * np.log10(size), np.rad2deg(angle)]),
        "complex": (["f_hz", "G"], [hz, G]),
        "khz": (["frequency (kHz)", "real", "imag"], [hz / 1e3, G.real, G.imag]),
    }[form]  # fmt: skip
    if fault == "twice":
        return [*names, names[1]], [*columns, 0.01 * columns[1]], re.escape(names[1])
    if fault == "unknown":
        return [*names, "delay"], [*columns, np.full(len(hz), 1e-3)], "delay"
    if fault == "both":
        if form in ("re, im", "khz"):
            return [*names, "G"], [*columns, G], "G"
        return [*names, "real", "imag"], [*columns, G.real, G.imag], "real"
    return list(names), list(columns), ""


@pytest.mark.parametrize("seed", range(100))
def test_no_table_is_read_as_another(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    hz, G = random_lines(rng)
    form, fault = FORMS[seed % len(FORMS)], FAULTS[seed % len(FAULTS)]
    names, columns, word = table_of(form, fault, hz, G)
    if seed % 3 and fault != "twice":  # a file of arrays cannot have a name twice
        path = tmp_path / ("x.npz" if seed % 3 == 1 else "x.mat")
        plain_names = [re.sub(r"\W+", "_", name).strip("_") for name in names]
        content = dict(zip(plain_names, columns, strict=True))
        np.savez(path, **content) if seed % 3 == 1 else savemat(path, content)
    else:
        path = tmp_path / "x.csv"
        path.write_bytes(table_text(names, columns, rng))
    if fault:
        with pytest.raises(UserError, match=word):
            read_frequency_response(path)
        return
    found = read_frequency_response(path)
    np.testing.assert_allclose(found.hz, hz, rtol=1e-9)
    np.testing.assert_allclose(found.G, G, rtol=1e-8)
    assert "lines from" in found.words


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2,3\n" * 6, "line 1: has no header"),
        ("f_hz,re,im\n1,2,3\n2,x,3\n", "line 3: 'x' is not a number"),
        ("f_hz,re,im\n1,2,3\n2,nan,3\n", "line 3: 'nan' is not a finite number"),
        ("f_hz,re,im\n1,2,3\n3,2,3\n2,2,3\n", "line 4 falls to 2 Hz"),
        ("f_hz,re,im\n1,2,3\n1,2,3\n", "line 3 repeats 1 Hz"),
        ("f_hz,re,im\n1,5,0,2,0,3\n", "line 2: has 6 cells and the header 3: are its decimals"),
        ("f_hz;re;im\n1,234;5,678;9,123\n", "line 2: a comma may be a decimal or part thousands"),
        ("f_hz;re;im\n1.5;5,678;9,123\n", "line 2: a comma may be"),
        ("f,re,im\n1,2,3\n", "'f': names no unit; it may be Hz or rad/s"),
        ("    -1\n    58\n", "universal file"),
    ],
)
def test_the_cause_is_named_with_its_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=re.escape(words)):
        read_frequency_response(path)


def test_a_line_at_0_hz_and_a_row_of_units_are_reported(tmp_path: Path) -> None:
    rows = "".join(f"{f},{1.0 / f},{-0.1 * f}\n" for f in range(1, 8))
    (tmp_path / "x.csv").write_text(f"f_hz,re,im\nHz,m/N,m/N\n0,1,0\n{rows}")
    found = read_frequency_response(tmp_path / "x.csv")
    assert found.hz[0] == 1.0
    assert "line 2 holds the units" in found.words
    assert "line 3 at 0 Hz is left out" in found.words


def lines_of_six() -> tuple[np.ndarray, np.ndarray]:
    hz = np.arange(1.0, 7.0)
    return hz, 1.0 / (1j * HZ * hz + 3.0)


def written_arrays(path: Path, content: Fields) -> Path:
    (np.savez if path.suffix == ".npz" else lambda p, **c: savemat(p, c))(path, **content)
    return path


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
@pytest.mark.parametrize("name", ["unit", "Units", "G_unit", "unit_of_response"])
@pytest.mark.parametrize(
    ("unit", "factor"),
    [("m/N", 1.0), ("mm/N", 1e-3), ("um/N", 1e-6), ("\xb5m/N", 1e-6), ("\u03bcm/N", 1e-6),
     ("nm/N", 1e-9), ("rad/(N m)", 1.0), ("-", 1.0), ("", 1.0)],
)  # fmt: skip
def test_the_unit_in_a_text_is_that_of_the_response(
    tmp_path: Path, suffix: str, name: str, unit: str, factor: float
) -> None:
    hz, G = lines_of_six()
    content: Fields = {"f_hz": hz, "G": G, "spread": 0.1 * np.abs(G), name: unit, "note": "um/N"}
    found = read_frequency_response(written_arrays(tmp_path / f"x{suffix}", content))
    np.testing.assert_allclose(found.G, factor * G, rtol=1e-12)
    assert found.spread is not None
    np.testing.assert_allclose(found.spread, 0.1 * factor * np.abs(G), rtol=1e-12)
    np.testing.assert_allclose(found.hz, hz)


def test_a_spread_keeps_the_unit_of_its_own(tmp_path: Path) -> None:
    hz, G = lines_of_six()
    content: Fields = {"f_hz": hz, "G": G, "spread": np.abs(G), "unit": "um/N",
                       "spread_unit": "nm/N"}  # fmt: skip
    found = read_frequency_response(written_arrays(tmp_path / "x.npz", content))
    assert found.spread is not None
    np.testing.assert_allclose(found.spread, 1e-3 * np.abs(found.G), rtol=1e-12)


def test_units_of_single_columns_are_those_of_a_table_of_text(tmp_path: Path) -> None:
    hz, G = lines_of_six()
    parts: Fields = {"frequency": hz / 1e3, "re": G.real, "im": G.imag, "frequency_unit": "kHz",
                     "units": "\xb5m/N"}  # fmt: skip
    found = read_frequency_response(written_arrays(tmp_path / "x.npz", parts))
    rows = "".join(f"{f!r},{g.real!r},{g.imag!r}\n" for f, g in zip(
        (hz / 1e3).tolist(), G.tolist(), strict=True))  # fmt: skip
    (tmp_path / "x.csv").write_text(f"frequency,re,im\nkHz,\xb5m/N,\xb5m/N\n{rows}")
    table = read_frequency_response(tmp_path / "x.csv")
    np.testing.assert_allclose(found.G, table.G, rtol=1e-12)
    np.testing.assert_allclose(found.G, 1e-6 * G, rtol=1e-12)
    np.testing.assert_allclose(found.hz, table.hz, rtol=1e-12)


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
@pytest.mark.parametrize(
    ("texts", "words"),
    [
        ({"unit": "furlong/N"}, "unit: is 'furlong/N'; it may be m/N, mm/N, µm/N or nm/N"),
        ({"unit": "Hz"}, "unit: is 'Hz'; it may be m/N"),
        ({"f_unit": "um/N"}, "f_unit: is 'um/N'; it may be Hz or rad/s"),
        ({"f_hz_unit": "rad/s"}, "f_hz_unit: gives 'f_hz' the unit 'rad/s'; keep one"),
        ({"unit": "dB"}, "has the unit 'db'; it may be m/N, mm/N, µm/N or nm/N"),
        ({"OutputUnit": "um"}, "OutputUnit: is 'um' and is not understood; give the unit"),
        ({"unit": ["um/N", "nm/N"]}, "unit: holds several texts; give one unit"),
        ({"unit": "um/N", "G_unit": "nm/N"}, "keep one"),
        ({"unit": "Mm/N"}, "is in megametres as it is written; it may be m/N, mm/N"),
    ],
)
def test_a_unit_that_is_not_clear_is_refused(
    tmp_path: Path, suffix: str, texts: Fields, words: str
) -> None:
    hz, G = lines_of_six()
    path = written_arrays(tmp_path / f"x{suffix}", {"f_hz": hz, "G": G, **texts})
    with pytest.raises(UserError, match=re.escape(words)):
        read_frequency_response(path)


@pytest.mark.parametrize("read", [read_frequency_response, read_mat])
@pytest.mark.parametrize("names", [("num", "den"), ("Numerator", "Denominator")])
@pytest.mark.parametrize("nested", [True, False])
def test_a_transfer_function_in_a_file_is_refused_as_one(
    tmp_path: Path, read: Callable, names: tuple[str, str], nested: bool
) -> None:
    polynomials = dict(zip(names, ([[1.0]], [[1.0, 2.0, 3.0]]), strict=True))
    if nested and read is read_frequency_response:
        return  # a struct is a model
    savemat(tmp_path / "x.mat", {"sys": polynomials} if nested else polynomials)
    words = f"{names[0]} and {names[1]} are a transfer function, which is not read; give A, B, C, D"
    with pytest.raises(UserError, match=words):
        read(tmp_path / "x.mat")


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize(
    ("units", "words"),
    [
        ({"OutputUnit": "um", "InputUnit": "N"}, "OutputUnit: is um: give the outputs in metres"),
        ({"OutputUnit": "mrad"}, "OutputUnit: is mrad: give the outputs in radians"),
        ({"OutputUnit": "in"}, "OutputUnit: is in: give the outputs in metres or radians"),
        ({"InputUnit": "kN"}, "InputUnit: is kN: give the inputs in newtons"),
        ({"InputUnit": "mN m"}, "InputUnit: is mN m: give the inputs in newton metres"),
        ({"InputUnit": "mV"}, "InputUnit: is mV: give the inputs in newtons or newton metres"),
        ({"OutputUnit": np.array([["m"], ["nm"]], dtype=object)}, "OutputUnit: is nm: give"),
        ({"OutputUnit": "m", "InputUnit": "N"}, ""),
        ({"OutputUnit": "rad", "InputUnit": "N m"}, ""),
        ({"OutputUnit": "rad", "InputUnit": "N*m"}, ""),
        ({"OutputUnit": "N", "InputUnit": "m"}, ""),
        ({"OutputUnit": "m", "InputUnit": "V"}, ""),
        ({"OutputUnit": "", "InputUnit": []}, ""),
    ],
)
def test_a_model_in_another_unit_is_refused(
    tmp_path: Path, nested: bool, units: Fields, words: str
) -> None:
    m = random_model(np.random.default_rng(0)) | units
    savemat(tmp_path / "x.mat", {"sys": m} if nested else m)
    if not words:
        assert read_mat(tmp_path / "x.mat").systems
        return
    with pytest.raises(UserError, match=re.escape(words)):
        read_mat(tmp_path / "x.mat")


def cell(*texts: str) -> np.ndarray:
    found = np.empty((len(texts), 1), dtype=object)
    found[:, 0] = texts
    return found


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.parametrize("lower", [True, False])
@pytest.mark.parametrize(("unit", "factor"), [("um/N", 1e-6), ("m/N", 1.0), ("-", 1.0),
                                              (("nm/N", "nm/N"), 1e-9)])  # fmt: skip
def test_the_unit_of_a_model_is_that_of_its_response(
    tmp_path: Path, nested: bool, beside: bool, lower: bool, unit: object, factor: float
) -> None:
    m = random_model(np.random.default_rng(1))
    stated = {"units" if nested else "unit": unit if isinstance(unit, str) else cell(*unit)}
    written = {key.lower(): value for key, value in m.items()} if lower else dict(m)
    if nested:
        content: Fields = {"sys": written} | stated if beside else {"sys": written | stated}
    else:
        content = written | stated
    savemat(tmp_path / "x.mat", content | {"note": "um/N", "author": "me"})
    named, _ = read_plant(tmp_path / "x.mat", 0.0, lambda words: None)
    assert isinstance(named, StateSpace)
    np.testing.assert_allclose(named.C, factor * np.asarray(m["C"]), rtol=1e-12)
    np.testing.assert_allclose(named.A, np.asarray(m["A"]))


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize(
    ("beside", "words"),
    [
        ({"unit": "furlong/N"}, "unit: is 'furlong/N'; it may be m/N"),
        ({"unit": "Mm/N"}, "unit: is 'Mm/N'; it may be m/N"),
        ({"unit": cell("um/N", "m/N")}, "unit: holds several texts; give one unit for all"),
        ({"unit": 1e-6}, "unit: is no text; give the unit"),
        ({"unit": "um/N", "G_unit": "nm/N"}, "and another unit is stated; keep one"),
        ({"output_unit": "um"}, "output_unit: is 'um' and is not understood"),
        ({"time_unit": "ms"}, "time_unit: is 'ms' and is not understood"),
        ({"OutputUnit": "um"}, "OutputUnit: "),
        ({"TimeUnit": "minutes", "Ts": 1.0}, ""),
        ({"gain": "3 V/N"}, "gain: "),
        ({"gain": np.ones((1, 7))}, "gain: "),
        ({"sensor_delay": "300 us"}, "sensor_delay: "),
        ({"loopDelay": 3e-4}, "loopDelay: "),
        ({"rate_hz": 5e3}, "rate_hz: "),
    ],
)
def test_what_is_beside_a_model_is_used_or_refused(
    tmp_path: Path, nested: bool, beside: Fields, words: str
) -> None:
    m = random_model(np.random.default_rng(2))
    savemat(tmp_path / "x.mat", ({"sys": m} if nested else m) | beside)
    if not words and not nested:
        assert read_mat(tmp_path / "x.mat").systems[""].system.period == 60.0
        return
    with pytest.raises(UserError, match=re.escape(words or "belongs to no system")):
        read_mat(tmp_path / "x.mat")


@pytest.mark.parametrize("beside", [True, False])
def test_lines_in_a_struct_are_read(tmp_path: Path, beside: bool) -> None:
    hz, G = lines_of_six()
    fields: Fields = {"f_hz": hz, "G": G}
    content: Fields = {"frf": fields, "unit": cell("um/N", "um/N")}
    savemat(tmp_path / "x.mat", content if beside else {"frf": fields | {"unit": "um/N"}})
    found, _ = read_plant(tmp_path / "x.mat", 0.0, lambda words: None)
    assert isinstance(found, MeasuredResponse)
    np.testing.assert_allclose(found.G, 1e-6 * G, rtol=1e-12)


def test_files_of_models_are_named_as_what_they_are(tmp_path: Path) -> None:
    m = random_model(np.random.default_rng(3))
    np.savez(tmp_path / "x.npz", **m)
    with pytest.raises(UserError, match=r"holds A, B, C of a model, which is read from \.mat"):
        read_plant(tmp_path / "x.npz", 0.0, lambda words: None)
    savemat(tmp_path / "x.mat", m | {"B": np.asarray(m["B"]).T})
    with pytest.raises(UserError) as error:
        read_mat(tmp_path / "x.mat")
    assert "x.mat: the sizes of A, B, C, D do not fit" in str(error.value)


def test_a_unit_in_a_comment_is_used_and_a_gain_announced(tmp_path: Path) -> None:
    hz, G = lines_of_six()
    rows = "".join(f"{f!r},{g.real!r},{g.imag!r}\n" for f, g in zip(
        hz.tolist(), G.tolist(), strict=True))  # fmt: skip
    head = "# unit: um/N\n% gain = 3\n# by: me\nf_hz,re,im\n"
    (tmp_path / "x.csv").write_text(head + rows)
    found = read_frequency_response(tmp_path / "x.csv")
    np.testing.assert_allclose(found.G, 1e-6 * G, rtol=1e-12)
    assert "line 1 gives the unit um/N" in found.words
    assert "line 2 is a comment and left out: gain = 3" in found.words
    (tmp_path / "x.csv").write_text(head.replace("re,im", "re (m/N),im (m/N)") + rows)
    with pytest.raises(UserError, match=r"line 1, unit: gives .* keep one"):
        read_frequency_response(tmp_path / "x.csv")


def test_sizes_that_do_not_fit_are_named(tmp_path: Path) -> None:
    path = tmp_path / "two.npz"
    hz = np.geomspace(1.0, 100.0, 95)
    np.savez(path, f_hz=hz, G=np.ones((100, 2, 2)) * (1.0 + 1j))
    with pytest.raises(UserError, match=r"G is \(100, 2, 2\), and there are 95 frequencies"):
        read_plant(path, 0.0, lambda words: None)


def test_matrices_of_a_model_are_no_response(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    np.savez(path, M=np.eye(2), D=np.eye(2), K=np.eye(2), B=np.ones((2, 1)), C=np.ones((1, 2)))
    with pytest.raises(UserError, match="M and K are the matrices of a model"):
        read_plant(path, 0.0, lambda words: None)
