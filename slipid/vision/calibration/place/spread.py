"""How well a camera's place is known, and lengths on the floor with it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.vision.calibration.lens.fit import Pose, lens_of, numbers_of, seen
from slipid.vision.calibration.place.floor import FloorFit, camera_of
from slipid.vision.camera import OverheadCamera

LEAST_PX = 0.03
"""Residuals of few points may be small by chance; no corner is seen better than this."""
STEP = 0.01
"""Of a standard deviation, by which numbers are moved to see what that does."""
GRID = 5
INSIDE = 0.8
"""Of the picture's width and height, over which lengths on the floor are compared."""


@dataclass(frozen=True, eq=False)
class Spread:
    """Uncertainty of a camera's place.

    Attributes:
        pose: covariance of turn [rad] and shift [m], the lens' own part in it.
        place_std_m: of the lens' place in the world.
        tilt_std_deg: of the angle between its axis and straight down.
        scale_std: of lengths on the floor, relative [1], without the part of the board's size.
    """

    pose: Float[np.ndarray, "6 6"]
    place_std_m: Float[np.ndarray, "3"]
    tilt_std_deg: float
    scale_std: float


def tilt_deg(camera: OverheadCamera) -> float:
    """Angle between a camera's axis and straight down."""
    return float(np.degrees(np.arccos(min(-camera.rotation[2, 2], 1.0))))


def spread(fit: FloorFit, of_lens: Float[np.ndarray, "number number"] | None) -> Spread:
    """Uncertainty of a camera's place from its residuals and the lens' covariance, where known."""
    lens = fit.camera.lens
    at = np.concatenate([fit.pose.turn, fit.pose.shift, numbers_of(lens)])
    joint = _joint(fit, of_lens)

    def camera(numbers: np.ndarray) -> OverheadCamera:
        return camera_of(lens_of(lens, numbers[6:]), Pose(numbers[:3], numbers[3:6]))

    place = _carried(lambda n: camera(n).place, at, joint)
    # of the axis itself: the angle has a kink at straight down
    axis = _carried(lambda n: camera(n).rotation[2, :2], at, joint)
    scale = _carried(lambda n: np.array([_log_length(camera(n))]), at, joint)
    return Spread(
        joint[:6, :6],
        np.sqrt(np.diag(place)),
        float(np.degrees(np.sqrt(np.linalg.eigvalsh(axis)[-1]))),
        float(np.sqrt(scale[0, 0])),
    )


def _joint(
    fit: FloorFit, of_lens: Float[np.ndarray, "number number"] | None
) -> Float[np.ndarray, "all all"]:
    """Covariance of pose and lens: a lens that is off moves the pose that is fitted through it."""
    now = seen(fit.camera.lens, fit.pose, fit.points.places)
    free = max(fit.residuals.size - 6, 1)
    variance = max((fit.residuals**2).sum() / free, LEAST_PX**2)
    own = np.linalg.inv(now.of_pose.T @ now.of_pose)
    count = now.of_lens.shape[1]
    lens = np.zeros((count, count)) if of_lens is None else of_lens
    follows = -own @ now.of_pose.T @ now.of_lens
    cross = follows @ lens
    return np.block([[variance * own + cross @ follows.T, cross], [cross.T, lens]])


def _carried(
    function: Callable[[np.ndarray], np.ndarray],
    at: Float[np.ndarray, " all"],
    joint: Float[np.ndarray, "all all"],
) -> np.ndarray:
    """Covariance of a function of numbers, to first order."""
    std = np.sqrt(np.diag(joint))
    slope = []
    for k, width in enumerate(std):
        step = np.zeros(len(at))
        step[k] = max(STEP * width, 1e-9)
        slope.append((function(at + step) - function(at - step)) / (2 * step[k]))
    columns = np.stack(slope, axis=1)
    return columns @ joint @ columns.T


def _log_length(camera: OverheadCamera) -> float:
    """Logarithm of the usual length on the floor between neighbours of a grid in the picture."""
    width, height = camera.lens.image_px
    part = np.linspace(0.5 - 0.5 * INSIDE, 0.5 + 0.5 * INSIDE, GRID)
    grid = np.stack(np.meshgrid(part * (width - 1), part * (height - 1)), axis=-1)
    floor = camera.on_plane(grid, 0.0)
    lengths = [np.linalg.norm(np.diff(floor, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    return float(np.nanmean(np.log(np.concatenate(lengths))))
