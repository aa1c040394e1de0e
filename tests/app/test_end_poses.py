"""Runs without a pose sensor are calibrated from a table of end poses, measured by hand."""

import json

import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.data.check.findings import by_reason
from slipid.fitting.calibration.estimate import calibrate
from slipid.search_space import Space
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import write
from tests.benchmarks.every_robot.robots import ROBOTS
from tests.helpers.shared import invoke

UMBMARK = next(robot for robot in ROBOTS if robot.name == "diff_umbmark")
"""Wheels that differ by 2 %, and a track that is 6 % wider than its user says, on squares."""


def ends_of(folder, seed):
    """Take the poses out of the logs; return the names and the measured end of each run."""
    write(UMBMARK, folder, seed)
    rng = np.random.default_rng(seed)
    lines = []
    for path in sorted((folder / "logs" / "floor").iterdir()):
        columns = np.genfromtxt(path, delimiter=",", names=True)
        x, y, turned = columns["x"], columns["y"], np.unwrap(columns["heading"])
        c, s = np.cos(turned[0]), np.sin(turned[0])
        dx, dy = x[-1] - x[0], y[-1] - y[0]
        end = np.array([c * dx + s * dy, c * dy - s * dx, np.degrees(turned[-1] - turned[0])])
        end += rng.normal(size=3) * [0.003, 0.003, 0.5]
        lines.append(["floor/" + path.name, *(f"{v:.4f}" for v in end)])
        rows = np.column_stack([columns[name] for name in ("t", "left", "right")])
        np.savetxt(path, rows, delimiter=",", header="t,left,right", comments="", fmt="%.9g")
    text = (folder / "robot.toml").read_text()
    text = "\n".join(line for line in text.splitlines() if not line.startswith("pose_"))
    named = text.replace('surface = "folder"', 'surface = "folder"\nend_poses = "floor/ends.csv"')
    (folder / "robot.toml").write_text(named)
    return lines


def task_of(folder, lines, head="run,x_m,y_m,heading_deg"):
    text = "\n".join([head, *(",".join(line) for line in lines)])
    (folder / "logs" / "floor" / "ends.csv").write_text(text + "\n")
    with Reporter(quiet=True) as report:
        return read_fit_task(read_config(folder / "robot.toml"), folder / "logs", report)


@pytest.fixture(scope="module")
def squares(tmp_path_factory):
    folder = tmp_path_factory.mktemp("squares")
    return folder, ends_of(folder, 1)


def test_end_points_of_squares_show_unequal_wheels_and_the_track(squares):
    task = task_of(*squares)
    pose = task.dataset.logs[0].pose
    np.testing.assert_array_equal(pose[0], 0.0)
    assert np.isnan(pose[1:-1]).all()
    found = calibrate(task.dataset, Space(task.robot, task.choices), task.choices)
    left, right = found.radius["floor"]
    assert left.value / right.value == pytest.approx(0.03267 / 0.03333, rel=2e-3)
    track = found.base["floor"]
    assert left.value / track.value == pytest.approx(0.03267 / 0.170, rel=5e-3)
    for length, true in ((left, 0.03267), (right, 0.03333), (track, 0.170)):
        assert length.interval90[0] < true < length.interval90[1]
    # Squares that nearly close tell little of the mean radius, which a straight run would tell.
    assert left.verdict == "weak"
    assert found.lag.verdict == "not_identified"
    with pytest.raises(DataError, match="poses in 2 rows only"):
        task.problem()


