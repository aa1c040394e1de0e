"""Quality of a calibrated lens: coverage of the image, accuracy, and error on held-out views."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.camera.calibration.board import View
from slipid.camera.calibration.lens import (
    LensFit,
    fit_lens,
    indeterminate,
    pose_of,
    project,
    rms,
    solid,
)
from slipid.support.errors import DataError

HELD_OUT_FOLDS = 5
"""Number of folds into which the views are divided for the held-out error."""
TILTED_DEG = 12.0
"""Tilt of the board above which a view separates focal length and distance [deg]."""
LEAST_TILTED = 3
"""Number of tilted views below which a lens is refused."""
CELLS = (8, 6)
"""Numbers of cells across and down into which the image is divided, to measure coverage."""
REFUSED_SHARE, POOR_SHARE = 0.35, 0.6
"""Fraction of the cells with corners below which a lens is refused, and below which it is reported
as poor [1]."""
POOR_REACH = 0.6
"""Value of `Coverage.reach` below which a lens is reported as poor [1]."""
REFUSED_FOCAL, POOR_FOCAL = 0.02, 0.005
"""Relative std of the focal lengths above which a lens is refused, and above which it is reported
as poor [1]."""
POOR_RMS_PX = 1.0
"""Root mean square error, of the fit or on held-out views, above which a lens is reported as poor
[pixel]."""
POOR_RATIO = 2.0
"""Ratio of the held-out error to the fit's error above which a lens is reported as poor [1]."""
POOR_VIEWS = 10
"""Number of views below which a lens is reported as poor."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """Coverage of the image by corners of the board.

    Attributes:
        visited: mask of the image's cells that contain corners, beginning at the upper left.
        reach: how near board corners come to each of the image's four corners, as a fraction of
            the distance from the image's middle; the smallest of the four values [1].
    """

    visited: Bool[np.ndarray, "down across"]
    reach: float

    @property
    def share(self) -> float:
        """Fraction of the image's cells that contain corners [1]."""
        return float(self.visited.mean())

    def empty_cells(self) -> str:
        """Return the cells without corners as text, such as `row 1: 1-3, 8; row 6: 1-8`."""
        rows = [
            f"row {down}: {_ranges(np.flatnonzero(~visited) + 1)}"
            for down, visited in enumerate(self.visited, 1)
            if not visited.all()
        ]
        return "; ".join(rows)


def _ranges(numbers: Int[np.ndarray, " number"]) -> str:
    """Return increasing numbers as text with ranges, such as `1-3, 8`."""
    groups = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{g[0]}-{g[-1]}" if len(g) > 1 else f"{g[0]}" for g in groups)


class TooLittleCovered(DataError):
    """Error about views that leave too much of the image without corners.

    Attributes:
        fit: the lens as these views give it.
        coverage: coverage of the image.
    """

    def __init__(self, fit: LensFit, coverage: Coverage):
        self.fit, self.coverage = fit, coverage
        down, across = coverage.visited.shape
        super().__init__(
            f"corners in {100 * coverage.share:.0f} % of the image's {across} x {down} cells; "
            f"expected {100 * POOR_SHARE:.0f} % or more, since distortion is unknown where no "
            f"corner was: move the board into the empty cells ({coverage.empty_cells()}, counted "
            "from the upper left)"
        )


def coverage(pixels: Float[np.ndarray, "corner 2"], image_px: tuple[int, int]) -> Coverage:
    """Return the coverage of an image by corners."""
    size = np.array(image_px)
    visited = np.histogramdd(pixels, CELLS, [(-0.5, n - 0.5) for n in image_px])[0].T > 0
    from_middle = (pixels - (size - 1) / 2) / (size / 2)
    # the smaller of the fractions in x and y counts, since the middle of an edge is near no corner
    reach = min(float((from_middle * one).min(1).max()) for one in product((1, -1), repeat=2))
    return Coverage(visited, max(reach, 0.0))


@dataclass(frozen=True, eq=False)
class Quality:
    """A fitted lens and its quality.

    Attributes:
        fit: the fit of the lens.
        held_out_px: root mean square error on views that the lens was not fitted to [pixel].
        coverage: coverage of the image.
        tilts_deg: angle between board and sensor in each view [deg].
        poor: sentences about shortcomings and their remedies.
    """

    fit: LensFit
    held_out_px: float
    coverage: Coverage
    tilts_deg: Float[np.ndarray, " view"]
    poor: list[str]


