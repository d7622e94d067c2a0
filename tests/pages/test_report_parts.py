"""Parts of a page alone: figures, landscapes, tables, pictures of a stranger."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.html_document import Document

from ccd_casadi.drawing.charts import figure_landscape
from ccd_casadi.drawing.content import (
    Chapter,
    Curve,
    Head,
    Landscape,
    Lines,
    Page,
    Panel,
    Picture,
    Table,
    ThetaPath,
    Words,
)
from ccd_casadi.drawing.paint import block_html, page_html
from ccd_casadi.report import main as report_command


def test_figures_are_deterministic_and_keep_the_callers_style() -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    x = np.linspace(1.0, 10.0, 5)
    panel = Panel("time (s)", "cost ($a$ & <b>) (–)", (Curve(x, x**2, "J"),), log_y=True)
    drawn = [block_html(Lines(((panel,),), "<t>"), "k") for _ in range(2)]
    assert drawn[0] == drawn[1]
    assert "cost ($a$ &amp; &lt;b&gt;)" in drawn[0]
    assert 'aria-label="&lt;t&gt;: cost' in drawn[0]
    assert dict(matplotlib.rcParams) == before


def test_landscape_takes_several_paths_and_unknown_letters() -> None:
    axis = np.linspace(0.0, 1.0, 5)
    field = axis[:, None] + axis
    field[0, 0] = np.nan
    ways = np.array([[0.1, 0.2], [0.9, 0.8]])
    land = Landscape(
        ("a", "b"), ("天", "x" * 90), axis, axis, field, np.array([[0.5, 0.5, 1.0]]),
        np.empty((0, 2)), forbidden=field > 1.5, region=(0.2, 0.6, 0.2, 0.6),
        paths=tuple(ThetaPath(name, ways) for name in ("ours", "theirs")), optimum=(0.9, 0.8),
    )  # fmt: skip
    svg = figure_landscape(land, "two")
    Document(svg)
    assert all(word in svg for word in ("ours", "theirs", "天", "…"))


def test_tables_round_and_escape() -> None:
    html = block_html(Table(("<a>", "n"), (("&", 1.0 / 3.0), ("x", float("nan")))))
    Document(html)
    assert "&lt;a&gt;" in html
    assert "&amp;" in html
    assert '<td class="n">0.33333</td>' in html
    assert '<td class="n">–</td>' in html
    head = Head("t", "good", "", "", "", "")
    Document(page_html(Page(head, (Chapter("<h>", (Words("x"),)),))))


@pytest.mark.parametrize(
    "svg",
    [
        "<svg><script>alert(1)</script></svg>",
        '<svg onload="alert(1)"/>',
        '<svg><a href="https://elsewhere.example"><text>here</text></a></svg>',
        "<svg><foreignObject><p>words</p></foreignObject></svg>",
        '<svg><rect style="fill: url(https://elsewhere.example)"/></svg>',
        "</figure><h1>words of somebody else</h1>",
        '<!DOCTYPE svg [<!ENTITY a "aaaa">]><svg><text>&a;</text></svg>',
    ],
)
def test_a_picture_of_a_strangers_report_holds_shapes_and_words_alone(
    two_mass_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], svg: str
) -> None:
    with pytest.raises(ValueError, match="picture"):
        Picture(svg)
    shutil.copy(two_mass_run / "report.json", tmp_path)
    place = tmp_path / "report.json"
    text = json.loads(place.read_text(encoding="utf-8"))

    def planted(item: Any) -> int:
        if isinstance(item, dict):
            if item.get("") == "Picture":
                item["svg"] = svg
                return 1
            return sum(map(planted, item.values()))
        return sum(map(planted, item)) if isinstance(item, list) else 0

    assert planted(text) > 0
    place.write_text(json.dumps(text), encoding="utf-8")
    assert report_command([str(tmp_path), "--quiet"]) == 2
    assert "is not what a page shows" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()
