"""The explorer in a real browser: dragged, refused with a bad token, its server killed."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from oracles.chromium import axe_findings
from oracles.kept_pictures import picture

from ccd_casadi import explore
from ccd_casadi.cases.case import load_case
from ccd_casadi.extensions.explorer.session import Session
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support import errors
from ccd_casadi.support.text import package_text

PATIENCE = 240e3  # ms: the machine may be busy
# Pixels of one unit of Re L and of Im L.
SCALES = """(() => {
  const of = view => view.model.name === "nyquist" ? view
    : (view.child_views ?? []).map(of).find(found => found != null)
  const found = Object.values(globalThis.Bokeh?.index ?? {}).map(of).find(v => v != null)
  if (found?.frame?.x_scale == null) return []
  const {x_scale: x, y_scale: y} = found.frame
  return [Math.abs(x.compute(1) - x.compute(0)), Math.abs(y.compute(1) - y.compute(0))]
})()"""
READY = "Bokeh?.documents[0]?.get_model_by_name('answer')?.data.serial[0] > 0"


@pytest.fixture
def server(tmp_path, request):
    """The command as a user gives it, and the address that it prints."""
    case = getattr(request, "param", "runs/two_mass.toml")
    command = [sys.executable, "-m", "ccd_casadi.explore", case, "--no-open"]
    started = subprocess.Popen(
        [*command, "--out", str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    found = re.search(r"http://127\.0\.0\.1:\d+/\S+", started.stdout.readline())
    assert found is not None
    yield started, found[0]
    started.kill()
    started.communicate()


def opened(browser, url, width=1300, scheme="light"):
    """The page, ready, and the list to which its complaints are added."""
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page, heard = context.new_page(), []
    page.set_default_timeout(PATIENCE)
    page.on("console", lambda said: heard.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: heard.append(str(error)))
    page.on("request", lambda sent: heard.append(sent.url) if "127.0.0.1" not in sent.url else None)
    page.goto(url)
    page.wait_for_function(READY)
    return page, heard


@pytest.mark.slow  # a browser: CI has that of the pages
def test_it_is_dragged_answers_and_says_when_its_server_is_gone(browser, server, tmp_path):
    started, url = server
    page, heard = opened(browser, url)
    before = page.evaluate("Bokeh.documents[0].get_model_by_name('answer').data.serial[0]")
    handle = page.locator(".noUi-handle").first.bounding_box()
    track = page.locator(".noUi-target").first.bounding_box()
    page.mouse.move(handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2)
    page.mouse.down()
    for share in (0.7, 0.5, 0.3):
        page.mouse.move(track["x"] + share * track["width"], handle["y"] + handle["height"] / 2)
    page.mouse.up()
    # let go: the answer of a full search at the slider's own value
    page.wait_for_function(
        """() => {
          const model = name => Bokeh.documents[0].get_model_by_name(name)
          const {theta, how} = model("answer").data
          return theta[0][0] == model("theta_m1").value && how[0].startsWith("full inner search")
        }"""
    )
    after, theta = page.evaluate(
        "(d => [d.serial[0], d.theta[0]])(Bokeh.documents[0].get_model_by_name('answer').data)"
    )
    assert after > before
    assert 55.0 < theta[0] < 67.0
    page.get_by_text("certified, keeps its bounds").wait_for()
    hz, gain = page.evaluate(
        "(d => [[...d.xs[0]], [...d.ys[0]]])(Bokeh.documents[0].get_model_by_name('own_S').data)"
    )
    assert hz == sorted(hz)
    assert len(hz) == len(gain)
    assert max(gain) == pytest.approx(1.75, rel=1e-6)  # S_max binds in the search at this θ
    page.get_by_role("button", name="Save as case").click()
    page.get_by_text("explored_1.toml").wait_for()
    picture(page, "explorer_dragged", whole=True)
    page.reload()  # a second document of the same session
    page.wait_for_function(f"window.{READY}")
    assert not heard
    started.send_signal(signal.SIGKILL)
    page.get_by_role("alert").wait_for(state="visible")
    assert "does not answer" in page.get_by_role("alert").inner_text()
    assert page.get_by_text("Reconnection").count() == 0  # it does not come back
    picture(page, "explorer_without_its_server")
    with SampleStore(Path(tmp_path) / "samples.sqlite") as store:
        assert tuple(theta) in {sample.theta for sample in store.select()}


@pytest.mark.slow
@pytest.mark.parametrize("server", ["runs/two_mass_built.toml"], indirect=True)
def test_a_case_with_sections_opens_with_a_controller(browser, server):
    page, heard = opened(browser, server[1])
    page.get_by_text("certified, keeps its bounds").wait_for()
    picture(page, "explorer_with_sections")
    assert not heard


@pytest.mark.slow
def test_pins_outlive_a_reload_and_a_change_to_dark(browser, server):
    page, heard = opened(browser, server[1])
    pinned = "Bokeh.documents[0].get_model_by_name('pins').source.data"
    slider = page.get_by_role("slider", name="m1 (kg)")
    slider.press("PageDown")
    page.get_by_role("button", name="Pin this design").click()
    page.wait_for_function(f"{pinned}.design.length == 1")
    assert page.locator(".slick-header-column").last.bounding_box()["width"] > 250  # its words fit
    before = page.evaluate(f"(d => [[...d.design], [...d.theta_m1]])({pinned})")
    light = page.evaluate(f"{pinned}.colour[0]")
    page.reload()
    page.wait_for_function(f"window.{READY}")
    assert page.evaluate(f"(d => [[...d.design], [...d.theta_m1]])({pinned})") == before
    assert slider.get_attribute("aria-valuetext") == f"{before[1][0]:.3f}"
    page.emulate_media(color_scheme="dark")
    page.wait_for_url("**dark=1**")
    page.wait_for_function(f"window.{READY}")
    assert page.evaluate(f"(d => [[...d.design], [...d.theta_m1]])({pinned})") == before
    assert page.evaluate(f"{pinned}.colour[0]") != light  # told apart on a dark ground too
    assert (
        page.get_by_role("slider", name="ω_S (Hz), range searched, upper").get_attribute(
            "aria-valuetext"
        )
        == "1800"
    )
    assert page.get_by_role("img", name="Sensitivity S").is_visible()
    picture(page, "explorer_pins_dark", whole=True)
    assert not heard


# A point of the loop's figure -> px of the window.
PLACE = """([x, y]) => {
  const of = view => view.model.name === "L" ? view
    : (view.child_views ?? []).map(of).find(found => found != null)
  const view = Object.values(Bokeh.index).map(of).find(found => found != null)
  const {left, top} = view.canvas_view.el.getBoundingClientRect()
  return [left + view.frame.x_scale.compute(x), top + view.frame.y_scale.compute(y)]
}"""


@pytest.mark.slow
def test_a_notch_is_dragged_and_a_pin_is_on_the_map_without_scrolling(browser, server):
    page, heard = opened(browser, server[1], 1400, "dark")
    data = "Bokeh.documents[0].get_model_by_name('{}').data"
    page.wait_for_function(f"{data.format('notch')}.x.length == 1")
    start = page.evaluate(f"(d => [d.x[0], d.y[0]])({data.format('notch')})")
    x, y = page.evaluate(PLACE, start)
    said = page.locator("#say_notch")
    assert said.inner_text().startswith("none")
    page.mouse.move(x, y)
    page.mouse.down()
    heard_while = set()
    for step in range(1, 7):
        page.mouse.move(x - 4 * step, y + 4 * step)
        page.wait_for_timeout(400)
        heard_while.add(said.inner_text())
    page.mouse.up()
    assert len(heard_while) > 2  # margins follow while it is dragged
    assert "phase margin" in said.inner_text() or "UNSTABLE" in said.inner_text()
    hz, gain = page.evaluate(f"(d => [d.x[0], d.y[0]])({data.format('notch')})")
    assert hz < start[0]
    assert page.evaluate(PLACE, [hz, gain]) == pytest.approx([x - 24, y + 24], abs=6)
    page.get_by_role("button", name="Pin this design").click()
    page.wait_for_function(f"{data.format('pinned')}.name.length == 1")
    assert page.evaluate(f"{data.format('pinned')}.name[0]") == "pin 1"
    land = page.get_by_role("img", name="Landscape").bounding_box()
    assert land["y"] + land["height"] <= 900  # seen without scrolling
    white = page.evaluate(r"""() => {
      const all = root => [...root.querySelectorAll("*")].flatMap(one =>
        [one, ...(one.shadowRoot ? all(one.shadowRoot) : [])])
      return all(document).filter(one => one.matches("button"))
        .map(one => getComputedStyle(one).backgroundColor)
        .filter(c => c.match(/\d+/g).slice(0, 3).every(v => v > 150)).length
    }""")
    assert white == 0
    picture(page, "explorer_notch_dark", whole=True)
    assert not heard


@pytest.mark.slow
def test_a_solve_from_here_reports_how_far_it_is_and_ends_with_its_report(
    browser, server, tmp_path
):
    page, heard = opened(browser, server[1])
    page.get_by_role("button", name="Solve from here").click()
    page.get_by_text(re.compile(r"sampling +\d+/\d+ \[")).wait_for()
    page.get_by_text("the solve ended: done and verified").wait_for()
    assert (tmp_path / "solved_1" / "report.html").exists()
    picture(page, "explorer_solved_from_here", whole=True)
    with page.expect_popup() as opening:
        page.get_by_role("link", name="the report of it").click()
    report = opening.value
    report.on("console", lambda said: heard.append(said.text) if said.type == "error" else None)
    report.on("pageerror", lambda error: heard.append(str(error)))
    report.reload()  # now that its complaints are heard
    report.get_by_role("heading", name="At a glance").wait_for()
    report.get_by_role("link", name="All pages of this run").click()
    report.get_by_role("heading", name="Pages").wait_for()
    assert not heard


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "scheme"),
    [(1920, "light"), (1400, "dark"), (800, "light"), (390, "light"), (390, "dark")],
)
def test_it_fits_and_does_not_complain(browser, server, width, scheme):
    page, heard = opened(browser, server[1], width, scheme)
    page.wait_for_timeout(2000)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("canvas").count() > 8
    across, up = page.evaluate(SCALES)
    assert across == pytest.approx(up, rel=0.01)  # the disk of S_max is round
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    light = sum(map(int, re.findall(r"\d+", ground)[:3])) > 3 * 128
    assert light == (scheme == "light")
    picture(page, f"explorer_{width}_{scheme}", whole=True)
    assert axe_findings(page) == []
    assert not heard


@pytest.mark.parametrize("width", [1920, 1400, 800, 390])
def test_a_circle_is_round_without_a_browser_too(width):
    """The page's own arithmetic, in the JavaScript that playwright brings: CI has no Chromium."""
    api = pytest.importorskip("playwright", reason="playwright is not installed")
    pytest.importorskip("bokeh", reason="bokeh is not installed")
    from ccd_casadi.extensions.explorer.painter import CENTRE, HALF

    size = {"inner_width": width - 70, "inner_height": 180}
    fit = package_text("extensions/explorer/assets/round.js")
    code = f"""
const axis = () => ({{setv(found) {{ Object.assign(this, found) }}}})
const figure = {{...{json.dumps(size)}, x_range: axis(), y_range: axis()}}
;((figure, centre, half) => {{ {fit} }})(figure, {CENTRE}, {json.dumps(HALF)})
console.log(JSON.stringify([figure.x_range, figure.y_range]))"""
    node = Path(api.__file__).parent / "driver" / "node"
    found = subprocess.run([node, "-e", code], capture_output=True, text=True, check=True)
    x, y = json.loads(found.stdout)
    across, up = x["end"] - x["start"], y["end"] - y["start"]
    assert across / size["inner_width"] == pytest.approx(up / size["inner_height"], rel=1e-12)
    assert min(CENTRE - x["start"], x["end"] - CENTRE) >= HALF[0] * (1.0 - 1e-12)
    assert min(-y["start"], y["end"]) >= HALF[1] * (1.0 - 1e-12)


