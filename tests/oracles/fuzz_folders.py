"""Fuzzed run folders, and what befalls a command: faults of the machine, Ctrl-C."""

import json
import math
import random
import shutil
import sqlite3
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Any

from oracles.fuzz_cases import mutate, spoil, toml
from oracles.fuzz_values import VALUES, Input


def pick(rng: random.Random, value: Any) -> tuple[Any, Any] | None:
    """A container inside a JSON value, and a key of it."""
    places: list[tuple[Any, Any]] = []
    stack = [value]
    while stack and len(places) < 5000:
        item = stack.pop()
        keys: list[Any] = []
        if isinstance(item, dict):
            keys = list(item)
        elif isinstance(item, list):
            keys = rng.sample(range(len(item)), min(len(item), 4))
        places += [(item, key) for key in keys]
        stack += [item[key] for key in keys]
    return rng.choice(places) if places else None


def spoil_json(rng: random.Random, path: Path) -> str:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError):
        return "spoilt already"
    found = pick(rng, value)
    if found is None:
        return "nothing to change"
    container, key = found
    if rng.random() < 0.3:
        del container[key]
        note = f"without {key}"
    else:
        odd = rng.choice(VALUES)
        if isinstance(container[key], float) and rng.random() < 0.5:
            odd = container[key] * math.exp(rng.gauss(0.0, 5.0))
        container[key] = odd
        note = f"{key} = {odd!r:.60}"
    path.write_text(json.dumps(value))
    return note


SQL = [
    "update samples set {column} = {value} where rowid % {modulus} = 0",
    "delete from samples where rowid % {modulus} = 0",
    "update results set json = {value}",
    "update results set json = '[]'",
    "update results set json = '{{}}'",
    "update results set json = json_set(json, '$.bandwidth', {value})",
    "update results set json = json_set(json, '$.gradient', {value})",
    "update results set json = json_set(json, '$.omega_S', {value})",
    "update results set json = json_set(json, '$.active', {value})",
    "update results set json = json_set(json, '$.syntheses', {value})",
    "update results set json = json_remove(json, '$.shortfall')",
    "update results set theta = {value}",
    "update results set theta = '[1]'",
    "delete from results",
    "drop table results",
    "drop table samples",
    "drop table meta",
    "delete from meta",
    "update meta set value = '2'",
    "update meta set value = {value}",
    "alter table samples drop column seconds",
    "alter table samples add column more text",
    "alter table samples rename column gamma to gama",
    "update problems set json = {value}",
    "create trigger t after insert on samples begin delete from samples; end",
    "create trigger t before insert on samples begin select raise(abort, 'no'); end",
    "create view v as select 1",
    "pragma user_version = 99",
    "pragma application_id = 7",
    "pragma journal_mode = delete",
    "vacuum",
    "delete from problems",
]
SQL_VALUES = [
    "null",
    "'x'",
    "''",
    "1e308",
    "-1",
    "0",
    "9e999",
    "x'ff00'",
    "'[null]'",
    "'[1, 2'",
    "'{\"a\": 1}'",
    "zeroblob(1000)",
    "'nan'",
    "cast(x'80' as text)",
    "3",
]
COLUMNS = [
    "key",
    "problem",
    "theta",
    "omega_S",
    "omega_T",
    "outcome",
    "reason",
    "gamma_opt",
    "gamma",
    "bandwidth",
    "sensitivity_peak",
    "sensitivity_low",
    "certified",
    "gradients",
]


def spoil_store(rng: random.Random, path: Path) -> str:
    statement = rng.choice(SQL).format(
        column=rng.choice(COLUMNS), value=rng.choice(SQL_VALUES), modulus=rng.choice([1, 2, 7])
    )
    database = sqlite3.connect(path, isolation_level=None)
    try:
        database.execute(statement)
    except sqlite3.Error as error:
        return f"{statement}: {error}"
    finally:
        database.close()
    return statement


