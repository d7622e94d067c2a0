"""The rib stage's table and sentences in docs/development/rib_stage_built.md, from kept figures.

    python benchmarks/rib_stage_conclusions.py [--write]

Prints what `rib_stage_on_the_set.py` says of the rows that `rib_stage_front.py --write`
keeps; `--write` puts it between the marks of the page.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rib_stage_on_the_set import HEAD, sentences, stages_of, stored_rows, table

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of

ROOT = Path(__file__).resolve().parent.parent
CASE, PAGE = ROOT / "runs" / "rib_stage.toml", ROOT / "docs/development/rib_stage_built.md"
BEGIN, END = "<!-- computed by benchmarks/rib_stage_conclusions.py -->", "<!-- end -->"


def markdown(rows: Mapping[str, Any]) -> str:
    """Sentences, the table that they are of, and the channels on their own."""
    problem = problem_of(load_case(CASE))
    stages = stages_of(rows, problem.w1, problem.w2)
    apart = [
        (name, f"{row['mass']:.3f} kg", *(f"{hz:.1f} Hz" for hz in row["apart_hz"].values()))
        for name, row in rows.items()
    ]
    said = "\n".join(f"- {words}" for words in sentences(stages))
    shown = lines(HEAD, table(stages)), lines(("stage", "mass", "z", "tip, tilt", "twist"), apart)
    return f"{said}\n\n{shown[0]}\n\nEach channel on its own:\n\n{shown[1]}"


def lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = markdown(stored_rows())
    print(text)
    if given.write:
        head, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        PAGE.write_text(f"{head}{BEGIN}\n\n{text}\n\n{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
