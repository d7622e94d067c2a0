"""Every structured design that the package ships or its pages show: its figures, and pictures.

    python benchmarks/oracle.py shipped_designs [NAME ...] [--draw DIR] [--from DIR] [--write]

Each is `inner` at the θ that its page names. `--draw` writes one picture a design: L in the Nyquist
plane, |S|, a unit step of each reference and of each force, on every corner of its set. `--from`
takes what an earlier run left in that folder. `--write` keeps sections, figures and the roots of K
near ω_b in tests/data/shipped_designs.json, which a test reads: no root with damping below 0.1
within 20 % of ω_b. The rib stage and the disk drive have scripts of their own.
"""

import argparse
import contextlib
import io
import json
import re
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi import inner
from ccd_casadi.analysis.loop_warnings import light_roots
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.plant_tables import parse_theta
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.lti.loop import Loop, Sampling, constant_drive
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.text import HZ
from oracles.sources import ROOT, files_of

RESULTS = ROOT / "tests/data/shipped_designs.json"
SECTIONS = re.compile(r"^```toml\n(\[controller\].*?)^```$", re.MULTILINE | re.DOTALL)
FIGURES = (
    "bandwidth_hz", "crossover_hz", "phase_margin_deg", "gain_margin", "delay_margin_us",
    "sensitivity_peak", "sensitivity_peak_hz", "step_overshoot", "settling_ms", "force_step_max",
    "loop_warnings",
)  # fmt: skip


def tutorial(page: str, title: str) -> str:
    """A file that a page has its reader write."""
    return files_of(ROOT / "docs" / f"{page}.md")[title]


def built() -> str:
    """`my_robust.toml` with the tables of the page's last section in place of `[robust]`."""
    text = tutorial("mixed_sensitivity", "my_robust.toml")
    head = re.sub(r"^\[robust\].*?(?=^\[)", "", text, flags=re.MULTILINE | re.DOTALL)
    page = (ROOT / "docs" / "mixed_sensitivity.md").read_text()
    (tables,) = SECTIONS.findall(page)
    bounds = "[inner]\nshape = 1.1\ncompliance_max = 5e-6\n"
    return head.replace("[inner]\n", bounds) + "\n" + tables


def off_centre() -> str:
    """Two axes with the payload off centre as well."""
    text = (ROOT / "examples/two_axes/case.toml").read_text()
    return text + '\n[robust]\nplants = ["plants/off_centre.toml"]\n'


def shipped() -> dict[str, tuple[str, Path | None, str]]:
    """θ as `inner` takes it, the folder that the case's files are in (None: a page), its text."""
    runs, examples = ROOT / "runs", ROOT / "examples"
    return {
        "two_mass_built": ("m1=55,m2=55", runs, (runs / "two_mass_built.toml").read_text()),
        "tutorial": ("rib=20.86,plate=6", None, tutorial("tutorial", "my_stage.toml")),
        "tutorial_bandwidth": ("rib=18.93,plate=6", None, built()),
        "two_axes": ("h=0.02", examples / "two_axes",
                     (examples / "two_axes/case.toml").read_text()),
        "two_axes_off_centre": ("h=0.02", examples / "two_axes", off_centre()),
        "guided_beam": ("guide=0.055,tip=0.005", examples / "guided_beam",
                        (examples / "guided_beam/case.toml").read_text()),
    }  # fmt: skip


def placed(name: str, folder: Path) -> Path:
    """The case of a design, in a folder of its own."""
    _, home, text = shipped()[name]
    folder.mkdir(parents=True, exist_ok=True)
    if home is None:
        (folder / "my_stage.py").write_text(tutorial("tutorial", "my_stage.py"))
    else:
        text = text.replace('function = "', f'function = "{home}/')
        text = text.replace('plants = ["', f'plants = ["{home}/')
    case = folder / "input.toml"
    case.write_text(text)
    return case


def designed(name: str, folder: Path) -> dict[str, Any]:
    """`inner` of one design into a folder; the answer is kept there."""
    case, out = placed(name, folder), io.StringIO()
    words = [
        str(case),
        "--theta",
        shipped()[name][0],
        "--out",
        str(folder),
        "--workers",
        "1",
        "--quiet",
    ]
    with contextlib.redirect_stdout(out):
        inner.main(words)
    (folder / "answer.json").write_text(out.getvalue())
    return read(folder)


def read(folder: Path) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads((folder / "answer.json").read_text())
    return answer


def loops_of(name: str, folder: Path) -> tuple[list[Loop], float]:
    """The loops on the model and the corners of the set, SI, and S_max."""
    case = load_case(folder / "input.toml")
    problem = problem_of(case)
    theta = parse_theta(case, shipped()[name][0])
    uncertain = uncertain_plant(problem, theta)
    stored = json.loads((folder / "controller.json").read_text())
    K = StateSpace(*(np.array(stored[key], float) for key in "ABCD"))
    of = stored["sections"].get("loop")
    sampling = Sampling(of["rate_hz"], of["delay_us"]) if of else None
    plants = uncertain.plants(uncertain.corners())
    return [Loop(plant.plant_si(), K, sampling) for plant in plants], problem.inner.S_max


