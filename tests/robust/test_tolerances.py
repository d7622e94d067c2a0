"""A share of machines, what tolerances cost, and half-widths as variables."""

import json
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy
from oracles.case_documents import QUICK_SECTIONS

from ccd_casadi.cases.case import case_to_toml, load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.deployment.robust_set import members
from ccd_casadi.extensions.tolerances import answers, prices, share_search
from ccd_casadi.extensions.tolerances.answers import tolerance_case
from ccd_casadi.extensions.tolerances.machines import (
    Machine,
    MachineOptions,
    Plan,
    ShareCertificate,
    Trial,
    certified_share,
    count_failures,
    draw_machines,
)
from ccd_casadi.extensions.tolerances.prices import Bought, WidthSearch, promised_gain, scale_width
from ccd_casadi.extensions.tolerances.share_search import NoDesign, ShareOptions, ShareSearch
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_search import prepare_search
from ccd_casadi.insight import main as insight_main
from ccd_casadi.report import main as report_main
from ccd_casadi.robustness import main as robustness_main
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.tolerances import main

ROBUST = """[robust]
resonance_shift = 0.03
damping = [0.5, 4.0]
gain = 0.02
"""


def case_file(place: Path, robust: str, *changes: tuple[str, str]) -> Path:
    text = QUICK_SECTIONS.replace("[robust]\ngain = 0.02\n", robust)
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = place / "case.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def uncertain(tmp_path_factory: pytest.TempPathFactory) -> Any:
    problem = problem_of(load_case(case_file(tmp_path_factory.mktemp("wide"), ROBUST)))
    return uncertain_plant(problem, problem.start)


# ---- what a count decides ------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.9, 0.99, 0.999])
@pytest.mark.parametrize("confidence", [0.9, 0.99])
def test_what_may_fail_is_the_most_that_scipy_confirms(share: float, confidence: float) -> None:
    plan = Plan(share, confidence)

    def least(failed: int) -> float:
        found = scipy.stats.binomtest(plan.draws - failed, plan.draws, alternative="greater")
        return float(found.proportion_ci(confidence).low)

    assert least(plan.allowed) >= share > least(plan.allowed + 1)


@pytest.mark.parametrize(("share", "confidence"), [(0.9, 0.9), (0.99, 0.99), (0.999, 0.99)])
def test_the_trial_is_the_largest_count_that_keeps_its_chance(
    share: float, confidence: float
) -> None:
    """Of any share q that fails: accepted by an attempt and then refused by the certificate."""
    plan, binom = Plan(share, confidence), scipy.stats.binom
    q = np.geomspace(1e-3, 1.0 / (1.0 - share), 5000)[:-1] * (1.0 - share)

    def chance(allowed: int) -> float:
        accepted = binom.cdf(allowed, plan.trial.rounds * plan.draws, q)
        both = accepted * binom.sf(plan.allowed, plan.draws, q)
        return float(MachineOptions.attempts * both.max())

    most = 1.0 - MachineOptions.reliable
    assert chance(plan.trial.allowed) <= most * (1.0 + 1e-4) < chance(plan.trial.allowed + 1)
    assert plan.trial.rounds >= MachineOptions.confirming


def test_failures_are_counted_anew_for_each_design(monkeypatch: pytest.MonkeyPatch) -> None:
    """A design is accepted by all rounds of its trial, with at most as many failures in all."""
    counts = iter([3, 1, 1, 2, 0, 1, 1, 0])  # a design is refused at 3, at 4 and at 3
    designs: list[int] = []
    search = ShareSearch(None, None, Plan(0.999, 0.99), {}, 0)  # type: ignore[arg-type]

    def drawn_on(one: ShareSearch, _: object) -> tuple[ShareSearch, int]:
        return replace(one, rounds=one.rounds + 1), next(counts)

    def redesigned(one: ShareSearch, *_: object, fewer: int) -> ShareSearch:
        designs.append(one.rounds)
        assert fewer == 1
        return one

    monkeypatch.setattr(ShareSearch, "with_draws", drawn_on)
    monkeypatch.setattr(ShareSearch, "redesign", redesigned)
    found = search.at_its_theta(lambda _: None, ShareOptions(), Trial(3, 2), 8)
    assert (designs, found.rounds, found.settled) == ([1, 4], 7, True)
    assert not replace(found).at_its_theta(lambda _: None, ShareOptions(), Trial(2, -1), 1).settled


