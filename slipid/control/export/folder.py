"""A folder that goes to a robot: robot.json, the forms made of it, and the checksum of every file.

`sha256sum -c SHA256SUMS` checks it where there is no slipid.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path

from slipid.support.errors import DataError
from slipid.support.files import write_bytes

SUMS = "SHA256SUMS"


def write_folder(folder: Path, content: Mapping[str, bytes]) -> None:
    """Write files and their checksums, which come last: without them no folder is whole.

    Raises:
        DataError: nothing can be written there, or a file lies there that is none of an export's.
    """
    _cleared(folder)
    for name, data in content.items():
        write_bytes(folder / name, data)
    sums = "".join(f"{_sum(data)}  {name}\n" for name, data in sorted(content.items()))
    write_bytes(folder / SUMS, sums.encode())


def _cleared(folder: Path) -> None:
    """Remove an older export, so that nothing of it stays; refuse a folder that is none."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DataError(f"{folder}: not a folder; name another one with --out")
    here = _files(folder)
    if not here:
        return
    known = set(_sums(folder)) | {SUMS} if (folder / SUMS).is_file() else set()
    if here - known:
        raise DataError(
            f"{folder}: has files that no export wrote ({sorted(here - known)[0]}); name another "
            "folder with --out"
        )
    for name in [SUMS, *sorted(here - {SUMS})]:
        (folder / name).unlink()


def check_folder(folder: Path | str) -> tuple[str, ...]:
    """Names of the files of a folder, all of them as they were written.

    Raises:
        DataError: one is absent, changed, or was not there when the folder was written.
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
                f"{place / name}: changed or damaged after it was written; export the robot again"
            )
    if more := sorted(_files(place) - set(sums) - {SUMS}):
        raise DataError(
            f"{place / more[0]}: not there when the folder was written; move it elsewhere, or "
            "export the robot again"
        )
    return tuple(sums)


def _sums(folder: Path) -> dict[str, str]:
    """Checksum of every file by its name, as they were written."""
    try:
        text = (folder / SUMS).read_text()
    except (OSError, UnicodeDecodeError):
        text = ""
    lines = [re.fullmatch(r"([0-9a-f]{64})  ([\w.-]+(?:/[\w.-]+)*)", x) for x in text.splitlines()]
    named = {line[2]: line[1] for line in lines if line and ".." not in line[2].split("/")}
    if not lines or len(named) < len(lines):
        raise DataError(
            f"{folder / SUMS}: cannot be read; expected a folder that `slipid export` wrote"
        )
    return named


def _files(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def _sum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