def entry(name: str, folder: Path) -> dict[str, Any]:
    """What is kept of a design: the tables that its controller hangs on, figures, sections."""
    answer = read(folder)
    case = tomllib.loads((folder / "input.toml").read_text())
    stored = json.loads((folder / "controller.json").read_text())
    K = StateSpace(*(np.array(stored[key], float) for key in "ABCD"))
    roots = light_roots(K, answer["bandwidth_hz"] * HZ)
    return {
        "theta": shipped()[name][0],
        "controller": case["controller"],
        "inner": case["inner"],
        "status": answer["status"],
        **{key: answer[key] for key in FIGURES},
        "light_roots": [[w / HZ, damping, word] for w, damping, word in roots],
        "sections": stored["sections"],
    }


def draw(name: str, folder: Path, target: Path) -> None:
    """L, |S|, a step of reference and of force; several outputs: singular values, loop by loop."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    loops, S_max = loops_of(name, folder)
    answer = read(folder)
    hz = answer["bandwidth_hz"]
    figure, ((nyquist, size), (step, force)) = plt.subplots(2, 2, figsize=(13.0, 10.0))
    for loop in loops:
        high = min(3e3 * HZ, 0.98 * np.pi / loop.sampling.period if loop.sampling else np.inf)
        omega = loop.grid()
        omega = np.unique(np.concatenate([omega, np.geomspace(0.1 * HZ, high, 4000)]))
        omega = omega[(omega >= 0.1 * HZ) & (omega <= high)]
        G, K = loop.responses(omega)
        L = G @ K
        for i in range(L.shape[1]):
            others = np.linalg.eigvals(L)[:, i]
            nyquist.plot(others.real, others.imag, ",-"[L.shape[1] == 1], lw=0.7)
        size.loglog(omega / HZ, np.linalg.norm(loop.sensitivity(omega), 2, axis=(1, 2)), lw=0.8)
        duration = 40.0 / hz
        steps = loop.over_a_step(duration / 8000.0)
        count = int(duration / steps.period) + 1
        time = 1e3 * np.arange(count) * steps.period
        for i, drive in enumerate(steps.B_r.T):
            step.plot(time, constant_drive(steps, drive, count)[i], lw=0.7)
        for drive in steps.B_d.T:
            force.plot(time, 1e6 * np.abs(constant_drive(steps, drive, count)).max(axis=0), lw=0.7)
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 400))
    nyquist.plot(-1.0 + turn.real / S_max, turn.imag / S_max, "k--", lw=0.8)
    nyquist.plot(turn.real, turn.imag, "0.7", lw=0.6)
    nyquist.set(xlim=(-3.0, 2.0), ylim=(-2.5, 2.5), aspect="equal", title="L (eigenvalues)")
    shape = np.geomspace(0.02 * hz, 20.0 * hz, 200)
    x = shape / hz
    room = np.where(x < 1.0, 1.0, 1.1 - 0.1 / x**2)
    size.loglog(shape, np.minimum(S_max, room * x / np.sqrt(2.0)), "k--", lw=0.8)
    size.axvline(hz, color="0.6", lw=0.6)
    size.set(title=f"|S|, bandwidth {hz:.2f} Hz", xlabel="Hz", ylim=(1e-3, 3.0))
    for axis, words in ((step, "step of reference"), (force, "1 N: |e| in um")):
        axis.set(title=words, xlabel="ms")
    for axis in (size, step, force, nyquist):
        axis.grid(alpha=0.3)
    phase, gain, over, settled, by_force = (answer[key] for key in (
        "phase_margin_deg", "gain_margin", "step_overshoot", "settling_ms", "force_step_max"
    ))  # fmt: skip
    roots = entry(name, folder)["light_roots"]
    figure.suptitle(
        f"{name}: {phase:.1f} deg, gain {gain:.2f}, overshoot {100 * over:.0f} %, settles "
        f"{settled:.3g} ms, 1 N moves {1e6 * by_force:.3g} um; roots {roots}"
    )
    figure.tight_layout()
    figure.savefig(target / f"{name}.png", dpi=70)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--draw", type=Path)
    parser.add_argument("--from", type=Path, dest="found")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    with tempfile.TemporaryDirectory() as place:
        root = options.found or Path(place)
        for name in options.names or shipped():
            folder = root / name
            answer = read(folder) if (folder / "answer.json").exists() else designed(name, folder)
            if "bandwidth_hz" not in answer:
                print(f"{name}: {answer['status']}, {answer.get('reason')}", flush=True)
                continue
            kept[name] = entry(name, folder)
            shown = {key: value for key, value in kept[name].items() if key in FIGURES}
            print(f"{name}: {answer['status']} {shown} {kept[name]['light_roots']}", flush=True)
            if options.draw is not None:
                options.draw.mkdir(parents=True, exist_ok=True)
                draw(name, folder, options.draw)
            if options.write:
                RESULTS.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
