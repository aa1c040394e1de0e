"""From logs to the config that is proposed for them."""

from dataclasses import dataclass, replace
from pathlib import Path

from slipid.data.reading.layout import Layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.reader import read_logs
from slipid.job.config import geometry, parsed
from slipid.job.logs import layout_of
from slipid.job.new.look.bags import bags_in, propose_bags
from slipid.job.new.look.file import SUFFIXES, head_of, heads_below
from slipid.job.new.look.kinds import Kind, a_folder_each, globs_of, kinds_of, pattern_beside
from slipid.job.new.look.known_formats import likely_presets
from slipid.job.new.look.robot import robot_from
from slipid.job.new.look.sketches import Known, file_sketch, radius_hint, without
from slipid.job.new.look.study import Study, study
from slipid.job.new.questions import Answers, Told, robot_of
from slipid.job.new.sketch import BesideSketch, LayoutSketch, LogsSketch, Sketch
from slipid.job.new.template import new_config
from slipid.support.errors import DataError

_RUNS = 4
"""Runs beside the first that are looked into."""
FLOOR = "floor"
_FLOOR = "on which floor was {} driven? Its name, or folder where folders are called after floors"


@dataclass(frozen=True)
class Proposal:
    """A config to be, and what was found, in sentences."""

    sketch: Sketch
    said: tuple[str, ...]


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
class Sorted:
    """All files that were found: those of published formats, and others by run.

    `told` are lines about what was found and left out.
    """

    root: Path
    presets: tuple[tuple[Kind, str], ...]
    groups: tuple[Group, ...]
    also: tuple[Kind, ...]
    hints: tuple[str, ...]
    told: tuple[str, ...]
    no_logs: tuple[Path, ...]


