"""Function `track`: poses of a robot from the video of an overhead camera."""

from pathlib import Path
from tempfile import TemporaryDirectory

from slipid.camera.frame_source import open_source
from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.target import Target, read_targets
from slipid.camera.tracking.tracking import LoneMarker, TrackingResult
from slipid.camera.tracking.tracking import track as run
from slipid.support.progress import Reporter


def track(
    video: Path | str,
    camera: OverheadCamera | Path | str,
    marker: LoneMarker | Path | str,
    *,
    fps: float | None = None,
    times: Path | str | None = None,
    quiet: bool = False,
) -> TrackingResult:
    """Return the poses of a robot with a marker in a video or a folder of pictures.

    With the result `tracked`, `tracked.tracks[0].pose` has x, y [m] and heading [rad] in every
    frame, or NaN in a rejected frame, whose flag gives the reason. `tracked.write(path)` writes the
    poses to a file that can be read together with a robot's log by the preset `tracked`.

    Args:
        video: file of the video, or folder of the pictures.
        camera: calibrated camera with its pose above the floor, or the path of its file.
        marker: marker in the middle of the robot, or the path of a file that describes several
            markers, boards or robots.
        fps: frames per second, if the video has no times.
        times: CSV file with the columns frame and time, if the video has no times.
        quiet: True to report no progress.

    Raises:
        DataError: a file is unreadable, no marker is found, or the frames have another size than
            the calibrated ones.
    """
    above = camera if isinstance(camera, OverheadCamera) else OverheadCamera.load(camera)
    source = open_source(str(video), fps, None if times is None else Path(times))
    above.lens.check_size(source.image_px, source.name)
    # The folder is temporary, since the results are kept in memory and no run is resumed from it.
    with TemporaryDirectory() as folder, Reporter(quiet=quiet) as report:
        bodies: tuple[Target, ...]
        if isinstance(marker, LoneMarker):
            bodies = (marker.target(source, report),)
        else:
            bodies = read_targets(Path(marker))
        return run(source, above, bodies, Path(folder) / "unfinished", report)
