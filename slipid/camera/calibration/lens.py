"""The lens fitted to views of the board, with the covariance of its parameters.

Views and corners that are inconsistent with the others are excluded and listed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from slipid.camera.calibration.board import View
from slipid.camera.calibration.views import check_enough
from slipid.camera.opencv import cv2
from slipid.camera.overhead import Lens
from slipid.support.errors import DataError

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Parameters of a lens, in the order of its covariance; k3 is present only if it is fitted."""
MOST_ROUNDS = 30
"""Largest number of fits in `fit_robustly`; after each fit but the last, views or corners are
excluded."""
VIEW_RATIO = 3.0
"""Ratio of a view's median residual to the median of these over all views, above which the view is
excluded [1]."""
CORNER_RATIO = 6.0
"""Ratio of a corner's residual to the median residual above which the corner is excluded [1]. Pure
noise exceeds it for one corner in 10^7."""
HARMLESS_PX = 0.3
"""Residual up to which views and corners are never excluded, since it is harmless [pixel]."""
MOST_VIEWS_EXCLUDED = 0.25
"""Largest fraction of the views that may be excluded [1]; if more views are inconsistent with the
others, it is not clear which ones are right."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of an object in the camera's axes: x right, y down, z away from the camera.

    Attributes:
        turn: rotation vector [rad].
        shift: position of the object's origin in the camera's axes [m].
    """

    turn: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "3"]

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation matrix of the pose, from the object's axes to the camera's."""
        return np.asarray(cv2.Rodrigues(self.turn)[0])


@dataclass(frozen=True, eq=False)
class Projection:
    """Pixels at which points appear, and their derivatives.

    Attributes:
        pixels: u, v of each point [pixel].
        by_pose: derivatives of u and v, point by point, with respect to the pose's turn [pixel/rad]
            and shift [pixel/m].
        by_lens: derivatives of u and v, point by point, with respect to the lens's parameters, in
            the order of NAMES.
    """

    pixels: Float[np.ndarray, "point 2"]
    by_pose: Float[np.ndarray, "residual 6"]
    by_lens: Float[np.ndarray, "residual parameter"]


@dataclass(frozen=True, eq=False)
class LensFit:
    """A lens, and the views that it was fitted to.

    Attributes:
        lens: the lens.
        covariance: covariance of the lens's parameters, in the order of NAMES.
        views: views with the corners that the lens was fitted to.
        poses: pose of the board in each view.
        residuals: measured less computed pixels of the corners, one array for each view [pixel].
        left_out: sentences about views and corners that were excluded.
    """

    lens: Lens
    covariance: Float[np.ndarray, "parameter parameter"]
    views: list[View]
    poses: list[Pose]
    residuals: list[Float[np.ndarray, "_ 2"]]
    left_out: tuple[str, ...] = ()

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths [pixel]."""
        return rms(np.concatenate(self.residuals))

    @property
    def parameters(self) -> Float[np.ndarray, " parameter"]:
        """Parameters of the lens, in the order of NAMES."""
        return parameters_of(self.lens)

    @property
    def std(self) -> Float[np.ndarray, " parameter"]:
        """Standard deviation of each parameter, in the order of NAMES."""
        return np.sqrt(np.diag(self.covariance))


def parameters_of(lens: Lens) -> Float[np.ndarray, " parameter"]:
    """Return the parameters of a lens, in the order of NAMES."""
    m = lens.matrix
    return np.concatenate([[m[0, 0], m[1, 1], m[0, 2], m[1, 2]], lens.distortion])


def lens_of(lens: Lens, parameters: Float[np.ndarray, " parameter"]) -> Lens:
    """Return a lens with new parameters, in the order of NAMES, and the given lens's image size."""
    fx, fy, cx, cy = parameters[:4]
    return Lens(lens.image_px, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), parameters[4:])


def rms(residuals: Float[np.ndarray, "point 2"]) -> float:
    """Return the root mean square of the residuals' lengths, in the residuals' unit."""
    return float(np.sqrt((residuals**2).sum(1).mean()))


def project(lens: Lens, pose: Pose, points: Float[np.ndarray, "point 3"]) -> Projection:
    """Return the pixels at which points of an object [m] appear, with derivatives."""
    flat = np.ascontiguousarray(points).reshape(-1, 1, 3)
    given = (flat, pose.turn, pose.shift, lens.matrix, lens.distortion)
    pixels, slope = (np.asarray(one) for one in cv2.projectPoints(*given)[:2])
    return Projection(pixels.reshape(-1, 2), slope[:, :6], slope[:, 6:])


