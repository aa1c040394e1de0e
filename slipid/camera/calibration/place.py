"""The pose of a camera with a known lens above a floor, fitted to points, and its uncertainty."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from slipid.camera.calibration.lens import Pose, lens_of, parameters_of, project, rms
from slipid.camera.calibration.points import FloorPoints
from slipid.camera.opencv import cv2
from slipid.camera.overhead import Lens, OverheadCamera
from slipid.support.errors import DataError

FLAT_M = 1e-9
"""Range of the points' heights below which the points count as lying in a plane [m]."""
AGREEMENT = 0.3
"""Ratio of the fit's error without a point to its error with all points, below which that point
counts as bad [1]."""
LEAST_BAD_PX = 1.5
"""Error of a point, or root mean square error of a fit, up to which no point counts as bad
[pixel]."""
LEAST_TO_DROP = 6
"""Number of points below which a bad point is reported but not excluded."""
LEAST_TO_TEST = 5
"""Number of points below which the fit cannot show which point is bad."""
MOST_POINTS_EXCLUDED = 0.25
"""Largest fraction of the points that may be excluded [1]."""
TWIN_RATIO = 2.0
"""Ratio of the errors of two poses below which the points do not clearly decide between the poses
[1]."""
LEAST_STD_PX = 0.03
"""Smallest std assumed for the error of a point [pixel]; the residuals of few points may by chance
be smaller than the accuracy of a detected corner."""
STEP_IN_STDS = 0.01
"""Step of numerical derivatives, in stds of the variable [1]."""
GRID_POINTS = 5
"""Number of grid pixels across and down the image, between which lengths are compared."""
INNER_SHARE = 0.8
"""Fraction of the image's width and height in which lengths on the floor are compared [1]."""


@dataclass(frozen=True, eq=False)
class FloorFit:
    """A camera's pose above the floor, and the points that it was fitted to.

    Attributes:
        camera: the lens at its fitted pose.
        pose: pose of the world in the camera's axes.
        points: points that the pose was fitted to.
        twin_px: root mean square error of the next best camera pose that is also above the floor
            and looks down, with another rotation [pixel]; None if there is none.
        left_out: sentences about points that contradict the others.
        disputed: True if the points contradict each other, but too few remain to exclude one.
    """

    camera: OverheadCamera
    pose: Pose
    points: FloorPoints
    twin_px: float | None = None
    left_out: tuple[str, ...] = ()
    disputed: bool = False

    @cached_property
    def residuals(self) -> Float[np.ndarray, "point 2"]:
        """Measured less computed pixels of the points [pixel]."""
        now = project(self.camera.lens, self.pose, self.points.places)
        return self.points.pixels - now.pixels

    @property
    def off_mm(self) -> Float[np.ndarray, "point 2"]:
        """Positions computed from the points' pixels and heights, less the given x and y [mm]."""
        off = [
            self.camera.on_plane(pixel, float(place[2])) - place[:2]
            for pixel, place in zip(self.points.pixels, self.points.places, strict=True)
        ]
        return 1000 * np.array(off)

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths [pixel]."""
        return rms(self.residuals)


def camera_of(lens: Lens, pose: Pose) -> OverheadCamera:
    """Return the camera with a lens and the pose of the world in the camera's axes."""
    rotation = pose.rotation
    return OverheadCamera(lens, rotation, -rotation.T @ pose.shift)


def fit_place(source: str, lens: Lens, points: FloorPoints) -> FloorFit:
    """Return the pose of the camera, fitted to all points.

    Raises:
        DataError: no camera pose above the floor explains the points.
    """
    fit = _fitted(lens, points)
    if fit is None:
        raise DataError(
            f"{source}: no camera above the floor that looks down would see these points at these "
            "pixels; expected x and y in metres, right-handed seen from above (y to the left of "
            "x), u to the right, and v down"
        )
    return fit


