"""What is told of a wrong or awkward plant, on loading and by the command `check`."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from ccd_casadi.__main__ import main as ccd
from ccd_casadi.cases.case import CaseError, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.diagnosis import diagnose
from ccd_casadi.cases.findings import Severity, Topic
from ccd_casadi.check import main as check
from ccd_casadi.plants.plant_facts import Zero, bandwidth_limit_hz
from ccd_casadi.solve import main as solve
from ccd_casadi.solve import show_findings

ROOT = Path(__file__).parents[2]
GOOD = (
    "{'mass': ca.diag(ca.vertcat(m1, m2)), 'stiffness': 2e8 * chain, 'damping_ratio': 0.01,"
    " 'input': ca.DM([1, 0]), 'output': ca.DM([[1, 0]]), 'hardware_cost': m1 + m2}"
)


def case_file(folder: Path, result: str, suspension: str = "", before: str = "") -> Path:
    """A case with the bounds of case study 1 whose plant function returns `result`."""
    (folder / "plant.py").write_text(
        "import casadi as ca\n\n\ndef f(t):\n    m1, m2 = t['m1'], t['m2']\n"
        f"    chain = ca.DM([[1, -1], [-1, 1]])\n{before}    return {result}\n"
    )
    text = (ROOT / "runs" / "two_mass.toml").read_text()
    text = text.replace('model = "two_mass"', 'function = "plant.py:f"').replace(
        "zeta = 0.01 ", "#"
    )
    path = folder / "own.toml"
    path.write_text(f"{text}\n[suspension]\n{suspension}\n")
    return path


@pytest.mark.parametrize(
    ("result", "suspension", "words"),
    [
        # wrong at corners or in the middle only, where the start is sound
        (GOOD + "|{'mass': ca.diag(ca.vertcat(m1 - 56, m2))}", "", "mass is not positive definite"),
        (GOOD + "|{'mass': ca.diag(ca.vertcat(m1 - 56, m2))}", "", "least eigenvalue is -1;"),
        (GOOD + "|{'stiffness': 2e8 * chain - (m1 > 69) * ca.DM([[0, 1], [0, 0]])}", "",
         "stiffness is not symmetric at theta = m1=70"),
        (GOOD + "|{'input': ca.DM([0, 0])}", "", "no mode is both driven and measured"),
        (GOOD, "rigid_modes = 2", "1 rigid-body modes at the start, where"),
        (GOOD + "|{'stiffness': 2e8 * chain + 1e7 * ca.DM.eye(2)}", "rigid_modes = 1",
         "0 rigid-body modes at the start, where suspension.rigid_modes expects 1"),
    ],
)  # fmt: skip
def test_a_wrong_plant_is_refused_on_loading(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], result: str, suspension: str, words: str
) -> None:
    path = case_file(tmp_path, result, suspension)
    with pytest.raises(CaseError) as caught:
        problem_of(load_case(path))
    assert str(caught.value).startswith(f"{path}: plant: ")
    assert words in str(caught.value)
    assert check([str(path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_expected_number_of_rigid_modes_passes_and_a_wrong_one_is_no_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check([str(case_file(tmp_path, GOOD, "rigid_modes = 1"))]) == 0
    assert check([str(case_file(tmp_path, GOOD, "rigid_modes = -1"))]) == 2
    assert "suspension.rigid_modes: is -1" in capsys.readouterr().err


HIDDEN = (
    "    M = ca.diag(ca.vertcat(m1, m2, m2))\n    K = 1e8*ca.DM([[2,-1,-1],[-1,1,0],[-1,0,1]])\n"
)
THREE = GOOD + "|{'mass': M, 'stiffness': K, 'input': ca.DM([1,0,0]), 'output': ca.DM([[1,0,0]])}"


def test_a_hidden_mode_is_reported_by_its_frequency(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two equal masses on equal springs, seen from the third: their opposed motion is hidden."""
    path = case_file(tmp_path, THREE, before=HIDDEN)
    assert check([str(path)]) == 0
    out = capsys.readouterr().out
    hz = (1e8 / 67.56) ** 0.5 / 6.283185307
    assert f"the mode at {hz:.5g} Hz at the start is not driven and not measured" in out
    assert "(uncontrollable, unobservable)" in out
    assert out.count("warning") == 1
    # a damper between both lets the motion out again, whatever its matrix does to symmetry
    asymmetric = THREE.replace("'damping_ratio': 0.01", "'damping': ca.diag(ca.DM([0, 1e4, 2e4]))")
    (tmp_path / "damped").mkdir()
    assert check([str(case_file(tmp_path / "damped", asymmetric, before=HIDDEN))]) == 0
    assert "not driven" not in capsys.readouterr().out


