"""Runs of a folder: the surface from the folder's name, a session for each run, then one `Runs`."""

from pathlib import Path
from typing import Literal

from slipid.data.log import Log
from slipid.data.reading.layout import Layout
from slipid.data.reading.presets import preset
from slipid.data.reading.reader import find_logs, read_logs
from slipid.data.runs import Runs, collect, default_session

Session = Literal["surface/load/speed", "folder", "file"]
"""What runs have in common between which the camera's marker stayed as it was."""


def read_runs(
    folder: Path | str,
    pattern: str,
    layout: Layout | str,
    *,
    surface: str | None = "folder",
    load: str = "as_built",
    session: Session = "surface/load/speed",
) -> Runs:
    """Every run of the files that match a glob.

    Runs of another load set-up are read by another call and added: `as_built + moved`.

    Args:
        folder: data folder, which the names of the runs are relative to.
        pattern: glob below the folder, such as `one_surface/*/*.csv`.
        layout: how the files are laid out, or the name of a preset.
        surface: name of the floor, `folder` for that of the folder each file lies in, or None where
            it is unknown.
        load: name of the load set-up.
        session: what runs have in common between which the camera's marker stayed as it was.

    Raises:
        DataError: no file matches, or one is wrong; the message names the file and the row.
    """
    root = Path(folder)
    chosen = preset(layout) if isinstance(layout, str) else layout
    logs = [
        log
        for path in find_logs(root, pattern)
        for log in read_logs(path, chosen, root, surface_of(path, surface), load)
    ]
    return collect(logs, session=lambda log: session_of(log, session))


def surface_of(path: Path, surface: str | None) -> str | None:
    """Surface a file was driven on; `folder` stands for the name of its folder, less `_surface`."""
    return path.parent.name.removesuffix("_surface") if surface == "folder" else surface


def session_of(log: Log, session: Session) -> str:
    """Name of the session of a run: its file, the folder of its file, or how it was driven."""
    if session == "file":
        return log.name
    if session == "folder":
        return log.name.rpartition("/")[0] or log.name
    return default_session(log)
