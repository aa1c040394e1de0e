"""A folder for a robot: robot.json, its exported forms, and a checksum of every file.

`sha256sum -c SHA256SUMS` checks the folder without slipid. Folders named `build` are ignored: they
contain files that users build from the exported ones.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path

from slipid.support.errors import DataError
from slipid.support.files import write_bytes

SUMS = "SHA256SUMS"
BUILD = "build"


def write_folder(folder: Path, content: Mapping[str, bytes]) -> None:
    """Write files and their checksums into a folder, and remove all files of an older export.

    Checksums are written first: a folder that lacks some files is then recognized as an incomplete
    export, and can be written again.

    Raises:
        DataError: as in `check_writable`, or the folder cannot be written.
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

    Raises:
        DataError: the path is not a folder, or a file in it was added or changed by hand.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DataError(f"{folder}: not a folder; expected another path (--out)")
    sums = _sums(folder) if (folder / SUMS).is_file() else {}
    for name in sorted(_files(folder) - {SUMS}):
        if _name_of_temporary(name) in {SUMS, *sums}:
            continue  # a temporary file of an interrupted export may be overwritten
        if name not in sums:
            raise DataError(
                f"{folder}: contains files that are not from an export ({name}); expected another "
                "folder (--out)"
            )
        if _sum((folder / name).read_bytes()) != sums[name]:
            raise DataError(
                f"{folder / name}: changed since it was written, and would be overwritten; move "
                "it elsewhere, or choose another folder (--out)"
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
                f"{place / name}: changed or damaged since it was written; export the robot "
                "again, to another folder"
            )
    if more := sorted(_files(place) - set(sums) - {SUMS}):
        raise DataError(
            f"{place / more[0]}: added after the folder was written; move it elsewhere, or "
            "export the robot again"
        )
    return tuple(sums)


def _sums(folder: Path) -> dict[str, str]:
    """Return the checksums in the folder's checksum file, keyed by file name."""
    try:
        text = (folder / SUMS).read_text()
    except (OSError, UnicodeDecodeError):
        text = ""
    lines = [re.fullmatch(r"([0-9a-f]{64})  ([\w.-]+(?:/[\w.-]+)*)", x) for x in text.splitlines()]
    named = {line[2]: line[1] for line in lines if line and ".." not in line[2].split("/")}
    if not lines or len(named) < len(lines):
        raise DataError(
            f"{folder / SUMS}: cannot be read; expected a folder written by `slipid export`"
        )
    return named


def _name_of_temporary(name: str) -> str | None:
    """Return the name that a temporary file of `write_bytes` would get; None for other files."""
    match = re.fullmatch(r"((?:.*/)?)\.(.+)\.[0-9a-f]{8}", name)
    return None if match is None else match[1] + match[2]


def _files(folder: Path) -> set[str]:
    """Return the paths of the files in a folder, except those in folders named `build`."""
    paths = (p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    return {p.as_posix() for p in paths if BUILD not in p.parts}


def _sum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
