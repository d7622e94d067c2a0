"""What is deployed: block-diagonal realisation, C code bit by bit, sections that multiply to K."""

import shutil
import subprocess
from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from oracles.helpers import few

from ccd_casadi.analysis.loop_channels import LoopChannel
from ccd_casadi.deployment.deploy_files import Section, sections_of
from ccd_casadi.deployment.realisation import (
    Realisation,
    difference_equation,
    in_single,
    realise,
    with_anti_windup,
)
from ccd_casadi.deployment.source_code import COMPILE, c_files, write_c
from ccd_casadi.lti.state_space import StateSpace

HZ = 2.0 * np.pi
# `make test` needs no compiler on a bare machine; where there is none only this is left out.
compiled = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


def random_controller(seed: int, pairs: int, reals: int, inputs: int = 1) -> StateSpace:
    """Poles close to z = 1, slow and lightly damped ones among them, in mixed coordinates."""
    rng = np.random.default_rng(seed)
    n = 2 * pairs + reals
    A = np.zeros((n, n))
    for i in range(pairs):
        size, angle = 1.0 - 10.0 ** rng.uniform(-4, -1), 10.0 ** rng.uniform(-3, -0.5)
        c, s = size * np.cos(angle), size * np.sin(angle)
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[c, s], [-s, c]]
    for i in range(2 * pairs, n):
        A[i, i] = 1.0 - 10.0 ** rng.uniform(-5, -0.3)
    T = np.linalg.qr(rng.normal(size=(n, n)))[0] * rng.uniform(0.5, 2.0, n) if n else np.eye(0)
    B, C = rng.normal(size=(n, inputs)), 1e6 * rng.normal(size=(inputs, n))
    D = 1e6 * rng.normal(size=(inputs, inputs))
    return StateSpace(np.linalg.solve(T, A @ T) if n else A, B, C, D, period=1e-4)


def of_one_channel(K: StateSpace, saturation: float | None = None) -> Realisation:
    eye = np.eye(len(K.D))
    channel = LoopChannel("all", eye, eye, None, StateSpace(K.A, K.B, K.C, K.D))  # type: ignore[arg-type]
    return realise([channel], [K], saturation)


@few(max_examples=40)
@given(seed=st.integers(0, 10**6), pairs=st.integers(0, 4), reals=st.integers(0, 3))
def test_the_realisation_is_the_same_controller(seed: int, pairs: int, reals: int) -> None:
    K = random_controller(seed, pairs, reals)
    found = of_one_channel(K)
    assert sum(found.blocks) == 2 * pairs + reals
    omega = np.geomspace(1.0, 0.99 * np.pi / K.period, 60)
    expected = K.response(omega)
    np.testing.assert_allclose(
        found.system.response(omega), expected, rtol=0, atol=1e-8 * np.abs(expected).max()
    )
    kept = np.zeros_like(K.A)
    start = 0
    for size in found.blocks:
        kept[start : start + size, start : start + size] = 1.0
        start += size
    assert not np.any(found.system.A * (1.0 - kept))


