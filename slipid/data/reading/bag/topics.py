"""What is in a bag: its topics, with what their first messages tell, without reading them all."""

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from slipid.data.reading.bag.messages.definitions import Message, definition_of
from slipid.data.reading.bag.messages.meanings import JOINT_STATE, fits
from slipid.data.reading.bag.messages.picks import edges_of
from slipid.data.reading.bag.messages.shape import MessageShape, shape_of, steps_of
from slipid.data.reading.bag.storage.opened import OpenBag, StoredTopic, open_bag
from slipid.support.errors import DataError

_LOOKED_AT = 10
"""First messages of a topic that are looked into."""
_SECOND = 10**9
_TOLD = ("pose", "twist_command", "gyro", "bus_voltage", "wheel_ticks", "motor_speed", "current")
_JOINTS = {"wheel_angle": "position", "wheel_speed": "velocity"}


@dataclass(frozen=True)
class TopicField:
    """A number, text or array in the messages of a topic.

    Attributes:
        path: as a layout names it, such as `motors.current`.
        type: such as `float64`, `float64[]`, `text`.
        count: how many the first message has of it.
    """

    path: str
    type: str
    count: int


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: of the topic.
        type: of its messages, as `sensor_msgs/msg/JointState`.
        count: how many messages it has.
        first: when the first was received [s], None where there is none.
        last: when the last was received [s].
        fields: what its messages hold; empty where there are none, or `problem` says why.
        joints: names in the first messages of a JointState.
        frames: parent and child of each transform in the first messages, as `map -> base_link`.
        serves: channels, or groups of them, that a layout may take from it without a field or a
            unit. What the effort of joints is no message tells.
        problem: why its messages could not be looked into, or None.
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
    """Every topic of a bag, from its index and the first messages of each.

    Args:
        path: a .bag, .db3 or .mcap file, the folder of a rosbag2, or the metadata.yaml in it.
        definitions: folder of .msg files, for types whose definition the bag lacks.

    Raises:
        DataError: it is no bag, or is damaged.
    """
    with open_bag(path) as bag:
        return tuple(_looked_into(bag, stored, definitions) for stored in bag.topics.values())


def _looked_into(bag: OpenBag, stored: StoredTopic, definitions: Path | None) -> Topic:
    """What is known of one topic."""
    raws = list(islice(bag.messages((stored.name,)), _LOOKED_AT)) if stored.count else []
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


def _served(message: Message, shape: MessageShape) -> tuple[str, ...]:
    """Channels that messages of a type tell of themselves, of joints those that are filled in."""
    if message.name == JOINT_STATE:
        return tuple(name for name, array in _JOINTS.items() if shape.places(steps_of(array)))
    return tuple(name for name in _TOLD if fits(name, message))


def _fields(message: Message, shape: MessageShape) -> tuple[TopicField, ...]:
    """Everything in a type of message, with how much of it one message has."""
    return tuple(
        TopicField(path, what, shape.count(steps_of(path))) for path, what in message.paths.items()
    )


def _last(bag: OpenBag, stored: StoredTopic, known: int) -> int:
    """When the last message of a topic was received [ns], looked for from the end of the bag."""
    back = _SECOND
    while (start := bag.end - back) > known:
        received = [raw.received for raw in bag.messages((stored.name,), start)]
        if received:
            return max(received)
        back *= 8
    return max((raw.received for raw in bag.messages((stored.name,), known)), default=known)
