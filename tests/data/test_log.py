"""The Log: its derived numbers, its shapes, the form of the errors about it."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from slipid.data.log import Log
from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import read_logs
from slipid.support.errors import DataError, bad_data
from tests.helpers.broken_logs import GENERIC, GENERIC_LAYOUT, ROBOTINO, ROWS, write_good
from tests.helpers.one_log import read_log


@pytest.fixture
def root(tmp_path):
    write_good(tmp_path)
    return tmp_path


@pytest.fixture
def log(root):
    layout = declared_layout({"format": "robotino2022"}, "layout")
    return read_log(root / ROBOTINO, layout, root=root, surface="gray", load="moved")


def test_a_run_in_si_units(log: Log):
    assert (log.name, log.surface, log.load) == (ROBOTINO, "gray", "moved")
    assert (log.samples, log.wheels) == (ROWS, 3)
    assert log.duration == pytest.approx(0.031 * (ROWS - 1), rel=1e-6)
    # 0.1 m/s along 20 deg: rim speed of the wheel at 60 deg is 0.1 sin(20 - 60) m/s, r = 0.04 m
    wheel = 0.1 * np.sin(np.radians(20.0 - 60.0)) / 0.04
    assert log.wheel_speed_command[-1, 0] == pytest.approx(wheel, rel=1e-5)
    assert log.wheel_speed[-1, 0] == pytest.approx(wheel, rel=1e-5)
    driven = log.time[-1] - 0.1
    assert log.wheel_angle[-1, 0] == pytest.approx(wheel * driven, rel=1e-3)
    np.testing.assert_allclose(log.twist_command[0, :2], 0.1 * np.array([0.93969, 0.34202]), 1e-4)
    # the camera sees x to the right and y down; X = -x, and the heading counts from there
    moved = log.pose[-1] - log.pose[0]
    np.testing.assert_allclose(moved, [0.93969 * 0.1 * driven, 0.34202 * 0.1 * driven, 0.0], 2e-3)
    assert log.pose[0, 2] == pytest.approx(0.0, abs=1e-12)
    assert not log.current_is_signed


def test_repeated_camera_frames_are_marked(log: Log):
    standing = log.time < 0.1
    assert log.pose_fresh[0]
    assert not log.pose_fresh[standing][1:].any()
    assert log.pose_fresh[~standing][1:].all()


def test_a_log_is_frozen_and_prints_on_one_line(log: Log):
    with pytest.raises(dataclasses.FrozenInstanceError):
        log.load = "other"  # type: ignore[misc]
    assert "\n" not in repr(log)
    assert "200 rows" in repr(log)
    assert "current" in repr(log)
    assert "voltage" not in repr(log)


@pytest.mark.skipif(os.environ.get("SLIPID_CHECK_TYPES") == "0", reason="types are not checked")
def test_shapes_are_checked(log: Log):
    with pytest.raises(Exception, match="wheel_angle"):
        dataclasses.replace(log, wheel_angle=log.wheel_angle[1:])


def test_the_hash_tells_files_apart(root):
    layout = declared_layout(GENERIC_LAYOUT, "layout")
    first = read_log(root / GENERIC, layout, root=root)
    (root / GENERIC).write_text((root / GENERIC).read_text().replace("6.1", "6.2"))
    second = read_log(root / GENERIC, layout, root=root)
    assert first.sha256 != second.sha256
    assert read_log(root / GENERIC, layout).name == "run.csv"


def test_several_runs_in_one_file(root):
    lines = (root / GENERIC).read_text().splitlines()
    (root / GENERIC).write_text("\n".join([*lines, *lines[1:51]]) + "\n")
    layout = declared_layout({**GENERIC_LAYOUT, "new_run": "time_restarts"}, "layout")
    logs = read_logs(root / GENERIC, layout, root, "oak", "as_built").logs
    assert [(log.name, log.samples) for log in logs] == [
        ("generic/run.csv#1", 200),
        ("generic/run.csv#2", 50),
    ]
    assert {log.surface for log in logs} == {"oak"}
    broken = lines[1:51]
    broken[10] = broken[10].replace(",6,", ",nan,")
    (root / GENERIC).write_text("\n".join([*lines, *broken, broken[-1]]) + "\n")
    # the row named is that of the file, not of the run inside it
    with pytest.raises(DataError, match=r"row 252, column 'time'"):
        read_log(root / GENERIC, dataclasses.replace(layout, new_run="ticks_restart"), root=root)


def test_errors_have_one_form():
    assert str(bad_data(Path("a.csv"), "x", "y")) == "a.csv: x; expected y"
    assert str(bad_data("a.csv", "x", "y", row=3)) == "a.csv row 3: x; expected y"
    assert str(bad_data("a.csv", "x", "y", row=(3, 5), column="t")) == (
        "a.csv rows 3-5, column 't': x; expected y"
    )
    assert isinstance(bad_data("a.csv", "x", "y"), ValueError)
