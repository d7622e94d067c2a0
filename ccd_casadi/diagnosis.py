"""What is wrong, or worth knowing, with a plant before anything is designed for it.

A plant is looked at in the start of θ, the middle and the corners of the box. Errors are what no
design can be made with; warnings what a designer must know; notes what explains the bandwidth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from itertools import product

import numpy as np

from ccd_casadi.kernels.frequency import prepare, response
from ccd_casadi.modal import ModalPlant, Suspension, modal_plant
from ccd_casadi.plant import Array, Plant, PlantError, mechanics, theta_words
from ccd_casadi.problem import CoDesignProblem, plant_of
from ccd_casadi.scaling import ScaledPlant, scale_plant, transmission_zeros

HZ = 2.0 * np.pi
MAX_CORNERS = 16
HIDDEN = 1e-6  # a mode whose gain is below this share of the largest is not driven, or measured
COUPLED = 1e-9  # a share of the modes' own damping above which a damper connects modes
LIGHT = 0.3  # damping ratio below which a zero is a dip in the frequency response


class Severity(StrEnum):
    """How much a finding matters."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class Topic(StrEnum):
    """What a finding is about."""

    MATRICES = "matrices"
    RIGID_MODES = "rigid modes"
    HIDDEN_MODE = "hidden mode"
    ZERO = "transmission zero"
    DOMAIN = "domain"
    EFFORT = "control effort"


@dataclass(frozen=True)
class Finding:
    """One sentence about the plant; `index` of the θ where it was seen, among those looked at."""

    severity: Severity
    topic: Topic
    words: str
    index: int


@dataclass(frozen=True)
class Mode:
    """One mode of the undamped plant; driven and measured: its gains over the largest."""

    frequency_hz: float
    damping_ratio: float
    rigid: bool
    driven: float
    measured: float


@dataclass(frozen=True)
class Zero:
    """A transmission zero: |z| in Hz, its damping ratio (negative: right half-plane), and its dip.

    `dip`: the plant's least gain at |z| over its geometric mean at 0.7 and 1.4 times |z|.
    """

    frequency_hz: float
    damping_ratio: float
    dip: float


@dataclass(frozen=True)
class PlantFacts:
    """A plant at one θ. `effort_hz`: where M_K σ_r(G) first falls below 1; nan if nowhere.

    σ_r is the r-th singular value, r the number of rigid-body modes where there are fewer of them
    than inputs and outputs: what is held by a spring anyway needs no force at low frequency.
    """

    theta: tuple[float, ...]
    modes: tuple[Mode, ...]
    zeros: tuple[Zero, ...]
    effort_hz: float


def points_to_check(problem: CoDesignProblem) -> list[tuple[float, ...]]:
    """Start, middle, and the corners of the box, of which at most 16 (drawn with a fixed seed)."""
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    n = len(lower)
    if n <= np.log2(MAX_CORNERS):
        sides = np.array(list(product((0.0, 1.0), repeat=n)))
    else:
        sides = np.random.default_rng(0).integers(0, 2, (MAX_CORNERS, n)).astype(float)
    corners = lower + (upper - lower) * sides
    rows = [problem.start, 0.5 * (lower + upper), *corners]
    return list(dict.fromkeys(tuple(float(value) for value in row) for row in rows))


@lru_cache(maxsize=4)
def diagnose(
    problem: CoDesignProblem, rigid_modes: int | None = None
) -> tuple[tuple[PlantFacts, ...], tuple[Finding, ...]]:
    """Facts and findings of the problem's plant over its box; `rigid_modes` are expected if given.

    Facts are of the points where the matrices are those of a plant, in the order of
    `points_to_check`. Raises PlantError where the model's function fails.
    """
    plant = plant_of(problem)
    facts: list[PlantFacts] = []
    findings = list(_outside(problem, plant))
    if findings:
        return (), tuple(findings)
    for index, theta in enumerate(points_to_check(problem)):
        place = f"at theta = {theta_words(plant, theta)}" if index else "at the start"
        try:
            system = mechanics(plant, theta, derivatives=index == 0)
            modal = modal_plant(system, problem.suspension)
            scaled = scale_plant(modal, problem.weights.M_K)
        except PlantError as error:
            words = str(error) if "at theta" in str(error) else f"{error} {place}"
            findings.append(Finding(Severity.ERROR, Topic.MATRICES, words, index))
            continue
        effort = _effort_hz(modal, scaled)
        found = PlantFacts(theta, _modes(modal), _zeros(scaled, effort), effort)
        findings += _rigid(found, modal, problem.suspension, rigid_modes, index, place)
        findings += _hidden(modal, index, place)
        findings += _about_zeros(found, problem.inner.S_max, index)
        facts.append(found)
    counts = sorted({sum(mode.rigid for mode in item.modes) for item in facts})
    if len(counts) > 1 and rigid_modes is None:
        words = (
            f"from {counts[0]} to {counts[-1]} rigid-body modes over the bounds of theta: a mode "
            "that is free at one theta and held at another has no derivative between; narrow the "
            "bounds, or hold it everywhere"
        )
        findings.append(Finding(Severity.WARNING, Topic.RIGID_MODES, words, 0))
    return tuple(facts), tuple(findings)


