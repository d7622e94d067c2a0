"""Pictures of the stage: surfaces closed and to scale, drawings true to θ, pages that stay safe."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from functools import cache
from xml.etree import ElementTree

import numpy as np
import pytest

from ccd_casadi.drawing.content import Block, Chapter, Head, Page, Panel, Words
from ccd_casadi.drawing.paint import block_html, page_html
from ccd_casadi.drawing.surface import (
    HEIGHT,
    MARGIN,
    REACH,
    WIDTH,
    box_scale,
    camera,
    colours,
    data,
    still,
)
from ccd_casadi.drawing.svg import ModeShape, ModeShapes
from ccd_casadi.extensions.rib_stage.geometry import COARSE, UPPER, Geometry, PointMass, bays, mass
from ccd_casadi.extensions.rib_stage.model import RibStage
from ccd_casadi.extensions.rib_stage.pictures import drawing, mode_shapes
from ccd_casadi.reporting.machine import mode_shape_figure, table_modes

Array = np.ndarray
A = (1e-3, 3e-3, 8e-3, 8e-3, 16.806e-3, 67.5e-3)
B = (1e-3, 3e-3, 4.2446e-3, 4.0588e-3, 11.917e-3, 74.974e-3)
STAGE = RibStage(order=COARSE)
HOSTILE = '</text><script>alert(1)</script>"&'


@cache
def modes_figure() -> str:
    return block_html(mode_shape_figure(mode_shapes(STAGE, A)), "f")


def page(*blocks: Block) -> str:
    return page_html(Page(Head("t", "good", "", "", "", ""), (Chapter("s", blocks),)))


def svgs(html: str) -> list[ElementTree.Element]:
    return [ElementTree.fromstring(t) for t in re.findall(r"<svg.*?</svg>", html, re.DOTALL)]


def volume(surface: ModeShapes) -> float:
    """By the divergence theorem, of flat quads."""
    a, b, c, d = surface.points[surface.faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", (a + c) / 2.0, np.cross(c - a, d - b)) / 6.0)


def assert_closed(quads: Array) -> None:
    """Every edge is run through once each way."""
    edges = [(q[i], q[(i + 1) % 4]) for q in quads.tolist() for i in range(4)]
    assert len(edges) == len(set(edges))
    assert {(b, a) for a, b in edges} == set(edges)


# ---- surfaces ---------------------------------------------------------------------------------


@pytest.mark.parametrize("theta", [A, B, UPPER], ids=["a", "b", "thick"])
def test_the_surface_is_closed_and_encloses_the_material(theta) -> None:
    surface = mode_shapes(STAGE, theta, 1)
    assert_closed(surface.faces)
    expected = mass(STAGE.geometry, theta) / STAGE.geometry.material.density
    assert volume(surface) == pytest.approx(expected, rel=1e-12)


def test_the_surface_counts_its_faces() -> None:
    rib, bay = 1, 4  # cells a rib and a bay along an axis; the centre rib is two halves
    across = 6 * rib + 4 * bay
    below, walls, edge = across**2, 16 * 4 * bay, 4 * across * 2
    assert len(mode_shapes(STAGE, A, 1).faces) == 2 * below + walls + edge == 1400


# ---- projection and painting ------------------------------------------------------------------


def test_camera_looks_from_where_it_says() -> None:
    x, y, z = np.eye(3)
    # from the front (-y): x to the right, z up, the near side towards us
    assert camera(np.array([x, y, z]), -90.0, 0.0) == pytest.approx(
        np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), abs=1e-15
    )
    half = np.sqrt(0.5)
    assert camera(z[None], 17.0, 45.0) == pytest.approx(np.array([[0, half, half]]))
    turned = camera(np.eye(3), 33.0, -21.0)
    assert turned @ turned.T == pytest.approx(np.eye(3))


@pytest.mark.parametrize("elevation", [-90.0, -20.0, 0.0, 38.0, 90.0])
def test_a_moved_box_stays_inside_its_frame_however_it_is_turned(elevation: float) -> None:
    size, reach = np.array([0.3, 0.3, 0.02]), 0.024
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
    corners[:, 2] += reach * np.sign(corners[:, 2])
    scale = box_scale(size, reach, elevation)
    spans = [np.abs(scale * camera(corners, a, elevation)).max(axis=0) for a in range(0, 360, 5)]
    right, up, _ = np.max(spans, axis=0)
    assert right <= WIDTH / 2 - MARGIN + 1e-9
    assert up <= HEIGHT / 2 - MARGIN + 1e-9
    assert right > WIDTH / 2 - MARGIN - 1 or up > HEIGHT / 2 - MARGIN - 1


def test_still_picture_leaves_out_back_faces_and_paints_near_last() -> None:
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0],
                       [-1, -1, 0.1], [1, -1, 0.1], [1, 1, 0.1], [-1, 1, 0.1]], float)  # fmt: skip
    quads = np.array([[4, 5, 6, 7], [0, 1, 2, 3], [0, 3, 2, 1]])  # above, below, below from below
    moves = np.zeros((8, 3))
    moves[:4, 2] = 1.0
    mode = ModeShape(moves, 1.0, (1,))
    svg = still(ModeShapes(points, quads, (mode,)), mode, 'a "b" <c>')
    root = ElementTree.fromstring(svg)
    paths = root.findall(".//path")
    assert root.get("aria-label") == 'a "b" <c>'
    assert len(paths) == 2  # one of three looks away
    # all of the lower face moves by 8 % of the width and comes above the other, which rests
    first, last = (p.get("color") for p in paths)
    brightness = [int(c[i : i + 2], 16) for c in (first, last) for i in (1, 3, 5)]
    rest, most = colours(np.array([0.0, 1.0]))
    ratio = np.array(brightness[:3]) / rest
    assert np.ptp(ratio[[0, 2]]) < 0.03  # the light dims all three alike
    assert np.array(brightness[3:]) / most == pytest.approx(np.full(3, ratio[0]), abs=0.03)
    numbers = [int(v) for v in re.findall(r"-?\d+", paths[0].get("d", ""))]
    corner = camera(np.array([[-1.0, -1.0, 0.05]]), -62.0, 44.0)[0]
    scale = box_scale(np.array([2.0, 2.0, 0.1]), 2 * REACH, 44.0)
    assert numbers[:2] == [round(10 * scale * corner[0]), round(-10 * scale * corner[1])]


# ---- mode shapes ------------------------------------------------------------------------------


def test_modes_have_names_in_words_and_pairs_are_one() -> None:
    modes = mode_shapes(STAGE, A, 6).modes
    words = ["twist", "saddle x² − y²", "bowl", "bent tilt", "second bowl", "second twist"]
    assert [m.words for m in modes] == words
    assert [m.numbers for m in modes] == [(1,), (2,), (3,), (4, 5), (6,), (7,)]
    hertz = [m.frequency for m in modes]
    assert hertz == pytest.approx([264.0, 826.4, 916.6, 950.6, 1535.0, 1567.9], abs=0.1)
    # a mode that the model leaves out is shown all the same
    few = mode_shapes(RibStage(order=COARSE, outputs="corners"), A, 8).modes
    assert [m.numbers[0] for m in few] == [1, 2, 3, 4, 6, 7, 8, 10]
    assert few[-1].frequency == pytest.approx(1740, abs=20)


def test_corners_do_not_see_the_saddle() -> None:
    rows = table_modes(mode_shapes(STAGE, A, 3)).rows
    assert rows[0][4] > 0.95  # the twist is largest there
    assert rows[1][4] < 1e-9
    assert rows[2][3] == pytest.approx(2.796, abs=1e-3)


def test_lopsided_stage_has_pictures_without_symmetry() -> None:
    stage = RibStage(Geometry(point_masses=(PointMass(0.1, 0.12, 0.05),)), order=COARSE)
    html = block_html(mode_shape_figure(mode_shapes(stage, A, 10)), "f")
    found = re.findall(r"<p>(\d+): bending, ", html)
    assert found == [str(i) for i in range(1, 11)]
    assert "A1" not in html


def test_mode_figure_is_sound_small_and_holds_the_script_s_data() -> None:
    html = modes_figure().replace("\xa0", " ")
    pictures = svgs(html)
    assert len(pictures) == 7  # six modes and the scale
    assert "4 and 5: bent tilt, a pair, 950.6" in html
    assert not re.search(r"\b(A1|A2|B1|B2|SA|AS)\b", html)
    found = re.search(r'<script type="application/json">(.*?)</script>', html)
    assert found is not None
    content = json.loads(found[1])
    count = len(content["points"]) // 3
    assert len(content["quads"]) == 4 * 1400
    assert max(content["quads"]) == count - 1
    assert content["size"] == [3000, 3000, 178]
    assert content["reach"] == 240
    for field in content["fields"]:
        size = np.linalg.norm(np.array(field).reshape(count, 3), axis=1)
        assert size.max() == pytest.approx(999, abs=1.0)
    assert len(html) < 450_000
    assert "the largest is drawn as 8 % of the side" in html
    assert html.count("<details>") == 1


def test_data_cannot_end_its_script_element() -> None:
    surface = mode_shapes(STAGE, A, 1)
    still = replace(surface.modes[0], displacement=np.zeros_like(surface.points), words=HOSTILE)
    text = data(replace(surface, modes=(still,)))  # at rest: no 0/0
    assert "<" not in text
    assert set(json.loads(text)["fields"][0]) == {0}


def test_page_allows_its_scripts_and_nothing_else() -> None:
    plain = page(Words("x"))
    assert "script" not in plain
    figure = mode_shape_figure(mode_shapes(STAGE, A))
    text = page(figure, figure)
    scripts = re.findall(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    assert len(scripts) == 2  # that turns shapes, and that saves figures: once each
    digests = [base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in scripts]
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None
    allowed = policy[1].partition("; script-src ")[2].split()
    assert sorted(allowed) == sorted(f"'sha256-{digest}'" for digest in digests)
    assert policy[1].startswith("default-src 'none';")
    assert "://" not in text.replace("http://www.w3.org/2000/svg", "")  # a name: nothing is fetched


# ---- dimensions -------------------------------------------------------------------------------


def inside_plan(panel: Panel) -> float:
    """Share of the square that is shaded, by the divergence theorem."""
    (area,) = panel.forbidden
    x, y = area.x, area.y
    return abs(0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))) / 300.0**2


def test_drawing_is_to_scale() -> None:
    plans, cuts = drawing(Geometry(), {"start": A, "end": B}).drawing.rows
    assert [plan.title for plan in plans] == ["start, 1.019 kg", "end, 0.59 kg"]
    for plan, cut, theta in zip(plans, cuts, (A, B), strict=True):
        h, H = (1e3 * theta[i] for i in (0, 4))
        outer, inner = (1e3 * width for width in bays(Geometry(), theta))
        assert inside_plan(plan) == pytest.approx(1.0 - (2.0 * (outer + inner) / 300.0) ** 2)
        assert plan.equal
        assert plan.x_range == plan.y_range
        assert np.nanmax(np.abs(plan.curves[0].x)) == pytest.approx(150.0)
        (outline,) = cut.curves
        assert (outline.y.min(), outline.y.max()) == pytest.approx((0.0, h + H))
        shares = mass(Geometry(), theta) / 2700.0 * 1e9  # mm³, of the plate and of the ribs
        ribs = inside_plan(plan) * 300.0**2 * H
        assert ribs + 300.0**2 * h == pytest.approx(shares, rel=1e-9)


def test_dimension_figure_has_a_caption_with_numbers_and_a_table() -> None:
    words = drawing(Geometry(), {"start": A, "end": B}).caption
    assert "From start to end the mass goes from 1.0189 to 0.59001 kg (−42.1 %)." in words
    assert "Changed: t_c (−49.3 %), t_i (−46.9 %), H (−29.1 %), x_i (+11.1 %)." in words
    rows = {row[0]: row[2:] for row in drawing(Geometry(), {"a": A, "b": B}).tables[0].rows}
    assert rows["t_c"] == ("mm", 8.0, pytest.approx(4.0588))
    assert rows["b_1"] == ("mm", pytest.approx(75.5), pytest.approx(69.9037))
    assert rows["mass"] == ("kg", pytest.approx(1.01891, rel=1e-4), pytest.approx(0.59, rel=1e-3))


def test_one_stage_three_stages_hostile_names_and_point_masses() -> None:
    assert "Changed" not in drawing(Geometry(), {"start": A}).caption
    assert "No parameter changes." in drawing(Geometry(), {"a": A, "b": A}).caption
    masses = Geometry(point_masses=(PointMass(0.0, 0.15, 0.1),))
    assert "Dots" not in drawing(Geometry(), {"start": A}).caption
    assert "Dots: masses" in drawing(masses, {"start": A}).caption
    found = drawing(masses, {HOSTILE: A, "x" * 90: B, "c": A})
    html = block_html(found, "f")
    assert "<script" not in html
    plans, _ = found.drawing.rows
    assert plans[0].title == f"{HOSTILE}, 1.119 kg"
    assert plans[1].title == f"{'x' * 39}…, 0.69 kg"
    assert all(plan.curves[1].marker == "o" for plan in plans)
    alone, _ = drawing(masses, {"a": A}).drawing.rows
    assert alone[1] is None  # half a page, as beside another
