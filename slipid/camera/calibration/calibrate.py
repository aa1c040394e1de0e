"""A calibration from end to end: pictures and points in, a camera and its report out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.camera.calibration.board import (
    LEAST_CORNERS,
    Board,
    named_pictures,
    read_named,
    view_of,
)
from slipid.camera.calibration.lens import LensFit, fit_kept
from slipid.camera.calibration.place import FloorFit, placed, placed_robustly, spread
from slipid.camera.calibration.points import FloorPoints, read_points
from slipid.camera.calibration.quality import Quality, judged
from slipid.camera.calibration.report import floor_report, lens_report, scale_std, straight_report
from slipid.camera.calibration.views import not_found, usable
from slipid.camera.overhead import Lens, OverheadCamera, read_camera
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import write_json


@dataclass(frozen=True, eq=False)
class LensFound:
    """A lens, fitted or read, and the report that goes with it.

    Attributes:
        lens: the lens.
        report: what its calibration found.
        covariance: of its numbers; None where nobody knows.
        fit: where it was fitted now, with its quality.
    """

    lens: Lens
    report: Content
    covariance: Float[np.ndarray, "number number"] | None = None
    fit: tuple[LensFit, Quality] | None = None


@dataclass(frozen=True, eq=False)
class FloorFound:
    """A camera above the floor, and its fit."""

    camera: OverheadCamera
    fit: FloorFit


def lens_from_pictures(words: Sequence[str], board: Board, k3: bool) -> LensFound:
    """A lens from pictures of a board.

    Raises:
        DataError: a picture is none, or the views do not tell a lens.
    """
    seen = usable(board, [read_named(path) for path in named_pictures(words)])
    kept = fit_kept(seen.views, seen.image_px, k3)
    quality = judged(kept.fit, k3)
    report = lens_report(kept.fit, quality, seen.left_out + kept.dropped)
    report["board"] = str(board)
    found = {"lens": report, "poor": quality.poor}
    return LensFound(kept.fit.lens, found, kept.fit.covariance, (kept.fit, quality))


def lens_from_file(path: Path) -> LensFound:
    """The lens of a camera file, with its covariance where that was calibrated.

    Raises:
        DataError: absent or no camera file.
    """
    known = read_camera(path)
    lens = known.report.get("lens")
    if not isinstance(lens, dict):
        return LensFound(known.lens, {})
    report = {"lens": lens, "poor": list(lens.get("poor", []))}
    return LensFound(known.lens, report, _covariance(lens, 4 + len(known.lens.distortion)))


def _covariance(lens: Content, count: int) -> Float[np.ndarray, "number number"] | None:
    """Of the numbers of a lens, where its report has it; another program may have written it."""
    try:
        found = np.array(lens.get("covariance"), float)
    except (TypeError, ValueError):
        return None
    return found if found.shape == (count, count) and np.isfinite(found).all() else None


def on_board(lens: LensFound, board: Board, picture: Path, height_m: float) -> FloorPoints:
    """Corners of a board that lies on the floor.

    Args:
        height_m: of its printed face above the floor.

    Raises:
        DataError: the picture is of another size than the lens, or shows no board, or too little.
    """
    taken = read_named(picture)
    if taken.image_px != tuple(lens.lens.image_px):
        (width, height), (w, h) = taken.image_px, lens.lens.image_px
        raise DataError(
            f"{picture}: {width} x {height} pixels, but the lens was calibrated at {w} x {h}; "
            "expected the same resolution: take the picture at it, or calibrate at this one"
        )
    view = view_of(board, taken)
    if not len(view.pixels):
        raise not_found(board, [taken])
    if view.flat:
        raise DataError(
            f"{picture}: {len(view.pixels)} corners of the board; expected {LEAST_CORNERS} or "
            "more, not all on a line: the whole board, sharp and evenly lit"
        )
    names = tuple(f"corner {k}" for k in range(1, len(view.pixels) + 1))
    return FloorPoints(names, view.pixels, board.on_floor(view.board_m, height_m))


def floor_from_board(
    lens: LensFound, board: Board, picture: Path, height_m: float, size_std: float
) -> FloorFound:
    """A camera's place from a board on the floor, whose size is known to a part of it."""
    points = on_board(lens, board, picture, height_m)
    fit = placed(str(picture), lens.lens, points)
    return _above(lens, fit, f"board on the floor in {picture.name}", size_std)


def floor_from_points(lens: LensFound, path: Path, size_std: float) -> FloorFound:
    """A camera's place from measured points, whose tape is right to a part of what it says."""
    fit = placed_robustly(str(path), lens.lens, read_points(path, lens.lens.image_px))
    return _above(lens, fit, f"points of {path.name}", size_std)


def told(
    picture: Path, metres_per_pixel: float, height_m: float, turn_deg: float, size_std: float | None
) -> OverheadCamera:
    """A camera straight above the floor, as a user tells it; the picture tells its size alone."""
    image_px = read_named(picture).image_px
    camera = OverheadCamera.straight_down(image_px, metres_per_pixel, height_m, turn_deg)
    report = {"floor": straight_report(camera), "poor": []}
    return replace(camera, scale_std=size_std, report=report)


def save_lens(lens: LensFound, path: Path) -> None:
    """Write a lens without a floor as a camera file.

    Raises:
        DataError: nothing can be written there.
    """
    write_json(path, lens.lens.to_json() | {"report": lens.report})


def _above(lens: LensFound, fit: FloorFit, source: str, size_std: float) -> FloorFound:
    found = spread(fit, lens.covariance)
    floor = floor_report(source, fit, found, size_std)
    report = {**lens.report, "floor": floor, "poor": lens.report.get("poor", []) + floor["poor"]}
    scale = scale_std(found, size_std)
    return FloorFound(replace(fit.camera, scale_std=scale, report=report), fit)