def test_a_circle_of_the_nyquist_plot_is_one_in_pixels(browser, tmp_path):
    embed = pytest.importorskip("bokeh.embed", reason="bokeh is not installed")
    from bokeh.resources import INLINE

    from ccd_casadi.extensions.explorer.painter import PanelFigure

    place = tmp_path / "nyquist.html"
    made = PanelFigure("nyquist", "", False, whole_circles=True)
    place.write_text(embed.file_html(made.figure, INLINE), encoding="utf-8")
    page = browser.new_page()
    page.goto(place.as_uri())
    for width in (1920, 1400, 800, 390):
        page.set_viewport_size({"width": width, "height": 600})
        page.wait_for_timeout(300)
        page.wait_for_function(f"(([x, y]) => Math.abs(x / y - 1) < 0.01)({SCALES})", timeout=10e3)
        picture(page, f"nyquist_{width}")
    page.close()


def test_without_the_token_every_path_is_refused(tmp_path):
    client = pytest.importorskip("tornado.httpclient").AsyncHTTPClient
    server = pytest.importorskip(
        "ccd_casadi.extensions.explorer.server", reason="bokeh is not installed"
    )
    explorer = server.Explorer(Session(load_case("runs/two_mass.toml"), tmp_path), workers=1)
    token = explorer.url.rstrip("/").rsplit("/", 1)[1]
    root = explorer.url.split(token)[0]
    wrong = f"{token[:-1]}{'A' if token[-1] != 'A' else 'B'}"
    paths = ("", "ws", "autoload.js", "static/js/bokeh.min.js", f"{wrong}/", f"{wrong}/ws", "none/")
    page = "runs/solved_1/report.html"
    (tmp_path / page[5:]).parent.mkdir()
    (tmp_path / page[5:]).write_text("a page")
    (tmp_path.parent / "private").write_text("no page of a solve")
    names = ("samples.sqlite", "solved_1/../../private", "solved_1/%2e%2e/%2e%2e/private")
    outside = [f"{token}/runs/{name}" for name in names]

    async def codes():
        explorer._server.start()
        found = {}
        for path in (*paths, page, *outside, f"{token}/{page}", f"{token}/static/js/bokeh.min.js"):
            answer = await client().fetch(root + path, raise_error=False, follow_redirects=False)
            found[path] = answer.code
            assert token not in str(answer.headers)
        return found

    found = explorer._server.io_loop.run_sync(codes)
    explorer.close()
    assert found.pop(f"{token}/static/js/bokeh.min.js") == 200  # the page's own scripts, from here
    assert found.pop(f"{token}/{page}") == 200
    assert set(found.values()) <= {403, 404}
    assert root.startswith("http://127.0.0.1:")


