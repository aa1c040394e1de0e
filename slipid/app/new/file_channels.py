"""Recognition of the channels in a file's columns, and grouping of a folder's log files by kind.

Columns are recognised by their names and numbers. Files of one kind have the same layout. For each
kind, this module finds presets that can read it, globs that match its files, and kinds with
additional files of the same runs.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from re import sub

import numpy as np
from jaxtyping import Float

from slipid.data.check.columns import refuse_misordered
from slipid.data.reading.column_names import ColumnMeaning, meaning_of, stamp_columns
from slipid.data.reading.layout import GROUPS, PER_WHEEL, TURNS, Layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.reader import read_logs
from slipid.data.reading.table_format import TableFormat, TableNumbers, format_of
from slipid.support.errors import DataError

_ORDER = ("fl", "fr", "ml", "mr", "rl", "rr", "l", "r")
"""Labels of wheels in the order in which the types of drive count wheels."""
_QUATERNION = ("x", "y", "z", "w")
_LEAST_TICKS = 50
"""Magnitude above which whole numbers of a position are assumed to be ticks."""


@dataclass(frozen=True, eq=False)
class FileChannel:
    """A channel that was found in a file, with its columns.

    Attributes:
        channel: name of the channel.
        columns: positions of its columns, from 0.
        labels: label of the wheel in the name of each column.
        values: values of the columns, as in the file; a time has a single column.
        unit: unit in the names or in a row of units; empty if there is none.
        questions: one question about each assumption that was made.
    """

    channel: str
    columns: tuple[int, ...]
    labels: tuple[str, ...]
    values: Float[np.ndarray, "row column"]
    unit: str = ""
    questions: tuple[str, ...] = ()


Channels = tuple[list[FileChannel], list[str], list[str]]
"""The channels of a file, the names of its other columns, and remarks for the user."""


def channels_in(numbers: TableNumbers) -> Channels:
    """Return the channels in the named columns of a file."""
    format, meanings, width = numbers.format, {}, len(numbers.format.names)
    for at, name in enumerate(format.names):
        if at not in numbers.texts and name and not np.isnan(numbers.values[:, at]).all():
            meanings[at] = meaning_of(name, format.units[at])
    stamp = stamp_columns([format.names[at] if at in meanings else "" for at in range(width)])
    if stamp and not any(m.channel == "time" for at, m in meanings.items() if at not in stamp):
        meanings |= dict.fromkeys(stamp, ColumnMeaning())
    else:
        stamp = None
    channels: dict[str, dict[str, int]] = {}
    also: list[str] = []
    for at, one in meanings.items():
        if not one.channel or one.channel == "odometry":
            continue
        there = channels.setdefault(one.channel, {})
        if one.label in there:
            also.append(f"{format.names[at]} (as {format.names[there[one.label]]})")
        else:
            there[one.label] = at
    found = [_file_channel(numbers, meanings, name, places) for name, places in channels.items()]
    if stamp:
        seconds = numbers.values[:, stamp] @ [[1.0], [1e-9]]
        found.append(FileChannel("time", stamp, ("", ""), seconds, "s"))
    first: dict[str, FileChannel] = {}
    for resolved in _resolved(found):
        first.setdefault(resolved.channel, resolved)
    wheels = [format.names[at] for at, one in meanings.items() if one.channel == "odometry"]
    notes = []
    if wheels:
        odometry = "odometry is not a measured pose, since it is computed from the wheels"
        notes.append(f"{', '.join(wheels)}: {odometry}")
    if also:
        notes.append(f"not used, a second column: {', '.join(also)}")
    kept, dropped = _consistent(list(first.values()))
    used = {at for one in kept for at in one.columns}
    unused = [name for at, name in enumerate(format.names) if name and at not in used]
    return kept, unused, notes + dropped


def _file_channel(
    numbers: TableNumbers, meanings: dict[int, ColumnMeaning], channel: str, places: dict[str, int]
) -> FileChannel:
    """Return a channel with its columns in the order of the wheels."""
    labels = sorted(places, key=rank)
    at = tuple(places[label] for label in labels)
    units = Counter(meanings[k].unit for k in at)
    doubts = [
        f"column '{numbers.format.names[k]}': {meanings[k].doubt}" for k in at if meanings[k].doubt
    ]
    if len(units) > 1:
        doubts.append(f"columns of one channel in several units ({', '.join(units)})")
    unit = units.most_common(1)[0][0]
    return FileChannel(channel, at, tuple(labels), numbers.values[:, at], unit, tuple(doubts))


def rank(label: str) -> tuple[int, int, str]:
    """Return the key by which labels of wheels, or components of a quaternion, are sorted.

    Known labels come first, in the order in which drives count wheels; numbers follow in increasing
    order.
    """
    known = (*_QUATERNION, *_ORDER)
    if label in known:
        return (0, known.index(label), label)
    return (1, int(label) if label.isdecimal() else 0, label)


def _resolved(found: list[FileChannel]) -> list[FileChannel]:
    """Return the channels, with ambiguous channels decided by their units and numbers.

    Positions are ticks or angles; "v" is a voltage or a speed.
    """
    speeds = {one.labels for one in found if one.channel.endswith("_speed")}
    out = []
    for one in found:
        kind, _, what = one.channel.rpartition("_")
        if what == "position":
            ticks = one.unit in ("tick", "ticks") or (not one.unit and _is_ticks(one.values))
            one = replace(one, channel="wheel_ticks" if ticks else f"{kind}_angle")
        elif what == "v":
            volts = (
                one.unit in ("V", "mV")
                or one.labels in speeds
                or (not one.unit and _stays_up(one.values))
            )
            one = replace(one, channel="voltage" if volts else f"{kind}_speed")
        out.append(one)
    return out


def _is_ticks(values: Float[np.ndarray, "row column"]) -> bool:
    """Return whether all values are whole numbers, some of them too large for an angle."""
    known = values[~np.isnan(values)]
    return bool((known == np.round(known)).all() and np.abs(known).max(initial=0.0) > _LEAST_TICKS)


def _stays_up(values: Float[np.ndarray, "row column"]) -> bool:
    """Return whether all values are well above 0, like a battery's voltage and unlike a speed."""
    known = values[~np.isnan(values)]
    return bool(known.size) and float(known.min()) > 0.5 * float(known.max()) > 0.0


