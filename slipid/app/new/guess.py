"""Guess of the robot that drove logged runs, and sorting of log files into runs.

The type of drive is guessed from the number of wheels and from sideways motion. Files in published
formats are recognised, and files of the same run are put together.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slipid.app.new.draft import RobotHint
from slipid.app.new.file_channels import (
    SUFFIXES,
    FileKind,
    file_kinds,
    formats_below,
    matching_presets,
    pattern_beside,
    without,
)
from slipid.app.new.file_study import FileStudy, file_with_pose, study_file
from slipid.app.new.robot_questions import RobotAnswers, RobotOptions, ask
from slipid.data.reading.table_format import format_of
from slipid.data.reading.units import factor
from slipid.data.wheel_signals import body_steps
from slipid.support.errors import DataError

_SIDEWAYS = 0.3
"""Share of sideways motion above which a robot can drive sideways [1]."""


@dataclass(frozen=True)
class RobotGuess:
    """Guessed robot, and questions about it that suit the logs and replace the usual ones."""

    robot: RobotAnswers
    hints: tuple[RobotHint, ...]


def guess_robot(options: RobotOptions, wheels: int, files: tuple[FileStudy, ...]) -> RobotGuess:
    """Return the robot that options describe, completed by guesses from the logs.

    Args:
        options: command-line options that describe the robot.
        wheels: number of wheels with columns in the logs.
        files: studies of the log files.

    Raises:
        DataError: an option is not valid, or belongs to another type of drive.
    """
    drive, hint = _likely_drive(wheels, drives_sideways(files))
    drive = options.drive or drive
    if wheels == 2 and drive in ("mecanum", "skid") and options.shared is None:
        options = replace(options, shared="yes")
    if wheels >= 3 and drive == "omni" and options.wheels is None and options.azimuths_deg is None:
        options = replace(options, wheels=str(wheels))
    known = ask(options, None, drive)
    if drive == "general" and options.places_m is None and wheels >= 2:
        known = _two_rows(known, wheels)
    return RobotGuess(known, (RobotHint("drive", hint),))


def _likely_drive(wheels: int, aside: bool | None) -> tuple[str, str]:
    """Return the likeliest type of drive, and the question about it.

    `aside` is whether the robot drives sideways, None if unknown.
    """
    if wheels == 2:
        return (
            "differential",
            'two drives: differential, or "skid" with drives = [[1, 3], [2, 4]], half_length_m and '
            "half_width_m instead of track_m?",
        )
    if wheels == 3:
        return "omni", "three wheels: omni, or general (two driven and steered ones do not work)?"
    if wheels == 4:
        drive = "mecanum" if aside else "skid"
        moves = {True: ", it goes sideways", False: ", it never goes sideways", None: ""}[aside]
        return drive, f"four wheels{moves}: skid, mecanum or omni, in which order of the columns?"
    if wheels > 4:
        return "general", f"{wheels} wheels: where do they stand, in the order of the columns?"
    if wheels == 1:
        return "omni", "one column of wheels only: a motor on a bench (slipid motor FILE), or more?"
    return "omni", "no column has the wheels' motion: which drive is it, and how many wheels?"


def drives_sideways(files: tuple[FileStudy, ...]) -> bool | None:
    """Return whether commands or poses show sideways motion; None if neither is known."""
    for one in files:
        command = one.channels.get("twist_command_y")
        if command is not None and np.nanmax(np.abs(command.values)) > 0:
            return True
    posed = file_with_pose(files)
    if posed is None or (turned := posed.channels.get("pose_heading")) is None:
        return None
    if not turned.unit:
        return None
    x, y = posed.channels.get("pose_x"), posed.channels.get("pose_y")
    assert x is not None
    assert y is not None
    heading = turned.values[:, 0] * factor(turned.unit, "rad")
    pose = np.stack([x.values[:, 0], y.values[:, 0], heading], axis=1)
    steps = np.abs(body_steps(pose[~np.isnan(pose).any(axis=1)]))
    ahead, left = float(steps[:, 0].sum()), float(steps[:, 1].sum())
    return left > _SIDEWAYS * (ahead + left) if ahead + left > 0 else None


def _two_rows(known: RobotAnswers, wheels: int) -> RobotAnswers:
    """Return answers with wheels placed in a left and a right row, as a first guess.

    If the number is odd, the last wheel is at the back in the middle.
    """
    pairs = wheels // 2
    places = [
        (0.2 - 0.4 * k / max(pairs - 1, 1), side) for k in range(pairs) for side in (0.15, -0.15)
    ]
    places += [(-0.3, 0.0)] * (wheels % 2)
    return replace(
        known,
        wheels=wheels,
        places_m=tuple(places),
        directions_deg=(0.0,) * wheels
        if len(known.directions_deg) != wheels
        else known.directions_deg,
        rollers_deg=(None,) * wheels if len(known.rollers_deg) != wheels else known.rollers_deg,
    )


_MORE_RUNS = 4
"""Number of further runs that are studied besides the first."""


@dataclass(frozen=True, eq=False)
class RunFiles:
    """Kinds of files that together make runs, with studies of the files of the first run.

    Attributes:
        kind: kind of the files with the wheels, one for each run.
        main: study of the first of these files.
        beside: name of each further file of a run, as in `Layout.beside`, and its study in the
            first run.
        others: the same for further runs.
    """

    kind: FileKind
    main: FileStudy
    beside: tuple[tuple[str, FileStudy], ...] = ()
    others: tuple["RunFiles", ...] = ()

    @property
    def all(self) -> tuple[FileStudy, ...]:
        """Return the studies of all files of the first run."""
        return (self.main, *(one for _, one in self.beside))

    @property
    def complete(self) -> bool:
        """Return whether the run has wheels and a pose."""
        return any(one.channels.wheels for one in self.all) and any(
            one.channels.has_pose for one in self.all
        )


@dataclass(frozen=True, eq=False)
class SortedFiles:
    """All files that were found, sorted.

    Attributes:
        root: folder of the files.
        presets: kinds of files in a published format, each with the name of its preset.
        groups: runs made of the other kinds.
        other_kinds: all kinds that are not in a published format.
        hints: comments about published formats that may fit.
        sentences: lines about files that were found or left out.
        no_logs: files that are not logs.
    """

    root: Path
    presets: tuple[tuple[FileKind, str], ...]
    groups: tuple[RunFiles, ...]
    other_kinds: tuple[FileKind, ...]
    hints: tuple[str, ...]
    sentences: tuple[str, ...]
    no_logs: tuple[Path, ...]


def sort_files(path: Path) -> SortedFiles:
    """Return the log files at a path, sorted.

    If the path is a file without wheels or pose, files beside it are taken into account.
    """
    if path.is_dir():
        formats, no_logs = formats_below(path)
        root, kinds = path, file_kinds(formats)
    else:
        formats, no_logs = [format_of(path)], []
        root, kinds = path.parent, file_kinds(formats)
    presets, others, hints = [], [], []
    for kind in kinds:
        likely = matching_presets(kind)
        if likely.sure:
            presets.append((kind, likely.sure))
            continue
        others.append((kind, study_file(kind.formats[0])))
        if likely.perhaps:
            hints.append(
                f"If {kind.paths[0].name} is of the published logs: format = "
                f"{' or '.join(likely.perhaps)} in [[logs]] reads it, and no layout is needed."
            )
    if path.is_file() and others and not _is_complete(others[0][1]):
        others += _siblings(path, others[0][0])
    groups, left_out = _run_files(others)
    sentences = [
        f"{len(kind.paths)} of format {name}: {kind.paths[0]} ..." for kind, name in presets
    ]
    sentences += [_sentence(group) for group in groups]
    sentences += [f"left out: {line}" for line in (*left_out, *(one.reason for one in no_logs[:3]))]
    sentences += [f"left out: {len(no_logs) - 3} more that are no logs"] * (len(no_logs) > 3)
    paths = tuple(one.path for one in no_logs)
    also = tuple(kind for kind, _ in others)
    return SortedFiles(
        root, tuple(presets), tuple(groups), also, tuple(hints), tuple(sentences), paths
    )


def _siblings(path: Path, kind: FileKind) -> list[tuple[FileKind, FileStudy]]:
    """Return the files of other kinds in the folder of a file, each with its study."""
    near = [p for p in sorted(path.parent.iterdir()) if p.is_file() and p.suffix in SUFFIXES]
    out = []
    for other in near:
        try:
            format = format_of(other)
        except DataError:
            continue
        if format.signature != kind.formats[0].signature:
            out.append((FileKind((format,)), study_file(format)))
    return out


def _is_complete(one: FileStudy) -> bool:
    return one.channels.wheels > 0 and one.channels.has_pose


def _run_files(kinds: list[tuple[FileKind, FileStudy]]) -> tuple[list[RunFiles], list[str]]:
    """Return runs of each kind with wheels and the kinds beside it, and lines about the rest."""
    mains = [pair for pair in kinds if pair[1].channels.wheels] or kinds[:1]
    rest = [pair for pair in kinds if pair not in mains]
    if len(mains) > 1 and not any(_is_complete(one) for _, one in mains):
        # Several kinds have wheels but none has a pose as well: the first kind is the main one.
        mains, more = mains[:1], mains[1:]
        rest = more + rest
    groups, used = [], []
    for kind, main in mains:
        beside: list[tuple[str, FileStudy]] = []
        have = frozenset(one.channel for one in main.channels.found) - {"time"}
        for other, one in rest:
            pattern = pattern_beside(kind, other)
            one = replace(one, channels=without(one.channels, have))
            fresh = {found.channel for found in one.channels.found} - {"time"}
            if pattern is None or not fresh or one.clock is None or main.clock is None:
                continue
            if max(main.time[0], one.time[0]) >= min(main.time[-1], one.time[-1]):
                continue  # the files cannot be of one run, since their times do not overlap
            beside.append((pattern, one))
            have |= fresh
            used.append(other)
        group = RunFiles(kind, main, tuple(beside))
        groups.append(replace(group, others=_more_runs(group)))
    lost = [kind for kind, _ in rest if kind not in used]
    lines = [f"{k.paths[0]}: no wheels in it, and no channels for a run beside it" for k in lost]
    return groups, lines


def _more_runs(group: RunFiles) -> tuple[RunFiles, ...]:
    """Return further runs of the same kinds, spread evenly over all runs."""
    count = len(group.kind.formats)
    chosen = sorted({k * count // (_MORE_RUNS + 1) for k in range(1, _MORE_RUNS + 1)} - {0})
    out = []
    for k in chosen:
        format = group.kind.formats[k]
        names = [
            (n, format.path.parent / n.replace("{stem}", format.path.stem)) for n, _ in group.beside
        ]
        try:
            beside = tuple((name, study_file(format_of(path))) for name, path in names)
            out.append(RunFiles(group.kind, study_file(format), beside))
        except DataError:
            continue  # the error is reported when the run is read; other runs are enough here
    return tuple(out)


def _sentence(group: RunFiles) -> str:
    """Return a sentence with the channels of a run's files."""
    listed = [", ".join(found.channel for found in one.channels.found) for one in group.all]
    more = [
        f"; beside it {name}: {channels}"
        for (name, _), channels in zip(group.beside, listed[1:], strict=True)
    ]
    like = f"{len(group.kind.paths)} like {group.kind.paths[0]}"
    return f"{like}: {listed[0] or 'no known channel'}{''.join(more)}"
