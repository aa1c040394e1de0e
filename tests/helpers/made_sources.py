"""Pictures of a test as a source of frames, and as a video file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np

from slipid.camera.frame import Frame, FrameSource
from tests.helpers.made_videos import FPS


@dataclass(frozen=True, eq=False)
class InMemory(FrameSource):
    """Frames that a test holds, as a source."""

    pictures: Sequence[np.ndarray]
    times: np.ndarray

    @classmethod
    def even(cls, pictures: Sequence[np.ndarray], fps: float = FPS) -> InMemory:
        size, times = pictures[0].shape[::-1], np.arange(len(pictures)) / fps
        return cls("made.avi", size, len(pictures), False, "made", pictures, times)

    def frames(self, first: int = 0) -> Iterator[Frame]:
        for k in range(first, len(self.pictures)):
            yield Frame(k, float(self.times[k]), self.pictures[k])


def write_video(path: Path, pictures: Sequence[np.ndarray], fps: float = FPS) -> Path:
    """Frames as Motion JPEG."""
    size = (pictures[0].shape[1], pictures[0].shape[0])
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for picture in pictures:
        video.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    video.release()
    return path


def encoded(
    path: Path,
    pictures: Sequence[np.ndarray],
    *,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    rotation: int = 0,
    options: dict[str, str] | None = None,
) -> Path:
    """Write frames at FPS with a codec of FFmpeg and its options, and an orientation flag [deg]."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=round(FPS), options=options or {})
        stream.height, stream.width = pictures[0].shape
        stream.pix_fmt = pixels
        if rotation:
            stream.set_display_rotation(rotation)
        for picture in pictures:
            rgb = np.repeat(picture[..., None], 3, axis=2)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, "rgb24")))
        file.mux(stream.encode())
    return path