def fit_place_robustly(source: str, lens: Lens, points: FloorPoints) -> FloorFit:
    """Return the pose of the camera, fitted without points that clearly contradict the others.

    Raises:
        DataError: no camera pose above the floor explains the points.
    """
    left_out: tuple[str, ...] = ()
    first = len(points.names)
    fewest = max(LEAST_TO_DROP, first - int(MOST_POINTS_EXCLUDED * first) + 1)
    while len(points.names) >= LEAST_TO_TEST:
        bad = _bad_point(lens, points)
        if bad is None:
            return replace(fit_place(source, lens, points), left_out=left_out)
        index, sentence = bad
        if len(points.names) < fewest:
            doubt = (
                f"{sentence}; it was NOT left out, because there are too few points: measure again"
            )
            fit = _fitted(lens, points)
            if fit is None:
                raise DataError(f"{source}: {doubt}")
            return replace(fit, left_out=(*left_out, doubt), disputed=True)
        left_out = (*left_out, f"{sentence}: left out")
        points = points.without(index)
    fit = fit_place(source, lens, points)
    vague = fit.rms_px > LEAST_BAD_PX
    if vague:
        left_out = (
            *left_out,
            f"the points are off by {fit.rms_px:.1f} pixels; with {len(points.names)} points "
            "it is not possible to tell which one is bad: measure again, preferably 8 points",
        )
    return replace(fit, left_out=left_out, disputed=vague)


def _bad_point(lens: Lens, points: FloorPoints) -> tuple[int, str] | None:
    """Return the index of a point that clearly contradicts all others, and a sentence about it.

    Without this point the others agree far better. The result is None if there is no such point.
    """
    fit = _fitted(lens, points)
    without = [_fitted(lens, points.without(k)) for k in range(len(points.names))]
    agreed = [(rest.rms_px, k, rest) for k, rest in enumerate(without) if rest is not None]
    if not agreed:
        return None
    error, index, rest = min(agreed, key=lambda one: one[:2])
    # one point may be so far off that no camera pose explains all points: there is no error to
    # compare with then, and the fit without the point must be accurate in itself
    limit = LEAST_BAD_PX if fit is None else AGREEMENT * fit.rms_px
    one = replace(rest, points=points.only([index]))
    if not (error < limit and one.rms_px > LEAST_BAD_PX):
        return None
    return index, (
        f"point {points.names[index]} is off by {one.rms_px:.1f} pixels ({rms(one.off_mm):.0f} "
        f"mm), the others by {error:.1f}"
    )


def _fitted(lens: Lens, points: FloorPoints) -> FloorFit | None:
    """Return the best camera pose above the floor; None if no such pose explains the points."""
    poses = _candidates(lens, points)
    fits = [FloorFit(camera_of(lens, pose), pose, points) for pose in poses]
    fits.sort(key=lambda fit: fit.rms_px)
    above = [fit for fit in fits if fit.camera.place[2] > 0 and fit.camera.rotation[2, 2] < 0]
    # the best pose of all may lie below the floor: accept a pose above the floor if its error is
    # similar to that of the best pose, or small
    if not above or above[0].rms_px > max(TWIN_RATIO * fits[0].rms_px, LEAST_BAD_PX):
        return None
    best, *others = above
    twins = [fit.rms_px for fit in others if _differ(fit.pose, best.pose)]
    return replace(best, twin_px=min(twins, default=None))


