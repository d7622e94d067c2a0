"""Measured frequency responses: read, judged and designed on as the model they came from."""

from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
from oracles.fixed_structure_loops import BOUNDS, FAST, loop, plant
from oracles.measured_files import measured
from scipy.io import savemat

from ccd_casadi.extensions.measured.between_lines import bound_between_lines
from ccd_casadi.extensions.measured.line_problem import line_problem
from ccd_casadi.extensions.measured.measured_design import design_on_data
from ccd_casadi.extensions.measured.measured_loop import judge, winding
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.design import in_problem_units
from ccd_casadi.fixed_structure.local_search import LoopModel
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.measured import MeasuredResponse, from_control, read_frequency_response
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

PID = Structure(biquads=0)
KEPT = replace(BOUNDS, compliance_max=None)  # which no PID meets


@pytest.mark.parametrize("sampling", [None, FAST])
def test_the_judge_on_lines_agrees_with_the_one_on_the_model(sampling: Sampling | None) -> None:
    """Stability always; figures to what lies between lines, which the stated bound covers."""
    found = measured(sampling)
    period = None if sampling is None else sampling.period
    for seed in range(3):
        problem, kappa = loop(seed, PID, sampling)
        P = problem.plants
        K = PID.state_space(PID.in_units(kappa, P.omega_0, P.force))
        for factor in (1.0, 30.0):
            own = StateSpace(K.A, K.B, factor * K.C, factor * K.D)
            model = certify([plant()], own, BOUNDS, sampling).plants[0]
            lines = judge(found, own, BOUNDS, period=period)
            assert lines.sure, lines.words
            assert lines.stable == model.stable
            if not model.stable:
                assert lines.right_half_plane > 0
                continue
            assert max(lines.S_peak / model.S_peak, lines.KS / model.KS) <= 1.0 + 1e-6
            assert model.S_peak / lines.S_between <= 1.0 + 1e-6
            assert lines.bandwidth == pytest.approx(model.bandwidth, rel=1e-4)
            np.testing.assert_allclose(lines.GS, model.GS, rtol=1e-3)


@pytest.mark.slow
def test_the_design_on_lines_is_that_on_the_model() -> None:
    found = design_on_data(measured(FAST), PID, KEPT, period=FAST.period)
    assert found.usable, found.words
    assert found.figures is not None
    assert all(ratio <= 1.0 + 1e-5 for ratio in KEPT.shares(found.figures).values())
    model = synthesise_sections([plant()], PID, KEPT, sampling=FAST, starts=2)
    assert model.certified
    assert found.bandwidth == pytest.approx(model.bandwidth, rel=1e-2)


def test_rows_on_lines_have_their_derivatives() -> None:
    structure = Structure(biquads=1)
    modelled, kappa = loop(3, structure)
    kappa = structure.in_units(kappa, modelled.plants.omega_0, modelled.plants.force)
    problem = line_problem([measured(None, 60)], structure, BOUNDS)
    kappa = in_problem_units(problem, kappa)
    model = LoopModel(problem)
    tau = float(np.log(2.0 * HZ * 1.013 / problem.plants.omega_0))
    x = np.append(kappa, tau)
    point = model.at(x)
    assert point is not None
    rows = model.rows(point, 1.0)
    rng = np.random.default_rng(0)
    way, h = rng.normal(size=len(x)), 1e-6
    ends = [model.at(x + s * h * way) for s in (1.0, -1.0)]
    assert ends[0] is not None
    assert ends[1] is not None
    values = [end.data.peaks.value for end in ends if end and end.data.peaks is not None]
    assert len(values[0]) == len(values[1]) == len(rows.value)
    difference = (values[0] - values[1]) / (2.0 * h)
    slope = rows.slopes @ way
    np.testing.assert_allclose(slope, difference, atol=1e-6)


def test_a_resonance_narrower_than_the_lines_is_not_sure() -> None:
    """It may encircle -1 between two lines; what the lines show of it is that the phase falls."""
    whole = measured(None)
    problem, kappa = loop(0, PID)
    K = PID.state_space(PID.in_units(kappa, problem.plants.omega_0, problem.plants.force))
    L = whole.G * K.response(HZ * whole.hz)[:, 0, 0]
    i = int(np.flatnonzero(np.abs(L) > 0.3)[-1])
    ends, omega = HZ * whole.hz[i : i + 2], HZ * whole.hz
    at, half = float(ends.mean()), 0.5 * float(np.ptp(ends))
    for width, sure in ((0.2, False), (20.0, True)):  # of the resonance, in half steps
        zeta = width * half / at
        mode = 6.0 * abs(whole.G[i]) * at * half / (at**2 - omega**2 + 2j * zeta * at * omega)
        found = judge(MeasuredResponse(whole.hz, whole.G + mode), K, BOUNDS)
        assert ("narrower than the lines" not in found.words) == sure, found.words
        assert sure or not found.sure


