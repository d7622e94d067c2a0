"""What a loop survives: ranges against dense evaluations of their own, whatever is drawn."""

from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles.helpers import few, problem

from ccd_casadi.analysis.loop_channels import sampled_figures
from ccd_casadi.codesign.final_judgement import OtherDamping, judge_survival
from ccd_casadi.codesign.outer_mixed import set_findings
from ccd_casadi.codesign.survival import (
    PEAK,
    LoopsOffModel,
    Survival,
    SurvivalOptions,
    excess_of,
    loops_off_model,
    reach,
    shift_range,
    survival,
)
from ccd_casadi.codesign.verdict import State, survives
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.modal import FREE, Perturbation, modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.robust import perturbed

SUSPENSION = FREE
CROSSOVER = 100.0  # rad/s


@dataclass(frozen=True)
class Drawn:
    """Σ b_i c_i/(s² + 2 ζ_i ω_i s + ω_i²) and a lead with a notch, as lists of factors."""

    omega: np.ndarray
    zeta: np.ndarray
    strength: np.ndarray
    given: bool
    gain: float
    top: list[np.ndarray]
    bottom: list[np.ndarray]

    def system(self) -> Mechanics:
        """The rigid body first; damping as a matrix or as one ratio."""
        n = 1 + len(self.omega)
        K = np.diag([0.0, *self.omega**2])
        D = np.diag([0.0, *(2.0 * self.zeta * self.omega)])
        B, C = np.ones((n, 1)), np.array([[1.0, *self.strength]])
        still = tuple(np.zeros((0, *M.shape)) for M in (K, K, K, B, C))
        if self.given:
            return Mechanics(np.eye(n), D, K, B, C, None, still)
        return Mechanics(np.eye(n), 0.0 * D, K, B, C, float(self.zeta[0]), still)

    def controller(self) -> StateSpace:
        """In series."""
        A, B, C, D = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[self.gain]])
        for top, bottom in zip(self.top, self.bottom, strict=True):
            n = len(bottom) - 1
            top = np.concatenate([np.zeros(n + 1 - len(top)), top])
            a = np.zeros((n, n))
            a[:-1, 1:], a[-1] = np.eye(n - 1), -bottom[:0:-1]
            b, d = np.eye(n)[:, -1:], top[0]
            c = (top[1:] - d * bottom[1:])[None, ::-1]
            A = np.block([[A, np.zeros((len(A), n))], [b @ C, a]])
            B, C, D = np.vstack([B, b @ D]), np.hstack([d * C, c]), d * D
        return StateSpace(A, B, C, D)

    def sensitivity(self, shift: np.ndarray, omega: np.ndarray) -> np.ndarray:
        """|S|, by the sums themselves."""
        s = 1j * omega
        w = 2.0 * np.pi * SUSPENSION.frequency_hz
        G = 1.0 / (s**2 + 2.0 * SUSPENSION.damping_ratio * w * s + w**2)
        for i in range(len(self.omega)):
            moved = self.omega[i] * (1.0 + shift)
            damping = 2.0 * (self.zeta[i] if self.given else self.zeta[0])
            damping = damping * (self.omega[i] if self.given else moved)
            G = G + self.strength[i] / (s**2 + damping * s + moved**2)
        K = self.gain
        for top, bottom in zip(self.top, self.bottom, strict=True):
            K = K * np.polyval(top, s) / np.polyval(bottom, s)
        return np.abs(1.0 / (1.0 + G * K))

    def dense(self, shifts: np.ndarray) -> np.ndarray:
        """Not above ‖S‖∞ at shifts: through every resonance in steps of a share of its width."""
        roots = [np.roots(p) for p in (*self.top, *self.bottom)]
        near = np.tan(np.linspace(-1.5, 1.5, 81))
        fixed = [np.geomspace(1.0, 1e4, 400)]
        fixed += [abs(r.imag) + abs(r.real) * near for r in np.concatenate(roots)]
        grid = np.concatenate(fixed)
        rows = [np.broadcast_to(grid[grid > 0.0], (len(shifts), (grid > 0.0).sum()))]
        for omega, zeta in zip(self.omega, self.zeta, strict=True):
            own = (omega * (1.0 + shifts))[:, None] * (1.0 + zeta * near)
            rows.append(np.maximum(own, 1e-3))
        return self.sensitivity(shifts[:, None], np.hstack(rows)).max(axis=1)


