from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys

HEAVY = ["jax", "equinox", "optimistix", "scipy", "matplotlib", "pydantic", "pint", "typer", "rich"]


def test_version_is_the_installed_one():
    import slipid

    assert slipid.__version__ == importlib.metadata.version("slipid")


def test_import_is_light_and_silent():
    code = (
        f"import json, sys, slipid\nprint(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert json.loads(done.stdout) == []
