"""Does one curve of slip over current carry over to a surface unseen? The 2022 runs tell."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slipid.data.log import Log


@dataclass(frozen=True)
class TransferRecipe:
    """The 2021 recipe on the 2022 runs: half-second windows, its cuts, the uncorrected camera.

    Args:
        wheel_radius: r [m].
        base_radius: L [m].
        azimuth_deg: wheel centres seen from the body's x axis [deg].
        window: length of one sample [s], a row of the 2021 files.
        moved: rim travel after which a run counts as under way [m].
        min_current: samples at or below it are left out [A].
        degree: of the polynomial in current, 1 as deployed.
    """

    wheel_radius: float = 0.040
    base_radius: float = 0.125
    azimuth_deg: tuple[float, ...] = (60.0, 180.0, 300.0)
    window: float = 0.5
    moved: float = 0.010
    min_current: float = 0.25
    degree: int = 1


@dataclass(frozen=True)
class Transfer:
    """Error in slip [-] on each surface, from three sources of a prediction.

    Args:
        samples: number of them per surface.
        pooled: root mean square error of a curve fitted to the other surfaces.
        constant: of the other surfaces' mean slip.
        own: of a curve fitted to the surface itself.
    """

    samples: dict[str, int]
    pooled: dict[str, float]
    constant: dict[str, float]
    own: dict[str, float]

    def mean(self) -> dict[str, float]:
        """Each error averaged over surfaces, every surface counting the same."""
        rows = {"pooled": self.pooled, "constant": self.constant, "own": self.own}
        return {name: float(np.mean(list(row.values()))) for name, row in rows.items()}


def window_samples(log: Log, recipe: TransferRecipe) -> np.ndarray:
    """Current and slip of every wheel over a log's windows, after the paper's cuts.

    s = 1 - J v / (r w), v the camera's body velocity over the window, w the encoders' mean speed.

    Args:
        log: one run with pose and current.
        recipe: the choices.

    Returns:
        current [A] and slip [-], shape (sample, 2), wheels one after another.

    Raises:
        ValueError: if the log has no pose or no current.
    """
    if log.pose is None or log.current is None:
        raise ValueError(f"{log.name}: slip against current needs both pose and current")
    edges = _edges(log, recipe)
    if len(edges) < 2:
        return np.empty((0, 2))
    span = np.diff(log.time[edges])[:, None]
    azimuth = np.radians(recipe.azimuth_deg)
    rim = np.stack([-np.sin(azimuth), np.cos(azimuth), np.full(3, recipe.base_radius)], axis=1)
    effective = _body_steps(log.pose[edges]) / span @ rim.T / recipe.wheel_radius
    speed = np.diff(log.wheel_angle[edges], axis=0) / span
    # Mean over the rows of each window, not the value at its edge: the current is 10-bit and rough.
    sums = np.add.reduceat(np.abs(log.current), edges, axis=0)[:-1]
    current = sums / np.diff(edges)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        slip = 1.0 - effective / speed
        keep = (slip > 0.0) & (slip <= 1.0) & (current > recipe.min_current)
    return np.stack([current.T[keep.T], slip.T[keep.T]], axis=1)


def leave_one_surface_out(logs: Iterable[Log], recipe: TransferRecipe | None = None) -> Transfer:
    """Predict the slip of each surface from the others' curve, their mean, and its own curve.

    Args:
        logs: runs on one known surface each.
        recipe: the choices; the paper's where None.

    Raises:
        ValueError: if fewer than two surfaces are there, or one has too few samples for a curve.
    """
    recipe = recipe or TransferRecipe()
    parts: dict[str, list[np.ndarray]] = {}
    for log in logs:
        if log.surface is None:
            raise ValueError(f"{log.name}: no known surface; expected runs on one surface each")
        parts.setdefault(log.surface, []).append(window_samples(log, recipe))
    points = {surface: np.concatenate(part) for surface, part in parts.items()}
    if len(points) < 2:
        raise ValueError(f"surfaces {list(points)}: leaving one out needs at least two")
    for surface, point in points.items():
        if len(point) <= recipe.degree:
            raise ValueError(f"surface {surface!r}: {len(point)} samples, too few for a curve")
    pooled, constant, own = {}, {}, {}
    for surface, here in points.items():
        others = np.concatenate([p for name, p in points.items() if name != surface])
        pooled[surface] = _curve_error(others, here, recipe.degree)
        constant[surface] = _curve_error(others, here, 0)
        own[surface] = _curve_error(here, here, recipe.degree)
    counts = {surface: len(point) for surface, point in points.items()}
    return Transfer(samples=counts, pooled=pooled, constant=constant, own=own)


def _curve_error(train: np.ndarray, test: np.ndarray, degree: int) -> float:
    curve = np.polynomial.Polynomial.fit(train[:, 0], train[:, 1], degree)
    return float(np.sqrt(np.mean((test[:, 1] - curve(test[:, 0])) ** 2)))


def _edges(log: Log, recipe: TransferRecipe) -> np.ndarray:
    travel = np.max(np.abs(log.wheel_angle - log.wheel_angle[0]), axis=1) * recipe.wheel_radius
    moving = np.flatnonzero(travel >= recipe.moved)
    if len(moving) == 0:
        return np.empty(0, dtype=int)
    starts = np.arange(log.time[moving[0]], log.time[-1], recipe.window)
    # unique: where rows are further apart than a window, two windows would begin at the same row
    return np.unique(np.searchsorted(log.time, starts))


def _body_steps(pose: np.ndarray) -> np.ndarray:
    """Pose increments in the body frame, turned by the mean heading of each window."""
    step = np.diff(pose, axis=0)
    heading = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    c, s = np.cos(heading), np.sin(heading)
    forward = c * step[:, 0] + s * step[:, 1]
    left = -s * step[:, 0] + c * step[:, 1]
    return np.stack([forward, left, step[:, 2]], axis=1)
