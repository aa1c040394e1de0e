"""What ships with slipid beside its code: configs, and recorded logs of the virtual test site."""

from pathlib import Path
from zipfile import ZipFile

from slipid.support.errors import DataError
from slipid.support.files import write_bytes

RECORDED = Path(__file__).with_name("recorded.zip")
"""Logs of the test site that ship with slipid."""


def packaged_path(name: str) -> Path:
    """Path of a config that ships with slipid, or of a file below it."""
    package = Path(__file__).parents[1]
    # beside the package in a clone, inside it in an installation
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"{name} is missing from this installation of slipid")


def packaged_config(name: str) -> str:
    """Text of a config that ships with slipid."""
    return packaged_path(name).read_text(encoding="utf-8")


def unpack(out: Path) -> None:
    """Write the recorded logs, their truth and nothing else below a folder."""
    try:
        archive = ZipFile(RECORDED)
    except OSError as error:
        raise DataError(f"{RECORDED}: {error.strerror}; expected the recorded logs") from error
    with archive:
        for name in archive.namelist():
            write_bytes(out / name, archive.read(name))
