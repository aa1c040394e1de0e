"""A config proposed from several files: files of one run, and files that are no logs."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from slipid.app.new.propose import propose
from slipid.support.errors import DataError
from tests.helpers.made_tables import motion, plain, table, wheel_speeds
from tests.helpers.proposals import ROBOT, layout_in, proposed, read


def three_files(root: Path, epoch: float = 1.7e9) -> None:
    """Of a run: joints at 100 Hz in ns, a quaternion at 30 Hz in s, currents at 10 Hz in ms."""
    time = np.arange(0, 10, 0.01)
    angle, _ = motion(time)
    stamps = [f"{round((epoch + t) * 1e9):d}" for t in time]
    table(
        root / "joint_states.csv",
        {
            "stamp": np.array(stamps),
            "left_wheel_joint_position": angle[:, 0],
            "right_wheel_joint_position": angle[:, 1],
        },
    )
    time = np.arange(0.003, 10, 1 / 30)
    _, pose = motion(time)
    half = pose[:, 2] / 2
    table(
        root / "mocap.csv",
        {
            "stamp": np.array([f"{epoch + t:.6f}" for t in time]),
            **{"x": pose[:, 0], "y": pose[:, 1], "qx": 0 * half, "qy": 0 * half},
            **{"qz": np.sin(half), "qw": np.cos(half)},
        },
    )
    time = np.arange(0, 10, 0.1)
    currents = 0.5 * wheel_speeds(time)
    table(
        root / "drivers.csv",
        {
            "time_ms": np.array([f"{(epoch + t) * 1e3:.0f}" for t in time]),
            **{"current_left": currents[:, 0], "current_right": currents[:, 1]},
        },
    )


def test_three_files_of_a_run_at_three_rates(tmp_path):
    for run in ("run1", "run2", "run3"):
        three_files(tmp_path / run)
    _, config = proposed(tmp_path, **ROBOT)
    layout = layout_in(config)
    assert layout["columns"]["time"]["unit"] == "ns"
    assert set(layout["beside"]) == {"mocap.csv", "drivers.csv"}
    assert layout["beside"]["mocap.csv"]["columns"]["time"]["unit"] == "s"
    assert layout["beside"]["drivers.csv"]["columns"]["time"]["unit"] == "ms"
    turned = layout["beside"]["mocap.csv"]["columns"]["pose_quaternion"]
    assert turned["columns"] == ["qx", "qy", "qz", "qw"]
    assert tomllib.loads(config.text)["logs"][0]["glob"] == "run*/joint_states.csv"
    # folders are runs here and no floors, and no voltage was logged: that is all left to say
    assert [q.partition(":")[0] for q in config.questions] == ["surface", '"motor.resistance"']
    data = read(config, tmp_path)
    assert len(data) == 3
    log = data.logs[0]
    angle, pose = motion(log.time)
    assert log.pose_fresh is not None
    assert 25 < log.pose_fresh.sum() / log.duration < 31
    np.testing.assert_allclose(log.pose[log.pose_fresh], pose[log.pose_fresh], atol=1e-4)
    np.testing.assert_allclose(log.wheel_angle, angle - angle[0], atol=1e-3)
    assert log.current is not None


def test_one_file_of_a_run_finds_the_pose_beside_it(tmp_path):
    three_files(tmp_path)
    _, config = proposed(tmp_path / "joint_states.csv", **ROBOT)
    assert "mocap.csv" in layout_in(config)["beside"]
    assert len(read(config, tmp_path)) == 1


def test_a_file_beside_may_be_called_after_the_run(tmp_path):
    for k in (1, 2):
        si = plain(8.0 + k)
        wheels = ("t", "left_vel", "right_vel")
        table(tmp_path / "sand" / f"run{k}.csv", {n: si[n] for n in wheels})
        table(tmp_path / "sand" / f"run{k}_pose.csv", {n: si[n] for n in ("t", "x", "y", "yaw")})
    _, config = proposed(tmp_path, **ROBOT)
    assert set(layout_in(config)["beside"]) == {"{stem}_pose.csv"}
    assert config.questions == ()
    assert {log.surface for log in read(config, tmp_path).logs} == {"sand"}


def test_a_whole_pose_beside_replaces_a_heading_in_the_file_of_the_wheels(tmp_path):
    si = plain()
    folder = tmp_path / "sand"
    table(folder / "run1.csv", {n: si[n] for n in ("t", "left_vel", "right_vel", "yaw")})
    table(folder / "run1_pose.csv", {n: si[n] for n in ("t", "x", "y", "yaw")})
    _, config = proposed(tmp_path, **ROBOT)
    layout = layout_in(config)
    assert not [name for name in layout["columns"] if name.startswith("pose_")]
    (beside,) = layout["beside"].values()
    assert {"pose_x", "pose_y", "pose_heading"} <= {*beside["columns"]}
    assert config.questions == ()


def test_files_at_other_times_are_not_of_the_run(tmp_path):
    si = plain()
    table(tmp_path / "wheels.csv", {n: si[n] for n in ("t", "left_vel", "right_vel")})
    table(tmp_path / "pose.csv", {**{n: si[n] for n in ("x", "y", "yaw")}, "t": si["t"] + 900})
    draft, config = proposed(tmp_path, **ROBOT)
    assert "beside" not in layout_in(config)
    assert any(line.startswith("left out") and "pose.csv" in line for line in draft.sentences)
    assert any("no pose was found" in question for question in config.questions)


def test_parquet(tmp_path):
    import pyarrow
    from pyarrow import parquet

    (tmp_path / "grass").mkdir()
    parquet.write_table(pyarrow.table(plain()), tmp_path / "grass" / "run.parquet")
    _, config = proposed(tmp_path, **ROBOT)
    assert [q for q in config.questions if "datasheet" not in q] == []
    assert "delimiter" not in layout_in(config)
    assert len(read(config, tmp_path)) == 1


def test_what_is_no_log_is_one_clear_error(tmp_path):
    with pytest.raises(DataError, match="no such file or folder"):
        propose(tmp_path / "none.csv", {})
    (tmp_path / "empty.csv").write_bytes(b"")
    with pytest.raises(DataError, match="the file is empty"):
        propose(tmp_path / "empty.csv", {})
    (tmp_path / "words.csv").write_text("a,b\nc,d\n" * 20)
    with pytest.raises(DataError, match="no rows of numbers"):
        propose(tmp_path / "words.csv", {})
    (tmp_path / "binary.csv").write_bytes(b"\0\1\2\3" * 100)
    with pytest.raises(DataError, match="a binary file"):
        propose(tmp_path / "binary.csv", {})
    with pytest.raises(DataError, match="no log in 3 files"):
        propose(tmp_path, {})
    (tmp_path / "sub").mkdir()
    with pytest.raises(DataError, match="no CSV or Parquet file below it"):
        propose(tmp_path / "sub", {})
    rows = "\n".join(f"{k},5;0,1" for k in range(30))
    (tmp_path / "sub" / "comma.csv").write_text(f"t;x\n{rows}\n")
    with pytest.raises(DataError, match="decimal points, not commas"):
        propose(tmp_path / "sub" / "comma.csv", {})
    rows = "\n".join(f"{k},5,0,1" for k in range(30))
    (tmp_path / "sub" / "comma.csv").write_text(f"t,x\n{rows}\n")
    with pytest.raises(DataError, match="row 1: 2 names, but 4 cells in the rows below; expected"):
        propose(tmp_path / "sub" / "comma.csv", {})


def test_a_file_of_which_no_column_is_known_is_a_question_and_still_a_config(tmp_path):
    lines = {name: np.arange(30.0) ** 2 + k for k, name in enumerate(("foo", "bar", "baz"))}
    _, config = proposed(table(tmp_path / "run.csv", lines))
    assert any("which column holds what? There are: foo, bar, baz" in q for q in config.questions)


def test_magnitudes_of_currents_in_a_file_of_their_own_raise_a_question(tmp_path):
    three_files(tmp_path / "run1")
    path = tmp_path / "run1" / "drivers.csv"
    path.write_text(path.read_text().replace("-", ""))
    _, config = proposed(tmp_path, **ROBOT)
    assert any("do currents have a sign" in q for q in config.questions)


def test_a_folder_above_those_of_the_runs_is_proposed_as_the_floor_with_a_question(tmp_path):
    for floor in ("grass", "ice"):
        for run in ("run1", "run2"):
            three_files(tmp_path / floor / run)
    _, config = proposed(tmp_path, **ROBOT)
    floors = [one["surface"] for one in tomllib.loads(config.text)["logs"]]
    assert sorted(floors) == ["grass", "ice"]
    assert sum("on which floor was" in q for q in config.questions) == 2
