"""The explorer without its page: sliders as problems, certified looks, their curves, the store."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi import inner
from ccd_casadi.analysis import LIMITS, MoveLimits
from ccd_casadi.analysis.motor import Motion
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.drawing.svg import BLUE
from ccd_casadi.extensions.explorer.curves import (
    FIGURES,
    as_sampled,
    curves_of,
    draw_design,
    machine_html,
    move_words,
    sampled_of,
    standing_html,
    with_sampled,
)
from ccd_casadi.extensions.explorer.designs import (
    How,
    Standing,
    elements_at,
    judge_figures,
    present,
)
from ccd_casadi.extensions.explorer.knobs import Notch, Problems, case_at, judge_notched, knobs_of
from ccd_casadi.extensions.explorer.pins import landscape_of, steepest_axes
from ccd_casadi.extensions.explorer.session import KnownPlant, Session, frequency_error
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.lti.state_space import closed_loop
from ccd_casadi.plants.places import Places
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.reporting.landscape import read_truths
from ccd_casadi.reporting.machine import find_lumped, lumped_svg
from ccd_casadi.reporting.nyquist import loop_panels
from ccd_casadi.support.text import HZ, use_units
from ccd_casadi.synthesis.synthesis import Outcome

CASE = Path("runs/two_mass.toml")
EQUAL = 1e-9  # relative: the same figures by another way


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    made = Session(load_case(CASE), tmp_path_factory.mktemp("explored"))
    yield made
    made.store.close()


@pytest.fixture(scope="module")
def searched_look(session):
    return session.full(session.start)


def asked_of_inner(capsys, theta, *options):
    """What the command `inner` prints at θ."""
    words = ",".join(f"{name}={value!r}" for name, value in zip(("m1", "m2"), theta, strict=True))
    code = inner.main([str(CASE), "--theta", words, "--quiet", *options])
    return code, json.loads(capsys.readouterr().out)


def same(design, found):
    """Every figure of a look equals that of `inner`."""
    f = design.figures
    pairs = [
        (design.bandwidth_hz, "bandwidth_hz"), (f.sensitivity_peak, "sensitivity_peak"),
        (f.sensitivity_low, "sensitivity_low"), (f.gamma, "gamma"), (f.gamma_opt, "gamma_opt"),
        (f.omega_S / HZ, "omega_S_hz"), (f.omega_T / HZ, "omega_T_hz"),
        (design.cost, "hardware_cost"), (design.objective, "objective"),
    ]  # fmt: skip
    return all(value == pytest.approx(found[name], rel=EQUAL) for value, name in pairs)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"S_max": 1.6, "omega_T_hz": (30.0, 500.0), "theta": (60.0, 58.0)},
        {"resonance_shift": 0.02},
        {"structure": "h_infinity_disturbance", "omega_S_hz": (20.0, 900.0)},
        {"structure": "sections", "sampled": True, "rate_hz": 8000.0, "delay_us": 50.0},
    ],
)
def test_sliders_and_the_case_they_make_are_one_problem(change):
    case = load_case(CASE)
    knobs = replace(knobs_of(case), **change)
    assert Problems(case).at(knobs) == problem_of(case_at(case, knobs))


def test_designs_at_random_are_those_of_inner(session, capsys):
    rng = np.random.default_rng(0)
    case = session.case
    problem = session.problems.at(session.start)
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    for number in range(8):
        theta = tuple(map(float, lower + rng.uniform(size=2) * (upper - lower)))
        knobs = replace(session.start, theta=theta)
        if number < 1:  # a full search, as when a slider is let go
            _, found = asked_of_inner(capsys, theta)
            assert same(session.full(knobs), found)
            continue
        box = case.inner.omega_S_hz, case.inner.omega_T_hz
        hz = [float(np.exp(rng.uniform(*np.log(pair)))) for pair in box]
        options = ("--omega-s-hz", repr(hz[0]), "--omega-t-hz", repr(hz[1]))
        code, found = asked_of_inner(capsys, theta, *options)
        design = present(problem, knobs, elements_at(problem, theta), (HZ * hz[0], HZ * hz[1]))
        assert (design.standing is Standing.REFUSED) == (code != 0)
        if code == 0:
            assert same(design, found)
            assert (design.standing is Standing.KEPT) == found["feasible"]


def test_a_search_keeps_its_bounds_and_its_curves_show_it(searched_look):
    design, c = searched_look, curves_of(searched_look)
    assert design.how is How.SEARCHED
    assert design.standing is Standing.KEPT
    assert c.view.gains[0].max() == pytest.approx(design.figures.sensitivity_peak, rel=1e-6)
    # what the certificate says of each of them
    assert (c.view.gains <= c.view.bounds * (1.0 + 1e-9)).all()
    assert c.view.gains[0][c.view.hz == design.bandwidth_hz] == pytest.approx(2**-0.5, rel=1e-6)
    assert c.poles[2].real.max() < 0.0
    # the distance of L from -1 is 1/|S|
    near = np.abs(1.0 + c.view.open[0, :, 0, 0])
    known = np.isfinite(near)
    assert near[known] * c.view.gains[0][known] == pytest.approx(np.ones(known.sum()), rel=1e-6)
    assert abs(c.step[-1] - 1.0) < 0.05
    assert c.move.feedforward
    assert (
        np.abs(c.move.error[c.move.time > 1.5 * c.move.duration]).max() < 1e-2 * c.move.window
    )


def test_a_bound_that_is_missed_is_said_so(session, searched_look):
    stricter = replace(session.start, S_max=1.5)
    design = session.live(stricter)  # at the weights that suit a larger S_max
    assert design.standing is Standing.MISSED
    assert "S_max = 1.5" in design.reason
    assert curves_of(design) is not None


def test_what_is_not_certified_says_why_and_has_no_bandwidth(searched_look):
    failed = replace(searched_look.figures, outcome=Outcome.UNSTABLE_LOOP)
    standing, reason = judge_figures(searched_look.problem, failed)
    design = replace(searched_look, figures=failed, standing=standing, reason=reason)
    assert standing is Standing.REFUSED
    assert reason == Outcome.UNSTABLE_LOOP.value
    assert np.isnan(design.bandwidth_hz)
    assert sampled_of(design) is None
    assert curves_of(replace(design, controller=None)) is None


def test_hold_and_delay_take_their_share_of_the_margin(searched_look):
    late = [
        sampled_of(replace(searched_look, knobs=replace(searched_look.knobs, delay_us=delay)))
        for delay in (0.0, 100.0)
    ]
    assert all(found.stable for found in late)
    assert searched_look.figures.sensitivity_peak < late[0].peak < late[1].peak
    for found in late:
        assert found.gain.max() <= found.peak * (1.0 + 1e-6)


def test_the_standing_is_that_of_the_worst_that_was_judged(searched_look):
    """Certified, and unstable as it would run: "certified, keeps its bounds" is not what it is."""
    order = list(Standing)
    for rate, delay, worst in ((1e5, 0.0, Standing.KEPT), (1e4, 100.0, Standing.MISSED),
                               (3162.0, 300.0, Standing.REFUSED)):  # fmt: skip
        knobs = replace(searched_look.knobs, rate_hz=rate, delay_us=delay)
        loose = replace(searched_look.problem.inner, S_max=1.01 * searched_look.problem.inner.S_max)
        problem = replace(searched_look.problem, inner=loose)
        for before in (Standing.KEPT, Standing.MISSED, Standing.NEAR, Standing.REFUSED):
            design = replace(searched_look, knobs=knobs, standing=before, problem=problem)
            found = as_sampled(design.plant, design.controller, rate, delay)
            after = with_sampled(design, found)
            assert after.standing == max(before, worst, key=order.index)
    assert "unstable as sampled at 3162 Hz" in after.reason
    assert np.isnan(after.bandwidth_hz)


def test_another_plant_than_the_models_own_certifies_nothing(session, searched_look):
    own = elements_at(searched_look.problem, searched_look.theta)
    for error, kept in ((0.0, True), (0.01, True), (0.05, False), (np.inf, False)):
        near = replace(own, error=error, words="a plant nearby")
        point = searched_look.figures.omega_S, searched_look.figures.omega_T
        design = present(searched_look.problem, searched_look.knobs, near, point)
        assert (design.standing is Standing.KEPT) == kept
        assert (design.standing is Standing.NEAR) != kept
        assert np.isfinite(design.objective) == kept  # no J of one θ's mass and another's bandwidth
        words = standing_html(design, curves_of(design), None)
        assert ("certified, keeps its bounds" in words) == kept
        assert ("a plant nearby" in words) == (error > 0.0) or kept


def test_the_margins_reported_are_where_stability_ends(session, searched_look):
    assert "K by itself is stable" in standing_html(searched_look, curves_of(searched_look), None)
    design = session.full(replace(session.start, theta=(55.0, 55.0)))  # K is unstable there
    c, G, K = curves_of(design), design.plant.plant_si(), design.controller

    def stable(factor):
        loop = closed_loop(G, replace(K, C=factor * K.C, D=factor * K.D))
        return np.linalg.eigvals(loop.A).real.max() < 0.0

    for gain, inwards in (
        (c.view.margins.gain_down, 1.0 + 1e-6),
        (c.view.margins.gain_up, 1.0 - 1e-6),
    ):
        assert stable(gain * inwards)
        assert not stable(gain / inwards)
    assert "UNSTABLE (poles at 143.1 Hz)" in standing_html(design, c, None)
    assert "feedforward" in move_words(c)
    alone = replace(c, move=replace(c.move, feedforward=False))
    assert "without feedforward" in move_words(alone)
    assert "[move]" in move_words(c, own=True)


def test_margins_are_drawn_where_the_loop_has_them(session):
    design = session.full(replace(session.start, theta=(55.0, 55.0)))  # with a margin downwards too
    view = curves_of(design).view
    size, phase = loop_panels(view)

    def L(hz):
        G, K = view.loop.responses(HZ * np.array([hz]))
        return complex((G @ K)[0, 0, 0])

    (crossover,) = (level.value for level in phase.levels if level.vertical)
    assert abs(L(crossover)) == pytest.approx(1.0, rel=1e-9)
    assert len(size.marks) == 2
    for mark in size.marks:
        assert L(mark.x) == pytest.approx(-mark.y, rel=1e-6)  # where the gain alone decides
    (mark,) = phase.marks
    assert abs(L(mark.x)) == pytest.approx(1.0, rel=1e-9)
    turned = (mark.y - np.degrees(np.angle(L(mark.x)))) % 360.0
    assert min(turned, 360.0 - turned) < 1.0  # read off the grid's straight pieces
    gap = phase.curves[-1].y
    assert abs(gap[0] - gap[1]) == pytest.approx(view.margins.phase_deg, abs=1.0)
    drawn_too = draw_design(design, curves_of(design), None).panels
    assert drawn_too["L"].marks == size.marks  # what a page shows is what the explorer shows


def test_every_panel_can_be_painted_marks_with_words_alone_too(session, searched_look):
    painter = pytest.importorskip(
        "ccd_casadi.extensions.explorer.painter", reason="bokeh is not installed"
    )
    panels = draw_design(searched_look, curves_of(searched_look), None).panels
    assert any(mark.text and not mark.marker for p in panels.values() for mark in p.marks)
    for name, (heading, log_x, log_y) in FIGURES.items():
        panel = panels[name]
        figure = painter.PanelFigure(name, heading, False, log_x=log_x, log_y=log_y)
        sent = [values["data"] for _, values in figure.changes(panel, BLUE, "", True)
                if "data" in values]  # fmt: skip
        words = [word for data in sent for word in data.get("text", ())]
        assert {mark.text for mark in panel.marks} - {""} <= set(words)


def test_the_error_of_a_move_is_drawn_in_the_unit_of_the_plant(searched_look) -> None:
    curves = curves_of(searched_look)
    use_units("rad", "N m")
    try:
        panel = draw_design(searched_look, curves, None).panels["move"]
    finally:
        use_units("m", "N")
    assert panel.y_label == "error (µrad)"


def test_every_look_is_in_the_store_and_a_search_is_a_true_sample(session, searched_look):
    live = session.live(replace(session.start, theta=(60.0, 66.0)))
    session.keep([live, searched_look])
    problem = searched_look.problem
    truths = read_truths(session.store.path, problem)
    places = {s.theta for s in truths.designs}
    assert {live.theta, searched_look.theta} <= places
    known = dict(zip(map(tuple, truths.theta.tolist()), truths.bandwidth_hz, strict=True))
    assert known[searched_look.theta] == pytest.approx(searched_look.bandwidth_hz, rel=EQUAL)
    assert np.isnan(known.get(live.theta, np.nan))  # one synthesis is no ω_b*(θ)
    drawn, _ = landscape_of(problem, searched_look.theta, None, None, session.store.path, (0, 1))
    assert searched_look.theta in {(x, y) for x, y, _ in drawn.truths.tolist()}


@pytest.mark.parametrize("steep", [(0, 1), (1, 3), (2, 4)])
def test_the_map_opens_over_the_two_parameters_that_matter(steep):
    rng = np.random.default_rng(0)
    lower, width = rng.uniform(-1.0, 1.0, 5), 10.0 ** rng.uniform(-3.0, 2.0, 5)
    slopes = np.where(np.isin(np.arange(5), steep), (8.0, -8.0, 8.0, -8.0, 8.0), 2.0)
    places = rng.uniform(size=(40, 5))
    hz = 70.0 + places @ slopes + rng.normal(size=40)
    hz[::9] = np.nan  # infeasible
    known = {tuple(lower + width * x): value for x, value in zip(places, hz, strict=True)}
    assert steepest_axes(known, lower, lower + width) == steep
    assert steepest_axes({}, lower, lower + width) == (0, 1)
    assert steepest_axes({}, lower[:1], lower[:1] + 1.0) == (0,)


def test_a_saved_case_is_the_one_on_the_sliders(session):
    knobs = replace(session.start, theta=(61.5, 58.25), S_max=1.625)
    first, second = session.save(knobs), session.save(knobs)
    assert first != second
    case = load_case(first)
    assert knobs_of(case) == knobs
    assert problem_of(case) == session.problems.at(knobs)


def test_a_place_that_is_dragged_moves_what_it_names():
    """A mirrored coordinate the other way, a diagonal by the mean, what is held not at all."""
    pytest.importorskip("bokeh")
    from ccd_casadi.extensions.explorer.controls import PlacesFigure, moves

    nodes = tuple((x, y) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.0, 0.1))
    places = Places(nodes, (("-a", "b"), ("r", "r"), (0.0, 0.05)))
    theta, found = np.array([2.0, 0.04, 0.03]), []
    problem = problem_of(load_case(CASE))
    assert not moves(problem)
    source = replace(problem.source, places=places, fixed=(("b", 0.06, "m"),))
    problem = replace(problem, source=source, names=("t", "a", "r"))
    assert moves(problem)
    made = PlacesFigure(problem, found.append)
    source, shown = made.marks(theta)
    x, y = np.array(shown["data"]["x"]), np.array(shown["data"]["y"])
    assert np.allclose([x, y], [[-40.0, 30.0, 0.0], [60.0, 30.0, 50.0]])
    moves = (
        (0, (-5.0, 3.0), (0.0, 5e-3, 0.0)),
        (1, (2.0, 4.0), (0.0, 0.0, 3e-3)),
        (2, (9.0, 0.0), (0.0,) * 3),
    )
    for i, (dx, dy), expected in moves:
        source.data = shown["data"] | {"x": x + dx * np.eye(3)[i], "y": y + dy * np.eye(3)[i]}
        assert found[-1] - theta == pytest.approx(expected, abs=1e-12)
    source.data = {name: column[1:] for name, column in shown["data"].items()}
    assert found[-1] == pytest.approx(theta)


def test_masses_and_springs_are_read_from_the_matrices(session, searched_look):
    system = searched_look.elements.system
    found = find_lumped(system)
    assert found.masses.tolist() == list(searched_look.theta)
    ((i, j, stiffness),) = found.springs  # nothing holds it to the ground
    assert (i, j) == (0, 1)
    assert stiffness == pytest.approx(2.0 * sum(m**4 for m in searched_look.theta))
    assert (found.driven, found.measured) == ((0,), (0,))
    svg = lumped_svg(found, searched_look.modal, 70.0)
    assert svg.count("<rect") == 2
    assert "mode 1" in svg
    grounded = find_lumped(replace(system, K=system.K + np.diag([0.0, 1e6])))
    assert (1, -1, pytest.approx(1e6)) in grounded.springs
    other = family((1.0, 1.0))  # in modal coordinates there are no masses to draw
    assert find_lumped(other) is None
    design = replace(searched_look, elements=replace(searched_look.elements, system=other))
    assert "<table>" in machine_html(design, session.start.theta, 1.0)


def family(theta):
    """Three modes, a rigid and two flexible ones, that move smoothly with θ."""
    a, b = theta
    B = np.array([[1.0, 1.0], [a**0.3, -(b**0.1)], [0.4 * b, 0.4 * b]])
    lam = np.diag([0.0, 1e6 * a**1.5 / b, 4e6 * b**0.5])
    none = tuple(np.zeros((0, *shape)) for shape in ((3, 3), (3, 3), (3, 3), (3, 2), (2, 3)))
    return Mechanics(np.eye(3), np.zeros((3, 3)), lam, B, B.T.copy(), 0.01, none)


def test_a_slow_plant_is_drawn_by_a_model_whose_error_was_measured(session):
    problem = session.problems.at(session.start)
    plant, start = plant_of(problem), np.array(session.start.theta)
    known = KnownPlant(plant, problem.lower, problem.upper)
    width = np.array(problem.upper) - np.array(problem.lower)
    away = [tuple(start + share * width) for share in (0.005, 0.01, 0.02, 0.04)]

    def own(theta):
        return mechanics(plant, theta, derivatives=False)

    assert known.learn(tuple(start), own(start)) is None
    assert known.at(tuple(start)).exact
    assert "nearest solved" in known.at(away[0]).words
    known.renew()
    off = [frequency_error(known.at(theta).system, own(theta)) for theta in away]
    assert 0.0 < off[0] < 0.3 * off[1] < 0.09 * off[2]  # to first order: by the square of the step
    assert known.at(away[0]).error == np.inf  # nothing was checked
    assert known.learn(away[1], own(away[1])) == off[1]
    assert known.at(away[0]).error == off[1]
    assert not known.at(away[0]).exact
    assert known.at(away[3]).error == np.inf  # farther away than what was checked
    assert known.at(away[1]).exact
    known.renew()
    assert frequency_error(known.at(away[2]).system, own(away[2])) < off[2]


@pytest.mark.parametrize("depth", [0.05, 0.4])
def test_a_notch_is_judged_as_its_response_has_it(searched_look, depth):
    """L, S and stability against the plain product of responses, by other arithmetic."""
    view = curves_of(searched_look).view
    notch = Notch(1.3 * view.bandwidth_hz, depth, 0.3)
    found = judge_notched(view, notch)
    s, w = 2j * np.pi * found.hz, HZ * notch.hz
    own = (s**2 + 2 * 0.3 * depth * w * s + w**2) / (s**2 + 2 * 0.3 * w * s + w**2)
    at = np.isin(found.hz, view.hz)  # lines of the page itself
    # measured 8e-9: what two state spaces of one product differ by
    np.testing.assert_allclose(found.open[at, 0, 0], view.open[0, :, 0, 0] * own[at], rtol=1e-7)
    np.testing.assert_allclose(found.gain, 1.0 / np.abs(1.0 + found.open[:, 0, 0]), rtol=1e-7)
    assert np.abs(own).min() == pytest.approx(depth, rel=1e-3)
    # of the margins: on the unit circle at the crossover's distance of angle
    crossing = np.interp(found.margins.places[2], HZ * found.hz, np.abs(found.open[:, 0, 0]))
    assert crossing == pytest.approx(1.0, rel=0.02)
    assert found.bandwidth_hz < view.bandwidth_hz  # it takes phase and gain below itself


def test_a_notch_that_is_none_changes_nothing_and_a_hurtful_one_is_called_unstable(searched_look):
    view = curves_of(searched_look).view
    same = judge_notched(view, Notch(view.bandwidth_hz, 1.0, 0.3)).margins
    assert same.phase_deg == pytest.approx(view.margins.phase_deg, rel=1e-3)
    slow = judge_notched(view, Notch(0.3 * view.bandwidth_hz, 0.01, 2.0))
    assert slow.stable == (slow.margins.phase_deg > 0.0)
    wide = replace(view.loop, controller=Notch(0.3, 50.0, 2.0).behind(view.loop.controller))
    assert wide.stable == bool((wide.poles.real < 0.0).all())


def test_the_move_that_is_drawn_is_that_of_the_case(searched_look):
    """With [move] its setpoint, window and feedforward; the default one without."""
    plain = curves_of(searched_look).move
    assert plain.duration == pytest.approx(setpoint(LIMITS).duration)
    limits = MoveLimits(0.002, 0.1, 5.0, 1e3, 1e6)
    source = replace(searched_look.problem.source, motion=Motion(limits, 1e-7))
    problem = replace(searched_look.problem, source=source)
    own = curves_of(replace(searched_look, problem=problem)).move
    assert own.duration == pytest.approx(setpoint(limits).duration)
    assert (own.window, own.position[-1]) == (1e-7, pytest.approx(0.002))
    assert own.feedforward
