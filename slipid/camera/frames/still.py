"""A picture of the floor: a photograph, or the middle of what a video shows at each place."""

from contextlib import closing
from pathlib import Path

import numpy as np

from slipid.camera.frames.source import PICTURES
from slipid.camera.frames.video import Capture
from slipid.camera.opencv import opencv, read_picture
from slipid.support.errors import DataError

FRAMES = 25
"""Frames of a video whose median is taken."""


def is_picture(path: Path) -> bool:
    """Whether a file is taken for a picture, by its name."""
    return path.suffix.lower() in PICTURES


def still(path: Path) -> np.ndarray:
    """Rows, columns, and blue, green, red of a picture, or of the median of a video's frames.

    What moves through a video is in no median, unless it stands in one place half of the time.

    Raises:
        DataError: neither a picture nor a video.
    """
    if is_picture(path) or not path.is_file() or not path.stat().st_size:
        return read_picture(path)
    with closing(Capture(str(path))) as capture:
        count = int(capture.value(opencv().CAP_PROP_FRAME_COUNT))
        every, kept = max(1, count // FRAMES), []
        for k in range(10**9):
            wanted = k % every == 0
            picture = capture.next_picture(decode=wanted)
            if picture is None:
                break
            kept += [picture] if wanted else []
            if len(kept) == 2 * FRAMES:  # of a video that does not know its length
                kept, every = kept[::2], 2 * every
    if not kept:
        raise DataError(f"{path}: no frame that OpenCV can decode; expected a picture or a video")
    return np.median(np.stack(kept), axis=0).astype(np.uint8)
