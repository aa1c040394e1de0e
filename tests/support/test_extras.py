"""Optional packages: what is missing is named, with a command that can be typed."""

from __future__ import annotations

import ast
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from slipid.support import extras
from slipid.support.errors import DataError
from slipid.support.extras import MissingExtra, install_command, require

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def installed_in(folder: Path, monkeypatch, clone: bool) -> Path:
    """A folder in which slipid is installed in `.venv`, as a clone or not; return its package."""
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "pip").touch()
    root = folder if clone else folder / ".venv" / "lib"
    package = root / "slipid" / "support"
    package.mkdir(parents=True)
    if clone:
        (folder / "pyproject.toml").touch()
    monkeypatch.setattr(extras, "__file__", str(package / "extras.py"))
    monkeypatch.setattr(sys, "prefix", str(folder / ".venv"))
    return package


def test_in_a_clone_the_command_is_short(tmp_path, monkeypatch):
    installed_in(tmp_path, monkeypatch, clone=True)
    monkeypatch.chdir(tmp_path)
    assert install_command("posterior") == ".venv/bin/pip install -e '.[posterior]'"


def test_elsewhere_the_command_names_the_clone(tmp_path, monkeypatch):
    installed_in(tmp_path / "a clone", monkeypatch, clone=True)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    root = tmp_path / "a clone"
    assert shlex.split(install_command("ulog")) == [
        *(str(root / ".venv/bin/pip"), "install", "-e", f"{root}[ulog]"),
    ]


def test_an_installed_wheel_gets_the_extra_by_its_name(tmp_path, monkeypatch):
    installed_in(tmp_path, monkeypatch, clone=False)
    monkeypatch.chdir(tmp_path)
    assert install_command("bags") == ".venv/bin/pip install 'slipid[bags]'"
    (tmp_path / ".venv/bin/pip").unlink()
    assert install_command("bags") == f"{sys.executable} -m pip install 'slipid[bags]'"


def test_a_missing_package_is_named_with_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(MissingExtra) as told:
        require("pyulog", "ulog", "run.ulg: a ULog file")
    assert str(told.value) == (
        "run.ulg: a ULog file needs the package pyulog, which is not installed; "
        f"install it with: {install_command('ulog')}"
    )
    # by either name it is caught where the other would be
    assert isinstance(told.value, DataError)
    assert isinstance(told.value, ImportError)


def test_a_package_that_fails_to_load_gives_the_reason(tmp_path, monkeypatch):
    (tmp_path / "broken_extra.py").write_text("raise ImportError('libGL.so.1: not found')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtra, match=r"needs a package \(libGL\.so\.1: not found\)"):
        require("broken_extra", "camera", "an image")


def test_every_extra_that_a_message_names_exists():
    known = set(PROJECT["optional-dependencies"])
    named = {}
    for path in (ROOT / "slipid").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                place = {"require": 1, "missing": 0}.get(node.func.id)
                if place is not None and path.name != "extras.py":
                    argument = node.args[place]
                    assert isinstance(argument, ast.Constant), path
                    named[argument.value] = path
    assert {name: path for name, path in named.items() if name not in known} == {}
    assert {"report", "posterior", "bags", "testsite"} <= set(named)
