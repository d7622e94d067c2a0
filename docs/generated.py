"""For MkDocs: what the code itself says, in place of a mark: options of commands, keys of files."""

import json
import re
import sys
from contextlib import redirect_stdout
from importlib import import_module
from io import StringIO
from typing import Any
from unittest import mock

MARK = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)


def options() -> str:
    """Every command, as its --help prints it."""
    from ccd_casadi.__main__ import commands

    found = []
    for word, (module, _) in commands().items():
        text, wide = StringIO(), mock.patch.dict("os.environ", COLUMNS="100")
        with redirect_stdout(text), mock.patch.object(sys, "argv", ["ccd"]), wide:
            import_module(module).main(["--help"])
        found.append(f"### ccd {word}\n\n```text\n{text.getvalue().rstrip()}\n```")
    return "\n\n".join(found)


def result() -> str:
    """Every key of result.json, as its schema has it."""
    from ccd_casadi.support.text import package_text

    schema = json.loads(package_text("templates/result.schema.json"))
    of_design = schema["else"]["required"]
    rows = []
    for key, own in schema["properties"].items():
        when = "always" if key in schema["required"] else "of a design" * (key in of_design)
        rows.append(f"| `{key}` | {own['description']} | {_holds(own, schema)} | {when} |")
    return "\n".join(["| key | meaning | holds | given |", "|---|---|---|---|", *rows])


def files() -> str:
    """Every file that a run's folder may hold, as its index.html lists them."""
    from ccd_casadi.reporting.run_verdict import FILES, PAGES

    rows = [f"| `{name}` | {words} |" for name, words in (PAGES | FILES).items()]
    return "\n".join(["| file | holds |", "|---|---|", *rows])


def _holds(own: Any, schema: Any) -> str:
    if "$ref" in own:
        return _holds(schema["$defs"][own["$ref"].rpartition("/")[2]], schema)
    if "enum" in own or "const" in own:
        return " or ".join(f"`{json.dumps(each)}`" for each in own.get("enum", [own.get("const")]))
    kinds = own["type"] if isinstance(own["type"], list) else [own["type"]]
    words = " or ".join(kinds)
    inside = own.get("items", own.get("additionalProperties"))
    if "properties" in own:
        return f"{words} of {', '.join(f'`{key}`' for key in own['properties'])}"
    return f"{words} of {_holds(inside, schema)}" if isinstance(inside, dict) else words


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with what is generated for it."""
    made = {"options": options, "result": result, "files": files}
    return MARK.sub(lambda found: made[found[1]](), markdown)