def drawn(seed: int) -> Drawn:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 3))
    omega = CROSSOVER * np.sort(rng.uniform(2.0, 12.0, count))
    zeta = 10.0 ** rng.uniform(-3.3, -1.7, count)
    meets = bool(rng.integers(2))  # a weak mode which shifts into a narrow resonance of K
    most = 2.0 * zeta * (omega / CROSSOVER) ** 1.5
    share = rng.uniform(-1.5, -0.5, count) if meets else rng.uniform(-1.5, 0.3, count)
    strength = rng.choice([-1.0, 1.0], count) * most * 10.0**share
    given = bool(rng.integers(2))
    if not given:
        zeta[:] = zeta[0]
    at = omega[0] * (1.0 + rng.choice([0.0, *rng.uniform(-0.2, 0.2, 2)]))
    narrow, wide = 10.0 ** rng.uniform(-3.0, -0.5, 2)
    if meets:
        at = omega[0] * (1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.02, 0.3))
        wide = 10.0 ** rng.uniform(-3.0, -2.0)
        narrow = wide * 10.0 ** rng.uniform(0.7, 1.5)
    slip = 1.0 if meets else 1.0 + rng.uniform(-0.02, 0.02)
    lead = 10.0 ** rng.uniform(0.3, 0.6)
    top = [np.array([1.0 / (CROSSOVER / lead), 1.0]),
           np.array([1.0 / at**2, 2.0 * narrow / at, 1.0])]  # fmt: skip
    bottom = [np.array([1.0 / (CROSSOVER * lead), 1.0]),
              np.array([1.0 / (slip * at) ** 2, 2.0 * wide / (slip * at), 1.0])]  # fmt: skip
    top, bottom = ([t / b[0] for t, b in zip(top, bottom, strict=True)],
                   [b / b[0] for b in bottom])  # fmt: skip
    gain = CROSSOVER**2 / lead * 10.0 ** rng.uniform(-0.5, 0.2)
    return Drawn(omega, zeta, strength, given, gain, top, bottom)


def loops_and_bound(
    case: Drawn, seed: int, sampling: Sampling | None = None
) -> tuple[LoopsOffModel, float]:
    loops = loops_off_model(case.system(), case.controller(), sampling, SUSPENSION)
    model = loops.at(Perturbation())
    assume(model.stable and model.peak < 5.0)
    return loops, model.peak * float(np.random.default_rng(seed + 1).choice([1.0, 1.001, 1.1, 1.5]))


def found_of(loops: LoopsOffModel, S_max: float) -> Survival:
    return survival(loops, S_max=S_max, bandwidth=CROSSOVER, omega_low=1.0)


@pytest.mark.slow
@given(seed=st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_no_range_hides_a_peak_or_an_instability(seed: int) -> None:
    """Dense in shift and frequency, by sums of its own; and what lies just beyond is lost."""
    case = drawn(seed)
    loops, S_max = loops_and_bound(case, seed)
    found = found_of(loops, S_max)
    low, high = found.S_max_shift
    roots = np.concatenate([np.roots(p) for p in (*case.top, *case.bottom)])
    meets = (np.abs(roots) / case.omega[:, None] - 1.0).ravel()[:, None]
    close = meets + np.linspace(-0.02, 0.02, 81)
    shrinking = 10.0 ** -np.arange(8.0)
    shifts = np.concatenate(
        [np.linspace(low, high, 200), low * shrinking, high * shrinking, close.ravel()]
    )
    shifts = np.unique(shifts[(shifts >= low) & (shifts <= high)])
    assert case.dense(shifts).max() <= S_max * (1.0 + PEAK) * (1.0 + 1e-8)

    def loop(shift: float) -> StateSpace:
        G = modal_plant(case.system(), SUSPENSION, Perturbation(shift))
        n, K = len(G.K), case.controller()
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-G.K, -G.D]])
        B, C = np.vstack([np.zeros_like(G.B), G.B]), np.hstack([G.C, np.zeros_like(G.C)])
        joint = np.block([[A - B @ K.D @ C, B @ K.C], [-K.B @ C, K.A]])
        out = np.hstack([-C, np.zeros((1, len(K.A)))])
        return StateSpace(joint, np.vstack([B @ K.D, K.B]), out, np.eye(1))

    for end in (low, high):
        if abs(end) < SurvivalOptions().reach:
            beyond = end + np.sign(end or 1.0) * max(3e-4 * abs(end), 3e-9)
            assert hinf_norm(loop(beyond))[0] > S_max * (1.0 + 0.5 * PEAK)
    for end, inner in zip(found.stable_shift, found.S_max_shift, strict=True):
        assert abs(inner) <= abs(end)
        places = np.append(np.linspace(0.0, end, 60), end)
        assert all(np.linalg.eigvals(loop(float(s)).A).real.max() < 0.0 for s in places)
        if abs(end) < SurvivalOptions().reach:
            beyond = end * (1.0 + 3e-4) + np.sign(end) * 3e-9
            assert np.linalg.eigvals(loop(float(beyond)).A).real.max() > -1e-6


