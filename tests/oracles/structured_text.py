"""Structured text run line by line: a twin in Python for the statements that our code uses.

`run(text, calls)`: the function block of `text`, called once for each mapping of inputs; the values
of its outputs after each call. Anything it does not know is an error, not a guess.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

DECLARED = re.compile(
    r"(\w+) : (?:ARRAY\[0\.\.(\d+)\] OF )?(BOOL|LREAL|DINT)(?: := (.*?))?;", re.DOTALL
)
STATEMENTS = (
    (re.compile(r"IF (.+) THEN"), r"if \1:"),
    (re.compile(r"WHILE (.+) DO"), r"while \1:"),
    (re.compile(r"(\w+(?:\[.+\])?) := (.+);"), r"\1 = \2"),
)


def run(text: str, calls: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Outputs after each call."""
    text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
    head, body = text.split("FUNCTION_BLOCK FB_CONTROLLER\n")[1].rsplit("END_VAR\n", 1)
    memory: dict[str, Any] = {}
    sections = re.findall(r"^(VAR\w*(?: CONSTANT)?)\n(.*?)(?=^END_VAR|\Z)", head, re.DOTALL | re.M)
    outputs: list[str] = []
    for kind, lines in sections:
        for name, last, of, value in DECLARED.findall(lines):
            zero: Any = {"BOOL": False, "LREAL": 0.0, "DINT": 0}[of]
            memory[name] = [zero] * (int(last) + 1) if last else zero
            if value:
                memory[name] = eval(" ".join(value.split()), {})  # literals of our own text
                assert not last or len(memory[name]) == int(last) + 1
            if kind == "VAR_OUTPUT":
                outputs.append(name)
    program = compile(_python(body), "structured text", "exec")
    answers = []
    for call in calls:
        memory |= call
        exec(program, {"__builtins__": {"range": range}}, memory)
        answers.append({name: list(memory[name]) for name in outputs})
    return answers


def _python(body: str) -> str:
    lines, depth = [], 0
    for line in map(str.strip, body.splitlines()):
        if line in ("", "END_FUNCTION_BLOCK"):
            continue
        if line in ("END_IF;", "END_WHILE;"):
            depth -= 1
            continue
        pattern, form = next((p, f) for p, f in STATEMENTS if p.fullmatch(line))
        lines.append("    " * depth + pattern.sub(form, line))
        depth += form.endswith(":")
    assert depth == 0
    return "\n".join(lines)
