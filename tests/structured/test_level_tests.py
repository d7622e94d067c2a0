"""KS, T and GS between the points of a grid: level tests of the judge and of the second engine."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from oracles.fixed_structure_channels import loop as channel_loop
from oracles.fixed_structure_channels import plant as channel_plant
from oracles.fixed_structure_loops import BOUNDS, FAST, loop, plant
from scipy.linalg import block_diag

from ccd_casadi.codesign.verdict import OwnSet, State, survives
from ccd_casadi.fixed_structure import certificate
from ccd_casadi.fixed_structure.bounds import ChannelBounds
from ccd_casadi.fixed_structure.box_proof import NOT_APPLICABLE, Proof, ProofOutcome
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.synthesis.second_engine import SecondEngineOptions, compare_engines, second_opinion

AGREEMENT = SecondEngineOptions().agreement
WIDE = replace(BOUNDS, S_max=50.0, weighted_level=1e6, compliance_max=1.0)


def pair(seed: int) -> tuple[StateSpace, StateSpace]:
    """Case study 1 with a stable random controller, SI."""
    problem, kappa = loop(seed, Structure())
    unit = problem.plants
    si = problem.structure.in_units(kappa, unit.omega_0, unit.force)
    return plant().plant_si(), problem.structure.state_space(si)


def blind(monkeypatch: pytest.MonkeyPatch, share: float = 0.9) -> None:
    """The judge's grid loses every peak but that of S."""
    sought = certificate.peaks

    def lower(*given: Any) -> dict[str, Any]:
        return {name: (value if name == "S" else share * value, at)
                for name, (value, at) in sought(*given).items()}  # fmt: skip

    monkeypatch.setattr(certificate, "peaks", lower)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sampling", [None, FAST])
def test_a_peak_that_the_grid_lost_is_found_by_its_level(
    seed: int, sampling: Sampling | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every figure as with the whole grid; sampled KS and T, and the others are named."""
    G, K = pair(seed)
    whole = certify([G], K, WIDE, sampling)
    blind(monkeypatch)
    found = certify([G], K, WIDE, sampling)
    names = ["KS", "T"] if sampling else ["KS", "T", "GS", "weighted_KS", "weighted_T"]
    for name in names:
        expected = getattr(whole.plants[0], name)
        assert getattr(found.plants[0], name) == pytest.approx(expected, rel=1e-6)
    assert found.grid_only == (("KS", "T", "GS") if sampling else ())
    assert found.worst["GS"] == pytest.approx((0.9 if sampling else 1.0) * whole.worst["GS"])


def test_a_channels_own_force_has_a_level_test(monkeypatch: pytest.MonkeyPatch) -> None:
    model, kappa = channel_loop(0, (0.0,))
    K = model.structure.state_space(model.structure.in_units(
        kappa, model.plants.omega_0, model.plants.force))  # fmt: skip
    own = ChannelBounds("z", (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), M_K=0.5 * WIDE.weights.M_K)
    bounds = replace(WIDE, S_max=1e3, channels=(own,))
    G = channel_plant().plant_si()
    whole = certify([G], K, bounds)
    assert whole.plants[0].stable
    blind(monkeypatch)
    found = certify([G], K, bounds).worst["KS of z"]
    assert found == pytest.approx(whole.worst["KS of z"], rel=1e-6)


@pytest.mark.parametrize("sampling", [None, FAST])
@pytest.mark.parametrize("name", ["KS", "T", "GS"])
def test_the_second_engine_denies_a_false_claim(name: str, sampling: Sampling | None) -> None:
    G, K = pair(1)
    found = second_opinion(G, K, sampling)
    if name == "GS" and sampling is not None:
        assert name not in found.norms  # a product of functions of z and of s
        return
    of = getattr(closed_loop(G, K), name) if sampling is None else None
    true = found.norms[name] if of is None else hinf_norm(of)[0]
    assert not found.contradictions(**{name: true})
    assert found.contradictions(**{name: true * (1.0 - 3.0 * AGREEMENT)})
    assert compare_engines([(found, {name: 0.99 * true})]).agrees is False
    assert compare_engines([(found, {name: float("nan")})]).agrees is False


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e4, 1e8])
def test_the_second_engines_norm_does_not_hang_on_units(scale: float) -> None:
    """SLICOT's search ended 6e-4 short of KS in one scale of its inputs."""
    G, K = pair(2)
    true = hinf_norm(closed_loop(G, K).KS)[0]
    small = replace(K, C=K.C / scale, D=K.D / scale)
    found = second_opinion(replace(G, B=scale * G.B), small).norms["KS"]
    assert scale * found == pytest.approx(true, rel=1e-7)


@pytest.mark.parametrize("outcome", list(ProofOutcome))
def test_what_no_proof_covers_is_not_passed(outcome: ProofOutcome) -> None:
    """A proof that does not apply or leaves bounds out says so, and its line is not passed."""
    for left in ("", "bounds of single channels are judged, not proven"):
        proof = Proof(outcome, 1e-3, ("shift",), {"KS": 1.0}, left=left, point=(0.1,),
                      exceeded=("KS", 1.1))  # fmt: skip
        assert bool(proof.unproven) == (bool(left) or outcome in NOT_APPLICABLE)
        if proof.unproven and (proof.stable or outcome in NOT_APPLICABLE):
            assert "not proven" in proof.words
            assert proof.unproven in proof.words
        assert ("proven for the whole box" in proof.words) == proof.proven
    assert survives(None, S_max=2.0, own=OwnSet.SEARCHED).state is State.UNKNOWN


@pytest.mark.parametrize("resonance_hz", [300.0, 620.0])
def test_a_compliance_that_a_resonance_beyond_half_the_rate_exceeds_is_said_with_its_frequency(
    resonance_hz: float,
) -> None:
    """Sampled at 1 kHz a mode at 620 Hz answers to the loop as one at 380 Hz, to a force at 620."""
    w, low, zeta, mass = 2.0 * np.pi * resonance_hz, 2.0 * np.pi * 100.0, 1e-3, 25.0
    A = block_diag([[0.0, 1.0], [-(low**2), -0.6 * low]], [[0.0, 1.0], [-(w**2), -2.0 * zeta * w]])
    B, C = np.array([[0.0, 1.0, 0.0, 1.0]]).T, np.array([[1.0 / mass, 0.0, 0.3 / mass, 0.0]])
    K = StateSpace(*(np.array([[part]]) for part in (0.0, 1.0, 1e4, 0.0)))
    bounds = replace(WIDE, compliance_max=1e-9)
    found = certify([StateSpace(A, B, C, np.zeros((1, 1)))], K, bounds, Sampling(1e3))
    G = 0.3 / mass / (2.0 * zeta * w**2)  # the mode's own answer at its resonance
    if resonance_hz < 500.0:
        assert found.plants[0].GS_beyond == 0.0
        assert "beyond half" not in found.words
    else:
        assert found.plants[0].GS_beyond == pytest.approx(w, rel=1e-3)
        assert found.plants[0].GS < 1.1 * G
        assert "620 Hz, at a resonance beyond half the sampling rate" in found.words
