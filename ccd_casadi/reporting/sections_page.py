"""The run report of a controller of fixed structure: its sections, and every plant's loop."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import expm

from ccd_casadi.fixed_structure import Sampling
from ccd_casadi.fixed_structure.composite import CompositeProblem, largest_gains
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.figures import Problem, evaluate
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_bandwidth import bounds_of, plants_of, sections_of_problem
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.reporting.facts import Fact, binding, theta_table, theta_words
from ccd_casadi.reporting.lines import Band, Curve, Level, Panel, figure_lines
from ccd_casadi.reporting.page import (
    Section,
    Table,
    escape,
    facts_html,
    figure_html,
    number,
    paragraph,
    table_html,
)
from ccd_casadi.reporting.svg import BLUE, GREEN, GREY, ORANGE
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

if TYPE_CHECKING:
    from ccd_casadi.codesign.run import Solution
    from ccd_casadi.codesign.sections_run import VerifiedSections

POINTS = 700
ROWS = 40  # of the tables
SETTLED = 4.0  # time constants of the slowest pole that the force step is shown for
STEPS = 200  # points of it


@dataclass(frozen=True)
class Loops:
    """S, KS (N/m), T and L of every plant (rows) over Hz.

    Of several channels the largest singular values, and no L.
    """

    hz: Array
    S: np.ndarray
    KS: np.ndarray
    T: np.ndarray
    L: np.ndarray


def sections_conclusion(result: dict[str, Any]) -> str:
    """One sentence with the key numbers."""
    certificate, robust = result["certificate"], result["robust"]
    verdict = "a verified design" if result["status"] == "verified" else "an UNVERIFIED design"
    return (
        f"The {result['formulation']} formulation ends at {verdict}, {theta_words(result)}: a "
        f"controller of order {result['controller']['order']} with a bandwidth of "
        f"{number(result['bandwidth_hz'])} Hz on each of {certificate['plants']} plants, judged "
        f"again on {robust['plants']} plants of the box, at a hardware cost of "
        f"{number(result['hardware_cost'])} (J = {number(result['objective'], 6)})."
    )


def sections_sections(problem: CoDesignProblem, solution: "Solution") -> list[Section]:
    """What the page shows between its head and its provenance."""
    verified = solution.sections
    assert verified is not None
    loops = loops_of(verified)
    found = [
        _design(problem, solution.result),
        Section("The controller", _controller(solution.result)),
        Section("Closed loop on every plant", _gains(problem, verified, loops)),
    ]
    if len(loops.L):  # of one channel
        body = _nyquist(problem, verified, loops)
        found.append(Section("Nyquist plot and a step of force", body))
    return found


def loops_of(verified: "VerifiedSections") -> Loops:
    """The loops of all plants of the set, hold and delay exact where they are sampled."""
    problem, made = verified.problem, verified.design
    sampling = sections_of_problem(problem).sampling
    inside = problem_for(
        plants_of(problem, verified.theta),
        made.structure,
        bounds_of(problem),
        sampling,
        made.frequencies,
    )
    P = inside.plants
    poles = P.poles
    if isinstance(inside, CompositeProblem):
        poles = np.concatenate([part.problem.plants.poles.ravel() for part in inside.parts])
    low = 0.2 * problem.inner.omega_low
    high = 20.0 * float(np.abs(poles).max()) * P.omega_0
    if sampling is not None:
        high = min(high, 0.98 * np.pi / sampling.period)
    near = np.abs(poles.imag) + np.abs(poles.real) * np.linspace(-12, 12, 97).reshape(
        -1, *[1] * poles.ndim
    )
    omega = np.concatenate([np.geomspace(low, high, POINTS), near.ravel() * P.omega_0])
    omega = np.unique(omega[(omega >= low) & (omega <= high)])
    v = P.variable(omega / P.omega_0)
    kappa = in_problem_units(inside, made.kappa)
    if isinstance(inside, CompositeProblem):
        S, KS, T = largest_gains(inside, kappa, v)
        return Loops(omega / HZ, S, KS * P.force, T, np.zeros((0, len(v))))
    assert isinstance(inside, Problem)
    which, grid = np.meshgrid(np.arange(len(P.plants)), v, indexing="ij")
    tau = float(np.log(made.bandwidth / P.omega_0))
    found = evaluate(inside, kappa, tau, which, grid, order=0)
    L = 1.0 / found.S - 1.0
    return Loops(omega / HZ, found.S, found.K * P.force * found.S, 1.0 - found.S, L)


def _design(problem: CoDesignProblem, result: dict[str, Any]) -> Section:
    items = "".join(f"<li>{escape(words)}</li>" for words in _binds(problem, result))
    body = (
        table_html(theta_table(problem, result))
        + facts_html(_facts(problem, result))
        + (f"\n<h3>What binds</h3>\n<ul>{items}</ul>" if items else "")
        + "".join(paragraph(f"Note: {words}.") for words in result.get("notes", ()))
    )
    return Section("The design", body)


def _binds(problem: CoDesignProblem, result: dict[str, Any]) -> list[str]:
    over_theta = binding(problem, {**result, "active": []})
    mu = result["controller"]["multipliers"]
    names = {"S_MAX": "the peak of S", "SHAPE": "the shape of S below ω_b", "S_LOW": "|S| at ω_low",
             "KS": "|W_KS KS|", "T": "|W_T T|", "GS": "the compliance"}  # fmt: skip
    over_kappa = [
        f"{words} binds; a bound looser by 1 % would raise ω_b by {number(mu[name], 3)} %"
        for name, words in names.items()
        if mu.get(name, 0.0) > 1e-6
    ]
    ends = [f"{words} of its range" for words in result["controller"]["at_range"]]
    return [*over_theta, *over_kappa, *ends]


def _facts(problem: CoDesignProblem, r: dict[str, Any]) -> list[Fact]:
    certificate, robust, inner = r["certificate"], r["robust"], problem.inner
    optima = ", ".join(f"{number(o['bandwidth_hz'], 5)} Hz ({o['searches']}×)" for o in r["race"])
    sampling = sections_of_problem(problem).sampling
    runs = "continuous" if sampling is None else (
        f"{number(sampling.rate_hz)} Hz, {number(sampling.delay_us)} µs from measurement to force"
    )  # fmt: skip
    worst = f"largest of {robust['plants']} plants of the box"
    kkt = r["kkt"]["stationarity"]
    return [
        ("Objective J", number(r["objective"], 7), f"{problem.w1:g} f(θ) + ({problem.w2:g}) ω_b"),
        ("Hardware cost f(θ)", number(r["hardware_cost"], 6), ""),
        ("Bandwidth ω_b", f"{number(r['bandwidth_hz'], 6)} Hz", "on every plant of the set"),
        ("Predicted bandwidth", f"{number(r['surrogate_bandwidth_hz'], 6)} Hz",
         f"relative error {number(r['verification_error'], 2)}"),
        ("Loop", runs, ""),
        ("Peak of sensitivity", number(r["sensitivity_peak"], 6),
         f"at {number(r['sensitivity_peak_hz'], 4)} Hz; S_max = {inner.S_max:g}"),
        ("Peak of S over the box", number(robust["worst_sensitivity_peak"], 6), worst),
        (f"|S| at {number(inner.omega_low / HZ)} Hz", number(r["sensitivity_low"], 4),
         f"S_low = {inner.S_low:g}"),
        ("Compliance |GS|", f"{number(1e6 * r['compliance_max'], 4)} µm/N",
         f"at most; at the lowest frequencies {number(1e6 * r['static_compliance'], 4)} µm/N"),
        ("Largest |KS|", f"{number(r['KS_max'], 4)} N/m", ""),
        ("Certificate", "passed" if certificate["passed"] else "FAILED",
         f"poles left of {number(certificate['max_real_pole'], 4)} 1/s on {certificate['plants']} "
         f"plants, at most {number(certificate['norm'], 6)} of a bound"),
        ("Over the box", "passed" if robust["passed"] else "FAILED",
         f"{robust['words']}; the worst that was searched is {100 * robust['worst_excess']:+.2g} % "
         "of a bound. Between the plants that were looked at nothing is proven"),
        ("Optimality (KKT residual)", number(kkt, 2),
         f"over θ; {number(r['controller']['kkt_residual'], 2)} over the controller"),
        ("A full race at this θ", optima or "–",
         f"local optima (searches); {r['rounds']} rounds of the outer problem"),
        ("Price", f"{r['syntheses']} syntheses", f"{number(r['seconds'], 3)} s"),
    ]  # fmt: skip


def _controller(result: dict[str, Any]) -> str:
    controller = result["controller"]
    rows = tuple(
        (s["kind"], s["zero_hz"], s["zero_damping"], s["pole_hz"], s["pole_damping"])
        for s in controller["sections"]
    )
    head = ("section", "zero Hz", "zero ζ", "pole Hz", "pole ζ")
    gains = (
        f"Gain {number(controller['gain'], 6)} N/m"
        if "gain" in controller
        else ", ".join(
            f"{channel['name']}: gain {number(channel['gain'], 6)} N/m"
            for channel in controller["channels"]
        )
    )
    words = (
        f"{gains}, order {controller['order']}, stable but for "
        "the integrator, every section of gain 1 at s = 0 (the integrator's: at high frequency)."
    )
    return paragraph(words) + table_html(Table(head, rows))


def _gains(problem: CoDesignProblem, verified: "VerifiedSections", loops: Loops) -> str:
    inner, bandwidth = problem.inner, verified.design.bandwidth / HZ
    x = (float(loops.hz[0]), float(loops.hz[-1]))

    def panel(label: str, gains: np.ndarray, levels: Sequence[Level]) -> Panel:
        size = np.abs(gains)
        band = Band(loops.hz, size.min(axis=0), size.max(axis=0), "all plants")
        curve = Curve(loops.hz, size[0], "the model")
        return Panel("frequency (Hz)", label, (curve,), (band,), levels=tuple(levels), log_x=True,
                     log_y=True, x_range=x, legend="lower right")  # fmt: skip

    at = Level(bandwidth, f"ω_b {number(bandwidth, 4)} Hz", True)
    S = panel("|S| (–)", loops.S, (Level(inner.S_max, f"S_max {inner.S_max:g}", colour=GREY),
              Level(2**-0.5, "-3 dB", colour=GREY), at))  # fmt: skip
    KS, T = panel("|KS| (N/m)", loops.KS, (at,)), panel("|T| (–)", loops.T, (at,))
    svg = figure_lines([[S], [KS, T]], key="sections-loop", heights=(3.4, 2.6),
                       title="S, KS and T of every plant of the set over frequency")  # fmt: skip
    rows = [int(np.abs(loops.hz - f).argmin()) for f in np.geomspace(*x, ROWS)]
    table = Table(
        ("Hz", "|S| model", "|S| least", "|S| largest", "|KS| largest N/m", "|T| largest"),
        tuple(
            (float(loops.hz[i]), float(abs(loops.S[0, i])), float(np.abs(loops.S[:, i]).min()),
             float(np.abs(loops.S[:, i]).max()), float(np.abs(loops.KS[:, i]).max()),
             float(np.abs(loops.T[:, i]).max()))
            for i in sorted(set(rows))
        ),
    )  # fmt: skip
    return figure_html(svg, f"The band spans {len(loops.S)} plants of the set.", table)


def _nyquist(problem: CoDesignProblem, verified: "VerifiedSections", loops: Loops) -> str:
    S_max = problem.inner.S_max
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    disk = -1.0 + np.exp(1j * angle) / S_max
    curves = [Curve(line.real, line.imag, colour=GREEN if i else BLUE, width=1.0 if i else 1.5)
              for i, line in reversed(list(enumerate(loops.L)))]  # fmt: skip
    curves.append(Curve(disk.real, disk.imag, f"|S| = S_max = {S_max:g}", ORANGE))
    nyquist = Panel("Re L", "Im L", tuple(curves), x_range=(-3.0, 1.0), y_range=(-1.75, 1.75),
                    legend="upper right")  # fmt: skip
    certificate = verified.design.certificate
    assert certificate is not None
    assert verified.design.controller is not None
    sampling = sections_of_problem(verified.problem).sampling
    slow = min(-plant.stability for plant in certificate.plants)
    if sampling is not None:
        slow = -float(np.log1p(-slow)) / sampling.period
    times = np.geomspace(0.02 / verified.design.bandwidth, SETTLED / slow, STEPS)
    plants = plants_of(verified.problem, verified.theta)
    steps = [force_step(p, verified.design.controller, sampling, times) for p in plants]
    t = steps[0][0]
    y = 1e6 * np.array([step[1] for step in steps])
    step = Panel("time (ms)", "y after a step of 1 N (µm)", (Curve(1e3 * t, y[0], "the model"),),
                 (Band(1e3 * t, y.min(axis=0), y.max(axis=0), "all plants"),), log_x=True,
                 legend="upper left")  # fmt: skip
    svg = figure_lines([[nyquist, step]], key="sections-nyquist", heights=(3.9,),
                       title="Nyquist plot of every plant, and a step of force")  # fmt: skip
    rows = np.unique(np.linspace(0, len(t) - 1, ROWS).astype(int))
    table = Table(("ms", "µm model", "µm least", "µm largest"), tuple(
        (1e3 * float(t[i]), float(y[0, i]), float(y[:, i].min()), float(y[:, i].max()))
        for i in rows))  # fmt: skip
    words = "L = GK of every plant stays outside the disk of S_max around -1. "
    return figure_html(svg, words + "The step of force acts at the actuator.", table)


def force_step(
    plant: ScaledPlant, K: StateSpace, sampling: Sampling | None, times: Array
) -> tuple[Array, Array]:
    """Times in s near the given ones, and y in m after a step of 1 N, exact at them.

        y_n = C (I - A)⁻¹ (I - Aⁿ) B

    of the loop over one step: a period, or where the loop is continuous the first of the times.
    """
    step = float(times[0]) if sampling is None else sampling.period
    A, B, C = _over_a_step(plant.plant_si(), K, sampling, step)
    counts = np.unique(np.maximum(np.round(times / step), 1.0).astype(int))
    final = np.linalg.solve(np.eye(len(A)) - A, B)
    y = [float(C @ (final - np.linalg.matrix_power(A, int(n)) @ final)) for n in counts]
    return np.asarray(step * counts, float), np.array(y)


def _over_a_step(
    G: StateSpace, K: StateSpace, sampling: Sampling | None, T: float
) -> tuple[Array, Array, Array]:
    """The loop from a force to y in discrete time, the delay's whole periods and rest exact.

    u_k reaches the plant after the delay: over the first part of a period an older one still acts.
    """
    n, m = len(G.A), len(K.A)
    if sampling is None:
        A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
        A, B = _held(A, np.vstack([G.B, np.zeros((m, 1))]), T)
        return A, B[:, 0], np.append(G.C[0], np.zeros(m))
    whole = int(np.floor(sampling.delay / T + 1e-9))
    rest = max(sampling.delay - whole * T, 0.0)
    first, second = _held(G.A, G.B, rest), _held(G.A, G.B, T - rest)
    inverse = np.linalg.inv(np.eye(m) - 0.5 * T * K.A)  # Tustin
    Ak, Bk = inverse @ (np.eye(m) + 0.5 * T * K.A), T * inverse @ K.B
    Ck, Dk = K.C @ inverse, K.D + 0.5 * T * K.C @ inverse @ K.B

    def moved(state: Array, force: float) -> Array:
        x, k, old = state[:n], state[n : n + m], state[n + m :]
        e = -G.C @ x
        u = np.concatenate([Ck @ k + Dk @ e, old])  # u_k, u_{k-1}, …
        x = first[0] @ x + first[1][:, 0] * (u[whole + 1] + force)
        x = second[0] @ x + second[1][:, 0] * (u[whole] + force)
        return np.concatenate([x, Ak @ k + Bk @ e, u[:-1]])

    size = n + m + whole + 1
    A = np.array([moved(row, 0.0) for row in np.eye(size)]).T
    return A, moved(np.zeros(size), 1.0), np.append(G.C[0], np.zeros(size - n))


def _held(A: Array, B: Array, T: float) -> tuple[Array, Array]:
    n = len(A)
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n:] = A, B
    whole = expm(T * joint)
    return whole[:n, :n], whole[:n, n:]
