"""A design that no smooth surrogate foresees (ω_b jumps there) is learnt, and told as such."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccd_casadi.codesign import outer_search as search
from ccd_casadi.codesign.gaussian_processes import with_sample
from ccd_casadi.codesign.outer import Outer, PolishedDesign
from ccd_casadi.codesign.outer_problem import FormulationResult
from ccd_casadi.codesign.result import predicted_value
from ccd_casadi.optim.kkt import KktCertificate
from ccd_casadi.sampling.inner_samples import SynthesisCounts
from surrogates import fit


@given(place=st.floats(0.05, 0.95), jump=st.floats(0.01, 1.0), sloped=st.booleans())
@settings(max_examples=6, deadline=None)
def test_a_value_beyond_a_jump_is_learnt(place: float, jump: float, sloped: bool) -> None:
    X = np.linspace(0.0, 1.0, 6)[:, None]
    before = fit(X, X[:, 0], np.ones_like(X) if sloped else None, lower=[0.0], upper=[1.0])
    x, slope = np.array([place]), np.array([1.0])
    after = with_sample(before, x, place + jump, slope)
    missed = [abs(float(p.predict(x[None, :])[0]) - place - jump) for p in (before, after)]
    assert missed[1] <= missed[0]
    if np.abs(X[:, 0] - place).min() > 0.01:
        assert missed[1] < 1e-3 * jump
        assert len(after.X) == 7
    if sloped:  # one without a slope cannot join those that have one
        assert with_sample(before, x, place + jump, np.array([np.nan])) is before


@pytest.mark.parametrize("sloped", [False, True])
def test_a_better_value_takes_the_place_of_one_at_the_same_theta(sloped: bool) -> None:
    """An inner search may miss what the polish finds at its very θ: the better one is the truth."""
    X = np.linspace(0.0, 1.0, 6)[:, None]
    before = fit(X, X[:, 0], np.ones_like(X) if sloped else None, lower=[0.0], upper=[1.0])
    after = with_sample(before, X[2] + 1e-12, 0.6, np.array([1.0]))
    assert float(after.predict(X[2:3])[0]) == pytest.approx(0.6, rel=1e-6)
    assert len(after.X) == 6


@pytest.mark.parametrize("rounds", [1, 0])
def test_what_is_missed_at_the_end_is_learnt(monkeypatch: pytest.MonkeyPatch, rounds: int) -> None:
    """Whatever the rounds had left, and where no global check has moved the design; not where the
    case allows none."""
    X = np.linspace(0.0, 1.0, 6)[:, None]
    process = fit(X, 1.0 + X[:, 0], lower=[0.0], upper=[1.0])
    kkt = KktCertificate(0.0, 0.0, 0.0, {}, (), None, ())
    end = PolishedDesign(np.array([0.5]), 2.5, -1.0, kkt, 0.0)
    spent = (SimpleNamespace(),) * (rounds + 1)
    outcome = FormulationResult(end.x, spent, (process,), None, False, "")  # type: ignore[arg-type]
    outer = SimpleNamespace(
        sampler=SimpleNamespace(spent=SynthesisCounts()), kkt_level=1e-4, retries_pay=False,
        training_samples=lambda end, inputs: (np.array([end.value]), np.full((1, 1), np.nan)),
        with_training_sample=lambda outcome, end: Outer.with_training_sample(outer, outcome, end),
    )  # fmt: skip
    monkeypatch.setattr(search, "global_check", lambda *_: SimpleNamespace(x=None))
    options = SimpleNamespace(box_points=0, max_refinements=rounds, tolerance=1e-3)
    learnt_of, *_ = search._after_global_check(outer, outcome, end, options, 0)
    assert abs(predicted_value(outcome, end.x, end.value) / end.value - 1.0) > 0.1
    learnt = abs(predicted_value(learnt_of, end.x, end.value) / end.value - 1.0) < 1e-3
    assert learnt is (rounds > 0)