@given(seed=st.integers(0, 10**6), loose=st.sampled_from([2e-4, 1e-2]))
@few(max_examples=2)
def test_a_range_ends_where_s_max_does_unless_the_set_is_held_by_less(
    seed: int, loose: float
) -> None:
    """A tolerance of the search adds to a range only what the set needs, and is stated then."""
    loops, S_max = loops_and_bound(drawn(seed), seed)
    exact, wide = (
        shift_range(loops, partial(excess_of, level=S_max * (1.0 + slack)))
        for slack in (PEAK, loose)
    )
    assume(wide[0] < exact[0] or exact[1] < wide[1])
    known = {"S_max": S_max, "bandwidth": CROSSOVER, "omega_low": 1.0, "slack": loose}
    for held in ((0.0, 0.0), exact, (2.0 * wide[0] - 0.1, 2.0 * wide[1] + 0.1)):
        found = survival(loops, held=held, **known)
        assert (found.S_max_shift, found.S_max_slack) == (exact, PEAK)
    found = survival(loops, held=wide, **known)
    assert (found.S_max_shift, found.S_max_slack) == (wide, loose)


@given(seed=st.integers(0, 10**6), delay=st.floats(0.0, 1.7))
@few(max_examples=2)
def test_sampled_loops_are_judged_as_deploy_does(seed: int, delay: float) -> None:
    """Hold and delay exact: the norm of `deployment`, which has level tests of its own."""
    case = drawn(seed)
    sampling = Sampling(rate_hz=2000.0, delay_us=delay * 500.0)
    loops, S_max = loops_and_bound(case, seed, sampling)
    found = found_of(loops, S_max)
    K = loops.run

    def judged(shift: float) -> tuple[bool, float]:
        modal = modal_plant(case.system(), SUSPENSION, Perturbation(shift))
        n, empty = len(modal.K), np.zeros_like(modal.B)
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-modal.K, -modal.D]])
        B, C = np.vstack([empty, modal.B]), np.hstack([modal.C, empty.T])
        G = StateSpace(A, B, C, np.zeros((1, 1)))
        figures = sampled_figures(closed_loop(zoh(G, sampling.period, sampling.delay), K).S)
        return figures.stable, figures.sensitivity_peak

    low, high = found.S_max_shift
    for shift in (low, high, *np.linspace(low, high, 7)):
        stable, peak = judged(float(shift))
        assert stable
        assert peak <= S_max * (1.0 + PEAK) * (1.0 + 1e-7)
    for end in (low, high):
        if abs(end) < SurvivalOptions().reach:
            stable, peak = judged(end + np.sign(end or 1.0) * max(3e-4 * abs(end), 3e-9))
            assert not stable or peak > S_max * (1.0 + 0.5 * PEAK)


@pytest.mark.slow
@given(
    seed=st.integers(0, 10**6),
    reach=st.floats(1e-3, 0.2),
    factors=st.sampled_from([(), (0.5, 2.0)]),
)  # fmt: skip
@settings(max_examples=20, deadline=None)
def test_neither_the_set_nor_the_range_denies_the_other(
    seed: int, reach: float, factors: tuple[float, ...]
) -> None:
    case = drawn(seed)
    loops, S_max = loops_and_bound(case, seed)
    whole = problem(robust=RobustSet(reach, 5, factors, 0.0))
    whole = replace(whole, inner=replace(whole.inner, S_max=S_max))
    design = SimpleNamespace(certified=True, bandwidth=CROSSOVER)
    found, check = judge_survival(whole, loops, design)
    assert check is not None
    within = found.within(-reach, reach)
    assert check.passed <= within
    if not factors:
        assert check.passed == within
    if check.passed:
        shifts = np.linspace(-reach, reach, 400)
        assert case.dense(shifts).max() <= S_max * (1.0 + 2.0 * PEAK)
    elif np.isfinite(check.peak):
        assert check.peak > S_max
    line = survives(found, S_max=S_max, **set_findings(check))
    assert (line.state is State.FAILED) == (not check.passed)
    assert ("the [robust] set is kept" in "; ".join(line.clauses)) == check.passed


