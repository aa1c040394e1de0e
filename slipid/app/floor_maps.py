"""Floor maps that a config names, and their copies in a folder of results."""

import os
from pathlib import Path

from slipid.app.config import Config, LogsSection
from slipid.data.floor_map import picture_of
from slipid.support.errors import DataError
from slipid.support.files import write_bytes

COPIES = "maps"
"""Name of the folder of the copies, inside a folder of results."""


def map_path(config: Config, section: LogsSection) -> Path | None:
    """Return the path of the map of a log section, None for a section without a map.

    The path in a config is relative to the config. A folder of results, which has a run.json, has
    copies of the maps, so that later commands use the maps of the fit.
    """
    if section.map is None:
        return None
    named = config.path.parent / section.map
    copied = config.path.parent / COPIES / named.name
    of_results = (config.path.parent / "run.json").is_file()
    return copied if of_results and os.path.isfile(copied) else named


def map_files(config: Config) -> dict[str, Path]:
    """Return the files of all maps of a config with their pictures, keyed by file name.

    Raises:
        DataError: a map is damaged, or two different files have the same name.
    """
    out: dict[str, Path] = {}
    for path in (map_path(config, section) for section in config.content.logs):
        if path is None or not os.path.isfile(path):
            continue
        for file in filter(None, (path, picture_of(path))):
            other = out.setdefault(file.name, file)
            if other != file and other.read_bytes() != file.read_bytes():
                raise DataError(f"{file} and {other} differ; expected different file names")
    return out


def copy_maps(files: dict[str, Path], out: Path) -> None:
    """Copy files of maps, keyed by file name, to the folder of the copies."""
    for name, file in files.items():
        copy = out / COPIES / name
        if file.resolve() != copy.resolve():
            copy.parent.mkdir(exist_ok=True)
            write_bytes(copy, file.read_bytes())
