"""Reader of logs: functions that read files with a layout and return checked runs in SI units."""

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise, takewhile
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.reading.assemble import assembled, clock_against
from slipid.data.reading.bag.layout import BagLayout
from slipid.data.reading.bag.topics import read_bag
from slipid.data.reading.checks import (
    LARGEST,
    MIN_ROWS,
    UnusablePose,
    check_log,
    check_sizes,
    check_time,
)
from slipid.data.reading.layout import Layout
from slipid.data.reading.presets import preset
from slipid.data.reading.signal import (
    Identity,
    RawRun,
    Signal,
    SignalSource,
    cumulative_ticks,
    heading,
)
from slipid.data.reading.table import Table, read_table
from slipid.data.runs import Runs, collect, counted_once, default_session
from slipid.support.errors import DataError, first_names
from slipid.support.quantities import inside

AnyLayout = Layout | BagLayout
"""Layout of a file of rows (CSV or Parquet) or of a bag."""
MOST_FILES = 200_000
"""Largest number of files that a glob with ** may search."""
Session = Literal["surface/load/speed", "folder", "file"]
"""Property that the runs of one session have in common; within a session the camera's marker was
not moved on the robot."""


def read_runs(
    folder: Path | str,
    pattern: str,
    layout: AnyLayout | str,
    *,
    surface: str | None = "folder",
    load: str = "as_built",
    session: Session = "surface/load/speed",
) -> Runs:
    """Return every run of the files that match a glob.

    Runs with another load set-up are read by a separate call, and the two sets are added, as in
    `as_built + moved`.

    Args:
        folder: data folder, to which the names of the runs are relative.
        pattern: glob below the folder, such as `one_surface/*/*.csv`.
        layout: layout of the files, or the name of a preset.
        surface: name of the surface; `folder` stands for the name of each file's folder; None if it
            is unknown.
        load: name of the load set-up.
        session: property that the runs of one session have in common.

    Raises:
        DataError: no file matches, or one is wrong; the message names the file and the row.
    """
    root = Path(folder)
    chosen = preset(layout) if isinstance(layout, str) else layout
    logs: list[Log] = []
    aside: list[str] = []
    for path in without_beside(find_logs(root, pattern), chosen):
        found = read_logs(path, chosen, root, surface, load)
        logs += found.logs
        aside += found.aside
    if not logs and aside:
        raise DataError(*aside)
    return collect(counted_once(logs), [session_of(log, session) for log in logs], aside)


def session_of(log: Log, session: Session) -> str:
    """Return the name of a run's session: its file, its folder, or its surface, load and speed.

    The runs in one file have the same file and folder.
    """
    if session == "file":
        return re.sub(r"#\d+$", "", log.name)
    if session == "folder":
        return log.name.rpartition("/")[0] or log.name
    return default_session(log)


@dataclass(frozen=True)
class FileRuns:
    """Runs in one file.

    Attributes:
        logs: runs that were read.
        aside: one line about each run that was left out because its poses are unusable.
    """

    logs: tuple[Log, ...]
    aside: tuple[str, ...]


def read_logs(
    path: Path, layout: AnyLayout, root: Path, surface: str | None, load: str
) -> FileRuns:
    """Return every run in a CSV or Parquet file or in a bag.

    A run is left out if its pose jumps, because the marker was confused with another one or the
    matching of scans failed, or if its poses have a clock of their own whose offset the motion does
    not determine. Runs in a file of rows are separated by `layout.new_run`, those in a bag by
    `layout.runs`. Parts of a file with a single row show no motion and are dropped.

    Args:
        path: the file.
        layout: layout of the file.
        root: data folder above the file, to which the names of the runs are relative.
        surface: name of the surface; `folder` stands for the name of the file's folder without the
            suffix `_surface`. A bag, or the table of its runs, may name another surface.
        load: name of the load set-up; a bag, or the table of its runs, may name another one.
    """
    surface = path.parent.name.removesuffix("_surface") if surface == "folder" else surface
    known = Identity(path.relative_to(root).as_posix(), path, "", surface, load)
    try:
        raw = (
            read_bag(known, layout) if isinstance(layout, BagLayout) else _table_runs(known, layout)
        )
    except UnusablePose as error:
        return FileRuns((), (f"set aside: {error}",))
    logs: list[Log] = []
    aside: list[str] = []
    for run in raw:
        check_sizes(run.signals)
        log = assembled(run, layout)
        try:
            check_log(log, run.signals, layout)
        except UnusablePose as error:
            aside.append(f"set aside: {error}")
            continue
        logs.append(log)
    return FileRuns(tuple(logs), tuple(aside))


