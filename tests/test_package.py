from __future__ import annotations

import ast
import importlib.metadata
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import slipid

HEAVY = ["jax", "equinox", "optimistix", "scipy", "matplotlib", "pydantic", "pint", "typer", "rich"]


def test_version_is_the_installed_one():
    assert slipid.__version__ == importlib.metadata.version("slipid")


def test_older_public_names_still_work():
    assert slipid.made_runs is slipid.simulate_runs
    assert slipid.move is slipid.steady_motion


def test_import_is_light_and_silent():
    code = (
        f"import json, sys, slipid\nprint(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert json.loads(done.stdout) == []


@pytest.mark.slow
def test_all_but_extras_runs_without_their_libraries():
    """What `pip install slipid` brings is enough to identify, deploy and run the demo."""
    rooms = (
        *(
            "cli.demo",
            "app.identify",
            "app.compare",
            "infer.posterior.diagnosis",
        ),
        *("deploy.deploy", "lab.trial.trial", "api.fit", "api.robot", "plots.fit"),
    )
    code = (
        "import sys\nfrom importlib import import_module\n"
        "for extra in ('emcee', 'arviz_stats', 'xarray', 'h5netcdf', 'mujoco', 'cv2', 'pyarrow'):\n"
        "    sys.modules[extra] = None\n"
        f"for room in {rooms!r}: import_module('slipid.' + room)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_xla_gets_only_flags_that_it_knows_and_that_are_not_set(monkeypatch):
    from slipid.support import jax_setup

    for version, before, after in (
        ("0.10.2", "", jax_setup.PLAIN_LOOPS),
        ("0.10.2", "--a=b", f"--a=b {jax_setup.PLAIN_LOOPS}"),
        ("0.10.2", "--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true"),
        ("0.11.0", "--a=b", "--a=b"),
        ("0.10.2", "/flags.txt", "/flags.txt"),  # XLA reads them from there
    ):
        monkeypatch.setattr(jax_setup, "version", lambda _, v=version: v)
        monkeypatch.setenv("XLA_FLAGS", before)
        jax_setup.plain_loops()
        assert jax_setup.os.environ["XLA_FLAGS"] == after


def test_a_class_name_stands_for_one_class():
    paths = Path(slipid.__file__).parent.rglob("*.py")
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in paths)
    names = Counter(
        node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_no_public_name_is_that_of_a_room():
    """A module that is imported would hide the function of its name."""
    rooms = {path.stem for path in Path(slipid.__file__).parent.iterdir()}
    assert not rooms & set(slipid.__all__)
