"""Frames decoded ahead, in a thread of their own."""

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor

from slipid.vision.tracking.frames.frame import Frame

DEPTH = 8
"""Frames that are decoded ahead."""


def ahead(frames: Iterator[Frame]) -> Generator[Frame]:
    """The same frames, decoded in a thread of their own; its errors are raised where they are used.

    Decoding ends with the frames, or when nobody wants more.
    """
    with ThreadPoolExecutor(1) as thread:
        decoded = deque(thread.submit(next, frames, None) for _ in range(DEPTH))
        try:
            while (frame := decoded.popleft().result()) is not None:
                decoded.append(thread.submit(next, frames, None))
                yield frame
        finally:
            for waiting in decoded:
                waiting.cancel()
