"""Pictures that a test holds as a source of frames, and as a video file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slipid.camera.frames.frame import Frame
from tests.helpers.made_videos import FPS


@dataclass(frozen=True, eq=False)
class InMemory:
    """Frames that a test holds, as a source."""

    pictures: Sequence[np.ndarray]
    times: np.ndarray
    name: str = "made.avi"
    identity: str = "made"
    exact: bool = False

    @classmethod
    def even(cls, pictures: Sequence[np.ndarray], fps: float = FPS) -> InMemory:
        return cls(pictures, np.arange(len(pictures)) / fps)

    @property
    def image_px(self) -> tuple[int, int]:
        return self.pictures[0].shape[1], self.pictures[0].shape[0]

    @property
    def count(self) -> int:
        return len(self.pictures)

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