@pytest.mark.parametrize("word", ["uniform", "normal"])
def test_drawn_machines_have_the_share_that_is_known(uncertain: Any, word: str) -> None:
    """Of each tolerance alone below a level, and of two together: they are independent."""
    number, z, names = 20_000, np.array([-0.5, 0.2, 0.7]), list(uncertain.names)
    rng = np.random.default_rng(1)
    machines = draw_machines(uncertain, dict.fromkeys(names, word), rng, number)
    points = np.array([point for _, point in machines])
    low, high = uncertain.box
    assert (np.clip(points, low, high) == points).all()
    cut = scipy.stats.truncnorm(-MachineOptions.sigmas, MachineOptions.sigmas)
    share = cut.cdf(MachineOptions.sigmas * z) if word == "normal" else 0.5 * (1.0 + z)
    levels = {"resonance_shift": 0.03 * z, "gain": 0.02 * z}
    levels["damping"] = 0.5 + 3.5 * share  # of the uniform one in the factor itself
    if word == "normal":  # 0.5 = 2^-1 and 4 = 2^2: the sides differ, the median is the model's
        levels["damping"] = np.where(z < 0.0, 2.0**z, 4.0**z)
    spread = 4.0 * np.sqrt(share * (1.0 - share) / number)
    below = {name: points[:, [names.index(name)]] <= level for name, level in levels.items()}
    for name, found in below.items():
        assert (np.abs(found.mean(axis=0) - share) < spread).all(), name
    both = (below["gain"] & below["damping"]).mean(axis=0)
    assert (np.abs(both - share**2) < 4.0 * np.sqrt(share**2 / number)).all()


def test_certificates_of_toys_claim_too_much_no_oftener_than_stated() -> None:
    """Machines fail with a probability that the plan is to refuse in 99 of 100 cases; and with one
    that a trial may accept, of which the certificate refuses as few as stated."""
    plan, toys, rng = Plan(0.99, 0.99), 200_000, np.random.default_rng(2)
    trial, q = plan.trial, 0.01 * rng.random(toys)
    claimed = rng.binomial(plan.draws, 1.0 - plan.share, 1000)
    wrong = sum(ShareCertificate(plan, int(failed)).passed for failed in claimed)
    assert wrong <= 1000 * (1.0 - plan.confidence) + 4.0 * np.sqrt(1000 * (1.0 - plan.confidence))
    accepted = rng.binomial(trial.rounds * plan.draws, q) <= trial.allowed
    refused = accepted & (rng.binomial(plan.draws, q) > plan.allowed)
    stated = toys * (1.0 - MachineOptions.reliable) / MachineOptions.attempts
    assert refused.sum() <= stated + 4.0 * np.sqrt(stated)
    assert accepted.sum() > 100


# ---- the certificate -----------------------------------------------------------------------------


class Backwards:
    """A pool whose results come in another order."""

    count = 3

    def map_unordered(self, function: Callable[..., Any], tasks: Sequence[Any]) -> Iterator[Any]:
        return iter([function(task) for task in reversed(tasks)])


def test_machines_that_cannot_be_evaluated_fail_alone() -> None:
    def judge(machines: list[Machine]) -> list[bool]:
        if any(option == 7 for option, _ in machines):
            raise ZeroDivisionError
        return [option < 5 for option, _ in machines]

    machines = [(option, np.zeros(1)) for option in (0, 1, 7, 2, 6, 7)]
    assert count_failures(judge, machines) == (3, 2)