@given(seed=st.integers(0, 10**6), shift=st.floats(-0.3, 0.3), factor=st.floats(0.2, 5.0))
def test_other_damping_is_that_of_the_plant_given_the_other_way(
    seed: int, shift: float, factor: float
) -> None:
    """One damping ratio, as a matrix and as a ratio: each one's other is the other's own."""
    case = drawn(seed)
    case = replace(case, zeta=np.full_like(case.zeta, case.zeta[0]))
    K, off = case.controller(), Perturbation(shift, factor)
    ways = [
        loops_off_model(replace(case, given=given).system(), K, None, SUSPENSION)
        for given in (True, False)
    ]
    for one, two in (ways, ways[::-1]):
        np.testing.assert_allclose(one.other.modal(off).D, two.modal(off).D, rtol=1e-9, atol=1e-9)
        own = modal_plant(replace(case, given=one.given).system(), SUSPENSION, off)
        np.testing.assert_allclose(one.modal(off).D, own.D, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one.modal(off).K, own.K, rtol=1e-12)


def test_what_the_other_damping_would_pass_is_reported() -> None:
    reported = OtherDamping("matrix", {"S_max": 1.0, "KS": 0.2}, {"S_max": 1.036, "KS": 0.5})
    assert "with the damping ratio kept instead of the matrix: S by 3.6 %" in reported.words
    assert "KS" not in reported.words
    assert reported.words in reported.entry["damping_words"]
    assert not OtherDamping("ratio", {"S_max": 1.0}, {"S_max": 1.009}).words
    assert "unstable" in OtherDamping("ratio", {"S_max": 1.0}, {}).words


@given(
    at=st.floats(0.01, 0.9), width=st.floats(1e-3, 0.2), height=st.floats(1e-4, 1.0),
    mark=st.floats(0.0, 1.0),
)  # fmt: skip
def test_a_walk_meets_every_bump_that_its_steps_resolve(
    at: float, width: float, height: float, mark: float
) -> None:
    def bump(x: float) -> float:
        return (1.0 + height) / (1.0 + ((x - at) / width) ** 2) - 1.0

    end = reach(bump, lambda x: 0.3 * np.hypot(x - at, width), 1.0, (mark,))
    true = at - width * np.sqrt(height)
    if true > 0.0:
        assert end == pytest.approx(true, rel=2e-3, abs=1e-8)
        assert bump(end) <= 0.0


@given(seed=st.integers(0, 10**6), held=st.booleans())
@few(max_examples=2)
def test_the_lines_of_robustness_end_where_the_verdict_ends(seed: int, held: bool) -> None:
    """One search, whatever places are drawn, and for K(z) as for the K(s) it is made of."""
    case = drawn(seed)
    sampling = Sampling(40.0 * CROSSOVER / np.pi, 20.0) if held else None
    loops, S_max = loops_and_bound(case, seed, sampling)
    found = found_of(loops, S_max)
    run = SimpleNamespace(
        problem=replace(
            problem(), inner=replace(problem().inner, S_max=S_max), suspension=SUSPENSION
        ),
        controller=loops.run,
        sampling=sampling,
        system=case.system(),
        modal=lambda *off: modal_plant(case.system(), SUSPENSION, *off),
    )
    good = perturbed.PerturbedLoop((0.0,), True, 1.0, 1.0, -1.0)
    with mock.patch.object(perturbed, "judge", return_value=good):
        line = perturbed.shift_line(run, SurvivalOptions().reach, 2)
        damped = perturbed.damping_line(run, *SurvivalOptions().factors, 2)
    assert line.stable == pytest.approx(found.stable_shift, rel=1e-3, abs=1e-6)
    assert line.within == pytest.approx(found.S_max_shift, rel=1e-3, abs=1e-6)
    assert damped.stable == pytest.approx(found.stable_damping, rel=1e-3)
