"""Poses with a clock of their own: how it goes against that of the robot."""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float

from slipid.data.clocks.clock import Clock, best_clock
from slipid.data.clocks.motion import Motion
from slipid.data.log import Log
from slipid.data.reading.assemble import heading
from slipid.data.reading.signal import Signal, clock_of


def clock_against(robot: Log, poses: Mapping[str, Signal]) -> Clock:
    """The clock of poses against that of the robot, from the motion that both saw.

    Args:
        robot: what the robot itself logged.
        poses: signals of a pose, by channel, on their own clock.

    Raises:
        DataError: the motion does not tell how far the clocks are apart.
    """
    parts = (poses["pose_x"], poses["pose_y"], heading(poses))
    time = clock_of(parts)
    columns = [np.interp(time, part.time, part.values[:, 0]) for part in parts[:2]]
    turned = np.unwrap(parts[2].values[:, 0])
    pose = np.column_stack([*columns, np.interp(time, parts[2].time, turned)])
    clock = best_clock(_views(robot, time, pose))
    if clock is None:
        raise parts[0].source.error(
            f"the motion does not tell the clock of {robot.name} from that of these poses",
            "a run with starts, stops and turns that both saw, or clock = 'robot' and an offset of "
            "the time column",
        )
    return clock


def _views(
    robot: Log, time: Float[np.ndarray, " pose"], pose: Float[np.ndarray, "pose 3"]
) -> Iterator[Motion]:
    """By the gyro where there is one, which turns with the body itself; by the wheels."""
    if robot.gyro is not None:
        yield Motion.of_gyro(robot.time, robot.gyro, time, pose)
    yield Motion.of_wheels(robot.time, robot.wheel_angle, time, pose)