def _consistent(found: list[FileChannel]) -> tuple[list[FileChannel], list[str]]:
    """Return the channels that have the same wheels as the motion, and a line about each other one.

    The motion is the channel from which the turns of the wheels are computed. Channels of the whole
    robot are kept.
    """
    turns = [one for name in TURNS for one in found if one.channel == name]
    per_wheel = turns or [one for one in found if one.channel in PER_WHEEL]
    count = len(per_wheel[0].columns) if per_wheel else 0
    labels = set(per_wheel[0].labels) if per_wheel else set()
    kept, dropped = [], []
    for one in found:
        if one.channel == "pose_quaternion" and len(one.columns) != 4:
            dropped.append(f"{len(one.columns)} columns of a quaternion; expected x, y, z and w")
        elif one.channel in PER_WHEEL and (
            len(one.columns) != count or not _same_wheels(labels, one)
        ):
            what = f"{len(one.columns)} columns of {one.channel}"
            motion = f"the {count} columns of {per_wheel[0].channel}"
            dropped.append(f"{what} are left out: they do not match {motion}")
        else:
            kept.append(one)
    return kept, dropped


def _same_wheels(labels: set[str], one: FileChannel) -> bool:
    """Return whether the labels of a channel's columns may be those of the same wheels.

    Labels are either names of sides, such as `fl`, or numbers. Labels of one type must be equal;
    names and numbers cannot be compared and are accepted.
    """
    numbers = all(label.isdecimal() for label in labels)
    return set(one.labels) == labels or numbers != all(label.isdecimal() for label in one.labels)


