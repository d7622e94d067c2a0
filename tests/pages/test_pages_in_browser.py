"""The pages of a run in a real browser: quiet, readable narrow and dark, whole in print, linked."""

import csv
import io
import json
import re
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import pytest
from oracles.chromium import chromium
from oracles.kept_pictures import picture
from PIL import Image

from ccd_casadi.drawing.content import Chapter, Head, Lines, Page, Steps, Table
from ccd_casadi.drawing.paint import page_html

WIDTHS, SCHEMES = (1920, 1300, 800, 390), ("light", "dark")
HEAVIEST = 1.5e6  # bytes of a page
# Numbers that are broken over two lines: of a text node's own boxes there is more than one height.
SPLIT = r"""() => {
  const found = [], walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT)
  for (let node; node = walk.nextNode();) {
    if (node.parentElement.closest("pre, script, style, svg, .meta, details:not([open])")) continue
    for (const m of node.data.matchAll(/[-+\u2212]?\d[\d.]*(e[-+]?\d+)?/g)) {
      const range = document.createRange()
      range.setStart(node, m.index)
      range.setEnd(node, m.index + m[0].length)
      if (new Set([...range.getClientRects()].map(box => Math.round(box.top))).size > 1)
        found.push(m[0])
    }
  }
  return found
}"""
# Words of a figure outside of it, or two on each other (boxes of 9 px letters have some air).
LABELS = r"""() => {
  const found = []
  for (const svg of document.querySelectorAll("svg[role=img]")) {
    if (!svg.checkVisibility()) continue
    const frame = svg.getBoundingClientRect()
    const texts = [...svg.querySelectorAll("text")].filter(each => each.checkVisibility())
      .map(each => [each.textContent.trim(), each.getBoundingClientRect()])
      .filter(([words, box]) => words && box.width > 0)
    texts.forEach(([words, a], i) => {
      if (a.left < frame.left - 1 || a.right > frame.right + 1 || a.top < frame.top - 1
          || a.bottom > frame.bottom + 1) found.push([words, "outside"])
      for (const [other, b] of texts.slice(0, i)) {
        const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left)
        const high = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top)
        if (wide > 1.5 && high > 0.25 * Math.min(a.height, b.height)) found.push([words, other])
      }
    })
  }
  return found
}"""
# Contrast to the page's ground, the least of all words and of all curves in the figures.
CONTRAST = r"""() => {
  const light = colour => {
    const c = colour.match(/[\d.]+/g).slice(0, 3).map(v => v / 255)
      .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2] + 0.05
  }
  const ground = light(getComputedStyle(document.documentElement).backgroundColor)
  const least = (selector, property) => Math.min(...[...document.querySelectorAll(selector)]
    .map(each => light(getComputedStyle(each)[property]))
    .map(v => Math.max(v, ground) / Math.min(v, ground)))
  return {words: least("svg text", "fill"), curves: least("[id*='-curve'] path", "stroke")}
}"""


OPEN = "document.querySelectorAll('.folded').forEach(one => one.open = true)"
# what is folded and has no height
HIDDEN = """() => [...document.querySelectorAll(".folded > :not(summary)")]
  .filter(one => !one.getClientRects().length || !one.getBoundingClientRect().height)
  .map(one => one.textContent.slice(0, 40))"""


# What a reader with a keyboard or a screen reader misses: names, headings, where to scroll.
ACCESS = r"""() => {
  const name = one =>
    one.getAttribute("aria-label") || one.labels?.[0]?.textContent || one.textContent
  const found = [], all = what => [...document.querySelectorAll(what)]
  for (const one of all("svg[role=img], button, a, input, summary, nav"))
    if (!name(one).trim()) found.push(`no name: ${one.outerHTML.slice(0, 60)}`)
  for (const svg of all("figure svg"))
    if (svg.getAttribute("role") !== "img" && !svg.closest("svg svg"))
      found.push("a figure without role")
  const navs = all("nav").map(name)
  if (new Set(navs).size < navs.length) found.push("two landmarks of one name")
  for (const th of all("th")) if (!th.textContent.trim()) found.push("an empty header")
  for (const one of all("div"))
    if (one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).overflowX === "auto" &&
        one.tabIndex < 0 && !one.querySelector("[tabindex='0'], a, button"))
      found.push(`scrolls without focus: ${one.className}`)
  const levels = all("h1, h2, h3").map(one => +one.tagName[1])
  if (levels[0] !== 1 || levels.some((level, i) => i && level > levels[i - 1] + 1))
    found.push(`headings ${levels}`)
  return found
}"""


