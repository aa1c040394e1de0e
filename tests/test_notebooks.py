"""The lessons run from top to bottom, with real logs and without, and hold no stale outputs."""

from __future__ import annotations

import base64
from pathlib import Path

import nbformat
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
FIGURES = {
    "01_one_wheel": 5,
    "02_a_real_log": 8,
    "03_fit_and_identifiability": 7,
    "04_posterior": 5,
    "05_linear_or_nonlinear": 5,
    "06_compensation": 4,
}


def run(name: str, where: Path) -> list[bytes]:
    """Execute a lesson in a folder; its pictures."""
    from nbclient import NotebookClient

    lesson = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    client = NotebookClient(lesson, timeout=300, resources={"metadata": {"path": str(where)}})
    client.execute()  # raises with the cell's own error
    outputs = [o for cell in lesson.cells for o in cell.get("outputs", [])]
    data = [o["data"] for o in outputs if "data" in o]
    return [base64.b64decode(d["image/png"]) for d in data if "image/png" in d]


def test_every_lesson_is_known_here():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(FIGURES)


@pytest.mark.parametrize("name", FIGURES)
def test_outputs_are_stripped(name):
    lesson = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    code = [cell for cell in lesson.cells if cell.cell_type == "code"]
    assert code
    assert all(cell.outputs == [] and cell.execution_count is None for cell in code)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_lesson_runs_without_real_logs(name, tmp_path, monkeypatch):
    monkeypatch.setenv("SLIPID_DATA", str(tmp_path))
    pictures = run(name, tmp_path)
    assert len(pictures) == FIGURES[name]
    assert min(map(len, pictures)) > 10_000  # an empty frame is smaller


@pytest.mark.slow
def test_a_real_log_runs_on_real_logs(real_data, tmp_path, monkeypatch):
    monkeypatch.setenv("SLIPID_DATA", str(real_data.resolve()))
    assert len(run("02_a_real_log", tmp_path)) == FIGURES["02_a_real_log"]
