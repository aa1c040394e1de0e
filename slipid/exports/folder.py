"""A folder for a robot: robot.json, its exported forms, and a checksum of every file.

`sha256sum -c SHA256SUMS` checks the folder without slipid. Folders called `build` are ignored,
since they contain files that users build from the exported files.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path

from slipid.support.errors import DataError
from slipid.support.files import write_bytes
from slipid.support.folder import LOCK, name_of_temporary

SUMS = "SHA256SUMS"
"""Name of the file of checksums in an exported folder."""
BUILD = "build"


def write_folder(folder: Path, content: Mapping[str, bytes]) -> None:
    """Write files and their checksums into a folder, and remove all files of an older export.

    Checksums are written first, so that a folder that lacks some files is recognized as an
    incomplete export and can be written again.

    Raises:
        DataError: the folder is refused by `check_writable`, or cannot be written.
    """
    check_writable(folder)
    for name in sorted(_files(folder) - {SUMS}):
        (folder / name).unlink()
        for above in (folder / name).parents:
            if above == folder or any(above.iterdir()):
                break
            above.rmdir()
    sums = "".join(f"{_sum(data)}  {name}\n" for name, data in sorted(content.items()))
    write_bytes(folder / SUMS, sums.encode())
    for name, data in content.items():
        write_bytes(folder / name, data)


def check_writable(folder: Path) -> None:
    """Raise `DataError` unless a folder is absent, empty or an unchanged export.

    An interrupted export counts as unchanged.

    Raises:
        DataError: the path is not a folder, or a file in the folder was added or changed by hand.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DataError(f"{folder}: not a folder; expected another path (--out)")
    sums = _sums(folder) if (folder / SUMS).is_file() else {}
    for name in sorted(_files(folder) - {SUMS}):
        if name_of_temporary(name) in {SUMS, *sums}:
            # an interrupted export left this temporary file: `write_folder` removes it
            continue
        if name not in sums:
            raise DataError(
                f"{folder}: contains files that an export did not write ({name}); expected an "
                "empty or new folder (--out)"
            )
        if _sum((folder / name).read_bytes()) != sums[name]:
            raise DataError(
                f"{folder / name}: changed since it was exported, and would be overwritten; move "
                "the file elsewhere, or choose another folder (--out)"
            )


def check_folder(folder: Path | str) -> tuple[str, ...]:
    """Return the names of the files in an exported folder, after checking that none has changed.

    Raises:
        DataError: a file is absent or changed, or was added after the folder was written.
    """
    place = Path(folder)
    sums = _sums(place)
    for name, expected in sums.items():
        try:
            data = (place / name).read_bytes()
        except OSError as error:
            raise DataError(f"{place / name}: {error.strerror}; export the robot again") from error
        if _sum(data) != expected:
            raise DataError(
                f"{place / name}: changed or damaged since it was exported; export the robot "
                "again, to another folder"
            )
    if more := sorted(_files(place) - set(sums) - {SUMS}):
        raise DataError(
            f"{place / more[0]}: added after the export; move the file elsewhere, or export the "
            "robot again"
        )
    return tuple(sums)


def _sums(folder: Path) -> dict[str, str]:
    """Return the checksums in a folder's `SHA256SUMS`, keyed by the file's path in the folder.

    Raises:
        DataError: the file is absent, or a line does not have the form of `sha256sum`.
    """
    try:
        text = (folder / SUMS).read_text()
    except (OSError, UnicodeDecodeError):
        text = ""
    lines = [re.fullmatch(r"([0-9a-f]{64})  ([\w.-]+(?:/[\w.-]+)*)", x) for x in text.splitlines()]
    named = {line[2]: line[1] for line in lines if line and ".." not in line[2].split("/")}
    if not lines or len(named) < len(lines):
        raise DataError(
            f"{folder / SUMS}: absent, or not a list of checksums; expected a folder that `slipid "
            "export` wrote"
        )
    return named


def _files(folder: Path) -> set[str]:
    """Return the paths of the files in a folder, except its lock and files in folders `build`."""
    paths = (p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    return {p.as_posix() for p in paths if BUILD not in p.parts and p != Path(LOCK)}


def _sum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