@pytest.fixture(scope="module")
def one_browser():
    """For all tests here, which need no other event loop: to start one takes a second."""
    with chromium() as made:
        yield made


@pytest.fixture
def browser(one_browser):
    """The same without the pages of the test before."""
    yield one_browser
    for context in one_browser.contexts:
        context.close()


def complaints(page):
    """A list to which what the page complains of is added."""
    heard = []
    page.on("console", lambda said: heard.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: heard.append(str(error)))
    return heard


def looked_at(browser, pages, schemes=SCHEMES):
    """Every page at all widths in the themes, and printed."""
    for scheme in schemes:
        context = browser.new_context(color_scheme=scheme)
        page = context.new_page()
        heard = complaints(page)
        for place in pages:
            page.goto(place.as_uri())
            page.emulate_media(media="print")
            assert page.evaluate(HIDDEN) == [], place  # printed pages show what is folded
            page.emulate_media(media="screen")
            page.evaluate(OPEN)
            for width in WIDTHS:
                page.set_viewport_size({"width": width, "height": 900})
                assert page.evaluate("document.documentElement.scrollWidth") <= width, place
                assert page.evaluate(SPLIT) == [], (place, width)
                assert page.evaluate(LABELS) == [], (place, width)
                assert page.evaluate(ACCESS) == [], (place, width)
                picture(page, f"{name_of(place)}_{width}_{scheme}", whole=True)
            found = page.evaluate(CONTRAST)
            if page.locator("svg text").count():
                assert found["words"] >= 4.5, (place, scheme)
                assert found["curves"] >= 3.0, (place, scheme)
            page.emulate_media(media="print")
            page.set_viewport_size({"width": 680, "height": 960})  # A4 without its margins
            assert page.evaluate(SPLIT) == [], place
            assert page.evaluate(CONTRAST)["words"] >= 4.5  # on white, whatever the theme is
            assert page.pdf().startswith(b"%PDF")
            picture(page, f"{name_of(place)}_print", whole=True)
            page.emulate_media(media="screen")
        assert not heard
        context.close()


def test_a_figure_is_saved_as_a_picture_and_as_numbers(browser, solved):
    """All points as drawn: |S| of the page is that of result.json at its largest."""
    folder = solved("lifted")
    page = browser.new_page()
    page.goto((folder / "report.html").as_uri())
    figure = page.locator("figure").first
    saved = {}
    for kind in ("SVG", "CSV"):
        with page.expect_download() as waited:
            figure.get_by_role("button", name=f"Save this figure as {kind}").click()
        saved[kind] = Path(waited.value.path()).read_text("utf-8")
        assert waited.value.suggested_filename == f"at-a-glance-1.{kind.lower()}"
    assert ElementTree.fromstring(saved["SVG"]).findall(".//{http://www.w3.org/2000/svg}path")
    head, *rows = csv.reader(io.StringIO(saved["CSV"]))
    assert head == ["x axis", "y axis", "curve", "x", "y"]
    peak = max(float(row[4]) for row in rows if row[1].startswith("|S|"))
    result = json.loads((folder / "result.json").read_text())
    assert peak == pytest.approx(result["sensitivity_peak"], rel=0.01)  # as far as it is drawn


def name_of(place):
    """Of a page in pictures: index, report, deploy, insight, robustness."""
    return place.parent.name if place.parent.name == "deploy" else place.stem


def test_the_pages_of_a_run_are_read_on_any_screen_and_on_paper(browser, solved):
    folder = solved("lifted")
    page = browser.new_page()
    page.goto((folder / "index.html").as_uri())
    page.get_by_role("link", name="Co-design of").click()
    assert page.url == (folder / "report.html").as_uri()
    assert (folder / "report.html").stat().st_size < HEAVIEST
    page.get_by_role("link", name="Loop, plant and controller").click()  # of the contents list
    top = page.get_by_role("heading", name="Loop, plant and controller").bounding_box()["y"]
    assert -1.0 <= top < 200.0
    looked_at(browser, [folder / "report.html"], ["dark"])  # the rest is behind slow


