"""Plants to test on, and the independent reference: frequency responses formed in SI.

The reference takes nothing from the package but the matrices M, D, K, B, C: suspension and modal
damping come from matrix square roots, loops from dense solves at each frequency.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import casadi as ca
import control
import numpy as np
from scipy.linalg import sqrtm
from scipy.optimize import brentq, minimize_scalar

from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sweep import InnerBounds
from ccd_casadi.kernels.certified_design import judge
from ccd_casadi.kernels.sensitivity import Column
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics, Plant, build_plant, mechanics
from ccd_casadi.plants.registry import two_mass_plant
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.synthesis.synthesis import DesignFigures, figures_from_row
from ccd_casadi.synthesis.weights import Weights
from oracles.draws import few as few

Array = np.ndarray
HZ = 2.0 * np.pi
OMEGA_LOW = 1.0 * HZ
SUSPENSION = Suspension()
# Rounding K alone moves a rigid-body mode by eps·(ω_max/ω_r)²: comparisons between dense
# matrices to 1e-9 need it nearer to the flexible modes than the default 0.1 Hz.
STIFF_SUSPENSION = Suspension(2.0, 0.7)

PAPER = Weights(
    M_S=2.0, A_S=1e-4, omega_S=800.0 * HZ, c_K=1e4, omega_K=100.0 * HZ, M_K=2e7,
    A_l=1.0, A_u=1e-2, omega_T=40.0 * HZ,
)  # fmt: skip
INNER = InnerBounds(
    S_max=1.75,
    S_low=0.03,
    omega_low=OMEGA_LOW,
    omega_S=(10.0 * HZ, 1800.0 * HZ),
    omega_T=(25.0 * HZ, 1000.0 * HZ),
)


def problem(**changes: object) -> CoDesignProblem:
    """The co-design problem of the two-mass case file."""
    values = {
        "source": PlantSource("two_mass", None, None, (("zeta", 0.01),)),
        "names": ("m1", "m2"),
        "units": ("kg", "kg"),
        "lower": (55.0, 55.0),
        "upper": (70.0, 70.0),
        "start": (67.56, 67.56),
        "w1": 0.0995,
        "w2": -0.9950,
        "weights": PAPER,
        "inner": INNER,
        "suspension": SUSPENSION,
    }
    return CoDesignProblem(**(values | changes))


@cache
def two_mass_model() -> Plant:
    return two_mass_plant(("m1", "m2"))


def two_mass(m1: float, m2: float, M_K: float = 2e7) -> ScaledPlant:
    return scaled(mechanics(two_mass_model(), (m1, m2)), M_K)


def scaled(system: Mechanics, M_K: float, suspension: Suspension = SUSPENSION) -> ScaledPlant:
    return scale_plant(modal_plant(system, suspension), M_K)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# ---- random mechanical systems ---------------------------------------------------------------


def random_model(
    seed: int, *, rigid: int, flexible: int, inputs: int, outputs: int, parameters: int = 2,
    modal: bool = True,
) -> Callable[..., dict]:  # fmt: skip
    """A model in dense coordinates whose matrices are smooth functions of θ in about [0, 1].

    The rigid-body modes stay rigid at every θ; with `modal` False it has its own damper.
    """
    rng = np.random.default_rng(seed)
    n = rigid + flexible
    u, _, v = np.linalg.svd(rng.normal(size=(n, n)))
    T = (u * rng.uniform(0.5, 2.0, n)) @ v
    hz = np.exp(rng.uniform(np.log(20.0), np.log(300.0), flexible))
    stiffness = np.concatenate([np.zeros(rigid), (HZ * hz) ** 2])
    slope = rng.uniform(-0.3, 0.3, (parameters, n))
    masses = [0.1 * _positive(rng, n) for _ in range(parameters)]
    B0, C0 = rng.normal(size=(n, inputs)), rng.normal(size=(outputs, n))
    dB, dC = 0.2 * rng.normal(size=(n, inputs)), 0.2 * rng.normal(size=(outputs, n))
    zeta = float(rng.uniform(0.005, 0.03))

    def model(theta: dict) -> dict:
        t = [theta[f"p{i}"] for i in range(parameters)]
        k = sum((slope[i] * t[i] for i in range(parameters)), start=0.0)
        K = ca.DM(T.T) @ ca.diag(stiffness * ca.exp(k)) @ ca.DM(T)
        M = ca.DM(T.T @ T) + sum(ca.DM(masses[i]) * t[i] ** 2 for i in range(parameters))
        out = {
            "mass": 0.5 * (M + M.T),
            "stiffness": 0.5 * (K + K.T),
            "input": ca.DM(B0) + ca.DM(dB) * ca.sin(t[0]),
            "output": ca.DM(C0) + ca.DM(dC) * t[-1],
            "hardware_cost": sum(t),
        }
        if modal:
            return out | {"damping_ratio": zeta}
        return out | {"damping": 1e-4 * out["stiffness"] * (1 + t[0])}

    return model


def _positive(rng: np.random.Generator, n: int) -> Array:
    R = rng.normal(size=(n, n))
    return R @ R.T / n


def random_plant(seed: int, **shape: int | bool) -> Plant:
    count = int(shape.get("parameters", 2))
    return build_plant(random_model(seed, **shape), [f"p{i}" for i in range(count)], {})


@dataclass(frozen=True)
class FlexibleCase:
    """A 3 x 3 plant of 26 states, near-collocated, with its weights."""

    plant: ScaledPlant
    model: Plant
    weights: Weights
    theta: tuple[float, float]


def flexible_model(seed: int) -> tuple[Plant, np.random.Generator]:
    """3 rigid and 10 flexible modes of 150 to 1500 Hz, B = Cᵀ + κ·noise; θ moves all of them."""
    rng = np.random.default_rng(seed)
    n = 13
    hz = np.concatenate([np.zeros(3), np.sort(rng.uniform(150.0, 1500.0, 10))])
    C = rng.normal(size=(3, n))
    B = C.T + rng.choice([0.0, 0.05, 0.3]) * rng.normal(size=(n, 3))
    to_k, coupling = rng.uniform(-0.2, 0.2, n), 0.1 * _positive(rng, n)
    dC = 0.1 * rng.normal(size=(3, n))

    def model(theta: dict) -> dict:
        a, b = theta["a"], theta["b"]
        return {
            "mass": 20.0 * (ca.DM.eye(n) + ca.DM(coupling) * (b - 1.0)),
            "stiffness": ca.diag(20.0 * (HZ * hz) ** 2 * ca.exp(ca.DM(to_k) * (a - 1.0))),
            "damping_ratio": 0.01,
            "input": ca.DM(B),
            "output": ca.DM(C) + ca.DM(dC) * (a - 1.0) * b,
            "hardware_cost": a + b,
        }

    return build_plant(model, ("a", "b"), {}), rng


def flexible_case(seed: int) -> FlexibleCase:
    model, rng = flexible_model(seed)
    M_K = float(10.0 ** rng.uniform(4.0, 7.5))
    weights = Weights(
        M_S=2.0, A_S=1e-4, omega_S=log_uniform(rng, 10.0, 2000.0) * HZ, c_K=1e4,
        omega_K=100.0 * HZ, M_K=M_K, A_l=1.0, A_u=1e-2,
        omega_T=log_uniform(rng, 20.0, 2000.0) * HZ,
    )  # fmt: skip
    theta = (1.0, 1.0)
    return FlexibleCase(scaled(mechanics(model, theta), M_K), model, weights, theta)


# ---- any controller, assessed as our own -----------------------------------------------------


def in_time_unit(system: StateSpace, omega_0: float, force: float = 1.0) -> StateSpace:
    """A controller handed out in SI, in the scaled plant's units."""
    return StateSpace(system.A / omega_0, system.B / omega_0, system.C / force, system.D / force)


