"""Controllers for parts of a stroke: halving, handover, the code, and the command."""

import ctypes
import json
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from oracles.case_documents import QUICK_SECTIONS

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.extensions.schedule import main
from ccd_casadi.extensions.schedule.handover import (
    RateBound,
    RateTrial,
    controllers_of,
    handovers,
    part_at,
)
from ccd_casadi.extensions.schedule.schedule_files import Schedule, write_code
from ccd_casadi.extensions.schedule.segments import (
    Alone,
    DesignedPart,
    ScheduleOptions,
    Segment,
    halve,
    scheduled_name,
    share_of,
    within,
)
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.errors import UserError

SAMPLING = Sampling(2000.0, 100.0)
LAST = 'start = 59.0\nunit = "kg"\n'
VARYING = QUICK_SECTIONS.replace(f"{LAST}[objective]", f"{LAST}varies = true\n[objective]")


def segment(low: float, high: float, gain: float) -> Segment:
    """A part with an integrator and two lags; nothing of it is judged."""
    A, B = np.diag([0.0, -300.0 * gain, -900.0]), np.array([[1.0], [1.0], [gain]])
    K = StateSpace(A, B, np.array([[1e3 * gain, -2e4, 3e4 * gain]]), np.array([[gain * 1e2]]))
    design = SimpleNamespace(controller=K, bandwidth=100.0)
    proof = SimpleNamespace(refuted=False, proven=True)
    judgement = SimpleNamespace(passed=True)
    return Segment(low, high, cast(Any, None), cast(Any, design), cast(Any, judgement),
                   cast(Any, proof))  # fmt: skip


PARTS = [segment(0.0, 0.4, 1.0), segment(0.3, 0.7, 1.7), segment(0.6, 1.0, 2.5)]


def test_a_part_controls_until_its_range_ends() -> None:
    """Up and down, with the overlap between the two handovers."""
    now, seen = 0, []
    up = np.linspace(0.0, 1.0, 101)
    for p in [*up, *up[::-1]]:
        now = part_at(PARTS, now, float(p))
        assert PARTS[now].low <= p <= PARTS[now].high
        seen.append(now)
    handed = [float(up[i]) for i in range(1, 101) if seen[i] != seen[i - 1]]
    back = [float(up[::-1][i]) for i in range(1, 101) if seen[101 + i] != seen[100 + i]]
    assert handed == pytest.approx([0.4, 0.7], abs=0.011)
    assert back == pytest.approx([0.6, 0.3], abs=0.011)