def test_headings_of_turns_alone_show_the_track(squares):
    """No positions were measured: the config's radius is taken as given."""
    folder, lines = squares
    turns = [[name, "", "", turned] for name, _, _, turned in lines]
    task = task_of(folder, turns)
    found = calibrate(task.dataset, Space(task.robot, task.choices), task.choices)
    low, high = found.base["floor"].interval90
    assert low < 0.170 < high
    assert found.radius["floor"][0].verdict == "not_identified"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: [["floor/0.csv", *c[0][1:]], *c[1:]], "row 2, column 'run': no run 'floor/0.c"),
        (lambda c: [c[0], c[0], *c[2:]], r"row 3, column 'run': 'floor/00.csv' again"),
        (lambda c: [["floor/00.csv", "1,5", "0", "0"], *c[1:]], "row 2: too many cells"),
        (lambda c: [["floor/00.csv", "1 m", "", "0"], *c[1:]], "row 2, column 'x_m': '1 m'; exp"),
        (lambda c: [["floor/00.csv", "1e9", "", "0"], *c[1:]], "row 2, column 'x_m': '1e9'; exp"),
        (lambda c: [["floor/00.csv", "nan", "", "0"], *c[1:]], "row 2, column 'x_m': 'nan'; exp"),
        (lambda c: [["floor/00.csv", "", "", ""], *c[1:]], "row 2: no coordinate is known at both"),
        (lambda c: [[*c[0][:3], "3"], *c[1:]], "row 2, column 'heading_deg': the heading changes"),
    ],
)
def test_what_is_wrong_in_a_table_is_named(squares, change, message):
    folder, lines = squares
    with pytest.raises(DataError, match=rf"ends\.csv {message}"):
        task_of(folder, change(lines))


def test_an_unknown_column_is_named(squares):
    with pytest.raises(DataError, match=r"column 'heading': no such column, did you mean heading_"):
        task_of(*squares, head="run,x_m,y_m,heading")


def test_runs_that_are_not_in_the_table_are_set_aside(squares):
    folder, lines = squares
    task = task_of(folder, lines[1:])
    assert len(task.dataset) == len(lines) - 1
    assert "set aside: floor/00.csv: no row in floor/ends.csv" in task.skipped


def test_runs_that_are_set_aside_for_one_reason_are_one_line():
    lines = [f"set aside: {k:02}.csv: no row in ends.csv; expected one" for k in range(20)]
    few = "00.csv, 01.csv, 02.csv, 03.csv and 16 more"
    assert by_reason(["skipped: a: b", *lines, "set aside: x.csv: a jump", "skipped: a: b"]) == [
        f"set aside: 20 runs ({few}): no row in ends.csv; expected one",
        "set aside: x.csv: a jump",
        *["skipped: a: b"] * 2,
    ]


def test_a_radius_that_is_given_makes_the_track_of_squares_sharp(squares):
    folder, lines = squares
    text = (folder / "robot.toml").read_text()
    try:
        (folder / "robot.toml").write_text(text.replace('"poses"', '"wheels"'))
        task = task_of(folder, lines)
    finally:
        (folder / "robot.toml").write_text(text)
    found = calibrate(task.dataset, Space(task.robot, task.choices), task.choices)
    low, high = found.base["floor"].interval90
    assert low < 0.170 < high
    assert high - low < 0.01  # .14 if the radius is free
    assert found.base["floor"].verdict == "identified"


def test_identify_calibrates_such_runs_and_predicts_their_ends(squares, tmp_path):
    folder, lines = squares
    task_of(folder, lines)
    words = ("--data", folder / "logs", "--out", tmp_path, "--only", "calibration")
    done = invoke("identify", folder / "robot.toml", *words, "--quiet")
    assert done.exit_code == 0, done.stderr
    found = json.loads((tmp_path / "identified.json").read_text())
    assert found["selected_model"] == {"floor": "calibrated"}
    errors = found["trust"]["held_out_error_over_path"]["floor"]
    assert errors["nominal"] > 0.03
    assert errors["calibrated"] < 0.004
    assert "little of the mean wheel radius: drive some metres" in " ".join(done.stdout.split())
    words = ("floor/" + lines[0][0].rpartition("/")[2], "--out", tmp_path / "run.mcap")
    done = invoke("export-run", tmp_path, *words, "--json", tmp_path / "topics.json", "--quiet")
    assert done.exit_code == 0, done.stderr
    found = json.loads((tmp_path / "topics.json").read_text())
    assert found["topics"]["/pose/measured"]["messages"] == 2
    assert found["topics"]["/pose/selected"]["messages"] > 20
    assert "/region90/selected" not in found["topics"]
    assert "aligned with the measured poses" in " ".join(found["notes"])
