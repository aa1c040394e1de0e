"""A robot is taken along: the folder is whole, its C program drives as the library does."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import asdict, replace
from pathlib import Path

import jax
import numpy as np
import pytest

from slipid.deploy.controllers import control_loop_of
from slipid.deploy.deploy import read_robot
from slipid.deploy.export import FORMS, ExportOptions, export
from slipid.deploy.twin_run import REST_S, starts, twin_floor
from slipid.exports.c99.folder import c_files
from slipid.exports.folder import check_folder
from slipid.lab.testsite.site import Site
from slipid.lab.trial.controllers import ROWS
from slipid.lab.trial.trial import SitePlant
from slipid.robot import closed_loop
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import PERIOD, Measurement
from slipid.robot.trajectory import rectangle
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.helpers import small_twin
from tests.helpers.compiled_c import NEEDS_COMPILER
from tests.helpers.kinds import SHAPES, deployed
from tests.helpers.known_gains import fitted_motors
from tests.helpers.shared import invoke

ROBOT = small_twin.deployed(1.0, 1.0, 0.3)
QUIET = Reporter(quiet=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Everything, for a controller that traces fast."""
    out = tmp_path_factory.mktemp("export") / "robot"
    export(ROBOT, out, ExportOptions(controller="slip_odometry"), QUIET)
    return out


@pytest.mark.slow
def test_all_forms_come_from_one_robot(folder):
    names = check_folder(folder)
    assert {name.split("/")[0] for name in names} == {"README.md", "robot.json", *FORMS}
    again = DeployedRobot.load(folder / "robot.json")
    assert again.record.numbers == ROBOT.record.numbers
    in_c = ("c/src/slipid.h", "c/src/slipid.c", "c/README.md")
    for name in (*in_c, "README.md", "ros2/slipid.yaml", "ros2/README.md", "table/gains.md"):
        assert ROBOT.record.numbers in (folder / name).read_text(), name


