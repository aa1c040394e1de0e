"""Floor maps that a config names, and their copies in a folder of results."""

from pathlib import Path

from slipid.app.config import Config, LogsSection
from slipid.data.floor_map import picture_of
from slipid.support.errors import DataError
from slipid.support.files import write_bytes


def map_path(config: Config, section: LogsSection) -> Path | None:
    """Return the path of the map of a log section, None for a section without a map.

    The path in a config is relative to the config. The config in a folder of results has copies of
    its maps beside it.
    """
    if section.map is None:
        return None
    named = config.path.parent / section.map
    return named if named.is_file() else config.path.parent / named.name


def map_files(config: Config) -> dict[str, Path]:
    """Return the files of all maps of a config with their pictures, keyed by file name.

    Raises:
        DataError: a map is damaged, or two different files have the same name.
    """
    out: dict[str, Path] = {}
    for path in (map_path(config, section) for section in config.content.logs):
        if path is None or not path.is_file():
            continue
        for file in filter(None, (path, picture_of(path))):
            other = out.setdefault(file.name, file)
            if other != file and other.read_bytes() != file.read_bytes():
                raise DataError(f"{file} and {other} differ; expected different file names")
    return out


def copy_maps(config: Config, out: Path) -> None:
    """Copy the files of all maps of a config to a folder."""
    for name, file in map_files(config).items():
        if file.resolve() != (out / name).resolve():
            write_bytes(out / name, file.read_bytes())