def _table_runs(known: Identity, layout: Layout) -> list[RawRun]:
    """Return the runs in a file of rows, with the channels of its additional files."""
    table = read_table(known.path, layout)
    if layout.drop_repeated_time:
        table = table.rows(np.append(np.diff(times_of(table, layout)) != 0, True))
    beside = {
        pattern: _beside(known.path, pattern, other) for pattern, other in layout.beside.items()
    }
    parts = [table.sha256, *(other.sha256 for other in beside.values())]
    sha256 = hashlib.sha256("\n".join(parts).encode()).hexdigest() if beside else table.sha256
    out = []
    for part, suffix in _parts(table, layout):
        notes: list[str] = []
        signals = signals_of(part, layout, notes)
        identity = replace(known, name=known.name + suffix, sha256=sha256)
        for pattern, other in beside.items():
            more = signals_of(other, layout.beside[pattern], notes)
            if layout.beside[pattern].clock == "own":
                clock = clock_against(RawRun(identity, signals), layout, more)
                identity = replace(identity, pose_clock=clock)
                more = {n: replace(s, time=clock.robot_time(s.time)) for n, s in more.items()}
            signals |= more
        out.append(RawRun(identity, signals, tuple(dict.fromkeys(notes))))
    return out


def _parts(table: Table, layout: Layout) -> list[tuple[Table, str]]:
    """Return the part of a table for each run, and the suffix of the run's name."""
    starts = _run_starts(table, layout)
    if len(starts) == 1:
        return [(table, "")]
    pairs = [(a, b) for a, b in pairwise([*starts, len(table.values)]) if b - a >= MIN_ROWS]
    width = len(str(len(pairs)))
    return [(table.rows(slice(a, b)), f"#{k:0{width}d}") for k, (a, b) in enumerate(pairs, start=1)]


def _beside(path: Path, pattern: str, layout: Layout) -> Table:
    """Return the table of an additional file of a run, in the folder of its main file `path`."""
    other = path.parent / pattern.replace("{stem}", path.stem)
    if not os.path.isfile(other):  # unlike Path.is_file, False for a name that is too long
        there = sorted(p.name for p in path.parent.iterdir() if p.is_file() and p != path)
        raise DataError(
            f"{other}: missing; expected in the folder of {path.name}, as declared in the layout "
            f"(the folder has {first_names(there, 'nothing else')})"
        )
    return read_table(other, layout)


def matching(root: Path, pattern: str) -> list[Path]:
    """Return the files and folders below `root` that match a glob.

    Raises:
        DataError: the glob leaves the folder, or searches more than `MOST_FILES` files below it.
    """
    try:
        levels = Path(inside(pattern)).parts
        if levels.count("**") > 1:
            raise ValueError(
                f"'{pattern}' has several **; expected at most one: write * for each level of "
                "folders in place of the others"
            )
        if "**" in levels:
            fixed = takewhile(lambda part: not set(part) & set("*?["), levels)
            walk = os.walk(root.joinpath(*fixed))
            counts = accumulate(len(folders) + len(files) for _, folders, files in walk)
            if any(count > MOST_FILES for count in counts):
                raise ValueError(
                    f"'{pattern}' searches more than {MOST_FILES} files; expected a glob with the "
                    "names of the folders, or a smaller folder"
                )
        return list(root.glob(pattern))
    except (ValueError, OSError) as error:
        raise DataError(f"{root}: {error}") from error


def _is_bag(path: Path) -> bool:
    return (path / "metadata.yaml").is_file()


