"""Real logs through the deployed estimator: what it hears of a run, and how its end is judged.

The floor is unknown to it, the pose is used once: the first one after the wheels moved
`slipid.data.wheel_signals.MOVED_M`. Its poses are of the encoders' time, the camera's lag
is taken off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from slipid.data.floor_map import FloorMap
from slipid.data.log import Log
from slipid.data.runs import Runs, first_row
from slipid.model.robot import Robot
from slipid.model.se2 import compose
from slipid.robot.interface import AbstractEstimator, Readings, StateEstimate

TOGETHER = 32
"""Runs replayed in one call."""
ROWS = 128
"""Rows are filled up to a multiple of it, so that few shapes are compiled."""
STARTS = 0.001
"""A robot moves from where the rim of a wheel has moved this far [m]."""


def heard(estimator: AbstractEstimator, angle: Any, current: Any) -> Readings:
    """What one row of a run tells: wheel angles and currents, no more."""
    return replace(Readings.nothing(estimator.robot.wheels), wheel_angle=angle, current=current)


def replay(
    estimator: AbstractEstimator, logs: Sequence[Log], begin: np.ndarray | None = None
) -> list[StateEstimate]:
    """Estimates of every row of each run; it starts at rest at a pose (run, 3), or the origin."""
    begin = np.zeros((len(logs), 3)) if begin is None else begin

    @jax.jit
    def run(start: Any, angle: Any, current: Any, dt: Any) -> Any:
        def step(state: Any, row: Any) -> Any:
            return estimator.step(state, heard(estimator, *row[:2]), row[2])

        def one(pose: Any, *rows: Any) -> Any:
            return jax.lax.scan(step, estimator.init(pose), rows)[1]

        return jax.vmap(one)(start, angle, current, dt)

    said: list[Any] = [None] * len(logs)
    by_length = np.argsort([log.samples for log in logs], kind="stable")
    for first in range(0, len(logs), TOGETHER):
        some = [logs[k] for k in by_length[first : first + TOGETHER]]
        longest = -(-max(log.samples for log in some) // ROWS) * ROWS
        wheels = np.full((2, TOGETHER, longest, estimator.robot.wheels), np.nan)
        dt = np.zeros((TOGETHER, longest))
        for n, log in enumerate(some):
            assert log.current is not None
            wheels[:, n, : log.samples] = log.wheel_angle, log.current
            dt[n, 1 : log.samples] = np.diff(log.time)
        start = np.zeros((TOGETHER, 3))
        start[: len(some)] = begin[by_length[first : first + TOGETHER]]
        rows = run(jnp.asarray(start), *jnp.asarray(wheels), jnp.asarray(dt))
        out = jax.tree.map(np.asarray, rows)
        for n, k in enumerate(by_length[first : first + TOGETHER]):
            said[k] = jax.tree.map(lambda x, n=n, k=k: x[n, : logs[k].samples], out)
    return said


@dataclass(frozen=True)
class Judged:
    """One run, judged.

    Attributes:
        name, surface, heading_deg, speed: of the run.
        told: floor most probable under the wheels on average 1 s after it starts to move.
        belief: of every floor then, and of none.
        error: distance of predicted and camera end over the camera's chord.
        straight: the same for wheels that do not slip.
        level: probability of the region on whose edge the camera's end lies.
        chord: the camera's [m].
    """

    name: str
    surface: str | None
    heading_deg: float
    speed: float
    told: str
    belief: tuple[float, ...]
    error: float
    straight: float
    level: float
    chord: float


def judged(
    robot: Robot, labels: Sequence[str], data: Runs, said: Sequence[Any], noise: Mapping[str, float]
) -> list[Judged]:
    """Runs against the camera.

    Args:
        robot: fitted, for its camera.
        labels: floors in the order of the estimator's.
        data: the runs.
        said: of each run, see `replay`.
        noise: variances of the camera, `camera.place` [m^2] and `camera.heading` [rad^2].
    """
    rows = []
    for k, log in enumerate(data.logs):
        belief = at_one_second(robot, log, said[k])
        camera, predicted, straight, cov = _ends(robot, data, k, said[k])
        chord = float(np.hypot(*(camera[1] - camera[0])[:2]))
        gap = predicted[:2] - camera[1, :2]
        way = predicted[:2] - camera[0, :2]
        across = np.array([-way[1], way[0]])
        cov = cov + noise["camera.heading"] * np.outer(across, across)
        cov = cov + 2 * noise["camera.place"] * float(robot.camera.scale) ** 2 * np.eye(2)
        rows.append(
            Judged(
                name=log.name,
                surface=log.surface,
                heading_deg=float(np.degrees(data.heading[k])),
                speed=float(data.speed[k]),
                told=labels[int(np.argmax(belief[:-1]))],
                belief=tuple(belief.tolist()),
                error=float(np.hypot(*gap)) / chord,
                straight=float(np.hypot(*(straight[:2] - camera[1, :2]))) / chord,
                level=float(chi2.cdf(gap @ np.linalg.solve(cov, gap), 2)),
                chord=chord,
            )
        )
    return rows


def at_one_second(robot: Robot, log: Log, said: Any) -> np.ndarray:
    """Probability of each floor and of none, wheels averaged, 1 s after the wheels start."""
    angle, radius = log.wheel_angle, float(robot.geometry.wheel_radius)
    starts = np.argmax(np.abs(angle - angle[0]).max(axis=1) * radius >= STARTS)
    row = min(np.searchsorted(log.time, log.time[starts] + 1.0, side="right") - 1, log.samples - 1)
    return np.asarray(said.surface_probability[row].mean(axis=0))


def _ends(
    robot: Robot, data: Runs, run: int, said: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Camera poses at both ends; ends that estimator and bare encoders predict; covariance.

    All in the frame of the corrected camera; headings are the body's.
    """
    log = data.logs[run]
    assert log.pose is not None
    assert log.pose_fresh is not None
    fresh = np.flatnonzero(log.pose_fresh)
    fresh = fresh[fresh >= first_row(data, run, float(robot.geometry.wheel_radius))]
    rows = fresh[[0, -1]]
    yaw = float(robot.camera.yaw(robot.session_index(data.session[run])))
    camera = np.array(jax.jit(jax.vmap(robot.camera.corrected))(log.pose[rows]))
    camera[:, 2] -= yaw
    at = log.time[rows] - float(robot.camera.lag)

    def between(path: np.ndarray) -> np.ndarray:
        """End of a path of its own, moved so that it starts at the camera's first pose."""
        a, b = (np.array([np.interp(t, log.time, path[:, i]) for i in range(3)]) for t in at)
        c, s = np.cos(a[2]), np.sin(a[2])
        x, y = b[:2] - a[:2]
        step = jnp.array([c * x + s * y, c * y - s * x, b[2] - a[2]])
        return np.asarray(compose(jnp.asarray(camera[0]), step))

    end = np.searchsorted(log.time, at[1])
    turn = camera[0, 2] - np.interp(at[0], log.time, said.pose[:, 2])
    c, s = np.cos(turn), np.sin(turn)
    back = np.array([[c, -s], [s, c]])
    cov = back @ said.covariance[end][:2, :2] @ back.T
    return camera, between(said.pose), between(_encoders(robot, log)), cov


