"""Thousands of inputs that nobody should give, each through the real command: none may break it.

`python benchmarks/fuzz.py [--count 10000] [--seed 0] [--out FILE]` goes on from what the file
holds, and sums it up in benchmarks/fuzz.json. `--only N` runs one input and shows what it prints.
The inputs are made by tests/support/fuzz_inputs.py. Four fifths of the solves leave their pictures
out.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

sys.path += [str(Path(__file__).parents[1] / folder) for folder in (".", "tests")]


ROOT = Path(__file__).parent.parent
DEADLINE = 120.0  # s for one input
FRESH = 400  # inputs after which a process is exchanged for a new one
MEMORY = 6 << 30  # bytes of address space of a process


def serve(pipe: Connection, seed: int) -> None:
    """A process that runs inputs one after the other and sends what became of each."""
    from oracles.fuzz_bench import Bench

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    with tempfile.TemporaryDirectory(prefix="fuzz_") as place:
        bench = Bench(Path(place))
        pipe.send("ready")
        while True:
            number = pipe.recv()
            if number is None:
                return
            pipe.send(bench.judged(f"{seed}-{number}"))


class Process:
    """A process to run inputs in, which may be killed."""

    def __init__(self, seed: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs, seed), daemon=True)
        self.process.start()
        theirs.close()
        self.done = 0
        assert self.pipe.recv() == "ready"

    def run(self, number: int) -> dict[str, Any]:
        """The verdict on one input."""
        self.done += 1
        self.pipe.send(number)
        try:
            if self.pipe.poll(DEADLINE):
                found: dict[str, Any] = self.pipe.recv()
                return found
            wrong = f"hang: no answer within {DEADLINE:g} s"
        except (EOFError, ConnectionResetError):
            self.process.join()
            wrong = f"crash: the process died with exit code {self.process.exitcode}"
        self.process.kill()
        self.process.join()
        return {"wrong": [wrong]}

    def end(self) -> None:
        """End the process in good order."""
        if self.process.is_alive():
            self.pipe.send(None)
            self.process.join()


def summed(path: Path, seed: int) -> dict[str, Any]:
    """The figures of all verdicts in the file."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    families = Counter(line.get("family", "?") for line in lines)
    codes = Counter(f"{line.get('command', '?')} {line.get('code', '?')}" for line in lines)
    wrong = [line for line in lines if line["wrong"]]
    return {
        "seed": seed,
        "inputs": len(lines),
        "families": dict(sorted(families.items())),
        "exit_codes": dict(sorted(codes.items())),
        "verified_and_judged": sum(line.get("judged", False) for line in lines),
        "tracebacks": sum(any("traceback" in w for w in line["wrong"]) for line in lines),
        "hangs": sum(any("hang" in w for w in line["wrong"]) for line in lines),
        "crashes": sum(any("crash" in w for w in line["wrong"]) for line in lines),
        "wrong": [[line["number"], line["wrong"][0][:200]] for line in wrong],
        "longest_seconds": max((line.get("seconds", 0.0) for line in lines), default=0.0),
        "seconds": sum(line.get("seconds", 0.0) for line in lines),
    }


def main() -> None:
    """Run what is missing, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--start", type=int, default=0, help="number of the first one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("fuzz.jsonl"))
    parser.add_argument("--only", type=int)
    options = parser.parse_args()
    if options.only is not None:
        from oracles.fuzz_bench import Bench

        with tempfile.TemporaryDirectory(prefix="fuzz_") as place:
            found = Bench(Path(place)).judged(f"{options.seed}-{options.only}", keep=True)
            print(json.dumps(found, indent=2))
        return
    options.out.touch()
    known = {json.loads(line)["number"] for line in options.out.read_text().splitlines()}
    process: Process | None = None
    with options.out.open("a") as stream:
        for number in range(options.start, options.start + options.count):
            if number in known:
                continue
            if process is None or process.done == FRESH or not process.process.is_alive():
                if process is not None:
                    process.end()
                process = Process(options.seed)
            verdict = {"number": number} | process.run(number)
            stream.write(json.dumps(verdict) + "\n")
            stream.flush()
            if verdict["wrong"]:
                print(number, verdict.get("note"), verdict["wrong"], flush=True)
    if process is not None:
        process.end()
    figures = summed(options.out, options.seed)
    (ROOT / "benchmarks" / "fuzz.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures | {"wrong": len(figures["wrong"])}, indent=2))


if __name__ == "__main__":
    main()
