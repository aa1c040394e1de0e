"""The lens from views of the board, and how well each of its numbers is known.

Views and corners that do not fit the others are left out, and named.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.camera.calibration.board import View
from slipid.camera.calibration.views import enough
from slipid.camera.opencv import opencv
from slipid.camera.overhead import Lens
from slipid.support.errors import DataError

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Numbers of a lens, in the order of its covariance; k3 where it was asked for."""


@dataclass(frozen=True, eq=False)
class Pose:
    """From the axes of an object to the camera's: x right, y down, z away.

    Attributes:
        turn: rotation vector [rad].
        shift: origin of the object's axes in the camera's [m].
    """

    turn: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "3"]

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The same as a matrix."""
        return np.asarray(opencv().Rodrigues(self.turn)[0])


@dataclass(frozen=True, eq=False)
class Seen:
    """Where points are seen, and how that moves with the numbers.

    Attributes:
        pixels: of the points.
        of_pose: with turn and shift.
        of_lens: with the numbers of the lens.
    """

    pixels: Float[np.ndarray, "point 2"]
    of_pose: Float[np.ndarray, "residual 6"]
    of_lens: Float[np.ndarray, "residual number"]


@dataclass(frozen=True, eq=False)
class LensFit:
    """A lens, and what it was fitted to.

    Attributes:
        lens: the lens.
        covariance: of its numbers, in the order of NAMES.
        views: the corners it was fitted to.
        poses: of the board, by view.
        residuals: seen less computed, by view [pixel].
    """

    lens: Lens
    covariance: Float[np.ndarray, "number number"]
    views: list[View]
    poses: list[Pose]
    residuals: list[Float[np.ndarray, "_ 2"]]

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths."""
        return rms(np.concatenate(self.residuals))

    @property
    def numbers(self) -> Float[np.ndarray, " number"]:
        """Of the lens, in the order of NAMES."""
        return numbers_of(self.lens)

    @property
    def std(self) -> Float[np.ndarray, " number"]:
        """Standard deviation of each number."""
        return np.sqrt(np.diag(self.covariance))


def numbers_of(lens: Lens) -> Float[np.ndarray, " number"]:
    """Of a lens, in the order of NAMES."""
    m = lens.matrix
    return np.concatenate([[m[0, 0], m[1, 1], m[0, 2], m[1, 2]], lens.distortion])


def lens_of(lens: Lens, numbers: Float[np.ndarray, " number"]) -> Lens:
    """A lens like another with other numbers."""
    fx, fy, cx, cy = numbers[:4]
    return Lens(lens.image_px, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), numbers[4:])


def rms(residuals: Float[np.ndarray, "point 2"]) -> float:
    """Root mean square of their lengths."""
    return float(np.sqrt((residuals**2).sum(1).mean()))


def seen(lens: Lens, pose: Pose, points: Float[np.ndarray, "point 3"]) -> Seen:
    """Where a lens sees points of an object [m], with derivatives."""
    found = opencv().projectPoints(
        np.ascontiguousarray(points).reshape(-1, 1, 3),
        pose.turn,
        pose.shift,
        lens.matrix,
        lens.distortion,
    )
    slope = np.asarray(found[1])
    return Seen(np.asarray(found[0]).reshape(-1, 2), slope[:, :6], slope[:, 6:])


def fit_lens(views: Sequence[View], image_px: tuple[int, int], k3: bool) -> LensFit:
    """The lens that explains views best, by least squares.

    Raises:
        DataError: they do not determine one.
    """
    cv2 = opencv()
    points = [_solid(view).astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32).reshape(-1, 1, 2) for view in views]
    flags = 0 if k3 else cv2.CALIB_FIX_K3
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    try:
        found = cv2.calibrateCamera(
            [p.reshape(-1, 1, 3) for p in points],
            pixels,
            image_px,
            None,
            None,
            None,
            None,
            flags,
            until,
        )
    except cv2.error as error:
        raise alike(f"OpenCV finds no lens ({error.err})") from error
    lens = Lens(image_px, np.asarray(found[1]), np.ravel(found[2])[: 5 if k3 else 4])
    poses = [Pose(np.ravel(r), np.ravel(t)) for r, t in zip(found[3], found[4], strict=True)]
    if not (np.isfinite(numbers_of(lens)).all() and all(np.isfinite(p.shift).all() for p in poses)):
        raise alike("the fit of the lens does not end at numbers")
    return _with_spread(lens, list(views), poses)


