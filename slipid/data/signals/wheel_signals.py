"""Signals of one run: steps of motion, speeds from angles, stalls of the telemetry, the start."""

import numpy as np
from jaxtyping import Bool, Float


def interpolate(
    time: Float[np.ndarray, " time"],
    values: Float[np.ndarray, " time"] | Float[np.ndarray, "time column"],
    at: Float[np.ndarray, " at"],
) -> Float[np.ndarray, " at"] | Float[np.ndarray, "at column"]:
    """Values at other times [s], linear in between, constant beyond both ends.

    Angles have to be without wrap-around.
    """
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    before = after - 1
    share = np.clip((at - time[before]) / (time[after] - time[before]), 0.0, 1.0)
    share = share.reshape(-1, *([1] * (values.ndim - 1)))
    return values[before] + share * (values[after] - values[before])


def integral(
    time: Float[np.ndarray, " time"], rate: Float[np.ndarray, "time column"]
) -> Float[np.ndarray, "time column"]:
    """Integral of each column from the first row on, by trapezoids; the first row is 0."""
    areas = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(areas, axis=0)])


def step_edges(time: Float[np.ndarray, " time"], step: float = 0.5) -> Float[np.ndarray, " edge"]:
    """Edges of equal steps [s], long enough that delays and jitter do not matter."""
    count = max(2, int((time[-1] - time[0]) / step) + 1)
    return np.linspace(time[0], time[-1], count)


def integrated_steps(
    time: Float[np.ndarray, " time"],
    rate: Float[np.ndarray, "time column"],
    edges: Float[np.ndarray, " edge"],
) -> Float[np.ndarray, "step column"]:
    """Integral of a rate over each step."""
    return np.diff(interpolate(time, integral(time, rate), edges), axis=0)


def body_steps(pose: Float[np.ndarray, "row 3"]) -> Float[np.ndarray, "step 3"]:
    """Increments ahead [m], to the left [m] and in heading [rad] between rows of a pose.

    They are in the body's axes halfway through each step: turned back by the mean heading.
    """
    middle = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    dx, dy, turn = np.diff(pose, axis=0).T
    ahead = np.cos(middle) * dx + np.sin(middle) * dy
    left = np.cos(middle) * dy - np.sin(middle) * dx
    return np.stack([ahead, left, turn], axis=1)


def bridge_stalls(
    time: Float[np.ndarray, " time"],
    wheel_angle: Float[np.ndarray, "time wheel"],
    min_rows: int = 3,
) -> tuple[Float[np.ndarray, "time wheel"], Bool[np.ndarray, " time"]]:
    """Wheel angle with stalls of the telemetry bridged, and the rows in which it was stalled.

    A stall is a stretch in which no wheel's angle changes and that ends in one step as large as the
    motion missed: the radio froze, not the wheels. The angle is made linear across it; speeds and
    currents reported in the marked rows are as stale as the angle was.

    Args:
        min_rows: steps without change from which a stretch can be a stall.
    """
    stalled = np.zeros(len(time), dtype=bool)
    step = np.abs(np.diff(wheel_angle, axis=0)).max(axis=1, initial=0.0)
    if not step.any():
        return wheel_angle, stalled
    usual = float(np.median(step[step > 0]))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], step == 0, [0]]).astype(np.int8)))
    bridged = wheel_angle
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        # Rows start..end hold the same angle; row end + 1 is the burst.
        if end - start < min_rows or end == len(step) or start == 0:
            continue
        if step[end] < 0.5 * (end - start + 1) * min(usual, step[start - 1]):
            continue
        if bridged is wheel_angle:
            bridged = wheel_angle.copy()
        inside = slice(start + 1, end + 1)
        ends = np.array([start, end + 1])
        bridged[inside] = interpolate(time[ends], wheel_angle[ends], time[inside])
        stalled[inside] = True
    return bridged, stalled


MOVED = 0.010
"""A run counts from where the fastest wheel's rim has moved this far [m]."""


def first_moved(
    wheel_angle: Float[np.ndarray, "time wheel"], radius: float, distance: float = MOVED
) -> int | None:
    """First row by which some wheel's rim has moved the distance [m]; None where none ever does."""
    rim = radius * np.abs(wheel_angle - wheel_angle[:1]).max(axis=1, initial=0.0)
    moved = np.flatnonzero(rim >= distance)
    return int(moved[0]) if len(moved) else None
