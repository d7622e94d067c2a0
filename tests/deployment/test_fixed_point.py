"""Integers: what is judged is what they are, what rounding adds is bounded, C is the same bit by
bit."""

import json
import re
import shutil
import subprocess
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from oracles.integer_controller import IntegerController, driven
from scipy import signal

from ccd_casadi.analysis import MoveLimits
from ccd_casadi.deploy import main as deploy_main
from ccd_casadi.deployment.fixed_point import FixedRequest, Ranges, in_fixed
from ccd_casadi.deployment.integer_loop import rounding_bound
from ccd_casadi.deployment.realisation import Realisation, difference_equation, realise_blocks
from ccd_casadi.deployment.source_code import COMPILE, write_c
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.support.errors import UserError

HZ = 2.0 * np.pi
T = 1e-4
MOVES = MoveLimits(0.01, 1.0, 10.0, 1e3, 1e6)


def stage(seed: int) -> tuple[StateSpace, Realisation]:
    """Two masses behind hold and delay, and PID with a notch and a roll-off; each third loop has
    six times the gain and is unstable."""
    rng = np.random.default_rng(seed)
    mass, hz, share = rng.uniform(1.0, 50.0), rng.uniform(300.0, 900.0), rng.uniform(0.05, 0.4)
    modes = np.diag([0.0, (HZ * hz) ** 2])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-modes, -np.diag([0.0, 0.02 * HZ * hz])]])
    b = np.array([1.0, np.sqrt(share)]) / np.sqrt(mass)
    B, C = np.r_[np.zeros(2), b][:, None], np.r_[b, np.zeros(2)][None]
    G = zoh(StateSpace(A, B, C, np.zeros((1, 1))), T, T)
    wc = HZ * rng.uniform(20.0, 60.0)
    notch = [1.0, HZ * hz, (HZ * hz) ** 2]
    sections = [([1.0, wc / 10.0], [1.0, 0.0]), ([3.0, wc], [1.0 / 3.0, wc]),
                ([1.0, 0.02 * HZ * hz, notch[2]], notch),
                ([8.0 * wc], [1.0, 8.0 * wc])]  # fmt: skip
    gain = mass * wc**2 / 3.0 * (6.0 if seed % 3 == 2 else 1.0)
    K = StateSpace(*(np.zeros(s) for s in ((0, 0), (0, 1), (1, 0))), np.array([[gain]]), period=T)
    for section in sections:
        K = K.series(StateSpace(*signal.tf2ss(*signal.bilinear(*section, fs=1.0 / T)), period=T))
    return G, realise_blocks(K)


