"""Log files sorted into runs: published formats, and files that belong together."""

from dataclasses import dataclass, replace
from pathlib import Path

from slipid.data.reading.table_format import format_of
from slipid.job.new.look.file_channels import without
from slipid.job.new.look.kinds import (
    SUFFIXES,
    Kind,
    formats_below,
    kinds_of,
    likely_presets,
    pattern_beside,
)
from slipid.job.new.look.study import Study, study
from slipid.support.errors import DataError

_RUNS = 4
"""Runs beside the first that are looked into."""


@dataclass(frozen=True, eq=False)
class Group:
    """Files of a run: those of one kind with the wheels, and others beside them.

    Attributes:
        kind: the files with the wheels.
        main: the first of them, looked into.
        beside: name of each other file, as of `Layout.beside`, and the first of them looked into.
        others: the same of further runs.
    """

    kind: Kind
    main: Study
    beside: tuple[tuple[str, Study], ...] = ()
    others: tuple["Group", ...] = ()

    @property
    def all(self) -> tuple[Study, ...]:
        """Every file of the first run."""
        return (self.main, *(one for _, one in self.beside))

    @property
    def complete(self) -> bool:
        """Whether it has wheels and a pose."""
        return any(one.columns.wheels for one in self.all) and any(
            one.columns.has_pose for one in self.all
        )


@dataclass(frozen=True, eq=False)
class SortedLogs:
    """All files that were found: those of published formats, and others by run.

    `sentences` are lines about what was found and left out.
    """

    root: Path
    presets: tuple[tuple[Kind, str], ...]
    groups: tuple[Group, ...]
    also: tuple[Kind, ...]
    hints: tuple[str, ...]
    sentences: tuple[str, ...]
    no_logs: tuple[Path, ...]


def sorted_logs(path: Path) -> SortedLogs:
    """All files that belong to what was named."""
    if path.is_dir():
        formats, no_logs = formats_below(path)
        root, kinds = path, kinds_of(formats)
    else:
        formats, no_logs = [format_of(path)], []
        root, kinds = path.parent, kinds_of(formats)
    presets, others, hints = [], [], []
    for kind in kinds:
        likely = likely_presets(kind)
        if likely.sure:
            presets.append((kind, likely.sure))
            continue
        others.append((kind, study(kind.formats[0])))
        if likely.perhaps:
            hints.append(
                f"If {kind.paths[0].name} is of the published logs: format = "
                f"{' or '.join(likely.perhaps)} in [[logs]] reads it, and no layout is needed."
            )
    if path.is_file() and others and not _complete(others[0][1]):
        others += _siblings(path, others[0][0])
    groups, left_out = _groups(others)
    sentences = [
        f"{len(kind.paths)} of format {name}: {kind.paths[0]} ..." for kind, name in presets
    ]
    sentences += [_found(group) for group in groups]
    sentences += [f"left out: {line}" for line in (*left_out, *(one.why for one in no_logs[:3]))]
    sentences += [f"left out: {len(no_logs) - 3} more that are no logs"] * (len(no_logs) > 3)
    paths = tuple(one.path for one in no_logs)
    also = tuple(kind for kind, _ in others)
    return SortedLogs(
        root, tuple(presets), tuple(groups), also, tuple(hints), tuple(sentences), paths
    )


def _siblings(path: Path, kind: Kind) -> list[tuple[Kind, Study]]:
    """Files beside one that lacks something."""
    near = [p for p in sorted(path.parent.iterdir()) if p.is_file() and p.suffix in SUFFIXES]
    out = []
    for other in near:
        try:
            format = format_of(other)
        except DataError:
            continue
        if format.signature != kind.formats[0].signature:
            out.append((Kind((format,)), study(format)))
    return out


def _complete(one: Study) -> bool:
    return one.columns.wheels > 0 and one.columns.has_pose


def _groups(kinds: list[tuple[Kind, Study]]) -> tuple[list[Group], list[str]]:
    """Runs: kinds that have wheels, and with each the kinds that lie beside it."""
    mains = [pair for pair in kinds if pair[1].columns.wheels] or kinds[:1]
    rest = [pair for pair in kinds if pair not in mains]
    if len(mains) > 1 and not any(_complete(one) for _, one in mains):
        # the same wheels in two files: the one with the better channel leads
        mains, more = mains[:1], mains[1:]
        rest = more + rest
    groups, used = [], []
    for kind, main in mains:
        beside: list[tuple[str, Study]] = []
        have = frozenset(one.channel for one in main.columns.found) - {"time"}
        for other, one in rest:
            pattern = pattern_beside(kind, other)
            one = replace(one, columns=without(one.columns, have))
            fresh = {found.channel for found in one.columns.found} - {"time"}
            if pattern is None or not fresh or one.clock is None or main.clock is None:
                continue
            if not _together(main, one):
                continue
            beside.append((pattern, one))
            have |= fresh
            used.append(other)
        group = Group(kind, main, tuple(beside))
        groups.append(replace(group, others=_further(group)))
    lost = [kind for kind, _ in rest if kind not in used]
    lines = [
        f"{k.paths[0]}: no wheels in it, and nothing of a run that it lies beside" for k in lost
    ]
    return groups, lines


def _further(group: Group) -> tuple[Group, ...]:
    """Some more runs of a kind, spread over all of them."""
    count = len(group.kind.formats)
    chosen = sorted({k * count // (_RUNS + 1) for k in range(1, _RUNS + 1)} - {0})
    out = []
    for k in chosen:
        format = group.kind.formats[k]
        names = [
            (n, format.path.parent / n.replace("{stem}", format.path.stem)) for n, _ in group.beside
        ]
        try:
            beside = tuple((name, study(format_of(path))) for name, path in names)
            out.append(Group(group.kind, study(format), beside))
        except DataError:
            continue  # the reader will say it of this run; the first one tells enough
    return tuple(out)


def _together(one: Study, other: Study) -> bool:
    """Whether two files cover the same time: then they are of one run."""
    return bool(max(one.time[0], other.time[0]) < min(one.time[-1], other.time[-1]))


def _found(group: Group) -> str:
    """What a group of files holds, in a sentence."""
    listed = [", ".join(found.channel for found in one.columns.found) for one in group.all]
    more = [
        f"; beside it {name}: {channels}"
        for (name, _), channels in zip(group.beside, listed[1:], strict=True)
    ]
    like = f"{len(group.kind.paths)} like {group.kind.paths[0]}"
    return f"{like}: {listed[0] or 'nothing known'}{''.join(more)}"
