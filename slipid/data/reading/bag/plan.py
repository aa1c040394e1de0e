"""Plan of reading a bag: for each channel its topics, and the numbers to take from their messages.

The module also lists, for common message types, the fields and units of each channel.
"""

from dataclasses import dataclass
from itertools import islice

from slipid.data.reading.bag.definitions import MessageType
from slipid.data.reading.bag.layout import EFFORT, BagLayout, TopicChannel
from slipid.data.reading.bag.opened import BagTopic, OpenBag
from slipid.data.reading.bag.shape import without_indices
from slipid.data.reading.bag.streams import FieldPick, JointPick, Pick, TransformPick, edges_of
from slipid.data.reading.bag.transforms import STATIC, ChainLink, chain_of
from slipid.data.reading.layout import AT_RIM, CHANNELS, GROUPS, PER_WHEEL
from slipid.data.reading.units import converts, factor
from slipid.support.errors import DataError, bad_data, did_you_mean, first_names

JOINT_STATE = "sensor_msgs/msg/JointState"
_ODOMETRY = "nav_msgs/msg/Odometry"
_JOINT_ARRAYS = {"position": "rad", "velocity": "rad/s", "effort": None}
_KNOWN: dict[str, dict[str, tuple[tuple[str, ...], str]]] = {
    "sensor_msgs/msg/Imu": {"gyro": (("angular_velocity.z",), "rad/s")},
    "sensor_msgs/msg/BatteryState": {
        "bus_voltage": (("voltage",), "V"),
        "current": (("current",), "A"),
    },
    # The packages robotino_msgs and rto_msgs have the same two types, which are therefore listed
    # without a package.
    "MotorReadings": {
        "motor_speed": (("velocities",), "rpm"),
        "wheel_ticks": (("positions",), "tick"),
        "current": (("currents",), "A"),
    },
    "PowerReadings": {"bus_voltage": (("voltage",), "V"), "current": (("current",), "A")},
    # of PX4, whose first wheel is the right one
    "wheel_encoders": {
        "wheel_angle": (("wheel_angle[1]", "wheel_angle[0]"), "rad"),
        "wheel_speed": (("wheel_speed[1]", "wheel_speed[0]"), "rad/s"),
    },
    "battery_status": {"bus_voltage": (("voltage_v",), "V")},
}
"""Paths and unit of known fields, keyed by message type and then by channel. A type is named
without its package if several packages have a copy of it."""
_INSIDE = {
    "pose": ("pose.pose.", "pose.", "transform.", ""),
    "twist": ("twist.twist.", "twist.", ""),
    "twist_command": ("twist.twist.", "twist.", ""),
}
"""Beginnings of the paths of a pose or a twist in messages."""
_AXES = ("x", "y", "z", "w")
_FORMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "pose": (
        ("position.x", "position.y", *(f"orientation.{axis}" for axis in _AXES)),
        ("translation.x", "translation.y", *(f"rotation.{axis}" for axis in _AXES)),
        ("x", "y", "theta"),
        ("x", "y", "heading"),
        ("position[0]", "position[1]", "q[1]", "q[2]", "q[3]", "q[0]"),
    ),
    "twist": (("linear.x", "linear.y", "angular.z"),),
    "twist_command": (("linear.x", "linear.y", "angular.z"),),
}
"""Forms that a pose or a twist has in messages: names of its numbers, in order."""
_FITTING = {
    "gyro": "sensor_msgs/Imu",
    "bus_voltage": "sensor_msgs/BatteryState or robotino_msgs/PowerReadings",
    "wheel_ticks": "robotino_msgs/MotorReadings",
    "pose": "geometry_msgs/PoseStamped, PoseWithCovarianceStamped or TransformStamped, "
    "nav_msgs/Odometry, or tf2_msgs/TFMessage with frame and child",
    "twist": "nav_msgs/Odometry, geometry_msgs/TwistStamped or Twist",
    "twist_command": "geometry_msgs/Twist or TwistStamped",
}
"""Message types that contain each channel, for error messages."""


@dataclass(frozen=True, eq=False)
class ChannelPlan:
    """Topics and numbers from which a channel, a pose or a twist is read.

    Attributes:
        channel: name of the channel, pose or twist in the layout.
        spec: entry of the channel in the layout.
        wanted: name of each topic, with the numbers to take from its messages.
        unit: unit of the numbers; empty for a pose or a twist, whose numbers are in SI units.
        links: chain of transforms that a pose is composed of; empty for other channels and poses.
    """

    channel: str
    spec: TopicChannel
    wanted: tuple[tuple[str, Pick], ...]
    unit: str = ""
    links: tuple[ChainLink, ...] = ()


