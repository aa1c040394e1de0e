"""Poses with a clock of their own, put on that of the robot."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slipid.data.clocks.clock import Clock, best_clock
from slipid.data.clocks.motion import Motion
from slipid.data.log import Log
from slipid.data.reading.assemble import heading
from slipid.data.reading.signal import Signal, clock_of


def on_robot_clock(poses: Mapping[str, Signal], robot: Log, notes: list[str]) -> dict[str, Signal]:
    """The same poses at times of the robot's clock; what was found is added to the notes.

    Args:
        poses: signals of a pose, by channel, on their own clock.
        robot: what the robot itself logged.

    Raises:
        DataError: the motion does not tell how far the clocks are apart.
    """
    parts = (poses["pose_x"], poses["pose_y"], heading(poses))
    time = clock_of(parts)
    columns = [np.interp(time, p.time, p.values[:, 0]) for p in parts[:2]]
    turned = np.unwrap(parts[2].values[:, 0])
    pose = np.column_stack([*columns, np.interp(time, parts[2].time, turned)])
    clock = _clock(robot, time, pose)
    if clock is None:
        raise parts[0].source.error(
            f"the clocks of {robot.name} and of these poses cannot be told from the motion",
            "a run with starts, stops and turns that both saw, or clock = 'robot' and an offset of "
            "the time column",
        )
    notes.append(f"clock of the poses against the robot's, from the motion: {clock}")
    return {
        name: replace(signal, time=clock.robot_time(signal.time)) for name, signal in poses.items()
    }


def _clock(robot: Log, time: np.ndarray, pose: np.ndarray) -> Clock | None:
    """By the gyro where there is one and it tells, else by the wheels."""
    views = [Motion.of_wheels(robot.time, robot.wheel_angle, time, pose)]
    if robot.gyro is not None:
        views.insert(0, Motion.of_gyro(robot.time, robot.gyro, time, pose))
    return best_clock(views)
