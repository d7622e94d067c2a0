"""The review of all pages: every finding, what became of it, and how a browser sees that.

B: what hindered a reader, C: what was ugly, D: what the best tools show. `seen` is an expression of
JavaScript on a page that holds where a finding is corrected, or the test that asserts it.
"""

from dataclasses import dataclass

import pytest
from oracles.chromium import axe_findings, chromium
from oracles.sources import ROOT


@dataclass(frozen=True)
class Finding:
    """`done`: what became of it; "open: why" where nothing did."""

    done: str
    page: str = ""
    seen: str = ""


DECISION = "document.querySelector('.decision').textContent"
HEAD = "document.querySelector('header')"
TABLE = "document.querySelector('main table')"
FINDINGS = {
    "B1": Finding("decision in colour; insight begins with a refusal", "insight.html",
                  f"{DECISION}.startsWith('Do not build this')"),
    "B2": Finding("the lines of the verdict are folded on other pages", "robustness.html",
                  f"{HEAD}.querySelector('details:not([open])').textContent.includes('verdict')"),
    "B3": Finding("ends of the [robust] set in the four plots, and words", "",
                  "tests/pages/test_findings.py::test_the_ends_of_the_set_are_drawn"),
    "B4": Finding("one table of feedforward by plant, with errors of 1 %", "report.html",
                  "[...document.querySelectorAll('table')].some(one => ['feedforward', 'plant', "
                  "'feedforward -1 %', 'feedforward +1 %'].every(word => "
                  "one.textContent.includes(word)))"),
    "B5": Finding("derivatives per 1 %, sorted, as bars", "insight.html",
                  "document.body.textContent.includes('1 % more of')"),
    "B6": Finding("the rate at the design, no average; no line through a hollow front", "",
                  "tests/pages/test_page_words.py::where it is heaviest, 0.1 at this design"),
    "B7": Finding("the case's units on the axes of maps", "report.html",
                  "[...document.querySelectorAll('svg[aria-label^=Landscape]')]"
                  ".every(one => one.textContent.includes('(kg)'))"),
    "B8": Finding("a picture of every machine", "report.html",
                  "document.querySelector('svg[aria-label=\"masses and springs\"]') !== null"),
    "B9": Finding("start against optimum", "brief.html",
                  "document.body.textContent.includes('Before and after')"),
    "B10": Finding("SVG and CSV at every figure", "report.html",
                   "[...document.querySelectorAll('main figure')].filter(one => "
                   "one.querySelector('svg[data-axes]')).every(one => "
                   "[...one.querySelectorAll('button')].length >= 2)"),
    "B11": Finding("five minutes first", "", "docs/first_stage.md::ccd new my_stage"),
    "B12": Finding("wider site", "", "docs/site.css::76rem"),
    "B13": Finding("pictures are stamped with what draws them", "",
                   "tests/commands/test_docs_pictures.py::test_no_picture_is_older_than_its_page"),
    "B14": Finding("pins on the map, status and legend in colour", "",
                   "tests/pages/test_explore_page.py::"
                   "test_a_notch_is_dragged_and_a_pin_is_on_the_map_without_scrolling"),
    "B15": Finding("tabs; development is one entry", "", "mkdocs.yml::navigation.tabs"),
    "B16": Finding("tune decides", "", "ccd_casadi/reporting/decision.py::_decide_loop"),
    "C1": Finding("one ground for |S|", "report.html",
                  "document.querySelectorAll(\"svg[aria-label='At a glance: |S| (–)'] "
                  "[id*=area]\").length === 1"),
    "C2": Finding("a single curve has its name without a box", "",
                  "tests/pages/test_labels.py::test_a_single_curve_has_its_name_and_no_box"),
    "C3": Finding("the co-design is blue in the comparison too", "",
                  "ccd_casadi/studies/compare_page.py::comparison.method(best), comparison"),
    "C4": Finding("labels keep apart", "",
                  "tests/pages/test_pages_in_browser.py::"
                  "test_words_outside_and_on_each_other_are_noticed"),
    "C5": Finding("local peaks are named so", "",
                  "tests/pages/test_limits.py::test_the_words_name_the_zero_that_limits_case_a"),
    "C6": Finding("provenance is folded", "report.html",
                  "[...document.querySelectorAll('details.chapter summary')]"
                  ".some(one => one.textContent.includes('Provenance'))"),
    "C7": Finding("the step of a force has linear time", "report.html",
                  "JSON.parse(document.querySelector('svg[aria-label*=\"after a step of\"]')"
                  ".dataset.axes).scales[0][2] === 0"),
    "C8": Finding("the shadow of a table that goes on does not hide it", "",
                  "tests/pages/test_pages_in_browser.py::"
                  "test_a_table_that_goes_on_has_a_shadow_there"),
    "C9": Finding("dark buttons, no empty room, axis titles of 12 px", "",
                  "tests/pages/test_explore_page.py::"
                  "test_a_notch_is_dragged_and_a_pin_is_on_the_map_without_scrolling"),
    "C10": Finding("pictures are dark in the dark theme; open: at 390 px their words are small", "",
                   "docs/site.css::filter: invert"),
    "C11": Finding("no bytecode in the site", "", "mkdocs.yml::__pycache__"),
    "C12": Finding("figures for developers are folded", "report.html",
                   "!document.querySelector('.lead').textContent.includes('‖')"),
    "C13": Finding("lines of 25 words", "", "tests/conftest.py::short_verdicts"),
    "D1": Finding("requirements are the first picture", "report.html",
                  f"{TABLE}.textContent.startsWith('requirement')"),
    "D2": Finding("a notch is dragged in the Bode plot", "",
                  "tests/pages/test_explorer.py::test_a_notch_is_judged_as_its_response_has_it"),
    "D3": Finding("two runs side by side; open: history and parallel coordinates, which need the "
                  "samples of a run in its page",
                  "changes.html", f"{TABLE}.textContent.startsWith('requirement')"),
    "D4": Finding("open: a coloured Jacobian is for many parameters, and insight has bars for few"),
    "D5": Finding("margins drawn on Bode", "report.html",
                  "[...document.querySelectorAll('svg')].some(one => "
                  "(one.getAttribute('aria-label') ?? '').startsWith('Bode plot') || "
                  "(one.getAttribute('aria-label') ?? '').includes('phase of L'))"),
    "D6": Finding("a gallery with thumbnails", "", "docs/gallery.md::.png"),
    "D7": Finding("modes swing; case, version and command on the brief", "brief.html",
                  "document.querySelector('.sways') !== null && "
                  "document.body.textContent.includes('To reproduce it: ccd solve')"),
    "boss": Finding("one A4 page", "brief.html",
                    "['Checks:', 'Next:', 'Risks', 'Requirements'].every(word => "
                    "document.body.textContent.includes(word))"),
}  # fmt: skip
# Of the worst sentences what was said, of which no source has a word any more.
SAID = (
    "after the figure's end", "least delay margin are", "and +-2 % is less",
    "the direction that no bound holds", "the samples around do not support the design",
    "true syntheses and", "the loop needs a look", "in SI an actuator moves", "of its surroundings",
    "an estimate, no bound", "adds to them stands beside it", "no step down to the smallest",
    "Per unit of the parameter", "no weights' frequencies to move", "others above S_max;",
    "largest is allowed bounds a part", "is wider by what",
)  # fmt: skip
PAGES = ("index", "report", "brief", "changes", "insight", "robustness", "deploy/report",
         "feedforward/report")  # fmt: skip
