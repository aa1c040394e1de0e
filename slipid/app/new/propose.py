"""Proposal of a config for a log or a folder of logs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slipid.app.config import geometry, parsed
from slipid.app.logs import layout_of
from slipid.app.new.bags import bags_in, propose_bags
from slipid.app.new.config_lines import ConfigLine
from slipid.app.new.config_text import new_config
from slipid.app.new.draft import ConfigDraft, ConfigProposal, LayoutDraft, LogsDraft
from slipid.app.new.file_channels import floor_of, folder_per_run, globs_of
from slipid.app.new.file_draft import file_draft, radius_hint
from slipid.app.new.file_study import FileStudy, RunStudy
from slipid.app.new.guess import RunFiles, SortedFiles, guess_robot, sort_files
from slipid.app.new.robot_questions import RobotAnswers, RobotOptions, robot_of
from slipid.data.check.columns import refuse_misordered
from slipid.data.log import Log
from slipid.data.reading.bag.runs import PAUSE_S, runs_between_pauses
from slipid.data.reading.layout import Layout
from slipid.data.reading.motor_layout import motor_layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.reader import read_logs
from slipid.support.errors import DataError

FLOOR = "floor"
_FLOOR = "on which floor was {} driven? Its name, or folder where folders are called after floors"


def propose(path: Path, options: RobotOptions) -> ConfigProposal:
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
        proposed = propose_bags(bags, path, options)
        return replace(proposed, draft=_bags_checked(proposed.draft, bags[0]))
    found = sort_files(path)
    wheels = max((group.main.channels.wheels for group in found.groups), default=0)
    for _, name in found.presets:
        wheels = max(wheels, _wheels_of(PRESETS[name]))
    files = tuple(one for group in found.groups for one in group.all)
    _refuse_bench(path, found, wheels, files)
    guessed = guess_robot(options, wheels, files)
    robot = _with_preset_gear(guessed.robot, found)
    known = [_run_study(group, robot) for group in found.groups]
    logs = _logs(found)
    used = {one.format for one in logs if not one.commented_out}
    presets = [PRESETS[name] for _, name in found.presets if name in used]
    draft = ConfigDraft(
        robot,
        tuple(
            _layout(group, one, k)
            for k, (group, one) in enumerate(zip(found.groups, known, strict=True))
        ),
        tuple(logs),
        preset_channels=frozenset(channel for layout in presets for channel in layout.channels),
        above=(f"Proposed from {path}.", *found.hints),
        data=str(found.root),
        hints=(*guessed.hints, *(hint for one in known for hint in radius_hint(one))),
    )
    return ConfigProposal(
        _checked_by_reader(draft, found, wheels), (*found.sentences, *found.hints)
    )


def _refuse_bench(path: Path, found: SortedFiles, wheels: int, files: Sequence[FileStudy]) -> None:
    """Raise `DataError` for the log of a motor on a bench, which `slipid motor` reads."""
    if found.presets or wheels > 1 or not files or any(one.channels.has_pose for one in files):
        return
    first = files[0].format.path
    try:
        guessed = motor_layout(files[0].format, {}, signed=True)
    except DataError:
        return
    channels = ", ".join(channel.removeprefix("motor_") for channel in guessed.channels)
    also = 'several logs of it: drive = "motor" in [robot] of a config, see slipid reference'
    raise DataError(
        f"{path}: no wheels and no pose; "
        f"{first.name} is like that of a motor on a bench ({channels})\n"
        f"run: slipid motor {first} --out DIR\n{also}"
    )


def _wheels_of(layout: Layout) -> int:
    turns = ("wheel_ticks", "motor_speed", "wheel_speed")
    return max((len(layout.channels[c].columns) for c in turns if c in layout.channels), default=0)


def _with_preset_gear(robot: RobotAnswers, found: SortedFiles) -> RobotAnswers:
    """Return the robot with the gear ratio of a published format, unless an option gives one."""
    gears = {PRESETS[name].gear_ratio for _, name in found.presets}
    if len(gears) != 1 or "gear_ratio" not in robot.defaults:
        return robot
    return replace(robot, gear_ratio=gears.pop(), defaults=robot.defaults - {"gear_ratio"})


def _run_study(group: RunFiles, robot: RobotAnswers) -> RunStudy:
    others = tuple(RunStudy(robot, other.main, other.all) for other in group.others)
    return RunStudy(robot, group.main, group.all, others)


def _layout(group: RunFiles, known: RunStudy, number: int) -> LayoutDraft:
    file = file_draft(group.main, known)
    if not any(one.channels.has_pose for one in group.all):
        ask = "no pose was found (x, y, and a heading or a quaternion): a fit needs one"
        file = replace(file, questions=(*file.questions, ask))
    beside = tuple(replace(file_draft(one, known), pattern=name) for name, one in group.beside)
    return LayoutDraft(_name(number), file, beside)


def _name(number: int) -> str:
    return "mine" if number == 0 else f"mine{number + 1}"


def _logs(found: SortedFiles) -> list[LogsDraft]:
    """Return a log section for each glob; those without wheels or a pose are commented out."""
    named = [(kind, name) for kind, name in found.presets]
    named += [(group.kind, _name(k)) for k, group in enumerate(found.groups)]
    every = {path for kind, _ in named for path in kind.paths}
    every |= {path for one in found.other_kinds for path in one.paths} | set(found.no_logs)
    whole = {name for name in PRESETS if {"pose_x"} <= PRESETS[name].channels.keys()}
    whole -= {name for name in PRESETS if not _wheels_of(PRESETS[name])}
    whole |= {_name(k) for k, group in enumerate(found.groups) if group.complete}
    out = []
    for kind, name in named:
        for glob in globs_of(found.root, kind, sorted(every - set(kind.paths))):
            floors = glob.count("/") > 0 and not folder_per_run(kind)
            commented_out = name not in whole
            surface, ask = ("folder", "") if floors else (floor_of(glob), _FLOOR.format(glob))
            above = (
                ("Without wheels or without a pose, so nothing to fit:",) if commented_out else ()
            )
            out.append(
                LogsDraft(glob, name, surface, above, "" if commented_out else ask, commented_out)
            )
    if all(
        one.commented_out for one in out
    ):  # a config must have at least one section; its layout asks for what is missing
        return [replace(one, commented_out=False, above=()) for one in out]
    return sorted(out, key=lambda one: one.commented_out)


def _checked_by_reader(draft: ConfigDraft, found: SortedFiles, wheels: int) -> ConfigDraft:
    """Return the draft, with questions about problems in reading the first file of each layout.

    `wheels` is the number of wheels with columns in the logs.
    """
    drives = geometry(robot_of(draft.robot)).drives
    layouts = []
    for layout, group in zip(draft.layouts, found.groups, strict=True):
        questions = list(layout.file.questions)
        if wheels and drives != wheels:
            questions.append(f"[robot] has {drives} drives, but {wheels} have columns here: which?")
        if problem := _read_first(draft, layout.name, group.kind.paths[0]).problem:
            questions.append(f"the reader says: {problem}")
        layouts.append(replace(layout, file=replace(layout.file, questions=tuple(questions))))
    return replace(draft, layouts=tuple(layouts))


def _bags_checked(draft: ConfigDraft, first: Path) -> ConfigDraft:
    """Return the draft for bags, with a question about a problem in reading the first bag, if any.

    If the wheels pause in the bag, it is separated into runs at the pauses, in one session.
    """
    (bag,) = draft.bags
    tried = _read_first(draft, bag.name, first)
    if tried.problem:
        questions = (*bag.questions, f"the reader says: {tried.problem}")
        return replace(draft, bags=(replace(bag, questions=questions),))
    count = max((runs_between_pauses(log, PAUSE_S) for log in tried.logs), default=1)
    if count < 2:
        return draft
    comment = f"cut where no wheel moves for longer: {count} runs in the first bag"
    cut = ConfigLine("runs", f"{{ pause_s = {PAUSE_S:g} }}", comment)
    logs = tuple(replace(one, session="file") for one in draft.logs)
    return replace(draft, bags=(replace(bag, settings=(*bag.settings, cut)),), logs=logs)


@dataclass(frozen=True)
class _ReadResult:
    """Result of reading a file: its runs, or else the reader's error."""

    logs: tuple[Log, ...] = ()
    problem: str = ""


def _read_first(draft: ConfigDraft, name: str, path: Path) -> _ReadResult:
    """Return the result of reading a file with the draft's config.

    Args:
        draft: the draft.
        name: name of the layout.
        path: first file of the layout.
    """
    try:
        config = parsed(Path("robot.toml"), new_config(draft, "robot.toml").text)
        section = next((one for one in config.content.logs if one.format == name), None)
        if section is None:
            return _ReadResult()
        layout = layout_of(config, section)
        logs = read_logs(path, layout, path.parent, FLOOR, "as_built").logs
        refuse_misordered(logs)
        return _ReadResult(tuple(logs))
    except DataError as error:
        return _ReadResult(problem=str(error).splitlines()[0].replace("robot.toml ", ""))
