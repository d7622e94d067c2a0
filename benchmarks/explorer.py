"""From a drag in the explorer to the new curves on the screen, measured in the browser.

    python benchmarks/explorer.py runs/two_mass.toml m1 --chromium /usr/bin/chromium

Starts the explorer, drags the slider of one parameter with the mouse, and times in the page from
the slider's value to the moment when every figure of a curve has been painted anew with the answer
to it. Needs `playwright` and a Chromium; the machine should have nothing else to do.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import psutil
from playwright.sync_api import sync_playwright

WATCH = """([name, scale, figures]) => {
  const model = name => Bokeh.documents[0].get_model_by_name(name)
  const slider = model(`theta_${name}`), answer = model("answer"), moved = new Map()
  const sliders = model("controls").children.filter(each => each.name.startsWith("theta_"))
  const index = sliders.indexOf(slider), key = value => value.toPrecision(9)
  window.latencies = []
  window.answers = 0
  let waiting = null
  slider.properties.value.change.connect(() => moved.set(key(slider.value), performance.now()))
  answer.properties.data.change.connect(() => {
    window.answers += 1
    const began = moved.get(key(answer.data.theta[0][index] * scale))
    if (began != null) waiting = {began, left: new Set(figures)}
  })
  for (const figure of figures) {
    const view = Bokeh.index.find_one(model(figure))
    const paint = view._actual_paint.bind(view)
    view._actual_paint = () => {
      paint()
      if (waiting == null) return
      waiting.left.delete(figure)
      if (waiting.left.size == 0) {
        window.latencies.push(performance.now() - waiting.began)
        waiting = null
      }
    }
  }
}"""
FIGURES = ["S", "nyquist", "L", "phase", "KS", "T", "K", "G", "step", "move"]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("case", type=Path)
    options.add_argument("parameter", help="the slider to drag")
    options.add_argument("--chromium", default="/usr/bin/chromium", help="its executable")
    options.add_argument("--moves", type=int, default=60, help="of the mouse")
    options.add_argument("--pause", type=float, default=120.0, help="ms between them")
    options.add_argument("--wait", type=float, default=0.0, help="s before the first")
    options.add_argument("--out", help="the explorer's folder; default: a temporary one")
    given = options.parse_args()
    folder = given.out or tempfile.mkdtemp()
    command = [
        sys.executable,
        "-m",
        "ccd_casadi.explore",
        str(given.case),
        "--out",
        folder,
        "--no-open",
    ]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        found = re.search(r"http://\S+", server.stdout.readline())
        assert found is not None, "the explorer printed no address"
        latencies, answers, spent = drag(found[0], given)
    finally:
        server.terminate()
        server.wait()
    ms = np.array(latencies)
    found = {"moves": given.moves, "answers": answers, "timed": len(ms)}
    if latencies:
        found |= {"median_ms": float(np.median(ms)), "p90_ms": float(np.quantile(ms, 0.9)),
                  "largest_ms": float(ms.max())}  # fmt: skip
    found |= {"cpu_ms_per_answer": 1e3 * spent / max(answers, 1), "load": os.getloadavg()[0]}
    print(json.dumps(found))


def drag(url: str, given: argparse.Namespace) -> tuple[list[float], int, float]:
    """Latencies in ms, how many answers came, and the processor time that all took."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=given.chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1300, "height": 1000})
        page.set_default_timeout(400e3)
        page.goto(url)
        page.wait_for_function("document.getElementById('verdict')?.textContent.length > 10")
        page.wait_for_timeout(2000.0 + 1e3 * given.wait)
        scale = page.evaluate(
            "name => { const d = Bokeh.documents[0], s = d.get_model_by_name(`theta_${name}`);"
            " return s.title.includes('(mm)') ? 1e3 : 1 }", given.parameter,
        )  # fmt: skip
        page.evaluate(WATCH, [given.parameter, scale, FIGURES])
        before = cpu_seconds()
        place = page.evaluate(
            """name => {
              const model = Bokeh.documents[0].get_model_by_name(`theta_${name}`)
              const view = Bokeh.index.find_one(model)
              const box = selector => {
                const b = view.shadow_el.querySelector(selector).getBoundingClientRect()
                return [b.x, b.y, b.width, b.height]
              }
              return [box(".noUi-handle"), box(".noUi-target")]
            }""",
            given.parameter,
        )
        (hx, hy, hw, hh), (x, _, width, _) = place
        page.mouse.move(hx + hw / 2, hy + hh / 2)
        page.mouse.down()
        for i in range(given.moves):
            share = 0.5 + 0.42 * np.sin(0.31 * i)
            page.mouse.move(x + share * width, hy + hh / 2)
            page.wait_for_timeout(given.pause)
        page.mouse.up()
        page.wait_for_timeout(2000)
        found = page.evaluate("[window.latencies, window.answers]")
        spent = cpu_seconds() - before
        browser.close()
    return found[0], found[1], spent


def cpu_seconds() -> float:
    """Processor time of server and browser so far, which depends less on a machine's other work."""
    times = [each.cpu_times() for each in psutil.Process().children(recursive=True)]
    return sum(each.user + each.system for each in times)


if __name__ == "__main__":
    main()
