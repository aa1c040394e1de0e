"""Video files, decoded by PyAV: their frames as stored, the times in the file, and still images.

OpenCV is not used for files, since its version 5.0 returns uninitialised memory for videos that are
flagged as interlaced. Orientation flags are reported and not applied, because the lens is
calibrated for pixels as the sensor recorded them.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import UInt8

from slipid.camera.frame import Frame, FrameSource, Times, even_times, grey_of, stamp
from slipid.camera.opencv import MOST_PIXELS
from slipid.camera.picture_file import is_picture, read_picture
from slipid.support.errors import DataError
from slipid.support.extras import require

MEDIAN_FRAMES = 25
"""Approximate number of frames of a video whose pixelwise median gives a still image; at most
twice as many are used."""
STILL_BYTES = 1_000_000_000
"""Largest total size of the frames that are kept for a still image [byte]."""
MARGIN = 8
"""Number of frames before an undecodable one that are not used either: decoders report damage up to
a few frames late, after frames that they have patched up."""
BLOCK_ROWS = 64
"""Number of rows of an image whose median is computed at once, to limit memory."""


def _av() -> ModuleType:
    """Return the module av; raise `DataError` if it is not installed."""
    return require("av", "camera", "a video")


class VideoStream:
    """PyAV's decoder of the first video stream in a file, used as a context manager.

    Attributes:
        fault: sentence about damage at which decoding ended; None without damage so far.

    Raises:
        DataError: the file is not a video that PyAV reads, or its frames are too large.
    """

    def __init__(self, path: Path):
        self._path, self._av = path, _av()
        av = self._av
        try:
            self._file = _opened(av, path)
            self._stream = self._file.streams.video[0]
            if self._stream.codec_context is None:
                raise ValueError("its kind of compression is unknown")
        except (av.FFmpegError, IndexError, ValueError) as error:
            reason = "it has no video" if isinstance(error, IndexError) else _message(error)
            raise DataError(
                f"{path}: not a video that can be opened ({reason}); expected a video (a recording "
                "that was cut off may have lost its index)"
            ) from None
        context = self._stream.codec_context
        width, height = context.width, context.height
        if width * height > MOST_PIXELS:
            most = f"{MOST_PIXELS // 10**6} million at most"
            raise DataError(f"{path}: frames of {width} x {height} pixels; expected {most}")
        self._stream.thread_type = "AUTO"
        self._reason: str | None = None
        # in Motion JPEG every frame stands for itself, and damage to one is no doubt about another
        self._certain = context.name == "mjpeg"
        if self._certain:
            # by default this decoder patches up damaged frames without a sign of it
            context.options = {"err_detect": "explode"}
        self.fault: str | None = None

    def __enter__(self) -> "VideoStream":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def count(self) -> int | None:
        """Number of frames that the file announces or that follows from its duration, or None."""
        stream, file = self._stream, self._file
        if stream.frames > 0:
            return int(stream.frames)
        if not stream.average_rate:
            return None
        if stream.duration is not None and stream.time_base is not None:
            seconds = stream.duration * float(stream.time_base)
        else:
            seconds = (file.duration or 0) / self._av.time_base
        count = round(seconds * float(stream.average_rate))
        return count if 0 < count < 1e9 else None

    def frames(self) -> Iterator[Any]:
        """Yield PyAV's frames up to one that cannot be decoded, see `fault`.

        Undecodable packets before the first key frame are skipped, since a part of a longer
        recording may begin with them.

        Raises:
            DataError: the size of the frames changes.
        """
        waiting: deque[Any] = deque()
        used = 0
        for frame in self._decoded():
            waiting.append(frame)
            if (frame.width, frame.height) != (waiting[0].width, waiting[0].height):
                raise DataError(
                    f"{self._path}: frames of {frame.width} x {frame.height} pixels after frames "
                    f"of {waiting[0].width} x {waiting[0].height}; expected frames of one size"
                )
            if len(waiting) > MARGIN:
                used += 1
                yield waiting.popleft()
        if self._reason is None or self._certain:
            used += len(waiting)
            yield from waiting
        if self._reason is not None:
            number = used if self._certain else used + len(waiting)
            self.fault = (
                f"{self._path}: decoding failed near frame {number} ({self._reason}); the file is "
                f"damaged or cut off there, and only the first {used} frames are used"
            )

    def _decoded(self) -> Iterator[Any]:
        """Yield frames until one cannot be decoded, for a reason that is stored."""
        key, packets = False, self._file.demux(self._stream)
        while True:
            try:
                if (packet := next(packets, None)) is None:
                    return
                key = key or packet.is_keyframe
                if packet.is_corrupt and key:
                    self._reason, self._certain = "data are missing", True
                    return
                frames = packet.decode()
                reason = "it is patched up" if any(one.is_corrupt for one in frames) else None
            except self._av.EOFError:
                return
            except self._av.FFmpegError as error:
                reason = _message(error)
            if reason is None:
                yield from frames
            elif key:
                self._reason = reason
                return

    def picture_of(self, frame: Any) -> UInt8[np.ndarray, "row column 3"]:
        """Return the blue, green and red of a frame of PyAV, as stored, without rotation.

        Raises:
            DataError: PyAV cannot convert pixels of this format.
        """
        try:
            # threads are started anew for every frame, and end late
            return np.asarray(frame.to_ndarray(format="bgr24", threads=1))
        except self._av.FFmpegError as error:
            raise DataError(
                f"{self._path}: pixels of the format {frame.format.name} cannot be converted "
                f"({_message(error)}); expected a video in colours or grey levels"
            ) from None

    def time_of(self, frame: Any) -> float:
        """Return the time of a frame after the start of the stream [s]; NaN if it has none."""
        at = frame.pts if frame.pts is not None else frame.dts
        if at is None or frame.time_base is None:
            return float("nan")
        return (at - (self._stream.start_time or 0)) * float(frame.time_base)

    def frames_before(self, first: Any) -> int:
        """Return the approximate number of frames between the start and a later `first` frame."""
        seconds, rate = self.time_of(first), float(self._stream.average_rate or 0)
        return max(0, round(seconds * rate)) if np.isfinite(seconds) else 0


def _opened(av: ModuleType, path: Path) -> Any:
    """Return PyAV's container of a file, also if its title and the like are not in UTF-8."""
    name = f"file:{path}"  # so that a colon in the name does not end the name of a protocol
    try:
        return av.open(name)
    except UnicodeDecodeError:  # only before PyAV 19
        return av.open(name, metadata_errors="replace")


