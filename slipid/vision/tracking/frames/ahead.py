"""Frames decoded ahead, in a thread of their own."""

import queue
import threading
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field

from slipid.vision.tracking.frames.frame import Frame

DEPTH = 8
"""Frames that are decoded ahead."""


@dataclass
class _Ended:
    """Put behind the last frame: how decoding ended."""

    error: BaseException | None = None


@dataclass
class _Ahead:
    """A thread that decodes ahead."""

    frames: Iterator[Frame]
    decoded: "queue.Queue[Frame | _Ended]" = field(default_factory=lambda: queue.Queue(DEPTH))
    stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Decode until the end, or until nobody wants more."""
        ended = _Ended()
        try:
            for frame in self.frames:
                if not self._put(frame):
                    return
        except BaseException as error:  # raised again where the frames are used
            ended = _Ended(error)
        self._put(ended)

    def _put(self, what: Frame | _Ended) -> bool:
        while not self.stop.is_set():
            try:
                self.decoded.put(what, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False


def ahead(frames: Iterator[Frame]) -> Generator[Frame]:
    """The same frames, decoded in a thread of their own."""
    worker = _Ahead(frames)
    thread = threading.Thread(target=worker.run, daemon=True)
    thread.start()
    try:
        while True:
            got = worker.decoded.get()
            if isinstance(got, _Ended):
                if got.error is not None:
                    raise got.error
                return
            yield got
    finally:
        worker.stop.set()
        thread.join()
