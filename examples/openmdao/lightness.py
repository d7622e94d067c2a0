"""A certified loop beside components of one's own in OpenMDAO: what is lightness worth?

First the problem of case study 1 as OpenMDAO poses it, with the hardware's cost from a component of
our own: the same optimum as `solve`. Then the shop's price for taking weight out, which no case
file knows of: the optimum moves off its bounds.
"""

from pathlib import Path

import openmdao.api as om

import ccd_casadi as ccd
from ccd_casadi.extensions.openmdao.components import CertifiedLoop, pose

CASE = Path(__file__).parent.parent.parent / "runs" / "two_mass.toml"


class Workshop(om.ExplicitComponent):
    """Mass in kg, and the price (EUR) of milling both bodies down from 70 kg."""

    def setup(self):
        for name in ("m1", "m2"):
            self.add_input(name, units="kg")
        self.add_output("mass", units="kg")
        self.add_output("price")
        self.declare_partials("mass", ["m1", "m2"], val=1.0)
        self.declare_partials("price", ["m1", "m2"])

    def compute(self, inputs, outputs):
        outputs["mass"] = inputs["m1"] + inputs["m2"]
        outputs["price"] = sum(20.0 * (70.0 - inputs[name]) ** 2 for name in ("m1", "m2"))

    def compute_partials(self, inputs, partials):
        for name in ("m1", "m2"):
            partials["price", name] = -40.0 * (70.0 - inputs[name])


def posed(per_euro: float) -> om.Problem:
    """min w1 mass + w2 ω_b + per_euro price, under the case's certified constraints."""
    problem = ccd.problem_of(ccd.load_case(CASE))
    model = om.Group()
    model.add_subsystem("loop", CertifiedLoop(problem=problem), promotes=["*"])
    model.add_subsystem("workshop", Workshop(), promotes=["*"])
    objective = f"J = {problem.w1} * mass + {problem.w2} * bandwidth + {per_euro} * price"
    model.add_subsystem(
        "sum", om.ExecComp(objective, bandwidth={"units": "rad/s"}, mass={"units": "kg"}),
        promotes=["*"],
    )  # fmt: skip
    pose(model, problem)
    model.add_objective("J", ref=100.0)
    found = om.Problem(model, reports=False)
    found.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=1e-9, disp=False)
    found.setup()
    return found


def main() -> list[om.Problem]:
    found = []
    for per_euro in (0.0, 0.005):
        problem = posed(per_euro)
        problem.run_driver()
        J, m1, m2, price, rate = (
            float(problem.get_val(name).item()) for name in ("J", "m1", "m2", "price", "bandwidth")
        )
        print(f"{per_euro:g} per EUR: J {J:.4f}, m1 {m1:.3f} kg, m2 {m2:.3f} kg, "
              f"{rate / ccd.HZ:.3f} Hz, {price:.0f} EUR")  # fmt: skip
        found.append(problem)
    return found


if __name__ == "__main__":
    main()
