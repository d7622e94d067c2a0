"""Verdict, margins and units of a drive's design: by the rule of solve, against loops in numpy."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.case import parse_case, read_toml
from ccd_casadi.codesign.survival import Survival
from ccd_casadi.extensions.drives import sheet
from ccd_casadi.extensions.drives.cascade_search import Candidate
from ccd_casadi.extensions.drives.drive_case import DriveProblem, drive_problem
from ccd_casadi.extensions.drives.drive_design import DriveDesign, judge
from ccd_casadi.extensions.drives.sheet import sheet_rows, verdict_entry
from ccd_casadi.fixed_structure.box_proof import Proof, ProofOutcome
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.norms import BetweenSamples
from ccd_casadi.reporting.decision import Build, decide
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from tests.drives.bench import SLOW

EXAMPLES = Path(__file__).parents[2] / "examples"
BENCH, FEED = EXAMPLES / "drive_bench/case.toml", EXAMPLES / "feed_drive/case.toml"


@cache
def bench(S_max: float = 2.5) -> DriveProblem:
    data = read_toml(BENCH)
    data["drive"] |= {"name": "generic", "filters": 1, "setpoint_filters": 1, "filters_above": 1.0}
    data["inner"] |= {"S_max": S_max, "S_low": 0.3, "omega_low_hz": 2.0}
    return drive_problem(parse_case(data, BENCH))


def made(drive: DriveProblem, values: Array = SLOW, slower: int = 1) -> DriveDesign:
    """A design of these values, searched and not proven."""
    own, points = replace(drive.cascade, slower=slower), drive.uncertain.corners()
    judged = judge(own, values, drive.uncertain, drive.bounds, drive.sampling, points)
    proof = Proof(ProofOutcome.VARIES, 1e-3, drive.uncertain.names)
    between = BetweenSamples(2.0, 2.0, 1.0, 0.5) if slower == 1 else None
    return DriveDesign(own, values, 40.0 * HZ, Candidate(values, 40.0 * HZ, 0.0), judged, proof,
                       Excess(*points[0], -0.01), between=between)  # fmt: skip


SURVIVAL = sheet._survival


@cache
def ranges() -> Survival:
    """Of the one loop of these tests, off its set."""
    return SURVIVAL(bench(), made(bench()))


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sheet, "_survival", lambda *_: ranges())


def stable(drive: DriveProblem, gain: float = 1.0, late: float = 0.0) -> bool:
    """Whether every corner's loop is, by its poles, with the force times `gain`, `late` by s."""
    K, rate = drive.cascade.state_space(SLOW), drive.sampling
    delayed = Sampling(rate.rate_hz, rate.delay_us + 1e6 * late)
    for plant in drive.uncertain.as_written(drive.uncertain.corners()):
        G = zoh(plant, delayed.period, delayed.delay)
        A = np.block([[G.A - gain * G.B @ K.D @ G.C, gain * G.B @ K.C], [-K.B @ G.C, K.A]])
        if not np.abs(np.linalg.eigvals(A)).max() < 1.0:
            return False
    return True


def test_a_margin_is_what_takes_a_corner_to_the_limit_of_stability() -> None:
    drive = bench()
    rows = {row["place"]: row for row in verdict_entry(drive, made(drive))["margins"]}
    own = rows["actuator"]
    assert list(rows) == ["load", "motor", "actuator"]
    assert stable(drive, 0.999 * own["gain_up"])
    assert not stable(drive, 1.001 * own["gain_up"])
    assert stable(drive, late=0.999e-6 * own["delay_margin_us"])
    assert not stable(drive, late=1.001e-6 * own["delay_margin_us"])


