"""The machine as a picture, and what an engineer looks at first."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.drawing import svg
from ccd_casadi.drawing.content import Chapter, Figure, Lines, Modes, Picture, Place, Table
from ccd_casadi.drawing.paint import tables_of
from ccd_casadi.drawing.surface import REACH
from ccd_casadi.drawing.svg import ModeShapes
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.modal import ModalPlant, modal_plant
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.plants.plant_facts import modes_of
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.reporting.gain_figures import S_panel
from ccd_casadi.reporting.nyquist import loci_of, nyquist_panel
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, number, spoken, template

# in a page's own theme, where it has one
BLUE, GREEN, ORANGE = (
    f"var(--{name}, {colour})"
    for name, colour in (("blue", svg.BLUE), ("green", svg.GREEN), ("orange", svg.ORANGE))
)
MOST_NODES = 12
SHOWN_MODES = 3
SHOWN = 6  # of those to turn
STEP, SIDE = 150.0, 86.0  # between masses, and of the reference mass's block


@dataclass(frozen=True)
class Lumped:
    """Masses on one line: kg each, springs (i, j, N/m) between them and to the ground (j = -1)."""

    masses: Array
    springs: tuple[tuple[int, int, float], ...]
    driven: tuple[int, ...]
    measured: tuple[int, ...]


def find_lumped(system: Mechanics, *, small: float = 1e-9) -> Lumped | None:
    """Find the masses and springs that M and K consist of.

    M must be diagonal, K without a positive entry beside its diagonal or a negative row sum, and
    some spring must join two masses: matrices in modal coordinates have none.

    Parameters
    ----------
    system : Mechanics
    small : float
        Share of the largest entry below which an entry is zero.

    Returns
    -------
    Lumped, or None
    """
    n = len(system.M)
    m, K = np.diag(system.M), system.K
    apart = np.abs(system.M - np.diag(m)).max() <= small * np.abs(m).max()
    level = small * np.abs(K).max()
    off = K - np.diag(np.diag(K))
    ground = K.sum(axis=1)
    if n > MOST_NODES or not apart or off.max(initial=0.0) > level or ground.min() < -n * level:
        return None
    springs = [
        (i, j, float(-K[i, j])) for i in range(n) for j in range(i + 1, n) if -K[i, j] > level
    ]
    if not springs:
        return None
    springs += [(i, -1, float(ground[i])) for i in range(n) if ground[i] > n * level]
    driven = tuple(map(int, np.flatnonzero(np.abs(system.B).max(axis=1) > 0.0)))
    measured = tuple(map(int, np.flatnonzero(np.abs(system.C).max(axis=0) > 0.0)))
    return Lumped(np.array(m), tuple(springs), driven, measured)


def lumped_svg(found: Lumped, modal: ModalPlant, reference: float) -> str:
    """Masses as blocks whose areas are as their masses, springs, force and sensor; modes below.

    `reference` in kg has the block of full size, alike at every θ.
    """
    side = SIDE * np.sqrt(np.abs(found.masses) / reference)
    flexible = np.flatnonzero(~modal.rigid)[:SHOWN_MODES]
    shapes = (modal.modes / np.abs(modal.modes).max(axis=0)).T[flexible]
    words = (
        f"mode {i}: {number(hz, 4)} Hz" for i, hz in enumerate(modal.natural[flexible] / HZ, 1)
    )
    return template("drawing/assets/lumped.svg").render(
        wide=STEP * (len(side) + 0.5), at=STEP * (np.arange(len(side)) + 0.75), side=side,
        masses=[spoken(f"{number(float(mass), 4)} kg") for mass in found.masses],
        springs=[(i, j, spoken(f"{number(1e-6 * k, 3)} N/µm")) for i, j, k in found.springs],
        driven=found.driven, measured=found.measured, modes=list(zip(words, shapes, strict=True)),
        blue=BLUE, green=GREEN, orange=ORANGE,
    )  # fmt: skip


def lumped_machine(
    system: Mechanics, modal: ModalPlant, reference: float | None = None
) -> Picture | Table:
    """Draw masses and springs with their modes, or tabulate the modes.

    Parameters
    ----------
    system : Mechanics
    modal : ModalPlant
        The same plant.
    reference : float, optional
        Mass in kg that is drawn at full size; by default the largest.

    Returns
    -------
    Picture or Table
    """
    found = find_lumped(system)
    if found is None:
        return modes_table(modal)
    return Picture(lumped_svg(found, modal, reference or float(np.abs(found.masses).max())))


def modes_table(modal: ModalPlant) -> Table:
    """Tabulate of each mode: frequency, damping ratio, and the norms of what drives and measures
    it, as shares of the largest of all modes."""
    rows = []
    for mode in sorted(modes_of(modal), key=lambda mode: mode.frequency_hz):
        known = (f"{number(mode.frequency_hz, 4)}\u00a0Hz", f"{100.0 * mode.damping_ratio:.3g} %")
        if not mode.resonant:
            grows = f"driven away, pole at +{number(mode.growth_hz, 4)}\u00a0Hz"
            lies = f"real pole, {known[0]}" if mode.real else grows
            known = ("rigid" if mode.rigid else lies, "")
        rows.append((*known, f"{mode.driven:.2g}", f"{mode.measured:.2g}"))
    return Table(("mode", "damping", "driven (most: 1)", "measured (most: 1)"), tuple(rows))


def mode_shape_figure(shapes: ModeShapes) -> Figure:
    """The modes with their frequencies in Hz, to be turned."""
    named = len({mode.words for mode in shapes.modes}) > 1
    paired = any(len(mode.numbers) > 1 for mode in shapes.modes)
    words = paragraph("report.modes", shapes, named, paired, REACH)
    return Figure(Modes(shapes, turning=True), words, (table_modes(shapes),))


def table_modes(shapes: ModeShapes) -> Table:
    """Every mode's frequency, largest displacement, and what else its plant says of it."""
    head = ("mode", "shape", "frequency (Hz)", "largest displacement (1/√kg)")
    rows = [
        (
            mode.places, mode.words, mode.frequency,
            float(np.linalg.norm(mode.displacement, axis=1).max()), *mode.more.values(),
        )
        for mode in shapes.modes
    ]  # fmt: skip
    return Table((*head, *shapes.modes[0].more), tuple(rows))


