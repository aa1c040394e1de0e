"""Does one curve of slip over current carry over to a surface unseen? The 2022 runs tell."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slipid.baselines.paper2021.samples import FIGURES_3_AND_4, Recipe
from slipid.data.log import Log
from slipid.data.wheel_signals import body_steps, first_moved
from slipid.identify.compare.transfer import errors_by_floor


@dataclass(frozen=True)
class Transfer:
    """Error in slip [-] on each surface, from three sources of a prediction.

    Args:
        samples: number of them per surface.
        pooled: root mean square error of a curve fitted to the other surfaces.
        constant: error of the other surfaces' mean slip.
        own: error of a curve fitted to the surface itself.
    """

    samples: dict[str, int]
    pooled: dict[str, float]
    constant: dict[str, float]
    own: dict[str, float]

    def mean(self) -> dict[str, float]:
        """Each error averaged over surfaces, every surface counting the same."""
        rows = {"pooled": self.pooled, "constant": self.constant, "own": self.own}
        return {name: float(np.mean(list(row.values()))) for name, row in rows.items()}


def wheel_windows(log: Log, recipe: Recipe) -> tuple[np.ndarray, np.ndarray]:
    """Mean current and slip of every wheel over a log's windows, nothing cut away.

    A window is as long as a row of the 2021 files. s = 1 - J v / (r w), v the camera's body
    velocity over the window, w the encoders' mean speed.

    Returns:
        |current| [A] and slip [-], both (window, wheel); slip is not finite where a wheel rests.
    """
    if log.pose is None or log.current is None:
        raise ValueError(f"{log.name}: slip against current needs both pose and current")
    first = first_moved(log.wheel_angle, recipe.wheel_radius)
    start = log.time[-1] if first is None else log.time[first]
    # unique: where rows are further apart than a window, two windows would begin at the same row
    starts = np.arange(start, log.time[-1], recipe.row_period)
    edges = np.unique(np.searchsorted(log.time, starts))
    if len(edges) < 2:
        return np.empty((0, log.wheels)), np.empty((0, log.wheels))
    span = np.diff(log.time[edges])[:, None]
    effective = body_steps(log.pose[edges]) / span @ recipe.rim.T
    driven = np.diff(log.wheel_angle[edges], axis=0) / span * recipe.wheel_radius
    # Mean over the rows of each window, not the value at its edge: the current is 10-bit and rough.
    current = np.add.reduceat(np.abs(log.current), edges, axis=0)[:-1] / np.diff(edges)[:, None]
    slip = np.full_like(driven, np.nan)
    np.divide(effective, driven, out=slip, where=driven != 0)
    return current, 1.0 - slip


def curve_points(log: Log, recipe: Recipe) -> np.ndarray:
    """Current [A] and slip [-] of all wheels after the paper's cuts, shape (sample, 2)."""
    current, slip = wheel_windows(log, recipe)
    keep = (slip > 0.0) & (slip <= 1.0) & (current > recipe.min_current)
    return np.stack([current[keep], slip[keep]], axis=1)


def leave_one_surface_out(logs: Iterable[Log]) -> Transfer:
    """Predict the slip of each surface from the others' curve, their mean, and its own curve.

    The camera is uncorrected.

    Raises:
        ValueError: if fewer than two surfaces are there, or one has too few samples for a curve.
    """
    parts: dict[str, list[np.ndarray]] = {}
    for log in logs:
        if log.surface is None:
            raise ValueError(f"{log.name}: no known surface; expected runs on one surface each")
        parts.setdefault(log.surface, []).append(curve_points(log, FIGURES_3_AND_4))
    points = {surface: np.concatenate(part) for surface, part in parts.items()}
    if len(points) < 2:
        raise ValueError(f"surfaces {list(points)}: leaving one out needs at least two")
    counts = {surface: len(point) for surface, point in points.items()}
    for surface, count in counts.items():
        if count < 2:
            raise ValueError(f"surface {surface!r}: {count} samples, too few for a curve")
    current, slip = np.concatenate(list(points.values())).T
    floor = np.repeat(list(counts), list(counts.values()))
    found = errors_by_floor(slip, current, floor)
    pooled, constant, own = (found[k]["each"] for k in ("pooled", "constant", "per_surface"))
    return Transfer(samples=counts, pooled=pooled, constant=constant, own=own)