def test_margins_at_the_sensors_are_those_of_a_loop_in_numpy() -> None:
    """L_i = G_i K_i/(1 + G_j K_j) on a dense grid: its least phase and its least distance to -1."""
    drive, omega = bench(), HZ * np.geomspace(0.5, 3999.0, 40_000)
    rows = verdict_entry(drive, made(drive))["margins"]
    K = drive.cascade.responses(SLOW, np.exp(1j * omega / 8000.0))[0]
    phase, distance = np.full(2, np.inf), np.full(2, np.inf)
    for plant in drive.uncertain.as_written(drive.uncertain.corners()):
        L = zoh(plant, 1.0 / 8000.0, 375e-6).sweep(omega)[:, :, 0].T * K
        for i in range(2):
            opened = L[i] / (1.0 + L[1 - i])
            at = np.flatnonzero(np.diff(np.abs(opened) > 1.0))
            phase[i] = min(phase[i], np.abs(np.angle(-opened[at], deg=True)).min())
            distance[i] = min(distance[i], np.abs(1.0 + opened).min())
    for row, i in zip(rows, (1, 0), strict=False):
        assert row["phase_margin_deg"] == pytest.approx(phase[i], rel=1e-2)
        assert row["modulus_margin"] == pytest.approx(distance[i], rel=1e-3)


@pytest.mark.parametrize(
    ("outcome", "status", "state", "build"),
    [
        (ProofOutcome.PROVEN, "verified", "passed", Build.YES),
        (ProofOutcome.VARIES, "verified", "unknown", Build.IF_ACCEPTED),
        (ProofOutcome.OPEN, "verified", "warned", Build.IF_ACCEPTED),
        (ProofOutcome.REFUTED, "not_verified", "failed", Build.NO),
    ],
)
def test_what_is_searched_and_not_proven_is_verified_with_a_line_that_names_it(
    outcome: ProofOutcome, status: str, state: str, build: Build
) -> None:
    """As `ccd solve` has it."""
    drive = bench()
    proof = Proof(outcome, 1e-3, drive.uncertain.names, {}, 1, 0, (0.0,), ("S_MAX", 1.1))
    found = verdict_entry(drive, replace(made(drive), proof=proof))
    assert found["status"] == status
    assert found["verdict"]["survives"]["state"] == state
    assert decide({**found, "loop_warnings": []}).build is build  # of S near ω_b, of this loop
    assert bool(found["reason"]) == (status != "verified")


def test_two_rates_are_searched_and_what_is_not_judged_warns() -> None:
    drive = bench()
    design = replace(made(drive, slower=4), proof=Proof(ProofOutcome.AS_RUN, 0.0, ()))
    found = verdict_entry(drive, design)
    assert found["status"] == "verified"
    assert found["verdict"]["survives"]["set"] == "searched"
    assert "searched, not proven" in decide(found).words
    assert found["verdict"]["deployable"]["state"] == "warned"


@pytest.mark.parametrize("which", ["filters", "bounds"])
def test_a_design_that_exceeds_a_bound_is_not_verified(which: str) -> None:
    drive = bench(1.2 if which == "bounds" else 2.5)
    design = made(drive)
    if which == "filters":
        design = replace(design, cascade=replace(design.cascade, filter_gain=1.0))
    found = verdict_entry(drive, design)
    assert found["status"] == "not_verified"
    assert found["verdict"]["certified"]["state"] == "failed"
    assert decide(found).build is Build.NO


