"""Paths over time: reference poses and rates, whose time stops while the robot lags behind.

A robot whose wheels determine x, y and yaw drives along its path without turning. The heading of
any other robot is tangent to the path, which consists of sections: on a `PathSection` the curvature
k [1/m] changes linearly with the driven distance s [m], so that it is a line, an arc or a clothoid,
and on a `Turn` the robot turns on the spot:

    d heading / ds = k(s),   d (x, y) / ds = (cos heading, sin heading)
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

BASE_M = 0.125
"""Base radius of the robot for which the lengths of the named paths were chosen [m]."""
ROW_PERIOD = 0.02
"""Time between two rows of a path [s]."""
FULL_SPEED_M, WAIT_M = 0.02, 0.12
"""Distance of the robot from its reference up to which a path keeps its speed, and distance above
which the path stops and waits; in between the path slows down linearly [m]."""
LONGEST_STEP = 0.5
"""Largest time step by which a path advances [s]."""


class Path(eqx.Module):
    """Reference pose and its rates in the world, over a time that waits for a robot that lags.

    Attributes:
        rows: x, y [m], heading [rad] and their rates [m/s, m/s, rad/s], one row every `ROW_PERIOD`.
        marks: times of the path at which a side (including the rest at its end) or a quarter of a
            curve ends [s].
        corners: reference positions at the times `marks` [m].
    """

    rows: Float[Array, "row 6"]
    marks: Float[Array, " mark"]
    corners: Float[Array, "mark 2"]

    @property
    def duration(self) -> float:
        """Duration of the path, in the time of the path [s]."""
        return (len(self.rows) - 1) * ROW_PERIOD

    def at(self, time: Float[Array, ""] | float) -> Float[Array, "6"]:
        """Return pose and rates at a time of the path [s], limited to the path's duration."""
        place = jnp.clip(jnp.asarray(time) / ROW_PERIOD, 0.0, len(self.rows) - 1.000001)
        low = jnp.floor(place).astype(jnp.int32)
        high, part = jnp.minimum(low + 1, len(self.rows) - 1), place - low
        return (1 - part) * self.rows[low] + part * self.rows[high]

    def remaining(self, time: Float[Array, ""] | float) -> Float[Array, ""]:
        """Return the path length that remains at a time of the path [m]."""
        steps = jnp.diff(self.rows[:, :2], axis=0)
        after = jnp.clip(jnp.arange(1, len(self.rows)) - jnp.asarray(time) / ROW_PERIOD, 0.0, 1.0)
        return jnp.sum(after * jnp.sqrt(jnp.sum(steps**2, axis=1)))

    def follow(
        self,
        time: Float[Array, ""],
        pose: Float[Array, "3"],
        dt: Float[Array, ""] | float,
        preview: Float[Array, ""] | float = 0.0,
        arm: Float[Array, ""] | float = 0.0,
        sideways: Float[Array, ""] | float = 0.0,
    ) -> tuple[Float[Array, ""], Float[Array, "6"]]:
        """Return the time of the path one step later, and the reference at the new time.

        The reference consists of the pose at the new time and the rates `preview` [s] later, which
        are relative to the heading of that pose for a robot that cannot drive sideways.

        The path slows down, and its rates with it, while the robot's estimated `pose` lags behind
        the reference or is off to the side. A heading that lags counts as the distance that a point
        at the end of a lever `arm` [m] lags; with 0, for robots that drive sideways, headings do
        not count. The path does not wait for a robot that is ahead, nor for the first `sideways`
        [m] of a distance to the side. A `dt` [s] that is not a positive number counts as 0; time
        advances by at most `LONGEST_STEP`.
        """
        dt = jnp.asarray(dt, dtype=float)
        dt = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, LONGEST_STEP), 0.0)
        here = self.at(time)
        gap, v = here[:2] - pose[:2], here[3:5]
        ahead = jnp.stack([jnp.cos(here[2]), jnp.sin(here[2])])
        v = jnp.where(jnp.asarray(arm) > 0, (v @ ahead) * ahead, v)
        size = jnp.sqrt(v @ v + 1e-12)
        along = jnp.where(size > 1e-3, gap @ v / size, 0.0)
        beside = jnp.sqrt(jnp.maximum(gap @ gap - along**2, 0.0) + 1e-12)
        lag = jnp.maximum(along, 0.0) ** 2 + jnp.maximum(beside - sideways, 0.0) ** 2
        turn = here[2] - pose[2]
        turn = turn - 2 * jnp.pi * jnp.floor(turn / (2 * jnp.pi) + 0.5)
        turn = jnp.where(turn * here[5] < -1e-3 * jnp.abs(turn), 0.0, turn)
        off = jnp.sqrt(lag + (arm * turn) ** 2 + 1e-12)
        rate = jnp.clip((WAIT_M - off) / (WAIT_M - FULL_SPEED_M), 0.0, 1.0)
        time = jnp.asarray(time) + rate * dt
        here, later = self.at(time), self.at(time + preview)
        turn = jnp.where(jnp.asarray(arm) > 0, here[2] - later[2], 0.0)
        c, s = jnp.cos(turn), jnp.sin(turn)
        v = jnp.stack([c * later[3] - s * later[4], s * later[3] + c * later[4]])
        rates = rate * jnp.concatenate([v, later[5:]])
        return time, jnp.concatenate([here[:3], rates])

    def moved(self, start: Sequence[float]) -> "Path":
        """Move the path so that it begins at a pose (x, y [m], heading [rad])."""
        x, y, heading = (float(v) for v in start)
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, s], [-s, c]])
        rows = np.array(self.rows)
        rows[:, :2] = rows[:, :2] @ turn + [x, y]
        rows[:, 2] += heading
        rows[:, 3:5] = rows[:, 3:5] @ turn
        corners = np.asarray(self.corners).reshape(-1, 2) @ turn + [x, y]
        return Path(jnp.asarray(rows), self.marks, jnp.asarray(corners))

    def without_turning(self) -> "Path":
        """Return the path for a robot that drives in any direction and keeps its heading."""
        kept = np.asarray(self.rows) * [1, 1, 0, 1, 1, 0]
        return Path(jnp.asarray(kept), self.marks, self.corners)

    def after_rest(self, seconds: float) -> "Path":
        """Return the path preceded by a rest of `seconds` [s] at its start."""
        count, rows = round(seconds / ROW_PERIOD), np.asarray(self.rows)
        still = np.tile(rows[0] * [1, 1, 1, 0, 0, 0], (count, 1))
        marks = jnp.asarray(np.asarray(self.marks) + count * ROW_PERIOD)
        return Path(jnp.asarray(np.concatenate([still, rows])), marks, self.corners)