def test_the_count_is_the_same_for_any_workers_and_not_for_another_seed(uncertain: Any) -> None:
    column = list(uncertain.names).index("gain")

    def kept(machines: list[Machine]) -> list[bool]:
        return [point[column] < 0.012 for _, point in machines]

    box: Any = SimpleNamespace(uncertain=uncertain, find_kept=kept)
    plan, workers = Plan(0.9, 0.99), Backwards()
    one = certified_share(box, plan, {}, 3)
    assert one == certified_share(box, plan, {}, 3, workers)  # type: ignore[arg-type]
    counts = {certified_share(box, plan, {}, seed).failed for seed in range(6)}
    assert len(counts) > 1
    assert abs(one.failed / plan.draws - 0.2) < 4.0 * np.sqrt(0.16 / plan.draws)


@pytest.mark.parametrize("failed", [0, 5, 6])
def test_the_line_names_share_confidence_and_draws_and_claims_no_box(failed: int) -> None:
    certificate = ShareCertificate(Plan(0.999, 0.99), failed)
    line = certificate.line
    assert certificate.passed == (failed <= certificate.plan.allowed) == (line.state == "passed")
    fresh = f"{certificate.plan.draws:,} fresh draws"
    for part in ("99.9 % of machines", "99 % confidence", fresh):
        assert part in line.words
    clauses = "; ".join(line.clauses).split("; ")
    assert "the whole box is not judged" in clauses
    assert "proven" not in " ".join(clauses)
    shown = next(float(each.split()[0]) for each in clauses if each.endswith("is shown"))
    assert shown / 100.0 <= certificate.least