def test_behind_a_screw_a_gain_is_in_the_unit_of_the_rotary_motor() -> None:
    """The same torque of the same turning: T = F lead/2π, v = ω lead/2π."""
    data = read_toml(FEED)
    assert data["drive"]["lead_mm"] == "lead"
    named = drive_problem(parse_case(data, FEED)).cascade
    data["drive"]["lead_mm"] = 16.0
    given = drive_problem(parse_case(data, FEED)).cascade
    del data["drive"]["lead_mm"]
    linear = drive_problem(parse_case(data, FEED)).cascade
    assert named == given
    assert [own.unit for own in named.settings[:3]] == ["1000/min", "N m s/rad", "ms"]
    assert linear.settings[1].unit == "N s/m"
    assert linear.drive.travel is None
    assert named.drive.travel == pytest.approx(16e-3 / (2.0 * np.pi))
    travel, omega = 16e-3 / (2.0 * np.pi), 7.0
    Kp = named.settings[1].round_value(4e5)  # N s/m
    torque = Kp * omega * travel * travel
    typed = round(Kp * named.settings[1].per_si, 6)  # as it is in the drive
    assert typed * omega == pytest.approx(torque)
    assert typed == pytest.approx(round(1e3 * 4e5 * travel**2) / 1e3)
    mass = named.drive.force_feedforward
    assert mass is not None
    assert mass.unit == "kg m²"
    assert 1540.0 * mass.per_si == pytest.approx(1540.0 * travel**2)


def test_what_is_no_screw_is_named() -> None:
    data = read_toml(FEED)
    for lead, words in (("pitch", "name of a .theta. in mm"), ("at", "in mm"), (-1.0, "above 0")):
        data["drive"]["lead_mm"] = lead
        with pytest.raises(UserError, match=words):
            drive_problem(parse_case(data, FEED))


def test_todays_value_is_beside_the_new_one_in_the_drives_unit() -> None:
    data = read_toml(FEED)
    drive = drive_problem(parse_case(data, FEED))
    values = np.exp(np.mean(np.log(drive.cascade.ranges), axis=0))
    design = made(bench())
    design = replace(design, cascade=drive.cascade, values=values)
    row = sheet_rows(design, {"p1460": 2.5})[1]
    assert (row["number"], row["unit"], row["today"]) == ("p1460", "N m s/rad", 2.5)


def test_a_coil_designs_the_current_loop_that_the_plant_has() -> None:
    """Against the PI of the sheet on R and L, sampled at its rate with one period to compute."""
    R, L, rate = 0.8, 4e-3, 16e3
    data = read_toml(BENCH)
    data["drive"]["coil"] = [R, L, rate]
    drive = drive_problem(parse_case(data, BENCH))
    (gain, Kp), (time, Tn) = drive.cascade.current
    assert (gain.number, gain.unit, time.number, time.unit) == ("p1715", "V/A", "p1717", "ms")
    assert Tn == pytest.approx(L / R, rel=1e-3)
    omega = HZ * np.array([50.0, 100.0, 200.0, 400.0])
    T = 1.0 / rate
    z, s = np.exp(1j * omega * T), 1j * omega
    a = np.exp(-R / L * T)
    held = (1.0 - a) / R / (z - a) / z * Kp * (1.0 + T / Tn / (1.0 - 1.0 / z))
    closed = held / (1.0 + held)
    plain = drive_problem(parse_case(read_toml(BENCH), BENCH))
    both = [own.uncertain.plant(own.uncertain.nominal).plant_si().at(s)[:, 0, 0]
            for own in (drive, plain)]  # fmt: skip
    np.testing.assert_allclose(both[0] / both[1], closed, atol=0.02)  # 0.016 at 400 Hz


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"drive": {"coil": [0.8, 4e-3, 16e3]}, "actuator": {"lag_hz": 900.0}}, "one of both"),
        ({"drive": {"coil": [0.8, 4e-3, 16e3], "name": "synapticon", "filters": 1,
                    "setpoint_filters": 0}}, "no parameters of a current controller"),
        ({"drive": {"coil": [0.8, 4e-9, 16e3]}}, "which the drive has not"),
    ],
)  # fmt: skip
def test_a_coil_that_does_not_go_with_the_drive_is_named(
    tables: dict[str, dict[str, object]], words: str
) -> None:
    data = read_toml(BENCH)
    for name, table in tables.items():
        data[name] = {**data.get(name, {}), **table}
    with pytest.raises(UserError, match=words):
        drive_problem(parse_case(data, BENCH))
