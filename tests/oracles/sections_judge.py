"""A controller of fixed structure on one plant of its box, judged without the package.

The plant from the chain's matrices, hold and delay by modes, K by the formula of
docs/fixed_structure.md (the state space has to agree with it), poles of the loop rebuilt, S, KS, T
and GS on grids through every pole. Of the package there are but the types of its data.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.loop import Sampling

HZ = 2.0 * np.pi


@dataclass(frozen=True)
class Case:
    """A random problem; the chain itself for the judge."""

    mass: np.ndarray
    stiffness: np.ndarray
    zeta: float
    sensor: int
    uncertain: UncertainPlant
    structure: Structure
    bounds: Bounds
    sampling: Sampling | None


def figures(required: Case, point: np.ndarray, design: SectionsDesign) -> dict[str, float]:
    """Every figure over its bound on one plant of the box; infinite where the loop is unstable."""
    controller = design.controller
    assert controller is not None
    a, k_b, k_c = controller.A, controller.B[:, 0], controller.C[0]
    k_d = float(controller.D[0, 0])
    A, b, c = chain_at(required, point)
    n = len(A) // 2
    rest = np.setdiff1d(np.arange(len(A)), [0, n])  # the first mode is the free body, b c/s²
    body = float(c[0] * b[n])
    poles, V = np.linalg.eig(A[np.ix_(rest, rest)])
    left, right = np.linalg.solve(V, b[rest] + 0j), c[rest] @ V
    T = None if required.sampling is None else required.sampling.period
    if T is None:
        closed = np.block([[A - np.outer(b, c) * k_d, np.outer(b, k_c)], [-np.outer(k_b, c), a]])
        loop_poles = np.linalg.eigvals(closed)
        if not (loop_poles.real < 0.0).all():
            return {"STABLE": np.inf}
        fastest = max(np.abs(poles).max(initial=0.0), np.abs(loop_poles).max())
        top, roots = 1e3 * fastest, loop_poles
    else:
        assert required.sampling is not None
        age = int(np.ceil(1e-6 * required.sampling.delay_us / T - 1e-9))
        h = T * age - 1e-6 * required.sampling.delay_us  # of the newest force in a period
        late = np.expm1(poles * h) / poles * left if h > 1e-12 else np.zeros_like(left)
        early = np.exp(poles * h) * np.expm1(poles * (T - h)) / poles * left
        n, m = len(A), len(a)
        newer, Ad = driven(A, b, h), expm(A * T)
        older = expm(A * h) @ driven(A, b, T - h)
        inverse = np.linalg.inv(np.eye(m) - 0.5 * T * a)
        a_z, b_z = inverse @ (np.eye(m) + 0.5 * T * a), inverse @ k_b * T
        c_z, d_z = k_c @ inverse, k_d + 0.5 * T * k_c @ inverse @ k_b
        size = n + age + m
        closed = np.zeros((size, size))
        closed[:n, :n] = Ad
        # e = -c x, u = d_z e + c_z x_K; the force is u_{k-age} at first, then u_{k-age+1}
        command = np.concatenate([-d_z * c, np.zeros(age), c_z])
        vectors = [older, newer]
        for back, vector in zip((age, age - 1), vectors, strict=True):
            if back <= 0:
                closed[:n] += np.outer(vector, command)
            else:
                closed[:n, n + back - 1] += vector
        if age:
            closed[n] += command
            for i in range(1, age):
                closed[n + i, n + i - 1] = 1.0
        closed[n + age :, :n] = -np.outer(b_z, c)
        closed[n + age :, n + age :] = a_z
        inside = np.linalg.eigvals(closed)
        if not (np.abs(inside) < 1.0).all():
            return {"STABLE": np.inf}
        top, roots = np.pi / T, np.log(inside[np.abs(inside) > 1e-12]) / T
    near = np.concatenate([roots, poles, np.linalg.eigvals(a)])
    omega = [np.geomspace(1e-2 * required.bounds.omega_low, top, 3000)]
    steps = np.concatenate([-np.geomspace(1e-2, 30.0, 25), [0.0], np.geomspace(1e-2, 30.0, 25)])
    omega += [abs(p.imag) + abs(p.real) * steps for p in near]
    bandwidth, bounds = design.bandwidth, required.bounds
    rest = [] if required.structure.integrator else [1e-5 * bounds.omega_low]
    w = np.unique(np.concatenate([*omega, [bandwidth, bounds.omega_low], rest]))
    w = w[(w > 0.0) & (w <= top)]
    s = 1j * w
    free = (right * left / (s[:, None] - poles)).sum(1) + body / s**2
    if T is None:
        G, x = free, s
    else:
        z = np.exp(s * T)
        terms = (early + late * z[:, None]) * right / (z[:, None] - np.exp(poles * T))
        first = h**2 / 2.0 * z + (T**2 - h**2) / 2.0
        coasted = (first + T * (h * z + T - h) / (z - 1.0)) / (z - 1.0)
        G = np.exp(-s * T * age) * (terms.sum(1) + body * coasted)
        x = 2.0 / T * (z - 1.0) / (z + 1.0)
    k = product(required.structure, design.kappa, x)
    few = np.array([0, len(w) // 2, int(np.argmin(np.abs(w - bandwidth)))])
    solved_too = np.linalg.solve(x[few, None, None] * np.eye(len(a)) - a, k_b[:, None] + 0j)[..., 0]
    if not np.allclose((k_c * solved_too).sum(1) + k_d, k[few], rtol=1e-4, atol=0.0):
        return {"STATE_SPACE": np.inf}
    S = 1.0 / (1.0 + G * k)
    low = int(np.argmin(np.abs(w - bounds.omega_low)))
    found = {"S_MAX": np.abs(S).max() / bounds.S_max, "S_LOW": abs(S[low]) / bounds.S_low}
    counted = w if required.structure.integrator else np.maximum(w, bounds.omega_low)
    below = w <= bandwidth
    size = np.abs(S) * np.sqrt(2.0)
    found["LEVEL"] = size[below].max()
    if bounds.shape is not None:
        x = counted / bandwidth
        if bounds.shape_ends is ShapeEnd.CROSSING:
            found["SHAPE"] = (size / (bounds.shape * x))[below].max()
        else:
            rising = bounds.shape * x - (bounds.shape - 1.0) / x
            found["SHAPE"] = (size / np.where(x < 1.0, x, rising)).max()
    if bounds.weighted_level is not None and bounds.weights is not None:
        v = bounds.weights
        W_KS = v.c_K / v.M_K * (s + v.omega_K) / (s + v.c_K * v.omega_K)
        W_T = (s + v.omega_T / v.A_l) / (s + v.omega_T / v.A_u) / v.A_u
        found["KS"] = np.abs(W_KS * k * S).max() / bounds.weighted_level
        found["T"] = np.abs(W_T * G * k * S).max() / bounds.weighted_level
    if bounds.compliance_max is not None:
        found["GS"] = np.abs(free * S).max() / bounds.compliance_max
    return {name: float(value) for name, value in found.items()}


def product(structure: Structure, kappa: np.ndarray, s: np.ndarray) -> np.ndarray:
    """K(s) as docs/fixed_structure.md writes it."""
    value = dict(zip(structure.names, np.exp(kappa).tolist(), strict=True))

    def q(name: str) -> np.ndarray:
        ratio = s / value[name]
        return 1.0 + 2.0 * value[f"{name} damping"] * ratio + ratio**2

    K = np.full(s.shape, value["gain"], complex)
    if structure.integrator:
        K = K * (1.0 + value["integrator"] / s)
    for i in range(1, structure.lead + 1):
        K = K * (1.0 + s / value[f"lead {i} zero"]) / (1.0 + s / value[f"lead {i} pole"])
    for i in range(1, structure.biquads + 1):
        K = K * q(f"biquad {i} zeros") / q(f"biquad {i} poles")
    for i in range(1, structure.roll_off // 2 + 1):
        K = K / q(f"roll-off {i}")
    return K / (1.0 + s / value["roll-off real"]) if structure.roll_off % 2 else K


def driven(A: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """What a constant force does to the states in a time."""
    n = len(A)
    return np.asarray(expm(np.block([[A, b[:, None]], [np.zeros((1, n + 1))]]) * t)[:n, n])


def chain_at(required: Case, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A, b, c) of the chain at a point of the box, in modal coordinates."""
    values = dict(zip(required.uncertain.names, point.tolist(), strict=True))
    root = 1.0 / np.sqrt(required.mass)
    lam, modes = np.linalg.eigh(root[:, None] * required.stiffness * root)
    omega = np.sqrt(np.maximum(lam, 0.0)) * (1.0 + values.get("resonance_shift", 0.0))
    zeta = np.full(len(lam), required.zeta * values.get("damping", 1.0))
    omega[0], n = 0.0, len(lam)  # the free chain
    rate = np.where(omega > 0.0, omega, 1.0)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.diag(rate)
    A[n:, :n], A[n:, n:] = -np.diag(omega), -np.diag(2.0 * zeta * omega)
    shape = root[:, None] * modes
    b = np.concatenate([np.zeros(n), shape[0]]) * (1.0 + values.get("gain", 0.0))
    return A, b, np.concatenate([shape[required.sensor] / rate, np.zeros(n)])
