"""Plan of reading a bag: for each channel its topics, and the numbers to take from their messages.

The module also knows, for common message types, the fields and units that belong to each channel.
"""

from dataclasses import dataclass
from itertools import islice

from slipid.data.reading.bag.definitions import MessageType, definition_of
from slipid.data.reading.bag.layout import EFFORT, GROUPS, BagLayout, TopicChannel
from slipid.data.reading.bag.opened import OpenBag, StoredTopic
from slipid.data.reading.bag.shape import (
    FieldPick,
    JointPick,
    MessageShape,
    Pick,
    TransformPick,
    edges_of,
    shape_of,
    steps_of,
)
from slipid.data.reading.bag.streams import topic_error
from slipid.data.reading.bag.transforms import STATIC, ChainLink, chain_of
from slipid.data.reading.layout import CHANNELS, PER_WHEEL
from slipid.data.reading.units import converts, factor
from slipid.support.errors import DataError, bad_data, did_you_mean, first_names

JOINT_STATE = "sensor_msgs/msg/JointState"
_ODOMETRY = "nav_msgs/msg/Odometry"
_JOINT_ARRAYS = {"position": "rad", "velocity": "rad/s", "effort": None}


@dataclass(frozen=True)
class _KnownField:
    """Path of a field of a known message type, and the unit of its numbers."""

    path: str
    unit: str


# Known fields by channel, by name of the message type. The name has no package if several packages
# have a copy of the type.
_KNOWN: dict[str, dict[str, _KnownField]] = {
    "sensor_msgs/msg/Imu": {"gyro": _KnownField("angular_velocity.z", "rad/s")},
    "sensor_msgs/msg/BatteryState": {
        "bus_voltage": _KnownField("voltage", "V"),
        "current": _KnownField("current", "A"),
    },
    # These types are in the packages robotino_msgs and rto_msgs.
    "MotorReadings": {
        "motor_speed": _KnownField("velocities", "rpm"),
        "wheel_ticks": _KnownField("positions", "tick"),
        "current": _KnownField("currents", "A"),
    },
    "PowerReadings": {
        "bus_voltage": _KnownField("voltage", "V"),
        "current": _KnownField("current", "A"),
    },
}
_POSES = ("pose.pose", "pose", "transform", "")
_TWISTS = ("twist.twist", "twist", "")
_FITTING = {
    "gyro": "sensor_msgs/Imu",
    "bus_voltage": "sensor_msgs/BatteryState or robotino_msgs/PowerReadings",
    "wheel_ticks": "robotino_msgs/MotorReadings",
    "pose": "geometry_msgs/PoseStamped, PoseWithCovarianceStamped or TransformStamped, "
    "nav_msgs/Odometry, or tf2_msgs/TFMessage with frame and child",
    "twist_command": "geometry_msgs/Twist or TwistStamped",
}


class UnsuitableType(ValueError):
    """Error about a message type that does not fit a channel.

    Attributes:
        found: text about the type or field in the bag.
        expected: text about types or settings that would fit.
    """

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(found, expected)
        self.found, self.expected = found, expected


@dataclass(frozen=True, eq=False)
class PickedNumbers:
    """Numbers to take from a message for a channel, and their unit.

    The unit is empty for poses and twists, whose numbers are in SI units.
    """

    pick: Pick
    unit: str


def fits(channel: str, message: MessageType) -> bool:
    """Return whether messages of a type contain a channel, with no setting needed but the topic."""
    if channel == "pose":
        return is_transforms(message) or bool(_group_paths(channel, message, ""))
    if channel == "twist_command":
        return message.name != _ODOMETRY and bool(_group_paths(channel, message, ""))
    if message.name == JOINT_STATE:
        return channel in PER_WHEEL and channel != "wheel_ticks"
    return channel in _known(message)


def is_transforms(message: MessageType) -> bool:
    """Return whether messages of a type contain transforms between frames, like those of `/tf`."""
    return "transforms.transform.translation.x" in message.paths


