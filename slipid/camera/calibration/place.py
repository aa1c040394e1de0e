"""Where a camera with a known lens hangs above a floor, from places that it sees.

How well a camera's place is known, and lengths on the floor with it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.camera.calibration.lens import Pose, lens_of, numbers_of, rms, seen
from slipid.camera.calibration.points import FloorPoints
from slipid.camera.opencv import opencv
from slipid.camera.overhead import Lens, OverheadCamera
from slipid.support.errors import DataError

FLAT_M = 1e-9
AGREES = 0.3
"""Part of the residual that the fit without a point has left, where that point was the only bad."""
LEAST_BAD_PX = 1.5
LEAST_TO_DROP = 6
LEAST_TO_TELL = 5
"""Points below which nobody knows which of them is bad."""
MOST = 0.25
"""Of the points may be left out."""
TWIN_RATIO = 2.0
"""Of the errors of two poses, below which the points hardly tell them apart."""


@dataclass(frozen=True, eq=False)
class FloorFit:
    """A camera's place, and what it was fitted to.

    Attributes:
        camera: the lens in its place.
        pose: the same as numbers, from the world to the camera.
        points: to which it was fitted.
        residuals: seen less computed [pixel].
        off_mm: the same on the floor: seen less true place, x and y [mm].
        twin_px: error of the mirrored pose that looks down, too; None where there is none.
        told: sentences about points that do not fit.
        disputed: whether points that do not fit are still among those it was fitted to.
    """

    camera: OverheadCamera
    pose: Pose
    points: FloorPoints
    residuals: Float[np.ndarray, "point 2"]
    off_mm: Float[np.ndarray, "point 2"]
    twin_px: float | None
    told: list[str]
    disputed: bool

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths."""
        return rms(self.residuals)


def camera_of(lens: Lens, pose: Pose) -> OverheadCamera:
    """A lens in a place."""
    rotation = pose.rotation
    return OverheadCamera(lens, rotation, -rotation.T @ pose.shift)


def placed(source: str, lens: Lens, points: FloorPoints) -> FloorFit:
    """Where the camera is, from points of which none is left out.

    Raises:
        DataError: no camera above the floor sees these points so.
    """
    fit = _fitted(lens, points)
    if fit is None:
        raise DataError(
            f"{source}: no camera that is above the floor and looks down sees these points so; "
            "expected x and y in metres, right-handed seen from above (y to the left of x), u to "
            "the right and v down, and a camera that looks down"
        )
    return fit


def placed_robustly(source: str, lens: Lens, points: FloorPoints) -> FloorFit:
    """Where the camera is; a point that is far off is left out where the others can tell.

    Raises:
        DataError: no camera above the floor sees these points so.
    """
    told: list[str] = []
    first = len(points.names)
    while len(points.names) >= LEAST_TO_TELL:
        bad = _bad_point(lens, points)
        if bad is None:
            return _with(placed(source, lens, points), told, False)
        few = len(points.names) < LEAST_TO_DROP or first - len(points.names) >= int(MOST * first)
        if few:
            told.append(f"{bad}; it was NOT left out, for the points are too few: measure again")
            fit = _fitted(lens, points)
            if fit is None:
                raise DataError(f"{source}: {told[-1]}")
            return _with(fit, told, True)
        told.append(f"{bad}: left out")
        points = points.without(bad.index)
    fit = placed(source, lens, points)
    vague = fit.rms_px > LEAST_BAD_PX
    if vague:
        told.append(
            f"the points are off by {fit.rms_px:.1f} pixels; with {len(points.names)} points "
            "nobody can tell which is bad: measure again, better 8 points"
        )
    return _with(fit, told, vague)


@dataclass(frozen=True)
class _Bad:
    """A point that does not fit the others.

    Attributes:
        index: of the point.
        name: of the point.
        off_px, off_mm: how far it is from where the others put it.
        others_px: error of the others without it.
    """

    index: int
    name: str
    off_px: float
    off_mm: float
    others_px: float

    def __str__(self) -> str:
        return (
            f"point {self.name} is off by {self.off_px:.1f} pixels ({self.off_mm:.0f} mm), the "
            f"others by {self.others_px:.1f}"
        )