def waypoints(
    places: Sequence[Sequence[float]],
    speed: float = 0.2,
    acceleration: float = 0.5,
    pause: float = 0.6,
    turn: float = 0.0,
) -> Path:
    """Return a path of straight lines between way-points, with a stop at each way-point.

    Args:
        places: way-points x, y [m]; the path starts at the first one.
        speed: speed between stops [m/s].
        acceleration: acceleration at both ends of each line [m/s^2].
        pause: rest at every way-point after the start [s].
        turn: change of heading on each line [rad].

    Raises:
        ValueError: there are fewer than two way-points, two consecutive way-points are equal, or
            the speed or the acceleration is not positive.
    """
    _positive(speed, acceleration)
    p = np.asarray(places, float)
    if p.ndim != 2 or len(p) < 2 or p.shape[1] != 2:
        raise ValueError(f"way-points {p.tolist()}; expected at least two points x, y")
    parts, marks, time = [np.array([[*p[0], 0.0, 0.0, 0.0, 0.0]])], [], 0.0
    for k, (a, b) in enumerate(itertools.pairwise(p)):
        length = float(np.hypot(*(b - a)))
        if length < 1e-9:
            raise ValueError(
                f"way-point {b.tolist()} occurs twice in succession; expected consecutive "
                "way-points that differ"
            )
        distance, rate = _trapezoid(length, speed, acceleration, pause)
        line = np.array([*(b - a), turn]) / length
        parts.append(np.hstack([[*a, k * turn] + distance[:, None] * line, rate[:, None] * line]))
        time += len(distance) * ROW_PERIOD
        marks.append(time)
    rows = np.concatenate(parts)
    return Path(jnp.asarray(rows), jnp.asarray(marks), jnp.asarray(p[1:]))


def rectangle(
    length: float = 0.9, width: float = 0.4, speed: float = 0.2, turn: float = 0.0
) -> Path:
    """Return the path of the 2021 paper's trial (figure 7): ahead, to the right, back, to the left.

    Args:
        length: length of the sides driven ahead and back [m].
        width: length of the sides driven to the right and to the left [m].
        speed: speed on each side [m/s].
        turn: change of heading on each side [rad].
    """
    corners = [(0.0, 0.0), (length, 0.0), (length, -width), (0.0, -width), (0.0, 0.0)]
    return waypoints(corners, speed, turn=turn)


class PathSection(NamedTuple):
    """Part of a path whose curvature changes linearly with the distance: line, arc or clothoid.

    Attributes:
        length: length [m], negative if the robot drives in reverse.
        begin, end: curvature at both ends [1/m], positive to the left of a robot that drives ahead.
    """

    length: float
    begin: float = 0.0
    end: float = 0.0


