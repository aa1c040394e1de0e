"""Topics and runs of a bag.

Topics are listed with the content of their first messages, without reading the whole bag. Reading a
bag returns every channel of a layout, each at its own times, run by run.
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
"""Number of first messages of a topic that are examined."""
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
    """A number, text or array in the messages of a topic.

    Attributes:
        path: its path in a layout, such as `motors.current`.
        type: such as `float64`, `float64[]`, `text`.
        count: number of elements in the first message.
    """

    path: str
    type: str
    count: int


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: name of the topic.
        type: type of its messages, such as `sensor_msgs/msg/JointState`.
        count: number of messages.
        first: time of receipt of the first message [s], None where there is none.
        last: time of receipt of the last message [s].
        fields: fields of its messages; empty where there are none, or `problem` says why.
        joints: names in the first messages of a JointState.
        frames: parent and child of each transform in the first messages, as `map -> base_link`.
        serves: channels, or groups of them, that a layout may take from it without a field or a
            unit; the effort of joints is not among them, since its meaning is unknown.
        problem: reason why its messages could not be examined, or None.
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
    """Return every topic of a bag, from its index and the first messages of each.

    Args:
        path: a .bag, .db3 or .mcap file, the folder of a rosbag2, or the metadata.yaml in it.
        definitions: folder of .msg files, for types whose definition the bag lacks.

    Raises:
        DataError: it is no bag, or is damaged.
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
    """Return the channels that messages of a type have by themselves, and filled-in joints."""
    if message.name == JOINT_STATE:
        return tuple(name for name, array in _JOINTS.items() if shape.places(steps_of(array)))
    return tuple(name for name in _SELF_EXPLAINED if fits(name, message))


def _fields(message: MessageType, shape: MessageShape) -> tuple[TopicField, ...]:
    """Return all fields of a type of message, with their number of elements in one message."""
    return tuple(
        TopicField(path, what, shape.count(steps_of(path))) for path, what in message.paths.items()
    )


def _last(bag: OpenBag, stored: StoredTopic, known: int) -> int:
    """Return the time of receipt of a topic's last message [ns], searched from the bag's end."""
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
        name_suffix: suffix of the bag's name: empty for the only run, else `#03` or `#name`.
        sha256: hash of the bag's files.
        signals: signals by channel, in the units of `CHANNELS`; a pose as pose_x, pose_y and
            pose_heading (without wrap-around), a twist as twist_command_x, _y and _yaw.
        surface: name of the floor in the bag or the table of runs, else None.
        load: name of the load set-up, likewise.
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
        layout: topics of the channels.

    Raises:
        DataError: the bag is damaged, or does not match the layout; the message names the topic,
            what is there, and the next step.
    """
    with open_bag(path) as bag, ThreadPoolExecutor(1) as beside:
        # hashing releases the interpreter lock, so on two cores it takes no extra time
        sha256 = beside.submit(lambda: bag.files.sha256)
        notes = list(bag.notes)
        signals = _signals(bag, layout, notes)
        spans = run_spans(bag, layout, signals, notes)
        # two channels of one topic repeat its notes
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
    """Return every signal of the layout, from one pass over the bag."""
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
    """Return the numbers of every plan, topic by topic."""
    topics = {}
    for name in dict.fromkeys(w.topic for one in plans for w in one.wanted):
        wanted = [w for one in plans for w in one.wanted if w.topic == name]
        picks = [one.pick for one in wanted]
        topics[name] = TopicStreams(bag.path, name, wanted[0].message, picks, cdr=bag.cdr)
    for batch in bag.batches(tuple(topics)):
        topics[batch.topic].add(batch)
    return [[topics[w.topic].stream(w.pick) for w in one.wanted] for one in plans]
