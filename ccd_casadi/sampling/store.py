"""The store of samples: rows with hashed keys in SQLite, one transaction a unit of work."""

import json
import math
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import plain, restore
from ccd_casadi.support.time_budget import time_is_up

DAMAGED = "a row is damaged"


@dataclass(frozen=True)
class Sample:
    """One synthesis, certified or not; SI, frequencies in rad/s, NaN where there is no figure.

    Attributes
    ----------
    key, outcome, reason : str
        Of the row, and how the synthesis ended.
    theta : tuple of float
        SI.
    gradients : tuple of float or None
        Flattened total derivatives (4, n_θ + 2) of (ω_b, ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt) to
        (θ, ln ω_S, ln ω_T), where they were computed. With `compliance` (‖GS‖∞, m/N) its logarithm
        comes before γ_opt.
    seconds : float
        That it took.
    """

    key: str
    theta: tuple[float, ...]
    omega_S: float
    omega_T: float
    outcome: str
    reason: str
    gamma_opt: float = math.nan
    gamma_lower_bound: float = math.nan
    gamma: float = math.nan
    bandwidth: float = math.nan
    sensitivity_peak: float = math.nan
    sensitivity_peak_frequency: float = math.nan
    sensitivity_low: float = math.nan
    max_real_pole: float = math.nan
    norm: float = math.nan
    norm_bound: float = math.nan
    certified: bool = False
    seconds: float = 0.0
    gradients: tuple[float, ...] | None = None
    compliance: float = math.nan


COLUMNS = tuple(field.name for field in fields(Sample))
_REALS = frozenset(f.name for f in fields(Sample) if f.type is float)
_TEXTS = frozenset(f.name for f in fields(Sample) if f.type is str)


def to_row(sample: Sample) -> tuple[object, ...]:
    """The values of COLUMNS as SQLite takes them: NaN as null, tuples as JSON."""
    row: list[object] = []
    for name in COLUMNS:
        value = getattr(sample, name)
        if name == "theta" or (name == "gradients" and value is not None):
            value = json.dumps([None if math.isnan(item) else item for item in value])
        elif name == "certified":
            value = int(value)
        elif isinstance(value, float) and math.isnan(value):
            value = None
        row.append(value)
    return tuple(row)


def from_row(row: Sequence[Any]) -> Sample:
    """Read a sample from its row. Raises sqlite3.DatabaseError for a row that `to_row` cannot have
    made."""
    values: dict[str, Any] = dict(zip(COLUMNS, row, strict=True))
    values |= {name: math.nan for name in _REALS if values[name] is None}
    values["theta"] = numbers_of(decode(values["theta"]))
    values["certified"] = bool(values["certified"])
    if values["gradients"] is not None:
        values["gradients"] = numbers_of(decode(values["gradients"]))
    if not all(isinstance(values[name], str) for name in _TEXTS):
        raise sqlite3.DatabaseError(DAMAGED)
    numbers_of([values[name] for name in _REALS])
    return Sample(**values)


def numbers_of(items: Any) -> tuple[float, ...]:
    """A list of numbers (null: NaN) as it was stored. Raises sqlite3.DatabaseError for others."""
    if not isinstance(items, list) or not all(
        item is None or type(item) in (int, float) for item in items
    ):
        raise sqlite3.DatabaseError(DAMAGED)
    return tuple(math.nan if item is None else float(item) for item in items)


def decode(text: Any) -> Any:
    """A value from its JSON. Raises sqlite3.DatabaseError for what is none."""
    try:
        return json.loads(text)
    except (ValueError, TypeError, RecursionError) as error:
        raise sqlite3.DatabaseError(DAMAGED) from error


T = TypeVar("T")
SCHEMA = 1  # of the tables


class SampleStoreError(UserError):
    """The file is not a usable sample store; the message names it and says what to do."""


_ADDED = "compliance"  # the one column that stores of before do not have
_TABLES = """
create table if not exists meta (name text primary key, value text not null);
create table if not exists problems (hash text primary key, json text not null);
create table if not exists samples (
    key text primary key, problem text, theta text not null, omega_S real not null,
    omega_T real not null, outcome text not null, reason text not null, gamma_opt real,
    gamma_lower_bound real, gamma real, bandwidth real, sensitivity_peak real,
    sensitivity_peak_frequency real, sensitivity_low real, max_real_pole real, norm real,
    norm_bound real, certified integer not null, seconds real, gradients text, compliance real
);
create table if not exists results (
    key text primary key, problem text not null, theta text not null, json text not null
);
create index if not exists samples_of_problem on samples (problem);
create index if not exists results_of_problem on results (problem);
"""