def quality_of(fit: LensFit, k3: bool) -> Quality:
    """Return the quality of a fitted lens.

    Raises:
        DataError: the views do not determine the lens well enough, see `check_usable`.
    """
    covered = coverage(np.concatenate([v.pixels for v in fit.views]), fit.lens.image_px)
    cosines = np.array([abs(pose.rotation[2, 2]) for pose in fit.poses])
    tilts = np.degrees(np.arccos(np.minimum(cosines, 1.0)))
    check_usable(fit, covered, tilts)
    held_out = held_out_px(fit.views, fit.lens.image_px, k3)
    return Quality(fit, held_out, covered, tilts, _poor(fit, covered, held_out))


def check_usable(fit: LensFit, covered: Coverage, tilts: Float[np.ndarray, " view"]) -> None:
    """Raise `DataError` unless the views of a fit can determine a lens.

    Raises:
        DataError: the views do not suffice; the message says what is missing and what to do.
    """
    tilted = int((tilts > TILTED_DEG).sum())
    if tilted < LEAST_TILTED:
        raise indeterminate(
            f"{tilted} of {len(tilts)} views are tilted by more than {TILTED_DEG:g} degrees: focal "
            "length and distance are not separable"
        )
    focal = _focal_std(fit)
    if focal > REFUSED_FOCAL:
        raise indeterminate(f"the focal length is known only to {100 * focal:.1f} %")
    if covered.share < REFUSED_SHARE:
        raise TooLittleCovered(fit, covered)


def held_out_px(views: Sequence[View], image_px: tuple[int, int], k3: bool) -> float:
    """Return the root mean square error on views that the lens was not fitted to [pixel].

    The board's pose in each of these views is fitted with the lens fixed. The six parameters of the
    pose reduce the error, so it is scaled up by the lost degrees of freedom.
    """
    squares, count = 0.0, 0
    for fold in range(HELD_OUT_FOLDS):
        rest = [v for k, v in enumerate(views) if k % HELD_OUT_FOLDS != fold]
        lens = fit_lens(rest, image_px, k3).lens
        for view in views[fold::HELD_OUT_FOLDS]:
            off = view.pixels - project(lens, pose_of(lens, view), solid(view)).pixels
            squares += rms(off) ** 2 * len(off) * off.size / (off.size - 6)
            count += len(off)
    return float(np.sqrt(squares / count))


def _focal_std(fit: LensFit) -> float:
    """Return the larger of the relative stds of the two focal lengths [1]."""
    return float((fit.std[:2] / fit.parameters[:2]).max())


def _poor(fit: LensFit, covered: Coverage, held_out: float) -> list[str]:
    """Return sentences about shortcomings of a lens."""
    poor, focal = [], _focal_std(fit)
    if len(fit.views) < POOR_VIEWS:
        poor.append(f"{len(fit.views)} views; expected {POOR_VIEWS} or more: take more images")
    if covered.share < POOR_SHARE:
        poor.append(
            f"corners in {100 * covered.share:.0f} % of the image; expected "
            f"{100 * POOR_SHARE:.0f} % or more: take images with the board in the empty cells "
            f"({covered.empty_cells()}, counted from the upper left)"
        )
    if covered.reach < POOR_REACH:
        poor.append(
            f"corners reach {100 * covered.reach:.0f} % of the way to the image's corners; "
            f"expected {100 * POOR_REACH:.0f} % or more, since distortion is largest in corners: "
            "move the board into them"
        )
    if focal > POOR_FOCAL:
        poor.append(
            f"focal length known to {100 * focal:.2f} %; expected {100 * POOR_FOCAL:g} % or "
            "better: tilt the board more, by 20 to 40 degrees"
        )
    if fit.rms_px > POOR_RMS_PX or held_out > POOR_RMS_PX:
        poor.append(
            f"error of {fit.rms_px:.2f} pixels, {held_out:.2f} on held-out views; expected "
            f"{POOR_RMS_PX:g} or less: check that the board is flat, images are sharp, and focus "
            "and zoom are fixed"
        )
    if held_out > POOR_RATIO * fit.rms_px:
        poor.append(
            f"error {held_out / fit.rms_px:.1f} times as large on held-out views as on fitted "
            f"views; expected {POOR_RATIO:g} times or less: take more images, since these are too "
            "few for the parameters of the lens"
        )
    return poor
