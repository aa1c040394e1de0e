"""Topics and runs of a bag.

`topics_of` describes every topic by its first messages, without reading the whole bag. `read_bag`
returns the runs of a bag, each with all channels of a layout at their own times.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from slipid.data.reading.bag.definitions import MessageType, definition_of
from slipid.data.reading.bag.layout import GROUPS, BagLayout
from slipid.data.reading.bag.opened import OpenBag, StoredTopic, open_bag
from slipid.data.reading.bag.plan import JOINT_STATE, ChannelPlan, fits, plan
from slipid.data.reading.bag.runs import RunSpan, run_spans
from slipid.data.reading.bag.shape import MessageShape, edges_of, shape_of, steps_of
from slipid.data.reading.bag.signals import channel_signal, check_clocks, group_signals
from slipid.data.reading.bag.streams import Stream, TopicStreams
from slipid.data.reading.layout import PER_WHEEL
from slipid.data.reading.signal import Signal
from slipid.support.errors import DataError

_FIRST_MESSAGES = 10
"""Number of first messages of a topic that its description is based on."""
_SECOND = 10**9
_SELF_EXPLAINED = (
    "pose",
    "twist_command",
    "gyro",
    "bus_voltage",
    "wheel_ticks",
    "motor_speed",
    "current",
)
_JOINTS = {"wheel_angle": "position", "wheel_speed": "velocity"}


@dataclass(frozen=True)
class TopicField:
    """Description of a number, text or array in the messages of a topic.

    Attributes:
        path: path by which a layout names it, such as `motors.current`.
        type: type, such as `float64`, `float64[]` or `text`.
        count: number of elements in the first message.
    """

    path: str
    type: str
    count: int


@dataclass(frozen=True)
class Topic:
    """Description of a topic of a bag.

    Attributes:
        name: name of the topic.
        type: type of the messages, such as `sensor_msgs/msg/JointState`.
        count: number of messages.
        first: time of receipt of the first message [s], None if there is none.
        last: time of receipt of the last message [s], None if there is none.
        fields: fields of the messages; empty if there is no message or they could not be examined.
        joints: names of joints in the first messages of type JointState.
        frames: parent and child of each transform in the first messages, as `map -> base_link`.
        serves: channels, or groups of channels, that a layout can take from the topic without
            naming a field or a unit; the effort of joints is not among them, since its meaning is
            unknown.
        problem: reason why the messages could not be examined, or None.
    """

    name: str
    type: str
    count: int
    first: float | None = None
    last: float | None = None
    fields: tuple[TopicField, ...] = ()
    joints: tuple[str, ...] = ()
    frames: tuple[str, ...] = ()
    serves: tuple[str, ...] = ()
    problem: str | None = None


def topics_of(path: Path, definitions: Path | None = None) -> tuple[Topic, ...]:
    """Return the description of every topic of a bag, from its index and first messages.

    Args:
        path: a .bag, .db3 or .mcap file, the folder of a rosbag2, or the metadata.yaml in it.
        definitions: folder of .msg files, for types whose definition the bag lacks, or None.

    Raises:
        DataError: there is no bag, or it is damaged.
    """
    with open_bag(path) as bag:
        return tuple(_described(bag, stored, definitions) for stored in bag.topics.values())


def _described(bag: OpenBag, stored: StoredTopic, definitions: Path | None) -> Topic:
    """Return the description of one topic."""
    raws = list(islice(bag.messages((stored.name,)), _FIRST_MESSAGES)) if stored.count else []
    if not raws:
        return Topic(stored.name, stored.type, stored.count)
    first, last = raws[0].received / 1e9, _last(bag, stored, raws[-1].received) / 1e9
    known = Topic(stored.name, stored.type, stored.count, first, last)
    try:
        message = definition_of(bag.path, stored.name, stored.type, stored.carried, definitions)
        shapes = [shape_of(raw.data, message, cdr=bag.cdr) for raw in raws]
    except (DataError, ValueError) as error:
        return replace(known, problem=str(error))
    joints = (name for shape in shapes for name in shape.texts(steps_of("name")))
    frames = (f"{edge.parent} -> {edge.child}" for shape in shapes for edge in edges_of(shape))
    return replace(
        known,
        fields=_fields(message, shapes[0]),
        joints=tuple(dict.fromkeys(joints)) if message.name == JOINT_STATE else (),
        frames=tuple(dict.fromkeys(frames)),
        serves=_served(message, shapes[0]),
    )


def _served(message: MessageType, shape: MessageShape) -> tuple[str, ...]:
    """Return the channels that messages of a type contain, for `Topic.serves`.

    For a JointState these are the channels whose arrays are not empty.
    """
    if message.name == JOINT_STATE:
        return tuple(name for name, array in _JOINTS.items() if shape.places(steps_of(array)))
    return tuple(name for name in _SELF_EXPLAINED if fits(name, message))


def _fields(message: MessageType, shape: MessageShape) -> tuple[TopicField, ...]:
    """Return the fields of a message type, with the number of elements in one message."""
    return tuple(
        TopicField(path, what, shape.count(steps_of(path))) for path, what in message.paths.items()
    )


def _last(bag: OpenBag, stored: StoredTopic, known: int) -> int:
    """Return the time of receipt of a topic's last message [ns].

    It is searched backwards from the end of the bag, to time `known` [ns] of an earlier message.
    """
    back = _SECOND
    while (start := bag.end - back) > known:
        received = [raw.received for raw in bag.messages((stored.name,), start)]
        if received:
            return max(received)
        back *= 8
    return max((raw.received for raw in bag.messages((stored.name,), known)), default=known)


@dataclass(frozen=True, eq=False)
class BagRun:
    """One run of a bag.

    Attributes:
        name_suffix: suffix that follows the bag's name in the run's name, such as `#03` or `#name`;
            empty for a single run.
        sha256: SHA-256 hash of the bag's files.
        signals: signals by channel, in the units of `CHANNELS`; a pose as pose_x, pose_y and
            pose_heading (without wrap-around), a twist as twist_command_x, _y and _yaw.
        surface: name of the surface, if the bag or the table of runs gives it, else None.
        load: name of the load set-up, if the bag or the table of runs gives it, else None.
        notes: repairs and omissions, one sentence each.
    """

    name_suffix: str
    sha256: str
    signals: dict[str, Signal]
    surface: str | None
    load: str | None
    notes: tuple[str, ...]


def read_bag(path: Path, layout: BagLayout) -> tuple[BagRun, ...]:
    """Return every run in a bag.

    Args:
        path: a .bag, .db3 or .mcap file, the folder of a rosbag2, or the metadata.yaml in it.
        layout: layout of the bag.

    Raises:
        DataError: the bag is damaged, or does not match the layout; the message names the topic,
            what is there, and the next step.
    """
    with open_bag(path) as bag, ThreadPoolExecutor(1) as beside:
        # Hashing releases the interpreter lock, so on two cores it runs while the bag is read.
        sha256 = beside.submit(lambda: bag.files.sha256)
        notes = list(bag.notes)
        signals = _signals(bag, layout, notes)
        spans = run_spans(bag, layout, signals, notes)
        # If two channels come from one topic, its notes occur twice.
        unique = tuple(dict.fromkeys(notes))
        return tuple(_run(signals, span, sha256.result(), unique) for span in spans)


def _run(
    signals: dict[str, Signal], stretch: RunSpan, sha256: str, notes: tuple[str, ...]
) -> BagRun:
    """Return the part of all signals that lies in one run."""
    parts, without = {}, []
    for name, signal in signals.items():
        first, end = np.searchsorted(signal.time, (stretch.start, stretch.end)).tolist()
        if end > first:
            parts[name] = signal.part(slice(first, end))
        else:
            without.append(name)
    if without:
        notes = (*notes, f"no sample of {', '.join(without)} in this run")
    return BagRun(stretch.suffix, sha256, parts, stretch.surface, stretch.load, notes)


def _signals(bag: OpenBag, layout: BagLayout, notes: list[str]) -> dict[str, Signal]:
    """Return the signals of all channels in the layout, from one pass over the bag."""
    plans = plan(bag, layout)
    collected = _collected(bag, plans)
    signals: dict[str, Signal] = {}
    for one, streams in zip(plans, collected, strict=True):
        if one.channel in GROUPS:
            signals |= group_signals(one, streams, layout, notes)
        else:
            signals[one.channel] = channel_signal(one, streams, layout, notes)
    check_clocks([stream for streams in collected for stream in streams], layout, notes)
    counts = {n: s.values.shape[1] for n, s in signals.items() if n in PER_WHEEL}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{count} in {name}" for name, count in counts.items())
        raise DataError(
            f"{bag.path}: channels disagree on the number of wheels: {listed}; expected the same "
            'of each; name those that count by index (field = ["currents[0]", "currents[1]"])'
        )
    return signals


def _collected(bag: OpenBag, plans: Sequence[ChannelPlan]) -> list[list[Stream]]:
    """Return, for every plan, the numbers from each of its topics."""
    topics = {}
    for name in dict.fromkeys(w.topic for one in plans for w in one.wanted):
        wanted = [w for one in plans for w in one.wanted if w.topic == name]
        picks = [one.pick for one in wanted]
        topics[name] = TopicStreams(bag.path, name, wanted[0].message, picks, cdr=bag.cdr)
    for batch in bag.batches(tuple(topics)):
        topics[batch.topic].add(batch)
    return [[topics[w.topic].stream(w.pick) for w in one.wanted] for one in plans]