class Turn(NamedTuple):
    """Turn on the spot by an angle [rad], positive to the left."""

    angle: float


Shape = Sequence[PathSection | Turn]
"""Sections of a path in the order in which they are driven."""


def arc(radius: float, angle: float) -> PathSection:
    """Return an arc of a `radius` [m] and an `angle` [rad], positive to the left."""
    bend = float(np.sign(angle)) / radius
    return PathSection(abs(angle) * radius, bend, bend)


def rectangle_shape(length: float = 0.9, width: float = 0.4, radius: float = 0.0) -> Shape:
    """Return the shape of `rectangle`, driven ahead and to the right.

    The `radius` [m] is that of the arcs at the corners; with 0 the robot turns on the spot there.

    Raises:
        ValueError: the arcs leave nothing of a side.
    """
    quarter = -0.5 * np.pi
    corner = arc(radius, quarter) if radius > 0 else Turn(quarter)
    sides = length - 2 * radius, width - 2 * radius
    if min(sides) <= 0:
        raise ValueError(
            f"arcs of radius {radius} m in a rectangle of {length} x {width} m; expected a radius "
            f"below {0.5 * min(length, width):g} m"
        )
    return [part for side in 2 * sides for part in (PathSection(side), corner)]


def clothoid_shape(radius: float = 0.2, side: float = 0.1) -> Shape:
    """Return the shape of a lap to the right whose curvature never jumps.

    Four lines of the length `side` [m] are joined by corners, on which the curvature grows linearly
    to that of the `radius` [m] and falls again.
    """
    half = 0.5 * np.pi * radius
    return 4 * [
        PathSection(side),
        PathSection(half, 0.0, -1 / radius),
        PathSection(half, -1 / radius, 0.0),
    ]


def tangent(
    shape: Shape,
    speed: float = 0.2,
    acceleration: float = 0.5,
    pause: float = 0.6,
    yaw_rate: float = 1.6,
    centre: float = 0.0,
) -> Path:
    """Return the path of a robot that does not drive sideways, from the origin, straight ahead.

    The point about which the robot turns follows the shape; it lies `centre` ahead of the middle of
    the robot, to which the path belongs. A turn moves the middle sideways unless `centre` is 0.

    The robot stops before and after a turn on the spot, where it changes between driving ahead and
    in reverse, and at the end; in between the speed changes by a trapezoidal profile. The robot
    drives more slowly up to the next stop where curvature times speed would exceed the yaw rate.
    The ramps of the yaw rate of a turn last as long as those of the speed. A path without stops has
    marks at the quarters of its length.

    Args:
        shape: sections of the path.
        speed: largest speed [m/s].
        acceleration: acceleration along the path [m/s^2].
        pause: rest at every stop [s].
        yaw_rate: largest yaw rate [rad/s].
        centre: distance of the centre of rotation ahead of the robot's middle [m].

    Raises:
        ValueError: the shape is empty or a section has no length; or the speed, the acceleration or
            the yaw rate is not positive.
    """
    _positive(speed, acceleration)
    if not yaw_rate > 0:
        raise ValueError(f"yaw rate {yaw_rate} rad/s; expected a positive number")
    if not shape or not all(part[0] for part in shape):
        raise ValueError(f"sections {list(shape)}; expected one or more, each longer than 0")
    rows, stops = np.zeros((1, 6)), list[int]()
    for (moves, ahead), alike in itertools.groupby(
        shape, lambda part: (isinstance(part, PathSection), part[0] > 0)
    ):
        parts = list(alike)
        size, sign = np.abs([part[0] for part in parts]), 1.0 if ahead else -1.0
        # a turn is like an arc of curvature 1 without motion
        bend = sign * np.array([part[1:] or (1.0, 1.0) for part in parts])
        top, most = (speed, acceleration) if moves else (yaw_rate, acceleration * yaw_rate / speed)
        top = min(top, yaw_rate / max(float(np.abs(bend).max()), 1e-9))
        at, rate = _trapezoid(float(size.sum()), top, most, pause)
        pose, slope = _along(at, size, bend.T, sign * moves, rows[-1, :3])
        rows = np.concatenate([rows, np.hstack([pose, rate[:, None] * slope])])
        stops += [len(rows) - 1] if moves else []
    if len(stops) == 1:
        driven = np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T))
        stops = [*np.searchsorted(driven, driven[-1] * np.array([0.25, 0.5, 0.75])) + 1, *stops]
    c, s, zero = np.cos(rows[:, 2]), np.sin(rows[:, 2]), np.zeros(len(rows))
    rows -= centre * np.stack([c - 1, s, zero, -s * rows[:, 5], c * rows[:, 5], zero], axis=1)
    marks = np.array(stops, int)
    corners = jnp.asarray(rows[marks, :2])
    return Path(jnp.asarray(rows), jnp.asarray(marks * ROW_PERIOD), corners)


