"""Paths in time: where the robot should be and how fast, and when to wait for it."""

import itertools
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

STEP = 0.02
"""Between rows of a path [s]."""
PATIENT, LOST = 0.02, 0.12
"""Distance from the reference up to which it goes on, and from which it waits [m]."""
LONGEST = 0.5
"""Time step beyond which a path does not run ahead of its robot [s]."""


class Path(eqx.Module):
    """Pose and twist in the world over a path's own time, which waits for a robot that lags.

    Attributes:
        rows: x, y [m], heading [rad], their rates [m/s, m/s, rad/s], a row every `STEP`.
        marks: times at which a side ends, the robot having had time to settle, or a quarter of a
            curve [s].
        corners: where it then should be (mark, 2) [m].
    """

    rows: Float[Array, "row 6"]
    marks: Float[Array, " mark"]
    corners: Float[Array, "mark 2"]

    @property
    def duration(self) -> float:
        """Own time of the path [s]."""
        return (len(self.rows) - 1) * STEP

    def at(self, time: Float[Array, ""] | float) -> Float[Array, "6"]:
        """Pose and rates at a time of the path; beyond its ends, at rest there."""
        place = jnp.clip(jnp.asarray(time) / STEP, 0.0, len(self.rows) - 1.000001)
        low = jnp.floor(place).astype(jnp.int32)
        high, part = jnp.minimum(low + 1, len(self.rows) - 1), place - low
        return (1 - part) * self.rows[low] + part * self.rows[high]

    def left(self, time: Float[Array, ""] | float) -> Float[Array, ""]:
        """Way that is left at a time of the path [m]."""
        steps = jnp.diff(self.rows[:, :2], axis=0)
        after = jnp.clip(jnp.arange(1, len(self.rows)) - jnp.asarray(time) / STEP, 0.0, 1.0)
        return jnp.sum(after * jnp.sqrt(jnp.sum(steps**2, axis=1)))

    def follow(
        self,
        time: Float[Array, ""],
        pose: Float[Array, "3"],
        dt: Float[Array, ""] | float,
        preview: Float[Array, ""] | float = 0.0,
    ) -> tuple[Float[Array, ""], Float[Array, "6"]]:
        """Time of the path one step later, and the reference there for a robot at a pose.

        The pose is that of this time, the rates are those `preview` later [s].

        The path slows down, and its rates with it, while the robot is believed to lag behind or
        beside it; one that is ahead is no reason to wait. Where dt is no positive number, no time
        has passed; it moves on by `LONGEST` at most.
        """
        dt = jnp.asarray(dt, dtype=float)
        dt = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, LONGEST), 0.0)
        here = self.at(time)
        gap, v = here[:2] - pose[:2], here[3:5]
        size = jnp.sqrt(v @ v + 1e-12)
        ahead = jnp.minimum(gap @ v / size, 0.0)
        off = jnp.sqrt(
            jnp.maximum(gap @ gap - jnp.where(size > 1e-3, ahead, 0.0) ** 2, 0.0) + 1e-12
        )
        pace = jnp.clip((LOST - off) / (LOST - PATIENT), 0.0, 1.0)
        time = jnp.asarray(time) + pace * dt
        rates = self.at(time + preview)[3:] * pace
        return time, jnp.concatenate([self.at(time)[:3], rates])

    def moved(self, start: Sequence[float]) -> "Path":
        """The path as it lies for a robot that starts at a pose (x, y [m], heading [rad])."""
        x, y, heading = (float(v) for v in start)
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, s], [-s, c]])
        rows = np.array(self.rows)
        rows[:, :2] = rows[:, :2] @ turn + [x, y]
        rows[:, 2] += heading
        rows[:, 3:5] = rows[:, 3:5] @ turn
        corners = np.asarray(self.corners).reshape(-1, 2) @ turn + [x, y]
        return Path(jnp.asarray(rows), self.marks, jnp.asarray(corners))

    def waiting(self, seconds: float) -> "Path":
        """The path after so long a rest at its start."""
        count = round(seconds / STEP)
        still = jnp.broadcast_to(self.rows[0].at[3:].set(0.0), (count, 6))
        return Path(jnp.concatenate([still, self.rows]), self.marks + count * STEP, self.corners)


def waypoints(
    places: Sequence[Sequence[float]],
    speed: float = 0.2,
    acceleration: float = 0.5,
    pause: float = 0.6,
    turn: float = 0.0,
) -> Path:
    """Straight from place to place with a stop at each.

    Args:
        places: x, y [m], the first one is where it starts.
        speed: between stops [m/s]; acceleration: [m/s^2].
        pause: at every place [s].
        turn: by which it turns on the way to each place [rad].

    Raises:
        ValueError: fewer than two places, neighbours that are the same, or a speed or acceleration
            that is not positive.
    """
    _positive(speed, acceleration)
    p = np.asarray(places, float)
    if p.ndim != 2 or len(p) < 2 or p.shape[1] != 2:
        raise ValueError(f"way-points {p.tolist()}; expected two or more places x, y")
    parts, marks, time = [np.array([[*p[0], 0.0, 0.0, 0.0, 0.0]])], [], 0.0
    for k, (a, b) in enumerate(itertools.pairwise(p)):
        far = float(np.hypot(*(b - a)))
        if far < 1e-9:
            raise ValueError(f"way-point {b.tolist()} twice in a row; expected another place")
        gone, pace = _trapezoid(far, speed, acceleration, pause)
        way = np.array([*(b - a), turn]) / far
        parts.append(np.hstack([[*a, k * turn] + gone[:, None] * way, pace[:, None] * way]))
        time += len(gone) * STEP
        marks.append(time)
    rows = np.concatenate(parts)
    return Path(jnp.asarray(rows), jnp.asarray(marks), jnp.asarray(p[1:]))