HEIGHT = 3.0  # inches of a row


def glance(
    problem: CoDesignProblem, theta: Sequence[float], view: LoopView, move: Figure
) -> Chapter:
    """Make the chapter at a glance of a design, on the plants that it is made for."""
    assert isinstance(move.drawing, Lines)
    S_max = problem.inner.S_max
    names = ("an eigenvalue of L", "the others")
    if view.scalar:
        names = ("the model", "plant 2 (and the others)")
    rows: tuple[tuple[Place, ...], ...] = (
        (machine(problem, theta), S_panel(view)),
        (
            nyquist_panel(view.hz, loci(view), problem.inner.S_max, HEIGHT, names),
            move.drawing.rows[-2][0],
        ),
    )
    peak = float(view.sizes[0].max())
    table = isinstance(rows[0][0], Table)
    words = paragraph("report.glance", view, peak, S_max, move.caption, table)
    lines = Lines(rows, "At a glance", (HEIGHT, HEIGHT))
    return Chapter("At a glance", (Figure(lines, words, (*tables_of(lines), move.tables[0])),))


def loci(view: LoopView) -> list[np.ndarray]:
    """L of one channel on every plant, of several its eigenvalues on the model."""
    return [line for L in view.open for line in loci_of(L).T]


def machine(problem: CoDesignProblem, theta: Sequence[float]) -> Modes | Picture | Table:
    """Masses and springs with their modes, the first modes of a surface, or a table of modes."""
    plant = plant_of(problem)
    if plant.shapes is not None:
        return Modes(plant.shapes(theta, SHOWN_MODES))
    system = mechanics(plant, theta)
    return lumped_machine(system, modal_plant(system, problem.suspension.free))