WIDTHS = (390, 1400, 1920)


@pytest.fixture(scope="module")
def browser():
    with chromium() as made:
        yield made


@pytest.mark.parametrize("name", FINDINGS)
def test_what_became_of_a_finding(browser, examined, name):
    finding = FINDINGS[name]
    if not finding.seen:
        assert finding.done.startswith("open: ")
    elif finding.page:
        page = browser.new_page()
        page.goto((examined / finding.page).as_uri())
        assert page.evaluate(finding.seen), finding.done
        page.close()
    else:
        file, _, words = finding.seen.partition("::")
        assert words in (ROOT / file).read_text(encoding="utf-8")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_no_page_is_wide_or_hard_to_use(browser, examined, name, scheme):
    """Nothing is wider than the window, and axe-core finds nothing serious, all of it unfolded."""
    page = browser.new_page(color_scheme=scheme)
    page.goto((examined / f"{name}.html").as_uri())
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert axe_findings(page) == []
    page.close()


@pytest.mark.parametrize("name", ["report", "robustness", "changes", "deploy/report",
                                  "feedforward/report"])  # fmt: skip
def test_no_axis_is_without_a_unit(browser, examined, name):
    """A panel is named by its axis: a unit in brackets, or a dash."""
    page = browser.new_page()
    page.goto((examined / f"{name}.html").as_uri())
    names = page.locator("svg[data-axes]").evaluate_all(
        "all => all.map(one => one.getAttribute('aria-label'))"
    )
    assert names
    own = ("Landscape", "samples predicted")  # of these the axes are inside
    bare = [one for one in names if "(" not in one and not one.startswith(own)]
    assert bare == []
    page.close()


def test_masses_of_a_mode_swing_and_rest_where_motion_is_not_wanted(browser, examined):
    for motion, swings in (("no-preference", True), ("reduce", False)):
        page = browser.new_page(reduced_motion=motion)
        page.goto((examined / "report.html").as_uri())
        name = page.locator(".sways").first.evaluate("one => getComputedStyle(one).animationName")
        assert (name != "none") == swings
        page.close()


def test_the_ends_of_the_set_are_drawn() -> None:
    from ccd_casadi.reporting.robustness_page import _required

    assert [level.value for level in _required(100.0, (-0.03, 0.03))] == [-3.0, 3.0]
    assert _required(1.0, (1.0, 1.0)) == ()


def test_no_source_says_what_readers_did_not_understand() -> None:
    files = [*(ROOT / "ccd_casadi").rglob("*.py"), *(ROOT / "ccd_casadi").rglob("*.txt"),
             *(ROOT / "ccd_casadi").rglob("*.html"), *(ROOT / "docs").glob("*.md")]  # fmt: skip
    text = " ".join(" ".join(file.read_text(encoding="utf-8").split()) for file in files)
    assert [words for words in SAID if words in text] == []


def test_every_finding_is_named() -> None:
    review = [*(f"B{i}" for i in range(1, 17)), *(f"C{i}" for i in range(1, 14)),
              *(f"D{i}" for i in range(1, 8)), "boss"]  # fmt: skip
    assert list(FINDINGS) == review
