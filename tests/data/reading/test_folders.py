"""`read_runs` finds the files, floors, sessions and load set-ups of a folder of logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import read_runs, session_of
from slipid.support.errors import DataError
from tests.helpers.broken_logs import GENERIC, GENERIC_LAYOUT, ROBOTINO, write_good


@pytest.fixture
def root(tmp_path):
    """Return a folder with one run on gray as built, and the same run with its load moved."""
    write_good(tmp_path)
    moved = tmp_path / "wheel_load" / "gray_surface" / "exp01.csv"
    moved.parent.mkdir(parents=True)
    moved.write_bytes((tmp_path / ROBOTINO).read_bytes())
    return tmp_path


def read(root, pattern="one_surface/*/*.csv", **how):
    return read_runs(root, pattern, "robotino2022", **how)


def test_the_folder_names_the_surface(root):
    (log,) = read(str(root)).logs
    assert (log.name, log.surface, log.load) == (ROBOTINO, "gray", "as_built")
    (moved,) = read(root, "wheel_load/*/*.csv", load="moved").logs
    assert (moved.surface, moved.load) == ("gray", "moved")


def test_a_surface_may_be_named_or_unknown(root):
    assert read(root, surface="oak").logs[0].surface == "oak"
    assert read(root, surface=None).logs[0].surface is None
    assert read(root, surface="gray_surface").logs[0].surface == "gray_surface"


def test_sessions(root):
    assert read(root).session == ("gray/as_built/0.10",)
    assert read(root, session="file").session == (ROBOTINO,)
    assert read(root, session="folder").session == (ROBOTINO.rpartition("/")[0],)
    (log,) = read(root).logs
    assert session_of(replace(log, name="alone.csv"), "folder") == "alone.csv"
    assert session_of(replace(log, name="a/rec.bag#03"), "file") == "a/rec.bag"


def test_runs_are_added_with_the_sessions_they_had(root):
    as_built = read(root, session="file")
    both = as_built + read(root, "wheel_load/*/*.csv", load="moved")
    assert [log.load for log in both.logs] == ["as_built", "moved"]
    assert both.session == (ROBOTINO, "gray/moved/0.10")
    np.testing.assert_array_equal(both.pose[both.rows(0)], as_built.pose)
    with pytest.raises(DataError, match=rf"{ROBOTINO}: in both sets of runs; expected every run"):
        both + as_built


def test_a_layout_of_ones_own(root):
    layout = declared_layout(GENERIC_LAYOUT, "layout")
    runs = read_runs(root, GENERIC, layout, surface=None)
    assert len(runs) == 1
    assert runs.voltage is not None


def test_absent_files_are_named(root):
    with pytest.raises(DataError, match=r"no file matches 'one_surface/grey/\*\.csv'.*gray/"):
        read(root, "one_surface/grey/*.csv")
    with pytest.raises(DataError, match="no format 'robotino', did you mean robotino2022"):
        read_runs(root, ROBOTINO, "robotino")


def test_voltage_from_duty_only_where_it_was_not_logged(root):
    columns = dict(GENERIC_LAYOUT["columns"])
    columns["duty"] = {"columns": ["left_a", "right_a"], "unit": "1"}
    columns["bus_voltage"] = {"column": "y", "unit": "V"}

    def voltage(columns):
        layout = declared_layout(GENERIC_LAYOUT | {"columns": columns}, "layout")
        return read_runs(root, GENERIC, layout, surface=None).logs[0].voltage

    np.testing.assert_array_equal(voltage(columns)[0], [6.0, 6.1])
    del columns["voltage"]
    np.testing.assert_array_equal(voltage(columns)[0], [0.5, 0.6])
    del columns["duty"]
    assert voltage(columns) is None
