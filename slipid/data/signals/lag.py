"""How far the camera is behind the encoders, with an honest standard error."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.signals.wheel_signals import body_steps, integral, interpolate


class Lag(NamedTuple):
    """How far one signal is behind another [s], with its standard error."""

    value: float
    std: float


def camera_lag(
    time: Float[np.ndarray, " time"],
    wheel_angle: Float[np.ndarray, "time wheel"],
    pose: Float[np.ndarray, "time 3"],
    pose_fresh: Bool[np.ndarray, " time"],
    rim_to_twist: Float[np.ndarray, "3 wheel"],
    *,
    window: float = 0.25,
    largest: float = 0.3,
) -> Lag:
    """Time by which the camera is behind the encoders, from the body's velocity seen by both.

        v_camera(t) = G v_wheels(t - lag) + error

    Both velocities are smoothed by the same triangle of two windows' width, without which the
    jitter of the encoders hides the lag. G is 2 x 2 and fitted along, so that slip, scale and a
    turned marker do not matter. The lag is found on a grid and refined by Gauss-Newton; its error
    allows for errors that hang together over a second (jackknife over blocks), as slip does. Only
    starts, stops and changes of direction tell anything: a run at constant speed gives a large or
    infinite standard error, not a wrong number. What is found includes the body's own delay where
    it slips while it gathers speed.

    Args:
        time: [s].
        wheel_angle: [rad].
        pose: x [m], y [m], heading [rad].
        pose_fresh: rows that hold a new camera frame.
        rim_to_twist: maps wheel speeds [rad/s] to the body twist: r pinv(J).
        window: [s]; longer than the jitter of the encoders.
        largest: [s] searched on both sides of 0.

    Raises:
        ValueError: too few frames, or nothing moves.
    """
    reach = largest + window
    wheels = wheel_angle @ rim_to_twist[:2].T
    frames, camera = time[pose_fresh], _body_path(pose[pose_fresh])
    # Before a run that begins at rest nothing moved either: its start, which tells most, is used.
    early = wheel_angle[np.searchsorted(time, time[0] + 0.05)] - wheel_angle[0]
    if float(np.abs(early).max(initial=0.0)) < 0.02:
        time, wheels = _held_before(time, wheels, 2.0 * reach)
        frames, camera = _held_before(frames, camera, 2.0 * reach)
    at = frames[(frames >= time[0] + reach) & (frames + reach <= min(time[-1], frames[-1]))]
    if len(at) < 10:
        raise ValueError(f"{len(at)} camera frames inside; expected at least 10 to find a lag")
    seen = _smooth_velocity(frames, integral(frames, camera), at, window)
    area = integral(time, wheels)

    def driven(lag: float) -> np.ndarray:
        return _smooth_velocity(time, area, at - lag, window)

    if not (np.abs(driven(0.0)).max() > 1e-6 and np.abs(seen).max() > 1e-6):
        raise ValueError("nothing moves; expected motion to find a lag in")

    def fitted(lag: float) -> tuple[np.ndarray, np.ndarray]:
        """The four gains, and what they leave over."""
        wheel = driven(lag)
        gains = np.linalg.lstsq(wheel, seen, rcond=None)[0]
        return gains, seen - wheel @ gains

    def linearised(lag: float) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the prediction by lag and the four gains, and what is left over."""
        gains, left_over = fitted(lag)
        design = np.zeros((len(at), 2, 5))
        design[:, :, 0] = (driven(lag + 0.01) - driven(lag - 0.01)) / 0.02 @ gains
        design[:, 0, 1:3] = design[:, 1, 3:5] = driven(lag)
        return design.reshape(-1, 5), left_over.ravel()

    slope, *_ = linearised(0.0)
    told = slope[:, 0] - slope[:, 1:] @ np.linalg.lstsq(slope[:, 1:], slope[:, 0], rcond=None)[0]
    if np.abs(told).max() < 1e-6 * np.abs(seen).max():
        return Lag(0.0, float("inf"))
    grid = np.linspace(-largest, largest, 31)
    lag = float(grid[np.argmin([np.sum(fitted(g)[1] ** 2) for g in grid])])
    for _ in range(6):
        change = np.linalg.lstsq(*linearised(lag), rcond=None)[0][0]
        lag = float(np.clip(lag + np.clip(change, -0.02, 0.02), -largest, largest))
    design, left_over = linearised(lag)
    return Lag(lag, _jackknife_std(design, left_over, np.repeat(np.floor(at - at[0]), 2)))


def _jackknife_std(design: np.ndarray, left_over: np.ndarray, block: np.ndarray) -> float:
    """Standard error of the first coefficient, from leaving out one block of rows at a time.

    A sandwich would not do: where one start holds all the information, the fit has made the score
    of its block vanish, and the sandwich with it.
    """
    starts = np.flatnonzero(np.diff(block, prepend=-1.0))
    outer = np.add.reduceat(design[:, :, None] * design[:, None, :], starts, axis=0)
    scores = np.add.reduceat(design * left_over[:, None], starts, axis=0)
    shifts = np.linalg.pinv(design.T @ design - outer) @ scores[:, :, None]
    return float(np.sqrt(np.sum(shifts[:, 0, 0] ** 2)))


def _body_path(pose: np.ndarray) -> np.ndarray:
    """Sum of the steps between frames, each in the body's own axes."""
    return np.concatenate([np.zeros((1, 2)), np.cumsum(body_steps(pose)[:, :2], axis=0)])


def _held_before(
    time: np.ndarray, values: np.ndarray, duration: float
) -> tuple[np.ndarray, np.ndarray]:
    return np.append(time[0] - duration, time), np.concatenate([values[:1], values])


def _smooth_velocity(
    time: np.ndarray, area: np.ndarray, at: np.ndarray, window: float
) -> np.ndarray:
    """Velocity averaged twice over the window: second difference of the path's integral."""
    after, here, before = (interpolate(time, area, at + s) for s in (window, 0.0, -window))
    return (after - 2.0 * here + before) / window**2
