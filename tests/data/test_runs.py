"""A set of runs and its summary."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.data.runs import collect


def run(k: int, floor: str | None, load: str = "as_built", seconds: float = 10.0, **more) -> Log:
    time = np.linspace(0.0, seconds, 101)
    return Log(
        name=f"run{k}.csv",
        path=Path(f"run{k}.csv"),
        sha256=str(k),
        time=time,
        wheel_angle=np.outer(time, [1.0, 1.0]),
        current_is_signed=True,
        pose=np.outer(time, [0.1, 0.0, 0.0]),
        surface=floor,
        load=load,
        **more,
    )


def test_runs_print_counts_durations_channels_and_sessions():
    logs = [run(0, "oak", seconds=90.0), run(1, "oak"), run(2, "oak", "moved"), run(3, None)]
    logs[1] = replace(logs[1], gyro=np.zeros(101))
    assert str(collect(logs, ["day 1", "day 2", "day 1", "day 1"], ["run9.csv jumps"])) == (
        "4 runs of 2 drives, 2.0 min (10.0 to 90.0 s each)\n"
        "  oak, as_built: 2 runs, 1.7 min (10.0 to 90.0 s each)\n"
        "  oak, moved: 1 run, 10.0 s\n"
        "  unknown floor, as_built: 1 run, 10.0 s\n"
        "channels: gyro (1 of 4 runs), pose\n"
        "2 sessions:\n"
        "  day 1 (3 runs)\n"
        "  day 2 (1 run)\n"
        "1 run set aside:\n"
        "  run9.csv jumps"
    )


def test_many_runs_print_at_most_30_lines():
    logs = [run(k, f"floor{k}", f"load{k}") for k in range(40)]
    lines = repr(collect(logs, [f"day{k}" for k in range(40)], ["x jumps"] * 40)).splitlines()
    assert len(lines) <= 30
    assert "  and 34 more floors and load set-ups" in lines
    assert "  and 34 more sessions" in lines


def test_readings_of_a_run_without_marks_are_all_new():
    fresh = np.zeros((101, 2), bool)
    fresh[::10] = True
    logs = [run(0, "oak"), run(1, "oak")]
    volts = np.ones((101, 2))
    logs = [replace(logs[0], voltage=volts, voltage_fresh=fresh), replace(logs[1], voltage=volts)]
    np.testing.assert_array_equal(collect(logs).voltage_fresh, np.vstack([fresh, fresh | True]))
    assert collect(logs[1:]).voltage_fresh is None