def unnamed_channels(numbers: TableNumbers) -> Channels:
    """Return guessed channels of columns without names, each with a question.

    The first increasing column is the time, columns of large whole numbers are ticks, and the first
    three of the other columns are x, y and heading of the pose.
    """
    values = numbers.values
    whole = [k for k in range(values.shape[1]) if _is_ticks(values[:, [k]])]
    time = next((k for k in range(values.shape[1]) if (np.diff(values[:, k]) > 0).all()), None)
    whole = [k for k in whole if k != time]
    others = [k for k in range(values.shape[1]) if k not in (*whole, time)]
    found = []

    def put(channel: str, *at: int) -> None:
        labels = tuple(str(k + 1) for k in range(len(at)))
        doubt = (f"guessed from the numbers: is it {channel}?",)
        found.append(FileChannel(channel, at, labels, values[:, at], "", doubt))

    if time is not None:
        put("time", time)
    if whole:
        put("wheel_ticks", *whole)
    for channel, at in zip(GROUPS["pose"], others, strict=False):
        if len(others) >= 3:
            put(channel, at)
    used = {at for one in found for at in one.columns}
    return found, [str(k) for k in range(values.shape[1]) if k not in used], []


SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".log", ".parquet")
"""Suffixes of files that may be logs."""
_TELLING_COLUMNS = 8
"""Least number of named columns of a preset for which a match of all names is not by chance."""
_FILES_TRIED = 3
"""Largest number of files that are read to find out whether a preset can read them."""


def formats_below(folder: Path) -> tuple[list[TableFormat], dict[Path, str]]:
    """Return the format of every log in a folder and below, and why other files are not logs.

    Raises:
        DataError: there is no log.
    """
    found, not_logs = [], {}
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix.lower() in SUFFIXES)
    for path in paths:
        try:
            found.append(format_of(path))
        except DataError as error:
            not_logs[path] = str(error)
    if not found:
        there = f"no log in {len(paths)} files" if paths else "no CSV or Parquet file below it"
        listed = list(not_logs.values())[:3]
        raise DataError(f"{folder}: {there}; expected logs of a robot", *listed)
    return found, not_logs


@dataclass(frozen=True)
class FileKind:
    """Files with the same layout, sorted by path."""

    formats: tuple[TableFormat, ...]

    @property
    def paths(self) -> tuple[Path, ...]:
        """Return the paths of the files."""
        return tuple(one.path for one in self.formats)


def file_kinds(formats: Sequence[TableFormat]) -> list[FileKind]:
    """Return files grouped by kind, the kind with the most files first."""
    groups: dict[TableFormat, list[TableFormat]] = {}
    for one in formats:
        groups.setdefault(one.signature, []).append(one)
    return [FileKind(tuple(g)) for g in sorted(groups.values(), key=len, reverse=True)]


def globs_of(root: Path, kind: FileKind, others: Sequence[Path]) -> list[str]:
    """Return globs below a folder that together match all files of a kind and no other file.

    Files in subfolders of different top folders get separate globs, since each top folder is
    usually a set of logs.
    """
    mine = [path.relative_to(root) for path in kind.paths]
    theirs = [PurePosixPath(path.relative_to(root)) for path in others]
    buckets: dict[tuple[str, int], list[PurePosixPath]] = {}
    for path in map(PurePosixPath, mine):
        top = path.parts[0] if len(path.parts) > 2 else ""
        buckets.setdefault((top, len(path.parts)), []).append(path)
    return [glob for paths in buckets.values() for glob in _narrow_globs(paths, theirs)]


def _narrow_globs(paths: list[PurePosixPath], theirs: list[PurePosixPath]) -> list[str]:
    """Return a common glob for some files, or several narrower ones if it matches other files."""
    glob, depth = common_glob(paths), len(paths[0].parts)
    if not any(path.match(glob) and len(path.parts) == depth for path in theirs):
        return [glob]
    folders = {path.parent for path in paths}
    if len(folders) > 1:
        parts = [[p for p in paths if p.parent == folder] for folder in sorted(folders)]
        return [one for part in parts for one in _narrow_globs(part, theirs)]
    return [path.as_posix() for path in paths]