def group_meaning(channel: str, spec: TopicChannel, message: MessageType) -> PickedNumbers:
    """Return the numbers of a pose (x, y, quaternion or heading) or a twist (x, y, yaw rate).

    Args:
        channel: `pose` or `twist_command`.
        spec: position of the channel in the layout.
        message: type of the topic's messages.

    Raises:
        UnsuitableType: the type contains no pose or twist.
    """
    if channel == "twist_command" and message.name == _ODOMETRY:
        raise UnsuitableType(
            "nav_msgs/Odometry, which holds the measured twist", "the commanded twist"
        )
    prefix = spec.fields[0] if spec.fields else ""
    paths = _group_paths(channel, message, prefix)
    if not paths:
        where = f" in field '{prefix}'" if prefix else ""
        expected = f"{_FITTING[channel]}; or field = the field that holds it ({_listed(message)})"
        raise UnsuitableType(f"no {channel}{where} of type {message.name}", expected)
    return PickedNumbers(FieldPick(paths), "")


def channel_meaning(
    channel: str, spec: TopicChannel, message: MessageType, joints: tuple[str, ...]
) -> PickedNumbers:
    """Return the numbers of a channel that is not a pose or a twist.

    Args:
        channel: name of the channel.
        spec: position of the channel in the layout.
        message: type of the topic's messages.
        joints: names of the drives' joints, for messages of the type JointState.

    Raises:
        UnsuitableType: the type does not fit, or a field or a unit must be given in the layout.
    """
    if message.name == JOINT_STATE and not any("[" in path for path in spec.fields):
        return _joint_meaning(channel, spec, joints)
    known = _known(message)
    paths = spec.fields or ((known[channel].path,) if channel in known else ())
    if not paths and message.name.startswith("std_msgs/") and "data" in message.paths:
        paths = ("data",)
    if not paths:
        fitting = f"{_FITTING[channel]}, or " if channel in _FITTING else ""
        expected = f"{fitting}field = one of its numbers ({_listed(message)}), with its unit"
        raise UnsuitableType(
            f"{message.name}, in which the field of {channel} is unknown", expected
        )
    for path in paths:
        _check_number(path, message)
    units = (one.unit for one in known.values() if one.path == paths[0].split("[")[0])
    unit = spec.unit or next(units, None)
    if unit is None:
        expected = f'unit = the unit of its numbers, such as "{CHANNELS[channel]}"'
        raise UnsuitableType(f"{channel} without a unit", expected)
    _check_unit(channel, paths[0], unit)
    return PickedNumbers(FieldPick(tuple(paths)), unit)


def _joint_meaning(channel: str, spec: TopicChannel, joints: tuple[str, ...]) -> PickedNumbers:
    """Return the numbers of a channel that comes from an array of JointState messages."""
    array = spec.fields[0] if spec.fields else _array_of(channel)
    if array not in _JOINT_ARRAYS or len(spec.fields) > 1:
        found = f"no array '{array}' in {JOINT_STATE}{did_you_mean(array, _JOINT_ARRAYS)}"
        raise UnsuitableType(found, f"one of {', '.join(_JOINT_ARRAYS)}")
    unit = spec.unit or _JOINT_ARRAYS[array]
    if unit is None:
        raise UnsuitableType(
            "effort without a unit, and drivers disagree on it", f"unit = {EFFORT}"
        )
    _check_unit(channel, array, unit)
    if not joints:
        raise UnsuitableType(
            "no joints are named", "joints = their names, in the order of the drives"
        )
    return PickedNumbers(JointPick(joints, array), unit)


def _array_of(channel: str) -> str:
    """Return the array of JointState that most likely contains a channel."""
    if channel.endswith("_angle"):
        return "position"
    return "velocity" if "_speed" in channel else "effort"


