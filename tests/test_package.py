from __future__ import annotations

import ast
import importlib.metadata
import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import slipid

ROOT = Path(__file__).resolve().parents[1]
EXTRA = (
    *("matplotlib", "plotly", "jinja2", "rosbags", "pyarrow", "pyulog", "mcap", "cv2", "mujoco"),
    *("emcee", "arviz_base", "arviz_stats", "arviz_plots", "xarray", "h5netcdf", "h5py", "sklearn"),
)
"""Packages that extras install."""
DRAW_OR_SAMPLE = {
    "slipid.app.sample",
    *(f"slipid.infer.posterior.{name}" for name in ("ensemble", "learning", "proposals", "sample")),
    *(f"slipid.lab.{name}" for name in ("paper2021.plots", "trial.plots")),
}
"""Modules outside `slipid.plots` that need such a package: commands look for it before."""
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
    """Every module but those that draw and sample needs no more than `pip install slipid`."""
    code = f"""if True:
        import json, sys
        from importlib import import_module
        from pkgutil import walk_packages

        for package in {EXTRA!r}:
            sys.modules[package] = None
        import slipid

        absent = {{}}
        for module in walk_packages(slipid.__path__, "slipid.", onerror=lambda name: None):
            if not module.name.endswith("__main__"):
                try:
                    import_module(module.name)
                except ImportError as error:
                    absent[module.name] = str(error)
        print(json.dumps(absent))
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    absent = json.loads(done.stdout)
    assert {name for name in absent if not name.startswith("slipid.plots")} == DRAW_OR_SAMPLE
    assert "install" in absent["slipid.plots"]  # the command to type


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


def test_files_that_the_guide_for_contributors_names_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w/]+(?:/|\.py|\.toml))`|\]\(([\w/.]+)\)", text)
    paths = [Path(code or link) for code, link in named]
    assert len(paths) > 20
    homes = (ROOT, ROOT / "slipid")
    assert [path for path in paths if not any((home / path).exists() for home in homes)] == []
