"""Limits for the unpacking of compressed bags, since a small file may fill memory or disk.

The package rosbags, which reads bags, has no limits of its own.
"""

import bz2
import os
from collections.abc import Callable
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, BinaryIO

MOST_BYTES = 256 * 2**20
"""Largest size of a message, or of a chunk of messages [byte]."""
MOST_TIMES = 200
"""Largest size of an unpacked file, above `MOST_BYTES`, over that of the packed one [1]."""


@cache
def limit_rosbags() -> None:
    """Replace the functions with which rosbags unpacks chunks, messages and files.

    The new ones raise `ValueError` for what is cut off or too large.
    """
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as reader1
    from rosbags.rosbag2 import reader as reader2
    from rosbags.rosbag2 import storage_mcap

    module: Any = vars(reader2)["zstd"]
    lz4 = partial(_within, LZ4FrameDecompressor)
    zstd = partial(_within, module.ZstdDecompressor)
    reader1.decompressors |= {"bz2": partial(_within, bz2.BZ2Decompressor), "lz4": lz4}
    storage_mcap.DECOMPRESSORS |= {"lz4": lambda raw, _: lz4(raw), "zstd": lambda raw, _: zstd(raw)}
    limited = SimpleNamespace(decompress=zstd, open=partial(_opened, module.open))
    vars(reader2)["zstd"] = limited


def _within(kind: Callable[[], Any], packed: bytes) -> bytes:
    """Return unpacked bytes; `kind` makes a decompressor."""
    unpacker = kind()
    raw: bytes = unpacker.decompress(packed, max_length=MOST_BYTES)
    if not unpacker.eof or unpacker.unused_data:
        raise ValueError(f"compressed data that is cut off, or over {MOST_BYTES} bytes large")
    return raw


def _opened(open_packed: Callable[..., Any], packed: BinaryIO, mode: str) -> Any:
    """Return the stream of an unpacked file; `open_packed` makes one without a limit."""
    most, stream = (
        MOST_BYTES + MOST_TIMES * os.fstat(packed.fileno()).st_size,
        open_packed(packed, mode),
    )
    plain = stream.read

    def read(size: int = -1) -> bytes:
        block: bytes = plain(size)
        if stream.tell() > most:
            raise ValueError(f"a compressed file of over {most} bytes")
        return block

    stream.read = read
    return stream
