"""Track a robot in the video of an overhead camera."""

from pathlib import Path
from tempfile import TemporaryDirectory

from slipid.camera.frames.source import open_source
from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.target import Target, read_targets
from slipid.camera.tracking.tracking import LoneMarker, Tracked
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
) -> Tracked:
    """Return poses of a robot with a marker, in every frame of a video or of a folder of pictures.

    `tracked.tracks[0].pose` has x, y [m] and heading [rad], NaN where the flag says why there is
    none;
    `tracked.write(path)` writes the file that the layout `tracked` reads beside a log.

    Args:
        video: file of a video, or folder of pictures.
        camera: calibrated and with its place above the floor, or its file.
        marker: in the middle of the robot; or the file that places several, boards or robots.
        fps: frames per second where the video has no times.
        times: CSV file of frame and time, instead.
        quiet: show no progress.

    Raises:
        DataError: unreadable files, no marker, or frames of another size than calibrated.
    """
    above = camera if isinstance(camera, OverheadCamera) else OverheadCamera.load(camera)
    source = open_source(str(video), fps, None if times is None else Path(times))
    above.of_size(source.image_px, source.name)
    # what is found is in memory: nobody goes on from this folder
    with TemporaryDirectory() as folder, Reporter(quiet=quiet) as report:
        bodies: tuple[Target, ...]
        if isinstance(marker, LoneMarker):
            bodies = (marker.target(source),)
        else:
            bodies = read_targets(Path(marker))
        return run(source, above, bodies, Path(folder) / "unfinished", report)
