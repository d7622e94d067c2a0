"""Every colour of words against its ground, in both themes, from the style sheets themselves."""

import re

import pytest

from ccd_casadi.drawing.charts import GROUND, RING
from ccd_casadi.drawing.paint import theme
from ccd_casadi.drawing.svg import COLOUR_MAP, THEME
from ccd_casadi.support.text import package_text

LEAST, LEAST_OF_CURVES = 4.5, 3.0  # of WCAG 2.2: 1.4.3 for words, 1.4.11 for what is drawn
SHEETS = ("drawing/assets/page.css", "drawing/assets/steps.css", "drawing/assets/turntable.css")
DARK = re.compile(r"@media screen and \(prefers-color-scheme: dark\) \{\s*(:root \{[^}]*\})\s*\}")
RULE = re.compile(r"([^{};]+)\{([^{}]*)\}")
NAME = re.compile(r"--([\w-]+): (#\w+)")


def luminance(colour: str) -> float:
    digits = colour.removeprefix("#")
    digits = "".join(2 * d for d in digits) if len(digits) == 3 else digits
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    """Of WCAG: 1 for equal colours, 21 for black on white."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def words_on_grounds(sheet: str, named: dict[str, str], ink: str, paper: str) -> dict[str, float]:
    """Contrast of every rule that sets a colour or a ground; what it does not set it inherits."""
    found = {}
    for selector, body in RULE.findall(sheet):
        value = r"(#\w+|var\(--[\w-]+\))"
        colour = re.search(rf"(?<![-\w])color: {value}", body)
        ground = re.search(rf"background(?:-color)?: {value}(?=[;\s]|$)", body)
        if colour or ground:
            pair = (colour[1] if colour else ink, ground[1] if ground else paper)
            read = [named[v[6:-1]] if v.startswith("var") else v for v in pair]
            found[selector.strip()] = contrast(*read)
    return found


@pytest.mark.parametrize("which", [0, 1])
def test_words_of_a_page_can_be_read(which: int) -> None:
    named = dict(NAME.findall(theme(which)))
    for place in SHEETS:
        sheet = package_text(place)
        plain = DARK.sub("", sheet)
        for root in re.findall(r":root \{[^}]*\}", plain):
            named |= dict(NAME.findall(root))
        for root in DARK.findall(sheet) if which else []:
            named |= dict(NAME.findall(root))
        found = words_on_grounds(plain, named, "var(--ink)", "var(--paper)")
        assert {rule: ratio for rule, ratio in found.items() if ratio < LEAST} == {}, place
        assert len(found) >= 10 or place != SHEETS[0]
    for name in set(THEME) - {"paper", "grid", "shade"}:
        assert contrast(named[name], named["paper"]) >= LEAST_OF_CURVES, name
    assert min(contrast(named[name], named["paper"]) for name in ("ink", "grey", "axis")) >= LEAST


@pytest.mark.parametrize("which", [0, 1])
def test_words_of_the_explorer_can_be_read(which: int) -> None:
    sheet = package_text("extensions/explorer/page.html").split("<style>")[1].split("</style>")[0]
    choice = r'\{\{ "([^"]*)" if dark else "([^"]*)" \}\}'
    sheet = re.sub(choice, lambda found: found[1] if which else found[2], sheet)
    sheet = sheet.replace("{{ css }}", "")
    body = re.search(r"body \{[^}]*background: (#\w+); color: (#\w+)", sheet)
    assert body is not None
    paper, ink = body.groups()
    found = words_on_grounds(sheet, dict(NAME.findall(theme(which))), ink, paper)
    assert {"body", "#lost"} <= set(found)
    assert {rule: ratio for rule, ratio in found.items() if ratio < LEAST} == {}


def test_marks_of_a_map_are_seen_on_every_colour_of_it() -> None:
    colours = pytest.importorskip("matplotlib").colormaps[COLOUR_MAP](range(256), bytes=True)
    for red, green, blue, _ in colours.tolist():
        place = f"#{red:02x}{green:02x}{blue:02x}"
        assert max(contrast(RING, place), contrast(GROUND, place)) >= LEAST_OF_CURVES


def test_the_ruler_itself() -> None:
    assert contrast("#000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#767676", "#fff") == pytest.approx(4.54, abs=0.01)  # the known limit of grey
    rule = "p { margin: 0; color: #777; } pre { background: var(--x); }"
    found = words_on_grounds(rule, {"x": "#fff"}, "#000", "#fff")
    assert found == {"p": pytest.approx(4.48, abs=0.01), "pre": pytest.approx(21.0)}