def ranges_in(G: StateSpace, r: Realisation, forces: np.ndarray) -> Ranges:
    """Of the loop in floats while forces disturb it; of an unstable one in its first tenth."""
    K, x, z = r.system, np.zeros(len(G.A)), np.zeros(len(r.system.A))
    seen = []
    for d in forces:
        e = -G.C @ x
        u = K.C @ z + K.D @ e
        seen.append(np.r_[z, e, u])
        x, z = G.A @ x + G.B @ (u + d), K.A @ z + K.B @ e
    if not closed_loop(G, K).S.stable:
        seen = seen[: len(seen) // 10]
    top, n = np.abs(seen).max(axis=0), len(z)
    return Ranges(top[:n], top[n : n + 1], top[n + 1 :])


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize("bits", [16, 32])
def test_verdict_simulation_and_code_agree(tmp_path: Path, bits: int) -> None:
    """20 controllers: where the judge says stable the integers stay within the bound of the loop
    that it judged (measured: 3 to 10 % of it); where not, they run to their limits."""
    verdicts = []
    for seed in range(20):
        G, floats = stage(seed)
        forces = 5.0 * np.random.default_rng(seed).standard_normal((500, 1))
        forces[:, 0] += np.where(np.arange(500) > 50, 10.0, 0.0)
        found = in_fixed(floats, ranges_in(G, floats, forces), FixedRequest(bits, MOVES))
        assert found.fixed is not None
        K, stable = found.system, closed_loop(G, found.system).S.stable
        bound = rounding_bound(G, K, found.fixed)
        verdicts.append(stable)
        assert stable == bool(np.isfinite(bound.largest))
        file = json.loads(json.dumps(asdict(found.fixed), default=np.ndarray.tolist))
        apart = IntegerController(file)
        y, heard = driven((G.A, G.B, G.C), apart, forces, found.fixed.forces)
        z = np.zeros(len(K.A))

        def exact(e: np.ndarray, K: StateSpace = K, z: np.ndarray = z) -> np.ndarray:
            u = K.C @ z + K.D @ e
            z[:] = K.A @ z + K.B @ e
            return u

        linear, _ = driven((G.A, G.B, G.C), exact, forces, np.ones(1))
        if stable:
            assert not apart.met
            off = float(np.abs(y - linear).max())
            assert 0.0 < off <= bound.largest
            assert off > 0.005 * bound.largest
        else:
            assert apart.met
        folder = tmp_path / str(seed)
        folder.mkdir()
        write_c(folder, found, title="x", delay=T, verified=stable)
        subprocess.run([*COMPILE.split(), "-Werror"], cwd=folder, check=True, capture_output=True)
        assert subprocess.run(["./controller_test"], cwd=folder, check=False).returncode == 0
        lines = "\n".join(str(int(e)) for e in heard.ravel())
        ran = subprocess.run(["./controller_test", "-"], cwd=folder, input=lines, text=True,
                             capture_output=True, check=True)  # fmt: skip
        words = [int(line) for line in ran.stdout.split()]
        again = IntegerController(file)
        assert words == [again(e * found.fixed.errors)[0] for e in heard]
        assert words == difference_equation(found, heard).ravel().tolist()
    assert 10 <= sum(verdicts) < 20


def test_a_slow_pole_keeps_its_distance_from_one() -> None:
    """1 - 3.3e-7 is not a word of 16 bits; -3.3e-7 is, to 2^-15."""
    slow = StateSpace(np.array([[1.0 - 3.3e-7]]), np.array([[1e-3]]), np.array([[1e6]]),
                      np.array([[1e6]]), period=T)  # fmt: skip
    ranges = Ranges(np.ones(1), np.array([1e-3]), np.array([1e6]))
    found = in_fixed(realise_blocks(slow), ranges, FixedRequest(16, MOVES))
    pole = float(found.system.A[0, 0])
    assert (1.0 - pole) / 3.3e-7 == pytest.approx(1.0, abs=2.0**-14)


def test_steps_of_the_electronics_are_counts_and_too_fine_ones_are_refused() -> None:
    G, floats = stage(0)
    ranges = ranges_in(G, floats, np.ones((100, 1)))
    with pytest.raises(UserError, match="--sensor-step 1e-15: words of 16 bits reach"):
        in_fixed(floats, ranges, FixedRequest(16, MOVES, sensor_step=1e-15))
    given = in_fixed(floats, ranges, FixedRequest(32, MOVES, sensor_step=1e-9, force_step=1e-3))
    assert given.fixed is not None
    assert given.fixed.errors.tolist() == [1e-9]
    assert given.fixed.forces.tolist() == [1e-3]
    response = HZ * np.array([1.0, 30.0, 300.0])
    np.testing.assert_allclose(given.system.response(response), floats.system.response(response),
                               rtol=1e-5)  # fmt: skip


def test_limits_hold_in_counts() -> None:
    """What is beyond the limit is cut to whole counts, and the same integers feed it back."""
    G, floats = stage(1)
    ranges = ranges_in(G, floats, 10.0 * np.ones((200, 1)))
    back = 1e-3 * np.ones((len(floats.system.A), 1))
    limited = Realisation(floats.system, floats.blocks, 3.0, back)
    found = in_fixed(limited, ranges, FixedRequest(16, MOVES))
    fixed = found.fixed
    assert fixed is not None
    assert found.saturation is not None
    assert 3.0 - fixed.forces[0] < found.saturation <= 3.0
    errors = np.full((50, 1), fixed.largest)
    held = difference_equation(found, errors)
    assert np.abs(held).max() * fixed.forces[0] == found.saturation
    clipped = Realisation(found.system, found.blocks, found.saturation, None, False,
                          fixed.only_clipped())  # fmt: skip
    X, Y = [0] * len(fixed.states), [0] * len(fixed.states)
    _, X, saturated = fixed.step(X, [fixed.largest], [0])
    assert clipped.fixed is not None
    _, Y, _ = clipped.fixed.step(Y, [fixed.largest], [0])
    assert saturated
    assert X != Y


def test_the_command_leaves_integers_and_their_verdict(
    two_mass_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copytree(two_mass_run, tmp_path / "run"))
    assert deploy_main([str(run), "--fixed", "32"]) == 0
    words = capsys.readouterr().out
    assert re.search(r"32 bits, saturating; a count of e \S+ m, of u \S+ N", words)
    assert "rounding to 32 bits moves y by" in words
    kept = json.loads((run / "deploy" / "controller.json").read_text())
    assert kept["precision"] == "fixed 32"
    assert not (run / "deploy" / "controller.st").exists()
    # the integers are the matrices beside them, which were judged
    fixed = kept["fixed"]
    first = fixed["to_forces"][0][-1]
    scale = fixed["forces"][0] / fixed["errors"][0] / 2.0 ** fixed["guard"]
    assert first["source"] == len(fixed["states"])
    number = first["value"] / 2.0 ** first["shift"] * scale
    assert number == pytest.approx(kept["D"][0][0], rel=1e-12)
    line = json.loads((run / "result.json").read_text())["verdict"]["deployable"]
    found = json.loads((run / "deploy" / "deploy.json").read_text())["rounding"]
    assert 0.0 < line["rounding"] == found["errors"][0] < 1e-6
    # integers that may spoil the move are not verified
    assert deploy_main([str(run), "--fixed", "16", "--window", "1e-9", "--quiet"]) == 4
    assert "NOT verified" in (run / "deploy" / "controller.h").read_text()
    line = json.loads((run / "result.json").read_text())["verdict"]["deployable"]
    assert line["state"] == "failed"
    assert "beyond its window, 1 nm" in " ".join([line["words"], *line.get("details", [])])
    assert deploy_main([str(run), "--fixed", "16", "--single", "--quiet"]) == 2