def assessed(
    plant: ScaledPlant, controller: StateSpace, weights: Weights, gamma: float,
    omega_low: float = OMEGA_LOW,
) -> DesignFigures:  # fmt: skip
    """Certificate and figures of any controller in SI against the claim `gamma`."""
    K = in_time_unit(controller, plant.omega_0, plant.force)
    matrices = (np.ascontiguousarray(matrix) for matrix in (K.A, K.B, K.C, K.D))
    row = np.full(int(Column.COUNT), np.nan)
    row[Column.LIMITED_BY_BOUND] = 0.0
    scaled_weights = weights.scale(plant.omega_0)
    low = omega_low / plant.omega_0
    judge(plant.A, plant.B, plant.C, *matrices, scaled_weights, 0.0, gamma, low, row)
    return figures_from_row(row, weights, plant.omega_0)


# ---- the reference ----------------------------------------------------------------------------


def reference_matrices(
    system: Mechanics, suspension: Suspension = SUSPENSION
) -> tuple[Array, Array, Array]:
    """M, D, K in SI with suspension and modal damping, through matrix square roots."""
    M = system.M
    root = np.real(sqrtm(M))
    inverse = np.linalg.inv(root)
    symmetric = inverse @ system.K @ inverse
    symmetric = 0.5 * (symmetric + symmetric.T)
    size = np.linalg.norm(symmetric, 2)
    u, s, _ = np.linalg.svd(symmetric)
    null = u[:, s <= 1e-9 * size]
    rigid = null @ null.T
    w_r = HZ * suspension.frequency_hz
    K = system.K + w_r**2 * root @ rigid @ root
    D = system.D + 2.0 * suspension.damping_ratio * w_r * root @ rigid @ root
    if system.damping_ratio is not None:
        # a shift of the rigid directions keeps the square root away from its branch point
        flexible = np.real(sqrtm(symmetric + size * rigid)) - np.sqrt(size) * rigid
        D = D + 2.0 * system.damping_ratio * root @ flexible @ root
    return M, D, K