class SampleStore(AbstractContextManager["SampleStore"]):
    """Samples in a file: `with SampleStore(path) as store:`.

    Parameters
    ----------
    path : path
        Of the SQLite file, which is made where there is none.
    busy_seconds : float
        How long to wait for another process that writes.

    Raises
    ------
    SampleStoreError
        The file is not usable.
    """

    def __init__(self, path: str | Path, busy_seconds: float = 60.0) -> None:
        self.path, self.busy_seconds = Path(path), busy_seconds
        with self.reword_errors():
            self._db = sqlite3.connect(self.path, timeout=busy_seconds, isolation_level=None)
            try:
                self._check()
                self._write_ahead()
                self._db.execute("pragma synchronous = normal")
                with self._transaction():
                    # one by one: executescript would end the transaction
                    for statement in _TABLES.split(";"):
                        self._db.execute(statement)
                    if _ADDED not in self._columns():  # a store of before
                        self._db.execute(f"alter table samples add column {_ADDED} real")
                    insert = "insert or ignore into meta values ('schema', ?)"
                    self._db.execute(insert, (str(SCHEMA),))
            except BaseException:
                self._db.close()
                raise

    def _check(self) -> None:
        """Refuse, untouched, a database that is not ours or has another schema."""
        kinds = self._db.execute("select name, type from sqlite_master").fetchall()
        tables = {name for name, kind in kinds if kind == "table"}
        if not kinds:
            return  # new, or being made by another process in one transaction
        if any(kind in ("trigger", "view") for _, kind in kinds):
            raise self._foreign("holds statements (triggers, views) that no store of ours has")
        if not {"meta", "problems", "samples", "results"} <= tables:
            raise self._foreign("is a database of another program")
        found = self._db.execute("select * from meta where name = 'schema'").fetchone()
        columns = self._columns() | {_ADDED}
        schema = None if found is None else found[1]
        if schema != str(SCHEMA) or not set(COLUMNS) <= columns:
            raise self._foreign(f"is a sample store of schema {schema}, not {SCHEMA}")

    def _foreign(self, words: str) -> SampleStoreError:
        return SampleStoreError(f"{self.path}: {words}; choose another --out")

    def _columns(self) -> set[str]:
        return {row[1] for row in self._db.execute("pragma table_info(samples)")}

    def _write_ahead(self) -> None:
        """Switch to the write-ahead log; SQLite does not wait for that lock by itself."""
        deadline = time.monotonic() + self.busy_seconds
        while True:
            try:
                self._db.execute("pragma journal_mode = wal")
                return
            except sqlite3.OperationalError as error:
                if "locked" not in str(error) or time.monotonic() > deadline:
                    raise
            time.sleep(0.01)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; every put is already on disk."""
        self._db.close()

    def put_problem(self, key: str, problem: Mapping[str, object]) -> None:
        """Keep what a problem hash stands for, so that the file explains itself."""
        with self.reword_errors(), self._transaction():
            text = json.dumps(problem, sort_keys=True)
            self._db.execute("insert or ignore into problems values (?, ?)", (key, text))

    def put(self, samples: Iterable[Sample], problem: str | None = None) -> None:
        """Write samples in one transaction; known keys stay as they are, but gain gradients."""
        with self.reword_errors(), self._transaction():
            self._insert(samples, problem)

    def put_unit(
        self,
        samples: Iterable[Sample],
        result: tuple[str, str, Sequence[float], Mapping[str, object]],
        problem: str | None = None,
        *,
        anew: bool = False,
    ) -> None:
        """Write a unit's samples and its result (key, problem, θ, payload): all or nothing.

        A key that is known stays as it is, unless the result is `anew`.
        """
        key, owner, theta, payload = result
        row = (key, owner, json.dumps(list(theta)), json.dumps(payload))
        with self.reword_errors(), self._transaction():
            self._insert(samples, problem)
            way = "replace" if anew else "ignore"
            self._db.execute(f"insert or {way} into results values (?, ?, ?, ?)", row)

    def get(self, keys: Sequence[str]) -> dict[str, Sample]:
        """The samples known among `keys`."""
        found: dict[str, Sample] = {}
        columns = ", ".join(COLUMNS)
        with self.reword_errors():
            for i in range(0, len(keys), 500):
                part = list(keys[i : i + 500])
                marks = ", ".join("?" * len(part))
                query = f"select {columns} from samples where key in ({marks})"
                for row in self._db.execute(query, part):
                    found[row[0]] = from_row(row)
        return found

    def get_result(self, key: str) -> dict[str, Any] | None:
        """The payload of a unit of work, None where it is not known."""
        with self.reword_errors():
            row = self._db.execute("select json from results where key = ?", (key,)).fetchone()
            return None if row is None else decode(row[0])

    def recall(
        self, key: str, owner: str, theta: Sequence[float], kind: type[T], make: Callable[[], T]
    ) -> T:
        """The dataclass that was stored under a key, else what `make` gives, which is stored unless
        its time was up.

        Raises SampleStoreError where the row holds something else.
        """
        stored = self.get_result(key)
        if stored is None:
            made = make()
            if not time_is_up():  # with more time it may be better
                self.put_unit([], (key, owner, theta, plain(made)))
            return made
        try:
            found: T = restore(kind, stored)
            return found
        except (KeyError, TypeError, ValueError) as error:
            raise self.damaged_error() from error

    def select(self, problem: str | None = None) -> list[Sample]:
        """Every sample (of one problem hash, if given), ordered by θ, ω_S and ω_T."""
        where, given = _of(problem)
        with self.reword_errors():
            query = f"select {', '.join(COLUMNS)} from samples {where}"
            rows = self._db.execute(query, given).fetchall()
            samples = [from_row(row) for row in rows]
        return sorted(samples, key=lambda s: (s.theta, s.omega_S, s.omega_T, s.key))

    def count(self, problem: str | None = None) -> int:
        """Number of samples (of one problem hash, if given)."""
        where, given = _of(problem)
        with self.reword_errors():
            query = f"select count(*) from samples {where}"
            return int(self._db.execute(query, given).fetchone()[0])

    def thetas(self, problem: str) -> list[tuple[float, ...]]:
        """θ of every unit of work of one problem hash, oldest first."""
        query = "select theta from results where problem = ? order by rowid"
        with self.reword_errors():
            return [numbers_of(decode(row[0])) for row in self._db.execute(query, (problem,))]

    def keys_with_gradients(self, problem: str) -> list[str]:
        """Keys of the samples of one problem hash that have gradients, oldest first."""
        query = "select key from samples where problem = ? and gradients is not null order by rowid"
        with self.reword_errors():
            return [row[0] for row in self._db.execute(query, (problem,))]

    def _insert(self, samples: Iterable[Sample], problem: str | None) -> None:
        marks = ", ".join("?" * (len(COLUMNS) + 1))
        self._db.executemany(
            f"insert into samples ({', '.join(COLUMNS)}, problem) values ({marks}) "
            "on conflict (key) do update set gradients = excluded.gradients "
            "where samples.gradients is null and excluded.gradients is not null",
            [(*to_row(sample), problem) for sample in samples],
        )

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._db:  # which commits, or rolls back
            self._db.execute("begin immediate")
            yield

    def damaged_error(self) -> SampleStoreError:
        """Return the error for a row that cannot be what was written."""
        return SampleStoreError(f"{self.path}: {DAMAGED}; move it away or choose another --out")

    @contextmanager
    def reword_errors(self) -> Iterator[None]:
        """SQLite's errors as one line that says what to do."""
        try:
            yield
        except sqlite3.ProgrammingError:
            raise  # a mistake of the program, not of the file
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            text = " ".join(str(error).split())
            if "locked" in text:
                advice = "another process holds it; wait or stop that one"
            elif "readonly" in text or "unable to open" in text:
                advice = "give a writable folder with --out"
            elif "full" in text:
                advice = "free some disk space and resume"
            else:
                advice = "it is damaged or no sample store; move it away or choose another --out"
            raise SampleStoreError(f"{self.path}: {text}; {advice}") from error


def _of(problem: str | None) -> tuple[str, tuple[str, ...]]:
    """The rows of one problem hash, or all: a condition that an index answers, and its values."""
    return ("", ()) if problem is None else ("where problem = ?", (problem,))