def _check_unit(channel: str, path: str, unit: str) -> None:
    """Raise `UnsuitableType` if a unit does not fit the channel."""
    try:
        factor(unit, CHANNELS[channel])
    except ValueError as error:
        fitting = [
            name
            for name, wanted in CHANNELS.items()
            if name not in ("time", channel) and converts(unit, wanted)
        ]
        other = f"; numbers in {unit} belong to {' or '.join(fitting)}" if fitting else ""
        raise UnsuitableType(f"field '{path}': {error}", f"a field of {channel}{other}") from error


def _check_number(path: str, message: MessageType) -> None:
    """Raise `UnsuitableType` if a path does not lead to a number."""
    plain = ".".join(step.name for step in steps_of(path))
    found = message.paths.get(plain)
    if found is None:
        known = list(message.paths)
        raise UnsuitableType(
            f"no field '{path}' in {message.name}{did_you_mean(plain, known)}", _listed(message)
        )
    if found.startswith("text"):
        raise UnsuitableType(f"field '{path}' of {message.name} is a text", "a field with numbers")


def _known(message: MessageType) -> dict[str, _KnownField]:
    """Return the known fields of a type, by channel; empty for an unknown type."""
    return _KNOWN.get(message.name) or _KNOWN.get(message.name.rsplit("/", 1)[-1], {})


def _group_paths(channel: str, message: MessageType, prefix: str) -> tuple[str, ...]:
    """Return the paths of the numbers of a pose or a twist in a field; empty if there is none.

    `prefix` is the path of the field, or empty for the whole message.
    """
    for inner in _TWISTS if channel == "twist_command" else _POSES:
        at = ".".join(part for part in (prefix, inner) if part)
        dot = f"{at}." if at else ""
        for names in _forms(channel):
            paths = tuple(dot + name for name in names)
            plain = (".".join(step.name for step in steps_of(path)) for path in paths)
            if all(path in message.paths for path in plain):
                return paths
    return ()


def _forms(channel: str) -> tuple[tuple[str, ...], ...]:
    """Return the forms that a pose or a twist has in messages: names of its numbers, in order."""
    if channel == "twist_command":
        return (("linear.x", "linear.y", "angular.z"),)
    axes = ("x", "y", "z", "w")
    return (
        ("position.x", "position.y", *(f"orientation.{axis}" for axis in axes)),
        ("translation.x", "translation.y", *(f"rotation.{axis}" for axis in axes)),
        ("x", "y", "theta"),
    )


def _listed(message: MessageType) -> str:
    """Return the paths of the numbers in a type, for error messages."""
    return first_names(
        [path for path, what in message.paths.items() if not what.startswith("text")]
    )


@dataclass(frozen=True, eq=False)
class TopicPick:
    """Numbers to take from the messages of one topic."""

    topic: str
    message: MessageType
    pick: Pick


@dataclass(frozen=True, eq=False)
class ChannelPlan:
    """Source of the numbers of a channel, or of a pose or a twist.

    Attributes:
        channel: name of the channel, pose or twist in the layout.
        spec: position of the channel in the layout.
        unit: unit of the numbers; empty for a pose or a twist, whose numbers are in SI units.
        wanted: numbers to take from the messages of each topic.
        links: chain of transforms that a pose is composed of; empty for other channels and poses.
    """

    channel: str
    spec: TopicChannel
    unit: str
    wanted: tuple[TopicPick, ...]
    links: tuple[ChainLink, ...] = ()


def plan(bag: OpenBag, layout: BagLayout) -> tuple[ChannelPlan, ...]:
    """Return the plan of every channel of a layout.

    Raises:
        DataError: a topic is missing or empty, its messages do not fit the channel, or their type
            has no definition.
    """
    return tuple(_planned(bag, layout, name, spec) for name, spec in layout.topics.items())