@pytest.mark.slow
@NEEDS_COMPILER
def test_its_example_drives_as_the_library_did(folder, tmp_path):
    """With a C compiler and the folder, and nothing else."""
    here = tmp_path / "c"
    shutil.copytree(folder / "c", here)
    result = subprocess.run(
        "mkdir build && cc -O2 -Isrc -o build/drive examples/drive/drive.c src/slipid.c -lm &&"
        " build/drive < examples/drive/readings.txt | cmp - examples/drive/commands.txt",
        shell=True,
        cwd=here,
        env={"PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    lines = (here / "examples/drive/commands.txt").read_text().splitlines()
    assert len(lines) > 300
    assert float(lines[-1].split()[-1]) == pytest.approx(rectangle().duration + REST_S, abs=0.05)


@pytest.mark.slow
@NEEDS_COMPILER
@pytest.mark.parametrize(
    "kind",
    [k if k == "differential" else pytest.param(k, marks=pytest.mark.nightly) for k in SHAPES],
)
def test_every_drive_is_tried_and_exported_from_the_command_line(kind, tmp_path):
    """A trial on the twin, all forms of an export, and its self-test in C."""
    deployed(kind).save(tmp_path / "robot.json")
    words = ("--plant", "twin", "--path", "circle", "--starts", 1, "--jobs", 1, "--quiet")
    done = invoke("trial", tmp_path, "--controllers", "contact", *words)
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "trial.json").read_text())
    assert found["summary"]["contact"]["finished_share"] == 1
    words = ("export", tmp_path, "--path", "circle", "--out", tmp_path / "to_go", "--quiet")
    done = invoke(*words)
    assert done.exit_code == 0, done.output
    assert invoke("export", tmp_path / "to_go", "--check").exit_code == 0
    result = subprocess.run(
        "cc -O2 -Isrc -o check test/check.c src/slipid.c -lm && ./check",
        shell=True,
        cwd=tmp_path / "to_go/c",
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    forms = {path.name for path in (tmp_path / "to_go").iterdir() if path.is_dir()}
    assert forms == set(FORMS)


@pytest.mark.slow
@NEEDS_COMPILER
def test_a_robot_with_fitted_motors_brings_their_gains(folder, tmp_path):
    robot, out = fitted_motors("omni 4"), tmp_path / "robot"
    options = ExportOptions(("c", "ros2"), controller="slip_odometry")
    export(robot, out, options, QUIET)
    assert "c/src/motor_feedforward.h" in check_folder(out)
    assert "motor_feedforward.h" in (out / "c/README.md").read_text()
    assert "feedforward:" in (out / "ros2/slipid.yaml").read_text()
    flags = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-fsyntax-only")
    words = ["cc", *flags, "-x", "c", out / "c/src/motor_feedforward.h"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    # the other robot was not fitted
    assert not (folder / "c/src/motor_feedforward.h").exists()
    assert "motor_feedforward.h" not in (folder / "c/README.md").read_text()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_cmake_builds_and_tests_it(folder, tmp_path):
    for words in (
        ["cmake", "-S", folder / "c", "-B", tmp_path],
        ["cmake", "--build", tmp_path],
        ["ctest", "--test-dir", tmp_path],
    ):
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


class Program:
    """The example's program as a robot's computer: lines in, lines out."""

    def __init__(self, program: Path):
        self._process = subprocess.Popen(
            [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._say("0 0 0")

    def __call__(self, reading: Measurement) -> tuple[np.ndarray, float]:
        leaves = [np.asarray(x).reshape(-1) for x in jax.tree.leaves(reading.filled(3))]
        self._say(" ".join(repr(float(x)) for x in np.concatenate([[PERIOD], *leaves])))
        assert self._process.stdout is not None
        numbers = [float(word) for word in self._process.stdout.readline().split()]
        return np.array(numbers[:3]), numbers[3]

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()


@pytest.mark.nightly  # the loop of a twin in C is compared in the suite
@NEEDS_COMPILER
def test_the_program_drives_the_test_site_to_the_last_printed_digit(tmp_path):
    """One process is the robot, in C; the other is the world, in MuJoCo."""
    pytest.importorskip("mujoco")
    control_loop = control_loop_of(ROBOT, ROWS["contact"])
    path = rectangle(0.4, 0.2).after_rest(REST_S)
    for name, text in c_files(ROBOT, control_loop, path).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    sources = ("examples/drive/drive.c", "src/slipid.c", "-lm")
    command = ["cc", "-O2", "-DDIGITS=15", "-Isrc", "-o", "drive", *sources]
    subprocess.run(command, cwd=tmp_path, check=True)
    floor = twin_floor(ROBOT)
    plant = SitePlant(Site(), floor, "as_built", starts(20, floor, rectangle())[3], 5)
    wanted = closed_loop.run_closed_loop(control_loop, path, plant, (0.0, 0.0, 0.0))
    program, reading, rows = Program(tmp_path / "drive"), plant.reset(), []
    for _ in wanted.time:
        pose = plant.pose
        sent, time = program(reading)
        rows.append((*pose, *sent, time))
        reading = plant.step(sent)
    program.close()
    found = np.array(rows)
    found[:, 2] = np.unwrap(found[:, 2])
    np.testing.assert_allclose(found[:, 3:6], wanted.command, atol=1e-6)
    same = replace(wanted, pose=found[:, :3], path_time=found[:, 6], command=found[:, 3:6])
    assert printed(same) == printed(wanted)


def printed(course: closed_loop.ClosedLoopRun) -> list[str]:
    """Metrics of a run as a trial prints them, and two digits more."""
    numbers = asdict(closed_loop.path_metrics(course))
    known = {name: value for name, value in numbers.items() if value is not None}
    return [f"{name} {np.round(np.asarray(value, float), 2)}" for name, value in known.items()]


def test_a_robot_is_found_in_a_folder_or_a_file_with_some_of_its_floors(tmp_path):
    ROBOT.save(tmp_path / "robot.json")
    assert read_robot(tmp_path).labels == ("firm", "soft")
    assert read_robot(tmp_path / "robot.json", None, ("soft",)).labels == ("soft",)
    with pytest.raises(DataError, match="no floor 'ice'; identified: firm, soft"):
        read_robot(tmp_path, None, ("ice",))
    with pytest.raises(DataError, match="no load set-up 'moved'"):
        read_robot(tmp_path, "moved", ())
    content = json.loads((tmp_path / "robot.json").read_text())
    content["schema"] = "slipid.robot/99"
    (tmp_path / "robot.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match="written by a newer slipid"):
        read_robot(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ExportOptions(("c", "ros")), "no form 'ros', did you mean ros2"),
        (ExportOptions(()), "no form"),
        (ExportOptions(controller="contacts"), "no controller 'contacts', did you mean contact"),
        (ExportOptions(controller="contact_map"), "needs a map of the floors"),
        (ExportOptions(map=Path("site.toml")), "does not use a map; omit --map"),
        (ExportOptions(path="square"), "no path 'square'"),
        (ExportOptions(speed=9.0), "speed 9 m/s"),
    ],
)
def test_invalid_options_are_refused_before_anything_is_written(tmp_path, options, message):
    with pytest.raises(DataError, match=message):
        export(ROBOT, tmp_path / "out", options, QUIET)
    assert not (tmp_path / "out").exists()


def test_a_folder_with_other_files_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    (tmp_path / "mine.txt").write_text("kept")
    made = "slipid.deploy.export.control_loop_of"
    monkeypatch.setattr(made, lambda *_, **__: pytest.fail("made"))
    with pytest.raises(DataError, match="files that an export did not write"):
        export(ROBOT, tmp_path, ExportOptions(), QUIET)


@pytest.mark.slow
def test_recovery_is_an_option_of_an_export(folder, tmp_path):
    """It is off by default for a robot without a gyro."""
    assert "recovery is off in this export" in (folder / "c/README.md").read_text()
    options = ExportOptions(("c",), "slip_odometry", recovery=True)
    export(ROBOT, tmp_path / "on", options, QUIET)
    assert "recovery is off" not in (tmp_path / "on/c/README.md").read_text()