def common_glob(paths: Sequence[PurePosixPath]) -> str:
    """Return a glob that matches paths of the same depth; `*` stands for what differs."""
    return "/".join(_common_name(parts) for parts in zip(*(p.parts for p in paths), strict=True))


def floor_of(glob: str) -> str:
    """Return the name of the floor of a glob's files: that of the top folder, or "floor"."""
    first, *others = glob.split("/")
    return first if len(others) > 1 and "*" not in first else "floor"


def _common_name(names: tuple[str, ...]) -> str:
    """Return a pattern that matches some names; `*` stands for what differs."""
    if len(set(names)) == 1:
        return names[0]
    suffixes = {PurePosixPath(name).suffix for name in names}
    end = suffixes.pop() if len(suffixes) == 1 else ""
    counted = {sub(r"\d+", "*", name) for name in names}
    if len(counted) == 1:
        return counted.pop()
    # Digits at the end of the common beginning are part of a number, which may differ.
    first, last = min(names), max(names)
    alike = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    return f"{first[:alike].rstrip('0123456789')}*{end}"


def pattern_beside(main: FileKind, other: FileKind) -> str | None:
    """Return the name, as in `Layout.beside`, that finds a file of a kind beside each main file.

    The name is the same in every folder, or contains `{stem}` for the stem of the main file. The
    result is None if no name finds a file of the kind in the folder of every main file.
    """
    there = set(other.paths)
    first = main.paths[0]
    near = [path for path in other.paths if path.parent == first.parent]
    patterns = [path.name for path in near]
    patterns += [
        path.name.replace(first.stem, "{stem}") for path in near if first.stem in path.name
    ]
    for pattern in patterns:
        named = [path.parent / pattern.replace("{stem}", path.stem) for path in main.paths]
        # A name without the stem is unambiguous only if each folder has one main file.
        alone = "{stem}" in pattern or len({path.parent for path in main.paths}) == len(named)
        if alone and there.issuperset(named):
            return pattern
    return None


def folder_per_run(kind: FileKind) -> bool:
    """Return whether every file is the only one of its kind in its folder, so a folder is a run."""
    return len(kind.paths) > 1 and len({path.parent for path in kind.paths}) == len(kind.paths)


def matching_presets(kind: FileKind) -> tuple[str | None, list[str]]:
    """Return the preset that is certainly right for a kind of files, or None, and possible presets.

    All these presets can read one of the first files of the kind. The certain preset has so many
    column names that they cannot match by chance; the possible presets have fewer.
    """
    fits = [name for name, layout in PRESETS.items() if _matches(kind.formats[0], layout)]
    fits = [name for name in fits if _reads(kind, PRESETS[name])]
    fits.sort(key=lambda name: len(PRESETS[name].columns), reverse=True)
    telling = [
        name
        for name in fits
        if PRESETS[name].names_row and len(PRESETS[name].columns) >= _TELLING_COLUMNS
    ]
    return next(iter(telling), None), [name for name in fits if name not in telling]


def _matches(format: TableFormat, layout: Layout) -> bool:
    """Return whether a format has names and numbers where a layout expects them."""
    rows = (layout.delimiter, layout.names_row, layout.first_data_row)
    if rows != (format.delimiter, format.names_row, format.first_data_row):
        return False
    if not layout.names_row:
        return len(format.names) == 1 + max(int(column) for column in layout.columns)
    return set(layout.columns) <= set(format.names)


def _reads(kind: FileKind, layout: Layout) -> bool:
    for path in kind.paths[:_FILES_TRIED]:
        try:
            refuse_misordered(read_logs(path, layout, path.parent, "floor", "as_built").logs)
        except DataError:
            continue
        return True
    return False
