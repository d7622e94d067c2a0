"""What every kind of inner problem keeps: a property a test, a kind a row."""

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from oracles.helpers import HZ, first_crossing, reference_plant, sensitivity_gain, state_response
from oracles.helpers import two_mass_model as model
from oracles.kinds import CABLES, kinds
from oracles.measured_files import written

from ccd_casadi.__main__ import main
from ccd_casadi.cases.measured_case import measured_case
from ccd_casadi.codesign import outer_mixed, outer_structured
from ccd_casadi.codesign.formulations import Direct, Lifted
from ccd_casadi.codesign.result import FORMAT
from ccd_casadi.codesign.run import solve
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.extensions.measured.measured_answer import measured_answer
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem import structured_bandwidth
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import FREE
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.sampling import sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.synthesis import derivatives, synthesis

KINDS = kinds()
HEAVY = ("disturbance", "error")  # whose figures and slopes have tests of their own elsewhere
EACH = [pytest.param(name, marks=pytest.mark.slow) if name in HEAVY else name for name in KINDS]
SYNTHESISE = [  # every way to a controller
    (synthesis, "design"), (synthesis, "_sweep"), (derivatives, "design"),
    (structured_bandwidth, "synthesise_sections"), (structured_bandwidth, "least_value"),
]  # fmt: skip
AT_THE_END = {  # what is asked of a polished design
    "mixed": (outer_mixed, "final_design"), "sections": (outer_structured, "_worst_plants"),
}  # fmt: skip
EVERY = {  # beside the schema's
    "compliance_max", "compliance_words", "cost_unit", "force_step_max", "globality", "iterates",
    "loop_warnings", "low_compliance", "notes", "outcome", "static_compliance",
    "surrogate_quality", "syntheses_to_optimum", "units",
}  # fmt: skip
UNITS = [(sampler, "inner_unit"), (sampler, "design_unit")]


@dataclass(frozen=True)
class Run:
    problem: CoDesignProblem
    first: Solution
    again: Solution
    made: tuple[Counter[str], Counter[str]]  # calls of the first run, and of the resumed one

    @property
    def result(self) -> dict[str, Any]:
        return self.first.result

    @property
    def controller(self) -> StateSpace:
        assert self.first.verified is not None
        return self.first.verified.controller

    @property
    def value(self) -> float:
        """What J counts, as result.json tells it."""
        error = self.result.get("error_rms_of_set")
        return HZ * self.result["bandwidth_hz"] if error is None else error


def lean(case: CoDesignProblem) -> CoDesignProblem:
    """With one start of a search where it has several: what is kept does not depend on them."""
    if not isinstance(case.controller, StructuredProblem):
        return case
    return replace(case, controller=replace(case.controller, starts=1))


def counted(calls: Counter[str], name: str, honest: Any) -> Any:
    def call(*arguments: Any, **more: Any) -> Any:
        calls[name] += 1
        return honest(*arguments, **more)

    return call