def test_a_rigid_motion_that_no_input_drives_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    free = GOOD + "|{'stiffness': 0 * chain}"
    assert check([str(case_file(tmp_path, free))]) == 0
    assert "of 2 rigid-body motions at the start one or more are not driven" in (
        capsys.readouterr().out
    )


def test_zeros_and_the_bandwidth_to_expect_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert check([str(ROOT / "runs" / "two_mass.toml"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    # two equal masses: the antiresonance is that of one on the spring, the resonance √2 above
    assert found["modes"][1]["frequency_hz"] == pytest.approx(250.0, abs=0.05)
    (zero,) = found["zeros"]
    assert zero["frequency_hz"] == pytest.approx(250.0 / 2**0.5, rel=1e-3)
    assert zero["damping_ratio"] == pytest.approx(0.01 / 2**0.5, rel=0.05)
    assert 0.001 < zero["dip"] < 0.1
    assert [f["severity"] for f in found["findings"]] == ["note"]
    low, high = found["bandwidth_window_hz"]
    assert low < 52.6 < high  # the true ω_b* there
    # M_K that suits scales with the square of the bandwidth
    suits = found["M_K_for_bandwidth"]
    assert suits[2]["M_K"] / suits[0]["M_K"] == pytest.approx(6.25)


def test_a_zero_in_the_right_half_plane_is_a_warning(tmp_path: Path) -> None:
    """Force on one mass, sensor beyond the other, as at the far end of a lever."""
    lever = GOOD + "|{'output': ca.DM([[-9, 10]])}"
    problem = problem_of(load_case(case_file(tmp_path, lever)))
    words = [f.words for f in diagnose(problem)[1] if f.topic is Topic.ZERO]
    assert "right half-plane" in words[0]
    # 10 X2/F - 9 X1/F = 0 at s² = k/(9 m2), damping neglected: lowest at the heaviest m2, once
    hz = (2e8 / 9 / 70.0) ** 0.5 / 6.283185307
    reported = float(words[0].split("half-plane at ")[1].split()[0])
    assert reported == pytest.approx(hz, rel=5e-3)
    assert "m2=70" in words[0]
    assert sum("right half-plane" in text for text in words) == 1


def test_solve_reports_what_is_serious_unless_it_is_quiet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = case_file(tmp_path, THREE, before=HIDDEN)
    text = path.read_text().replace("S_max = 1.75", "S_max = 1.001")
    quick = "\n[sampling]\nlifted_points = 8\n[outer]\nmax_refinements = 0\nbox_points = 0\n"
    path.write_text(text + quick)
    words = [str(path), "--formulation", "lifted", "--workers", "1", "--out", str(tmp_path / "run")]
    assert solve(words) == 3
    assert "warning: plant: the mode at" in capsys.readouterr().err
    assert solve([*words, "--quiet"]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_an_undamped_mode_is_reported_by_its_frequency(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    undamped = GOOD.replace("'damping_ratio': 0.01", "'damping': DAMPING")
    path = case_file(tmp_path, undamped.replace("DAMPING", "ca.DM.zeros(2, 2)"))
    assert check([str(path)]) == 0  # the loop reaches it
    (tmp_path / "hidden").mkdir()
    hidden = undamped.replace("DAMPING", "ca.DM.zeros(2, 2)").replace("[[1, 0]]", "[[1, 1]]")
    assert check([str(case_file(tmp_path / "hidden", hidden))]) == 2
    hz = (2e8 * 2 / 67.56) ** 0.5 / 6.283185307
    assert f"the mode at {hz:.5g} Hz is not damped" in capsys.readouterr().err
    # one that reaches the flexible mode will do, however little
    (tmp_path / "some").mkdir()
    some = undamped.replace("DAMPING", "1e-3 * chain")
    assert check([str(case_file(tmp_path / "some", some))]) == 0


FLIPPING = (
    "    import numpy as np\n    M, K = np.diag([m1, m2]), 2e8 * np.array([[1.0, -1], [-1, 1]])\n"
    "    root = np.diag(np.diag(M) ** -0.5)\n"
    "    w, V = np.linalg.eigh(root @ K @ root)\n    V = root @ V * np.array([1.0, SIGN])\n"
)
MODAL = (
    "{'mass': np.eye(2), 'stiffness': np.diag(np.maximum(w, 0)), 'damping_ratio': 0.01,"
    " 'input': V.T[:, :1], 'output': V[:1], 'hardware_cost': m1 + m2}"
)


def test_eigenvectors_whose_sign_flips_are_an_error_by_name(tmp_path: Path) -> None:
    """Values are those of one plant everywhere; its derivatives are of none."""
    good = case_file(tmp_path, MODAL, before=FLIPPING.replace("SIGN", "1.0"))
    problem_of(load_case(good))
    (tmp_path / "flip").mkdir()
    sign = "np.sign(np.sin(1e6 * m1 + 0.3))"
    path = case_file(tmp_path / "flip", MODAL, before=FLIPPING.replace("SIGN", sign))
    with pytest.raises(CaseError) as caught:
        problem_of(load_case(path))
    words = str(caught.value)
    assert "the derivative of input to m1" in words or "the derivative of output to m1" in words
    assert "eigenvectors whose sign" in words


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("M_K = 2e7", "M_K = 20.0"), "times too small"),
        (("M_K = 2e7", "M_K = 2e13"), "times too large"),
        (("S_max = 1.75", "S_max = 6.0"), "was 6 dB meant? Then write 1.995"),
    ],
)
def test_what_looks_like_another_unit_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: tuple[str, str], words: str
) -> None:
    path = case_file(tmp_path, GOOD)
    assert check([str(path)]) == 0
    assert "unit" not in capsys.readouterr().out
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    assert check([str(path)]) == 0
    assert words in capsys.readouterr().out


def test_a_stiffness_in_newton_per_micrometre_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = case_file(tmp_path, GOOD.replace("2e8 * chain", "200.0 * chain"))
    assert check([str(path)]) == 0
    assert "is the stiffness in another unit?" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "factor", "words"),
    [
        ("    stiffness = ", 1.0, ""),
        ("    stiffness = ", 1e-3, "is the stiffness in another unit?"),  # N/mm
        ("    stiffness = ", 1e-6, "is the stiffness in another unit?"),  # N/um
        ('        "mass": ', 1e3, "and of mass and stiffness"),  # g
    ],
)
def test_a_new_stage_in_another_unit_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str, factor: float, words: str
) -> None:
    """What `ccd new` writes has none; its stiffness in N/mm or its masses in g have one."""
    assert ccd(["new", str(tmp_path / "stage")]) == 0
    plant = tmp_path / "stage" / "plant.py"
    assert plant.read_text().count(line) == 1
    plant.write_text(plant.read_text().replace(line, f"{line}{factor!r} * "))
    assert check([str(tmp_path / "stage" / "case.toml"), "--quiet"]) == 0
    found = [text for text in capsys.readouterr().out.splitlines() if text.startswith("warning")]
    assert bool(found) == bool(words)
    assert words in "".join(found)