def _candidates(lens: Lens, points: FloorPoints) -> list[Pose]:
    """Return the poses at local minima of the error; points in a plane have two such poses."""
    middle = points.places.mean(0)
    # subtract the mean: OpenCV recognises points in a plane only if their z is 0, and centred
    # coordinates lose the least precision
    places = np.ascontiguousarray(points.places - middle).reshape(-1, 1, 3)
    pixels = np.ascontiguousarray(points.pixels).reshape(-1, 1, 2)
    given = (places, pixels, lens.matrix, lens.distortion)
    flat = np.ptp(points.places[:, 2]) < FLAT_M
    starts = cv2.solvePnPGeneric(*given, flags=cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    poses = []
    for start in zip(starts[1], starts[2], strict=True):
        turn, shift = (np.ravel(x) for x in cv2.solvePnPRefineLM(*given, *start, until))
        poses.append(Pose(turn, shift - Pose(turn, shift).rotation @ middle))
    return [pose for pose in poses if np.isfinite([*pose.turn, *pose.shift]).all()]


def _differ(pose: Pose, other: Pose) -> bool:
    """Return whether the rotations of two poses differ by more than a degree."""
    turn = cv2.Rodrigues(pose.rotation.T @ other.rotation)[0]
    return bool(np.degrees(np.linalg.norm(turn)) > 1)


@dataclass(frozen=True, eq=False)
class PlaceUncertainty:
    """Uncertainty of a camera's pose above the floor.

    Attributes:
        pose: covariance of turn [rad] and of the shift [m] of the floor below the points' middle,
            including the lens's uncertainty.
        place_std_m: std of the lens's position in the world [m].
        tilt_std_deg: std of the angle between the lens's axis and straight down [deg].
        scale_std: relative std of lengths on the floor if the board's size were exact [1].
    """

    pose: Float[np.ndarray, "6 6"]
    place_std_m: Float[np.ndarray, "3"]
    tilt_std_deg: float
    scale_std: float


def tilt_deg(camera: OverheadCamera) -> float:
    """Return the angle between a camera's axis and straight down [deg]."""
    return float(np.degrees(np.arccos(min(-camera.rotation[2, 2], 1.0))))


def uncertainty(
    fit: FloorFit, of_lens: Float[np.ndarray, "parameter parameter"] | None
) -> PlaceUncertainty:
    """Return the uncertainty of a camera's pose above the floor.

    Args:
        fit: the fit of the pose; its residuals give the variance of the points' errors.
        of_lens: covariance of the lens's parameters; None if it is not known.
    """
    lens, fit = fit.camera.lens, _centred(fit)
    at = np.concatenate([fit.pose.turn, fit.pose.shift, parameters_of(lens)])
    joint = _joint(fit, of_lens)

    def derived(values: np.ndarray) -> np.ndarray:
        camera = camera_of(lens_of(lens, values[6:]), Pose(values[:3], values[3:6]))
        # use the axis's direction instead of the tilt, which is not differentiable at straight down
        return np.array([*camera.place, *camera.rotation[2, :2], _log_length(camera)])

    steps = np.diag(np.maximum(STEP_IN_STDS * np.sqrt(np.diag(joint)), 1e-9))
    slopes = [(derived(at + step) - derived(at - step)) / (2 * step.sum()) for step in steps]
    spread = np.transpose(slopes) @ joint @ np.array(slopes)
    return PlaceUncertainty(
        joint[:6, :6],
        np.sqrt(np.diag(spread)[:3]),
        float(np.degrees(np.sqrt(np.linalg.eigvalsh(spread[3:5, 3:5])[-1]))),
        float(np.sqrt(spread[5, 5])),
    )


def _centred(fit: FloorFit) -> FloorFit:
    """Return a fit with the origin of the world below or above the middle of its points.

    Far from the origin, as with coordinates of UTM, an error of the turn would move the camera by
    more than the steps of derivatives allow.
    """
    middle = fit.points.places.mean(0) * [1, 1, 0]
    points = replace(fit.points, places=fit.points.places - middle)
    pose = Pose(fit.pose.turn, fit.pose.shift + fit.pose.rotation @ middle)
    return replace(fit, camera=camera_of(fit.camera.lens, pose), pose=pose, points=points)


def _joint(
    fit: FloorFit, of_lens: Float[np.ndarray, "parameter parameter"] | None
) -> Float[np.ndarray, "all all"]:
    """Return the joint covariance of pose and lens.

    Pose and lens are correlated, since an error of the lens changes the pose fitted with that lens.
    """
    now = project(fit.camera.lens, fit.pose, fit.points.places)
    free = max(fit.residuals.size - 6, 1)
    variance = max((fit.residuals**2).sum() / free, LEAST_STD_PX**2)
    own = np.linalg.inv(now.by_pose.T @ now.by_pose)
    count = now.by_lens.shape[1]
    lens = np.zeros((count, count)) if of_lens is None else of_lens
    follows = -own @ now.by_pose.T @ now.by_lens
    cross = follows @ lens
    return np.block([[variance * own + cross @ follows.T, cross], [cross.T, lens]])


def _log_length(camera: OverheadCamera) -> float:
    """Return the mean logarithm of the distances [m] on the floor between neighbouring grid pixels.

    Its std is the relative std of lengths on the floor.
    """
    width, height = camera.lens.image_px
    part = 0.5 + INNER_SHARE * np.linspace(-0.5, 0.5, GRID_POINTS)
    grid = np.stack(np.meshgrid(part * (width - 1), part * (height - 1)), axis=-1)
    floor = camera.on_plane(grid, 0.0)
    lengths = [np.linalg.norm(np.diff(floor, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    return float(np.nanmean(np.log(np.concatenate(lengths))))
