"""Generated C of every drive whose motors are cut, or that is held by hand, drives on gently."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from slipid.exports.c99.code import Code
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import Controller
from slipid.robot.estimator import Estimator
from slipid.robot.gains import Gains
from slipid.robot.trajectory import rectangle
from tests.helpers.compiled_c import NEEDS_COMPILER, CompiledC
from tests.helpers.kinds import SHAPES, deployed
from tests.helpers.motors_cut import ASKED, CUT, HELD, MOST, STALLED, Driven, faults, patterns

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
ATTACKED = """
void slipid_attacked(int32_t rounds, uint64_t seed, const double *most, const double *kinematics,
                     const double *asked, int32_t *faults, double *share);

static double slipid_draw(uint64_t *seed) {
  *seed ^= *seed << 13;
  *seed ^= *seed >> 7;
  *seed ^= *seed << 17;
  return (double)(*seed >> 11) / 9007199254740992.0;
}

void slipid_attacked(int32_t rounds, uint64_t seed, const double *most, const double *kinematics,
                     const double *asked, int32_t *faults, double *share) {
  static const double bad[] = {NAN,    INFINITY, -INFINITY, 1e300, -1e300, 1e-310,
                               0.0,    -1.0,     1e9,       3e7,   50.0};
  static const double rates[] = {0, 0.05, 0.5, 1};
  static slipid_state state;
  slipid_reading in;
  slipid_estimate out = {.pose = {0}};
  double angle[SLIPID_DRIVES] = {0}, command[SLIPID_DRIVES] = {0}, before[SLIPID_DRIVES];
  const double start[3] = {0, 0, 0};
  slipid_init(&state, start);
  for (int32_t i = 0; i < 1000 * rounds; ++i) {
    /* the last ten seconds of every round are honest, the rest is not */
    const int honest = i % 1000 >= 800, path = (i / 1000) % 2 && !honest;
    const double rate = honest ? 0 : rates[(int)(4 * slipid_draw(&seed))];
    double dt = 0.05, twist[3] = {0, 0, 0}, allowed = 0.05;
    double *field = (double *)&in;
    slipid_nothing(&in);
    for (int k = 0; k < SLIPID_DRIVES; ++k) {
      before[k] = command[k];
      angle[k] += dt * (honest ? command[k] : 24 * slipid_draw(&seed) - 12);
      for (int a = 0; a < 3; ++a) {
        twist[a] += kinematics[SLIPID_DRIVES * a + k] * command[k];
      }
    }
    if (!honest) {
      for (unsigned k = 0; k < sizeof in / sizeof *field; ++k) {
        field[k] = 12 * slipid_draw(&seed) - 6;
      }
      in.fix_std[0] = 0.05 * slipid_draw(&seed);
      in.fix_std[1] = 0.05 * slipid_draw(&seed);
    } else {
      in.gyro = twist[2];
    }
    for (int k = 0; k < SLIPID_DRIVES; ++k) {
      in.wheel_angle[k] = angle[k];
      in.current[k] = honest ? 0.5 : in.current[k];
    }
    for (unsigned k = 0; k < sizeof in / sizeof *field; ++k) {
      if (slipid_draw(&seed) < rate) {
        field[k] = bad[(int)(11 * slipid_draw(&seed))];
      }
    }
    if (!honest && slipid_draw(&seed) < 0.1) {
      dt = bad[(int)(11 * slipid_draw(&seed))];
      allowed = isfinite(dt) && dt > 0 ? fmin(dt, 0.5) : 0;
    }
    if (honest && state.controller.gave_up) {
      slipid_rearm(&state.controller);
    }
    if (path) {
      double reference[6];
      for (int a = 0; a < 6; ++a) {
        reference[a] = slipid_draw(&seed) < rate ? bad[(int)(11 * slipid_draw(&seed))]
                                                 : 4 * slipid_draw(&seed) - 2;
      }
      slipid_step(&state, &in, reference, dt, &out, command);
    } else {
      slipid_drive(&state, &in, asked, dt, &out, command);
    }
    int stops = 1, finite = 1;
    for (int k = 0; k < SLIPID_DRIVES; ++k) {
      stops = stops && fabs(command[k]) <= fabs(before[k]);
      finite = finite && isfinite(command[k]);
      faults[1] += fabs(command[k]) > most[0] + 1e-9;
    }
    /* a stop makes progress even without a clock */
    allowed = stops ? fmax(allowed, 0.01) : allowed;
    for (int k = 0; k < SLIPID_DRIVES && i > 0; ++k) {
      faults[2] += fabs(command[k] - before[k]) > most[1] * allowed + 1e-9;
    }
    for (int a = 0; a < 3; ++a) {
      finite = finite && isfinite(out.pose[a]) && isfinite(out.twist[a]);
      for (int b = 0; b < 3; ++b) {
        finite = finite && isfinite(out.covariance[3 * a + b]);
        const double gap = out.covariance[3 * a + b] - out.covariance[3 * b + a];
        faults[3] += fabs(gap) > 1e-9 * (1 + fabs(out.covariance[3 * a + b]));
      }
      faults[3] += !(out.covariance[4 * a] >= 0);
    }
    faults[0] += !finite;
    if (i % 1000 == 999) {
      share[2 * (i / 1000)] = hypot(twist[0], twist[1]) / hypot(asked[0], asked[1]);
      share[2 * (i / 1000) + 1] = twist[2] / asked[2];
    }
  }
}
"""
"""A loop whose readings, clock and references lie for 800 steps of every 1000, in both modes.

It counts faults of each kind, and gives body speed and yaw rate over those demanded at the end of
each round."""
FAULTS = ("not finite", "wheel speed", "acceleration", "covariance")


@pytest.fixture(scope="module", params=list(SHAPES))
def compiled(request, tmp_path_factory) -> CompiledC:
    robot = deployed(request.param)
    loop = ControlLoop(Estimator(robot), Controller(robot, Gains(), recovery=True))
    folder = tmp_path_factory.mktemp("c")
    return CompiledC(Code(robot, loop, rectangle()), folder, more=RELEASED + ATTACKED)


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


@pytest.mark.parametrize(
    "rounds", [250, pytest.param(1000, marks=pytest.mark.nightly)], ids=["quarter", "million"]
)
def test_nothing_that_is_read_makes_it_unsafe(compiled, rounds):
    """Over the four drives these are a million steps, nightly a million for each."""
    robot, limits = compiled.code.robot, compiled.code.loop.controller.limits
    kinematics = np.ascontiguousarray(np.linalg.pinv(np.asarray(robot.inverse_kinematics[0])))
    limit = float(limits.acceleration) / float(robot.frame.radius)
    most = np.array([float(limits.wheel_speed), limit])
    counts, shares = np.zeros(len(FAULTS), np.int32), np.zeros((rounds, 2))
    arrays = [a.ctypes.data_as(ctypes.c_void_p) for a in (most, kinematics, ASKED, counts, shares)]
    compiled.library.slipid_attacked(ctypes.c_int32(rounds), ctypes.c_uint64(20), *arrays)
    assert dict(zip(FAULTS, counts.tolist(), strict=True)) == dict.fromkeys(FAULTS, 0)
    # ten honest seconds later it drives as asked
    assert shares[:, 0].min() > 0.8, shares.min(axis=0)
    assert shares[:, 1].min() > 0.5, shares.min(axis=0)
    assert shares.max() < MOST, shares.max(axis=0)