@pytest.mark.parametrize(("share", "doubted"), [(2e-4, False), (5e-3, True)])
def test_noise_between_lines_finer_than_a_resonance_is_no_doubt(
    share: float, doubted: bool
) -> None:
    """A line turned by noise near a zero; `share`: what lines are apart, of the frequency."""
    hz = 1000.0 * (1.0 + share * np.arange(60))
    L = np.full((60, 1, 1), 0.1 - 0.02j)
    L[30] *= -1.0 + 0.01j  # falls by more than 90 degrees on one side, whichever
    doubts = winding(MeasuredResponse(hz, L[:, 0, 0], poles_at_zero=0), L)[1]
    assert any("narrower than the lines" in words for words in doubts) == doubted


def test_what_the_data_do_not_show_is_said() -> None:
    whole = measured(None)
    problem, kappa = loop(0, PID)
    P = problem.plants
    K = PID.state_space(PID.in_units(kappa, P.omega_0, P.force))
    assert judge(whole, K, BOUNDS).sure
    cut = MeasuredResponse(whole.hz[whole.hz < 20.0], whole.G[whole.hz < 20.0])
    assert "not small" in judge(cut, K, BOUNDS).words
    high = MeasuredResponse(whole.hz[whole.hz > 40.0], whole.G[whole.hz > 40.0])
    assert not judge(high, K, BOUNDS).sure
    # An unstable pole that is told moves the count by as many.
    assert judge(replace(whole, unstable_poles=2), K, BOUNDS).right_half_plane == 2


def test_files_of_every_kind_hold_the_same_response(tmp_path: Path) -> None:
    found = measured(None, 20)
    hz, G = found.hz, found.G
    angle = np.angle(G)
    tables = {
        "f_hz,re,im": (hz, G.real, G.imag),
        "f_hz, magnitude, phase_deg": (hz, np.abs(G), np.rad2deg(angle)),
        "# a comment\nf_hz,magnitude_db,phase_rad": (hz, 20.0 * np.log10(np.abs(G)), angle),
    }
    read = []
    for number, (head, columns) in enumerate(tables.items()):
        path = tmp_path / f"{number}.csv"
        rows = [",".join(repr(float(v)) for v in row) for row in zip(*columns, strict=True)]
        path.write_text("\n".join([head, *rows]) + "\n")
        read.append(read_frequency_response(path))
    savemat(tmp_path / "G.mat", {"f_hz": hz, "G": G})
    read.append(read_frequency_response(tmp_path / "G.mat"))
    np.savez(tmp_path / "G.npz", frequency_hz=hz, response=G)
    read.append(read_frequency_response(tmp_path / "G.npz"))
    read.append(from_control(control.FRD(G, HZ * hz)))
    for one in read:
        np.testing.assert_allclose(one.hz, hz, rtol=1e-12)
        np.testing.assert_allclose(one.G, G, rtol=1e-10)


def two_by_two(gain: float) -> MeasuredResponse:
    """Two coupled channels with a lag and a mode each, at 1 kHz behind a hold."""
    hz = np.geomspace(0.5, 490.0, 130)
    s = HZ * 1j * hz
    turn = np.array([[1.0, 0.2], [-0.15, 0.9]])
    modes = [gain * k * w**2 / (s**2 + 0.8 * w * s + w**2) for k, w in ((1.0, 300.0), (0.8, 420.0))]
    held = -np.expm1(-1e-3 * s) / (1e-3 * s)
    G = held[:, None, None] * (turn @ (np.stack(modes, -1)[:, :, None] * np.linalg.inv(turn)))
    return MeasuredResponse(hz, G)