def _planned(bag: OpenBag, layout: BagLayout, channel: str, spec: TopicChannel) -> ChannelPlan:
    """Return the plan of one channel."""
    wanted, unit = [], ""
    for name in spec.topics:
        message = message_of(bag, layout, name, channel)
        transforms = is_transforms(message)
        if channel == "pose" and (spec.frame is not None or transforms):
            if not transforms:
                found = f"messages of type {message.name} with frame and child"
                raise topic_error(bag.path, name, found, "tf2_msgs/TFMessage, or neither")
            return _transformed(bag, layout, spec, name, message)
        try:
            if channel in GROUPS:
                meaning = group_meaning(channel, spec, message)
            else:
                meaning = channel_meaning(channel, spec, message, layout.joints)
        except UnsuitableType as error:
            expected = error.expected
            if "joints are named" in error.found:
                shapes = first_shapes(bag, name, message, 10)
                there = [joint for one in shapes for joint in one.texts(steps_of("name"))]
                expected += f" (there are: {first_names(dict.fromkeys(there))})"
            raise topic_error(bag.path, name, error.found, expected) from None
        unit = meaning.unit
        wanted.append(TopicPick(name, message, meaning.pick))
    return ChannelPlan(channel, spec, unit, tuple(wanted))


def _transformed(
    bag: OpenBag, layout: BagLayout, spec: TopicChannel, topic: str, message: MessageType
) -> ChannelPlan:
    """Return the plan of a pose that is composed of transforms.

    Constant transforms are taken from the topic with the suffix `_static`, if there is one.
    """
    messages = {topic: message}
    static = topic + STATIC
    if static in bag.topics and bag.topics[static].count:
        messages[static] = message_of(bag, layout, static, "pose")
    if spec.frame is None or spec.child is None:
        shape = next(iter(first_shapes(bag, topic, message, 1)))
        pairs = first_names(f"{edge.parent} -> {edge.child}" for edge in edges_of(shape))
        expected = f"frame and child, the frames that the pose is between ({pairs})"
        raise topic_error(bag.path, topic, "transforms, without saying which", expected)
    links = chain_of(bag, messages, spec.frame, spec.child)
    wanted = (
        TopicPick(name, messages[name], TransformPick(link.edge))
        for name in messages
        for link in links
    )
    return ChannelPlan("pose", spec, "", tuple(wanted), links)


def message_of(bag: OpenBag, layout: BagLayout, name: str, channel: str) -> MessageType:
    """Return the type of a topic's messages.

    Raises:
        DataError: the topic is missing or empty, has several types, or has no definition.
    """
    topic = bag.topics.get(name)
    if topic is None:
        found = f"no topic '{name}' for {channel}{did_you_mean(name, bag.topics)}"
        raise bad_data(bag.path, found, _one_of(bag, layout, channel))
    if not topic.count:
        found = f"no message in the topic, which holds {channel}"
        raise topic_error(bag.path, name, found, "a topic that was recorded; was its driver on?")
    if " and " in topic.type:
        found = f"messages of several types ({topic.type})"
        raise topic_error(bag.path, name, found, "one type; record them under two names")
    return definition_of(bag.path, name, topic.type, topic.carried, layout.definitions)


def _one_of(bag: OpenBag, layout: BagLayout, channel: str) -> str:
    """Return a text for error messages that lists the topics that fit a channel, or all topics."""

    def serves(topic: StoredTopic) -> bool:
        try:
            where = (bag.path, topic.name, topic.type, topic.carried, layout.definitions)
            return fits(channel, definition_of(*where))
        except DataError:
            return False

    fitting = [topic.name for topic in bag.topics.values() if serves(topic)]
    if fitting:
        return f"one of {first_names(fitting)}, which hold such messages"
    return f"one of {first_names(bag.topics)}"


def first_shapes(
    bag: OpenBag, topic: str, message: MessageType, count: int
) -> tuple[MessageShape, ...]:
    """Return the shapes of the first `count` messages of a topic."""
    raws = islice(bag.messages((topic,)), count)
    try:
        return tuple(shape_of(raw.data, message, cdr=bag.cdr) for raw in raws)
    except ValueError as error:
        expected = "messages as their definition says; is the bag damaged?"
        raise topic_error(bag.path, topic, f"no {message.name}: {error}", expected) from error
