"""Random chains of masses and springs with 2 to 4 parameters, as a plant function and a problem.

Mass i and spring i grow with their parameter, m_i = a_i θ_j and k_i = b_i θ_j^p: thicker is
stiffer and heavier; the hardware costs Σ c_j (θ_j + r_j/θ_j), as thin parts are dear too. The chain
floats (one rigid-body mode); the force acts on the first mass and the sensor sits on the first or,
where the seed says so, on another one.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sweep import InnerBounds
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.synthesis.weights import Weights

HZ = 2.0 * np.pi
LOWER, UPPER = 0.6, 1.6


def _drawn(seed: int) -> dict[str, Any]:
    rng = np.random.default_rng([seed, 1])
    masses, parameters = int(rng.integers(2, 5)), int(rng.integers(2, 5))
    return {
        "parameters": parameters,
        "mass": rng.uniform(0.5, 2.0, masses),
        "stiffness": (HZ * np.exp(rng.uniform(np.log(60.0), np.log(300.0), masses - 1))) ** 2,
        "power": rng.uniform(0.0, 4.0, masses - 1),
        "of_mass": rng.integers(0, parameters, masses),
        "of_spring": rng.permutation(np.arange(max(parameters, masses - 1)) % parameters),
        "sensor": 0 if rng.uniform() < 0.7 else int(rng.integers(1, masses)),
        "zeta": float(rng.uniform(0.005, 0.03)),
        "price": rng.uniform(0.5, 2.0, parameters),
        "thin": rng.uniform(0.0, 3.0, parameters),
    }


def chain(theta: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """The plant function: matrices of the chain that the seed stands for."""
    d = _drawn(seed)
    t = [theta[f"p{i}"] for i in range(d["parameters"])]
    n = len(d["mass"])
    m = [d["mass"][i] * t[d["of_mass"][i]] for i in range(n)]
    K = ca.SX.zeros(n, n) if isinstance(t[0], ca.SX) else ca.MX.zeros(n, n)
    for i in range(n - 1):
        e = ca.DM.zeros(n, 1)
        e[i], e[i + 1] = 1.0, -1.0
        K = K + d["stiffness"][i] * t[d["of_spring"][i]] ** d["power"][i] * (e @ e.T)
    force, output = ca.DM.zeros(n, 1), ca.DM.zeros(1, n)
    force[0], output[d["sensor"]] = 1.0, 1.0
    return {
        "mass": ca.diag(ca.vertcat(*m)),
        "stiffness": K,
        "damping_ratio": d["zeta"],
        "input": force,
        "output": output,
        "hardware_cost": sum(
            price * (x + thin / x) for price, thin, x in zip(d["price"], d["thin"], t, strict=True)
        ),
    }


def chain_problem(seed: int) -> CoDesignProblem:
    """A co-design problem of the chain, its box and its weights in proportion to its resonance."""
    d = _drawn(seed)
    rng = np.random.default_rng([seed, 2])
    names = tuple(f"p{i}" for i in range(d["parameters"]))
    start = tuple(1.0 for _ in names)
    plant = build_plant(chain, names, {"seed": seed})
    natural = modal_plant(mechanics(plant, start), Suspension()).natural
    first = float(natural[natural > 1.0].min())
    total = float(d["mass"].sum())
    crossing = first * float(rng.uniform(0.15, 0.6))
    weights = Weights(
        M_S=2.0, A_S=1e-4, omega_S=crossing, c_K=1e4, omega_K=2.0 * crossing,
        M_K=float(rng.uniform(1.0, 4.0)) * total * crossing**2, A_l=1.0, A_u=1e-2,
        omega_T=crossing,
    )  # fmt: skip
    inner = InnerBounds(
        S_max=float(rng.uniform(1.6, 2.2)),
        S_low=0.1,
        omega_low=crossing / 30.0,
        omega_S=(crossing / 5.0, 30.0 * crossing),
        omega_T=(crossing / 2.0, 20.0 * crossing),
    )
    return CoDesignProblem(
        source=PlantSource(None, str(Path(__file__).resolve()), "chain", (("seed", seed),)),
        names=names,
        units=("",) * len(names),
        lower=(LOWER,) * len(names),
        upper=(UPPER,) * len(names),
        start=start,
        w1=float(rng.uniform(0.0, 2.0)) * crossing / len(names),
        w2=-1.0,
        weights=weights,
        inner=inner,
        suspension=Suspension(first / HZ / 500.0, 0.7),
    )
