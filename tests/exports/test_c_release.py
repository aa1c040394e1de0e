"""Generated C of every drive whose motors are cut, or that is held by hand, drives on gently."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from slipid.exports.c99.code import Code
from slipid.model.robot import build
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import Controller
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.gains import Gains
from slipid.robot.trajectory import rectangle
from slipid.search_space import Choice, Space
from tests.helpers.compiled_c import NEEDS_COMPILER, CompiledC
from tests.helpers.kinds import FLOORS, SHAPES, numbers
from tests.helpers.known_robot import deploy_known
from tests.helpers.motors_cut import ASKED, CUT, HELD, STALLED, Driven, faults, patterns

pytestmark = [NEEDS_COMPILER, pytest.mark.slow]

RELEASED = """
void slipid_released(int32_t steps, int32_t with_reference, const int32_t *happens,
                     const double *kinematics, const double *asked, double *said);

void slipid_released(int32_t steps, int32_t with_reference, const int32_t *happens,
                     const double *kinematics, const double *asked, double *said) {
  const double dt = 0.05;
  static slipid_state state;
  slipid_reading in;
  slipid_estimate out = {.pose = {0}};
  double angle[SLIPID_DRIVES] = {0}, command[SLIPID_DRIVES] = {0};
  const double start[3] = {0, 0, 0};
  int32_t free = 0;
  slipid_init(&state, start);
  for (int32_t i = 0; i < steps; ++i) {
    double twist[3] = {0, 0, 0};
    const int stands = happens[i] == 1 || happens[i] == 3;
    free = happens[i] ? 0 : free + 1;
    slipid_nothing(&in);
    for (int k = 0; k < SLIPID_DRIVES; ++k) {
      const double speed = stands ? 0 : command[k];
      angle[k] += dt * speed;
      in.wheel_angle[k] = angle[k];
      in.current[k] = happens[i] == 1 ? 0 : 0.5;
      for (int a = 0; a < 3; ++a) {
        twist[a] += happens[i] ? 0 : kinematics[SLIPID_DRIVES * a + k] * speed;
      }
    }
    in.gyro = twist[2];
    if (state.controller.gave_up && free > 20) {
      slipid_rearm(&state.controller);
    }
    if (with_reference) {
      const double c = cos(out.pose[2]), s = sin(out.pose[2]);
      const double reference[6] = {out.pose[0],
                                   out.pose[1],
                                   out.pose[2],
                                   c * asked[0] - s * asked[1],
                                   s * asked[0] + c * asked[1],
                                   asked[2]};
      slipid_step(&state, &in, reference, dt, &out, command);
    } else {
      slipid_drive(&state, &in, asked, dt, &out, command);
    }
    double *row = said + i * (8 + SLIPID_DRIVES);
    for (int a = 0; a < 3; ++a) {
      row[a] = twist[a];
      row[3 + a] = out.twist[a];
    }
    row[6] = state.controller.drives_off;
    row[7] = state.controller.gave_up;
    for (int k = 0; k < SLIPID_DRIVES; ++k) {
      row[8 + k] = command[k];
    }
  }
}
"""
"""A loop on a body that moves by given kinematics while nobody holds it; outputs of every step."""


def robot_of(kind: str) -> DeployedRobot:
    shape = SHAPES[kind]
    robot = build(shape, list(FLOORS), ("as_built",), ("today",))
    choices = [Choice(path, fixed=value) for path, value in numbers(robot).items()]
    return deploy_known(Space(robot, choices).template)


@pytest.fixture(scope="module", params=list(SHAPES))
def compiled(request, tmp_path_factory) -> CompiledC:
    robot = robot_of(request.param)
    loop = ControlLoop(Estimator(robot), Controller(robot, Gains(), recovery=True))
    folder = tmp_path_factory.mktemp("c")
    return CompiledC(Code(robot, loop, rectangle()), folder, more=RELEASED)


def driven(compiled: CompiledC, pattern: np.ndarray, with_reference: bool) -> Driven:
    """Outputs over a pattern, on a body that slips as on the first floor."""
    robot = compiled.code.robot
    kinematics = np.ascontiguousarray(np.linalg.pinv(np.asarray(robot.inverse_kinematics[0])))
    happens, steps = np.asarray(pattern, np.int32), len(pattern)
    said = np.zeros((steps, 8 + robot.drives))
    arrays = [a.ctypes.data_as(ctypes.c_void_p) for a in (happens, kinematics, ASKED, said)]
    count, mode = ctypes.c_int32(steps), ctypes.c_int32(with_reference)
    compiled.library.slipid_released(count, mode, *arrays)
    off, gave_up = said[:, 6] > 0, said[:, 7] > 0
    return Driven(said[:, :3], said[:, 3:6], said[:, 8:], off, gave_up)


@pytest.mark.parametrize("with_reference", [True, False], ids=["path", "velocity"])
def test_a_robot_that_was_cut_or_held_drives_on_gently(compiled, with_reference):
    robot = compiled.code.robot
    radius = float(robot.frame.radius)
    limit = float(compiled.code.loop.controller.limits.acceleration)
    for pattern in patterns((CUT, HELD, STALLED)):
        run = driven(compiled, pattern, with_reference)
        assert faults(run, pattern, radius, limit) == []
