"""`slipid calibrate`: calibrate the lens of an overhead camera and its pose above the floor."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Json, Next, Quiet, can_draw, emit, flag, guarded, option
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from slipid.support.quantities import CellLength, Degrees, Height, SquareEdge

if TYPE_CHECKING:
    from slipid.camera.calibration.board import PrintedBoard
    from slipid.camera.calibration.calibrate import CalibratedLens
    from slipid.camera.calibration.place import FloorFit
    from slipid.camera.calibration.quality import TooLittleCovered
    from slipid.report.page import Page
SIZE_STD = 0.001
"""Relative std of the lengths of a printed board or a measuring tape [1], by default."""


@guarded
def calibrate(
    pictures: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="PICTURE...", help="Pictures of the board: files, folders or globs."
        ),
    ] = None,
    out: Annotated[Path, option("FILE", "Camera file to write.")] = Path("camera.json"),
    board: Annotated[
        str | None, option("7x5", "Number of squares of the ChArUco board along x and y.")
    ] = None,
    chessboard: Annotated[
        str | None,
        option("9x6", "Number of inner corners of a plain chessboard, instead of --board."),
    ] = None,
    square: Annotated[
        float | None, option("M", "Edge length of a square, in m.", kind=SquareEdge)
    ] = None,
    marker: Annotated[
        float | None, option("M", "Edge length of a marker, in m.", kind=SquareEdge)
    ] = None,
    dictionary: Annotated[
        str, option("NAME", "Name of the dictionary of the board's markers.")
    ] = "4X4_50",
    legacy: Annotated[
        bool, flag("--legacy", "The board was drawn by a version of OpenCV before 4.6.")
    ] = False,
    k3: Annotated[
        bool,
        flag("--k3", "Also fit the distortion term k3, for wide-angle lenses with a large error."),
    ] = False,
    camera: Annotated[
        Path | None, option("FILE", "Camera file with a calibrated lens, instead of pictures.")
    ] = None,
    floor: Annotated[
        Path | None, option("PICTURE", "Picture in which the board lies on the floor.")
    ] = None,
    board_height: Annotated[
        float,
        option("M", "Height of the board's printed face above the floor, in m.", kind=Height),
    ] = 0.0,
    points: Annotated[
        Path | None,
        option("CSV", "CSV of measured points: u, v [pixel], x, y and optionally z [m]."),
    ] = None,
    size_std: Annotated[
        float | None,
        option(
            "PART",
            "Relative standard deviation of the measured lengths; 0.001 by default.",
            min=0,
            max=1,
        ),
    ] = None,
    metres_per_pixel: Annotated[
        float | None,
        option(
            "M", "Length of a pixel on the floor, in m, if nothing was calibrated.", kind=CellLength
        ),
    ] = None,
    lens_height: Annotated[
        float | None,
        option(
            "M", "Height of the lens above the floor, in m; with --metres-per-pixel.", kind=Height
        ),
    ] = None,
    turn: Annotated[
        float | None,
        option(
            "DEG",
            "Rotation of the world's axes, in deg; with --metres-per-pixel.",
            kind=Degrees,
        ),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Calibrate an overhead camera from pictures of a printed board: its lens, and its pose.

    The board is a ChArUco board (--board 7x5 --square 0.04 --marker 0.03) or a plain chessboard
    (--chessboard 9x6 --square 0.025), which can calibrate the lens alone. The lens is calibrated
    from PICTURE... or read from --camera; the pose above the floor follows from --floor or
    --points. With --floor, the origin of the world is on the floor below the middle of the board,
    with x along the columns of the board, y along its rows, and z up. With --points, the measured
    points define the axes. Without any calibration, --metres-per-pixel and --lens-height describe a
    camera that looks straight down; the origin is then in the middle of the picture, with x to the
    right and y up.

    For a lens at height H, a point at height h above the floor appears H / (H - h) times as far
    from the point below the lens as it is. With H = 2.4 m and h = 0.25 m, lengths would be 11.6 %
    too long. Therefore calibrate on the floor, and give the height of the robot's marker to `slipid
    track`.

    The exit code is 1 if the calibration is poor but usable; the file, which is written all the
    same, then contains the reasons.
    """
    from slipid.camera.calibration.board import Board
    from slipid.camera.calibration.calibrate import (
        floor_from_board,
        floor_from_points,
        lens_from_file,
        lens_from_pictures,
    )
    from slipid.camera.calibration.quality import TooLittleCovered
    from slipid.support.folder import MARKS, refuse_foreign

    refuse_foreign(out, MARKS[".json"])
    words, described = pictures or [], (metres_per_pixel, lens_height, turn)
    std = SIZE_STD if size_std is None else _positive("--size-std", size_std)
    if any(value is not None for value in described):
        if any((board, chessboard, camera, floor, points)) or len(words) != 1:
            raise DataError(
                "--metres-per-pixel, --lens-height and --turn describe a camera without "
                "calibration; expected a single picture with them, and no --board, --camera, "
                "--floor or --points"
            )
        return _uncalibrated(Path(words[0]), described, size_std, out, json)
    _refuse_combinations(words, camera, floor, points)
    with Reporter(quiet=quiet) as report:
        sizes = board, chessboard
        seen = None
        if words or floor is not None:
            seen = _board(sizes, (square, marker), dictionary, legacy, floor is not None)
        if camera is not None:
            lens = lens_from_file(camera)
        else:
            assert seen is not None  # a board is required if there are pictures
            try:
                lens = lens_from_pictures(words, seen, k3, report)
            except TooLittleCovered as error:
                raise _with_picture(error, out, report) from None
        fit = None
        if points is not None:
            fit = floor_from_points(lens, points, std)
        elif floor is not None and isinstance(seen, Board):
            fit = floor_from_board(lens, seen, floor, board_height, std)
        return _write(lens, fit, out, json, report)


