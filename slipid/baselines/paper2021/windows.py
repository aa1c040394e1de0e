"""Current and slip of every wheel over short windows of a run, against the overhead camera."""

from dataclasses import dataclass

import numpy as np

from slipid.data.log import Log
from slipid.data.signals.steps import body_steps
from slipid.data.signals.wheel_signals import first_moved


@dataclass(frozen=True)
class WindowRecipe:
    """How a run is cut into samples; the defaults are the 2021 recipe carried to full logs.

    Args:
        wheel_radius: r [m].
        base_radius: L [m].
        azimuth_deg: wheel centres seen from the body's x axis [deg].
        window: length of one sample [s], a row of the 2021 files.
        moved: rim travel after which a run counts as under way [m].
        min_speed: windows in which a wheel's rim is slower have no slip ratio there [m/s].
        pose_scale: metres per logged metre of the camera [-]; 1 leaves it uncorrected.
    """

    wheel_radius: float = 0.040
    base_radius: float = 0.125
    azimuth_deg: tuple[float, ...] = (60.0, 180.0, 300.0)
    window: float = 0.5
    moved: float = 0.010
    min_speed: float = 0.0
    pose_scale: float = 1.0


def wheel_windows(log: Log, recipe: WindowRecipe) -> tuple[np.ndarray, np.ndarray]:
    """Mean current and slip of every wheel over a log's windows, nothing cut away.

    s = 1 - J v / (r w), v the camera's body velocity over the window, w the encoders' mean speed.

    Returns:
        |current| [A] and slip [-], both (window, wheel); slip is not finite where a wheel rests.

    Raises:
        ValueError: if the log has no pose or no current.
    """
    if log.pose is None or log.current is None:
        raise ValueError(f"{log.name}: slip against current needs both pose and current")
    edges = _edges(log, recipe)
    if len(edges) < 2:
        return np.empty((0, log.wheels)), np.empty((0, log.wheels))
    span = np.diff(log.time[edges])[:, None]
    azimuth = np.radians(recipe.azimuth_deg)
    arm = np.full(len(azimuth), recipe.base_radius)
    rim = np.stack([-np.sin(azimuth), np.cos(azimuth), arm], axis=1)
    steps = body_steps(log.pose[edges]) * [recipe.pose_scale, recipe.pose_scale, 1.0]
    effective = steps / span @ rim.T
    driven = np.diff(log.wheel_angle[edges], axis=0) / span * recipe.wheel_radius
    # Mean over the rows of each window, not the value at its edge: the current is 10-bit and rough.
    current = np.add.reduceat(np.abs(log.current), edges, axis=0)[:-1] / np.diff(edges)[:, None]
    moving = np.abs(driven) > recipe.min_speed
    slip = np.full_like(driven, np.nan)
    np.divide(effective, driven, out=slip, where=moving)
    return current, 1.0 - slip


def _edges(log: Log, recipe: WindowRecipe) -> np.ndarray:
    first = first_moved(log.wheel_angle, recipe.wheel_radius, recipe.moved)
    if first is None:
        return np.empty(0, dtype=int)
    starts = np.arange(log.time[first], log.time[-1], recipe.window)
    # unique: where rows are further apart than a window, two windows would begin at the same row
    return np.unique(np.searchsorted(log.time, starts))