def _encoders(robot: Robot, log: Log) -> np.ndarray:
    """Path of wheels that do not slip, from the origin (row, 3)."""
    step = np.diff(log.wheel_angle, axis=0) * float(robot.geometry.wheel_radius)
    step = step @ np.asarray(robot.geometry.pseudo_inverse()).T
    out = np.zeros((log.samples, 3))
    for k, (x, y, turn) in enumerate(step):
        middle = out[k, 2] + 0.5 * turn
        c, s = np.cos(middle), np.sin(middle)
        out[k + 1] = out[k] + [c * x - s * y, s * x + c * y, turn]
    return out


def wheels(
    robot: Robot, labels: Sequence[str], floor: FloorMap, data: Runs, said: Sequence[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Floor beneath each wheel in every row of moving robots, and what is believed of it.

    Returns:
        By the map and the camera, by number in `labels` (sample,); probabilities (sample, floor and
        none).
    """
    truth, belief = [], []
    number = np.array([labels.index(name) for name in floor.surfaces])
    for log, of, session in zip(data.logs, said, data.session, strict=True):
        moved = np.abs(log.wheel_angle - log.wheel_angle[0]).max(axis=1)
        rows = moved * float(robot.geometry.wheel_radius) >= STARTS
        place = _wheel_places(robot, log, session)[rows]
        truth.append(number[floor.at(place)].ravel())
        belief.append(of.surface_probability[rows].reshape(-1, of.surface_probability.shape[-1]))
    return np.concatenate(truth), np.concatenate(belief)


def poses(robot: Robot, log: Log, session: str) -> np.ndarray:
    """Pose of the body at every row, in the frame of the corrected camera (row, 3)."""
    assert log.pose is not None
    pose = np.array(jax.jit(jax.vmap(robot.camera.corrected))(log.pose[log.pose_fresh]))
    pose[:, 2] = np.unwrap(pose[:, 2]) - float(robot.camera.yaw(robot.session_index(session)))
    at = log.time + float(robot.camera.lag)
    return np.stack([np.interp(at, log.time[log.pose_fresh], x) for x in pose.T], axis=1)


def _wheel_places(robot: Robot, log: Log, session: str) -> np.ndarray:
    """Wheel centres at every row [m], in the frame of the corrected camera (row, wheel, 2)."""
    x, y, turn = (column[:, None] for column in poses(robot, log, session).T)
    px, py = (np.asarray(robot.geometry.place) * float(robot.geometry.base_radius)).T
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([x + c * px - s * py, y + s * px + c * py], axis=-1)
