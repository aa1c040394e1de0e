"""Poses with a clock of their own: how it goes against that of the robot."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from slipid.data.align.clock import Clock, best_clock
from slipid.data.align.motion_pair import MotionPair
from slipid.data.log import Log
from slipid.data.reading.assemble import TURNS, Identity, assembled, heading
from slipid.data.reading.checks import Unsteady
from slipid.data.reading.layout import Recorded
from slipid.data.reading.signal import Signal, clock_of


def clock_against(
    robot: Mapping[str, Signal], layout: Recorded, identity: Identity, poses: Mapping[str, Signal]
) -> Clock:
    """The clock of poses against that of the robot's signals, from the motion that both saw.

    Args:
        robot: what the robot itself logged, by channel; layout and identity are of its file.
        poses: signals of a pose, by channel, on their own clock.

    Raises:
        Unsteady: the motion does not tell how far the clocks are apart.
    """
    log = assembled(robot, layout, identity)
    parts = (poses["pose_x"], poses["pose_y"], heading(poses))
    time = clock_of(parts)
    columns = [np.interp(time, part.time, part.values[:, 0]) for part in parts[:2]]
    turned = np.unwrap(parts[2].values[:, 0])
    pose = np.column_stack([*columns, np.interp(time, parts[2].time, turned)])
    clock = best_clock(_views(log, time, pose))
    if clock is None:
        raise Unsteady(
            f"{parts[0].source.path}: the motion does not tell its clock from that of {log.name}; "
            "expected poses of this very run, with starts, stops and turns that both saw, and the "
            "frame rate that the video has"
        )
    # a log that counts from 1970 was made to begin at zero
    turns = next(name for name in TURNS if name in robot)
    began = float(robot[turns].time[0] - log.time[0])
    return replace(clock, offset=clock.offset + began)


def _views(
    robot: Log, time: Float[np.ndarray, " pose"], pose: Float[np.ndarray, "pose 3"]
) -> Iterator[MotionPair]:
    """By the gyro where there is one, which turns with the body itself; by the wheels."""
    if robot.gyro is not None:
        yield MotionPair.of_gyro(robot.time, robot.gyro, time, pose)
    yield MotionPair.of_wheels(robot.time, robot.wheel_angle, time, pose)