def find_logs(root: Path, pattern: str) -> list[Path]:
    """Return the files and bag folders under `root` that match a glob, sorted by name.

    Raises:
        DataError: there is no such folder, or nothing in it matches.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; expected the folder of the logs")
    found = sorted(p for p in matching(root, pattern) if p.is_file() or _is_bag(p))
    if found:
        return found
    if broken := broken_links(root, pattern):
        raise DataError(f"{root}: {broken}")
    nearest = root
    for part in Path(pattern).parts[:-1]:
        if not (nearest / part).is_dir():
            break
        nearest = nearest / part
    inside = sorted(p.name + ("/" if p.is_dir() else "") for p in nearest.iterdir())
    raise DataError(
        f"{root}: no file matches '{pattern}'; expected at least one "
        f"({nearest} has {first_names(inside, 'nothing in it')})"
    )


def broken_links(root: Path, pattern: str) -> str:
    """Return a message about links that match a glob and lead nowhere, empty if there are none."""
    links = sorted(str(p) for p in matching(root, pattern) if p.is_symlink() and not p.exists())
    count = "1 link leads" if len(links) == 1 else f"{len(links)} links lead"
    return f"{count} nowhere ({first_names(links)}); expected files" if links else ""


def without_beside(paths: Sequence[Path], layout: AnyLayout) -> list[Path]:
    """Return the main files of runs, without their additional files.

    A glob such as `*.csv` finds both kinds of files; if the layout has no additional files, all
    files are returned.
    """
    if isinstance(layout, BagLayout):
        return list(paths)
    further = set()
    for path in paths:
        for pattern in layout.beside:
            other = path.parent / pattern.replace("{stem}", path.stem)
            if other == path and "{stem}" in pattern:
                raise DataError(
                    f"{path}: '{pattern}', the name of an additional file in the layout, is that "
                    "of the run's main file; expected a name such as '{stem}.poses.csv'"
                )
            further.add(other)
    return [path for path in paths if path not in further]


def _run_starts(table: Table, layout: Layout) -> list[int]:
    """Return the first row of every run."""
    if layout.new_run == "time_restarts":
        time = times_of(table, layout)
        return [0, *(np.flatnonzero(np.diff(time) <= 0) + 1).tolist()]
    if layout.new_run == "ticks_restart":
        # In files with this layout the robot only drives away from the start of each run, so the
        # largest count of a wheel grows in magnitude, and a decrease marks a restart.
        count = np.abs(table.stacked(layout.channels["wheel_ticks"])).max(axis=1)
        return [0, *(np.flatnonzero(np.diff(count) < 0) + 1).tolist()]
    return [0]


def signals_of(table: Table, layout: Layout, notes: list[str]) -> dict[str, Signal]:
    """Return the signals of a table in SI units by channel, each at the times of its own values.

    Quaternions become headings. Remarks about empty cells are appended to the notes.
    """
    time = times_of(table, layout)
    check_time(table, layout, time)
    out: dict[str, Signal] = {}
    for name, channel in layout.channels.items():
        if name == "time":
            continue
        columns = tuple(str(column) for column in channel.columns)
        cells = table.stacked(channel)
        source = SignalSource(table.path, columns, table.lines)
        for i, j in np.argwhere(np.abs(cells) > LARGEST)[:1].tolist():
            value = "an infinite value" if np.isinf(cells[i, j]) else f"a value of {cells[i, j]:g}"
            raise source.error(value, "a measured number", sample=i, column=j)
        missing = np.isnan(cells)
        for j in np.flatnonzero(missing.any(axis=0)).tolist():
            if missing[:, j].all():
                raise source.error("no value in any row", "numbers", column=j)
            notes.append(
                f"column '{columns[j]}' has empty cells: it is used at the times of its values"
            )
        notes += layout.note(name, channel.unit)
        if name == "wheel_ticks":
            cells = cumulative_ticks(cells, layout, notes)
        values = (cells * channel.scale + channel.offset) * layout.to_si(name)
        signal, there = Signal(time, values, source), ~missing.all(axis=1)
        out[name] = signal if there.all() else signal.part(there)
    if "pose_quaternion" in out:
        out["pose_heading"] = heading(out.pop("pose_quaternion"))
    return out


def times_of(table: Table, layout: Layout) -> Float[np.ndarray, " row"]:
    """Return the times of the rows [s]."""
    if "time" not in layout.channels:
        return np.arange(len(table.values)) * float(layout.row_period or 1.0)
    channel = layout.channels["time"]
    cells = table.stacked(channel)
    with np.errstate(over="ignore"):  # a time that overflows is infinite, which a check refuses
        if cells.shape[1] == 2:
            cells = cells[:, :1] + 1e-9 * cells[:, 1:]
        return ((cells * channel.scale + channel.offset) * layout.to_si("time"))[:, 0]