def alike(found: str) -> DataError:
    """What to say where views do not tell a lens."""
    return DataError(
        f"{found}: these views do not determine the lens, most often because the board lies "
        "parallel to the sensor in all of them; expected some that are tilted by 20 to 40 degrees "
        "to the left, right, front and back"
    )


def _solid(view: View) -> Float[np.ndarray, "corner 3"]:
    return np.concatenate([view.board_m, np.zeros((len(view.board_m), 1))], axis=1)


def _with_spread(lens: Lens, views: list[View], poses: list[Pose]) -> LensFit:
    """A fit with the covariance of its lens; the poses' numbers are eliminated view by view."""
    known, residuals = np.zeros((len(numbers_of(lens)),) * 2), []
    for view, pose in zip(views, poses, strict=True):
        now = seen(lens, pose, _solid(view))
        residuals.append(view.pixels - now.pixels)
        cross = now.of_pose.T @ now.of_lens
        own = now.of_pose.T @ now.of_pose
        known += now.of_lens.T @ now.of_lens - cross.T @ np.linalg.solve(own, cross)
    every = np.concatenate(residuals)
    free = every.size - 6 * len(views) - len(known)
    try:
        covariance = (every**2).sum() / max(free, 1) * np.linalg.inv(known)
    except np.linalg.LinAlgError as error:
        raise alike("the numbers of the lens cannot be told apart") from error
    if not (np.diag(covariance) > 0).all():
        raise alike("the numbers of the lens cannot be told apart")
    return LensFit(lens, covariance, views, poses, residuals)


def pose_of(lens: Lens, view: View) -> Pose:
    """Where a board is, seen through a known lens."""
    cv2 = opencv()
    points, pixels = _solid(view).reshape(-1, 1, 3), view.pixels.reshape(-1, 1, 2)
    given = (points, pixels, lens.matrix, lens.distortion)
    found = cv2.solvePnPGeneric(*given, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(*given, found[1][0], found[2][0])
    return Pose(np.ravel(turn), np.ravel(shift))


ROUNDS = 30
WORSE = 3.0
"""Times the usual residual, from which on a view is out."""
FAR = 6.0
"""Times the usual residual, from which on a corner is out: with noise alone, one in 10^7."""
LEAST_PX = 0.3
"""Nothing is out by less: such residuals harm nobody."""
MOST = 0.25
"""Of the views may be left out; more, and it is not known which are right."""


@dataclass(frozen=True, eq=False)
class Kept:
    """The fit to what was kept, and sentences about what was not."""

    fit: LensFit
    dropped: list[str]


def fit_kept(views: Sequence[View], image_px: tuple[int, int], k3: bool) -> Kept:
    """Fit a lens, leave out what does not fit, and fit again until nothing is left out.

    Raises:
        DataError: more would go than may.
    """
    now, dropped, first = list(views), [], len(views)
    for _ in range(ROUNDS):
        fit = fit_lens(now, image_px, k3)
        usual = [float(np.median(np.hypot(*r.T))) for r in fit.residuals]
        level = max(float(np.median(usual)), LEAST_PX / WORSE)
        worst = int(np.argmax(usual))
        if usual[worst] > WORSE * level:
            dropped.append(
                f"view {now[worst].name} left out: its corners are off by {usual[worst]:.2f} "
                f"pixels, those of the other views by {level:.2f}"
            )
            del now[worst]
            if first - len(now) > MOST * first:
                raise DataError(
                    f"{first - len(now)} of {first} views do not fit the others ({now[0].name} "
                    "does); expected a flat board of known size, sharp pictures, and one camera "
                    "whose focus and zoom stayed"
                )
            enough(now)
            continue
        bad = [_worst(np.hypot(*r.T), max(FAR * level, LEAST_PX)) for r in fit.residuals]
        if not any(b.any() for b in bad):
            break
        dropped += [
            f"view {v.name}: one of {len(b)} corners left out, off by "
            f"{np.hypot(*r.T).max():.2f} pixels"
            for v, b, r in zip(now, bad, fit.residuals, strict=True)
            if b.any()
        ]
        now = [v.only(~b) for v, b in zip(now, bad, strict=True)]
        now = [v for v in now if not v.flat]
        enough(now)
    return Kept(fit, dropped)


def _worst(off: Float[np.ndarray, " corner"], limit: float) -> Bool[np.ndarray, " corner"]:
    """The corner that is off most, if by more than a limit: it may have drawn others with it."""
    return (off > limit) & (off == off.max())
