from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BENCHES = sorted((ROOT / "tests" / "benchmarks").glob("bench_*.py"))


@pytest.mark.parametrize("path", BENCHES, ids=lambda path: path.stem)
def test_benchmark_imports(path, monkeypatch):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    assert any(name.startswith("test_") for name in vars(module)), "a benchmark measures something"


@pytest.mark.nightly  # a process each, about a minute
@pytest.mark.parametrize("path", BENCHES, ids=lambda path: path.stem)
def test_quick_form_of_a_benchmark_runs(path):
    """All of its code runs; what it measures then says nothing, so nothing is judged."""
    words = ["-q", "-p", "no:cacheprovider", "-o", "python_files=bench_*.py", "-m", "", str(path)]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        env=os.environ | {"SLIPID_BENCH_QUICK": "1"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
