"""Paths over time: reference poses and rates, whose time stops while the robot lags behind."""

import itertools
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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
    ) -> tuple[Float[Array, ""], Float[Array, "6"]]:
        """Return the time of the path one step later, and the reference at the new time.

        The reference consists of the pose at the new time and the rates `preview` [s] later.

        The path slows down, and its rates with it, while the robot's estimated `pose` lags behind
        the reference or is off to the side; the path does not wait for a robot that is ahead. A
        `dt` [s] that is not a positive number counts as 0; time advances by at most `LONGEST_STEP`.
        """
        dt = jnp.asarray(dt, dtype=float)
        dt = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, LONGEST_STEP), 0.0)
        here = self.at(time)
        gap, v = here[:2] - pose[:2], here[3:5]
        size = jnp.sqrt(v @ v + 1e-12)
        ahead = jnp.minimum(gap @ v / size, 0.0)
        off = jnp.sqrt(
            jnp.maximum(gap @ gap - jnp.where(size > 1e-3, ahead, 0.0) ** 2, 0.0) + 1e-12
        )
        rate = jnp.clip((WAIT_M - off) / (WAIT_M - FULL_SPEED_M), 0.0, 1.0)
        time = jnp.asarray(time) + rate * dt
        rates = self.at(time + preview)[3:] * rate
        return time, jnp.concatenate([self.at(time)[:3], rates])

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


def curve(
    places: Sequence[Sequence[float]] | Float[np.ndarray, "place 2"],
    speed: float = 0.2,
    acceleration: float = 0.5,
    pause: float = 0.6,
) -> Path:
    """Return a smooth path that is driven without turning and with a stop only at its end.

    Args:
        places: points x, y on the curve [m]; they must be dense, since straight lines connect them.
        speed: speed along the curve [m/s].
        acceleration: acceleration at both ends of the curve [m/s^2].
        pause: rest at the curve's end [s].

    Raises:
        ValueError: there are fewer than two points, two consecutive points are equal, or the speed
            or the acceleration is not positive.
    """
    _positive(speed, acceleration)
    p = np.asarray(places, float)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))])
    if len(p) < 2 or np.diff(length).min() < 1e-9:
        raise ValueError(
            f"curve of {len(p)} points, or with equal consecutive points; expected two or more "
            "points, each different from the previous point"
        )
    distance, rate = _trapezoid(float(length[-1]), speed, acceleration, pause)
    distance, rate = np.append(0.0, distance), np.append(0.0, rate)
    place = np.stack([np.interp(distance, length, x) for x in p.T], axis=1)
    slope = np.stack([np.interp(distance, length, np.gradient(x, length)) for x in p.T], axis=1)
    still = np.zeros((len(distance), 1))
    quarters = np.searchsorted(distance, length[-1] * np.array([0.25, 0.5, 0.75]))
    at = np.append(quarters, len(distance) - 1)
    rows = np.hstack([place, still, rate[:, None] * slope, still])
    return Path(jnp.asarray(rows), jnp.asarray(at * ROW_PERIOD), jnp.asarray(place[at]))


def circle(radius: float = 0.35, speed: float = 0.2) -> Path:
    """Return a full circle to the right, driven without turning; `radius` [m], `speed` [m/s]."""
    return curve(_round(radius), speed)


def eight(radius: float = 0.25, speed: float = 0.2) -> Path:
    """Return a circle to the right, then one to the left, driven without turning.

    `radius` is in [m], `speed` in [m/s].
    """
    right = _round(radius)
    return curve(np.concatenate([right, right[1:] * [1.0, -1.0]]), speed)


def turning(speed: float = 0.2) -> Path:
    """Return the 2021 paper's rectangle with a quarter turn to the right on each side.

    `speed` is in [m/s].
    """
    return rectangle(speed=speed, turn=-0.5 * np.pi)


PATHS: Mapping[str, Callable[[float], Path]] = {
    "rectangle": lambda speed: rectangle(speed=speed),
    "circle": lambda speed: circle(speed=speed),
    "eight": lambda speed: eight(speed=speed),
    "turning": turning,
}
"""Functions that return a path of `slipid trial` for a speed [m/s], keyed by the path's name."""


def _round(radius: float) -> Float[np.ndarray, "place 2"]:
    """Return points of a circle to the right that begins at the origin, straight ahead [m]."""
    angle = np.linspace(0.0, 2 * np.pi, 721)
    return radius * np.stack([np.sin(angle), np.cos(angle) - 1.0], axis=1)


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