def reference_response(
    system: Mechanics, omega: Array, suspension: Suspension = SUSPENSION
) -> Array:
    """C (-ω²M + jωD + K)⁻¹ B at every ω in rad/s, (len(ω), p, m)."""
    M, D, K = reference_matrices(system, suspension)
    s = 1j * np.asarray(omega)[:, None, None]
    return system.C @ np.linalg.solve(s**2 * M + s * D + K, system.B.astype(complex))


def state_response(system: StateSpace, omega: Array) -> Array:
    """C (jω - A)⁻¹ B + D by dense solves, (len(ω), p, m)."""
    s = 1j * np.atleast_1d(omega)[:, None, None]
    eye = np.eye(system.A.shape[0])
    return system.C @ np.linalg.solve(s * eye - system.A, system.B.astype(complex)) + system.D


def sensitivity(plant: StateSpace, controller: StateSpace, omega: Array) -> Array:
    """S = (I + GK)⁻¹ at every ω in rad/s."""
    L = state_response(plant, omega) @ state_response(controller, omega)
    return np.linalg.inv(np.eye(L.shape[1]) + L)


def sensitivity_gain(plant: StateSpace, controller: StateSpace, omega: Array) -> Array:
    """σ_max(S) at every ω in rad/s."""
    return np.linalg.norm(sensitivity(plant, controller, omega), 2, axis=(1, 2))


def stack_gain(plant: StateSpace, controller: StateSpace, weights: Weights, omega: Array) -> Array:
    """σ_max([W1 S; W2 KS; W3 T]) at every ω in rad/s; W2 in SI."""
    K = state_response(controller, omega)
    S = sensitivity(plant, controller, omega)
    T = state_response(plant, omega) @ K @ S
    W1, W2, W3 = (w[:, None, None] for w in weights.responses(omega))
    return np.linalg.norm(np.concatenate([W1 * S, W2 * (K @ S), W3 * T], axis=1), 2, axis=(1, 2))


def dense_grid(*systems: StateSpace, per_decade: int = 100) -> Array:
    """Frequencies over all poles of the systems, crowded around each, rad/s."""
    poles = np.concatenate([np.linalg.eigvals(system.A) for system in systems])
    size = np.abs(poles)
    size = size[size > 1e-9 * size.max()]  # but of free bodies
    low, high = np.log10(0.01 * size.min()), np.log10(10.0 * size.max())
    pieces = [np.logspace(low, high, int(per_decade * (high - low)))]
    flanks = np.linspace(-4.0, 4.0, 41)
    for pole in poles[poles.imag > 0.0]:
        pieces.append(pole.imag + abs(pole.real) * flanks)
    grid = np.unique(np.concatenate(pieces))
    return grid[grid > 0.0]


def reference_plant(system: Mechanics, suspension: Suspension = SUSPENSION) -> StateSpace:
    """State space of the SI matrices, states [x; ẋ]."""
    M, D, K = reference_matrices(system, suspension)
    n = M.shape[0]
    lower = -np.linalg.solve(M, np.hstack([K, D]))
    A = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])
    B = np.vstack([np.zeros_like(system.B), np.linalg.solve(M, system.B)])
    C = np.hstack([system.C, np.zeros_like(system.C)])
    return StateSpace(A, B, C, np.zeros((C.shape[0], B.shape[1])))


