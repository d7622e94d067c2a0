"""The table of public judges: what each script found last, with source, version and licence.

    python benchmarks/peer_table.py

prints it from benchmarks/peer_table.json, where the scripts `keep` their rows.
"""

import json
from pathlib import Path

KEPT = Path(__file__).with_suffix(".json")
# problem: source (GitHub repository at commit, or page), licence, command
SOURCES = {
    "drive": ("liuzd1997/PyHDDBenchmark@8c508f5", "MIT",
              "benchmarks/drive_error.py --theirs DIR"),
    "mirror": ("merijnfloren/fsm-benchmark-data@539a12f", "CC BY 4.0",
               "benchmarks/mirror_held_out.py --theirs DIR"),
    "flexible beam": ("MathWorks, Robust vibration control in flexible beam", "numbers only",
                      "benchmarks/mathworks.py"),
    "positioning system": ("MathWorks, Robust tuning of positioning system", "numbers only",
                           "benchmarks/mathworks.py"),
    "nano stage": ("WataruOhnishi/control_benchmark@ea728a2, P4th, P8th", "MIT, numbers only",
                   "benchmarks/stage_judge.py"),
    "guided beam": ("aatmdelissen/controller-topology-optimization@36002cd", "MIT, formula only",
                    "benchmarks/oracle.py guided_beam"),
}  # fmt: skip


def keep(problem: str, rows: list[list[str]]) -> None:
    """Rows (what is judged, theirs, ours) of a problem, in place of those kept."""
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    kept[problem] = rows
    KEPT.write_text(json.dumps(kept, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


def main() -> None:
    kept = json.loads(KEPT.read_text())
    print("| problem | judged | theirs, or required | ours | source, licence | command |")
    print("|---|---|---|---|---|---|")
    for problem, (source, licence, command) in SOURCES.items():
        for what, theirs, ours in kept.get(problem, []):
            cells = (problem, what, theirs, ours, f"{source}; {licence}", f"`{command}`")
            print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