def first_seen(findings: Sequence[Finding]) -> list[Finding]:
    """The findings at the first θ where their topic comes up, the serious first.

    What holds at one θ mostly holds, with other numbers, at the others too.
    """
    first: dict[tuple[Topic, Severity], int] = {}
    for item in findings:
        first.setdefault((item.topic, item.severity), item.index)
    kept = [item for item in findings if item.index == first[item.topic, item.severity]]
    return sorted(kept, key=lambda item: list(Severity).index(item.severity))


def _outside(problem: CoDesignProblem, plant: Plant) -> list[Finding]:
    if plant.domain is None:
        return []
    found = []
    box = zip(problem.names, problem.lower, problem.upper, *plant.domain, strict=True)
    for name, low, high, least, most in box:
        slack = 1e-9 * (most - least)
        if low < least - slack or high > most + slack:
            words = (
                f"theta.{name}: its bounds {low:g} to {high:g} go beyond the model's samples, "
                f"{least:g} to {most:g}; narrow them, or add samples"
            )
            found.append(Finding(Severity.ERROR, Topic.DOMAIN, words, 0))
    return found


def _modes(modal: ModalPlant) -> tuple[Mode, ...]:
    b = np.linalg.norm(modal.B, axis=1)
    c = np.linalg.norm(modal.C, axis=0)
    zeta = np.diag(modal.D) / (2.0 * np.sqrt(np.diag(modal.K)))
    return tuple(
        Mode(float(w) / HZ, float(z), bool(r), float(drive), float(seen))
        for w, z, r, drive, seen in zip(
            modal.natural, zeta, modal.rigid, b / b.max(), c / c.max(), strict=True
        )
    )


def _clusters(modal: ModalPlant) -> list[np.ndarray]:
    """Modes of one frequency, whose shapes are one space; the rigid ones are one."""
    groups: list[list[int]] = []
    for i, w in enumerate(modal.natural):
        last = groups[-1][-1] if groups else None
        same = last is not None and (
            (modal.rigid[i] and modal.rigid[last])
            or (not modal.rigid[last] and w - modal.natural[last] <= HIDDEN * w)
        )
        if same:
            groups[-1].append(i)
        else:
            groups.append([i])
    return [np.array(group) for group in groups]


def _hidden(modal: ModalPlant, index: int, place: str) -> list[Finding]:
    """Directions of each eigenspace that no input drives, or no output measures (rank of B, C)."""
    D = np.abs(modal.D - np.diag(np.diag(modal.D)))
    coupled = (COUPLED * np.diag(modal.D).max() < D).any(axis=1)
    found = []
    for group in _clusters(modal):
        if coupled[group].any():
            continue  # a damper hands its motion on to others
        lacks = [
            name
            for name, gains in (("driven", modal.B), ("measured", modal.C.T))
            if np.linalg.matrix_rank(gains[group], tol=HIDDEN * np.abs(gains).max()) < len(group)
        ]
        if not lacks:
            continue
        missing = "not " + " and not ".join(lacks)
        if modal.rigid[group[0]]:
            words = (
                f"of {len(group)} rigid-body motions {place} one or more are {missing}: the "
                "suspension alone holds them; add an input or output, or take them out of the model"
            )
        else:
            formal = {"driven": "uncontrollable", "measured": "unobservable"}
            words = (
                f"the mode at {modal.natural[group[0]] / HZ:.5g} Hz {place} is {missing} "
                f"({', '.join(formal[name] for name in lacks)}): no controller damps it, and S "
                "does not show it"
            )
        found.append(Finding(Severity.WARNING, Topic.HIDDEN_MODE, words, index))
    return found


