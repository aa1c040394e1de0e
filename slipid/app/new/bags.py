"""Proposal of a config for bags, from the types and names of their topics."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from slipid.app.new.config_lines import ConfigLine, toml
from slipid.app.new.draft import ConfigDraft, LayoutDraft, LogsDraft
from slipid.app.new.file_channels import common_glob, floor_of, rank
from slipid.app.new.guess import guess_robot
from slipid.app.new.robot_answers import RobotAnswers, RobotOptions
from slipid.app.reference.keys import in_short, meanings
from slipid.data.reading.bag.layout import BagLayout
from slipid.data.reading.bag.topics import Topic, topics_of
from slipid.data.reading.column_names import meaning_of
from slipid.data.reading.layout import CHANNELS, PER_WHEEL, TURNS, Layout

SUFFIXES = (".bag", ".db3", ".mcap", ".ulg")
_METADATA = "metadata.yaml"
_ODOMETRY = "nav_msgs/msg/Odometry"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_EFFORT = (
    "what is the effort: a current (A), a torque (motor_torque or wheel_torque, N*m), a voltage "
    "(V) or a duty (1)?"
)
_TOPICS_HELP = (
    "The topic of each channel. Known types of messages need neither field nor unit; the frame of "
    "a pose in /tf and the meaning of the effort of joints must be given."
)
_NUMBER = re.compile(r"std_msgs/msg/(U?Int|Float)(\d+)")
_BY_NAME = ("current", "voltage", "duty")
"""Channels that are recognised by the names of fields in messages of unknown types."""


@dataclass(frozen=True)
class _TopicChannel:
    """Channel, or group of channels, that was found in a topic.

    Attributes:
        channel: name of the channel or group.
        topic: topic with the channel.
        wheels: number of wheels, each with a value in a message; 0 for a channel of the whole
            robot.
        question: open question for the user; empty if there is none.
        field, unit: field and unit of the numbers; empty if the message type implies them.
        beside: topics of the other wheels, if each wheel has a topic of its own.
    """

    channel: str
    topic: Topic
    wheels: int = 0
    question: str = ""
    field: str = ""
    unit: str = ""
    beside: tuple[Topic, ...] = ()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Return all topics of the channel, in the order of the wheels."""
        return (self.topic, *self.beside)

    def line(self) -> ConfigLine:
        """Return the config line of the channel; it is commented out if the field is an effort."""
        topic = self.topic
        inside = f"topic = {toml(topic.name)}"
        if self.beside:
            inside = f"topics = {toml([one.name for one in self.topics])}"
        if self.field:
            inside += f", field = {toml(self.field)}, unit = {toml(self.unit)}"
        if topic.type == _TRANSFORMS and topic.frames:
            frame, _, child = topic.frames[0].partition(" -> ")
            inside += f", frame = {toml(frame)}, child = {toml(child)}"
        rated = topic.type + ("" if topic.rate is None else f", {topic.rate:.3g} Hz")
        effort = self.question == _EFFORT
        return ConfigLine(self.channel, f"{{ {inside} }}", rated, self.question, effort)


def bags_in(path: Path) -> list[Path]:
    """Return the bags at or below a path, as a config names them.

    A rosbag2 folder is named by its metadata.yaml; other files in the folder are not listed.
    """
    if path.is_file():
        return [path] if path.suffix in SUFFIXES or path.name == _METADATA else []
    folders = {p.parent for p in path.rglob(_METADATA)}
    alone = (p for p in path.rglob("*") if p.suffix in SUFFIXES and p.parent not in folders)
    return sorted([*(folder / _METADATA for folder in folders), *alone])


