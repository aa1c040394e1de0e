"""Proposal of a config for a log or a folder of logs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from slipid.app.config import geometry, parsed
from slipid.app.logs import layout_of
from slipid.app.new.bags import bags_in, propose_bags
from slipid.app.new.config_lines import ConfigLine, toml
from slipid.app.new.config_text import new_config
from slipid.app.new.draft import COLUMNS_HELP, ConfigDraft, LayoutDraft, LogsDraft
from slipid.app.new.file_channels import floor_of, folder_per_run, globs_of
from slipid.app.new.file_draft import file_draft, radius_hint
from slipid.app.new.file_study import FileStudy, RunStudy, file_with_pose
from slipid.app.new.guess import SortedFiles, guess_robot, sort_files
from slipid.app.new.robot_answers import RobotAnswers, RobotOptions
from slipid.app.new.robot_questions import robot_of
from slipid.data.check.columns import refuse_misordered
from slipid.data.log import Log
from slipid.data.reading.bag.runs import PAUSE_S, runs_between_pauses
from slipid.data.reading.layout import GROUPS, TURNS, Layout
from slipid.data.reading.motor_layout import MotorOptions, motor_layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.reader import read_logs
from slipid.support.errors import DataError

FLOOR = "floor"
_NOT_WHOLE = "Without wheels or without a pose, so nothing to fit:"
_FLOOR = 'on which floor was {} driven? Its name, or "folder" if folders are named after floors'


def propose(path: Path, options: RobotOptions) -> ConfigDraft:
    """Return the proposed config for a log or a folder of logs.

    Args:
        path: the log or folder.
        options: command-line options that describe the robot.

    Raises:
        DataError: there is no log, an option is not valid, or the log is of a motor on a bench.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder; expected a log, or a folder of logs")
    if bags := bags_in(path):
        return _bags_checked(propose_bags(bags, path, options), bags[0])
    found = sort_files(path)
    counts = [group.main.wheels for group in found.groups]
    wheels = max(counts + [_wheels_of(PRESETS[name]) for _, name in found.presets])
    files = tuple(one for group in found.groups for one in group.all)
    _refuse_bench(path, found, wheels, files)
    robot, hints = guess_robot(options, wheels, files)
    robot = _with_preset_gear(robot, found)
    logs = _logs(found)
    used = {one.format for one in logs if not one.commented_out}
    presets = [PRESETS[name] for _, name in found.presets if name in used]
    for group in found.groups:
        hints = radius_hint(group, robot) | hints
    draft = ConfigDraft(
        robot,
        tuple(one for k, run in enumerate(found.groups) for one in _layouts(run, robot, _name(k))),
        tuple(logs),
        preset_channels=frozenset(channel for layout in presets for channel in layout.channels),
        above=(f"Proposed from {path}.", *found.hints),
        data=str(found.root),
        hints=hints,
        sentences=(*found.sentences, *found.hints),
    )
    return _checked_by_reader(draft, found.groups, wheels)


def _refuse_bench(path: Path, found: SortedFiles, wheels: int, files: Sequence[FileStudy]) -> None:
    """Raise `DataError` for the log of a motor on a bench, which `slipid motor` reads."""
    if found.presets or wheels > 1 or not files or file_with_pose(files) is not None:
        return
    first = files[0].format.path
    try:
        guessed = motor_layout(files[0].format, {}, MotorOptions(pole_pairs=1.0))
    except DataError:
        return
    channels = ", ".join(channel.removeprefix("motor_") for channel in guessed.channels)
    also = 'for several logs of a motor: drive = "motor" in [robot] of a config (slipid reference)'
    raise DataError(
        f"{path}: no wheels and no pose; "
        f"{first.name} looks like the log of a motor on a bench ({channels})\n"
        f"run: slipid motor {first} --out DIR\n{also}"
    )


def _wheels_of(layout: Layout) -> int:
    return max((len(layout.channels[c].columns) for c in TURNS if c in layout.channels), default=0)


def _with_preset_gear(robot: RobotAnswers, found: SortedFiles) -> RobotAnswers:
    """Return the robot with the gear ratio of a published format, unless an option gives one."""
    gears = {PRESETS[name].gear_ratio for _, name in found.presets}
    if len(gears) != 1 or "gear_ratio" not in robot.defaults:
        return robot
    return replace(robot, gear_ratio=gears.pop(), defaults=robot.defaults - {"gear_ratio"})


def _layouts(run: RunStudy, robot: RobotAnswers, name: str) -> list[LayoutDraft]:
    """Return the drafts of the layouts of all files of a run."""
    first = file_draft(name, run.main, run, robot, COLUMNS_HELP)
    if not run.has_whole_pose:
        first = replace(first, questions=(*first.questions, _missing_pose(run)))
    beside = (
        (f"{name}.beside.{toml(pattern)}", one, f"Of the same run, in {pattern}:")
        for pattern, one in run.beside
    )
    return [first, *(file_draft(key, one, run, robot, (help,)) for key, one, help in beside)]