GRAMS = GOOD.replace("vertcat(m1, m2)", "vertcat(1e3 * m1, 1e3 * m2)")


@pytest.mark.parametrize(
    ("result", "unit", "words"),
    [
        (GOOD, "kg", ""),
        (GOOD.replace("vertcat(m1, m2)", "vertcat(2.5 * m1, m2)"), "kg", ""),  # an idler
        (GOOD.replace("vertcat(m1, m2)", "vertcat(1e-3 * m1, 1e-3 * m2)"), "g", ""),
        (GOOD, "mm", ""),
        (GRAMS, "kg", "theta.m1 is in kg, and mass grows by 1000 with each, where 1 is meant"),
        (GOOD, "g", "theta.m1 is in g, and mass grows by 1 with each, where 0.001 is meant"),
        (GOOD.replace("2e8", "1e3 * m1"), "N/mm", ""),
        (GOOD.replace("2e8", "m1"), "N/mm", "and stiffness grows by 1 with each, where 1000 is"),
    ],
)
def test_a_matrix_in_the_unit_of_its_parameter_is_reported(
    tmp_path: Path, result: str, unit: str, words: str
) -> None:
    path = case_file(tmp_path, result)
    path.write_text(path.read_text().replace('unit = "kg"', f'unit = "{unit}"'))
    found = [f.words for f in diagnose(problem_of(load_case(path)))[1] if "theta." in f.words]
    assert bool(found) == bool(words)
    assert words in "".join(found)