def propose_bags(bags: Sequence[Path], path: Path, options: RobotOptions) -> ConfigDraft:
    """Return a config for bags, proposed from the topics of the first bag.

    Args:
        bags: the bags, from `bags_in`.
        path: log or folder that the user named.
        options: command-line options that describe the robot.

    Raises:
        DataError: the first bag cannot be read.
    """
    bag = bags[0]
    topics = topics_of(bag)
    joints, doubt = _joints(topics)
    channels = list(_best_topics(topics, len(joints)))
    channels += _by_topic_names(topics, channels)
    wheels = next((one.wheels for name in TURNS for one in channels if one.channel == name), 0)
    channels += _by_field_names(topics, channels, wheels)
    robot, hints = guess_robot(options, wheels, ())
    questions = [doubt] if doubt else []
    if not any(one.channel == "pose" for one in channels):
        questions.append("no topic with a pose was found: a fit needs one")
    if not wheels:
        questions.append("no topic has the wheels' motion: which one does, and in which field?")
    is_bag = path.is_file() or bag == path / _METADATA
    root = path.parent if is_bag else path
    inside = [PurePosixPath(one.relative_to(root)) for one in bags]
    inside = [one for one in inside if len(one.parts) == len(inside[0].parts)]
    layout = LayoutDraft(
        "mine",
        _layout_lines(robot, joints, channels),
        tuple(one.line() for one in channels),
        "topics",
        help=(_TOPICS_HELP,),
        above=_unused(topics, channels),
        questions=tuple(questions),
    )
    floor = "on which floor was it driven? A topic or table can give it: runs, in the layout"
    glob = common_glob(inside)
    sentences = [f"{bag}: {len(topics)} topics"]
    for one in channels:
        names = ", ".join(topic.name for topic in one.topics)
        sentences.append(f"  {names} ({one.topic.type}): {one.channel}")
    return ConfigDraft(
        robot,
        (layout,),
        (LogsDraft(glob, "mine", floor_of(glob), question=floor),),
        above=(f"Proposed from {bag}.",),
        data=str(root),
        hints=hints,
        sentences=tuple(sentences),
    )


def _joints(topics: Sequence[Topic]) -> tuple[tuple[str, ...], str]:
    """Return the names of the wheels' joints, in the order of the drives, and an open question.

    The question is empty if there is none.
    """
    names = tuple(dict.fromkeys(name for topic in topics for name in topic.joints))
    labels = {name: meaning_of(f"{name}_velocity") for name in names}
    wheels = [
        name for name in names if labels[name].channel == "wheel_speed" and labels[name].label
    ]
    if not names:
        return (), ""
    if not wheels:
        return names, f"which of the joints are wheels, in which order? {', '.join(names)}"
    ordered = tuple(sorted(wheels, key=lambda name: rank(labels[name].label)))
    others = [name for name in names if name not in wheels]
    doubt = f"are these joints no wheels: {', '.join(others)}?" if others else ""
    return ordered, doubt


def _best_topics(topics: Sequence[Topic], joints: int) -> Iterator[_TopicChannel]:
    """Yield the best topic for every channel.

    For a pose, topics other than odometry and transforms are preferred. `joints` is the number of
    the wheels' joints.
    """
    order = sorted(topics, key=lambda t: (t.type == _ODOMETRY, t.type == _TRANSFORMS, t.name))
    taken: set[str] = set()
    for topic in order:
        for channel in topic.serves:
            if channel in taken or not topic.count:
                continue
            taken.add(channel)
            count = max((f.count for f in topic.fields if f.type.endswith("]")), default=1)
            wheels = joints if topic.joints else count if channel in PER_WHEEL else 0
            yield _TopicChannel(channel, topic, wheels, _pose_question(channel, topic))
        if any(f.path == "effort" and f.count for f in topic.fields) and "current" not in taken:
            taken.add("current")
            yield _TopicChannel("current", topic, joints, _EFFORT, "effort", "A")


def _by_field_names(
    topics: Sequence[Topic], channels: Sequence[_TopicChannel], wheels: int
) -> Iterator[_TopicChannel]:
    """Yield channels in messages of unknown types, recognised by the names of fields.

    Such a field has a number for every wheel. Channels that are in `channels` already are omitted.
    """
    taken = {one.channel for one in channels}
    for topic in (one for one in topics if one.count and not one.serves and not one.joints):
        for field in topic.fields:
            meaning = meaning_of(f"wheel {field.path.replace('.', ' ')}")
            if meaning.channel not in _BY_NAME or meaning.channel in taken:
                continue
            if field.count != wheels or field.type.startswith("text"):
                continue
            taken.add(meaning.channel)
            unit = meaning.unit or CHANNELS[meaning.channel]
            ask = (
                f"guessed from the name of the field: is it the {meaning.channel} in {unit}, in "
                "the order of the joints?"
            )
            yield _TopicChannel(meaning.channel, topic, wheels, ask, field.path, unit)