def first_crossing(gain: Callable[[Array], Array], grid: Array, level: float) -> float:
    """The first ω where gain(ω) passes the level from below: grid, then brentq."""
    above = gain(grid) > level
    i = int(np.flatnonzero(~above[:-1] & above[1:])[0])
    return brentq(lambda w: float(gain(w)[0]) - level, grid[i], grid[i + 1], xtol=1e-12, rtol=1e-14)


def highest(gain: Callable[[Array], Array], grid: Array) -> tuple[float, float]:
    """The maximum of gain(ω) and where it is: grid, then a bounded search at the three best."""
    values = gain(grid)
    peaks = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    best, at = float(values.max()), float(grid[np.argmax(values)])
    for i in peaks[np.argsort(-values[peaks])][:3]:
        found = minimize_scalar(
            lambda w: -float(gain(w)[0]), bounds=(grid[i - 1], grid[i + 1]), method="bounded",
            options={"xatol": 1e-10 * grid[i]},
        )  # fmt: skip
        if -found.fun > best:
            best, at = -float(found.fun), float(found.x)
    return best, at


def stack_system(plant: StateSpace, controller: StateSpace, weights: Weights):
    """r to [W1 S; W2 KS; W3 T] r by python-control, from plant, controller and weights."""
    G, K = to_control(plant), to_control(controller)
    p, m = G.noutputs, G.ninputs
    W1, W2, W3 = (control.ss(system) for system in control_weights(weights))
    parts = control.append(G, K, *[W1] * p, *[W2] * m, *[W3] * p)
    # inputs [u_G; e_K; W1; W2; W3] from outputs [y; u; z1; z2; z3] and r
    outputs = p + m + 2 * p + m
    route, inject = np.zeros((m + p + 2 * p + m, outputs)), np.zeros((m + p + 2 * p + m, p))
    ones_p, ones_m = np.eye(p), np.eye(m)
    route[:m, p : p + m] = ones_m
    route[m : m + p, :p] = -ones_p
    route[m + p : m + 2 * p, :p] = -ones_p
    route[m + 2 * p : 2 * m + 2 * p, p : p + m] = ones_m
    route[2 * m + 2 * p :, :p] = ones_p
    inject[m : m + p] = ones_p
    inject[m + p : m + 2 * p] = ones_p
    loop = control.feedback(parts, control.ss([], [], [], route), sign=1)
    select = np.hstack([np.zeros((2 * p + m, p + m)), np.eye(2 * p + m)])
    return control.ss(loop.A, loop.B @ inject, select @ loop.C, select @ loop.D @ inject)


def responses(
    plant: ScaledPlant, controller: StateSpace, omega: Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """G (k, p, m), K (k, m, p) and S (k, p, p) in SI at ω (k,) in rad/s, by dense solves."""
    G, K = (state_response(system, omega) for system in (plant.plant_si(), controller))
    return G, K, np.linalg.inv(np.eye(G.shape[1]) + G @ K)


def to_control(system: StateSpace) -> control.StateSpace:
    return control.ss(system.A, system.B, system.C, system.D)


def control_weights(weights: Weights) -> tuple[control.TransferFunction, ...]:
    """W1, W2, W3 as python-control transfer functions from their defining fractions."""
    w = weights
    return (
        control.tf([1.0 / w.M_S, w.omega_S], [1.0, w.omega_S * w.A_S]),
        control.tf([w.c_K / w.M_K, w.c_K * w.omega_K / w.M_K], [1.0, w.c_K * w.omega_K]),
        control.tf([1.0, w.omega_T / w.A_l], [w.A_u, w.omega_T]),
    )


def well_conditioned(rng: np.random.Generator, n: int) -> Array:
    """Other coordinates, of condition 10 at most: at 5e4 rounding makes a plant 1 % another one."""
    left, right = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    return np.asarray(left * 10.0 ** rng.uniform(-0.5, 0.5, n) @ right)


def relative(a: Array, b: Array) -> float:
    """Largest difference over the largest reference value, frequency by frequency."""
    a, b = np.asarray(a), np.asarray(b)
    if a.ndim == 3:
        return float((np.abs(a - b).max(axis=(1, 2)) / np.abs(b).max(axis=(1, 2))).max())
    return float((np.abs(a - b) / np.abs(b)).max())