def rectangle(
    length: float = 0.9, width: float = 0.4, speed: float = 0.2, turn: float = 0.0
) -> Path:
    """The 2021 paper's trial (figure 7): ahead, to the right, back, to the left [m], [m/s].

    The robot turns by `turn` on each side [rad].
    """
    corners = [(0.0, 0.0), (length, 0.0), (length, -width), (0.0, -width), (0.0, 0.0)]
    return waypoints(corners, speed, turn=turn)


def curve(
    places: Sequence[Sequence[float]] | Float[np.ndarray, "place 2"],
    speed: float = 0.2,
    acceleration: float = 0.5,
    pause: float = 0.6,
) -> Path:
    """Along a smooth line without turning and without a stop, at rest in the end.

    Args:
        places: x, y [m], dense enough that straight lines between them are the curve.
        speed: along it [m/s]; acceleration: at its ends [m/s^2].
        pause: at its end [s].

    Raises:
        ValueError: fewer than two places, neighbours that are the same, or a speed or acceleration
            that is not positive.
    """
    _positive(speed, acceleration)
    p = np.asarray(places, float)
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))])
    if len(p) < 2 or np.diff(far).min() < 1e-9:
        raise ValueError("a curve's places; expected two or more, each another than the last")
    gone, pace = _trapezoid(float(far[-1]), speed, acceleration, pause)
    gone, pace = np.append(0.0, gone), np.append(0.0, pace)
    place = np.stack([np.interp(gone, far, x) for x in p.T], axis=1)
    rate = np.stack([np.interp(gone, far, np.gradient(x, far)) for x in p.T], axis=1)
    still = np.zeros((len(gone), 1))
    quarters = np.searchsorted(gone, far[-1] * np.array([0.25, 0.5, 0.75]))
    at = np.append(quarters, len(gone) - 1)
    rows = np.hstack([place, still, pace[:, None] * rate, still])
    return Path(jnp.asarray(rows), jnp.asarray(at * STEP), jnp.asarray(place[at]))


def circle(radius: float = 0.35, speed: float = 0.2) -> Path:
    """Once round to the right, without turning [m], [m/s]."""
    return curve(_round(radius), speed)


def eight(radius: float = 0.25, speed: float = 0.2) -> Path:
    """A circle to the right and one to the left, without turning [m], [m/s]."""
    right = _round(radius)
    return curve(np.concatenate([right, right[1:] * [1.0, -1.0]]), speed)


def turning(speed: float = 0.2) -> Path:
    """The 2021 paper's rectangle, turning by a quarter to the right on each side [m/s]."""
    return rectangle(speed=speed, turn=-0.5 * np.pi)


PATHS: Mapping[str, Callable[[float], Path]] = {
    "rectangle": lambda speed: rectangle(speed=speed),
    "circle": lambda speed: circle(speed=speed),
    "eight": lambda speed: eight(speed=speed),
    "turning": turning,
}
"""Of a trial, by name, at a speed [m/s]."""


def _round(radius: float) -> Float[np.ndarray, "place 2"]:
    """Places of a circle to the right that begins ahead [m]."""
    angle = np.linspace(0.0, 2 * np.pi, 721)
    return radius * np.stack([np.sin(angle), np.cos(angle) - 1.0], axis=1)


def _positive(speed: float, acceleration: float) -> None:
    if not (speed > 0 and acceleration > 0):
        raise ValueError(f"speed {speed}, acceleration {acceleration}; expected both positive")


def _trapezoid(
    far: float, speed: float, acceleration: float, pause: float
) -> tuple[np.ndarray, np.ndarray]:
    """Distance and speed every `STEP` on a straight line with a rest at its end."""
    top = min(speed, float(np.sqrt(far * acceleration)))
    ramp = top / acceleration
    whole = far / top + ramp
    t = np.arange(1, int(np.ceil((whole + pause) / STEP)) + 1) * STEP
    up, down = np.minimum(t, ramp), np.clip(t - (whole - ramp), 0.0, ramp)
    level = np.clip(t - ramp, 0.0, whole - 2 * ramp)
    gone = 0.5 * acceleration * up**2 + top * level + top * down - 0.5 * acceleration * down**2
    pace = np.where(t < whole, acceleration * up - acceleration * down, 0.0)
    return np.minimum(gone, far), pace