def test_every_solve_of_an_own_plant_says_how_large_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = load_case(case_file(tmp_path, GOOD))
    show_findings(case, problem_of(case))
    line = capsys.readouterr().err.splitlines()[0].removeprefix("note: in SI, at the start: ")
    moved, *words = line.split(", ")
    assert moved == "the mass felt by an actuator is 135 kg if its input is in N"
    assert words[0].startswith("the first resonance is at ")
    assert words[1].startswith("M_K suits a bandwidth of ")


def test_constraints_are_shown_with_what_their_sign_means(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = "|{'constraints': {'light': m1 - 60, 'heavy': 50 - m1}}"
    assert check([str(case_file(tmp_path, GOOD + more))]) == 0
    out = capsys.readouterr().out
    assert "light: 7.56 at the start, NOT met" in out
    assert "heavy: -17.56 at the start, met (0 or less)" in out


def test_a_suspension_makes_no_zero(tmp_path: Path) -> None:
    """Force on one mass, sensor on the other: the free chain has no zero."""
    far = GOOD + "|{'output': ca.DM([[0, 1]])}"
    slow = case_file(tmp_path, far.replace("2e8", "60.0"))
    slow.write_text(slow.read_text().replace("M_K = 2e7", "M_K = 30.0"))
    found = [f for f in diagnose(problem_of(load_case(slow)))[1] if f.topic is Topic.ZERO]
    assert not [f for f in found if "right half-plane" in f.words]


@pytest.mark.parametrize("damping", [-1.0, -0.4, -0.02])
def test_the_proven_limit_is_poissons_integral(damping: float) -> None:
    """Half a period of weight on either side, by quadrature."""
    zero = Zero(7.0, damping, 1.0)
    limit, M = bandwidth_limit_hz(zero, 1.8), 1.8
    x, y = 7.0 * -damping, 7.0 * (1.0 - damping**2) ** 0.5

    def weight(w: float) -> float:
        return x / (x**2 + (w - y) ** 2) + x / (x**2 + (w + y) ** 2)

    near = quad(weight, 0.0, limit, limit=500, points=[min(y, limit)])[0]
    assert (np.pi - near) * np.log(M) == pytest.approx(0.5 * np.log(2.0) * near, rel=1e-5)


SECTIONS = '\n[controller]\nstructure = "sections"\nbiquads = 0\nweighted_level = 9.0\n'


def test_a_dip_names_M_K_only_where_the_case_states_one(tmp_path: Path) -> None:
    """Sections without weighted_level have no M_K; a loop far above the zero crosses the dip."""
    case = case_file(tmp_path, GOOD.replace("2e8", "2e7"))
    before = case.read_text()
    for level, named in (("weighted_level = 9.0\n", True), ("", False)):
        case.write_text(before + SECTIONS.replace("weighted_level = 9.0\n", level))
        (words,) = [
            f.words for f in diagnose(problem_of(load_case(case)))[1] if f.topic is Topic.ZERO
        ][:1]
        assert ("raise M_K" in words) is named
        assert "e+" not in words


@pytest.mark.parametrize(
    ("more", "loop", "words"),
    [
        ("|{'output': ca.DM([[-1, 0]])}", "", "moves the sensor to negative values"),
        ("|{'input': ca.DM([-1, 0])}", "", "moves the sensor to negative values"),
        ("|{'output': ca.DM([[-1, 0]]), 'stiffness': 2e8 * chain + 1e8 * ca.DM.eye(2)}", "",
         "moves the sensor to negative values"),
        ("", "rate_hz = 10000.0\ndelay_us = 1e-4", "were seconds meant? Then write 100"),
        ("", "rate_hz = 10000.0\ndelay_us = 20000.0", "delay_us is in microseconds"),
        ("", "rate_hz = 10.0", "rate_hz is in Hz"),
        ("|{'output': ca.DM([[-1, 0]]), 'input': ca.DM([-1, 0])}", "rate_hz = 10000.0", ""),
        ("", "rate_hz = 4000.0\ndelay_us = 100.0", ""),
    ],
)  # fmt: skip
def test_a_sign_a_delay_and_a_rate_that_are_wrong_are_reported(
    tmp_path: Path, more: str, loop: str, words: str
) -> None:
    path = case_file(tmp_path, GOOD + more)
    table = f"\n[loop]\n{loop}\n" if loop else ""
    path.write_text(path.read_text() + SECTIONS + table)
    found = [item.words for item in diagnose(problem_of(load_case(path)))[1]
             if item.topic is Topic.LOOP]  # fmt: skip
    assert len(found) == bool(words)
    assert words in " ".join(found)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("biquads = 2\n", ["least_damping is not given", "slowest_zero_hz is not given"]),
        ("biquads = 2\nleast_damping = 0.05\n", ["slowest_zero_hz is not given"]),
        ("biquads = 0\nslowest_zero_hz = 2.0\n", []),
    ],
)
def test_what_no_bound_of_sections_forbids_is_noted_before_a_search(
    tmp_path: Path, keys: str, words: list[str]
) -> None:
    path = case_file(tmp_path, GOOD)
    path.write_text(path.read_text() + SECTIONS.replace("biquads = 0\n", keys))
    found = [item for item in diagnose(problem_of(load_case(path)))[1]
             if item.topic is Topic.CONTROLLER]  # fmt: skip
    assert all(item.severity is Severity.NOTE for item in found)
    assert len(found) == len(words)
    assert all(part in item.words for part, item in zip(words, found, strict=True))


