"""Logs of motors in the layouts of other tools, in one or several files, and damaged ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slipid.app.bench import read_motor_log
from slipid.data.reading.motor_layout import MotorOptions, given_columns
from slipid.infer.bench.motor import BenchRecord
from tests.helpers import motor_layouts as made
from tests.helpers.motor_layouts import LAYOUTS, MotorLayout


def read(path: Path, options: MotorOptions | None = None, **columns: str) -> list[BenchRecord]:
    """The records of a single motor, with columns given like options of the command."""
    given = {channel: given_columns(text, channel) for channel, text in columns.items()}
    task = read_motor_log(path, given, None, options or MotorOptions())
    assert [*task.records] == [""]
    return [*task.records[""]]


def read_layout(folder: Path, layout: MotorLayout) -> list[BenchRecord]:
    """Read a layout's file in a folder; an oscilloscope's with the log beside it."""
    path = folder / layout.name
    if not layout.voltage:
        return read(path, layout.options)
    return read(folder / "main.csv", layout.options, voltage=f"{path}::{layout.voltage}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a file of each layout."""
    path = tmp_path_factory.mktemp("layouts")
    made.without_voltage(path / "main.csv", made.signals())
    for layout in LAYOUTS:
        step = 1e-3 if layout.voltage else made.STEP
        rows = round(made.ROWS * made.STEP / step)
        layout.write(path / layout.name, made.signals(rows=rows, step=step))
    return path


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda one: one.name)
def test_every_layout_is_read_as_it_is(folder, layout):
    records = read_layout(folder, layout)
    assert len(records) == layout.tests
    time = np.concatenate([r.time for r in records])
    assert len(time) >= 0.99 * made.ROWS
    s = made.signals()
    for name, tolerance in (("voltage", 0.02), ("current", 0.01), ("speed", 0.2)):
        if name == "current" and not layout.current:
            assert all(r.current is None for r in records)
            continue
        known = np.interp(time, s.time, getattr(s, name))
        values = np.concatenate([getattr(r, name) for r in records])
        inner = slice(1, -1) if layout.voltage else slice(None)
        np.testing.assert_allclose(values[inner], known[inner], atol=tolerance)


def test_tests_are_records_with_their_names(folder):
    names = [r.name for r in read(folder / "sysid.csv")]
    assert names == [f"sysid.csv: {test}" for test in made.TESTS]
    assert [r.name.split(": ")[1] for r in read(folder / "sysid.wpilog")] == [*made.TESTS]
    assert [r.name.split(": ")[1] for r in read(folder / "sysid.json")] == [*made.OLD_TESTS]
