"""Logs that tell little, or that contradict the config, are answered by a sentence each."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from slipid.app.calibrate import calibrated, remarks
from slipid.app.check import calibration_part, overview, sanity
from slipid.app.config import read_config
from slipid.app.problem import ConfigFitTask, read_fit_task
from slipid.predict.selection import selected
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import commands, config, driven, table, write_csv
from tests.benchmarks.every_robot.robots import ROBOTS, Floor, MadeRobot
from tests.helpers.shared import invoke

Columns = dict[str, np.ndarray]
ROWS = 600
"""Rows of every run, equal so that all calibrations share what is compiled."""
NAMED = {robot.name: robot for robot in ROBOTS}
SQUARES = replace(NAMED["diff_umbmark"], runs=2)
"""Two wheels on squares, both ways, at one speed."""
MIXED = replace(NAMED["diff_right"], runs=2)
"""Two wheels on lines, arcs and turns on the spot, at several speeds."""
STRAIGHT = replace(NAMED["diff_straight"], runs=2)
"""Two wheels that never turn the robot."""
STEERED = replace(NAMED["bicycle_zero"], runs=2)


@cache
def tables(robot: MadeRobot, floor: Floor) -> list[Columns]:
    rng = np.random.default_rng(0)
    runs = [driven(robot, floor, commands(robot, rng, k, False), rng) for k in range(2)]
    return [{k: v[:ROWS] for k, v in table(robot, run, rng).items()} for run in runs]


def write(
    folder: Path,
    robot: MadeRobot,
    spoil: Callable[[Columns, int], Columns] = lambda columns, run: columns,
    radius: float = 1.0,
    order: tuple[int, ...] = (),
) -> Path:
    """Write logs of a robot, spoilt, and its config with a wrong radius or order of columns."""
    for floor in robot.floors:
        for k, columns in enumerate(tables(replace(robot, runs=2), floor)[: robot.runs]):
            write_csv(folder / "logs" / floor.name / f"{k}.csv", spoil(columns, k))
    text = config(replace(robot, nominal_radius=radius * robot.nominal_radius))
    (listed,) = re.findall(r"columns = \[(.*?)\]", text)
    names = listed.split(", ")
    swapped = ", ".join(names[k] for k in order or range(len(names)))
    (folder / "robot.toml").write_text(text.replace(listed, swapped), encoding="utf-8")
    return folder / "robot.toml"


def task_of(*made, **spoilt) -> ConfigFitTask:
    with TemporaryDirectory() as folder, Reporter(quiet=True) as report:
        file = write(Path(folder), *made, **spoilt)
        return read_fit_task(read_config(file), file.parent / "logs", report)


def alarms(task):
    return [f for f in sanity(task) if f.severity != "note"]


@cache
def judged(robot: MadeRobot, radius: float = 1.0):
    """A calibration of sound runs with its remarks."""
    task = task_of(robot, radius=radius)
    found = calibrated(task, Reporter(quiet=True))
    selection = selected(task.dataset, found.errors, found.contradicted)
    return found.calibration, "\n".join(remarks(found, selection, task))


def still(columns: Columns, run: int, which: tuple[int, ...] = (0, 1)) -> Columns:
    wheels = {k: np.full_like(v, v[0]) for k, v in columns.items() if k in ("left", "right")}
    return columns | (wheels if run in which else {})


def one_heading(columns: Columns, run: int) -> Columns:
    return columns | {"heading": np.full_like(columns["heading"], columns["heading"][0])}


def one_heading_first(columns: Columns, run: int) -> Columns:
    return one_heading(columns, run) if run == 0 else columns


def test_wheels_that_never_turn_are_named_with_their_channel():
    (found,) = alarms(task_of(SQUARES, still))
    assert found.kind == "no_motion"
    assert re.search(
        r"no wheel turns in these runs, although the poses move by up to \d", str(found)
    )
    assert "the channel wheel_ticks names the columns" in str(found)


def test_a_run_whose_wheels_do_not_count_is_named():
    (found,) = alarms(task_of(SQUARES, lambda columns, run: still(columns, run, (1,))))
    assert (found.kind, found.runs) == ("no_motion", ("floor/1.csv",))
    assert "no wheel turns in 1 of 2 runs, although the poses move" in found.found


def test_a_robot_at_rest_is_not_said_to_move():
    def parked(columns: Columns, run: int) -> Columns:
        return {k: np.full_like(v, v[0]) if k != "t" else v for k, v in columns.items()}

    (found,) = alarms(task_of(SQUARES, parked))
    assert found.kind == "no_motion"
    assert "although" not in found.found


@pytest.mark.parametrize("robot", [SQUARES, NAMED["omni3_right"], STEERED], ids=lambda r: r.drive)
def test_a_heading_that_never_changes_is_named_where_wheels_turn_the_robot(robot):
    (found,) = alarms(task_of(replace(robot, runs=2), one_heading))
    assert found.kind == "heading_constant"
    assert "never changes in 2 of 2 runs, although the wheels turn the robot by" in found.found
    assert "pose_heading names the column of the heading" in (found.remedy or "")
    assert found.runs == ()


def test_one_run_with_a_constant_heading_is_named():
    found = alarms(task_of(SQUARES, one_heading_first))
    assert [f.kind for f in found] == ["heading_constant"]


def test_a_constant_heading_of_a_robot_that_never_turns_is_right():
    assert alarms(task_of(STRAIGHT, one_heading)) == []


@pytest.mark.parametrize("radius", [1 / 1.5, 1.0, 1.5])
@pytest.mark.parametrize("robot", [SQUARES, MIXED], ids=lambda r: r.name)
def test_exchanged_wheels_are_named_whatever_the_radius(robot, radius):
    first, *_ = alarms(task_of(robot, radius=radius, order=(1, 0)))
    assert first.kind == "wheel_order"
    assert first.found.startswith("left and right seem to be exchanged in the wheels' columns")
    assert "[left, right] becomes [right, left]" in (first.remedy or "")


@pytest.mark.parametrize("radius", [1 / 1.5, 1.5])
@pytest.mark.parametrize(
    ("name", "order", "says"),
    [("omni3_right", (1, 2, 0), "3, 1, 2"), ("mecanum_wrong_base", (0, 1, 3, 2), "1, 2, 4, 3")],
)
def test_permuted_wheels_are_named_whatever_the_radius(name, order, says, radius):
    first, *rest = alarms(task_of(replace(NAMED[name], runs=2), radius=radius, order=order))
    assert first.kind == "wheel_order"
    assert [f.kind for f in rest] == ([] if radius > 1 else ["wheel_scale"])
    assert all("correct wheel_radius_m in [robot]" in (f.remedy or "") for f in rest)
    assert f"list the columns in the order {says} " in (first.remedy or "")


def dead(columns: Columns, run: int, which: tuple[int, ...] = (0, 1)) -> Columns:
    name = next(n for n in columns if n in ("right", "wheel2"))
    stopped = {name: np.full_like(columns[name], columns[name][0])}
    return columns | (stopped if run in which else {})


@pytest.mark.parametrize("name", ["diff_umbmark", "omni3_right", "ackermann_car"])
def test_an_encoder_that_never_counts_is_named_with_its_column(name):
    robot = replace(NAMED[name], runs=2)
    (found,) = alarms(task_of(robot, dead))
    assert (found.kind, found.severity, found.runs) == ("wheel_constant", "wrong", ())
    column = "wheel2" if robot.drive == "omni" else "right"
    assert found.found.startswith(f"wheel 2 (column '{column}') never turns in 2 of 2 runs, while")
    (one,) = alarms(task_of(robot, lambda columns, run: dead(columns, run, (1,))))
    assert (one.kind, one.severity, len(one.runs)) == ("wheel_constant", "wrong", 1)
    assert "never turns in 1 of 2 runs" in one.found


def test_without_headings_an_encoder_is_dead_where_the_robot_leaves_a_circle():
    far, near = replace(SQUARES, pose_kind="xy"), replace(SQUARES, pose_kind="xy", nominal_base=9.0)
    (found,) = alarms(task_of(far, lambda columns, run: dead(columns, run, (1,))))
    assert (found.kind, found.runs) == ("wheel_constant", ("floor/1.csv",))
    assert alarms(task_of(near, lambda columns, run: dead(columns, run, (1,)))) == []
    (found,) = alarms(task_of(near, dead))
    assert found.found.startswith("wheel 2 (column 'right') turns in no run, while other wheels")
    assert found.severity == "wrong"


def turning_about(columns: Columns, run: int) -> Columns:
    """Columns of a robot that turns about its right wheel, with a marker beside the left one."""
    angle = np.linspace(0.0, 5.0, len(columns["t"]))
    side = -1.2 * SQUARES.nominal_base
    x, y = side * np.array([np.sin(angle), 1 - np.cos(angle)])
    ticks = np.round(angle * SQUARES.nominal_base / SQUARES.nominal_radius / math.tau * 4096)
    noise = np.random.default_rng(run).normal(size=(3, len(angle))) * 0.001
    pose = {"x": x + noise[0], "y": y + noise[1], "heading": angle + noise[2]}
    return columns | pose | {"left": -ticks, "right": 0 * ticks}


def on_the_spot(columns: Columns, run: int) -> Columns:
    """Columns of a robot that turns on the spot, without noise, on unequal wheels."""
    angle = np.linspace(0.0, 9.0, len(columns["t"]))
    rim = 0.5 * angle * SQUARES.nominal_base / SQUARES.nominal_radius / math.tau * 4096
    pose = {"x": 0 * angle, "y": 0 * angle, "heading": angle}
    return columns | pose | {"left": np.round(-0.95 * rim), "right": np.round(1.05 * rim)}


@pytest.mark.parametrize("how", [turning_about, on_the_spot])
def test_wheels_and_positions_that_rightly_stand_still_are_not_named(how):
    found = alarms(task_of(SQUARES, lambda columns, run: how(columns, run) if run else columns))
    assert found == []


def test_frozen_positions_are_named_although_the_heading_goes_on():
    def frozen(columns: Columns, run: int) -> Columns:
        return columns | ({a: 0 * columns[a] + 0.5 for a in "xy"} if run == 1 else {})

    for robot in (SQUARES, STEERED):
        (found,) = alarms(task_of(robot, frozen))
        assert (found.kind, found.severity) == ("position_constant", "wrong")
        assert len(found.runs) == 1
        assert "x and y of the poses never change in 1 of 2 runs" in found.found


def test_wheels_exchanged_in_one_run_are_named():
    def swapped(columns: Columns, run: int) -> Columns:
        return columns | ({"left": columns["right"], "right": columns["left"]} if run else {})

    (found,) = alarms(task_of(MIXED, swapped))
    assert (found.kind, found.severity, found.runs) == (
        "wheels_exchanged",
        "wrong",
        ("floor/1.csv",),
    )
    assert (
        "the poses of 1 of 2 runs follow their wheels only with two columns exchanged"
        in found.found
    )
    assert "with wheels 1 and 2 exchanged" in found.found
    assert alarms(task_of(STRAIGHT, swapped)) == []


def test_without_a_turn_the_order_of_two_wheels_is_not_judged():
    assert alarms(task_of(STRAIGHT, order=(1, 0))) == []


def test_a_wrong_radius_alone_is_calibrated():
    calibration, remarked = judged(MIXED, 1.5)
    assert calibration.radius["floor"][0].value == pytest.approx(0.05, rel=5e-3)
    assert calibration.radius["floor"][0].verdict == "identified"
    assert "the wheel radius in the config is 75 mm; on floor it is 49.98 mm" in remarked


def test_lengths_far_from_the_config_do_not_count_as_identified():
    calibration, remarked = judged(MIXED, 4.0)
    assert {v.verdict for v in calibration.radius["floor"]} == {"not_identified"}
    assert re.search(
        "the wheel radius comes out 0.2[0-9]* times as large as in the config", remarked
    )
    assert "the wheel radius in the config is" not in remarked


@pytest.mark.slow
def test_one_run_is_said_to_be_one():
    assert "on floor one run alone" in judged(replace(SQUARES, runs=1))[1]
    assert "one run alone" not in judged(MIXED)[1]


def test_without_turns_the_track_is_not_identified():
    calibration, remarked = judged(STRAIGHT)
    assert calibration.base["floor"].verdict == "not_identified"
    assert calibration.base["floor"].value == pytest.approx(STRAIGHT.nominal_base)
    assert "no run turns: the effective track and the place of the pose sensor" in remarked
    assert "no run turns" not in judged(MIXED)[1]


def test_one_speed_is_said_with_what_it_does_not_tell():
    remarked = judged(SQUARES)[1]
    assert "one speed alone on floor (0.2 m/s): the runs do not show whether slip grows" in remarked
    assert "nearly one number" not in remarked
    assert "one speed" not in judged(MIXED)[1]


def test_one_speed_without_headings_mixes_lag_and_place():
    remarked = judged(replace(SQUARES, pose_kind="xy"))[1]
    assert (
        "the lag of the poses and the place of their sensor ahead are nearly one number" in remarked
    )


def test_check_does_not_calibrate_exchanged_wheels():
    task = task_of(SQUARES, radius=1.5, order=(1, 0))
    same, part = calibration_part(task, overview(task)["findings"], Reporter(quiet=True))
    assert same is task
    assert part == {"suspects": ["no calibration before the findings marked wrong are corrected"]}


def test_identify_refuses_wheels_that_never_turn(tmp_path):
    file = write(tmp_path, SQUARES, still)
    words = ("--data", tmp_path / "logs", "--out", tmp_path / "out", "--only", "calibration")
    result = invoke("identify", file, *words)
    assert result.exit_code == 2
    assert "no wheel turns in these runs" in result.stderr


@pytest.mark.slow
def test_wheels_that_slip_far_on_one_of_two_floors_are_identified_there():
    hard, soft = (replace(MIXED.floors[0], name=name) for name in ("hard", "soft"))
    soft = replace(soft, radius=tuple(0.25 * r for r in soft.radius))
    calibration, remarked = judged(replace(MIXED, floors=(hard, soft)))
    assert calibration.firmest == "hard"
    assert {v.verdict for row in calibration.radius.values() for v in row} == {"identified"}
    assert calibration.radius["soft"][0].value == pytest.approx(0.25 * 0.05, rel=0.02)
    assert "is not to be trusted" not in remarked


def test_a_calibration_that_still_changes_when_it_ends_is_reported(monkeypatch):
    assert judged(SQUARES)[0].settled
    assert "had not settled" not in judged(SQUARES)[1]
    monkeypatch.setattr("slipid.fitting.calibration.estimate.MOST_ROUNDS", 1)
    found, remarked = judged.__wrapped__(SQUARES)
    assert not found.settled
    assert "the calibration had not settled when it ended" in remarked
