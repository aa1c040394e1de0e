"""Topics and runs of a bag.

`topics_of` describes every topic by its first messages, without reading the whole bag. `read_bag`
returns the runs of a bag, each with all channels of a layout at the times of their sensors.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from slipid.data.reading.bag.layout import BagLayout
from slipid.data.reading.bag.opened import BagTopic, OpenBag, open_bag
from slipid.data.reading.bag.plan import JOINT_STATE, fits, plan
from slipid.data.reading.bag.runs import RunSpan, run_spans
from slipid.data.reading.bag.signals import channel_signal, check_clocks, group_signals
from slipid.data.reading.bag.streams import Pick, collected, edges_of
from slipid.data.reading.layout import GROUPS, PER_WHEEL
from slipid.data.reading.signal import Identity, RawRun, Signal
from slipid.support.errors import DataError

_FIRST_MESSAGES = 10
"""Number of first messages of a topic from which it is described."""
_SELF_EXPLAINED = (
    "pose",
    "twist_command",
    "gyro",
    "bus_voltage",
    "wheel_ticks",
    "wheel_angle",
    "wheel_speed",
    "motor_speed",
    "current",
)
"""Channels, or groups of channels, that common message types contain in known fields and units."""
_JOINTS = {"wheel_angle": "position", "wheel_speed": "velocity"}
"""Array of a JointState message that contains each channel."""


@dataclass(frozen=True)
class TopicField:
    """Description of a number, string or array in the messages of a topic.

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
        rate: median rate of the first messages [Hz]; None if there are too few messages.
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
    rate: float | None = None
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
    with open_bag(path, definitions) as bag:
        return tuple(_described(topic) for topic in bag.topics.values())


def _described(topic: BagTopic) -> Topic:
    """Return the description of one topic."""
    first = list(islice(topic.messages(), _FIRST_MESSAGES)) if topic.count else []
    known = Topic(topic.name, topic.type, topic.count)
    if not first:
        return known
    step = float(np.median(np.diff([received for received, _ in first]))) if first[1:] else 0.0
    known = replace(known, rate=1e9 / step if step > 0 else None)
    try:
        message = topic.message
        shapes = [topic.shape(data, k) for k, (_, data) in enumerate(first, start=1)]
    except DataError as error:
        return replace(known, problem=str(error))
    if message.name == JOINT_STATE:
        serves = [name for name, array in _JOINTS.items() if shapes[0].places(array)]
        joints = [name for shape in shapes for name in shape.texts("name")]
    else:
        serves, joints = [name for name in _SELF_EXPLAINED if fits(name, message)], []
    frames = (f"{edge.parent} -> {edge.child}" for shape in shapes for edge in edges_of(shape))
    return replace(
        known,
        fields=tuple(
            TopicField(path, what, shapes[0].count(path)) for path, what in message.paths.items()
        ),
        joints=tuple(dict.fromkeys(joints)),
        frames=tuple(dict.fromkeys(frames)),
        serves=tuple(serves),
    )


def read_bag(known: Identity, layout: BagLayout) -> list[RawRun]:
    """Return every run in a bag.

    A pose becomes the channels pose_x, pose_y and pose_heading (without wrap-around); a twist
    becomes twist_command_x, twist_command_y and twist_command_yaw.

    Args:
        known: name of the bag, its path, and the surface and load set-up that are used if the bag
            and the table of its runs name none. The path is that of a .bag, .db3 or .mcap file, of
            the folder of a rosbag2, or of the metadata.yaml in it.
        layout: layout of the bag.

    Raises:
        DataError: the bag is damaged, or does not match the layout; the message names the topic,
            what is there, and the next step.
    """
    with open_bag(known.path, layout.definitions) as bag, ThreadPoolExecutor(1) as beside:
        # Hashing releases the interpreter lock, so on two cores it runs while the bag is read.
        sha256 = beside.submit(lambda: bag.files.sha256)
        notes = list(bag.notes)
        signals = _signals(bag, layout, notes)
        spans = run_spans(bag, layout, signals, notes)
        known = replace(known, sha256=sha256.result())
        # Two channels that are read from one topic give the same notes, so repetitions are removed.
        return [_run(known, span, signals, tuple(dict.fromkeys(notes))) for span in spans]


def _run(
    known: Identity, span: RunSpan, signals: dict[str, Signal], notes: tuple[str, ...]
) -> RawRun:
    """Return the part of all signals that lies in one run."""
    parts, without = {}, []
    for name, signal in signals.items():
        first, end = np.searchsorted(signal.time, (span.start, span.end)).tolist()
        if end > first:
            parts[name] = signal.part(slice(first, end))
        else:
            without.append(name)
    if without:
        notes = (*notes, f"no sample of {', '.join(without)} in this run")
    identity = replace(
        known,
        name=known.name + span.suffix,
        surface=span.surface or known.surface,
        load=span.load or known.load,
    )
    return RawRun(identity, parts, notes)


def _signals(bag: OpenBag, layout: BagLayout, notes: list[str]) -> dict[str, Signal]:
    """Return the signals of all channels in the layout, from one pass over the bag."""
    plans = plan(bag, layout)
    picks: dict[str, list[Pick]] = {}
    for topic, pick in (wanted for one in plans for wanted in one.wanted):
        picks.setdefault(topic, []).append(pick)
    streams = collected(bag, picks, layout.stamp)
    signals: dict[str, Signal] = {}
    for one in plans:
        own = [streams[pick] for _, pick in one.wanted]
        if one.channel in GROUPS:
            signals |= group_signals(one, own, layout, notes)
        else:
            signals[one.channel] = channel_signal(one, own, layout, notes)
    check_clocks(list(streams.values()), layout, notes)
    counts = {n: s.values.shape[1] for n, s in signals.items() if n in PER_WHEEL}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{count} in {name}" for name, count in counts.items())
        raise DataError(
            f"{bag.files.path}: channels have different numbers of wheels: {listed}; expected the "
            'same number in all; select elements by index (field = ["currents[0]", "currents[1]"])'
        )
    return signals
