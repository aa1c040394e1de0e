"""The lessons run from top to bottom, with real logs and without, and hold no stale outputs."""

from __future__ import annotations

import ast
import base64
import re
from pathlib import Path

import nbformat
import pytest

import slipid
from tests.helpers.kept import kept

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
FIGURES = {
    "01_one_wheel": 4,
    "02_a_real_log": 5,
    "03_fit_and_identifiability": 6,
    "04_posterior": 4,
    "05_linear_or_nonlinear": 4,
    "06_compensation": 3,
    "07_from_a_video": 3,
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


@pytest.mark.parametrize("name", FIGURES)
def test_lessons_import_the_public_interface_alone(name):
    lesson = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    code = "\n".join(cell.source for cell in lesson.cells if cell.cell_type == "code")
    tree = ast.parse(re.sub("^%.*", "", code, flags=re.M))
    named = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    of_slipid = [text for node in named if "slipid" in (text := ast.unparse(node))]
    assert of_slipid == ["import slipid as sl"]
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "sl"
    }
    assert used <= set(slipid.__all__)


@pytest.mark.slow
@pytest.mark.parametrize("name", kept(FIGURES, list(FIGURES)[:2]))
def test_lesson_runs_without_real_logs(name, tmp_path, monkeypatch):
    monkeypatch.setenv("SLIPID_DATA", str(tmp_path))
    pictures = run(name, tmp_path)
    assert len(pictures) == FIGURES[name]
    assert min(map(len, pictures)) > 10_000  # an empty frame is smaller


@pytest.mark.slow
def test_a_real_log_runs_on_real_logs(real_data, tmp_path, monkeypatch):
    monkeypatch.setenv("SLIPID_DATA", str(real_data.resolve()))
    assert len(run("02_a_real_log", tmp_path)) == FIGURES["02_a_real_log"]