def _missing_pose(run: RunStudy) -> str:
    """Return the question about the pose of a run without a whole pose, with what was found."""
    needed = "motors and contact need x, y, and a heading or a quaternion"
    needed += "; identify --only calibration does without one of them" if run.has_pose else ""
    parts = [
        f"{name.removeprefix('pose_')} (column {one.format.column(found.columns[0])})"
        for name in (*GROUPS["pose"], "pose_quaternion")
        for one in run.all
        if (found := one.find(name)) is not None
    ]
    only = f"of a pose only {' and '.join(parts)} was found" if parts else "no pose was found"
    return f"{only}: {needed}"


def _name(number: int) -> str:
    return "mine" if number == 0 else f"mine{number + 1}"


def _logs(found: SortedFiles) -> list[LogsDraft]:
    """Return a log section for each glob; sections without wheels or a pose are commented out."""
    named = [*found.presets, *((group.kind, _name(k)) for k, group in enumerate(found.groups))]
    whole = {
        name
        for name, layout in PRESETS.items()
        if "pose_x" in layout.channels and _wheels_of(layout)
    }
    whole |= {_name(k) for k, group in enumerate(found.groups) if group.complete}
    out = []
    for kind, name in named:
        for glob in globs_of(found.root, kind, sorted(found.paths - set(kind.paths))):
            floors = glob.count("/") > 0 and not folder_per_run(kind)
            one = LogsDraft(glob, name, "folder" if floors else floor_of(glob))
            if name not in whole:
                one = replace(one, above=(_NOT_WHOLE,), commented_out=True)
            elif not floors:
                one = replace(one, question=_FLOOR.format(glob))
            out.append(one)
    if all(one.commented_out for one in out):
        # A config must have at least one section, so the comment signs are removed; the layouts ask
        # for what is missing.
        return [replace(one, commented_out=False, above=()) for one in out]
    return sorted(out, key=lambda one: one.commented_out)


def _checked_by_reader(draft: ConfigDraft, runs: Sequence[RunStudy], wheels: int) -> ConfigDraft:
    """Return the draft, with questions about problems in reading the first file of each layout.

    `wheels` is the number of wheels with columns in the logs.
    """
    drives = geometry(robot_of(draft.robot)).drives
    first = {_name(k): run.kind.paths[0] for k, run in enumerate(runs)}
    layouts = []
    for layout in draft.layouts:
        questions = list(layout.questions)
        if layout.name in first and wheels and drives != wheels:
            questions.append(
                f"[robot] has {drives} drives, but {wheels} have columns: which is right?"
            )
        try:
            if layout.name in first:
                _read(draft, layout.name, first[layout.name])
        except DataError as error:
            questions.append(_problem(error))
        layouts.append(replace(layout, questions=tuple(questions)))
    return replace(draft, layouts=tuple(layouts))


def _bags_checked(draft: ConfigDraft, first: Path) -> ConfigDraft:
    """Return the draft for bags, with a question about a problem in reading the first bag, if any.

    If the wheels pause in the bag, it is separated into runs at the pauses, in one session.
    """
    (bag,) = draft.layouts
    try:
        logs = _read(draft, bag.name, first)
    except DataError as error:
        return replace(draft, layouts=(replace(bag, questions=(*bag.questions, _problem(error))),))
    count = max((runs_between_pauses(log, PAUSE_S) for log in logs), default=1)
    if count < 2:
        return draft
    comment = f"cut where no wheel moves for longer: {count} runs in the first bag"
    cut = ConfigLine("runs", f"{{ pause_s = {PAUSE_S:g} }}", comment)
    sections = tuple(replace(one, session="file") for one in draft.logs)
    return replace(draft, layouts=(replace(bag, settings=(*bag.settings, cut)),), logs=sections)


def _problem(error: DataError) -> str:
    return f"reading fails: {str(error).splitlines()[0].replace('robot.toml ', '')}"


def _read(draft: ConfigDraft, name: str, path: Path) -> Sequence[Log]:
    """Return the runs in a file, read with the layout `name` of the draft.

    There are no runs if no section of the draft uses the layout.

    Raises:
        DataError: the file cannot be read with this layout.
    """
    config = parsed(Path("robot.toml"), new_config(draft, "robot.toml").text)
    for section in config.content.logs:
        if section.format == name:
            layout = layout_of(config, section)
            logs = read_logs(path, layout, path.parent, FLOOR, "as_built").logs
            refuse_misordered(logs)
            return logs
    return ()