def _message(error: Exception) -> str:
    """Return a decoder's message without the names of files and the error's number."""
    return str(getattr(error, "strerror", None) or error)


def remarks_on(path: Path, frame: Any) -> list[str]:
    """Return sentences about the orientation flag of a video and about interlaced frames."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    remarks = []
    if matrix is not None and not _upright(np.frombuffer(bytes(matrix), np.int32)):
        remarks.append(
            f"{path}: its orientation flag (rotation by {frame.rotation % 360} degrees) is not "
            "applied: the pixels are used as stored"
        )
    if frame.interlaced_frame:
        remarks.append(
            f"{path}: its frames are flagged as interlaced; they are used as stored, and if they "
            "really are, a moving marker has torn edges"
        )
    return remarks


def _upright(matrix: np.ndarray) -> bool:
    """Return whether a display matrix neither rotates nor mirrors; its numbers are 16.16 bits."""
    return bool(matrix[0] > 0 and matrix[4] > 0 and matrix[1] == 0 and matrix[3] == 0)


@dataclass(frozen=True, eq=False)
class Video(FrameSource):
    """A video file, with the frame times in the file or with times given by the user.

    Attributes:
        path: the file.
        times: given time of each frame [s]; None to use `fps` or the times in the file.
        fps: given frame rate from which times are computed [1/s]; None if no rate is given.
    """

    path: Path
    times: Times | None
    fps: float | None

    @classmethod
    def at(cls, path: Path, fps: float | None, times: Times | None) -> "Video":
        """Return the video in a file.

        Raises:
            DataError: the file cannot be opened, or its first frame cannot be decoded.
        """
        if fps is not None:
            even_times(1, fps)
        with VideoStream(path) as stream:
            first = next(stream.frames(), None)
            if first is None:
                raise no_frame(path, stream)
            size, notes = (first.width, first.height), remarks_on(path, first)
            count, lost = stream.count, stream.frames_before(first)
            if lost:
                count = None if count is None else max(1, count - lost)
                notes.append(
                    f"{path}: about {lost} frames at the beginning cannot be decoded, as in a part "
                    "of a longer recording; frames are counted from the first one that can"
                )
        if times is not None:
            count = len(times)
        identity = repr((stamp(path), fps, None if times is None else times.tolist()))
        exact = times is not None
        return cls(str(path), size, count, exact, identity, path, times, fps, notes=notes)

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """Yield the frames, beginning with number `first`; earlier frames are not converted.

        Frames end before the first one that cannot be decoded, and `faults` names it.

        Raises:
            DataError: times in the file do not increase, their size changes, or fewer times than
                frames were given.
        """
        before = -np.inf
        with VideoStream(self.path) as stream:
            for k, frame in enumerate(stream.frames()):
                at = self._time(k, stream.time_of(frame))
                if not at > before:
                    found = f"time {at:.4f} s after {before:.4f} s" if at <= before else "no time"
                    raise DataError(
                        f"{self.name}: frame {k} has {found}; expected times that increase: give "
                        "--fps, or --times FILE"
                    )
                before = at
                if k >= first:
                    yield Frame(k, at, grey_of(stream.picture_of(frame)))
            self.faults[:] = filter(None, [stream.fault])

    def _time(self, k: int, in_file: float) -> float:
        """Return the time of frame number `k`, which has the time `in_file` in the file [s]."""
        if self.fps is not None:
            return k / self.fps
        if self.times is None:
            return in_file
        if k >= len(self.times):
            raise DataError(
                f"{self.name}: more frames than the {len(self.times)} given times; expected one "
                "time for each frame"
            )
        return float(self.times[k])


def no_frame(path: Path, stream: VideoStream) -> DataError:
    """Return the error to raise if a video has no frame that can be used."""
    return DataError(
        f"{stream.fault or f'{path}: no frame that can be decoded'}; expected a video whose first "
        "frames can be decoded (a file that was cut off may have lost its index)"
    )


@dataclass(frozen=True, eq=False)
class Still:
    """A still image, and what the user should know about its file.

    Attributes:
        picture: blue, green and red of every pixel, 0 to 255.
        notes: sentences about orientation flags and interlaced frames.
        faults: sentences about damage, because of which only a part of a video was used.
    """

    picture: UInt8[np.ndarray, "row column 3"]
    notes: list[str]
    faults: list[str]


def still(path: Path) -> Still:
    """Return an image, or the pixelwise median of a video's frames.

    An object that moves through a video appears in the median only if it stays at one spot for at
    least half of the time.

    Raises:
        DataError: the file is neither an image nor a video, or shows a single colour.
    """
    if is_picture(path) or not path.is_file() or not path.stat().st_size:
        notes: list[str] = []
        result = Still(read_picture(path, notes), notes, [])
    else:
        result = _median_of(path)
    few, every = result.picture[::16, ::16], result.picture
    if all((pixels == every[0, 0]).all() for pixels in (few, every)):
        raise DataError(f"{path}: every pixel has the same colour; expected an image of the floor")
    return result


def _median_of(path: Path) -> Still:
    """Return the pixelwise median of frames that are spread over a video."""
    kept: list[np.ndarray] = []
    notes: list[str] = []
    with VideoStream(path) as stream:
        every = max(1, (stream.count or 0) // MEDIAN_FRAMES)
        for k, frame in enumerate(stream.frames()):
            if k % every:
                continue
            kept.append(stream.picture_of(frame))
            notes = notes or remarks_on(path, frame)
            if len(kept) == 2 * MEDIAN_FRAMES or len(kept) * kept[0].nbytes > STILL_BYTES:
                # the video is longer than announced, or large: thin the frames to limit memory
                kept, every = kept[::2], 2 * every
        if not kept:
            raise no_frame(path, stream)
        faults = [] if stream.fault is None else [stream.fault]
    rows = range(0, len(kept[0]), BLOCK_ROWS)
    blocks = [np.median([one[r : r + BLOCK_ROWS] for one in kept], axis=0) for r in rows]
    return Still(np.concatenate(blocks).astype(np.uint8), notes, faults)
