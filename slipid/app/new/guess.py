"""Guess of the robot that drove logged runs, and sorting of log files into runs.

The type of drive is guessed from the number of wheels and from sideways motion. Files in published
formats are recognised, and files of the same run are put together.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slipid.app.new.file_channels import (
    SUFFIXES,
    FileKind,
    file_kinds,
    formats_below,
    matching_presets,
    pattern_beside,
)
from slipid.app.new.file_study import FileStudy, RunStudy, file_with_pose, study_file
from slipid.app.new.from_reference import with_reference
from slipid.app.new.robot_answers import RobotAnswers, RobotOptions
from slipid.app.new.robot_questions import ask
from slipid.data.reading.layout import GROUPS
from slipid.data.reading.table_format import format_of
from slipid.data.reading.units import factor
from slipid.data.wheel_signals import body_steps
from slipid.support.errors import DataError

_POSE = frozenset((*GROUPS["pose"], "pose_quaternion"))
_SIDEWAYS = 0.3
"""Share of sideways motion above which a robot can drive sideways [1]."""


def guess_robot(
    options: RobotOptions, wheels: int, files: tuple[FileStudy, ...]
) -> tuple[RobotAnswers, dict[str, str]]:
    """Return the robot that options describe, completed by guesses, and a question about its drive.

    Args:
        options: command-line options that describe the robot.
        wheels: number of wheels with columns in the logs.
        files: studies of the log files.

    Raises:
        DataError: an option is not valid, or belongs to another type of drive.
    """
    drive, hint = _likely_drive(wheels, drives_sideways(files))
    if any(one.find("steering_angle") is not None for one in files):
        drive, hint = "steered", "a steering angle is logged: steered, with which axle driven?"
    options = with_reference(options)
    drive = options.get("drive", drive)
    if drive == "steered" and wheels == 2:
        options = {"encoders": "2", **options}
    if wheels == 2 and drive in ("mecanum", "skid"):
        options = {"shared": "yes", **options}
    if wheels >= 3 and drive == "omni" and not options.keys() & {"wheels", "azimuths_deg"}:
        options = {**options, "wheels": str(wheels)}
    known = ask(options, None, drive)
    if drive == "general" and "places_m" not in options and wheels >= 2:
        known = _two_rows(known, wheels)
    return known, {"drive": hint}


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
    # Without a known number of wheels, the drive with the fewest wheels is assumed.
    drive = "omni" if aside else "differential"
    if wheels == 1:
        return drive, "one column of wheels only: a motor on a bench (slipid motor FILE), or more?"
    return drive, "the wheels' motion was not recognised: which drive is it, and how many wheels?"


def drives_sideways(files: tuple[FileStudy, ...]) -> bool | None:
    """Return whether commands or poses show sideways motion; None if neither is known."""
    commands = (one.find("twist_command_y") for one in files)
    if any(command is not None and np.nanmax(np.abs(command.values)) > 0 for command in commands):
        return True
    posed = file_with_pose(files)
    turned = None if posed is None else posed.find("pose_heading")
    if posed is None or turned is None or not turned.unit or not posed.has_place:
        return None
    pose = np.stack([posed.channel(name).values[:, 0] for name in GROUPS["pose"]], axis=1)
    pose[:, 2] *= factor(turned.unit, "rad")
    ahead, left, _ = np.abs(body_steps(pose[~np.isnan(pose).any(axis=1)])).sum(axis=0).tolist()
    return left > _SIDEWAYS * (ahead + left) if ahead + left > 0 else None


def _two_rows(known: RobotAnswers, wheels: int) -> RobotAnswers:
    """Return answers with wheels placed in a left and a right row, as a first guess.

    If the number of wheels is odd, the last wheel is at the back in the middle.
    """
    pairs = wheels // 2
    places = [
        (0.2 - 0.4 * k / max(pairs - 1, 1), side) for k in range(pairs) for side in (0.15, -0.15)
    ]
    places += [(-0.3, 0.0)] * (wheels % 2)
    directions, rollers = known.directions_deg, known.rollers_deg
    return replace(
        known,
        wheels=wheels,
        places_m=tuple(places),
        directions_deg=directions if len(directions) == wheels else (0.0,) * wheels,
        rollers_deg=rollers if len(rollers) == wheels else (None,) * wheels,
    )


_MORE_RUNS = 4
"""Number of further runs that are studied besides the first."""


@dataclass(frozen=True, eq=False)
class SortedFiles:
    """All files that were found, sorted into published formats and other runs.

    Attributes:
        root: folder of the files.
        presets: kinds of files in a published format, each with the name of its preset.
        groups: studies of the runs made of the other kinds of files.
        hints: comments about published formats that may be those of the files.
        sentences: lines about files that were found or left out.
        paths: every file, including files that are left out or are not logs.
    """

    root: Path
    presets: list[tuple[FileKind, str]]
    groups: list[RunStudy]
    hints: list[str]
    sentences: list[str]
    paths: frozenset[Path]


def sort_files(path: Path) -> SortedFiles:
    """Return the log files at a path, sorted.

    If the path is a file without wheels or whole poses, other files in its folder are added.
    """
    formats, no_logs = formats_below(path) if path.is_dir() else ([format_of(path)], {})
    presets, others, hints = [], [], []
    for kind in file_kinds(formats):
        sure, perhaps = matching_presets(kind)
        if sure:
            presets.append((kind, sure))
            continue
        others.append(RunStudy(kind, study_file(kind.formats[0])))
        if perhaps:
            hints.append(
                f"If {kind.paths[0].name} is of the published logs: format = "
                f"{' or '.join(perhaps)} in [[logs]] reads it, and no layout is needed."
            )
    if path.is_file() and others and not (others[0].complete and others[0].has_whole_pose):
        others += _siblings(path, others[0].kind)
    groups, left_out = _run_files(others)
    left_out += list(no_logs.values())[:3]
    left_out += [f"{len(no_logs) - 3} more that are no logs"] * (len(no_logs) > 3)
    sentences = [
        *(f"{len(kind.paths)} of format {name}: {kind.paths[0]} ..." for kind, name in presets),
        *(_sentence(group) for group in groups),
        *(f"left out: {line}" for line in left_out),
    ]
    kinds = [*(kind for kind, _ in presets), *(one.kind for one in others)]
    paths = frozenset(no_logs) | {path for kind in kinds for path in kind.paths}
    root = path if path.is_dir() else path.parent
    return SortedFiles(root, presets, groups, hints, sentences, paths)


def _siblings(path: Path, kind: FileKind) -> list[RunStudy]:
    """Return the files of other kinds in the folder of a file."""
    near = [p for p in sorted(path.parent.iterdir()) if p.is_file() and p.suffix in SUFFIXES]
    out = []
    for other in near:
        try:
            format = format_of(other)
        except DataError:
            continue
        if format.signature != kind.formats[0].signature:
            out.append(RunStudy(FileKind((format,)), study_file(format)))
    return out


def _run_files(kinds: list[RunStudy]) -> tuple[list[RunStudy], list[str]]:
    """Return the runs of each kind of files with wheels, and lines about files outside all runs.

    Files of other kinds beside the file with the wheels are added to the run.
    """
    mains = [run for run in kinds if run.main.wheels] or kinds[:1]
    rest = [run for run in kinds if run not in mains]
    if len(mains) > 1 and not any(run.complete for run in mains):
        # Several kinds have wheels but none has a pose as well: the first kind is the main one.
        mains, rest = mains[:1], mains[1:] + rest
    groups, used = [], []
    for run in mains:
        main, beside = run.main, []
        have = frozenset(one.channel for one in main.found) - {"time"}
        for other in rest:
            pattern = pattern_beside(run.kind, other.kind)
            # A pose comes from one file, so a whole pose replaces a heading or position elsewhere.
            better = other.main.has_whole_pose and not main.has_whole_pose
            one = other.main.without(have - _POSE if better else have)
            fresh = {found.channel for found in one.found} - {"time"}
            if pattern is None or not fresh or one.clock is None or main.clock is None:
                continue
            if max(main.time[0], one.time[0]) >= min(main.time[-1], one.time[-1]):
                continue  # the files cannot be of one run, since their times do not overlap
            main = main.without(_POSE) if better else main
            beside.append((pattern, one))
            have |= fresh
            used.append(other)
        group = replace(run, main=main, beside=tuple(beside))
        groups.append(replace(group, others=_more_runs(group)))
    lost = [run.kind.paths[0] for run in rest if run not in used]
    lines = [f"{path}: it has no wheels, and adds no channel to another file" for path in lost]
    return groups, lines


def _more_runs(group: RunStudy) -> tuple[RunStudy, ...]:
    """Return further runs of the same kinds, spread evenly over all runs."""
    count = len(group.kind.formats)
    chosen = sorted({k * count // (_MORE_RUNS + 1) for k in range(1, _MORE_RUNS + 1)} - {0})
    out = []
    for format in (group.kind.formats[k] for k in chosen):
        folder, stem = format.path.parent, format.path.stem
        names = [(name, folder / name.replace("{stem}", stem)) for name, _ in group.beside]
        try:
            beside = tuple((name, study_file(format_of(path))) for name, path in names)
            out.append(RunStudy(group.kind, study_file(format), beside))
        except DataError:
            continue  # the error is reported when the run is read; other runs are enough here
    return tuple(out)


def _sentence(group: RunStudy) -> str:
    """Return a sentence with the channels of a run's files."""
    first, *listed = [", ".join(found.channel for found in one.found) for one in group.all]
    more = [
        f"; beside it {name}: {channels}"
        for (name, _), channels in zip(group.beside, listed, strict=True)
    ]
    like = f"{len(group.kind.paths)} like {group.kind.paths[0]}"
    return f"{like}: {first or 'no known channel'}{''.join(more)}"