def fit_lens(views: Sequence[View], image_px: tuple[int, int], k3: bool) -> LensFit:
    """Return the lens fitted to views by least squares.

    Raises:
        DataError: the views do not determine a lens.
    """
    points = [solid(view).astype(np.float32).reshape(-1, 1, 3) for view in views]
    pixels = [view.pixels.astype(np.float32).reshape(-1, 1, 2) for view in views]
    flags = 0 if k3 else cv2.CALIB_FIX_K3
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    try:
        fit = cv2.calibrateCamera(points, pixels, image_px, *[None] * 4, flags, until)
    except cv2.error as error:
        raise indeterminate(f"OpenCV finds no lens ({error.err})") from error
    lens = Lens(image_px, np.asarray(fit[1]), np.ravel(fit[2])[: 5 if k3 else 4])
    poses = [Pose(np.ravel(r), np.ravel(t)) for r, t in zip(fit[3], fit[4], strict=True)]
    finite = np.isfinite(np.concatenate([parameters_of(lens), *(pose.shift for pose in poses)]))
    if not finite.all():
        raise indeterminate("the lens parameters diverge in the fit")
    return _with_covariance(lens, list(views), poses)


def indeterminate(problem: str) -> DataError:
    """Return the error to raise if views do not determine a lens."""
    return DataError(
        f"{problem}: these views do not determine the lens, most often because the board lies "
        "parallel to the sensor in all of them; expected some that are tilted by 20 to 40 degrees "
        "to the left, right, front and back"
    )


def solid(view: View) -> Float[np.ndarray, "corner 3"]:
    """Return the corners of a view in the board's axes, with z = 0 [m]."""
    return np.concatenate([view.board_m, np.zeros((len(view.board_m), 1))], axis=1)


def _with_covariance(lens: Lens, views: list[View], poses: list[Pose]) -> LensFit:
    """Return a fit of a lens with residuals and the covariance of the lens's parameters.

    The board's pose in each view is eliminated from the normal equations by a Schur complement.
    """
    information, residuals = np.zeros((len(parameters_of(lens)),) * 2), []
    for view, pose in zip(views, poses, strict=True):
        now = project(lens, pose, solid(view))
        residuals.append(view.pixels - now.pixels)
        cross = now.by_pose.T @ now.by_lens
        own = now.by_pose.T @ now.by_pose
        information += now.by_lens.T @ now.by_lens - cross.T @ np.linalg.solve(own, cross)
    every = np.concatenate(residuals)
    free = every.size - 6 * len(views) - len(information)
    try:
        covariance = (every**2).sum() / max(free, 1) * np.linalg.inv(information)
    except np.linalg.LinAlgError as error:
        raise indeterminate("the parameters of the lens cannot be separated") from error
    if not (np.diag(covariance) > 0).all():
        raise indeterminate("the parameters of the lens cannot be separated")
    return LensFit(lens, covariance, views, poses, residuals)


def pose_of(lens: Lens, view: View) -> Pose:
    """Return the pose of a board seen through a known lens."""
    points, pixels = solid(view).reshape(-1, 1, 3), view.pixels.reshape(-1, 1, 2)
    given = (points, pixels, lens.matrix, lens.distortion)
    starts = cv2.solvePnPGeneric(*given, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(*given, starts[1][0], starts[2][0])
    return Pose(np.ravel(turn), np.ravel(shift))


def fit_robustly(views: Sequence[View], image_px: tuple[int, int], k3: bool) -> LensFit:
    """Return a lens fitted without the views and corners that are inconsistent with the others.

    The fit is repeated until nothing more is excluded.

    Raises:
        DataError: too many views are inconsistent with the others, or too few views remain.
    """
    now, left_out, first = list(views), [], len(views)
    for _ in range(MOST_ROUNDS):
        fit = fit_lens(now, image_px, k3)
        off = [np.hypot(*residual.T) for residual in fit.residuals]
        usual = [float(np.median(one)) for one in off]
        level = max(float(np.median(usual)), HARMLESS_PX / VIEW_RATIO)
        worst = int(np.argmax(usual))
        if usual[worst] > VIEW_RATIO * level:
            left_out.append(
                f"view {now[worst].name} left out: its corners are off by {usual[worst]:.2f} "
                f"pixels, those of the other views by {level:.2f}"
            )
            del now[worst]
            if first - len(now) > MOST_VIEWS_EXCLUDED * first:
                raise DataError(
                    f"{first - len(now)} of {first} views are inconsistent with the others "
                    f"({now[0].name} is consistent); expected a flat board of known size, sharp "
                    "images, and one camera with fixed focus and zoom"
                )
            check_enough(now)
            continue
        # exclude only the worst corner of each view: it may distort the other residuals
        limit = max(CORNER_RATIO * level, HARMLESS_PX)
        bad = [(one > limit) & (one == one.max()) for one in off]
        if not any(b.any() for b in bad):
            break
        left_out += [
            f"view {v.name}: one of {len(b)} corners left out, off by {one.max():.2f} pixels"
            for v, b, one in zip(now, bad, off, strict=True)
            if b.any()
        ]
        now = [v.only(~b) for v, b in zip(now, bad, strict=True)]
        now = [v for v in now if not v.flat]
        check_enough(now)
    return replace(fit, left_out=tuple(left_out))