# ---- cases ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robust", "words"),
    [
        ("confidence = 0.9", "confidence: has no effect without share"),
        ('distribution = {gain = "normal"}', "distribution: has no effect without share"),
        ('share = 0.9\ndistribution = {gains = "normal"}', "distribution.gains: has no such"),
        ('share = 0.9\ndistribution = {gain = "cauchy"}', "robust.distribution: gain"),
        ("share = 0.9\ncost_per_percent = {gain = 1.0}", "cost_per_percent: is of the whole box"),
        ("cost_per_percent = {damping = 1.0}", "cost_per_percent.damping: has no such"),
        ("half_width = {gain = [0.01, 0.1]}", "half_width: has no effect without cost_per_percent"),
        (
            "cost_per_percent = {gain = 1.0}\nhalf_width = {gain = [0.03, 0.1]}",
            "half_width.gain: is 0.03 to 0.1, without the case's own 0.02",
        ),
        ("share = 1.0", "robust.share: is 1; give a number between 0 and 1"),
        ("share = -0.5", "robust.share: is -0.5; give a number between 0 and 1"),
        ("share = 0.9\nconfidence = 0.01", "robust.share: 0.9 at a confidence of 0.01 has no"),
        ('share = 0.9\ndistribution = "normal"', "robust.distribution: is 'normal'; give a table"),
        ("cost_per_percent = {gain = -1.0}", "robust.cost_per_percent: gain is -1; give a number"),
        (
            "cost_per_percent = {gain = 1.0}\nhalf_width = {gain = [0.01, 5.0]}",
            "half_width.gain: is 5; give a share of the gain, 0 to 0.9",
        ),
    ],
)
def test_keys_without_effect_are_refused(tmp_path: Path, robust: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        tolerance_case(load_case(case_file(tmp_path, f"{ROBUST}{robust}\n")))


def test_what_cannot_keep_a_share_refuses_it_by_name(
    tmp_path: Path, two_mass_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = case_file(tmp_path, f"{ROBUST}share = 0.9\n")
    with pytest.raises(UserError, match=r"robust\.share: is kept by `ccd tolerances` alone"):
        problem_of(load_case(path))  # of every other command
    full = QUICK_SECTIONS[: QUICK_SECTIONS.index("[controller]")]
    path.write_text(f"{full}\n[robust]\nresonance_shift = 0.01\nshare = 0.9\n")
    with pytest.raises(UserError, match=r"robust\.share"):
        load_case(path)
    for robust, words in ((ROBUST, "robust.share: is missing"), ("", "has no tolerance")):
        assert main([str(case_file(tmp_path, robust)), "--quiet"]) == 2
        assert words in capsys.readouterr().err
    assert main([str(two_mass_run), "--quiet"]) == 2  # of full order
    assert "tolerances are of controller.structure" in capsys.readouterr().err


# ---- prices --------------------------------------------------------------------------------------


def test_scaled_widths_keep_the_model(tmp_path: Path) -> None:
    problem = problem_of(load_case(case_file(tmp_path, ROBUST)))
    whole = uncertain_plant(problem, problem.start)
    for name in whole.names:
        gone = uncertain_plant(scale_width(problem, name, 0.0), problem.start)
        assert set(gone.names) == set(whole.names) - {name}
        assert scale_width(problem, name, 1.0) == problem
        half = uncertain_plant(scale_width(problem, name, 0.5), problem.start)
        column = list(whole.names).index(name)
        assert half.nominal[column] == whole.nominal[column]
        assert (np.clip(half.box, *whole.box) == half.box).all()


def test_prices_fall_with_the_width_and_bought_widths_are_a_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole tolerance costs at least what half of it buys, and the slope has the same sign."""
    robust = "[robust]\ngain = 0.04\ncost_per_percent = {gain = 0.1}\n"
    case = load_case(case_file(tmp_path, robust))
    found, design, _ = prepare_search(problem_of(case))
    end = Bought({"gain": 0.05}, (58.5, 59.5), design.kappa, 1.0, 1.0, {})
    made = WidthSearch(end, end, 1, np.nan)
    monkeypatch.setattr(answers, "buy", lambda *_: made)
    run: Any = SimpleNamespace(problem=found, theta=found.start, kappa=design.kappa, case=case)
    answer = answers.price_answer(run, SimpleNamespace(workers=None), quiet=True)  # type: ignore[arg-type]
    (price,) = answer.entry["prices"]
    assert answer.entry["bandwidth_hz"] == pytest.approx(design.bandwidth / HZ, rel=1e-4)
    assert price["costs_hz"] >= price["half_buys_hz"] > 0.0
    assert price["slope_hz"] > 0.0
    assert any("gain ±4 %" in line for line in answer.words)
    bought = parse_case(tomllib.loads(answer.files["tolerances_bought.toml"]), case.path)
    assert bought.robust == replace(case.robust, gain=0.05, cost_per_percent=None)
    assert [one.start for one in bought.theta] == list(end.theta)


def test_a_case_of_tolerances_is_written_as_it_was_read(tmp_path: Path) -> None:
    robust = 'share = 0.9\ndistribution = {gain = "normal", damping = "uniform"}\n'
    case = load_case(case_file(tmp_path, f"{ROBUST}{robust}"))
    assert parse_case(tomllib.loads(case_to_toml(case)), case.path) == case


# ---- half-widths as variables --------------------------------------------------------------------


def test_half_widths_end_where_cost_and_gain_balance(monkeypatch: pytest.MonkeyPatch) -> None:
    """On J = Σ (ln t - a)² with its exact slopes, one optimum inside and one beyond its bound."""
    problem: Any = SimpleNamespace()
    own = SimpleNamespace(gain=0.02, mode_shift=0.03)
    centre = {"gain": np.log(0.03), "mode_shift": np.log(1.0)}

    def valley(sampler: Any, tried: dict[str, float], **_: Any) -> Bought:
        off = {name: float(np.log(t) - centre[name]) for name, t in tried.items()}
        slopes = {name: 2.0 * each for name, each in off.items()}
        return Bought(tried, (), np.zeros(0), 1.0, sum(x * x for x in off.values()), slopes)

    monkeypatch.setattr(prices, "bought", valley)
    monkeypatch.setattr(prices, "structured_of", lambda _: SimpleNamespace(uncertainty=own))
    costs = {"gain": 1.0, "mode_shift": 1.0}
    sampler: Any = SimpleNamespace(problem=problem)
    found = prices.buy(sampler, (), np.zeros(0), costs, {"gain": (0.01, 0.1)}, lambda _: None)
    assert found is not None
    assert found.best.widths["gain"] == pytest.approx(0.03, rel=1e-2)
    assert found.best.widths["mode_shift"] == pytest.approx(0.06, rel=1e-9)  # twice the case's
    assert found.gap < 1e-3 * found.first.objective
    assert found.best.objective < found.first.objective


def test_the_gap_of_a_convex_objective_is_an_upper_bound() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        a, u = rng.normal(size=2), rng.normal(size=2)
        bounds = np.column_stack([u - rng.random(2), u + rng.random(2)])
        names = ("gain", "mode_shift")
        slopes = dict(zip(names, (2.0 * (u - a)).tolist(), strict=True))
        at = Bought(dict(zip(names, np.exp(u), strict=True)), (), u, 1.0, 0.0, slopes)
        fall = ((u - a) ** 2 - (np.clip(a, *bounds.T) - a) ** 2).sum()
        assert promised_gain(at, dict.fromkeys(names, 1.0), bounds) >= fall - 1e-12
        assert np.isnan(promised_gain(replace(at, slopes={}), dict.fromkeys(names, 1.0), bounds))


# ---- the command ---------------------------------------------------------------------------------


def test_a_share_has_more_bandwidth_than_the_whole_box(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robust = "[robust]\ngain = 0.04\nshare = 0.9\nconfidence = 0.9\n"
    robust += 'distribution = {gain = "normal"}\n'
    path, words = case_file(tmp_path, robust), ["--theta", "m1=59,m2=59"]
    assert main([str(path), *words]) == 0
    found = json.loads((tmp_path / "case_tolerances" / "tolerances.json").read_text())
    line = found["verdict"]["share"]
    assert (line["state"], line["share"], line["draws"]) == ("passed", 0.9, Plan(0.9, 0.9).draws)
    assert found["bandwidth_hz"] > found["whole_box"]["bandwidth_hz"]
    assert "whole box is not judged" in capsys.readouterr().out
    _is_a_run_of_its_kept_set(tmp_path / "case_tolerances", capsys)


def _is_a_run_of_its_kept_set(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What deploy and robustness read has the machines it was designed on, and no corner of the
    box; other commands refuse it by name."""
    run, whole = read_run(folder, of_share=True), 0.04
    gains = [member.at.gain for member in members(run, dense=True)]  # type: ignore[attr-defined]
    kept = [one["point"][0] for one in run.result["robust"]["set"]]
    assert sorted(gains) == sorted(gain for gain in kept if gain)
    assert max(map(abs, gains)) < whole
    claim = "for a share of 90 % of machines at 90 % confidence"
    assert run.result["verdict"]["survives"]["words"].startswith(claim)
    for command in (insight_main, report_main):
        assert command([str(folder)]) == 2
        assert f"is {claim}; name a run of the whole box" in capsys.readouterr().err
    assert robustness_main([str(folder), "--quiet", "--samples", "2"]) == 0
    result = json.loads((folder / "result.json").read_text())
    assert result["verdict"]["survives"]["words"].startswith(claim)
    assert claim in " ".join((folder / "robustness.html").read_text().split())
    corner = {"option": 0, "point": [whole]}
    for kept_set, words in (([corner], "not certified on the plants"), ([], "set: is missing")):
        result["robust"]["set"] = kept_set
        (folder / "result.json").write_text(json.dumps(result))
        with pytest.raises(UserError, match=words):
            read_run(folder, of_share=True)


def test_a_search_starts_again_from_the_whole_box_where_its_own_controller_is_unstable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The fast controller of the model alone is stable on no other machine."""
    for name in ("with_warm_start", "with_structured", "with_state"):
        monkeypatch.setattr(share_search, name, lambda problem, *rest, **more: problem)

    class Sampler:
        problem = None

        def of(self, problem: object) -> "Sampler":
            return self

        def value_from(self, theta: tuple[float, ...], kappa: list[float]) -> Any:
            return SimpleNamespace(theta=theta, kappa=kappa, feasible=kappa == [1.0], shortfall="")

    fast = Sampler().value_from((0.0,), [2.0])
    search = ShareSearch(Sampler(), fast, Plan(0.9, 0.9), {}, 0)  # type: ignore[arg-type]
    with pytest.raises(NoDesign):
        search.on(())
    assert replace(search, whole_box=(1.0,)).on(()).best.kappa == [1.0]