def test_one_cursor_reads_all_curves_over_frequency(browser, solved):
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    page.goto((solved("lifted") / "report.html").as_uri())
    page.evaluate(OPEN)
    place = page.locator("svg[aria-label='At a glance: |S| (–)']")
    place.scroll_into_view_if_needed()
    place.hover()
    shown = page.locator("svg .readout:visible")
    words = [text for text in shown.all_text_contents() if text]
    assert len({text.split(" · ")[0] for text in words}) == 1  # one frequency
    for name in ("|S|", "|KS|", "|T|", "|G|", "|K|", "|L|", "phase of L"):
        assert any(f" {name} " in f" {text.replace(' · ', ' ')} " for text in words), name
    assert all(text.split(" · ")[0].endswith(" Hz") for text in words)
    assert any(re.search(r"\|KS\| \S+ N/m", text) for text in words)
    value = r"([\d.]+)(?:·10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?"
    plain = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")

    def read(name: str) -> float:
        found = next(filter(None, (re.search(rf" {name} {value}", text) for text in words)))
        return float(found[1]) * 10.0 ** int((found[2] or "0").translate(plain))

    picture(page, "cursor_over_frequency")
    # read off different pictures: |L| = |G| |K|
    product = read(r"\|G\|") * read(r"\|K\|")
    assert read(r"\|L\|") == pytest.approx(product, rel=0.03)


def test_the_cursor_of_a_nyquist_plot_reads_its_frequency(browser, solved):
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    page.goto((solved("lifted") / "report.html").as_uri())
    page.evaluate(OPEN)
    plot = page.locator("svg[aria-label='At a glance: Im L (–)']")
    plot.scroll_into_view_if_needed()
    d = json.loads(plot.get_attribute("data-axes"))
    middle = sum(d["scales"][1][3:]) / 2.0
    x, y, hz = max(d["locus"], key=lambda point: abs(point[1] - middle))
    box, (*_, wide, _) = plot.bounding_box(), map(float, plot.get_attribute("viewBox").split())
    page.mouse.move(box["x"] + x * box["width"] / wide, box["y"] + y * box["width"] / wide)
    words = plot.locator(".readout").text_content()
    found = re.fullmatch(r"(\S+) Hz · L (\S+) ([−+]) (\S+) i · (\S+) from −1", words)
    assert float(found[1]) == pytest.approx(hz, rel=0.01)
    L = complex(float(found[2]), float(found[4]) * (-1) ** (found[3] == "−"))
    assert abs(1.0 + L) == pytest.approx(float(found[5]), abs=0.02)
    picture(page, "cursor_in_nyquist")
    others = [text for text in page.locator("svg .readout:visible").all_text_contents() if text]
    assert len(others) > 5
    assert {text.split(" · ")[0] for text in others} == {f"{found[1]} Hz"}  # one frequency on all
    size = next(text.split(" · ")[1] for text in others if " · |L| " in text)
    assert float(size.removeprefix("|L| ")) == pytest.approx(abs(L), rel=0.05, abs=0.02)


def test_a_part_of_a_figure_is_enlarged_and_the_whole_shown_again(browser, solved):
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    heard = complaints(page)
    page.goto((solved("lifted") / "report.html").as_uri())
    page.evaluate(OPEN)
    plot = page.locator("svg[aria-label='At a glance: |S| (–)']")
    plot.scroll_into_view_if_needed()
    box, before = plot.bounding_box(), plot.screenshot()
    low, high, _, left, right = json.loads(plot.get_attribute("data-axes"))["scales"][0]
    scale = box["width"] / float(plot.get_attribute("viewBox").split()[2])

    def at(share, down):
        return box["x"] + (left + share * (right - left)) * scale, box["y"] + down * box["height"]

    page.mouse.move(*at(0.5, 0.3))
    page.mouse.down()
    page.mouse.move(*at(0.9, 0.6), steps=3)
    page.mouse.up()
    page.mouse.move(*at(0.25, 0.4))
    hz = float(plot.locator(".readout").text_content().split(" Hz")[0])
    assert hz == pytest.approx(low * (high / low) ** (0.5 + 0.25 * 0.4), rel=0.02)
    assert plot.locator(".scale text").count() >= 4  # scales written anew
    assert not plot.locator("[id*=xtick_1]").is_visible()
    picture(page, "figure_enlarged")
    page.mouse.dblclick(*at(0.25, 0.4))
    page.mouse.move(0.0, 0.0)
    assert plot.screenshot() == before
    assert not heard


