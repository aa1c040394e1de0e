"""Paths in time: where the robot should be and how fast, and when to wait for it."""

import itertools
from collections.abc import Sequence

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
        marks: times at which a side ends, the robot having had time to settle [s].
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
) -> Path:
    """Straight from place to place with a stop at each, without turning.

    Args:
        places: x, y [m], the first one is where it starts.
        speed: between stops [m/s]; acceleration: [m/s^2].
        pause: at every place [s].

    Raises:
        ValueError: fewer than two places, neighbours that are the same, or a speed or acceleration
            that is not positive.
    """
    if not (speed > 0 and acceleration > 0):
        raise ValueError(f"speed {speed}, acceleration {acceleration}; expected both positive")
    p = np.asarray(places, float)
    if p.ndim != 2 or len(p) < 2 or p.shape[1] != 2:
        raise ValueError(f"way-points {p.tolist()}; expected two or more places x, y")
    parts, marks, time = [np.array([[*p[0], 0.0, 0.0, 0.0, 0.0]])], [], 0.0
    for a, b in itertools.pairwise(p):
        far = float(np.hypot(*(b - a)))
        if far < 1e-9:
            raise ValueError(f"way-point {b.tolist()} twice in a row; expected another place")
        gone, pace = _trapezoid(far, speed, acceleration, pause)
        u = (b - a) / far
        still = np.zeros((len(gone), 1))
        parts.append(np.hstack([a + gone[:, None] * u, still, pace[:, None] * u, still]))
        time += len(gone) * STEP
        marks.append(time)
    rows = np.concatenate(parts)
    return Path(jnp.asarray(rows), jnp.asarray(marks), jnp.asarray(p[1:]))


def rectangle(length: float = 0.9, width: float = 0.4, speed: float = 0.2) -> Path:
    """The 2021 paper's trial (figure 7): ahead, to the right, back, to the left [m], [m/s]."""
    corners = [(0.0, 0.0), (length, 0.0), (length, -width), (0.0, -width), (0.0, 0.0)]
    return waypoints(corners, speed)


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
