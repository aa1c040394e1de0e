"""Reading and writing of files: atomic writes, strict JSON, and arrays without pickle."""

import hashlib
import json
import os
import stat
from collections.abc import Iterable, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from slipid.support.errors import DataError
from slipid.support.folder import MARKED, MARKS, refuse_foreign, temporary_of
from slipid.support.parsing import MOST_ARRAY_BYTES, arrays_of, json_of

PIPE = "a pipe or a device; save it to a file first"
"""Words of messages for a path of no regular file, such as `<(command)` of a shell."""


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically: after a crash, there is either the old or the new file.

    Raises:
        DataError: the file cannot be written.
    """
    write_together({path: data})


def write_together(content: Mapping[Path, bytes], outdated: Iterable[Path] = ()) -> None:
    """Write several files, each atomically, after all of them fit on the disk.

    A file of a marked kind (see `MARKS`) only replaces a file with the same mark. If a file cannot
    be written, all old files stay as they are. Otherwise outdated files are
    deleted, except links through which a file is written, and the new files then appear in the
    given order. If the process is killed in between, the last file is thus missing if it was among
    the outdated ones.

    Args:
        content: content of each file, keyed by its path, which may be a symbolic link to the file.
        outdated: paths of files to delete, in this order; they may be absent.

    Raises:
        DataError: a file cannot be written.
    """
    temporary: dict[Path, Path] = {}
    path = Path()
    removed = [path for path in outdated if not (path in content and path.is_symlink())]
    for path in removed:
        if path.is_dir() and not path.is_symlink():
            raise DataError(f"{path}: a folder; expected a file that is replaced; move it away")
    try:
        for path, data in content.items():
            target = target_of(path)
            for mark in MARKS.values():
                if mark in data[:MARKED]:
                    refuse_foreign(path, mark)
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary[target] = temporary_of(target)
            with temporary[target].open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        for path in removed:
            path.unlink(missing_ok=True)
        for path, partial in temporary.items():
            partial.replace(path)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be written ({error.strerror}); expected a writable folder"
        ) from error
    finally:
        for partial in temporary.values():
            with suppress(OSError):
                partial.unlink(missing_ok=True)


def target_of(path: Path) -> Path:
    """Return the file to write for a path, which may be a symbolic link; it need not exist.

    Raises:
        DataError: the path is that of a folder, a device or a pipe, or is no possible path.
    """
    kind = None
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            kind = "a folder"
        elif not stat.S_ISREG(mode):
            kind = "a device or a pipe"
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:  # a null character in a path is a ValueError
        reason = getattr(error, "strerror", None) or str(error)
        raise DataError(f"{str(path)[:80]}: cannot be written ({reason})") from error
    # /dev/stdout leads to a file if the output is redirected; replacing this would lose the output
    _, *above = path.absolute().parts[:3]
    if os.name == "posix" and above[:1] in (["dev"], ["proc"]) and above != ["dev", "shm"]:
        kind = "a device or a pipe"
    if kind is not None:
        raise DataError(f"{path}: cannot be written ({kind}); expected the name of a file")
    return Path(os.path.realpath(path))


def writable(folder: Path) -> None:
    """Make a folder and raise `DataError` if it is not writable.

    Call it before long work whose results will be written to the folder.
    """
    path = temporary_of(folder / "writable")
    write_bytes(path, b"")
    path.unlink()


def write_json(path: Path, value: object) -> None:
    """Write a JSON file; raise `ValueError` for numbers that are not finite."""
    write_bytes(path, json_text(value).encode())


def json_text(value: object) -> str:
    """Return the JSON text of plain values, numpy arrays and paths.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    return json.dumps(value, indent=1, allow_nan=False, default=_plain) + "\n"


def checksum(content: Mapping[str, object]) -> str:
    """Return the SHA-256 hash of the JSON text of plain values, with sorted keys and no spaces."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def read_bytes(path: Path, what: str, most: int = 256 * 2**20) -> bytes:
    """Return the content of a file.

    Args:
        path: the file.
        what: expected kind of file, for messages.
        most: largest size of the file [bytes].

    Raises:
        DataError: the file is absent, unreadable, too large or not a regular file.
    """
    try:
        kept = path.stat()
        if not stat.S_ISREG(kept.st_mode):
            found = "a folder" if stat.S_ISDIR(kept.st_mode) else PIPE
            raise DataError(f"{path}: {found}; expected {what}")
        if kept.st_size > most:
            raise DataError(f"{path}: {kept.st_size} bytes; expected {what}, at most {most} bytes")
        return path.read_bytes()
    except DataError:
        raise
    except (OSError, ValueError) as error:  # a null character in a path is a ValueError
        reason = getattr(error, "strerror", None) or str(error)
        raise DataError(f"{path}: {reason}; expected {what}") from error


def read_json(path: Path, what: str) -> Any:
    """Return the content of a JSON file.

    Raises:
        DataError: the file is missing or not JSON (see `json_of`); the message names `what` was
            expected.
    """
    raw = read_bytes(path, what)
    try:
        return json_of(raw)
    except ValueError as error:
        raise DataError(f"{path}: {error}; expected {what}") from error


def read_arrays(path: Path, what: str) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name.

    Raises:
        DataError: the file is missing, damaged or too large (see `arrays_of`); the message names
            `what` was expected.
    """
    # directories and headers of the file are small, beside arrays of the largest size
    raw = read_bytes(path, what, MOST_ARRAY_BYTES + 2**20)
    try:
        return arrays_of(raw)
    except ValueError as error:
        raise DataError(f"{path}: {error}; expected {what}") from error


def write_arrays(path: Path, arrays: dict[str, np.ndarray], compress: bool = True) -> None:
    """Write named arrays to an .npz file without pickle."""
    buffer = BytesIO()
    save = np.savez_compressed if compress else np.savez
    save(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def hash_of(runs: Iterable[tuple[str, str]]) -> str:
    """Return the hash of a set of runs, from pairs of name and file hash in any order."""
    lines = "".join(f"{name} {sha}\n" for name, sha in sorted(runs))
    return hashlib.sha256(lines.encode()).hexdigest()
