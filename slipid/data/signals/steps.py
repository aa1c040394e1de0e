"""Motion in steps: integrals of rates, and increments of the pose in the body's own axes."""

import numpy as np
from jaxtyping import Float

from slipid.data.signals.wheel_signals import interpolate


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
