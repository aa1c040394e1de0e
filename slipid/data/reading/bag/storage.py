"""Files of a bag, their storage format and hash.

An MCAP file that was cut off can be read as if it ended after its last complete record.
"""

import hashlib
import io
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from slipid.data.reading.containers import refuse_other
from slipid.support.errors import bad_data, first_names

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

Storage = Literal["rosbag1", "sqlite3", "mcap", "ulog"]
EXPECTED = (
    "a bag: a .bag file, a .db3 or .mcap file, the folder that ros2 bag record wrote, or a .ulg "
    "file of PX4"
)
OPENABLE = "a bag that can be opened; check its permissions"
_MAGIC: dict[Storage, bytes] = {
    "rosbag1": b"#ROSBAG V",
    "sqlite3": b"SQLite format 3\0",
    "mcap": b"\x89MCAP0\r\n",
    "ulog": b"ULog\x01\x12\x35",
}
_SUFFIX: dict[Storage, str] = {
    "rosbag1": ".bag",
    "sqlite3": ".db3",
    "mcap": ".mcap",
    "ulog": ".ulg",
}


@dataclass(frozen=True)
class BagFiles:
    """Files of one bag.

    Attributes:
        path: the given file, or the folder of a rosbag2.
        storage: storage format of the messages.
        parts: files with messages, sorted by the numbers in their names.
        metadata: metadata.yaml of a rosbag2 folder, None for a single file or if it is missing.
    """

    path: Path
    storage: Storage
    parts: tuple[Path, ...]
    metadata: Path | None

    @property
    def sha256(self) -> str:
        """Return the SHA-256 hash of the bag.

        For a single file it is the hash of the file; for several files, that of the text that
        `sha256sum` prints about them.
        """
        files = [*self.parts, *([self.metadata] if self.metadata else [])]
        if len(files) == 1:
            return _hash(files[0])
        lines = sorted((path.name, _hash(path)) for path in files)
        text = "".join(f"{digest}  {name}\n" for name, digest in lines)
        return hashlib.sha256(text.encode()).hexdigest()


def files_of(path: Path) -> BagFiles:
    """Return the files of a bag.

    Args:
        path: a file, the folder of a rosbag2, or the metadata.yaml in such a folder.

    Raises:
        DataError: there is no bag at the path.
    """
    if path.name == "metadata.yaml":
        path = path.parent
    if not path.exists():
        raise bad_data(path, "no such file or folder", EXPECTED)
    if not path.is_dir():
        return BagFiles(path, _storage_of(path), (path,), None)
    found = [p for p in path.iterdir() if re.search(r"\.(mcap|db3)(\.zstd)?$", p.name)]
    if not found:
        inside = sorted(p.name for p in path.iterdir())
        listed = first_names(inside, "empty")
        raise bad_data(path, f"a folder without a .db3 or .mcap file ({listed})", EXPECTED)
    parts = tuple(sorted(found, key=_numbers_in_name))
    storage: Storage = "mcap" if ".mcap" in parts[0].name else "sqlite3"
    metadata = path / "metadata.yaml"
    return BagFiles(path, storage, parts, metadata if metadata.exists() else None)


def _storage_of(path: Path) -> Storage:
    """Return the storage format of a file by its first bytes.

    Raises:
        DataError: the file is not a bag, or its suffix is that of another format.
    """
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise bad_data(path, f"cannot be read ({error.strerror})", OPENABLE) from error
    if not start:
        raise bad_data(path, "the file is empty", EXPECTED)
    for storage, magic in _MAGIC.items():
        if start.startswith(magic):
            if path.suffix != _SUFFIX[storage]:
                expected = f"the suffix of this format; rename it to {path.stem}{_SUFFIX[storage]}"
                raise bad_data(path, f"a {storage} bag", expected)
            return storage
    refuse_other(path)
    raise bad_data(path, f"not a bag (it starts with {start[:8]!r})", EXPECTED)


def _numbers_in_name(path: Path) -> tuple[tuple[int, str], ...]:
    """Return a key that sorts file names by the numbers in them, `bag_10` after `bag_9`."""
    parts = re.split(r"(\d+)", path.name)
    return tuple((int(part), "") if part.isdigit() else (-1, part) for part in parts)


def _hash(path: Path) -> str:
    """Return the SHA-256 hash of a file."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise bad_data(path, f"cannot be read ({error.strerror})", OPENABLE) from error


_DATA_END, _FOOTER = 0x0F, 0x02
# End of an MCAP file without a summary, so that readers go through all records.
_END = struct.pack("<BQQQI", _FOOTER, 20, 0, 0, 0) + _MAGIC["mcap"]


@dataclass(frozen=True)
class RepairedMcap:
    """Path-like object that opens a cut-off MCAP file as if it were complete.

    Attributes:
        path: path of the file.
        end: offset of the byte after the last complete record.
    """

    path: Path
    end: int

    def __getattr__(self, name: str) -> object:
        """Return an attribute of the path."""
        return getattr(self.path, name)

    def open(self, *_: object) -> io.BufferedReader:
        """Return a stream of the complete records, followed by the end of an MCAP file."""
        return io.BufferedReader(_RepairedBytes(self.path, self.end), buffer_size=1 << 16)


def repaired(path: Path) -> RepairedMcap | None:
    """Return a cut-off MCAP file up to its last complete record, or None if it has no message."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8) != _MAGIC["mcap"]:
            return None
        end, records = 8, 0
        while True:
            head = file.read(9)
            if len(head) < 9:
                break
            kind, length = struct.unpack("<BQ", head)
            # Reading stops at the record that ends the data, since no messages follow it, or at a
            # zero byte, or at a record that was cut off.
            if kind == _DATA_END or kind == 0 or end + 9 + length > size:
                break
            end, records = file.seek(end + 9 + length), records + 1
    # The first record is a header; a file with nothing else contains no message.
    return RepairedMcap(path, end) if records > 1 else None


class _RepairedBytes(io.RawIOBase):
    """Stream of the first `end` bytes of a file, followed by the end of an MCAP file."""

    def __init__(self, path: Path, end: int) -> None:
        super().__init__()
        self._file, self._end = path.open("rb"), end

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence == io.SEEK_END:
            offset, whence = offset + self._end + len(_END), io.SEEK_SET
        return self._file.seek(offset, whence)

    def readinto(self, buffer: "WriteableBuffer") -> int:
        view, at = memoryview(buffer), self._file.tell()
        if at < self._end:
            return self._file.readinto(view[: self._end - at])
        data = _END[at - self._end :][: len(view)]
        view[: len(data)] = data
        self._file.seek(at + len(data))
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