def test_a_page_from_elsewhere_gets_no_socket(tmp_path):
    pytest.importorskip("bokeh")
    from tornado.httpclient import HTTPClientError, HTTPRequest
    from tornado.websocket import websocket_connect

    from ccd_casadi.extensions.explorer.server import Explorer

    explorer = Explorer(Session(load_case("runs/two_mass.toml"), tmp_path), workers=1)
    own = explorer.url.rpartition(explorer.url.split("/")[3])[0].rstrip("/")
    elsewhere = ("http://example.org", own.replace("127.0.0.1", "localhost"), f"{own[:-1]}")

    async def refused(origin):
        place = explorer.url.replace("http", "ws", 1) + "ws"
        try:
            (await websocket_connect(HTTPRequest(place, headers={"Origin": origin}))).close()
        except HTTPClientError as error:
            return error.code == 403
        return False

    async def chosen():
        explorer._server.start()
        return [await refused(origin) for origin in (own, *elsewhere)]

    found = explorer._server.io_loop.run_sync(chosen)
    explorer.close()
    assert found == [False, True, True, True]


def test_a_package_that_is_missing_is_required_before_anything_is_done(
    monkeypatch, capsys, tmp_path
):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(errors, "import_module", missing)
    assert explore.main(["runs/two_mass.toml", "--out", str(tmp_path / "none"), "--no-open"]) == 2
    assert "pip install 'ccd-casadi[explore]'" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