def _refuse_combinations(
    words: list[str], camera: Path | None, floor: Path | None, points: Path | None
) -> None:
    """Raise `DataError` if options contradict each other; `words` are the pictures of a board."""
    if bool(words) == (camera is not None):
        raise DataError(
            "the lens must come from a single source; expected either pictures of a board, or "
            "--camera FILE with a known lens"
        )
    if floor is not None and points is not None:
        raise DataError(
            "both --floor and --points are given; expected only one of them, since each "
            "determines the pose"
        )
    if camera is not None and floor is None and points is None:
        raise DataError(
            f"--camera {camera} is given, but nothing to determine the pose; expected --floor "
            "PICTURE or --points CSV with it"
        )


def _positive(option: str, value: float | None) -> float:
    """Return the value of an option; raise `DataError` if it is missing or not positive."""
    if value is None or not value > 0:
        problem = "is missing" if value is None else f"{value:g}"
        raise DataError(f"{option} {problem}; expected a number above 0")
    return value


def _board(
    sizes: tuple[str | None, str | None],
    edges: tuple[float | None, float | None],
    dictionary: str,
    legacy: bool,
    on_floor: bool,
) -> "PrintedBoard":
    """Return the board that the options describe.

    Args:
        sizes: values of --board and --chessboard.
        edges: edge lengths of a square and of a marker [m].
        dictionary: dictionary of the markers.
        legacy: True for a board drawn by an old version of OpenCV.
        on_floor: True if the board also determines the pose above the floor.
    """
    from slipid.camera.calibration.board import board_of, chessboard_of

    size, inner = sizes
    if inner is not None:
        if size is not None or edges[1] is not None:
            raise DataError(
                "--chessboard is given with --board or --marker; expected --chessboard and "
                "--square for a plain chessboard, or --board, --square and --marker for a board "
                "with markers"
            )
        if on_floor:
            raise DataError(
                "--floor is given with --chessboard, which looks the same after half a turn; "
                "expected a ChArUco board on the floor, or --points CSV"
            )
        return chessboard_of(inner, _positive("--square", edges[0]))
    if size is None:
        raise DataError(
            "--board is missing; expected the numbers of squares along x and y, such as 7x5 "
            "(or --chessboard, for a board without markers)"
        )
    square, marker = map(_positive, ("--square", "--marker"), edges)
    return board_of(size, square, marker, dictionary, legacy)


def _uncalibrated(
    picture: Path,
    described: tuple[float | None, float | None, float | None],
    size_std: float | None,
    out: Path,
    json: str | None,
) -> int:
    """Write and print a camera that looks straight down, and return the exit code.

    `described` has the metres per pixel [m], the height of the lens [m] and the turn [deg].
    """
    from slipid.camera.calibration.calibrate import straight_camera

    per_pixel = _positive("--metres-per-pixel", described[0])
    height, turn = _positive("--lens-height", described[1]), described[2] or 0.0
    camera = straight_camera(picture, per_pixel, height, turn, size_std)
    camera.save(out)
    content, following = camera.to_json(), _following(out)
    emit(json, content, lambda page: _show(page, camera.report), following, out.parent, [out.name])
    return 0


def _write(
    lens: "CalibratedLens", fit: "FloorFit | None", out: Path, json: str | None, report: Reporter
) -> int:
    """Write the camera and its pictures, print the report, and return the exit code."""
    from slipid.support.files import read_json, write_json

    files = [out]
    write_json(out, lens.to_json() if fit is None else fit.camera.to_json())
    if can_draw(report):
        from slipid.plots.calibration import coverage_picture, floor_picture

        if (quality := lens.quality) is not None:
            shown = quality.fit, quality.coverage, quality.held_out_px
            files.append(coverage_picture(*shown, _coverage_file(out)))
        if fit is not None:
            files.append(floor_picture(fit, out.with_name(f"{out.stem}_floor.png")))
    content = read_json(out, "the camera file that was just written")
    about, fresh, names = content["report"], lens.quality is not None, [f.name for f in files]
    following = _following(out) if fit is not None else []
    emit(json, content, lambda page: _show(page, about, fresh), following, out.parent, names)
    return 1 if about.get("poor") else 0


def _with_picture(error: "TooLittleCovered", out: Path, report: Reporter) -> DataError:
    """Write the picture of the coverage of a refused lens, and return the error that names it."""
    if not can_draw(report):
        return error
    from slipid.plots.calibration import coverage_picture

    path = coverage_picture(error.fit, error.coverage, None, _coverage_file(out))
    return DataError(f"{error}; {path} shows them")


def _coverage_file(out: Path) -> Path:
    """Return the file of the picture of the coverage beside a camera file."""
    return out.with_name(f"{out.stem}_coverage.png")


def _following(camera: Path) -> list[Next]:
    """Return the commands to suggest after the pose of a camera was calibrated."""
    words = ("track", "run.mp4", "--camera", camera, "--out", "logs/run.poses.csv")
    return [Next("find the poses of a marker on the robot in a video", words)]


def _show(page: "Page", report: Content, lens_too: bool = True) -> None:
    """Print the report of a camera, including that of its lens if `lens_too`."""
    from slipid.camera.calibration.report import report_lines

    for line in report_lines(report, lens_too):
        page.line(line)
