"""A folder that goes to a robot: robot.json, the forms made of it, and the checksum of every file.

`sha256sum -c SHA256SUMS` checks it where there is no slipid. Folders named `build` hold what is
built of it, and count as no part of it.
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
    """Write files and their checksums in place of an older export, of which nothing stays.

    Checksums come first: a folder of which some files were not written any more is then known as
    one that was cut short, and can be written again.

    Raises:
        DataError: as `check_writable`, or nothing can be written there.
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
    """Refuse a folder whose content is not all an export's, as it was written.

    Raises:
        DataError: it is no folder, or a file in it was added or changed by hand.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DataError(f"{folder}: not a folder; name another one with --out")
    sums = _sums(folder) if (folder / SUMS).is_file() else {}
    for name in sorted(_files(folder) - {SUMS}):
        if _whole(name) in {SUMS, *sums}:
            continue  # a process was killed while it wrote this part of a file
        if name not in sums:
            raise DataError(
                f"{folder}: has files that no export wrote ({name}); name another folder with --out"
            )
        if _sum((folder / name).read_bytes()) != sums[name]:
            raise DataError(
                f"{folder / name}: changed after it was written, and would be lost; move it "
                "elsewhere, or name another folder with --out"
            )


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
                f"{place / name}: changed or damaged after it was written; export the robot again, "
                "to another folder"
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


def _whole(name: str) -> str | None:
    """Name of the file of which a file is a part that `write_bytes` left; None if it is none."""
    match = re.fullmatch(r"((?:.*/)?)\.(.+)\.[0-9a-f]{8}", name)
    return None if match is None else match[1] + match[2]


def _files(folder: Path) -> set[str]:
    """Files of a folder but for those in folders named `build`."""
    paths = (p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    return {p.as_posix() for p in paths if BUILD not in p.parts}


def _sum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
