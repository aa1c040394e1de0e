"""Fields and units of known message types for each channel."""

from collections.abc import Iterable
from dataclasses import dataclass

from slipid.data.reading.bag.definitions import MessageType
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
    """Path of a known field, and the unit of its numbers."""

    path: str
    unit: str


# Fields by the name of the type; without a package where several packages have a copy of it.
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


class UnsuitableType(ValueError):
    """Error about a message type that does not fit a channel.

    Attributes:
        found: type or field in the bag.
        expected: types or settings that would fit.
    """

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(found, expected)
        self.found, self.expected = found, expected


@dataclass(frozen=True, eq=False)
class PickedNumbers:
    """Numbers of a message that form a channel, with their unit; SI for poses and twists."""

    pick: Pick
    unit: str


def fits(channel: str, message: MessageType) -> bool:
    """Return whether messages of a type form a channel without any setting but their topic."""
    if channel == "pose":
        return is_transforms(message) or bool(_group_paths(channel, message, ""))
    if channel == "twist_command":
        return message.name != _ODOMETRY and bool(_group_paths(channel, message, ""))
    if message.name == JOINT_STATE:
        return channel in PER_WHEEL and channel != "wheel_ticks"
    return channel in _known(message)


def is_transforms(message: MessageType) -> bool:
    """Return whether messages hold transforms between frames, as those of `/tf` do."""
    return "transforms.transform.translation.x" in message.paths


def group_meaning(channel: str, spec: TopicChannel, message: MessageType) -> PickedNumbers:
    """Return the numbers of a pose (x, y, quaternion or heading) or a twist (x, y, yaw rate).

    Raises:
        UnsuitableType: the type holds none.
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
    """Return the numbers of any other channel.

    Raises:
        UnsuitableType: the type does not fit, or a field or a unit must be given.
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
    """Return the numbers of a channel that is an array of JointState."""
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
    """Return the most likely array of JointState for a channel."""
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
    """Return the known fields of a type, by its whole name, else without the package."""
    return _KNOWN.get(message.name) or _KNOWN.get(message.name.rsplit("/", 1)[-1], {})


def _group_paths(channel: str, message: MessageType, prefix: str) -> tuple[str, ...]:
    """Return the paths of the numbers of a pose or a twist at or below a field."""
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
    """Return the names of the numbers of a pose or a twist in messages."""
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


def first_names(names: Iterable[str]) -> str:
    """Return the first dozen names, for error messages."""
    every = list(names)
    return ", ".join(every[:12] + ["..."] * (len(every) > 12)) or "none"
