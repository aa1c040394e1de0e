"""Gains in written forms: a C header that computes as Python does, ROS 2 parameters, and JSON."""

from __future__ import annotations

import ctypes
import json
import subprocess

import numpy as np
import pytest

from slipid.exports.feedforward import HEADER, PARAMETERS, c_header, gains_json, write_gains
from slipid.exports.ros.folder import ros2_files
from slipid.model.feedforward import Feedforward, Gain
from slipid.robot.feedback import FeedbackGains
from slipid.robot.feedforward import robot_feedforwards
from tests.helpers.compiled_c import NEEDS_COMPILER
from tests.helpers.known_gains import fitted_motors
from tests.helpers.ros_yaml import parameters

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")
UNITS = ("V", "V*s/rad", "V*s^2/rad")


def motor(name, values=(0.41, 0.0537, 0.01 / 3), verdict="identified", lift=None):
    kS, kV, kA = (Gain.of(v, 0.1 * v, u, verdict) for v, u in zip(values, UNITS, strict=True))
    kG = None if lift is None else Gain.of(lift, 0.1, "V", "weak")
    return Feedforward(name, kS, kV, kA, kG)


MOTORS = (motor("left | */ 1"), motor("lift", lift=-0.7), motor("class", verdict="not_identified"))
"""Motors with odd names, and one that lifts."""
NAMES = ("left_1", "lift", "motor_class")


def compiled(header, names, folder):
    """The functions of a header, from a library in strict C99."""
    (folder / HEADER).write_text(header)
    lines = [f'#include "{HEADER}"']
    for name in names:
        own = f"double {name}(double w, double a)"
        lines += [f"{own};", f"{own} {{ return feedforward_{name}_volts(w, a); }}"]
    (folder / "of.c").write_text("\n".join(lines) + "\n")
    words = ["cc", *STRICT, "-shared", "-fPIC", "-o", "of.so", "of.c"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(folder / "of.so"))
    for name in names:
        function = getattr(library, name)
        function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double] * 2
    return library


@NEEDS_COMPILER
def test_the_header_computes_as_python_does(tmp_path):
    library = compiled(c_header(MOTORS), NAMES, tmp_path)
    rng = np.random.default_rng(0)
    points = [(0.0, 0.0), (0.0, 3.0), (0.0, -3.0), (1e-12, -5.0)]
    points += [tuple(x) for x in rng.normal(size=(100, 2)) * (100, 1000)]
    for one, name in zip(MOTORS, NAMES, strict=True):
        for speed, acceleration in points:
            expected = one.voltage(speed, acceleration)
            found = getattr(library, name)(speed, acceleration)
            assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_the_header_warns_of_gains_that_are_assumptions():
    lines = c_header(MOTORS).splitlines()
    (line,) = (x for x in lines if x.startswith("#define FEEDFORWARD_MOTOR_CLASS_KV"))
    assert "NOT IDENTIFIED" in line
    (line,) = (x for x in lines if x.startswith("#define FEEDFORWARD_LEFT_1_KV"))
    assert "identified, 90 % interval 0.04556 to 0.0633" in line


def test_parameters_are_read_back_to_the_last_bit(tmp_path):
    assert write_gains(tmp_path, MOTORS) == (HEADER, PARAMETERS)
    text = {PARAMETERS: (tmp_path / PARAMETERS).read_text()}
    found = parameters(text, PARAMETERS, "slipid")
    back = FeedbackGains.of(MOTORS[0])
    for name, gain in MOTORS[0].gains.items():
        assert found[f"feedforward.left_1.{name}"] == gain.value
    assert found["feedback.left_1.position_kD"] == back.position_kD
    assert found["feedforward.lift.kG"] == -0.7
    assert "feedforward.left_1.kG" not in found


def test_without_gains_nothing_is_written(tmp_path):
    assert write_gains(tmp_path, ()) == ()
    assert not list(tmp_path.iterdir())
    assert gains_json(()) == {"feedforward": {}, "feedback": {}}


def test_results_have_every_gain_with_its_interval_and_unit():
    content = json.loads(json.dumps(gains_json(MOTORS)))
    one = content["feedforward"]["lift"]
    assert one["kV"] == {
        "value": 0.0537,
        "unit": "V*s/rad",
        "std": pytest.approx(0.00537),
        "interval90": list(MOTORS[1].kV.interval90),
        "verdict": "identified",
    }
    assert one["per_rotation"]["kA"]["unit"] == "V*s^2/rot"
    assert "per_metre" not in one
    back = content["feedback"]["lift"]
    assert back["velocity_kP"]["unit"] == "V*s/rad"
    assert back["demand"]["period_s"] == 0.02


def test_a_robot_has_its_gains_among_the_parameters_of_its_node():
    robot = fitted_motors()
    found = parameters(ros2_files(robot), "slipid.yaml", "slipid")
    for one in robot_feedforwards(robot):
        assert found[f"feedforward.{one.name}.kA"] == one.kA.value
        assert found[f"feedback.{one.name}.velocity_kP"] == FeedbackGains.of(one).velocity_kP
