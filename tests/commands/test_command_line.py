"""What the commands share: options, exit codes, and one line on stderr for a user's mistake."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ccd_casadi.cases.case import load_case
from ccd_casadi.support.command_line import ExitCode, parser, run, run_folder
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import usable_cores

COMMAND = """
import sys
from ccd_casadi.support.command_line import ExitCode, parser, run

def main(options):
    {body}

sys.exit(run(main, parser("a.command", "what it does"), {argv}))
"""


def done(options: argparse.Namespace) -> ExitCode:
    return ExitCode.DONE


def never(options: argparse.Namespace) -> ExitCode:
    raise AssertionError("bad options must not reach the command")


def options_of(*argv: str) -> argparse.Namespace:
    return parser("a.command", "what it does").parse_args(argv)


def test_exit_codes_are_the_contracts() -> None:
    assert {code.name: code.value for code in ExitCode} == {
        "DONE": 0,
        "BAD_INPUT": 2,
        "INFEASIBLE": 3,
        "NOT_VERIFIED": 4,
        "INTERRUPTED": 130,
    }


def test_options_have_defaults() -> None:
    assert vars(options_of()) == {
        "case": Path("runs/two_mass.toml"),
        "out": None,
        "workers": usable_cores(),
        "seed": 0,
        "quiet": False,
        "no_user_code": False,
    }


def test_options_are_read(tmp_path: Path) -> None:
    out = tmp_path / "not" / "yet"
    found = options_of("x.toml", "--out", str(out), "--workers", "3", "--seed", "7", "--quiet")
    assert vars(found) == {
        "case": Path("x.toml"),
        "out": out,
        "workers": 3,
        "seed": 7,
        "quiet": True,
        "no_user_code": False,
    }
    assert not out.parent.exists()  # reading an option makes nothing


@pytest.mark.parametrize("code", ExitCode)
def test_the_commands_verdict_is_the_exit_code(code: ExitCode) -> None:
    assert run(lambda options: code, parser("a.command", "what it does"), []) == code


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--workers", "0"], "argument --workers: '0' is not a whole number from 1"),
        (["--workers", "-2"], "argument --workers: "),
        (["--workers=-2"], "argument --workers: '-2' is not a whole number from 1"),
        (["--workers", "2.5"], "argument --workers: '2.5' is not a whole number from 1"),
        (["--workers", "²"], "argument --workers: '²' is not a whole number from 1"),
        (["--workers", "9" * 5000], "argument --workers: '99999999999999999999' is not a whole"),
        (["--seed", "x"], "argument --seed: 'x' is not a whole number from 0"),
        (["--seed=-1"], "argument --seed: '-1' is not a whole number from 0"),
        (["--seed", "4294967296"], "argument --seed: '4294967296' is not a whole number from 0"),
        (["--seed"], "argument --seed: expected one argument"),
        (["--out", "{file}"], "argument --out: {file} is not a directory; choose another"),
        (["--out", "{file}/below"], "argument --out: {file} is not a directory; choose another"),
        (["--out", "{dangling}"], "argument --out: {dangling} is not a directory; choose another"),
        (["--nonsense"], "unrecognized arguments: --nonsense"),
        (["a.toml", "b\nc.toml"], "unrecognized arguments: b c.toml"),
    ],
)
def test_wrong_options_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str], words: str
) -> None:
    places = {"file": tmp_path / "file", "dangling": tmp_path / "dangling"}
    places["file"].write_text("")
    places["dangling"].symlink_to(tmp_path / "nowhere")
    argv = [item.format(**places) for item in argv]
    assert run(never, parser("a.command", "what it does"), argv) == ExitCode.BAD_INPUT
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(words.format(**places))
    assert err.endswith("; see python -m a.command --help\n")
    assert len(err.splitlines()) == 1


def test_a_folder_that_is_not_writable_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Root may write anywhere, so the system's answer is put in its mouth.
    monkeypatch.setattr(os, "access", lambda place, mode: str(place) != str(tmp_path))
    below = str(tmp_path / "new" / "folder")
    assert run(never, parser("a.command", ""), ["--out", below]) == ExitCode.BAD_INPUT
    assert f"argument --out: {tmp_path} is not writable" in capsys.readouterr().err
    with pytest.raises(UserError, match="is not writable; choose another --out"):
        run_folder(Path("x.toml"), tmp_path)


def test_help_is_no_failure(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(never, parser("a.command", "what it does"), ["--help"]) == ExitCode.DONE
    text = capsys.readouterr().out
    for word in ("python -m a.command", "what it does", "--out", "--workers", "--seed", "--quiet"):
        assert word in text


def test_a_users_mistake_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    def main(options: argparse.Namespace) -> ExitCode:
        raise UserError("x.toml: key: wrong\n  over two lines")

    assert run(main, parser("a.command", ""), []) == ExitCode.BAD_INPUT
    assert capsys.readouterr() == ("", "x.toml: key: wrong over two lines\n")


def test_a_wrong_case_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def main(options: argparse.Namespace) -> ExitCode:
        load_case(options.case)
        return ExitCode.DONE

    path = tmp_path / "x.toml"
    path.write_text("[plants]\n")
    assert run(main, parser("a.command", ""), [str(path)]) == ExitCode.BAD_INPUT
    assert capsys.readouterr() == ("", f"{path}: plants: unknown table; did you mean plant?\n")


def test_a_bug_is_not_hidden() -> None:
    def main(options: argparse.Namespace) -> ExitCode:
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        run(main, parser("a.command", ""), [])


def test_ctrl_c_says_that_the_work_is_kept(capsys: pytest.CaptureFixture[str]) -> None:
    def main(options: argparse.Namespace) -> ExitCode:
        raise KeyboardInterrupt

    assert run(main, parser("a.command", ""), []) == ExitCode.INTERRUPTED
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert "the same command resumes" in err


def test_nothing_global_is_set() -> None:
    before = dict(os.environ), sys.stdout, sys.stderr, sys.excepthook
    assert run(done, parser("a.command", ""), []) == ExitCode.DONE
    assert (dict(os.environ), sys.stdout, sys.stderr, sys.excepthook) == before


@pytest.mark.parametrize(
    ("body", "code"),
    [
        # All is written at the end: the command had concluded, and its verdict stands.
        ("sys.stdin.readline(); print('x'); return ExitCode.NOT_VERIFIED", ExitCode.NOT_VERIFIED),
        # The pipe breaks on the way: the command was cut short.
        ("sys.stdin.readline(); print('x' * 10**6, flush=True); return ExitCode.DONE",
         ExitCode.INTERRUPTED),
    ],
)  # fmt: skip
def test_a_reader_that_went_away_is_no_noise(body: str, code: ExitCode) -> None:
    reader, writer = os.pipe()
    script = COMMAND.format(body=body, argv=[])
    with subprocess.Popen(
        [sys.executable, "-W", "error", "-c", script],
        stdin=subprocess.PIPE,
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"},
    ) as process:
        os.close(writer)
        os.close(reader)
        _, err = process.communicate("go\n", timeout=60)
    assert (process.returncode, err) == (code, "")


def test_run_folder_is_beside_the_case_or_where_it_is_required(tmp_path: Path) -> None:
    assert run_folder(tmp_path / "x.toml", None) == tmp_path / "x"
    assert run_folder(tmp_path / "x.toml", tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert run_folder(tmp_path / "x.toml", None).is_dir()  # again: it may exist
    assert (tmp_path / "a" / "b").is_dir()


@pytest.mark.parametrize("name", ["file", "file/below", "x" * 300])
def test_a_run_folder_that_cannot_be_made_is_reported(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError) as caught:
        run_folder(tmp_path / "x.toml", tmp_path / name)
    text = str(caught.value)
    assert text.startswith(str(tmp_path / name))
    assert text.endswith("; choose another --out")
    assert len(text.splitlines()) == 1