def test_a_part_of_a_map_is_enlarged(browser, solved):
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    heard = complaints(page)
    page.goto((solved("lifted") / "report.html").as_uri())
    page.evaluate(OPEN)
    plot = page.locator(".whole svg[aria-label^=Landscape]")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    _, _, _, left, right = json.loads(plot.get_attribute("data-axes"))["scales"][0]
    scale = box["width"] / float(plot.get_attribute("viewBox").split()[2])
    dots = plot.locator("[id*=-mark-truths] use")
    before = [float(dot.get_attribute("x")) for dot in dots.all()]
    start = box["x"] + left * scale
    page.mouse.move(start + 5.0, box["y"] + 0.2 * box["height"])
    page.mouse.down()
    page.mouse.move(start + 0.5 * (right - left) * scale, box["y"] + 0.6 * box["height"], steps=3)
    page.mouse.up()
    picture(page, "map_enlarged")
    after = [float(dot.get_attribute("x")) for dot in dots.all()]
    assert max(after) - min(after) == pytest.approx(2.0 * (max(before) - min(before)), rel=0.1)
    assert plot.locator(".scale text").count() >= 4
    assert not heard


@pytest.mark.parametrize("width", [390, 1300])
def test_a_table_that_goes_on_has_a_shadow_there(browser, tmp_path, width):
    place = tmp_path / "page.html"
    wide = Table(tuple(f"a column {i}" for i in range(9)), (tuple(range(9)),))
    head = Head("a page", "good", "", "", "", "")
    place.write_text(page_html(Page(head, (Chapter("A table", (wide,)),))), encoding="utf-8")
    page = browser.new_page(viewport={"width": width, "height": 500}, color_scheme="light")
    page.goto(place.as_uri())
    box = page.locator(".table").bounding_box()
    right = {"x": box["x"] + box["width"] - 4, "y": box["y"] + 4, "width": 4, "height": 4}
    shown = Image.open(BytesIO(page.screenshot(clip=right))).convert("L").getextrema()[0]
    assert (shown < 200) == (width == 390)  # a grey there, and else white
    picture(page, f"wide_table_{width}")


def test_words_outside_and_on_each_other_are_noticed(browser):
    page = browser.new_page()
    words = [("in", 10, 20), ("on", 12, 22), ("out", 95, 50), ("free", 30, 80)]
    texts = "".join(f'<text x="{x}" y="{y}">{word}</text>' for word, x, y in words)
    page.set_content(f'<svg role="img" width="100" height="100">{texts}</svg>')
    assert page.evaluate(LABELS) == [["on", "in"], ["out", "outside"]]


@pytest.mark.slow
def test_what_is_not_accessible_is_noticed(browser):
    page = browser.new_page(viewport={"width": 390, "height": 900})
    page.set_content(
        "<h2>first</h2><nav>a</nav><nav>a</nav><table><tr><th></th></tr></table><button></button>"
        "<div style='overflow-x: auto; width: 90px'><p style='width: 500px'>wide</p></div>"
    )
    found = " ".join(page.evaluate(ACCESS))
    for words in ("no name", "two landmarks", "empty header", "without focus", "headings 2"):
        assert words in found


def test_every_page_of_a_run(browser, examined):
    folder = examined
    page = browser.new_page()
    page.goto((folder / "index.html").as_uri())
    linked = page.locator("li a").evaluate_all("links => links.map(link => link.href)")
    linked = [link for link in linked if link.endswith(".html")]  # data stand beside the pages
    pages = sorted(folder.rglob("*.html"))
    assert sorted([*linked, (folder / "index.html").as_uri()]) == [p.as_uri() for p in pages]
    assert len(pages) == 8
    looked_at(browser, [place for place in pages if place.stem != "brief"])


def test_a_slider_shows_one_step_at_a_time(browser, tmp_path):
    steps = tuple((f"step {i}", Lines(((Table(("",), ((i,),)),),), "")) for i in range(4))
    place = tmp_path / "page.html"
    section = Chapter("Steps", (Steps(steps, 1, "first to last"),))
    head = Head("a page", "good", "", "", "", "")
    place.write_text(page_html(Page(head, (section,))), encoding="utf-8")
    page = browser.new_page()
    heard = complaints(page)
    page.goto(place.as_uri())
    shown = page.locator(".step:visible")
    assert [text.split() for text in shown.all_inner_texts()] == [["step", "1", "1"]]
    slider = page.locator("input[type=range]")
    slider.focus()
    for key, expected in (("End", "3"), ("ArrowLeft", "2"), ("Home", "0")):
        page.keyboard.press(key)
        assert [text.split()[-1] for text in shown.all_inner_texts()] == [expected]
    page.emulate_media(media="print")
    assert not slider.is_visible()
    assert shown.count() == 1
    assert not heard
    page.close()