@pytest.fixture(scope="module", params=EACH)
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A solve and the same once more from its store, every synthesis counted."""
    case, store = lean(KINDS[request.param]), tmp_path_factory.mktemp("kind") / "samples.sqlite"
    made: tuple[Counter[str], Counter[str]] = (Counter(), Counter())
    ends = []
    for calls in made:
        with pytest.MonkeyPatch.context() as patch:
            for module, name in SYNTHESISE + UNITS:
                patch.setattr(module, name, counted(calls, name, getattr(module, name)))
            ends.append(solve(case, Lifted(points=4, box_points=2), store=store))
    return Run(case, *ends, made)


def test_the_value_is_that_of_the_controller(run: Run) -> None:
    """Recomputed from its matrices and the plant's own M, D and K, over frequency."""
    theta = tuple(run.result["theta"].values())
    G, K = reference_plant(mechanics(model(), theta), FREE), run.controller
    hz = np.geomspace(0.1, 1e3, 4000)
    found = first_crossing(lambda w: sensitivity_gain(G, K, w), HZ * hz, np.sqrt(0.5)) / HZ
    # ω_b is the largest that the shape allows
    if isinstance(run.problem.controller, StructuredProblem):
        shape = run.problem.controller.shape
        gain = sensitivity_gain(G, K, HZ * hz)
        level = np.sqrt(2.0) * gain  # x of the shape where it is so high, ω_b <= ω/x
        above = level + np.sqrt(level**2 + 4.0 * shape * (shape - 1.0))
        found = min(found, float((hz / np.where(level < 1.0, level, above / 2.0 / shape)).min()))
    assert run.result["bandwidth_hz"] == pytest.approx(found, rel=1e-4)
    if run.problem.budget is not None:
        hz = np.geomspace(1e-3, 1e6, 20_000)
        g, k = (state_response(part, HZ * hz)[:, 0, 0] for part in (G, K))
        of_force, of_noise = (abs(h / (1.0 + g * k)) ** 2 for h in (g, g * k))
        force, noise = (source.spectrum.level for source in CABLES.sources)
        density = of_force * force / (1.0 + (hz / 20.0) ** 2) + of_noise * noise
        assert run.value == pytest.approx(np.sqrt(np.trapezoid(density, hz)), rel=1e-4)


def test_the_gradient_is_the_slope(run: Run, tmp_path: Path) -> None:
    assert run.first.verified is not None
    case = run.first.verified.problem
    theta, way, h = np.array([60.3, 59.1]), np.array([0.8, 0.6]), 0.02
    with Workers(1) as pool, SampleStore(tmp_path / "samples.sqlite") as store:
        points = np.array([theta, theta + h * way, theta - h * way])
        here, *ends = sampler.Sampler(case, store, pool).values(points)
    numeric = (ends[0].value - ends[1].value) / (2.0 * h)
    assert np.array(here.gradient) @ way == pytest.approx(numeric, rel=1e-3)


def test_j_is_the_sum(run: Run) -> None:
    result = run.result
    assert result["hardware_cost"] == pytest.approx(sum(result["theta"].values()), rel=1e-12)
    J = run.problem.w1 * result["hardware_cost"] + run.problem.w2 * run.value
    assert result["objective"] == pytest.approx(J, rel=1e-12)


def test_what_was_spent_adds_up(run: Run) -> None:
    assert sum(run.result["spent"].values()) == run.result["syntheses"] > 0


