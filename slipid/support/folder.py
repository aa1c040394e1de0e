"""Folders that commands write to: one writer at a time, leftovers of killed ones, foreign files."""

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from slipid.support.errors import DataError, shown

HAS_LOCKS = os.name == "posix"
"""True if the system has locks that end with their process."""
LOCK = ".slipid.lock"
"""Name of the file that the writer of a folder locks; it names the writer."""
MOST_NAME_BYTES = 200
"""Largest number of bytes of a file's name that its temporary name repeats."""
MARKS = {
    ".json": b'"slipid.',
    ".geojson": b'"slipid.',
    ".html": b'<meta name="generator" content="slipid">',
    ".png": b"Software\0slipid",
    ".nc": b"slipid.",
    ".mcap": b"\0\0\0slipid ",
}
"""Bytes by which a file of slipid is recognised, keyed by the ending of its usual name."""
_MARKS_OF_NAMES = {
    "design_commands.csv": b"run,floor,load,",
    "motor_feedforward.h": b"slipid",
    "motor_feedforward.yaml": b"slipid",
}
"""Bytes by which files of other kinds are recognised, keyed by their name."""
_PICTURE_OF_MATPLOTLIB = b"Software\0Matplotlib version"
MARKED = 4096
"""Number of bytes at the beginning and at the end of a file that are searched for its mark."""
MOST_SORTED = 64 * 2**20
"""Number of bytes of JSON that are searched for its mark, as other programs may sort its keys."""


def temporary_of(path: Path) -> Path:
    """Return a new temporary path beside a file, from which the file is renamed."""
    name = path.name.encode()[:MOST_NAME_BYTES].decode(errors="ignore")
    return path.parent / f".{name}.slipid-{secrets.token_hex(4)}"


def name_of_temporary(name: str) -> str | None:
    """Return the final name of a temporary file; None for other files.

    `name` may contain folders.
    """
    match = re.fullmatch(r"((?:.*/)?)\.(.+)\.slipid-[0-9a-f]{8}", name)
    return None if match is None else match[1] + match[2]


def refuse_foreign(path: Path, mark: bytes | None = None) -> None:
    """Raise `DataError` if a file exists that slipid did not write, and would thus be lost.

    A file whose ends are empty or only zeros, as after a power cut, can be replaced.

    Args:
        path: the file to write, which may be absent.
        mark: bytes at the beginning or the end of the files of slipid; those for the path by
            default. Files for which there is no mark are not checked.
    """
    if mark is None:
        mark = _MARKS_OF_NAMES.get(path.name, MARKS.get(path.suffix))
    if mark is None or not path.is_file():
        return
    with suppress(OSError), path.open("rb") as file:  # not readable: an error when it is written
        found = file.read(MOST_SORTED if path.suffix == ".json" else MARKED)
        file.seek(max(0, path.stat().st_size - MARKED))
        found += file.read()
        if found.strip(b"\0") and mark not in found and not _is_older(path, found):
            raise DataError(
                f"{path}: exists and was not written by slipid, and would be overwritten; expected "
                "a new name or folder (or move the file away)"
            )


def _is_older(path: Path, head: bytes) -> bool:
    """Return True for a picture by matplotlib beside a JSON result: older versions marked none."""
    return _PICTURE_OF_MATPLOTLIB in head and any(
        MARKS[".json"] in beside.read_bytes()[:MARKED] for beside in path.parent.glob("*.json")
    )


@contextmanager
def locked(folder: Path | None, command: str, *names: str) -> Iterator[None]:
    """Return a context in which no other command of slipid writes to a folder.

    The folder is made if necessary. Temporary files that killed commands left in it are deleted.
    The system releases the lock when the process ends, however it ends. Systems and file systems
    without locks are used without one.

    Args:
        folder: the folder; None for a command that writes to none.
        command: name of the command, for the message to others.
        names: names of files that the command will write, among others, with * as a wildcard.

    Raises:
        DataError: a different process has the lock, which the message names, the folder cannot be
            written, or a file that slipid did not write has one of the names.
    """
    if folder is None:
        yield
        return
    for path in (path for name in names for path in folder.glob(name)):
        refuse_foreign(path)
    if not HAS_LOCKS:
        _remove_leftovers(folder)
        yield
        return
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    lock = _locked_file(folder, f"`slipid {command}` (process {os.getpid()})")
    try:
        _remove_leftovers(folder)
        yield
    finally:
        # Deleted while it is locked: who opened it before will notice, see `_locked_file`.
        with suppress(OSError):
            (folder / LOCK).unlink()
        os.close(lock)
        with suppress(OSError):  # it has results
            for path in new:
                path.rmdir()


def _locked_file(folder: Path, owner: str) -> int:
    """Return the descriptor of the locked file in a folder; the file then names its owner."""
    import fcntl

    path = folder / LOCK
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = _opened(path)
        except OSError as error:
            reason = _obstacle(folder, error)
            found = "a file" if folder.is_file() else f"cannot be written ({reason})"
            raise DataError(f"{folder}: {found}; expected a writable folder") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            other = os.pread(lock, 100, 0).decode(errors="replace") or "a different command"
            os.close(lock)
            raise DataError(
                f"{folder}: {other} is writing to this folder; wait until it has ended, or choose "
                "a different folder"
            ) from None
        except OSError:  # a network file system without locks
            pass
        # The previous owner may have deleted the file after it was opened here.
        with suppress(OSError):
            if os.path.samestat(os.fstat(lock), path.stat()):
                with suppress(OSError):  # a full disk: the lock then names nobody
                    os.ftruncate(lock, 0)
                    os.pwrite(lock, owner.encode(), 0)
                return lock
        os.close(lock)


def _opened(path: Path) -> int:
    """Return the descriptor of a lock file, which is made if necessary."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except PermissionError as error:
        # a different user's file, left by a killed command, can be locked without writing to it
        try:
            return os.open(path, os.O_RDONLY)
        except FileNotFoundError:
            raise error from None


def _obstacle(path: Path, error: OSError) -> str:
    """Return why a path cannot be written, which for links that lead nowhere no system explains."""
    for above in (path, *path.parents):
        if above.is_symlink() and not os.path.exists(above):
            return f"{shown(str(above))} is a link that leads nowhere"
    return str(error.strerror or error)


def _remove_leftovers(folder: Path) -> None:
    """Delete the temporary files in a folder and in its subfolders.

    Hidden subfolders, and those with a lock of their own, are left to those who use them.
    """
    for root, folders, files in os.walk(folder):
        inner = [name for name in folders if not name.startswith(".")]
        folders[:] = [name for name in inner if not (Path(root) / name / LOCK).exists()]
        for name in filter(name_of_temporary, files):
            with suppress(OSError):
                (Path(root) / name).unlink()