def plan(bag: OpenBag, layout: BagLayout) -> tuple[ChannelPlan, ...]:
    """Return the plan of every channel of a layout.

    Raises:
        DataError: a topic is missing or empty, its messages do not contain the channel, or their
            type has no definition.
    """
    return tuple(_planned(bag, layout, name, spec) for name, spec in layout.topics.items())


def _planned(bag: OpenBag, layout: BagLayout, channel: str, spec: TopicChannel) -> ChannelPlan:
    """Return the plan of one channel."""
    wanted: list[tuple[str, Pick]] = []
    unit = ""
    for name in spec.topics:
        topic = topic_of(bag, name, channel)
        transforms = is_transforms(topic.message)
        if channel == "pose" and (spec.frame is not None or transforms):
            if not transforms:
                found = f"messages of type {topic.type} with frame and child"
                raise topic.error(found, "tf2_msgs/TFMessage, or no frame and child")
            return _transformed(bag, spec, topic)
        if channel in GROUPS:
            wanted.append((name, _group_pick(channel, spec, topic)))
            continue
        joint_array = topic.type == JOINT_STATE and not any("[" in path for path in spec.fields)
        pick, unit = (
            _joint_pick(channel, spec, topic, layout.joints)
            if joint_array
            else _field_pick(channel, spec, topic)
        )
        wanted.append((name, pick))
    return ChannelPlan(channel, spec, tuple(wanted), unit)


def _transformed(bag: OpenBag, spec: TopicChannel, topic: BagTopic) -> ChannelPlan:
    """Return the plan of a pose that is composed of transforms.

    Constant transforms are taken from the topic with the suffix `_static`, if there is one.
    """
    topics = [topic]
    if (static := bag.topics.get(topic.name + STATIC)) is not None and static.count:
        topics.append(topic_of(bag, static.name, "pose"))
    if spec.frame is None or spec.child is None:
        edges = (edge for shape in islice(topic.shapes(), 1) for edge in edges_of(shape))
        pairs = first_names(f"{edge.parent} -> {edge.child}" for edge in edges)
        expected = f"frame and child, the two frames of the pose ({pairs})"
        raise topic.error("transforms, but the frames are not given", expected)
    links = chain_of(topics[::-1], spec.frame, spec.child)
    wanted = ((one.name, TransformPick(link.edge)) for one in topics for link in links)
    return ChannelPlan("pose", spec, tuple(wanted), links=links)


def topic_of(bag: OpenBag, name: str, channel: str) -> BagTopic:
    """Return a topic from whose messages a channel is read.

    Raises:
        DataError: the topic is missing or empty, or has several types.
    """
    topic = bag.topics.get(name)
    if topic is None:
        found = f"no topic '{name}' for {channel}{did_you_mean(name, bag.topics)}"
        fitting = [one.name for one in bag.topics.values() if _serves(one, channel)]
        also = ", which have such messages" if fitting else ""
        raise bad_data(bag.files.path, found, f"one of {first_names(fitting or bag.topics)}{also}")
    if not topic.count:
        found = f"no message in the topic of {channel}"
        raise topic.error(found, "a topic that was recorded; was its driver on?")
    if " and " in topic.type:
        found = f"messages of several types ({topic.type})"
        raise topic.error(found, "one type; record them as two topics")
    return topic


def _serves(topic: BagTopic, channel: str) -> bool:
    """Return whether the messages of a topic have a definition and contain a channel."""
    try:
        return fits(channel, topic.message)
    except DataError:
        return False


def fits(channel: str, message: MessageType) -> bool:
    """Return whether messages of a type contain a channel for which a layout needs only a topic."""
    if channel == "pose" and is_transforms(message):
        return True
    if channel in GROUPS:
        odometry = channel == "twist_command" and message.name == _ODOMETRY
        return not odometry and bool(_group_paths(channel, message, ""))
    if message.name == JOINT_STATE:
        return channel in PER_WHEEL and channel != "wheel_ticks"
    return channel in _known(message)


def is_transforms(message: MessageType) -> bool:
    """Return whether messages of a type contain transforms between frames, like those of `/tf`."""
    return "transforms.transform.translation.x" in message.paths


def _known(message: MessageType) -> dict[str, tuple[tuple[str, ...], str]]:
    """Return paths and unit of the known fields of a type, keyed by channel."""
    return _KNOWN.get(message.name) or _KNOWN.get(message.name.rsplit("/", 1)[-1], {})


def _group_paths(channel: str, message: MessageType, prefix: str) -> tuple[str, ...]:
    """Return the paths of the numbers of a pose or a twist in a field; empty if there is none.

    `prefix` is the path of the field followed by a dot, or empty for the whole message.
    """
    for inner in _INSIDE[channel]:
        for names in _FORMS[channel]:
            paths = tuple(f"{prefix}{inner}{name}" for name in names)
            if all(without_indices(path) in message.paths for path in paths):
                return paths
    return ()