@pytest.mark.parametrize(
    ("uses", "reported"),
    [
        ("", True),
        ("|{'hardware_cost': t['foo']}", False),
        ("|{'constraints': {'c': t['foo'] - 2}}", False),
    ],
)
def test_a_parameter_that_changes_nothing_is_reported(
    tmp_path: Path, uses: str, reported: bool
) -> None:
    path = case_file(tmp_path, GOOD + uses)
    path.write_text(path.read_text() + "\n[theta.foo]\nlower = 1.0\nupper = 2.0\n")
    found = [item.words for item in diagnose(problem_of(load_case(path)))[1]
             if item.topic is Topic.UNUSED]  # fmt: skip
    assert len(found) == reported
    assert not reported or "theta.foo changes nothing" in found[0]


def test_what_varies_is_looked_at_to_its_ends() -> None:
    """Where it would be held at its start its resonances would be those of θ alone."""
    problem = problem_of(load_case(ROOT / "examples/gantry_stroke/case.toml"))
    facts = diagnose(problem)[0]
    (name, low, high), *_ = problem.controller.uncertainty.ranges
    varied = {point.theta[len(problem.names)] for point in facts}
    assert {low, high} <= varied, name
    assert facts[0].theta[: len(problem.names)] == problem.start


@pytest.mark.parametrize(("least", "warned"), [("1e9", True), ("0", False)])
def test_a_constraint_that_no_point_meets_is_warned_of(
    tmp_path: Path, least: str, warned: bool
) -> None:
    path = case_file(tmp_path, GOOD + f"|{{'constraints': {{'too light': {least} - t['m1']}}}}")
    found = [item.words for item in diagnose(problem_of(load_case(path)))[1]
             if "too light" in item.words]  # fmt: skip
    assert len(found) == warned
    assert not warned or "met at none of" in found[0]