def propose(path: Path, told: Told) -> Proposal:
    """The config that a log, or a folder of logs, is proposed to have.

    Raises:
        DataError: there is no log, or what was told is no answer.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder; expected a log, or a folder of logs")
    if bags := bags_in(path):
        proposed = propose_bags(bags, path, told)
        return Proposal(proposed.sketch, proposed.said)
    found = _sorted(path)
    wheels = max((group.main.columns.wheels for group in found.groups), default=0)
    for _, name in found.presets:
        wheels = max(wheels, _wheels_of(PRESETS[name]))
    files = tuple(one for group in found.groups for one in group.all)
    guessed = robot_from(told, wheels, files)
    robot = _as_presets_say(guessed.robot, found)
    known = [_known(group, robot) for group in found.groups]
    logs = _logs(found)
    used = {one.format for one in logs if not one.off}
    presets = [PRESETS[name] for _, name in found.presets if name in used]
    sketch = Sketch(
        robot,
        tuple(
            _layout(group, one, k)
            for k, (group, one) in enumerate(zip(found.groups, known, strict=True))
        ),
        tuple(logs),
        carries=frozenset(channel for layout in presets for channel in layout.channels),
        above=(f"Proposed from {path}.", *found.hints),
        data=str(found.root),
        hints=(*guessed.hints, *(hint for one in known for hint in radius_hint(one))),
    )
    return Proposal(_tried(sketch, found, wheels), (*found.told, *found.hints))


def _sorted(path: Path) -> Sorted:
    """All files that belong to what was named."""
    if path.is_dir():
        heads, no_logs = heads_below(path)
        root, kinds = path, kinds_of(heads)
    else:
        heads, no_logs = [head_of(path)], []
        root, kinds = path.parent, kinds_of(heads)
    presets, others, hints = [], [], []
    for kind in kinds:
        likely = likely_presets(kind)
        if likely.sure:
            presets.append((kind, likely.sure))
            continue
        others.append((kind, study(kind.heads[0])))
        if likely.perhaps:
            hints.append(
                f"If {kind.paths[0].name} is of the published logs: format = "
                f"{' or '.join(likely.perhaps)} in [[logs]] reads it, and no layout is needed."
            )
    if path.is_file() and others and not _complete(others[0][1]):
        others += _siblings(path, others[0][0])
    groups, left_out = _groups(others)
    told = [f"{len(kind.paths)} of format {name}: {kind.paths[0]} ..." for kind, name in presets]
    told += [_found(group) for group in groups]
    told += [f"left out: {line}" for line in (*left_out, *(one.why for one in no_logs[:3]))]
    told += [f"left out: {len(no_logs) - 3} more that are no logs"] * (len(no_logs) > 3)
    paths = tuple(one.path for one in no_logs)
    also = tuple(kind for kind, _ in others)
    return Sorted(root, tuple(presets), tuple(groups), also, tuple(hints), tuple(told), paths)


def _siblings(path: Path, kind: Kind) -> list[tuple[Kind, Study]]:
    """Files beside one that lacks something."""
    near = [p for p in sorted(path.parent.iterdir()) if p.is_file() and p.suffix in SUFFIXES]
    out = []
    for other in near:
        try:
            head = head_of(other)
        except DataError:
            continue
        if head.signature != kind.heads[0].signature:
            out.append((Kind((head,)), study(head)))
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
    count = len(group.kind.heads)
    chosen = sorted({k * count // (_RUNS + 1) for k in range(1, _RUNS + 1)} - {0})
    out = []
    for k in chosen:
        head = group.kind.heads[k]
        names = [
            (n, head.path.parent / n.replace("{stem}", head.path.stem)) for n, _ in group.beside
        ]
        try:
            beside = tuple((name, study(head_of(path))) for name, path in names)
            out.append(Group(group.kind, study(head), beside))
        except DataError:
            continue  # the reader will say it of this run; the first one tells enough
    return tuple(out)


def _together(one: Study, other: Study) -> bool:
    """Whether two files cover the same time: then they are of one run."""
    return max(one.time[0], other.time[0]) < min(one.time[-1], other.time[-1])


def _found(group: Group) -> str:
    """What a group of files holds, in a sentence."""
    said = [", ".join(found.channel for found in one.columns.found) for one in group.all]
    more = [
        f"; beside it {name}: {channels}"
        for (name, _), channels in zip(group.beside, said[1:], strict=True)
    ]
    like = f"{len(group.kind.paths)} like {group.kind.paths[0]}"
    return f"{like}: {said[0] or 'nothing known'}{''.join(more)}"


def _wheels_of(layout: Layout) -> int:
    turns = ("wheel_ticks", "motor_speed", "wheel_speed")
    return max((len(layout.channels[c].columns) for c in turns if c in layout.channels), default=0)


def _as_presets_say(robot: Answers, found: Sorted) -> Answers:
    """The gear ratio that a published format has, unless another was told."""
    gears = {PRESETS[name].gear_ratio for _, name in found.presets}
    if len(gears) != 1 or "gear_ratio" not in robot.taken:
        return robot
    return replace(robot, gear_ratio=gears.pop(), taken=robot.taken - {"gear_ratio"})


def _known(group: Group, robot: Answers) -> Known:
    others = tuple(Known(robot, other.main, other.all) for other in group.others)
    return Known(robot, group.main, group.all, others)


def _layout(group: Group, known: Known, number: int) -> LayoutSketch:
    file = file_sketch(group.main, known)
    if not any(one.columns.has_pose for one in group.all):
        ask = "no pose was found (x, y, and a heading or a quaternion): a fit needs one"
        file = replace(file, questions=(*file.questions, ask))
    beside = tuple(BesideSketch(name, file_sketch(one, known)) for name, one in group.beside)
    return LayoutSketch(_name(number), file, beside)


def _name(number: int) -> str:
    return "mine" if number == 0 else f"mine{number + 1}"


def _logs(found: Sorted) -> list[LogsSketch]:
    """A section for each glob; those of files that lack wheels or a pose are commented out."""
    named = [(kind, name) for kind, name in found.presets]
    named += [(group.kind, _name(k)) for k, group in enumerate(found.groups)]
    every = {path for kind, _ in named for path in kind.paths}
    every |= {path for one in found.also for path in one.paths} | set(found.no_logs)
    whole = {name for name in PRESETS if {"pose_x"} <= PRESETS[name].channels.keys()}
    whole -= {name for name in PRESETS if not _wheels_of(PRESETS[name])}
    whole |= {_name(k) for k, group in enumerate(found.groups) if group.complete}
    out = []
    for kind, name in named:
        for glob in globs_of(found.root, kind, sorted(every - set(kind.paths))):
            floors = glob.count("/") > 0 and not a_folder_each(kind)
            off = name not in whole
            surface, ask = ("folder", "") if floors else (FLOOR, _FLOOR.format(glob))
            above = ("Without wheels or without a pose, so nothing to fit:",) if off else ()
            out.append(LogsSketch(glob, name, surface, above, "" if off else ask, off))
    if all(one.off for one in out):  # a config has one section at least; the layout asks for a pose
        return [replace(one, off=False, above=()) for one in out]
    return sorted(out, key=lambda one: one.off)


def _tried(sketch: Sketch, found: Sorted, wheels: int) -> Sketch:
    """The sketch with what the reader says of the first file of each layout, if it refuses it."""
    drives = geometry(robot_of(sketch.robot)).drives
    layouts = []
    for layout, group in zip(sketch.layouts, found.groups, strict=True):
        asked = list(layout.file.questions)
        if wheels and drives != wheels:
            asked.append(f"[robot] has {drives} drives, but {wheels} have columns here: which?")
        if problem := _refused(sketch, layout.name, group):
            asked.append(f"the reader says: {problem}")
        layouts.append(replace(layout, file=replace(layout.file, questions=tuple(asked))))
    return replace(sketch, layouts=tuple(layouts))


def _refused(sketch: Sketch, name: str, group: Group) -> str:
    """Why the first file of a layout cannot be read; nothing where it can."""
    try:
        config = parsed(Path("robot.toml"), new_config(sketch, "robot.toml").text)
        section = next((one for one in config.content.logs if one.format == name), None)
        if section is None:
            return ""
        path = group.kind.paths[0]
        read_logs(path, layout_of(config, section), path.parent, FLOOR, "as_built")
    except DataError as error:
        return str(error).splitlines()[0].replace("robot.toml ", "")
    return ""