def _group_pick(channel: str, spec: TopicChannel, topic: BagTopic) -> Pick:
    """Return the pick of a pose (x, y, quaternion or heading) or a twist (x, y, yaw rate).

    Raises:
        DataError: the messages contain no pose or twist.
    """
    message = topic.message
    if channel == "twist_command" and message.name == _ODOMETRY:
        found = "nav_msgs/Odometry, which contains the measured twist"
        raise topic.error(found, "the commanded twist")
    field = spec.fields[0] if spec.fields else ""
    paths = _group_paths(channel, message, f"{field}." if field else "")
    if not paths:
        where = f" in field '{field}'" if field else ""
        expected = (
            f"{_FITTING[channel]}; or field = the field that contains it ({_listed(message)})"
        )
        raise topic.error(f"no {channel}{where} of type {message.name}", expected)
    return FieldPick(paths)


def _field_pick(channel: str, spec: TopicChannel, topic: BagTopic) -> tuple[Pick, str]:
    """Return the pick of a channel by paths of fields, and the unit of the numbers.

    Raises:
        DataError: the type does not have the field, the field has no numbers, or the layout must
            give a field or a unit.
    """
    message = topic.message
    known = _known(message)
    paths = spec.fields or known.get(channel, ((), ""))[0]
    if not paths and message.name.startswith("std_msgs/") and "data" in message.paths:
        paths = ("data",)
    if not paths:
        fitting = f"{_FITTING[channel]}, or " if channel in _FITTING else ""
        expected = f"{fitting}field = one of its numbers ({_listed(message)}), with its unit"
        found = f"{message.name}, whose field for {channel} is not known"
        raise topic.error(found, expected)
    for path in paths:
        plain = without_indices(path)
        if plain not in message.paths:
            found = f"no field '{path}' in {message.name}{did_you_mean(plain, message.paths)}"
            raise topic.error(found, _listed(message))
        if message.paths[plain].startswith("text"):
            found = f"field '{path}' of {message.name} is a string"
            raise topic.error(found, "a field with numbers")
    plain = paths[0].split("[")[0]
    units = (unit for inside, unit in known.values() if inside[0].split("[")[0] == plain)
    unit = spec.unit or next(units, None)
    if unit is None:
        expected = f'unit = the unit of its numbers, such as "{CHANNELS[channel]}"'
        raise topic.error(f"{channel} without a unit", expected)
    _check_unit(channel, paths[0], unit, topic)
    return FieldPick(paths), unit


def _joint_pick(
    channel: str, spec: TopicChannel, topic: BagTopic, joints: tuple[str, ...]
) -> tuple[Pick, str]:
    """Return the pick of a channel from an array of JointState messages, and the numbers' unit.

    If the layout gives no field, the array that most likely contains the channel is used.
    """
    likely = "velocity" if "_speed" in channel else "effort"
    array = "position" if channel.endswith("_angle") else likely
    array = spec.fields[0] if spec.fields else array
    if array not in _JOINT_ARRAYS or len(spec.fields) > 1:
        found = f"no array '{array}' in {JOINT_STATE}{did_you_mean(array, _JOINT_ARRAYS)}"
        raise topic.error(found, f"one of {', '.join(_JOINT_ARRAYS)}")
    unit = spec.unit or _JOINT_ARRAYS[array]
    if unit is None:
        found = "effort without a unit, which differs between drivers"
        raise topic.error(found, f"unit = {EFFORT}")
    _check_unit(channel, array, unit, topic)
    if not joints:
        names = (name for shape in islice(topic.shapes(), 10) for name in shape.texts("name"))
        there = first_names(dict.fromkeys(names))
        expected = f"joints = their names, in the order of the drives (the messages have: {there})"
        raise topic.error("no joints are named", expected)
    return JointPick(joints, array), unit


def _check_unit(channel: str, path: str, unit: str, topic: BagTopic) -> None:
    """Raise `DataError` if the unit of a field cannot be converted to that of the channel."""
    if channel in AT_RIM and converts(unit, AT_RIM[channel]):
        return
    try:
        factor(unit, CHANNELS[channel])
    except ValueError as error:
        others = {
            name: wanted for name, wanted in CHANNELS.items() if name not in ("time", channel)
        }
        fitting = [name for name, wanted in others.items() if converts(unit, wanted)]
        other = f"; numbers in {unit} are possible for {' or '.join(fitting)}" if fitting else ""
        raise topic.error(f"field '{path}': {error}", f"a field of {channel}{other}") from error


def _listed(message: MessageType) -> str:
    """Return the paths of the numbers in a message type, for error messages."""
    return first_names(path for path, what in message.paths.items() if not what.startswith("text"))