def test_check_names_a_lower_velocity_that_shortens_a_move_that_heat_limits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As stated in the case, the move takes this long; where the force limits there is none."""
    path = case_file(tmp_path, GOOD)
    of = path.read_text()

    def found_with(velocity: float, power: float) -> dict:
        path.write_text(
            f"{of}[move]\ndistance = 0.1\nvelocity = {velocity!r}\njerk = 1e4\nsettle_band = 1e-6\n"
            "dwell = 0.1\n[motor]\nforce_constant = 50.0\nresistance = 2.0\npeak_current = 20.0\n"
            f"rms_power = {power}\n"
        )
        check([str(path), "--json"])
        return json.loads(capsys.readouterr().out)  # type: ignore[no-any-return]

    free = found_with(5.0, 20.0)
    better = free["slower_is_faster"]
    assert "heat" in free["move"]["limits"]
    assert better["duration"] < free["move"]["duration"]
    stated = found_with(better["velocity"], 20.0)["move"]
    assert stated["duration"] == pytest.approx(better["duration"], rel=1e-9)
    strong = found_with(5.0, 1e5)
    assert "peak force" in strong["move"]["limits"]
    assert strong["slower_is_faster"] is None


def test_check_shows_what_a_move_needs_at_the_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Force by the mass times the acceleration, current by the force constant, heat by resistance:
    masses of case study 1 at 1 m/s² with 50 N/A and 2 ohm."""
    path = case_file(tmp_path, GOOD)
    of = path.read_text()
    mass = sum(problem_of(load_case(path)).start)
    move = "[move]\ndistance = 0.1\nvelocity = 0.2\nacceleration = 1.0\njerk = 100.0\n"
    move += "settle_band = 1e-6\ndwell = 0.1\n"
    motor = "[motor]\nforce_constant = 50.0\nresistance = 2.0\npeak_current = 5.0\n"
    motor += "rms_power = 9.0\n"
    path.write_text(f"{of}{move}")
    check([str(path)])
    words = capsys.readouterr().out
    assert f"{mass:.3g} N peak" in words
    assert "current" not in words
    path.write_text(f"{of}{move}{motor}")
    check([str(path), "--json"])
    found = json.loads(capsys.readouterr().out)["move"]
    assert found["peak_force"] == pytest.approx(mass, rel=1e-6)
    assert found["rms_force"] < found["peak_force"]
    assert found["peak_current"] == pytest.approx(found["peak_force"] / 50.0)
    assert found["power"] == pytest.approx(2.0 * found["rms_current"] ** 2)
    check([str(path)])
    words = capsys.readouterr().out
    assert f"of 5 A allowed ({100.0 * found['peak_current'] / 5.0:.3g} %)" in words
    assert "of the 9 W allowed" in words
