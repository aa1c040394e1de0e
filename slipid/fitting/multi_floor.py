"""Runs over several floors as short windows, with the floor under each wheel in each window.

If all wheels stand on one floor, its friction coefficient has no influence on the motion, because
all forces of the balance are proportional to it. If wheels stand on different floors, the ratio of
the friction coefficients turns the robot. A run is one segment of many short windows, so that its
camera noise, its process noise and the constant errors of its motion and its currents are in the
covariance of the segment, as they are for runs on one floor. Windows in which a wheel changes
floors or wheel speeds are not steady, and windows beyond the end of a run, are not used in the
likelihood; their residuals are set to zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from slipid.data.floor_map import FloorMap
from slipid.data.runs import Runs
from slipid.data.windows import Windows, windows
from slipid.fitting import likelihood as lk
from slipid.model.robot import Robot
from slipid.search_space import Space
from slipid.support.errors import DataError

SHORTEST, LONGEST = 0.25, 0.5
"""Shortest and longest window [s], short compared with the time a wheel stays on one floor."""
LEAST_SPEED = 0.04
"""A window is used only if the fastest wheel reaches this rim speed [m/s]."""
MOST_ACCELERATION = 0.6
"""Largest rim acceleration of a window that is used [m/s^2]; above it the motion is not steady."""
MOST_WINDOWS = 40
"""Largest number of windows in a segment.