def _rigid(
    facts: PlantFacts,
    modal: ModalPlant,
    suspension: Suspension,
    expected: int | None,
    index: int,
    place: str,
) -> list[Finding]:
    count = int(modal.rigid.sum())
    flexible = modal.natural[~modal.rigid] / HZ
    least = f"; the lowest frequency is {flexible[0]:.4g} Hz" if flexible.size else ""
    if expected is not None and count != expected:
        words = (
            f"{count} rigid-body modes {place}, where suspension.rigid_modes expects "
            f"{expected}{least}; mend the stiffness (K v = 0 for a rigid-body motion v), or "
            "suspension.rigid_modes"
        )
        return [Finding(Severity.ERROR, Topic.RIGID_MODES, words, index)]
    slow = flexible[flexible < 10.0 * suspension.frequency_hz]
    if count and slow.size:
        words = (
            f"a flexible mode at {slow[0]:.3g} Hz {place} lies next to the suspension's "
            f"{suspension.frequency_hz:g} Hz: is it a rigid-body mode that K holds by mistake?"
        )
        return [Finding(Severity.WARNING, Topic.RIGID_MODES, words, index)]
    return []


def _effort_hz(modal: ModalPlant, plant: ScaledPlant) -> float:
    """The first frequency at which M_K σ_r(G) falls through 1."""
    order = min(plant.B.shape[1], plant.C.shape[0])
    order = min(order, int(modal.rigid.sum()) or order)
    G = prepare(plant.A, plant.B, plant.C)
    grid = plant.grid[plant.grid > 1e-4]
    gain = np.array(
        [np.linalg.svd(response(G, w), compute_uv=False)[order - 1] for w in grid]
    ).clip(1e-300)
    below = np.flatnonzero((gain[1:] < 1.0) & (gain[:-1] >= 1.0))
    if not below.size:
        return float("nan")
    i = int(below[0])
    x, y = np.log(grid[i : i + 2]), np.log(gain[i : i + 2])
    return float(np.exp(x[0] - y[0] * (x[1] - x[0]) / (y[1] - y[0])) * plant.omega_0 / HZ)


def _zeros(plant: ScaledPlant, effort_hz: float) -> tuple[Zero, ...]:
    """Zeros up to three times the frequency at which effort ends, one of each conjugate pair."""
    limit = 3.0 * effort_hz * HZ / plant.omega_0
    found = []
    for zero in transmission_zeros(plant.A, plant.B, plant.C):
        size = abs(zero)
        if zero.imag < 0.0 or not 1e-3 * limit < size < limit:
            continue
        gain = np.exp(
            np.interp(np.log(size * np.array([0.7, 1.0, 1.4])), np.log(plant.grid), _log(plant))
        )
        dip = gain[1] / np.sqrt(gain[0] * gain[2])
        damping = -zero.real / size
        found.append(Zero(float(size * plant.omega_0 / HZ), float(damping), float(dip)))
    return tuple(sorted(found, key=lambda zero: zero.frequency_hz))


def _log(plant: ScaledPlant) -> Array:
    return np.asarray(np.log(np.maximum(plant.gain, 1e-300)))


def _about_zeros(facts: PlantFacts, S_max: float, index: int) -> list[Finding]:
    found = []
    for zero in facts.zeros:
        z = zero.frequency_hz
        if zero.damping_ratio < -1e-9:
            words = (
                f"a transmission zero in the right half-plane at {z:.4g} Hz: with a peak of S of "
                f"{S_max:g} no controller has a bandwidth much above {z * (1 - 1 / S_max):.3g} Hz "
                "(z (1 - 1/S_max)); move sensor and actuator closer together"
            )
            severe = z < 2.0 * facts.effort_hz
            severity = Severity.WARNING if severe else Severity.NOTE
            found.append(Finding(severity, Topic.ZERO, words, index))
        elif zero.damping_ratio < LIGHT:
            words = (
                f"a transmission zero at {z:.4g} Hz, damping {100 * zero.damping_ratio:.2g} %: the "
                f"plant's gain falls to {100 * zero.dip:.2g} % of its surroundings, and so much "
                f"more force is needed there; |S| returns to about 1, so ω_b stays below {z:.4g} "
                "Hz unless M_K pays for it"
            )
            found.append(Finding(Severity.NOTE, Topic.ZERO, words, index))
    return found
