"""How good a calibrated lens is: what it was told, and how it does on views it was not told."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.camera.calibration.board import View
from slipid.camera.calibration.lens import LensFit, Pose, alike, fit_lens, pose_of, rms, seen
from slipid.camera.calibration.views import Coverage, coverage
from slipid.support.errors import DataError

FOLDS = 5
TILTED_DEG = 12.0
"""From which tilt on a view tells the focal length apart from the distance."""
LEAST_TILTED = 3
REFUSED_SHARE, POOR_SHARE = 0.35, 0.6
"""Of the cells over the picture that have corners."""
POOR_REACH = 0.6
REFUSED_FOCAL, POOR_FOCAL = 0.02, 0.005
"""Standard deviation of the focal lengths, relative."""
POOR_RMS_PX = 1.0
POOR_RATIO = 2.0
"""Held-out error over fitted error."""
POOR_VIEWS = 10


@dataclass(frozen=True, eq=False)
class Quality:
    """What is known of a lens' quality.

    Attributes:
        held_out_px: error on views that the lens was not fitted to, root mean square [pixel].
        coverage: of the picture.
        tilts_deg: of the board against the sensor, by view.
        poor: sentences about what is not as it should be, with the remedy.
    """

    held_out_px: float
    coverage: Coverage
    tilts_deg: Float[np.ndarray, " view"]
    poor: list[str]


def judged(fit: LensFit, k3: bool) -> Quality:
    """The quality of a fit.

    Raises:
        DataError: so bad that the lens is of no use.
    """
    covered = coverage(np.concatenate([v.pixels for v in fit.views]), fit.lens.image_px)
    tilts = np.array([_tilt_deg(pose) for pose in fit.poses])
    refuse(fit, covered, tilts)
    held_out = held_out_px(fit.views, fit.lens.image_px, k3)
    return Quality(held_out, covered, tilts, _poor(fit, covered, held_out))


def refuse(fit: LensFit, covered: Coverage, tilts: Float[np.ndarray, " view"]) -> None:
    """Refuse a lens that its views cannot have told.

    Raises:
        DataError: what is missing, and what to do.
    """
    tilted = int((tilts > TILTED_DEG).sum())
    if tilted < LEAST_TILTED:
        raise alike(
            f"{tilted} of {len(tilts)} views are tilted by more than {TILTED_DEG:g} degrees: focal "
            "length and distance are not separable"
        )
    focal = _focal_std(fit)
    if focal > REFUSED_FOCAL:
        raise alike(f"the focal length is known to {100 * focal:.1f} % alone")
    if covered.share < REFUSED_SHARE:
        raise DataError(
            f"corners in {100 * covered.share:.0f} % of the picture's {covered.visited.size} "
            f"cells; expected {100 * POOR_SHARE:.0f} % or more, for distortion is not known where "
            "no corner was: move the board to every edge and corner of the picture"
        )


def held_out_px(views: Sequence[View], image_px: tuple[int, int], k3: bool) -> float:
    """Error on views that the lens was not fitted to, root mean square [pixel].

    Each view's own pose is fitted to it, with the lens held; for its six numbers the error is
    made larger as they made it smaller.
    """
    squares, count = 0.0, 0
    for fold in range(FOLDS):
        rest = [v for k, v in enumerate(views) if k % FOLDS != fold]
        lens = fit_lens(rest, image_px, k3).lens
        for view in views[fold::FOLDS]:
            points = np.concatenate([view.board_m, np.zeros((len(view.board_m), 1))], axis=1)
            off = view.pixels - seen(lens, pose_of(lens, view), points).pixels
            squares += rms(off) ** 2 * len(off) * off.size / (off.size - 6)
            count += len(off)
    return float(np.sqrt(squares / count))


def _tilt_deg(pose: Pose) -> float:
    return float(np.degrees(np.arccos(min(abs(pose.rotation[2, 2]), 1.0))))


def _focal_std(fit: LensFit) -> float:
    return float((fit.std[:2] / fit.numbers[:2]).max())


def _poor(fit: LensFit, covered: Coverage, held_out: float) -> list[str]:
    found, focal = [], _focal_std(fit)
    if len(fit.views) < POOR_VIEWS:
        found.append(f"{len(fit.views)} views; expected {POOR_VIEWS} or more: take more pictures")
    if covered.share < POOR_SHARE:
        found.append(
            f"corners in {100 * covered.share:.0f} % of the picture; expected "
            f"{100 * POOR_SHARE:.0f} % or more: take pictures with the board in the empty cells"
        )
    if covered.reach < POOR_REACH:
        found.append(
            f"corners reach {100 * covered.reach:.0f} % of the way to the picture's corners; "
            f"expected {100 * POOR_REACH:.0f} % or more: distortion is largest there"
        )
    if focal > POOR_FOCAL:
        found.append(
            f"focal length known to {100 * focal:.2f} %; expected {100 * POOR_FOCAL:g} % or "
            "better: tilt the board more, by 20 to 40 degrees"
        )
    if fit.rms_px > POOR_RMS_PX or held_out > POOR_RMS_PX:
        found.append(
            f"error of {fit.rms_px:.2f} pixels, {held_out:.2f} on held-out views; expected "
            f"{POOR_RMS_PX:g} or less: is the board flat, are pictures sharp and focus and zoom "
            "fixed?"
        )
    if held_out > POOR_RATIO * fit.rms_px:
        found.append(
            f"error {held_out / fit.rms_px:.1f} times as large on held-out views as on fitted "
            "ones: too few views for the numbers of the lens"
        )
    return found