def test_two_channels_are_designed_on_two_responses_and_judged_apart(tmp_path: Path) -> None:
    """Every bound on every line by NumPy alone, and the winding of det(I + GK)."""
    plants, period = [two_by_two(1.0), two_by_two(1.25)], 1e-3
    np.savez(tmp_path / "G.npz", f_hz=plants[0].hz, G=plants[0].G)
    np.testing.assert_array_equal(read_frequency_response(tmp_path / "G.npz").G, plants[0].G)
    bounds = replace(KEPT, S_max=1.7, S_low=0.9, omega_low=HZ, weights=None, weighted_level=None)
    structure = Structure(lead=0, biquads=0, roll_off=1)
    found = design_on_data(plants, structure, bounds, period=period, starts=2)
    assert found.usable, found.words
    assert found.controller is not None
    K = found.controller
    for one in plants:
        s = 2j / period * np.tan(np.pi * one.hz * period)
        k = K.C @ np.linalg.solve(s[:, None, None] * np.eye(len(K.A)) - K.A, K.B + 0j) + K.D
        back = np.eye(2) + one.G @ k
        S = np.linalg.norm(np.linalg.inv(back), 2, axis=(1, 2))
        assert S.max() <= 1.7 * (1.0 + 1e-5)
        assert S[HZ * one.hz <= found.bandwidth].max() <= np.sqrt(0.5) * (1.0 + 1e-4)
        F = np.linalg.det(back)  # two integrators: from -180 deg to 0, an unstable loop to -360
        grown = np.angle(F[1:] / F[:-1]).sum()
        assert -np.pi + np.angle(-F[0]) + grown == pytest.approx(np.angle(F[-1]))
    other = MeasuredResponse(plants[0].hz, plants[0].G[:, :1, :1])
    with pytest.raises(UserError, match="different numbers of channels"):
        design_on_data([plants[0], other], structure, bounds, period=period)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("f_hz,re\n1,2\n2,3\n3,4\n4,5\n5,6\n", "needs re and im"),
        ("re,im\n1,2\n", "no column f_hz"),
        ("f_hz,re,im\n1,2,x\n", "not a table of numbers.*'x' in line 2"),
        ("f_hz,re,im\n1,2,3\n2,3,4\n", "five lines"),
        ("f_hz,re,im\n" + "1,2,3\n" * 6, "line 3 repeats 1 Hz"),
        ("", "is empty"),
    ],
)
def test_mistakes_in_files(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "G.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=words):
        read_frequency_response(path)
    with pytest.raises(UserError, match="cannot be read"):
        read_frequency_response(tmp_path / "none.csv")


def test_what_repeated_measurements_leave_open_is_in_the_bound_on_S(tmp_path) -> None:
    """Every response within the spread of the mean stays below |S| that the judge states."""
    rng = np.random.default_rng(4)
    hz = np.geomspace(1.0, 400.0, 300)
    s = 1j * HZ * hz
    G = (1.0 / (s + 5.0))[:, None, None] * np.array([[1.0, 0.1], [0.0, 0.8]])
    spread = 0.05 * np.abs(G)
    K = StateSpace(
        -60.0 * HZ * np.eye(2), 60.0 * HZ * np.eye(2), 100.0 * np.eye(2), np.zeros((2, 2))
    )
    bounds = Bounds(S_max=10.0, S_low=2.0, omega_low=HZ)
    plain, wide = (
        judge(MeasuredResponse(hz, G, spread=one), K, bounds, integrator=False)
        for one in (None, spread)
    )
    assert plain.stable
    assert plain.S_peak < wide.S_peak
    assert plain.S_between < wide.S_between < np.inf
    for _ in range(50):
        moved = G + spread * np.exp(2j * np.pi * rng.random(G.shape))
        S = np.linalg.inv(np.eye(2) + moved @ K.response(HZ * hz))
        assert np.linalg.norm(S, 2, axis=(1, 2)).max() <= wide.S_peak
    np.savez(tmp_path / "two.npz", f_hz=hz, G=G, spread=spread)
    assert np.array_equal(read_frequency_response(tmp_path / "two.npz").spread, spread)
    with pytest.raises(UserError, match="spread"):
        MeasuredResponse(hz, G, spread=spread[:5])


@pytest.mark.parametrize("channels", [1, 2])
def test_a_line_that_the_controller_blocks_is_no_error_of_the_bound(channels: int) -> None:
    """L has no inverse there: by L alone the bound is the larger, and the same elsewhere."""
    hz = np.geomspace(1.0, 100.0, 40)
    s = 1j * hz[:, None, None]
    G = np.eye(channels) / s**2 + 0.1 * np.ones((channels, channels)) / (s + 30.0)
    lines = MeasuredResponse(hz, G if channels > 1 else G[:, 0, 0])
    K = np.broadcast_to(20.0 * np.eye(channels) + 0j, G.shape)
    blocking = K.copy()
    blocking[20, 0] = 0.0
    whole, blocked = (bound_between_lines(lines, G @ each, each) for each in (K, blocking))
    far = np.abs(np.arange(39) - 19.5) > 3.0  # second differences reach two lines further
    np.testing.assert_allclose(blocked[far], whole[far], rtol=1e-9)
    S = np.linalg.norm(np.linalg.inv(np.eye(channels) + G @ blocking), 2, axis=(1, 2))
    assert (blocked >= (1.0 - 1e-9) * np.maximum(S[1:], S[:-1])).all()


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [((3, 1, slice(None)), 0.0, "is 0 at 4 Hz in output 2, whatever the input"),
     ((3, slice(None), 0), 0.0, "is 0 at 4 Hz in every output of input 1"),
     ((3,), 0.0, "is 0 at 4 Hz; "),
     ((3, 1, 0), np.nan, "is not finite at 4 Hz, output 2, input 1")],
)  # fmt: skip
def test_a_dead_line_is_refused_by_its_frequency_and_channel(
    where: tuple, value: float, said: str
) -> None:
    """An entry that is 0 is none: channels may be apart."""
    G = np.full((8, 2, 2), 1.0 + 1.0j) + np.eye(2)
    G[5, 0, 1] = 0.0
    MeasuredResponse(np.arange(1.0, 9.0), G)
    G[where] = value
    with pytest.raises(UserError, match=said):
        MeasuredResponse(np.arange(1.0, 9.0), G)
