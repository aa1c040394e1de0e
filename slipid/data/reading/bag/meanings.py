"""What the messages of known types mean for a channel: which fields, in which unit."""

from collections.abc import Iterable
from dataclasses import dataclass

from slipid.data.reading.bag.definitions import Message
from slipid.data.reading.bag.layout import EFFORT, TopicChannel
from slipid.data.reading.bag.shape import FieldPick, JointPick, Pick, steps_of
from slipid.data.reading.layout import CHANNELS, PER_WHEEL
from slipid.data.reading.units import converts, factor
from slipid.support.errors import did_you_mean

JOINT_STATE = "sensor_msgs/msg/JointState"
_ODOMETRY = "nav_msgs/msg/Odometry"
_JOINT_ARRAYS = {"position": "rad", "velocity": "rad/s", "effort": None}


@dataclass(frozen=True)
class _KnownField:
    """A field whose meaning is known: its path, and the unit of its numbers."""

    path: str
    unit: str


# By the name of the type; without a package where several packages have their own copy of it.
_KNOWN: dict[str, dict[str, _KnownField]] = {
    "sensor_msgs/msg/Imu": {"gyro": _KnownField("angular_velocity.z", "rad/s")},
    "sensor_msgs/msg/BatteryState": {
        "bus_voltage": _KnownField("voltage", "V"),
        "current": _KnownField("current", "A"),
    },
    # the packages robotino_msgs and rto_msgs
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


class Unfit(ValueError):
    """A message type does not serve a channel: what was found, and what was expected."""

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(found, expected)
        self.found, self.expected = found, expected


@dataclass(frozen=True, eq=False)
class Meaning:
    """Which numbers of a message make a channel, in which unit; SI for poses and twists."""

    pick: Pick
    unit: str


def fits(channel: str, message: Message) -> bool:
    """Whether messages of a type serve a channel without more said than their topic."""
    if channel == "pose":
        return is_transforms(message) or bool(_group_paths(channel, message, ""))
    if channel == "twist_command":
        return message.name != _ODOMETRY and bool(_group_paths(channel, message, ""))
    if message.name == JOINT_STATE:
        return channel in PER_WHEEL and channel != "wheel_ticks"
    return channel in _known(message)


def is_transforms(message: Message) -> bool:
    """Whether messages hold transforms between frames, as those of `/tf` do."""
    return "transforms.transform.translation.x" in message.paths


def group_meaning(channel: str, spec: TopicChannel, message: Message) -> Meaning:
    """Of a pose (x, y, quaternion; or x, y, heading) or a twist (x, y, yaw rate).

    Raises:
        Unfit: the type holds none.
    """
    if channel == "twist_command" and message.name == _ODOMETRY:
        raise Unfit("nav_msgs/Odometry, which holds the measured twist", "the commanded twist")
    prefix = spec.fields[0] if spec.fields else ""
    paths = _group_paths(channel, message, prefix)
    if not paths:
        where = f" in field '{prefix}'" if prefix else ""
        expected = f"{_FITTING[channel]}; or field = the field that holds it ({_listed(message)})"
        raise Unfit(f"no {channel}{where} of type {message.name}", expected)
    return Meaning(FieldPick(paths), "")


def channel_meaning(
    channel: str, spec: TopicChannel, message: Message, joints: tuple[str, ...]
) -> Meaning:
    """Of any other channel.

    Raises:
        Unfit: the type does not serve it, or a field or a unit must be said.
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
        raise Unfit(f"{message.name}, which does not tell where in it {channel} is", expected)
    for path in paths:
        _check_number(path, message)
    said = [one.unit for one in known.values() if one.path == paths[0].split("[")[0]]
    unit = spec.unit or (said[0] if said else None)
    if unit is None:
        expected = f'unit = the unit of its numbers, such as "{CHANNELS[channel]}"'
        raise Unfit(f"{channel} without a unit", expected)
    _check_unit(channel, paths[0], unit)
    return Meaning(FieldPick(tuple(paths)), unit)


def _joint_meaning(channel: str, spec: TopicChannel, joints: tuple[str, ...]) -> Meaning:
    """Of a channel that is an array of JointState."""
    array = spec.fields[0] if spec.fields else _array_of(channel)
    if array not in _JOINT_ARRAYS or len(spec.fields) > 1:
        found = f"no array '{array}' in {JOINT_STATE}{did_you_mean(array, _JOINT_ARRAYS)}"
        raise Unfit(found, f"one of {', '.join(_JOINT_ARRAYS)}")
    unit = spec.unit or _JOINT_ARRAYS[array]
    if unit is None:
        raise Unfit("effort without a unit, and drivers disagree on it", f"unit = {EFFORT}")
    _check_unit(channel, array, unit)
    if not joints:
        raise Unfit("no joints are named", "joints = their names, in the order of the drives")
    return Meaning(JointPick(joints, array), unit)


def _array_of(channel: str) -> str:
    """Array of JointState that a channel is likely to be."""
    if channel.endswith("_angle"):
        return "position"
    return "velocity" if "_speed" in channel else "effort"


def _check_unit(channel: str, path: str, unit: str) -> None:
    try:
        factor(unit, CHANNELS[channel])
    except ValueError as error:
        fitting = [
            name
            for name, wanted in CHANNELS.items()
            if name not in ("time", channel) and converts(unit, wanted)
        ]
        other = f"; numbers in {unit} belong to {' or '.join(fitting)}" if fitting else ""
        raise Unfit(f"field '{path}': {error}", f"a field of {channel}{other}") from error


def _check_number(path: str, message: Message) -> None:
    plain = ".".join(step.name for step in steps_of(path))
    found = message.paths.get(plain)
    if found is None:
        known = list(message.paths)
        raise Unfit(
            f"no field '{path}' in {message.name}{did_you_mean(plain, known)}", _listed(message)
        )
    if found.startswith("text"):
        raise Unfit(f"field '{path}' of {message.name} is a text", "a field with numbers")


def _known(message: Message) -> dict[str, _KnownField]:
    """What is known of a type: by its whole name, else by its name without the package."""
    return _KNOWN.get(message.name) or _KNOWN.get(message.name.rsplit("/", 1)[-1], {})


def _group_paths(channel: str, message: Message, prefix: str) -> tuple[str, ...]:
    """Paths of the numbers of a pose or a twist at or below a field, none where there is none."""
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
    """How messages spell a pose or a twist."""
    if channel == "twist_command":
        return (("linear.x", "linear.y", "angular.z"),)
    axes = ("x", "y", "z", "w")
    return (
        ("position.x", "position.y", *(f"orientation.{axis}" for axis in axes)),
        ("translation.x", "translation.y", *(f"rotation.{axis}" for axis in axes)),
        ("x", "y", "theta"),
    )


def _listed(message: Message) -> str:
    return listed([path for path, what in message.paths.items() if not what.startswith("text")])


def listed(names: Iterable[str]) -> str:
    """Names in a message, the first dozen of them."""
    every = list(names)
    return ", ".join(every[:12] + ["..."] * (len(every) > 12)) or "none"