@pytest.fixture
def schema(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main(["schema", "--result"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert found["properties"]["format"]["const"] == FORMAT
    return found


def test_the_result_has_the_same_keys_and_checks(run: Run, schema: dict[str, Any]) -> None:
    result = json.loads(json.dumps(run.result))
    jsonschema.validate(result, schema)
    assert result["status"] == "verified", result["reason"]
    assert result.keys() >= schema["properties"].keys()
    assert result.keys() >= EVERY
    assert {"certificate", "constraints", "inner_optimum", "optimality", "second_engine"} <= {
        name for name, passed in result["checks"].items() if passed
    }
    line, nothing = result["verdict"]["predicted"], not result["surrogate_quality"]
    assert (line["state"] == "unknown") == nothing
    assert (result["checks"]["prediction"] is None) == (nothing or line.get("learnt", False))


def test_what_the_schema_refuses(schema: dict[str, Any]) -> None:
    """And what was stored before there was a format passes."""
    kind = jsonschema.validators.validator_for(schema)
    kind.check_schema(schema)
    known = kind(schema)  # once: to check a schema costs more than to check a result
    for place in sorted((Path(__file__).parents[1] / "data/results").iterdir()):
        old = json.loads(place.read_text())
        known.validate(old)
        assert "format" not in old
        wrong = [old | {"format": FORMAT + 1}, old | {"syntheses": 1.5}, old | {"status": "done"}]
        wrong += [{name: old[name] for name in old if name != key} for key in schema["required"]]
        if old["status"] != "infeasible":
            wrong += [old | {"theta": {}}, old | {"bandwidth_hz": "50"}, old | {"checks": []}]
            of_a_design = schema["else"]["required"]
            wrong += [{name: old[name] for name in old if name != key} for key in of_a_design]
        for other in wrong:
            with pytest.raises(jsonschema.ValidationError):
                known.validate(other)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("mixed", {}),
        ("sections", {"structure": Structure(lead=0, biquads=0, roll_off=0)}),  # none is stable
        # whose nearest controllers climb for ten seconds
        *(pytest.param(name, {}, marks=pytest.mark.slow) for name in ("sections", *HEAVY)),
    ],
)
def test_what_is_infeasible_has_a_result_too(
    name: str, changes: dict[str, Any], schema: dict[str, Any]
) -> None:
    case = lean(KINDS[name])
    if changes and isinstance(case.controller, StructuredProblem):
        case = replace(case, controller=replace(case.controller, **changes))
    none = replace(case, inner=replace(case.inner, S_low=1e-6))
    result = solve(none, Direct(starts=1, box_points=2)).result
    assert (result["status"], result["format"]) == ("infeasible", FORMAT)
    jsonschema.validate(result, schema)


def test_a_resumed_run_is_the_same(run: Run) -> None:
    """And computes no unit of work anew."""
    for key in ("status", "theta", "objective", "bandwidth_hz", "syntheses", "spent", "active"):
        assert run.again.result[key] == run.result[key], key
    first, again = run.made
    assert sum(again.values()) < sum(first.values())
    assert not any(again[name] for _, name in UNITS), again


def test_a_resumed_run_makes_no_new_synthesis(run: Run) -> None:
    """But the final one, whose certificate no store is relied on for."""
    assert sum(run.made[1].values()) <= 1


# of sections, whose searches take three times as long, test_a_resumed_run_is_the_same is kept
@pytest.mark.parametrize("kind", ["mixed", pytest.param("sections", marks=pytest.mark.slow)])
def test_an_interrupted_run_makes_no_synthesis_twice(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C once the polish is done, before the design is judged."""
    case, made, options = lean(KINDS[kind]), Counter[str](), Direct(starts=1, box_points=0)
    for where, what in SYNTHESISE:
        monkeypatch.setattr(where, what, counted(made, what, getattr(where, what)))
    whole = solve(case, options, store=tmp_path / "whole.sqlite").result
    once = made.copy()
    made.clear()

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(*AT_THE_END[kind], stop)
        with pytest.raises(KeyboardInterrupt):
            solve(case, options, store=tmp_path / "samples.sqlite")
    assert 0 < sum(made.values()) < sum(once.values())
    resumed = solve(case, options, store=tmp_path / "samples.sqlite").result
    assert made == once
    for key in ("theta", "objective", "syntheses", "spent"):
        assert resumed[key] == whole[key], key


def test_the_value_on_measured_lines(tmp_path: Path) -> None:
    """There is no θ and no J; the bandwidth is the largest that the shape allows on the lines."""
    case = measured_case(written(tmp_path))
    assert case is not None
    answer = measured_answer(case, seed=0)[0]
    assert (answer.status, answer.figures["certificate"]["passed"]) == ("verified", True)
    assert answer.controller is not None
    K = StateSpace(*(np.array(answer.controller[name]) for name in "ABCD"))
    (response,) = case.responses
    hz = response.hz
    S = abs(1.0 / (1.0 + response.G * state_response(K, HZ * hz)[:, 0, 0]))
    above = int(np.argmax(S * S > 0.5))
    found = answer.figures["bandwidth_hz"]
    assert found <= hz[above]
    # |S| <= min(S_max, shape of ω/ω_b): kept at this ω_b, not at one a line or two higher
    x = hz / found
    room = np.where(x < 1.0, x, 1.1 * x - 0.1 / x) / np.sqrt(2.0)
    short = S / np.minimum(case.bounds.S_max, room)
    assert short.max() <= 1.0 + 1e-9
    assert short.max() >= 0.98 or hz[above - 1] <= found
    assert answer.figures["sensitivity_peak"] == pytest.approx(S.max(), rel=1e-9)
