"""Start against optimum on the page: each hardware with its own best loop."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from oracles.helpers import problem

from ccd_casadi.drawing.content import Chapter, Figure
from ccd_casadi.drawing.paint import block_html, tables_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant, true_inner
from ccd_casadi.reporting.limit_figures import start_chapter
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.synthesis import synthesise


def best_at(case: CoDesignProblem, theta: tuple[float, ...]) -> SimpleNamespace:
    """A verified design, as far as the chapter asks for it."""
    best = true_inner(case, theta).optimum
    assert best is not None
    f = best.figures
    made = synthesise(scaled_plant(case, theta), case.weights.at(f.omega_S, f.omega_T),
                      omega_low=case.inner.omega_low)  # fmt: skip
    return SimpleNamespace(theta=theta, design=made, problem=case, controller=made.controller,
                           bandwidth=f.bandwidth)  # fmt: skip


def html(chapter: Chapter) -> str:
    return block_html(chapter, "1")


def test_both_sides_are_the_true_inner_problems() -> None:
    case = problem()
    (chapter,) = start_chapter(case, best_at(case, (55.0, 55.0)))
    row = re.search(r"bandwidth ω_b.*?</tr>", html(chapter), re.DOTALL)
    assert row is not None
    shown = [float(v) for v in re.findall(r">([\d.]+)</td>", row[0])]
    expected = [true_inner(case, theta).bandwidth / HZ for theta in (case.start, (55.0, 55.0))]
    assert shown == pytest.approx(expected, rel=1e-4)
    gained = 100.0 * (expected[1] / expected[0] - 1.0)
    assert f"changes by {gained:+.3g}\xa0%" in html(chapter)


def test_poles_are_shown_once_a_pair_and_all_damped() -> None:
    case = problem()
    (chapter,) = start_chapter(case, best_at(case, (55.0, 60.0)))
    figure, _ = chapter.body
    assert isinstance(figure, Figure)
    heads = ("|pole| (Hz)", "damping ratio of the loop's poles (–), optimum")
    (rows,) = (table.rows for table in tables_of(figure.drawing) if table.head == heads)
    assert rows
    assert all(0.0 < zeta <= 1.0 for _, zeta in rows)
    assert np.all(np.diff([hz for hz, _ in rows]) >= 0.0)


def test_a_start_that_is_the_optimum_or_has_no_loop_is_said() -> None:
    case = problem()
    verified = best_at(case, (55.0, 55.0))
    assert start_chapter(replace(case, start=(55.0, 55.0)), verified) == []
    tight = replace(case, inner=replace(case.inner, S_max=1.01))
    (chapter,) = start_chapter(tight, verified)
    assert "no feasible loop" in html(chapter)