def test_channels_are_put_together() -> None:
    U = np.array([[0.6, -0.8], [0.8, 0.6]])
    parts = [random_controller(i, 1, 1) for i in range(2)]
    channels = [
        LoopChannel(str(i), U[:, [i]], U[:, [1 - i]], None, StateSpace(K.A, K.B, K.C, K.D))  # type: ignore[arg-type]
        for i, K in enumerate(parts)
    ]
    omega = HZ * np.array([1.0, 30.0, 900.0])
    found = realise(channels, parts).system.response(omega)
    a, b = (K.response(omega) for K in parts)
    expected = U[:, [1]] @ a @ U[:, [0]].T + U[:, [0]] @ b @ U[:, [1]].T
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_difference_equation_is_the_state_space() -> None:
    found = of_one_channel(random_controller(1, 2, 2, inputs=2))
    e = np.random.default_rng(2).normal(size=(50, 2))
    x, expected = np.zeros(6), []
    for v in e:
        expected.append(found.system.C @ x + found.system.D @ v)
        x = found.system.A @ x + found.system.B @ v
    u = difference_equation(found, e)
    np.testing.assert_allclose(u, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    limit = 0.3 * float(np.abs(u).max())
    clipped = difference_equation(Realisation(found.system, found.blocks, limit), e)
    np.testing.assert_array_equal(clipped, np.clip(u, -limit, limit))
    f = np.random.default_rng(3).normal(size=u.shape)
    np.testing.assert_array_equal(difference_equation(found, e, f)[0], u[0] + f[0])


def build(folder: Path, found: Realisation) -> Path:
    write_c(folder, found, title='x */ #error "', delay=1e-4, verified=True)
    made = subprocess.run(
        [*COMPILE.split(), "-Werror"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr
    return folder / "controller_test"


@compiled
@pytest.mark.parametrize(
    ("pairs", "reals", "inputs", "share"),
    [(0, 0, 1, None), (2, 1, 1, None), (2, 1, 1, 0.2), (3, 2, 3, None)],
)
def test_c_equals_python_bit_by_bit(
    tmp_path: Path, pairs: int, reals: int, inputs: int, share: float | None
) -> None:
    plain = of_one_channel(random_controller(5, pairs, reals, inputs))
    e = 1e-6 * np.random.default_rng(7).normal(size=(400, inputs))
    limit = None if share is None else share * float(np.abs(difference_equation(plain, e)).max())
    found = with_anti_windup(Realisation(plain.system, plain.blocks, limit), 500.0)
    program = build(tmp_path, found)
    assert subprocess.run([program], capture_output=True, check=False).returncode == 0
    lines = "\n".join(" ".join(f"{v:.17g}" for v in row) for row in e)
    ran = subprocess.run([program, "-"], input=lines, capture_output=True, text=True, check=True)
    u = np.array([[float(v) for v in line.split()] for line in ran.stdout.splitlines()])
    np.testing.assert_array_equal(u, difference_equation(found, e))


@compiled
def test_the_c_test_notices_a_wrong_number(tmp_path: Path) -> None:
    found = of_one_channel(random_controller(5, 1, 1))
    program = build(tmp_path, found)
    other = StateSpace(
        found.system.A, found.system.B, found.system.C, found.system.D * (1 + 1e-10), period=1e-4
    )
    files = c_files(Realisation(other, found.blocks), title="x", delay=1e-4, verified=True)
    (tmp_path / "controller.c").write_text(files["controller.c"])
    subprocess.run(COMPILE.split(), cwd=tmp_path, check=True)
    assert subprocess.run([program], capture_output=True, check=False).returncode == 1


# ---- sections ---------------------------------------------------------------------------------


def system(poles: list[complex], zeros: list[complex], gain: float) -> StateSpace:
    """A cascade of small sections: a companion form of all poles would lose its digits."""

    def groups(roots: list[complex]) -> list[np.ndarray]:
        pairs = [np.array([r, r.conjugate()]) for r in roots if r.imag > 0.0]
        return pairs + [np.array([r]) for r in roots if r.imag == 0.0]

    below = groups(poles)
    whole = control.ss([], [], [], [[gain]])
    for zero in groups(zeros):
        pole = below.pop(0)
        while len(pole) < len(zero):
            pole = np.append(pole, below.pop(0))
        whole = control.ss(control.tf(np.poly(zero).real, np.poly(pole).real)) * whole
    for pole in below:
        whole = control.ss(control.tf([1.0], np.poly(pole).real)) * whole
    return StateSpace(whole.A, whole.B, whole.C, whole.D)


def response(K: StateSpace, omega: np.ndarray) -> np.ndarray:
    s = 1j * omega[:, None, None]
    return (K.C @ np.linalg.solve(s * np.eye(len(K.A)) - K.A, K.B + 0j) + K.D)[:, 0, 0]


def pair(hz: float, damping: float) -> list[complex]:
    w = HZ * hz
    imaginary = 1j * w * np.sqrt(1.0 - damping**2)
    return [-damping * w + imaginary, -damping * w - imaginary]


@few(max_examples=60)
@example(510510, 3, 3, 3, 1)  # the slowest zero 8 % off under Haswell's kernels
@given(
    seed=st.integers(0, 10**6), pole_pairs=st.integers(0, 3), pole_reals=st.integers(1, 3),
    zero_pairs=st.integers(0, 3), zero_reals=st.integers(0, 2),
)  # fmt: skip
def test_sections_multiply_to_the_controller(
    seed: int, pole_pairs: int, pole_reals: int, zero_pairs: int, zero_reals: int
) -> None:
    rng = np.random.default_rng(seed)
    order = 2 * pole_pairs + pole_reals
    while 2 * zero_pairs + zero_reals > order:
        zero_pairs, zero_reals = max(zero_pairs - 1, 0), max(zero_reals - 1, 0)

    def roots(pairs: int, reals: int) -> list[complex]:
        found: list[complex] = []
        for _ in range(pairs):
            found += pair(10.0 ** rng.uniform(0, 3), rng.uniform(-0.3, 0.9))
        for _ in range(reals):
            found.append(-HZ * 10.0 ** rng.uniform(-1, 3) * rng.choice([1.0, 1.0, -1.0]))
        return found

    poles, zeros = roots(pole_pairs, pole_reals), roots(zero_pairs, zero_reals)
    K = system(poles, zeros, 1e3)
    found = sections_of(K, HZ * 50.0)
    omega = HZ * np.geomspace(0.1, 5e3, 80)
    s = 1j * omega
    exact = 1e3 * np.prod([s - z for z in zeros], axis=0) / np.prod([s - p for p in poles], axis=0)
    # poles decades above the zeros: the matrices themselves may hold K to 3e-4 only, and three in
    # 20,000 draws not to 1e-3, one not at all: these are no such controller, whatever reads them
    lost = float(np.abs(response(K, omega) / exact - 1.0).max())
    assume(lost < 1e-3)
    above = [one.zero.response(s) for one in found.sections if one.zero]
    below = [one.pole.response(s) for one in found.sections if one.pole]
    read = found.gain * np.prod(above, axis=0) / np.prod(below, axis=0)
    np.testing.assert_allclose(read, exact, rtol=1e-5 + 5.0 * lost)
    kept = sum((s.zero is not None) * (1 + (s.zero.damping is not None)) for s in found.sections
               if s.zero)  # fmt: skip
    assert kept == 2 * zero_pairs + zero_reals
    assert found.gain_at_bandwidth == pytest.approx(abs(response(K, np.array([HZ * 50.0]))[0]))


def test_a_textbook_controller_reads_as_it_was_made() -> None:
    """Integrator with zero, lead, notch, second-order roll-off."""
    poles = [-HZ * 0.1, -HZ * 150.0, *pair(200.0, 0.5), *pair(600.0, 0.7)]
    zeros = [-HZ * 5.0, -HZ * 17.0, *pair(200.0, 0.05)]
    found = sections_of(system(poles, zeros, 1e9), HZ * 50.0).sections
    kinds = {section.kind: section for section in found}
    assert set(kinds) == {"integrator with zero", "lead", "notch", "second-order roll-off"}

    def figures(section: Section) -> list[float | None]:
        roots = (section.zero, section.pole)
        return [value for r in roots if r is not None for value in (r.hz, r.damping)]

    assert figures(kinds["notch"]) == pytest.approx([200.0, 0.05, 200.0, 0.5], rel=1e-6)
    assert kinds["notch"].depth_db == pytest.approx(-20.0, abs=1e-4)
    assert kinds["second-order roll-off"].pole is not None
    assert kinds["second-order roll-off"].pole.hz == pytest.approx(600.0, rel=1e-6)
    assert kinds["integrator with zero"].pole is not None
    assert kinds["integrator with zero"].pole.hz == pytest.approx(0.1, rel=1e-6)


@compiled
@few(max_examples=10)
@given(seed=st.integers(0, 10**6), limited=st.booleans())
def test_code_in_single_precision_is_the_difference_equation(
    seed: int, limited: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Bit by bit, over 400 samples, of coefficients that are numbers of 24 bits."""
    K = random_controller(seed, 2, 2)
    realisation = of_one_channel(K, 1e3 if limited else None)
    assume(not limited or np.isfinite(realisation.system.A).all())
    found = in_single(with_anti_windup(realisation, 100.0) if limited else realisation)
    for M in (found.system.A, found.system.B, found.system.C, found.system.D):
        assert (M.astype(np.float32) == M).all()
    folder = tmp_path_factory.mktemp("single")
    texts = write_c(folder, found, title="single", delay=1e-4, verified=True)
    assert "double" not in texts["controller.c"]
    subprocess.run(COMPILE.split(), cwd=folder, check=True, capture_output=True)
    assert subprocess.run(["./controller_test"], cwd=folder, check=False).returncode == 0
    errors = 1e-6 * np.random.default_rng(seed).standard_normal((400, 1))
    lines = "\n".join(f"{e:.17g}" for e in errors.ravel())
    ran = subprocess.run(["./controller_test", "-"], cwd=folder, input=lines, text=True,
                         capture_output=True, check=True)  # fmt: skip
    forces = np.array([float(line) for line in ran.stdout.split()])
    np.testing.assert_array_equal(forces, difference_equation(found, errors).ravel())


def test_rounding_to_single_precision_is_judged() -> None:
    """Of a slow pole its distance from 1 is rounded: what is judged has it so."""
    slow = StateSpace(np.array([[1.0 - 3.3e-7]]), np.array([[1e-3]]), np.array([[1e6]]),
                      np.array([[1e6]]), period=1e-4)  # fmt: skip
    rounded = in_single(of_one_channel(slow)).as_coded
    pole, own = (float(one.A[0, 0]) for one in (rounded, slow))
    assert abs((1.0 - pole) / (1.0 - own) - 1.0) > 0.01
    assert abs(pole - own) < 2.0**-24
