"""`slipid track`: find the poses of a robot in a video."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Json, Next, Quiet, emit, guarded, option
from slipid.support.folder import locked
from slipid.support.progress import Reporter
from slipid.support.quantities import Degrees, FrameRate, Height, MarkerEdge, Seconds

if TYPE_CHECKING:
    from slipid.camera.tracking.detector import Region
    from slipid.report.page import Page


@guarded
def track(
    source: Annotated[
        str,
        typer.Argument(
            metavar="VIDEO|FOLDER|DEVICE", help="Video, pictures, or the number of a camera device."
        ),
    ],
    camera: Annotated[Path, option("FILE", "Camera file of `slipid calibrate`.")],
    out: Annotated[Path, option("FILE", "File of poses to write (.csv or .parquet).")],
    marker_size: Annotated[
        float | None,
        option("M", "Edge length of the marker's black square, in m.", kind=MarkerEdge),
    ] = None,
    marker_height: Annotated[
        float | None, option("M", "Height of the marker above the floor, in m.", kind=Height)
    ] = None,
    marker_yaw: Annotated[
        float,
        option(
            "DEG",
            "Direction of the marker's top edge, in deg counter-clockwise from the robot's x axis.",
            kind=Degrees,
        ),
    ] = 0.0,
    dictionary: Annotated[str, option("NAME", "Name of the dictionary of the marker.")] = "4X4_50",
    id: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=1_000_000,
            help="Id of the marker; by default that of the only visible marker.",
        ),
    ] = None,
    targets: Annotated[
        Path | None,
        option(
            "FILE", "Config of several markers, boards or robots, instead of the marker options."
        ),
    ] = None,
    fps: Annotated[
        float | None,
        option(
            "HZ", "Frame rate, in Hz; by default the times in the video are used.", kind=FrameRate
        ),
    ] = None,
    times: Annotated[
        Path | None, option("FILE", "CSV file of the frame times, with columns frame and time [s].")
    ] = None,
    region: Annotated[
        str | None, option("X0,Y0,X1,Y1", "Part of the picture in which to search, in pixels.")
    ] = None,
    seconds: Annotated[
        float | None,
        option("S", "Duration of the recording in s; required for a camera device.", kind=Seconds),
    ] = None,
    preview: Annotated[
        Path | None, option("FILE", "Picture to write, with the poses of one frame drawn in it.")
    ] = None,
    preview_frame: Annotated[
        int | None,
        option(
            "N", "Frame to draw in --preview; by default the first with a pose.", min=0, max=10**9
        ),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Track a robot with a marker in the video of a calibrated camera above it.

    The file has a row for every frame, with the pose and its covariance, or with the reason why the
    frame was rejected; nothing is interpolated. The exit code is 1 if the poses are too poor to be
    used unchanged.
    """
    from slipid.camera.frame_source import open_source
    from slipid.camera.overhead import OverheadCamera
    from slipid.camera.tracking import tracking
    from slipid.camera.tracking.outputs import check_writable
    from slipid.camera.tracking.target import read_targets
    from slipid.support.errors import DataError

    above = OverheadCamera.load(camera)
    with Reporter(quiet=quiet) as report:
        part = _region(region)
        frames = open_source(source, fps, times, seconds)
        tracking.check_outputs(frames, out, preview)
        above.lens.check_size(frames.image_px, frames.name)
        if targets is not None:
            bodies = read_targets(targets)
        elif marker_size is None or marker_height is None:
            raise DataError(
                "the size or the height of the marker is missing; expected --marker-size and "
                "--marker-height in metres, or --targets FILE"
            )
        else:
            yaw = math.radians(marker_yaw)
            lone = tracking.LoneMarker(marker_size, marker_height, id, dictionary, yaw)
            bodies = (lone.target(frames, report, part),)
        for file in tracking.pose_files(out, bodies):
            check_writable(file)
        unfinished = out.with_name(f".{out.name}.unfinished")
        with locked(unfinished, "track"):
            result = tracking.track(frames, above, bodies, unfinished, report, part)
            written = [path.name for path in result.write(out)]
        if preview is not None:
            number = tracking.preview(preview, result, above, preview_frame)
            report.line(f"frame {number} is drawn in {preview}")

    def show(page: "Page") -> None:
        page.notes(result.notes)
        for doubt in result.doubts:
            page.line(f"DOUBTFUL: {doubt}")

    step = Next(
        "write a config, from the poses and the robot's logs", ("new", "--from", out.parent)
    )
    emit(json, result.to_json(), show, [step], out.parent, written)
    return 1 if result.doubts else 0


def _region(text: str | None) -> "Region | None":
    """Return the region of a picture from the text `X0,Y0,X1,Y1` [pixel], or None for no text.

    Raises:
        DataError: the text is not four whole numbers.
    """
    from slipid.camera.tracking.detector import Region
    from slipid.support.errors import DataError

    if text is None:
        return None
    try:
        left, top, right, bottom = (int(part) for part in text.split(","))
    except ValueError:
        raise DataError(f"--region {text}; expected four whole numbers X0,Y0,X1,Y1") from None
    return Region(left, top, right, bottom)
