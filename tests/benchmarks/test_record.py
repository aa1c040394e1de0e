"""Benchmarks write tables of the documentation."""

from __future__ import annotations

import json
from datetime import date

import pytest

from tests.benchmarks import record as recording
from tests.benchmarks.record import RESULTS, record, written


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A folder with one results file, in which benchmarks are to record."""
    content = {
        "columns": ["robot", "rows/s", "error"],
        "date": "2000-01-01",
        "machine": "?",
        "slipid": "0",
        "rows": [["one", 50, 1.0], ["one", 100, 2.0]],
    }
    (tmp_path / "some.json").write_text(json.dumps(content))
    monkeypatch.setattr(recording, "RESULTS", tmp_path)
    monkeypatch.setattr(recording, "QUICK", False)
    monkeypatch.setenv("SLIPID_RECORD", "1")
    return tmp_path / "some.json"


def test_rows_are_replaced_or_added(results):
    record("some", [["one", 100, [0.5, 0.4, 0.6]], ["two", 50, None]], keys=2)
    content = json.loads(results.read_text())
    assert content["rows"] == [["one", 50, 1.0], ["one", 100, [0.5, 0.4, 0.6]], ["two", 50, None]]
    assert content["date"] == date.today().isoformat()
    assert content["slipid"] != "0"


def test_a_row_of_another_width_is_refused(results):
    with pytest.raises(ValueError, match="a row of 2 cells"):
        record("some", [["one", 100]])


def test_nothing_is_written_unasked(results, monkeypatch):
    before = results.read_bytes()
    monkeypatch.delenv("SLIPID_RECORD")
    record("some", [["one", 100, 9.0]])
    monkeypatch.setenv("SLIPID_RECORD", "1")
    monkeypatch.setattr(recording, "QUICK", True)
    record("some", [["one", 100, 9.0]])
    assert results.read_bytes() == before


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.json")), ids=lambda path: path.stem)
def test_files_are_as_a_benchmark_would_write_them(path):
    text = path.read_text(encoding="utf-8")
    assert text == written(json.loads(text))
