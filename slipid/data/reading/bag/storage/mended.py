"""An MCAP file that was cut off, shown to a reader as if it ended with its last whole record."""

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

MAGIC = b"\x89MCAP0\r\n"
_DATA_END, _FOOTER = 0x0F, 0x02
# A footer that names no summary: readers then look through the records themselves.
_END = struct.pack("<BQQQI", _FOOTER, 20, 0, 0, 0) + MAGIC


@dataclass(frozen=True)
class MendedMcap:
    """Path of a cut MCAP file that opens as a whole one.

    Attributes:
        path: the file.
        end: byte after its last whole record.
    """

    path: Path
    end: int

    @property
    def suffix(self) -> str:
        """As of a path."""
        return self.path.suffix

    @property
    def stem(self) -> str:
        """As of a path."""
        return self.path.stem

    def exists(self) -> bool:
        """As of a path."""
        return True

    def is_dir(self) -> bool:
        """As of a path."""
        return False

    def open(self, *_: object, **__: object) -> io.BufferedReader:
        """The whole records, and an end."""
        return io.BufferedReader(_Mended(self.path, self.end), buffer_size=1 << 16)


def mended(path: Path) -> MendedMcap | None:
    """The whole records of a cut MCAP file, None where there are none, or where it has its end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8) != MAGIC:
            return None
        end, records = 8, 0
        while True:
            head = file.read(9)
            if len(head) < 9:
                break
            kind, length = struct.unpack("<BQ", head)
            # where the summary begins there are no more messages
            if kind == _DATA_END or kind == 0 or end + 9 + length > size:
                break
            end, records = file.seek(end + 9 + length), records + 1
    # the first record is a header, which alone is no bag
    return MendedMcap(path, end) if records > 1 else None


class _Mended(io.RawIOBase):
    """Bytes of a file up to an end, and behind them the end of an MCAP file."""

    def __init__(self, path: Path, end: int) -> None:
        super().__init__()
        self._file, self._end, self._at = path.open("rb"), end, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._end + len(_END)}[whence]
        self._at = base + offset
        return self._at

    def readinto(self, buffer: "WriteableBuffer") -> int:
        view = memoryview(buffer)
        if self._at < self._end:
            self._file.seek(self._at)
            data = self._file.read(min(len(view), self._end - self._at))
        else:
            first = self._at - self._end
            data = _END[first : first + len(view)]
        view[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
