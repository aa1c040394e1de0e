"""Log files of a folder by kind: published formats, globs that find each, which lie together."""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from re import sub

from slipid.data.reading.layout import Layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.reader import read_logs
from slipid.data.reading.table_format import TableFormat, format_of
from slipid.data.sanity.columns import refuse_misordered
from slipid.support.errors import DataError

SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".log", ".parquet")
"""Of files that may be logs."""
_TELLING = 8
"""Named columns from which nobody else will have the same by chance."""
_TRIED = 3
"""Files that are read to see whether a preset fits."""


@dataclass(frozen=True)
class NoLog:
    """A file that might have been a log, and why it is none."""

    path: Path
    why: str


def formats_below(folder: Path) -> tuple[list[TableFormat], list[NoLog]]:
    """Every log in a folder and below, and the files that are none.

    Raises:
        DataError: there is none.
    """
    found, not_logs = [], []
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix.lower() in SUFFIXES)
    for path in paths:
        try:
            found.append(format_of(path))
        except DataError as error:
            not_logs.append(NoLog(path, str(error)))
    if not found:
        there = f"no log in {len(paths)} files" if paths else "no CSV or Parquet file below it"
        listed = "".join(f"\n{one.why}" for one in not_logs[:3])
        raise DataError(f"{folder}: {there}; expected logs of a robot{listed}")
    return found, not_logs


@dataclass(frozen=True)
class Kind:
    """Files that are laid out alike, sorted by path."""

    formats: tuple[TableFormat, ...]

    @property
    def paths(self) -> tuple[Path, ...]:
        """Where they are."""
        return tuple(one.path for one in self.formats)


def kinds_of(formats: Sequence[TableFormat]) -> list[Kind]:
    """Files by kind, the kind with most of them first."""
    groups: dict[TableFormat, list[TableFormat]] = {}
    for one in formats:
        groups.setdefault(one.signature, []).append(one)
    return [Kind(tuple(g)) for g in sorted(groups.values(), key=len, reverse=True)]


def globs_of(root: Path, kind: Kind, others: Sequence[Path]) -> list[str]:
    """Globs below a folder that find the files of a kind and none of the others.

    Folders two levels deep have one each: they tell sets of logs apart.
    """
    mine = [path.relative_to(root) for path in kind.paths]
    theirs = [PurePosixPath(path.relative_to(root)) for path in others]
    buckets: dict[tuple[str, int], list[PurePosixPath]] = {}
    for path in map(PurePosixPath, mine):
        top = path.parts[0] if len(path.parts) > 2 else ""
        buckets.setdefault((top, len(path.parts)), []).append(path)
    return [glob for paths in buckets.values() for glob in _narrow(paths, theirs)]


def _narrow(paths: list[PurePosixPath], theirs: list[PurePosixPath]) -> list[str]:
    """A glob for some files, narrower ones where it finds others."""
    glob = common_glob(paths)
    if not any(_finds(glob, path) for path in theirs):
        return [glob]
    folders = {path.parent for path in paths}
    if len(folders) > 1:
        parts = [[p for p in paths if p.parent == folder] for folder in sorted(folders)]
        return [one for part in parts for one in _narrow(part, theirs)]
    return [path.as_posix() for path in paths]


def common_glob(paths: Sequence[PurePosixPath]) -> str:
    """A glob that finds paths of the same depth: what they have in common, around stars."""
    return "/".join(_part(parts) for parts in zip(*(p.parts for p in paths), strict=True))


def floor_of(glob: str) -> str:
    """Name of a floor by a glob: that of a folder above the runs', or only that it is a floor."""
    first, *others = glob.split("/")
    return first if len(others) > 1 and "*" not in first else "floor"


def _finds(glob: str, path: PurePosixPath) -> bool:
    parts = glob.split("/")
    return len(parts) == len(path.parts) and all(
        fnmatchcase(name, part) for name, part in zip(path.parts, parts, strict=True)
    )


def _part(names: tuple[str, ...]) -> str:
    """One name, or what several have in common around a star."""
    if len(set(names)) == 1:
        return names[0]
    suffixes = {PurePosixPath(name).suffix for name in names}
    end = suffixes.pop() if len(suffixes) == 1 else ""
    counted = {sub(r"\d+", "*", name) for name in names}
    if len(counted) == 1:
        return counted.pop()
    # digits at its end are a number, of which others may begin otherwise
    first, last = min(names), max(names)
    alike = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    return f"{first[:alike].rstrip('0123456789')}*{end}"


def pattern_beside(main: Kind, other: Kind) -> str | None:
    """Name of the file beside each of the main ones, as of `Layout.beside`; None if they have none.

    Either it is called the same in every folder, or after the main file.
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
        # a name without the stem belongs to one main file a folder
        alone = "{stem}" in pattern or len({path.parent for path in main.paths}) == len(named)
        if alone and there.issuperset(named):
            return pattern
    return None


def a_folder_each(kind: Kind) -> bool:
    """Whether every file is alone of its kind in its folder: then the folder is a run."""
    return len(kind.paths) > 1 and len({path.parent for path in kind.paths}) == len(kind.paths)


@dataclass(frozen=True)
class Likely:
    """Presets that a kind of files can be read with.

    Attributes:
        sure: that which uses most of their columns, if its names are telling.
        perhaps: others, whose columns anybody could have.
    """

    sure: str | None
    perhaps: tuple[str, ...]


def likely_presets(kind: Kind) -> Likely:
    """Presets that read the first files of a kind."""
    fits = [name for name, layout in PRESETS.items() if _matches(kind.formats[0], layout)]
    fits = [name for name in fits if _reads(kind, PRESETS[name])]
    fits.sort(key=lambda name: len(PRESETS[name].columns), reverse=True)
    telling = [name for name in fits if PRESETS[name].names_row and _many(PRESETS[name])]
    sure = telling[0] if telling else None
    return Likely(sure, tuple(name for name in fits if name not in telling))


def _many(layout: Layout) -> bool:
    return len(layout.columns) >= _TELLING


def _matches(format: TableFormat, layout: Layout) -> bool:
    """Whether names and numbers stand where a layout says."""
    rows = (layout.delimiter, layout.names_row, layout.first_data_row)
    if rows != (format.delimiter, format.names_row, format.first_data_row):
        return False
    if not layout.names_row:
        return len(format.names) == 1 + max(int(column) for column in layout.columns)
    return set(layout.columns) <= set(format.names)


def _reads(kind: Kind, layout: Layout) -> bool:
    for path in kind.paths[:_TRIED]:
        try:
            refuse_misordered(read_logs(path, layout, path.parent, "floor", "as_built").logs)
        except DataError:
            continue
        return True
    return False