def spoil_folder(rng: random.Random, folder: Path) -> str:
    """Damage one file of a run folder; what was done."""
    files = [
        "samples.sqlite",
        "surrogate.json",
        "controller.json",
        "result.json",
        "case.toml",
        "truth.json",
        "surrogates/0001.json",
        "retrain.lock",
    ]
    name = rng.choice(files)
    path = folder / name
    if not path.is_file():
        return f"{name}: spoilt already"
    kind = rng.choices(["inside", "bytes", "gone", "folder", "link", "other"], [10, 4, 1, 1, 1, 1])[
        0
    ]
    if kind == "inside":
        if name.endswith(".json"):
            return f"{name}: {spoil_json(rng, path)}"
        if name.endswith(".sqlite"):
            return f"{name}: {spoil_store(rng, path)}"
        if name == "case.toml":
            with suppress(ValueError):  # what was spoilt before may be no TOML any more
                data = tomllib.loads(path.read_text())
                note = mutate(rng, data)
                path.write_bytes(toml(data).encode("utf-8", "surrogatepass"))
                return f"{name}: {note}"
        kind = "bytes"
    if kind == "bytes":
        content, note = spoil(rng, path.read_bytes())
        path.write_bytes(content)
        return f"{name}: {note}"
    path.unlink()
    if kind == "folder":
        path.mkdir()
        (path / "x").touch()
    elif kind == "link":
        path.symlink_to(rng.choice([path.name, "/nowhere", "/", "."]))
    elif kind == "other" and name in ("truth.json", "samples.sqlite"):
        path.write_text("[]" * rng.choice([1, 1000]))
    elif kind == "other":
        shutil.copy(folder / rng.choice(["truth.json", "index.html", "samples.sqlite"]), path)
    return f"{name}: {kind}"


def run_folder(rng: random.Random, folder: Path, run: Path) -> Input:
    copy = Path(shutil.copytree(run, folder / "run"))
    (copy / "index.html").write_text("<html>")
    note = "; ".join(spoil_folder(rng, copy) for _ in range(rng.choice([1, 1, 1, 2])))
    kind = rng.choices(["read", "solve", "retrain", "insight"], [200, 6, 1, 2])[0]
    quick = ["--workers", "1", "--quiet"]
    if kind == "read":
        return Input("folder", "read", [str(copy)], note)
    if kind == "retrain":
        return Input("folder", "retrain", [str(copy), "--budget", "4", *quick], note)
    if kind == "insight":
        return Input("folder", "insight", [str(copy), "--points", "2", *quick], note)
    words = [str(copy / "case.toml"), "--out", str(copy), "--formulation", "lifted", *quick]
    return Input("folder", "solve", words, note, report=rng.random() < 0.2)


def faulty(rng: random.Random, folder: Path, run: Path) -> Input:
    copy = Path(shutil.copytree(run, folder / "run"))
    fault = rng.choice(["full", "full", "clock", "locked", "readonly"])
    quick = ["--workers", "1", "--quiet"]
    if rng.random() < 0.6:
        for path in copy.glob("samples.sqlite*"):
            path.unlink()
    words = [str(copy / "case.toml"), "--out", str(copy), *quick]
    words += ["--formulation", rng.choice(["lifted", "direct", "nested"])]
    command = "solve"
    if rng.random() < 0.25 and (copy / "samples.sqlite").exists():
        command, words = "retrain", [str(copy), "--budget", "4", *quick]
    amount = float(int(10 ** rng.uniform(0.0, 5.5)))
    return Input("fault", command, words, fault, None, fault, amount, rng.random() < 0.3)


def interrupted(rng: random.Random, folder: Path, run: Path) -> Input:
    copy = Path(shutil.copytree(run, folder / "run"))
    for path in copy.glob("samples.sqlite*"):
        path.unlink()
    words = [str(copy / "case.toml"), "--out", str(copy), "--workers", "1", "--quiet"]
    words += ["--formulation", rng.choice(["lifted", "direct", "nested"])]
    return Input("interrupt", "solve", words, "", rng.uniform(0.0, 2.5), report=rng.random() < 0.3)
