"""What terminal, page and result.json of one run say against each other: nothing, of any run.

Texts are compared by the digits that they print; curves by what result.json says is their largest.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.codesign.verdict import clauses_of
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.paint import read_pages
from ccd_casadi.support.json_files import restore
from ccd_casadi.support.terminal import plain as in_ascii

CLOSE, ON_GRID = 1e-6, 2e-3  # relative: of one number, and of a peak between points of a grid
HALF_POWER = 0.5**0.5
PREFIX = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3, "M": 1e6,
          "G": 1e9}  # fmt: skip
NUMBER = r"[-−+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
LENGTH = rf"({NUMBER})\s?([pnuµm]?)m\b"


def page_of(folder: Path, name: str = "report.html") -> c.Page:
    """As it was kept."""
    page: c.Page = restore(c.Page, read_pages(folder)[name])
    return page


def same(text: str, value: float | None, scale: float = 1.0) -> bool:
    """Whether a printed number is the value to the digits that it has."""
    if value is None:
        return False
    text = text.replace("−", "-")
    shown, digits = float(text), len(text.split("e")[0].partition(".")[2])
    least = 0.51 * 10.0 ** (int(text.partition("e")[2] or 0) - digits)
    return abs(shown - scale * value) <= least + 1e-9 * abs(shown)


def plain(text: str) -> str:
    """On one line, each space one, in the signs of a terminal."""
    return re.sub(r"\s+", " ", in_ascii(text.replace("\u202f", " "))).strip()


def raw(text: str) -> str:
    """On one line, each space one."""
    return re.sub(r"\s+", " ", text.replace("\xa0", " ").replace("\u202f", " ")).strip()


def disagreements(folder: Path, terminal: str) -> list[str]:
    """Of a run folder of `solve` and what that printed; in words, empty where all agree."""
    result = json.loads((folder / "result.json").read_text("utf-8"))
    if result["status"] == "infeasible":
        words = plain(result["reason"])
        return [] if words in plain(terminal) else ["terminal: another reason"]
    page = page_of(folder)
    claims = [
        *_words(result, plain(terminal), page), *_terminal(result, plain(terminal)),
        *_facts(result, page), *_curves(result, page), *_captions(result, page),
        *_tables(page), *_proven(result, plain(terminal), page),
    ]  # fmt: skip
    return [words for holds, words in claims if not holds]


def tuned_disagreements(folder: Path, terminal: str) -> list[str]:
    """Of a run of `tune`: what is known on lines, or on a model."""
    r, text = json.loads((folder / "result.json").read_text("utf-8")), plain(terminal)
    if not (folder / "report.html").exists():
        return [] if plain(r["reason"]) in text else ["terminal: another reason"]
    page = page_of(folder)
    rows = {raw(row[0]): raw(row[1]) for block in _blocks(page, c.Facts) for row in block.rows}
    reported = [
        (text, rf"bandwidth ({NUMBER}) Hz, \|S\|", r["bandwidth_hz"]),
        (text, rf"\|S\| at most ({NUMBER}) at", r["sensitivity_peak"]),
        (text, rf"margins phase ({NUMBER}) deg", r["phase_margin_deg"]),
        (rows["Bandwidth"], rf"({NUMBER}) Hz", r["bandwidth_hz"]),
        (rows["Peak of S"], rf"({NUMBER})", r["sensitivity_peak"]),
        (raw(page.head.lead), rf"a bandwidth of ({NUMBER}) Hz", r["bandwidth_hz"]),
    ]
    if r["models"]:
        reported.append((raw(page.head.lead), rf"‖S‖∞ = ({NUMBER})", max(r["models"])))
    claims = []
    for where, pattern, value in reported:
        found = re.search(pattern, where)
        claims.append((found is not None and same(found[1], value), f"tune: {pattern}"))
    decision = plain(page.head.decision)
    claims += [
        (decision in text and (bool(decision) == ("decision" in text)), "tune: two decisions"),
        ((r["status"] == "verified") == r["certificate"]["passed"], "tune: status, certificate"),
        (f"status {r['status']}" in text, "tune: status"),
        *_tables(page),
    ]
    top = max(_largest(replace(p, curves=tuple(k for k in p.curves if not k.label)))
              for p in _panels(page, "The loop on the lines", "|S|"))  # fmt: skip
    claims.append((top <= r["sensitivity_peak"] * (1.0 + CLOSE), "tune, figure: peak of S"))
    return [words for holds, words in claims if not holds]


Claims = Iterator[tuple[bool, str]]


def _words(r: Mapping[str, Any], terminal: str, page: c.Page) -> Claims:
    shown = {line.name: (line.state, line.words) for line in page.head.verdict}
    for name, line in r["verdict"].items():
        yield f"{name} {line['state']} {plain(line['words'])}" in terminal, f"terminal: {name}"
        yield shown.get(name) == (line["state"], line["words"]), f"page: {name}"
    decision = plain(page.head.decision)
    yield bool(decision) and f"decision {decision}" in terminal, "two decisions"
    built = decision.startswith("Build this")
    yield not (built and r["status"] != "verified"), "not verified, to be built"
    bad = {line["state"] for name, line in r["verdict"].items() if name != "deployable"}
    yield not (decision.startswith("Build this.") and bad & {"warned", "failed"}), "build, warned"
    survives = r["verdict"]["survives"]["state"]
    yield not (decision.startswith("Build this.") and survives == "unknown"), "build, unknown"
    yield (page.head.badge == "good") <= (not bad & {"warned", "failed"}), "green and warned"
    yield not ("all checks passed" in page.head.reason.lower() and survives != "passed"), "all"


def _terminal(r: Mapping[str, Any], text: str) -> Claims:
    reported: list[tuple[str, str, float | None, float]] = [
        ("objective", rf"objective ({NUMBER}) ", r["objective"], 1.0),
        ("bandwidth", rf"bandwidth ({NUMBER}) Hz", r["bandwidth_hz"], 1.0),
        ("peak", rf"sensitivity peak ({NUMBER}) at", r["sensitivity_peak"], 1.0),
        ("peak at", rf"sensitivity peak {NUMBER} at ({NUMBER}) Hz", r["sensitivity_peak_hz"], 1.0),
        ("low", rf"\|S\| ({NUMBER}) at omega_low", r["sensitivity_low"], 1.0),
        ("phase", rf"margins phase ({NUMBER}) deg", r["phase_margin_deg"], 1.0),
        ("modulus", rf"modulus ({NUMBER})(?:;|\s|$)", r["modulus_margin"], 1.0),
        ("crossover", rf"crossover ({NUMBER}) Hz", r["crossover_hz"], 1.0),
        ("overshoot", rf"overshoot ({NUMBER}) %", r["step_overshoot"], 100.0),
        ("cost", rf"cost ({NUMBER}) syntheses", r["syntheses"], 1.0),
    ]
    if r["settling_ms"] is not None:
        reported.append(("settling", rf"within 2 % after ({NUMBER}) ms", r["settling_ms"], 1.0))
    for name, pattern, value, scale in reported:
        found = re.search(pattern, text)
        yield found is not None and same(found[1], value, scale), f"terminal: {name}"
    yield _length(r"force step " + LENGTH, text, r["force_step_max"]), "terminal: force step"


def _length(pattern: str, text: str, value: float) -> bool:
    found = re.search(pattern, text)
    return found is not None and same(found[1], value, 1.0 / PREFIX[found[2]])


def _facts(r: Mapping[str, Any], page: c.Page) -> Claims:
    rows = {
        raw(row[0]): (raw(row[1]), raw(row[2]))
        for block in _blocks(page, c.Facts) for row in block.rows
    }  # fmt: skip
    for name, value in (("Bandwidth ω_b", r["bandwidth_hz"]), ("Peak of S", r["sensitivity_peak"]),
                        ("Objective J", r["objective"])):  # fmt: skip
        found = re.search(NUMBER, rows[name][0])
        yield found is not None and same(found[0], value), f"page, table: {name}"
    yield _length(LENGTH, rows["Force step"][0], r["force_step_max"]), "page, table: force step"
    at = r["force_step_at"]
    yield at.get("pair", "") in rows["Force step"][1], "page, table: pair of the force step"
    passed = rows["Certificate"][0] == "passed"
    yield passed == r["certificate"]["passed"], "page, table: certificate"


def _blocks(page: c.Page, kind: type) -> Iterator[Any]:
    """Also what is folded."""
    for chapter in page.chapters:
        for block in chapter.body:
            inside = block.body if isinstance(block, c.FoldedBlocks) else (block,)
            yield from (one for one in inside if isinstance(one, kind))


def _panels(page: c.Page, heading: str, label: str) -> Iterator[c.Panel]:
    for chapter in page.chapters:
        for block in chapter.body if chapter.heading.startswith(heading) else ():
            if isinstance(block, c.Figure) and isinstance(block.drawing, c.Lines):
                for row in block.drawing.rows:
                    yield from (p for p in row if isinstance(p, c.Panel) and label in p.y_label)


def _largest(panel: c.Panel) -> float:
    drawn = [curve.y for curve in panel.curves if not curve.line.startswith("--")]
    drawn += [band.high for band in panel.bands]
    return float(max(np.nanmax(np.abs(y)) for y in drawn))


def _scale(panel: c.Panel) -> float:
    """Of a length on an axis, in m."""
    found = re.search(r"\(([pnuµm]?)m(?:/N)?\)", panel.y_label)
    assert found is not None, panel.y_label
    return PREFIX[found[1]]


def _curves(r: Mapping[str, Any], page: c.Page) -> Claims:
    for panel in _panels(page, "A step of force", "after a step"):
        most = _largest(panel) * _scale(panel)
        yield abs(most / r["force_step_max"] - 1.0) <= CLOSE, "figure: force step"
    for panel in _panels(page, "Closed loop", "(–)"):
        if not re.match(r"(\||σ_max\()S", panel.y_label):
            continue
        share = _largest(panel) / r["sensitivity_peak"]
        yield 1.0 - ON_GRID <= share <= 1.0 + CLOSE, "figure: peak of S"
        below = [np.interp(r["bandwidth_hz"], x, y)
                 for x, y in [*((k.x, k.y) for k in panel.curves[:1]),
                              *((b.x, b.high) for b in panel.bands if "proof" in r)]]  # fmt: skip
        yield max(below) <= HALF_POWER * (1.0 + ON_GRID), "figure: |S| at the bandwidth"
    for label, key in (("GS", "compliance_max"), ("KS", "KS_max")):
        for panel in _panels(page, "Closed loop", label):
            scale = _scale(panel) if label == "GS" else 1.0
            if r.get(key) is not None:
                yield _largest(panel) * scale <= r[key] * (1.0 + CLOSE), f"figure: {label}"


def _captions(r: Mapping[str, Any], page: c.Page) -> Claims:
    figures = list(_blocks(page, c.Figure))
    text = " ".join(raw(figure.caption) for figure in figures)
    for found in re.finditer(rf"[Tt]he least ω_b of them is ({NUMBER}) Hz|at ω_b = ({NUMBER}) Hz",
                             text):  # fmt: skip
        yield same(found[1] or found[2], r["bandwidth_hz"]), f"caption: {found[0]}"
    for found in re.finditer(rf"its peak(?: on the worst plant)?, ({NUMBER}), is", text):
        shown = float(found[1])  # on a grid, where a set has more than the model
        yield abs(shown / r["sensitivity_peak"] - 1.0) <= ON_GRID, f"caption: {found[0]}"
        worst = "worst plant" in found[0]
        yield worst == any("the model" in curve.label for p in _panels(page, "Closed loop", "S")
                           for curve in p.curves), "caption: one plant or several"  # fmt: skip
    for figure in figures:
        said = raw(figure.caption)
        if "until it is at rest" in said:
            yield _length(r"at most " + LENGTH, said, r["force_step_max"]), "caption: force step"
        if figure.tables and figure.tables[0].head[0] == "way":
            yield from _move(figure, said)


def _move(figure: c.Figure, said: str) -> Claims:
    """The words of each way against its row in the table beneath."""
    head = list(figure.tables[0].head)
    for row in figure.tables[0].rows:
        name = str(row[0])
        part = re.search(re.escape(name) + r": ([^;]*)", said, re.IGNORECASE)
        yield part is not None, f"move: {name} is not said"
        if part is None:
            continue
        peak = _cell(row[head.index("peak error, µm")])
        yield _length(r"at most " + LENGTH, part[1], 1e-6 * peak), f"move: peak of {name}"
        settled = _cell(row[head.index("settled after, ms")])
        late = "settle within" in part[1] or "not settle" in part[1] or "not settled" in part[1]
        yield late == (not np.isfinite(settled)), f"move: {name} settles"
        ends = re.search(rf"does not settle \({LENGTH}", part[1])
        within = re.search(r"stays within " + LENGTH, said)
        yield ends is None or within is None or (
            float(ends[1]) * PREFIX[ends[2]] > float(within[1]) * PREFIX[within[2]]
        ), f"move: {name} does not settle, and ends inside"  # fmt: skip


def _cell(value: Any) -> float:
    if isinstance(value, int | float):
        return float(value)
    found = re.search(NUMBER, str(value).replace("\xa0", ""))
    return float(found[0].replace("−", "-")) if found and "∞" not in str(value) else np.inf


def _tables(page: c.Page) -> Claims:
    """Of a locus both parts are known, or neither."""
    for figure in _blocks(page, c.Figure):
        for table in figure.tables:
            head = [str(name) for name in table.head]
            for i, name in enumerate(head):
                if not name.startswith("Re L") or name.replace("Re", "Im") not in head:
                    continue
                j = head.index(name.replace("Re", "Im"))
                pairs = [(_known(row[i]), _known(row[j])) for row in table.rows]
                yield all(re_ == im for re_, im in pairs), f"table: {name} and its Im"
                yield any(re_ for re_, _ in pairs), f"table: {name} is empty"


def _known(value: Any) -> bool:
    return bool(re.search(r"\d", str(value)))


def _proven(r: Mapping[str, Any], terminal: str, page: c.Page) -> Claims:
    """Nothing is called proven but what a proof has closed."""
    facts = " ".join(" ".join(map(str, row)) for block in _blocks(page, c.Facts)
                     for row in block.rows)  # fmt: skip
    proof, line = r.get("proof"), r["verdict"]["survives"]
    texts = {"terminal": terminal, "page": plain(facts), "survives": "; ".join(clauses_of(line))}
    if proof is None:
        yield from ((" proven for" not in text, f"{where}: proven, no proof")
                    for where, text in texts.items())  # fmt: skip
        return
    whole = proof["outcome"] == "proven"
    closed = all(level is not None and level <= 1.0 + proof["slack"] * (1.0 + CLOSE)
                 for level in proof["levels"].values())  # fmt: skip
    yield whole <= closed, "proof: proven, a level is open"
    for where, text in texts.items():
        said = "proven for the whole box" in text
        yield said <= whole, f"{where}: proven, the proof is {proof['outcome']}"
        for found in re.finditer(rf"every figure at most ({NUMBER}) of its bound", text):
            yield same(found[1], max(proof["levels"].values())), f"{where}: {found[0]}"
    passed = line["state"] == "passed"
    yield not (passed and line.get("set") == "kept" and not whole), "kept, unproven"
    yield line.get("proof") == proof["outcome"], "two outcomes of a proof"
    yield not (passed and line.get("unproven")), "passed, part is not proven"
