"""Camera calibration as a whole: from images of a board and measured points to a camera file."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.calibration.board import (
    LEAST_CORNERS,
    Board,
    Picture,
    PrintedBoard,
    view_of,
)
from slipid.camera.calibration.lens import fit_robustly
from slipid.camera.calibration.place import FloorFit, fit_place, fit_place_robustly, uncertainty
from slipid.camera.calibration.points import FloorPoints, read_points
from slipid.camera.calibration.quality import Quality, quality_of
from slipid.camera.calibration.report import floor_report, lens_report, straight_report
from slipid.camera.calibration.views import named_pictures, not_detected, usable
from slipid.camera.frame import grey_of
from slipid.camera.opencv import size_of
from slipid.camera.overhead import Lens, OverheadCamera, read_camera
from slipid.camera.picture_file import read_picture
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

MOST_FOCAL_PX = 1e6
"""Largest focal length of a camera [pixel]."""


@dataclass(frozen=True, eq=False)
class CalibratedLens:
    """A lens, fitted or read from a file, with the report of its calibration.

    Attributes:
        lens: the lens.
        report: report of its calibration.
        covariance: covariance of the lens's parameters, in the order of
            `slipid.camera.calibration.lens.NAMES`; None if it is not known.
        quality: the fit of the lens and its quality; None if the lens was read from a file.
    """

    lens: Lens
    report: Content
    covariance: Float[np.ndarray, "parameter parameter"] | None = None
    quality: Quality | None = None

    def to_json(self) -> Content:
        """Return the content of a camera file without a pose above the floor."""
        return self.lens.to_json() | {"report": self.report}


def lens_from_pictures(
    words: Sequence[str], board: PrintedBoard, k3: bool, report: Reporter
) -> CalibratedLens:
    """Return a lens calibrated with images of a board.

    Args:
        words: files, folders and glob patterns of images.
        board: the board.
        k3: True to fit the distortion parameter k3 as well.
        report: receives the progress.

    Raises:
        DataError: a file is not an image, or the views do not determine a lens.
    """
    notes: list[str] = []
    pictures = _taken(named_pictures(words), notes, report)
    views, left_out, image_px = usable(board, pictures, report)
    if any(view.inverted for view in views):
        notes.append("the board is printed white on black")
    report.stage("fitting the lens")
    fit = fit_robustly(views, image_px, k3)
    quality = quality_of(fit, k3)
    about = lens_report(quality, left_out) | {"board": str(board)}
    content = {"lens": about, "poor": quality.poor, "notes": notes}
    return CalibratedLens(fit.lens, content, fit.covariance, quality)


def _taken(paths: Sequence[Path], notes: list[str], report: Reporter) -> Iterator[Picture]:
    """Yield the images in files, one after the other, and report the progress."""
    report.stage("detecting the board")
    for k, path in enumerate(paths):
        report.advance(k, len(paths))
        yield Picture(path, grey_of(read_picture(path, notes)))


def lens_from_file(path: Path) -> CalibratedLens:
    """Return the lens in a camera file, with its covariance if the file contains one.

    Raises:
        DataError: the file is absent or not a camera file.
    """
    content = read_camera(path)
    lens = content.report.get("lens")
    if not isinstance(lens, dict):
        return CalibratedLens(content.lens, {})
    # another program may have written the report
    poor, notes = lens.get("poor"), content.report.get("notes")
    report = {
        "lens": lens,
        "poor": list(poor) if isinstance(poor, list) else [],
        "notes": list(notes) if isinstance(notes, list) else [],
    }
    return CalibratedLens(content.lens, report, _covariance(lens, 4 + len(content.lens.distortion)))


def _covariance(lens: Content, count: int) -> Float[np.ndarray, "parameter parameter"] | None:
    """Return the covariance in a lens report, or None if it is absent or invalid.

    The values are checked, since another program may have written the report.
    """
    try:
        covariance = np.array(lens.get("covariance"), float)
    except (TypeError, ValueError):
        return None
    sound = covariance.shape == (count, count) and np.isfinite(covariance).all()
    return covariance if sound else None


def on_board(lens: CalibratedLens, board: Board, taken: Picture, height_m: float) -> FloorPoints:
    """Return the corners of a board that lies on the floor, with world positions and pixels.

    Args:
        lens: the camera's lens.
        board: the board.
        taken: image that shows the board.
        height_m: height of the board's printed face above the floor [m].

    Raises:
        DataError: the image's size differs from the lens's, or too few corners are detected.
    """
    lens.lens.check_size(taken.image_px, taken.path)
    view = view_of(board, taken)
    if not len(view.pixels):
        raise not_detected(board, [taken], 1)
    if view.flat:
        raise DataError(
            f"{taken.path}: {len(view.pixels)} corners of the board; expected {LEAST_CORNERS} or "
            "more, not all on a line: show the whole board, sharp and evenly lit"
        )
    names = tuple(f"corner {k}" for k in range(1, len(view.pixels) + 1))
    return FloorPoints(names, view.pixels, board.on_floor(view.board_m, height_m))


def floor_from_board(
    lens: CalibratedLens, board: Board, picture: Path, height_m: float, size_std: float
) -> FloorFit:
    """Return a camera's pose above the floor, fitted to a board that lies on the floor.

    Args:
        lens: the camera's lens.
        board: the board.
        picture: file of the image that shows the board.
        height_m: height of the board's printed face above the floor [m].
        size_std: relative std of the board's size [1].
    """
    notes: list[str] = []
    taken = Picture(picture, read_picture(picture, notes))
    fit = fit_place(str(picture), lens.lens, on_board(lens, board, taken, height_m))
    return _with_report(lens, fit, f"board on the floor in {picture.name}", size_std, notes)


def floor_from_points(lens: CalibratedLens, path: Path, size_std: float) -> FloorFit:
    """Return a camera's pose above the floor, fitted to the measured points in a file.

    `size_std` is the relative std of the measuring tape's scale [1].
    """
    fit = fit_place_robustly(str(path), lens.lens, read_points(path, lens.lens.image_px))
    return _with_report(lens, fit, f"points of {path.name}", size_std)


def straight_camera(
    picture: Path, metres_per_pixel: float, height_m: float, turn_deg: float, size_std: float | None
) -> OverheadCamera:
    """Return an uncalibrated camera that looks straight down, with the image size of `picture`.

    `size_std` is the relative std of lengths on the floor [1], None if it is not known. The other
    arguments are those of `OverheadCamera.straight_down`.
    """
    notes: list[str] = []
    image_px = size_of(read_picture(picture, notes))
    camera = OverheadCamera.straight_down(image_px, metres_per_pixel, height_m, turn_deg)
    if not 1 <= camera.lens.matrix[0, 0] <= MOST_FOCAL_PX:
        raise DataError(
            f"{height_m:g} m above the floor, {metres_per_pixel:g} m per pixel give a focal length "
            f"of {camera.lens.matrix[0, 0]:g} pixels; expected 1 to {MOST_FOCAL_PX:g}"
        )
    report = {"floor": straight_report(camera), "poor": [], "notes": notes}
    return replace(camera, scale_std=size_std, report=report)


def _with_report(
    lens: CalibratedLens, fit: FloorFit, source: str, size_std: float, notes: Sequence[str] = ()
) -> FloorFit:
    """Add the report of lens and floor, and the relative std of lengths, to the camera of a fit."""
    floor = floor_report(source, fit, uncertainty(fit, lens.covariance), size_std)
    report = {**lens.report, "floor": floor, "poor": lens.report.get("poor", []) + floor["poor"]}
    report["notes"] = [*lens.report.get("notes", []), *notes]
    camera = replace(fit.camera, scale_std=floor["scale_std"], report=report)
    return replace(fit, camera=camera)
