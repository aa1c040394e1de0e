"""The sanity check of a robot that steers: its wheels and its steering angle against the poses."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from slipid.data.align.lag import pose_lag
from slipid.data.check.findings import (
    LEAST_TURN_RAD,
    ROUNDING_RAD,
    Finding,
    heading_constant,
)
from slipid.data.runs import Runs
from slipid.data.wheel_signals import body_steps, integral, interpolate
from slipid.model.geometry import Geometry

STEP_S = 0.2
"""Shortest duration of the compared pose increments [s]."""
LEAST_CORRELATION = 0.5
"""Smallest magnitude of the correlation of two motions at which their ratio is judged [1]."""
NATURAL = 0.67, 1.5
"""Range of the ratio of the poses' motion to that of wheels and steering without a finding [1]."""


def steered_findings(data: Runs, shape: Geometry) -> Iterator[Finding]:
    """Yield findings about wheels and steering angle, from their ratios to the poses' motion."""
    lag = pose_lag(data)
    late = lag.seconds if lag is not None and lag.decisive else 0.0
    parts = [_motions(data, run, shape, late) for run in range(len(data))]
    spans = [np.ptp(np.cumsum(part[:, 1::2], axis=0), axis=0) for part in parts if len(part)]
    logged, expected = np.max(np.reshape(spans, (-1, 2)), axis=0, initial=0.0)
    if logged < ROUNDING_RAD and expected > LEAST_TURN_RAD:
        yield heading_constant(float(expected), [log.name for log in data.logs], len(data))
        return
    ahead, turned, rolled, steered = np.concatenate(parts).T
    travel, turning = _ratio(ahead, rolled), _ratio(turned, steered)
    if turning is not None and travel is not None:
        turning = turning / travel
    if travel is None:
        yield _not_checked("the poses do not follow the wheels, or no run drives ahead")
    elif travel < 0:
        yield Finding(
            "wheel_sign",
            "the wheels roll in the opposite direction of the poses' motion ahead",
            "reverse the sign of scale for the channel of the wheels, or add 180 deg to the offset "
            "of the channel pose_heading",
        )
    elif not NATURAL[0] < travel < NATURAL[1]:
        yield Finding(
            "wheel_scale",
            f"the body moves {travel:.3g} times as far as the wheels roll",
            "check wheel_radius_m, gear_ratio, ticks_per_revolution and the unit of the poses",
        )
    if turning is None:
        yield _not_checked("the poses do not turn with the steering angle, or no run turns")
    elif turning < 0:
        yield Finding(
            "steering_sign",
            "the robot turns to the right where the steering angle points to the left",
            "reverse the sign of scale for the channel steering_angle (positive is to the left), "
            "or for the channel pose_heading if its angles grow clockwise",
        )
    elif not NATURAL[0] < turning < NATURAL[1]:
        yield Finding(
            "steering_scale",
            f"the body turns {turning:.3g} times as fast as steering angle and wheelbase say",
            "check wheelbase_m, and the unit of steering_angle, which is that of the wheel, not of "
            "the servo or the steering column (scale = angle of the wheel over the logged one)",
        )


def _motions(data: Runs, run: int, shape: Geometry, late: float) -> Float[np.ndarray, "step 4"]:
    """Return motions in steps of a run: ahead [m] and turned [rad] by the poses, then by wheels.

    `late` is the lag of the poses [s].
    """
    rows = data.rows(run)
    time, at = data.time[rows], np.flatnonzero(data.fresh[rows])
    at = at[np.isfinite(data.pose[rows][at]).all(axis=1)]
    if len(at) < 2 or data.steering is None:
        return np.zeros((0, 4))
    usual = max(float(np.median(np.diff(time[at]))), 1e-6)
    at = at[:: max(1, int(np.ceil(STEP_S / usual - 1e-6)))]
    rolled = float(shape.wheel_radius) * data.wheel_angle[rows].mean(axis=1)
    angle = data.steering[rows]
    if shape.driven == "front":
        rolled = integral(rolled, np.cos(angle)[:, None])[:, 0]
    turned = integral(rolled, np.tan(angle)[:, None]) / float(shape.base_radius)
    there = interpolate(time, np.column_stack([rolled, turned]), time[at] - late)
    moved = body_steps(data.pose[rows][at])[:, [0, 2]]
    return np.concatenate([moved, np.diff(there, axis=0)], axis=1)


def _ratio(
    moved: Float[np.ndarray, " step"], predicted: Float[np.ndarray, " step"]
) -> float | None:
    """Return the ratio of two motions, or None if they are hardly correlated."""
    both, square = float(moved @ predicted), float(predicted @ predicted)
    size = float(np.sqrt((moved @ moved) * square))
    return both / square if size > 0 and abs(both) > LEAST_CORRELATION * size else None


def _not_checked(why: str) -> Finding:
    """Return the note that something was not checked."""
    return Finding("not_checked", why, None, "note")