def _bad_point(lens: Lens, points: FloorPoints) -> _Bad | None:
    """The point without which the others agree far better, where there is one."""
    fit = _fitted(lens, points)
    without = [_fitted(lens, points.without(k)) for k in range(len(points.names))]
    agreed = [(rest.rms_px, k, rest) for k, rest in enumerate(without) if rest is not None]
    if not agreed:
        return None
    error, index, rest = min(agreed, key=lambda one: one[:2])
    # one bad point may be so far off that no camera at all sees the points so
    limit = LEAST_BAD_PX if fit is None else AGREES * fit.rms_px
    off_px, off_mm = _distance(rest, points, index)
    if not (error < limit and off_px > LEAST_BAD_PX):
        return None
    return _Bad(index, points.names[index], off_px, off_mm, error)


def _fitted(lens: Lens, points: FloorPoints) -> FloorFit | None:
    """The best place above the floor; None where there is none that explains the points."""
    poses = sorted(_candidates(lens, points), key=lambda p: _error(lens, p, points))
    above = [pose for pose in poses if _looks_down(camera_of(lens, pose))]
    if not above:
        return None
    # among twins of nearly one error the place decides, but it makes no bad fit a good one
    best, bearable = above[0], max(TWIN_RATIO * _error(lens, poses[0], points), LEAST_BAD_PX)
    if _error(lens, best, points) > bearable:
        return None
    camera = camera_of(lens, best)
    twins = [_error(lens, pose, points) for pose in above[1:] if _apart(pose, best)]
    return FloorFit(
        camera,
        best,
        points,
        points.pixels - seen(lens, best, points.places).pixels,
        _off_mm(camera, points),
        min(twins, default=None),
        [],
        False,
    )


def _with(fit: FloorFit, told: list[str], disputed: bool) -> FloorFit:
    return FloorFit(
        *(fit.camera, fit.pose, fit.points, fit.residuals, fit.off_mm, fit.twin_px), told, disputed
    )


def _distance(fit: FloorFit, points: FloorPoints, index: int) -> tuple[float, float]:
    """How far a point is off that was not fitted [pixel] and [mm]."""
    there = points.places[index : index + 1]
    off = points.pixels[index] - fit.camera.pixels(there)[0]
    one = FloorPoints(points.names[index : index + 1], points.pixels[index : index + 1], there)
    return float(np.hypot(*off)), float(np.hypot(*_off_mm(fit.camera, one)[0]))


def _candidates(lens: Lens, points: FloorPoints) -> list[Pose]:
    """Poses that explain the points at least locally: of a plane there are two."""
    cv2 = opencv()
    middle = points.places.mean(0)
    # OpenCV takes a plane for one where its z is 0, and numbers near 0 are kept best
    places = np.ascontiguousarray(points.places - middle).reshape(-1, 1, 3)
    pixels = np.ascontiguousarray(points.pixels).reshape(-1, 1, 2)
    given = (places, pixels, lens.matrix, lens.distortion)
    flat = np.ptp(points.places[:, 2]) < FLAT_M
    flag = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    found = cv2.solvePnPGeneric(*given, flags=flag)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    poses = []
    for start in zip(found[1], found[2], strict=True):
        turn, shift = (np.ravel(x) for x in cv2.solvePnPRefineLM(*given, *start, until))
        poses.append(Pose(turn, shift - Pose(turn, shift).rotation @ middle))
    return [pose for pose in poses if np.isfinite([*pose.turn, *pose.shift]).all()]


def _error(lens: Lens, pose: Pose, points: FloorPoints) -> float:
    return rms(points.pixels - seen(lens, pose, points.places).pixels)


def _looks_down(camera: OverheadCamera) -> bool:
    return bool(camera.place[2] > 0 and camera.rotation[2, 2] < 0)


def _apart(pose: Pose, other: Pose) -> bool:
    """Whether two poses are turned against each other by more than a degree."""
    cosine = 0.5 * (np.trace(pose.rotation.T @ other.rotation) - 1)
    return bool(np.degrees(np.arccos(np.clip(cosine, -1, 1))) > 1)


def _off_mm(camera: OverheadCamera, points: FloorPoints) -> Float[np.ndarray, "point 2"]:
    found = [
        camera.on_plane(pixel, float(place[2])) - place[:2]
        for pixel, place in zip(points.pixels, points.places, strict=True)
    ]
    return 1000 * np.array(found)


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
