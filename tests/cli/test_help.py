"""The help: panels of commands, an example for each, `--version`, completion, plain text."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys

import pytest
import typer

import slipid
from slipid.cli.main import PANELS, app
from tests.helpers.shared import invoke

GROUP = typer.main.get_command(app)
NAMES = list(GROUP.commands)
WIDTH = 80


@pytest.fixture(autouse=True)
def _terminal_of_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", str(WIDTH))


def test_the_version_is_printed():
    result = invoke("--version")
    assert (result.exit_code, result.stdout) == (0, f"slipid {slipid.__version__}\n")


def test_the_help_lists_every_command_in_a_panel_on_one_line():
    lines = invoke("--help").stdout.splitlines()
    assert max(map(len, lines)) <= WIDTH
    panels = {}
    for line in lines:
        if line.endswith(":") and line[0] != " ":
            panels[line[:-1]] = found = []
        elif match := re.match("  ([a-z][a-z-]*) +[A-Z][a-z0-9]", line):
            found.append(match[1])
    assert list(panels) == [*PANELS, "Options"]
    assert [name for found in panels.values() for name in found] == NAMES


def test_without_a_command_the_help_is_printed():
    result = invoke()
    assert result.exit_code == 2
    assert "From logs:" in result.output


@pytest.mark.parametrize("name", NAMES)
def test_a_help_begins_with_an_example_that_can_be_typed(name):
    text = invoke(name, "--help").stdout
    assert max(map(len, text.splitlines())) <= WIDTH
    usage, example, sentence = text.split("\n\n")[:3]
    assert usage.startswith("Usage: ")
    assert sentence.strip()[0].isupper()
    start, _, typed = example.partition("Example: ")
    assert start.strip() == ""
    assert "\n" not in typed
    program, command, *words = shlex.split(typed)
    assert (program, command) == ("slipid", name)
    with GROUP.commands[name].make_context(name, words):  # raises for wrong or missing options
        pass


@pytest.mark.parametrize("name", NAMES)
def test_a_help_keeps_every_word_of_its_options(name):
    text = " ".join(invoke(name, "--help").stdout.split())
    for one in (p for p in GROUP.commands[name].params if not p.hidden):
        # a word that was broken at the end of a line is whole again without the space
        words = " ".join((one.help or "").split())
        assert words.replace(" ", "") in text.replace(" ", ""), one.name


def test_options_of_a_panel_are_listed_below_its_name():
    text = invoke("new", "--help").stdout
    assert text.index("For mecanum and skid:") < text.index("--track-m") < text.index("For omni")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_commands(shell):
    words = {"bash": "slipid ide", "zsh": "slipid ide", "fish": "slipid ide"}[shell]
    env = {
        **os.environ,
        "_SLIPID_COMPLETE": f"complete_{shell}",
        **{"COMP_WORDS": words, "COMP_CWORD": "1", "_TYPER_COMPLETE_ARGS": words},
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    code = "import sys; sys.argv[0] = 'slipid'; from slipid.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
    )
    assert "identify" in done.stdout
    assert "validate" not in done.stdout