The windows of a long run are lengthened up to `LONGEST` to keep to this number. A run with still
more windows is split into several segments, as if it were several runs.
"""
MULTI_FLOOR_MOTION = "crossing.motion"
"""Name of the block of motion residuals of runs over several floors."""
MULTI_FLOOR_CURRENT = "crossing.current"
"""Name of the block of current residuals of runs over several floors."""


@dataclass(frozen=True, eq=False)
class MultiFloorRuns:
    """Runs over several floors, one segment per run.

    Attributes:
        windows: windows of every segment.
        floor: index of the floor under each wheel in the middle of each window.
        counts: True for windows that are used in the likelihood.
        runs: (name, sha256) of every run.
    """

    windows: Windows
    floor: Int[np.ndarray, "segment window wheel"]
    counts: Bool[np.ndarray, "segment window"]
    runs: tuple[tuple[str, str], ...]


def multi_floor_runs(sets: Sequence[tuple[Runs, FloorMap]], robot: Robot) -> MultiFloorRuns:
    """Return the segments of runs whose poses are in the frame of a map, for several maps.

    The wheel positions are computed with the camera model of the fitted robot, which must have
    every surface of the maps and every load set-up of the runs.

    Raises:
        DataError: no window of the runs on a map can be used, or only some runs have currents.
    """
    cut = [_windows_on(data, floor, robot) for data, floor in sets]
    if len({(c.windows.has_current, c.windows.current_is_signed) for c in cut}) > 1:
        raise DataError(
            "the sets of runs over several floors differ in the logged currents; expected signed "
            "currents in all of them, or unsigned ones in all, or none"
        )
    floor, counts = (np.concatenate([getattr(c, f) for c in cut]) for f in ("floor", "counts"))
    first = np.cumsum([0, *(len(c.runs) for c in cut)])
    run = np.concatenate([c.windows.run + k for c, k in zip(cut, first, strict=False)])
    rows = []
    for k in np.unique(run):
        mine = np.flatnonzero(run == k)
        parts = np.array_split(mine, -(-len(mine) // MOST_WINDOWS))
        rows += [part for part in parts if counts[part].any()]
    longest = max(len(row) for row in rows)
    at = np.array([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows])
    original = np.arange(longest) < np.array([[len(row)] for row in rows])
    w = _joined([c.windows for c in cut], run)
    whole = replace(
        w.segments(at[:, 0]),
        pose=np.concatenate([w.pose[at[:, :1], 0], w.pose[at, 1]], axis=1),
        **{name: getattr(w, name)[at, 0] for name in _PER_WINDOW},
    )
    names = tuple(name for c in cut for name in c.runs)
    return MultiFloorRuns(whole, floor[at, 0], counts[at, 0] & original, names)


_PER_WINDOW = (
    *("dt", "turn", "speed_change", "direction"),
    *("current", "voltage", "current_var", "voltage_var"),
)
"""Fields of `Windows` with one value per window."""


def _windows_on(data: Runs, floor: FloorMap, robot: Robot) -> MultiFloorRuns:
    """Return the windows of the runs on one map, each as a separate segment."""
    radius = float(robot.geometry.wheel_radius)
    w = _short(data, radius, float(robot.camera.lag))
    number = np.array([robot.surface_index(name) for name in floor.surfaces])
    edges = np.asarray(lk.corrected(robot, jnp.asarray(w.pose)))
    pose = np.stack([edges[:, 0], edges.mean(axis=1), edges[:, 1]], axis=1)
    under = number[floor.at(wheel_places(robot, pose, w.session))]
    counts = (under == under[:, 1:2]).all(axis=(1, 2)) & _steady(w, radius)
    if not counts.any():
        raise DataError(
            f"{data.logs[0].name} and the other runs over several floors: no window in which "
            "wheel speeds are steady and each wheel stays on its floor; expected larger patches "
            "or slower runs"
        )
    names = tuple((log.name, log.sha256) for log in data.logs)
    return MultiFloorRuns(w, under[:, 1:2], counts[:, None], names)


def _short(data: Runs, radius: float, lag: float) -> Windows:
    """Cut every run into short windows, each a separate segment; arguments as in `windows`."""
    each = []
    for k in range(len(data)):
        t = data.time[data.rows(k)]
        length = np.clip((t[-1] - t[0]) / MOST_WINDOWS, SHORTEST, LONGEST)
        each.append(windows(data.subset([k]), radius, lag, per_segment=1, longest=float(length)))
    return _joined(each, np.repeat(np.arange(len(each)), [len(w) for w in each]))


def _joined(each: Sequence[Windows], run: Int[np.ndarray, " segment"]) -> Windows:
    """Concatenate sets of windows; `run` is the new run index of every segment."""
    whole: dict[str, Any] = {"run": run}
    for name in (f.name for f in fields(Windows) if f.name != "run"):
        values = [getattr(w, name) for w in each]
        if isinstance(values[0], np.ndarray):
            whole[name] = np.concatenate(values)
        elif isinstance(values[0], tuple):
            whole[name] = tuple(x for value in values for x in value)
    return replace(each[0], **whole)


def wheel_places(
    robot: Robot, pose: Float[np.ndarray, "segment time 3"], sessions: Sequence[str]
) -> Float[np.ndarray, "segment time wheel 2"]:
    """Return positions of the wheel centres in the frame of the map [m].

    Args:
        robot: the robot.
        pose: poses of the marker, corrected by the robot's camera.
        sessions: name of the session of each segment.
    """
    session = lk.indices(robot.session_index, sessions)
    yaw = np.asarray(jax.vmap(robot.camera.yaw)(jnp.asarray(session)))
    heading = pose[..., 2] - yaw[:, None]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([c, -s, s, c], -1).reshape(*c.shape, 2, 2)
    place = np.asarray(robot.geometry.place) * float(robot.geometry.base_radius)
    from_marker = place - np.asarray(robot.camera.marker_place)
    return np.asarray(pose[..., None, :2] + np.einsum("ntij,wj->ntwi", turn, from_marker))


def _steady(w: Windows, radius: float) -> Bool[np.ndarray, " segment"]:
    """Return a mask of windows with moving wheels at steady speeds and without missing poses."""
    rim, jump = radius * w.turn[:, 0] / w.dt, radius * w.speed_change[:, 0] / w.dt
    moves = np.abs(rim).max(axis=1) >= LEAST_SPEED
    even = np.abs(jump).max(axis=1) <= MOST_ACCELERATION
    return np.asarray(moves & even & (w.dt[:, 0] < 2 * LONGEST))


class MultiFloorBatch(eqx.Module):
    """Runs over several floors as arrays for compiled functions.

    Attributes:
        batch: windows, with the floor under each wheel.
        counts: 1 for windows that are used in the likelihood, else 0.
    """

    batch: lk.Batch
    counts: Float[Array, "segment window"]

    @staticmethod
    def of(runs: MultiFloorRuns, robot: Robot) -> "MultiFloorBatch":
        """Return the batch of runs for a robot."""
        b = lk.batch(runs.windows, robot, runs.floor)
        return MultiFloorBatch(b, jax.device_put(np.asarray(runs.counts, float)))

    def as_if_on(self, floor: int) -> "MultiFloorBatch":
        """Return the same runs as if all wheels had always stood on one floor."""
        alone = jnp.full_like(self.batch.surface, floor)
        return replace(self, batch=replace(self.batch, surface=alone))

    def residuals(self, robot: Robot, p: lk.Predicted) -> dict[str, Array]:
        """Return predicted less measured motion and, if they are logged, currents."""
        motion = lk.motion_residual(robot, self.batch, p) * jnp.repeat(self.counts, 3, axis=1)
        return {MULTI_FLOOR_MOTION: motion} | self.currents(robot, p.motor_force)

    def currents(self, robot: Robot, motor_force: lk.MotorForce) -> dict[str, Array]:
        """Return predicted less measured currents, given contact forces, if they are logged."""
        b = self.batch
        if not b.has_current:
            return {}
        amps = lk.predicted_current(robot, b, motor_force) - b.current
        return {MULTI_FLOOR_CURRENT: (amps * self.counts[..., None]).reshape(len(amps), -1)}

    def log_jacobian(self, robot: Robot) -> Float[Array, " segment"]:
        """Return log |d motion residuals / d logged poses| of every segment."""
        each = jax.vmap(jax.vmap(robot.camera.log_jacobian))(self.batch.pose[:, 1:])
        return jnp.sum(each * self.counts, axis=1)


@eqx.filter_jit
def residuals_at(space: Space, multi_floor: MultiFloorBatch, z: Array) -> dict[str, Array]:
    """Return the residuals of runs over several floors at a search vector."""
    robot = space.tree(z)
    return multi_floor.residuals(robot, lk.predict(robot, multi_floor.batch))


class WindowErrors(NamedTuple):
    """Root mean square errors of windows.

    Attributes:
        speed: error of the speed [m/s].
        yaw_rate: error of the yaw rate [rad/s].
        current: error of the current [A], None if it was not logged.
    """

    speed: float
    yaw_rate: float
    current: float | None

    def over(self, before: "WindowErrors") -> float | None:
        """Return the larger ratio of these errors to others, of the speed and of the yaw rate.

        It is None if the currents, which know of the map as well, are predicted worse than before.
        """
        if self.current is not None and self.current > (before.current or 0.0):
            return None
        pairs = (self.speed, before.speed), (self.yaw_rate, before.yaw_rate)
        return max(new / max(old, 1e-12) for new, old in pairs)


def window_errors(
    multi_floor: MultiFloorBatch,
    judged: Sequence[tuple[dict[str, Array], Float[np.ndarray, " segment"]]],
) -> WindowErrors:
    """Return root mean square errors over all windows that are used.

    Args:
        judged: pairs of residuals, keyed by block, and weights: 1 for the segments whose errors are
            taken from these residuals, 0 for all other segments.
    """
    counts, dt = np.asarray(multi_floor.counts), np.asarray(multi_floor.batch.dt)
    motion, current, total = np.zeros(3), 0.0, 0.0
    for residual, weight in judged:
        count = counts * weight[:, None]
        rate = np.asarray(residual[MULTI_FLOOR_MOTION]).reshape(*dt.shape, 3) / dt[..., None]
        motion += (count[..., None] * rate**2).sum(axis=(0, 1))
        total += count.sum()
        if MULTI_FLOOR_CURRENT in residual:
            amps = np.asarray(residual[MULTI_FLOOR_CURRENT]).reshape(*dt.shape, -1)
            current += (count * (amps**2).mean(axis=2)).sum()
    x, y, yaw = motion / total
    has_current = multi_floor.batch.has_current
    return WindowErrors(
        speed=float(np.sqrt(x + y)),
        yaw_rate=float(np.sqrt(yaw)),
        current=float(np.sqrt(current / total)) if has_current else None,
    )
