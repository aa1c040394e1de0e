"""Poses of a robot from the video of an overhead camera."""

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

    `tracked.tracks[0].pose` has x, y [m] and heading [rad] of every frame, NaN where it was
    rejected and the flag gives the reason; `tracked.write(path)` writes the file that the format
    `tracked` reads beside a log.

    Args:
        video: file of the video, or folder of the pictures.
        camera: calibrated camera with its place above the floor, or its file.
        marker: marker in the middle of the robot; or a file of several markers, boards or robots.
        fps: frames per second where the video has no times.
        times: CSV file of frame and time, instead.
        quiet: whether to report no progress.

    Raises:
        DataError: an unreadable file, no marker, or frames of another size than calibrated.
    """
    above = camera if isinstance(camera, OverheadCamera) else OverheadCamera.load(camera)
    source = open_source(str(video), fps, None if times is None else Path(times))
    above.lens.check_size(source.image_px, source.name)
    # results stay in memory: nobody resumes from this folder
    with TemporaryDirectory() as folder, Reporter(quiet=quiet) as report:
        bodies: tuple[Target, ...]
        if isinstance(marker, LoneMarker):
            bodies = (marker.target(source),)
        else:
            bodies = read_targets(Path(marker))
        return run(source, above, bodies, Path(folder) / "unfinished", report)
