"""The judge: open loop from the first pose of a fresh run, error of its end over the path."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.benchmarks.every_robot.drive import Judged
from tests.benchmarks.every_robot.rivals import (
    Fitted,
    Kinematics,
    Motion,
    Track,
    aligned,
    relative,
    sensor_path,
    true,
)
from tests.benchmarks.every_robot.robots import MadeRobot

START = 4.0
"""Time in which positions alone tell in which direction a run starts [s]."""


def end_error(
    robot: MadeRobot, motion: Motion, k: Kinematics, track: Track, truth: Judged
) -> float:
    """Distance of the predicted end of a run from the measured one, over the path length.

    The run starts at the measured pose; without headings, at the heading that fits the first
    seconds best. Where headings alone are measured, start and end are the true ones.
    """
    found = sensor_path(motion, k, track)
    last = np.array([len(found) - 1])
    if robot.pose_kind == "xy":
        first = track.pose_t < track.pose_t[0] + START
        p, m = (pose[:, 0] + 1j * pose[:, 1] for pose in (found, track.pose))
        placed = aligned(p[first], m[first])
        turn = (placed[-1] - placed[0]) / (p[first][-1] - p[0])
        return float(abs(placed[0] + turn * (p[-1] - p[0]) - m[-1])) / truth.path
    measured = track.pose
    if robot.pose_kind == "heading":
        measured = np.array([truth.start, truth.end])
    there = np.array([len(measured) - 1])
    gap = relative(found, 0 * last, last) - relative(measured, 0 * there, there)
    return float(np.hypot(*gap[0, :2])) / truth.path


def row(
    robot: MadeRobot, motion: Motion, k: Kinematics, fresh: list[Track], truth: dict[str, Judged]
) -> dict[str, float]:
    """Mean error over the fresh runs of each floor [% of the path]."""
    errors: dict[str, list[float]] = {}
    for track in fresh:
        error = 100 * end_error(robot, motion, k, track, truth[track.name])
        errors.setdefault(track.floor, []).append(error)
    return {floor: float(np.mean(each)) for floor, each in errors.items()}


Number = Callable[[Kinematics], float]


def numbers(robot: MadeRobot) -> dict[str, Number]:
    """Numbers of a calibration that the runs of a robot tell, keyed by a name.

    The place of the sensor counts from the centre of rotation on the firmest floor.
    """
    if not robot.has_kinematics:
        return {}
    firm = max(robot.floors, key=lambda floor: max(floor.radius)).name
    found: dict[str, Number] = {}
    turns, scaled = robot.paths != "straight", robot.pose_kind != "heading"
    for floor in (floor.name for floor in robot.floors):
        for j in range(robot.drives if scaled and turns else 0):
            found[f"radius {floor} {j + 1}"] = lambda k, f=floor, j=j: float(k.radius[f][j])
        if turns and scaled:
            found[f"base {floor}"] = lambda k, f=floor: float(k.base[f])
        if robot.drive == "skid" and floor != firm:
            found[f"centre {floor}"] = lambda k, f=floor: k.centre[f] - k.centre[firm]
    if scaled and turns:
        found["place x"] = lambda k: k.place[0] - k.centre[firm]
        found["place y"] = lambda k: k.place[1]
    if robot.drive == "steered":
        found["steering zero_rad"] = lambda k: k.steering[0]
        found["steering gain"] = lambda k: k.steering[1]
        found["steering understeer"] = lambda k: k.understeer[firm]
    if scaled or turns:
        found["lag"] = lambda k: k.lag
    return found


def covered(robot: MadeRobot, fitted: Fitted) -> dict[str, bool]:
    """Return, for each number, whether its 90 % interval holds the true one."""
    truth, found = true(robot), {}
    for name, number in numbers(robot).items():
        low, high = fitted.interval(number)
        found[name] = bool(low <= number(truth) <= high)
    return found