def _by_topic_names(
    topics: Sequence[Topic], channels: Sequence[_TopicChannel]
) -> Iterator[_TopicChannel]:
    """Yield channels whose wheels have topics of their own, with a single number in a message.

    They are recognised by the names of the topics. Channels in `channels` already are omitted.
    """
    found: dict[str, dict[str, Topic]] = {}
    for topic in topics:
        if topic.count and (number := _NUMBER.fullmatch(topic.type)):
            meaning = meaning_of(topic.name)
            channel = meaning.channel
            if channel == "wheel_position":
                channel = "wheel_ticks" if "Int" in number[1] else "wheel_angle"
            if channel in PER_WHEEL and meaning.label:
                found.setdefault(channel, {}).setdefault(meaning.label, topic)
    taken = {one.channel for one in channels}
    for channel in (name for name in found if name not in taken):
        first, *others = (found[channel][label] for label in sorted(found[channel], key=rank))
        unit = CHANNELS[channel]
        ask = f"guessed from the topics' names: is it {channel}, in {unit}, in this order?"
        if others:
            yield _TopicChannel(
                channel, first, 1 + len(others), ask, "data", unit, beside=tuple(others)
            )


def _pose_question(channel: str, topic: Topic) -> str:
    """Return the question about a topic with a pose; empty if its type leaves no question."""
    if channel != "pose":
        return ""
    if topic.type == _ODOMETRY:
        return (
            "is this pose from a camera, lidar or motion capture? Odometry of wheels is of no use"
        )
    if topic.type == _TRANSFORMS:
        return f"which frame and which child? There are: {'; '.join(topic.frames)}"
    return ""


def _layout_lines(
    robot: RobotAnswers, joints: tuple[str, ...], channels: Sequence[_TopicChannel]
) -> tuple[ConfigLine, ...]:
    """Return the lines of the layout except its topics."""

    def line(key: str, value: object, question: str = "") -> ConfigLine:
        kind = BagLayout if key in meanings(BagLayout) else Layout
        return ConfigLine(key, toml(value), in_short(kind, key), question)

    lines = [ConfigLine("kind", toml("bag"))]
    have = {one.channel for one in channels}
    lines += [line("joints", joints)] if joints else []
    if "wheel_ticks" in have:
        ask = ""
        if "ticks_per_revolution" in robot.defaults:
            ask = "how many, of the motor shaft, all edges counted?"
        lines.append(line("ticks_per_revolution", robot.ticks_per_revolution or 1000.0, ask))
        types = (one.topic.type for one in channels if one.channel == "wheel_ticks" and one.beside)
        bits = (_NUMBER.fullmatch(name) for name in types)
        if bit := next((found[2] for found in bits if found and found[2] in ("8", "16")), None):
            lines.append(line("tick_bits", int(bit)))
    lines.append(ConfigLine("gear_ratio", toml(robot.gear_ratio), "as above"))
    if "current" in have:
        ask = "do currents have a sign, or are they magnitudes?"
        lines.append(ConfigLine("current_is_signed", "true", "false for magnitudes", ask))
    return tuple(lines)


def _unused(topics: Sequence[Topic], channels: Sequence[_TopicChannel]) -> tuple[str, ...]:
    """Return a comment for each unused topic, with the fields of its messages."""
    used, notes = {topic.name for one in channels for topic in one.topics}, []
    for topic in topics:
        if topic.name in used:
            continue
        paths = [field.path for field in topic.fields if not field.path.startswith("header")]
        fields = f"fields {', '.join(paths[:8])}" if paths else ""
        has = topic.problem or fields if topic.count else "no message"
        notes.append(f"Not used: {topic.name} ({topic.type}){has and ': '}{has}")
    return tuple(notes)