SHAPES: Mapping[str, Callable[[float], Shape]] = {
    "rectangle": lambda scale: rectangle_shape(0.9 * scale, 0.4 * scale),
    "circle": lambda scale: [arc(0.35 * scale, -2 * np.pi)],
    "eight": lambda scale: [arc(0.25 * scale, -2 * np.pi), arc(0.25 * scale, 2 * np.pi)],
    "clothoid": lambda scale: clothoid_shape(0.2 * scale, 0.1 * scale),
}
"""Functions that return the shape of a path of `slipid trial` for a scale [1], keyed by the path's
name; robots that do not drive sideways follow it by `tangent`. Every path ends where it begins."""


def _without_turning(name: str) -> Callable[[float, float], Path]:
    """Return a function that returns a path of `PATHS` that is driven without turning."""

    def path(speed: float, scale: float = 1.0) -> Path:
        return tangent(SHAPES[name](scale), speed, yaw_rate=np.inf).without_turning()

    return path


PATHS: Mapping[str, Callable[..., Path]] = {
    "rectangle": lambda speed, scale=1.0: rectangle(0.9 * scale, 0.4 * scale, speed),
    **{name: _without_turning(name) for name in ("circle", "eight", "clothoid")},
    "turning": lambda speed, scale=1.0: rectangle(0.9 * scale, 0.4 * scale, speed, -0.5 * np.pi),
}
"""Functions that return a path of `slipid trial` for a robot that drives in any direction, for a
speed [m/s] and a scale [1], keyed by the path's name."""


def _along(
    at: Float[np.ndarray, " row"],
    size: Float[np.ndarray, " part"],
    bend: Float[np.ndarray, "2 part"],
    ahead: float,
    start: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "row 3"], Float[np.ndarray, "row 3"]]:
    """Return poses [m, m, rad] and their derivatives along a path at the distances `at`.

    The parts of the path have lengths `size` and a `bend`, the derivative of the heading, which
    changes linearly from its first to its second row. The robot drives `ahead` times the distance.
    """
    ends, growth = np.cumsum(size), (bend[1] - bend[0]) / size
    before = np.cumsum(size * bend.mean(axis=0)) - size * bend.mean(axis=0)

    def heading(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = np.minimum(np.searchsorted(ends, s), len(size) - 1)
        since = s - (ends - size)[k]
        turned = (bend[0, k] + 0.5 * growth[k] * since) * since
        return start[2] + before[k] + turned, bend[0, k] + growth[k] * since

    # the curvature is linear between two knots, so that few nodes integrate to rounding errors
    knots = np.union1d(np.append(at, 0.0), ends)
    nodes, weights = np.polynomial.legendre.leggauss(5)
    half = 0.5 * np.diff(knots)[:, None]
    moved = (np.exp(1j * heading(knots[:-1, None] + half * (1 + nodes))[0]) * half) @ weights
    place = ahead * np.append(0.0, np.cumsum(moved))[np.searchsorted(knots, at)]
    angle, slope = heading(at)
    pose = np.stack([start[0] + place.real, start[1] + place.imag, angle], axis=1)
    return pose, np.stack([ahead * np.cos(angle), ahead * np.sin(angle), slope], axis=1)


def _positive(speed: float, acceleration: float) -> None:
    """Raise `ValueError` unless speed and acceleration are both positive."""
    if not (speed > 0 and acceleration > 0):
        raise ValueError(
            f"speed {speed} m/s, acceleration {acceleration} m/s^2; expected positive numbers"
        )


def _trapezoid(
    length: float, speed: float, acceleration: float, pause: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return distance [m] and speed [m/s] over time on a line of this `length` [m], with a rest.

    Rows are `ROW_PERIOD` apart, from one period after the start. The speed rises, stays constant
    and falls (trapezoidal profile); then the robot rests for `pause` [s].
    """
    top = min(speed, float(np.sqrt(length * acceleration)))
    ramp = top / acceleration
    whole = length / top + ramp
    t = np.arange(1, int(np.ceil((whole + pause) / ROW_PERIOD)) + 1) * ROW_PERIOD
    up, down = np.minimum(t, ramp), np.clip(t - (whole - ramp), 0.0, ramp)
    level = np.clip(t - ramp, 0.0, whole - 2 * ramp)
    distance = 0.5 * acceleration * up**2 + top * level + top * down - 0.5 * acceleration * down**2
    rate = np.where(t < whole, acceleration * up - acceleration * down, 0.0)
    return np.minimum(distance, length), rate