def test_the_code_hands_over_as_the_simulation_does(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    bound, crossed = RateBound(0.0, 101, 0, None, (np.inf,) * 3), RateTrial(0.0, np.nan, np.nan)
    found = Schedule(
        "at", "m", tuple(PARTS), (Alone(0.5, 100.0),), 90.0, (), (), bound, crossed
    )  # fmt: skip
    write_code(tmp_path, found, SAMPLING)
    assert "NOT verified" in (tmp_path / "schedule.h").read_text()  # no rate was tried
    warnings = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off"]
    library = tmp_path / "schedule.so"
    subprocess.run([compiler, *warnings, "-shared", "-fPIC", "-o", library,
                    tmp_path / "schedule.c"], check=True)  # fmt: skip
    code = ctypes.CDLL(str(library))
    K = controllers_of(PARTS, SAMPLING)
    onwards = handovers(K)
    state = (ctypes.c_double * 8)()
    code.schedule_reset(state, ctypes.c_double(0.05))
    forces = (ctypes.c_double * 1)()
    now, z, changes = 0, np.zeros(len(K[0].A)), 0
    rng = np.random.default_rng(0)
    for p in 0.5 - 0.48 * np.cos(np.linspace(0.0, 4.0 * np.pi, 400)):
        e = rng.standard_normal(1) * 1e-3
        part = part_at(PARTS, now, float(p))
        if part != now:
            now, z, changes = part, onwards[now, part] @ z, changes + 1
        u = K[now].C @ z + K[now].D @ e
        z = K[now].A @ z + K[now].B @ e
        code.schedule_step(state, ctypes.c_double(p), (ctypes.c_double * 1)(*e), forces)
        assert forces[0] == pytest.approx(u[0], rel=1e-9)
    assert changes == 8


def test_a_constant_force_stays_at_a_handover() -> None:
    """The integrator holds a load: with e = 0 the next part's force is the last one."""
    K = controllers_of(PARTS, SAMPLING)
    onwards, z = handovers(K), np.zeros(len(K[0].A))
    for e in np.append(np.full(50, 1e-3), np.zeros(2000)):
        u, z = K[0].C @ z + K[0].D[:, 0] * e, K[0].A @ z + K[0].B[:, 0] * e
    z = onwards[0, 2] @ z
    for _ in range(2000):
        new, z = K[2].C @ z, K[2].A @ z
        assert new == pytest.approx(u, rel=1e-6)


def written(folder: Path, text: str = VARYING) -> Path:
    path = folder / "case.toml"
    path.write_text(text)
    return path


def test_a_part_is_the_case_with_a_shorter_range(tmp_path: Path) -> None:
    problem = problem_of(load_case(written(tmp_path)), at_a_sample=True)
    assert scheduled_name(problem, None) == "m2"
    part = within(problem, "m2", 58.5, 59.0)
    own = uncertain_plant(part, problem.start)
    place = own.names.index("theta.m2")
    assert own.box[:, place].tolist() == [58.5, 59.0]
    assert own.nominal[place] == pytest.approx(58.75)
    alone = within(problem, "m2", 58.5, 58.5)
    assert structured_of(alone).uncertainty.ranges == ()
    assert ("m2", 58.5) in [fixed[:2] for fixed in alone.source.fixed]


def test_what_cannot_be_scheduled_is_refused_by_name(tmp_path: Path) -> None:
    problem = problem_of(load_case(written(tmp_path)), at_a_sample=True)
    with pytest.raises(UserError, match="does not vary; known are m2"):
        scheduled_name(problem, "m1")
    fixed = problem_of(load_case(written(tmp_path, QUICK_SECTIONS)), at_a_sample=True)
    with pytest.raises(UserError, match="no parameter varies"):
        scheduled_name(fixed, None)


def test_halving_ends_where_every_part_has_its_share() -> None:
    """Of a bandwidth that falls with the width of a part, and differs along the range."""
    alone = [Alone(at, 100.0 - 30.0 * at) for at in np.linspace(0.0, 1.0, 9)]
    searched = []

    def search(low: float, high: float, warm: Any = None) -> DesignedPart:
        found = (100.0 - 30.0 * high) * (1.0 - 0.3 * (high - low))
        searched.append((low, high))
        assert warm is None or warm.bandwidth <= found
        return DesignedPart(low, high, cast(Any, None), cast(Any, SimpleNamespace(bandwidth=found)))

    parts = halve(search(0.0, 1.0), alone, search, options=ScheduleOptions(most=64))
    assert parts[0].low == 0.0
    assert parts[-1].high == 1.0
    assert min(share_of(part, alone) for part in parts) >= 0.9
    for one, other in pairwise(parts):
        assert one.low < other.low < one.high < other.high  # they overlap
    assert len(searched) == 2 * len(parts) - 1
    few = halve(search(0.0, 1.0), alone, search, options=ScheduleOptions(most=3))
    assert len(few) == 3


@pytest.mark.slow
def test_the_command_designs_parts_that_keep_every_bound(tmp_path: Path) -> None:
    out = tmp_path / "found"
    words = [str(written(tmp_path)), "--out", str(out), "--quiet", "--positions", "5"]
    assert main([*words, "--parts", "2", "--share", "1.0"]) == 0
    found = json.loads((out / "schedule.json").read_text())
    low, high = found["parts"]
    assert (low["low"], high["high"]) == (58.0, 60.0)
    assert high["low"] < low["high"]
    whole = found["bandwidth_hz_of_one_controller"]
    assert min(part["bandwidth_hz"] for part in found["parts"]) >= whole * (1.0 - 1e-6)
    assert found["positions_kept"] == 5
    assert found["allowed_rate"] > 0.0
    assert found["rate_bound"]["rate"] > 0.0
    assert found["rate_bound"]["simulated"]["left"] < 0.1
    assert (out / "report.html").exists()
    assert (out / "schedule.c").exists()
