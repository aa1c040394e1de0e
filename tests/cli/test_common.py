"""The end of every command: where to look first, what else was written, what to type next."""

from __future__ import annotations

import inspect
import json
import math
import shlex
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import typer

from slipid.cli import common
from slipid.cli.common import Next, can_draw, emit, program
from slipid.cli.main import app
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.helpers.shared import invoke

GROUP = typer.main.get_command(app)
NEXT = Next("look for mistakes in the logs", ("check", Path("my robot.toml"), "--data", "logs"))


def shown(capsys, out=None, written=(), to=None, following=(NEXT,), show=lambda page: None):
    emit(to, {"value": 1.5}, show, following, out, written)
    return capsys.readouterr().out


def test_every_number_of_the_command_line_has_limits():
    count = 0
    for name, command in GROUP.commands.items():
        hints = get_type_hints(inspect.unwrap(command.callback), include_extras=True)
        for option, hint in hints.items():
            kind, *info = get_args(hint) or (hint,)
            if {float, int} & {kind, *get_args(kind)} and option != "return":
                assert 1 <= info[0].max <= 2**32, (name, option)
                assert info[0].min is not None, (name, option)
                assert -3600 <= info[0].min < info[0].max, (name, option)
                count += 1
    assert count > 25


@pytest.mark.parametrize("text", ["nan", "inf", "1e308", "-1"])
def test_a_number_beyond_its_limits_is_refused(tmp_path, text, capsys):
    assert invoke("trial", tmp_path, "--speed", text).exit_code == 2
    with pytest.raises(typer.Exit) as caught:  # versions of Typer differ in what they let through
        common.guarded(lambda **options: 0)(top_speed=math.nan)
    assert caught.value.exit_code == 2
    assert capsys.readouterr().err == "--top-speed: nan; expected a number\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("export", "fit", "--floors", ""), "--floors is empty; expected NAMES\n"),
        (("trial", "fit", "--load", " "), "--load is empty; expected a name\n"),
        (("check", "c.toml", "--data", ""), "--data is empty; expected a folder\n"),
        (("demo", "--out="), "--out is empty; expected a folder\n"),
        (("new", "--from", ""), "--from is empty; expected LOG\n"),
        (("check", "", "--data", "d"), "CONFIG is empty; expected a value\n"),
        (("design", "fit", "--floor", "a", "--floor", ""), "--floor is empty; expected a name\n"),
        (("trial", "fit", "--speed", "-NaN"), "--speed: nan; expected a number\n"),
        (
            ("trial", "fit", "--controllers", "a\nb"),
            "--controllers 'a\\nb'; expected printable characters\n",
        ),
    ],
)
def test_odd_values_are_refused_in_a_sentence(words, message):
    ended = invoke(*words)
    assert (ended.exit_code, ended.stderr) == (2, message)


@pytest.mark.parametrize(
    "words", [("x" * 5000,), ("check", f"--{'x' * 5000}"), ("--" + "x" * 999,)]
)
def test_wrong_usage_is_short(words):
    ended = invoke(*words)
    assert ended.exit_code == 2
    assert "x...x" in ended.stderr
    assert len(ended.stderr) < 600


def test_a_long_value_with_spaces_leaves_the_choices_in_the_message():
    ended = invoke("reference", "ab " * 2000)
    assert ended.exit_code == 2
    assert "expected one of config" in ended.stderr
    assert len(ended.stderr) < 300
    found = str(DataError(f"the robot's 'a' and {'b ' * 100}, 'c' and {'d ' * 160}"))
    assert "'a' and b b" in found


def test_the_page_is_named_first_and_the_others_below(capsys):
    written = ("fit.json", "paths.png", "report.html", "load_share.png")
    assert shown(capsys, Path("out"), written).splitlines()[:2] == [
        "in out: look first at report.html",
        "  fit.json, paths.png, load_share.png",
    ]


@pytest.mark.parametrize(
    ("written", "first"),
    [
        (("load_share.png", "fit.json", "paths.png"), "look first at paths.png"),
        (("trial.json", "trial.png"), "look first at trial.png"),
        (("9 CSV files",), "9 CSV files"),
    ],
)
def test_one_picture_comes_first(capsys, written, first):
    assert shown(capsys, Path("out"), written).startswith(f"in out: {first}\n")


def test_long_lists_of_files_go_on_in_the_next_line(capsys):
    names = [f"raw_carpet_{k}_as_built.png" for k in range(9)]
    lines = shown(capsys, Path("out"), names, following=()).splitlines()
    assert max(map(len, lines)) <= 80
    assert ", ".join(line.strip() for line in lines[1:]).count(".png") == 8


def test_the_next_command_can_be_typed(capsys):
    lines = shown(capsys).splitlines()
    assert lines[0] == "next, look for mistakes in the logs:"
    assert shlex.split(lines[1]) == ["slipid", "check", "my robot.toml", "--data", "logs"]


def test_json_on_stdout_comes_alone_and_in_a_file_beside_the_text(capsys, tmp_path):
    assert json.loads(shown(capsys, Path("out"), ("a.png",), "-")) == {"value": 1.5}
    target = tmp_path / "a.json"
    assert "next, " in shown(capsys, to=str(target))
    assert json.loads(target.read_text()) == {"value": 1.5}


@pytest.mark.parametrize(
    ("out", "written", "to", "place"),
    [
        (Path("out"), ("identified.json", "fit.json", "a.png"), None, "out/identified.json"),
        (None, (), "found.json", "found.json"),
        (None, (), None, "the file of --json FILE"),
    ],
)
def test_notes_that_are_left_out_are_said_to_be_in_a_file(
    capsys, tmp_path, monkeypatch, out, written, to, place
):
    monkeypatch.chdir(tmp_path)
    text = shown(capsys, out, written, to, show=lambda page: page.notes("abcdefgh"))
    assert f"3 more notes in {place}\n" in text


def test_the_program_is_named_as_it_was_called(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    script = tmp_path / ".venv" / "bin" / "slipid"
    script.parent.mkdir(parents=True)
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "argv", [".venv/bin/slipid", "check"])
    assert program() == ".venv/bin/slipid"
    monkeypatch.setenv("PATH", str(script.parent))
    assert program() == "slipid"
    monkeypatch.setattr(sys, "argv", ["/somewhere/slipid/__main__.py", "check"])
    assert program() == "python -m slipid"
    monkeypatch.setattr(sys, "argv", ["/somewhere/pytest"])
    assert program() == "slipid"


def test_pictures_are_left_out_with_the_reason(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with Reporter() as report:
        assert not can_draw(report)
    printed = capsys.readouterr().err
    assert "all pictures are left out: a picture needs the package matplotlib" in printed
    assert "install it with: " in printed
    monkeypatch.undo()
    with Reporter() as report:
        assert can_draw(report)


def test_suggestions_without_a_file_name_are_commands():
    from slipid.cli.identify import PRIORS

    for one in (PRIORS, common.renew(Path("out"))):
        name, *words = map(str, one.words)
        with GROUP.commands[name].make_context(name, words) as parsed:
            assert parsed.info_name == name
            assert not parsed.args
