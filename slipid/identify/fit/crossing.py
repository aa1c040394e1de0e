"""Runs over several floors cut into short windows, each wheel on one floor all the while."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.floor_map import FloorMap
from slipid.data.runs import Runs
from slipid.data.windows import Windows, windows
from slipid.model.robot import Robot
from slipid.support.errors import DataError

WINDOW = 0.25
"""Length of a window [s]: short against the time a wheel stays on a patch."""
LEAST_SPEED = 0.04
"""Speed of the fastest rim below which a window says nothing [m/s]."""
MOST_ACCELERATION = 0.6
"""Of a rim: beyond it the balance of forces is not that of rest [m/s^2]."""


@dataclass(frozen=True, eq=False)
class Crossing:
    """Windows of runs over several floors, one per piece; runs are (name, sha256).

    The floor is that under each wheel all the while, by number in the robot's stack, the place a
    window's number in its run, gaps counted.
    """

    windows: Windows
    floor: Int[np.ndarray, "piece wheel"]
    place: Int[np.ndarray, " piece"]
    runs: tuple[tuple[str, str], ...]

    def of(self, picked: Bool[np.ndarray, " piece"]) -> "Crossing":
        """Some of the windows, of the same runs."""
        windows = self.windows.pieces(np.flatnonzero(picked))
        return Crossing(windows, self.floor[picked], self.place[picked], self.runs)


def crossing(data: Runs, floor: FloorMap, robot: Robot) -> Crossing:
    """Windows of runs whose poses are in the frame of a map, in which no wheel changes floors.

    Where wheels stand is read through the camera of the fitted robot, which knows every surface of
    the map and every load of the runs.

    Raises:
        DataError: no such window.
    """
    radius, lag = float(robot.geometry.wheel_radius), float(robot.camera.lag)
    w = windows(data, radius, lag, per_piece=1, longest=WINDOW)
    number = np.array([robot.surface_index(name) for name in floor.surfaces])
    under = number[floor.at(wheel_places(robot, w))]
    found = Crossing(
        windows=w,
        floor=under[:, 1],
        place=np.arange(len(w)) - np.searchsorted(w.run, w.run),
        runs=tuple((log.name, log.sha256) for log in data.logs),
    )
    stays = (under == under[:, 1:2]).all(axis=(1, 2))
    found = found.of(stays & _steady(w, radius))
    if not len(found.windows):
        raise DataError(
            f"{data.logs[0].name} and the other runs over several floors: no {WINDOW:g} s in which "
            "wheels turn evenly and each keeps to its floor; expected larger patches or slower runs"
        )
    return found


def wheel_places(robot: Robot, w: Windows) -> Float[np.ndarray, "piece time wheel 2"]:
    """Wheel centres at start, middle and end of one window per piece [m], by the camera."""
    edges = np.asarray(jax.vmap(jax.vmap(robot.camera.corrected))(jnp.asarray(w.pose)))
    pose = np.stack([edges[:, 0], edges.mean(axis=1), edges[:, 1]], axis=1)
    yaw = np.array([float(robot.camera.yaw(robot.session_index(s))) for s in w.session])
    heading = pose[..., 2] - yaw[:, None]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([c, -s, s, c], -1).reshape(*c.shape, 2, 2)
    place = np.asarray(robot.geometry.place) * float(robot.geometry.base_radius)
    from_marker = place - np.asarray(robot.camera.marker_place)
    return np.asarray(pose[..., None, :2] + np.einsum("ntij,wj->ntwi", turn, from_marker))


def _steady(w: Windows, radius: float) -> Bool[np.ndarray, " piece"]:
    """Windows in which wheels turn, about evenly, and no camera frames are missing."""
    rim, jump = radius * w.turn[:, 0] / w.dt, radius * w.faster[:, 0] / w.dt
    moves = np.abs(rim).max(axis=1) >= LEAST_SPEED
    even = np.abs(jump).max(axis=1) <= MOST_ACCELERATION
    return np.asarray(moves & even & (w.dt[:, 0] < 2 * WINDOW))
