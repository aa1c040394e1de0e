"""Dictionary of words in column and topic names, from which the channel and unit are guessed."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache

from slipid.data.reading.layout import CHANNELS
from slipid.data.reading.units import converts

_TABLE: dict[str, str] = {
    # words that name the wheel
    "side l": "left l lt lh links",
    "side r": "right r rt rh rechts",
    "end f": "front fore forward f",
    "end m": "mid middle centre center",
    "end r": "rear back hind aft b",
    "corner fl": "fl lf",
    "corner fr": "fr rf",
    "corner rl": "rl bl",
    "corner rr": "rr br",
    "kind motor": "motor motors m mot engine",
    "kind wheel": "wheel wheels whl joint joints tyre tire track",
    # words that name the measured quantity
    "what time": "t time stamp timestamp times tstamp seconds elapsed clock zeit",
    "what ticks": "tick ticks enc encoder encoders count counts counter pulse pulses cnt",
    "what position": "pos position positions pose place loc location translation p",
    "what speed": "vel velocity velocities speed speeds spd omega qd rate",
    "what w": "w",
    "what v": "v",
    "what command": (
        "cmd command commanded set setpoint sp ref reference target des desired goal wanted"
    ),
    "what current": "cur curr current currents amp amps ampere i strom",
    "what torque": "torque torques tau effort efforts moment",
    "what voltage": "volt volts voltage voltages u spannung",
    "what duty": "duty pwm dutycycle throttle",
    "what battery": "bat batt battery bus supply vbat vbatt vbus ubat ubus",
    "what rpm": "rpm erpm",
    "what gyro": "gyro gyroscope gz",
    "what yaw": "yaw heading theta th psi bearing hdg",
    "what steering": "steering steer ackermann",
    "what angle": "angle angles ang phi rot rotation rotational",
    "what linear": "linear lin",
    "what angular": "angular",
    "what orientation": "orientation quaternion quat q attitude",
    "what quaternion": "qx qy qz qw",
    "what axis": "x y z",
    # words that mark a column which slipid does not use
    "not odometry": "odom odometry odo",
    "not wanted": (
        "delta diff d dt dx dy dtheta accel acc acceleration mag temp temperature std cov "
        "covariance error err sum mean row index seq id flag status roll pitch lat lon rssi step"
    ),
    # words that have no meaning for the channel
    "noise": (
        "data field fields msg value values actual measured meas feedback fb state states link "
        "robot base body global world map camera cam mocap vicon optitrack tag marker tracker "
        "lidar slam imu header twist coordinate coordinates coord axis of the from to in at along "
        "log sensor drive shaft nsec sec secs ros cycle today"
    ),
}
"""Words in column names, by role and value: the key `side l` is the role `side` with value `l`."""
_ROLES: dict[str, tuple[str, str]] = {
    word: (role.partition(" ")[0], role.partition(" ")[2])
    for role, words in _TABLE.items()
    for word in words.split()
}
_LONG = [word for word in _ROLES if len(word) >= 4]
_NEAR = 0.82
"""Least similarity (`difflib`) for which a word counts as a misspelling of a known one [1]."""
_LETTERS = 3
"""Words up to this length, such as wl, may be read as a sequence of one-letter words."""
_LONGEST = 60
"""Letters of the longest word that is looked up; the time of a search grows with their square."""
_SUFFIXES = {
    **{"s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "us": "us"},
    **{"usec": "us", "ns": "ns", "nsec": "ns", "m": "m", "mm": "mm", "cm": "cm"},
    **{"px": "pixel", "pix": "pixel", "pixels": "pixel", "rev": "rev", "ticks": "tick"},
    **{"rad": "rad", "deg": "deg", "degrees": "deg", "degs": "deg/s", "deg_s": "deg/s"},
    **{"dps": "deg/s", "rads": "rad/s", "rad_s": "rad/s", "radps": "rad/s", "rps": "rev/s"},
    **{"rpm": "rpm", "mps": "m/s", "m_s": "m/s", "mm_s": "mm/s", "mmps": "mm/s"},
    **{"a": "A", "amps": "A", "ma": "mA", "v": "V", "mv": "mV", "nm": "N*m"},
    **{"%": "%", "percent": "percent", "pct": "percent"},
}
"""Units by the endings of column names that denote them."""
_BY_UNIT = {"tick": "ticks", "A": "current", "V": "voltage", "N*m": "torque", "rad/s": "speed"}
_SHORT = ("v", "a", "s", "m")
"""Endings that may be words as well: they are taken as units only if the whole name, with the
ending as a word, has no meaning."""


@dataclass(frozen=True)
class ColumnMeaning:
    """Meaning of the name of a column.

    Attributes:
        channel: one of `CHANNELS`; or `wheel_position`, `wheel_v`, `motor_position` or `motor_v` if
            only the numbers can decide between two channels; or `odometry`; empty if the name has
            no known meaning.
        label: name of the wheel, such as `fl` or `2`, or component of a quaternion; else empty.
        unit: unit in the name or in the row of units; empty if there is none that suits the
            channel.
        doubt: question about an assumption that was made, for the user to confirm; else empty.
    """

    channel: str = ""
    label: str = ""
    unit: str = ""
    doubt: str = ""


def stamp_columns(names: Sequence[str]) -> tuple[int, int] | None:
    """Return the positions of two columns that together are a time, or None if there are none.

    They have the seconds and the nanoseconds of a stamp, such as `stamp.sec` and `stamp.nanosec`.
    """
    at = {name.lower(): k for k, name in enumerate(names)}
    for name, seconds in at.items():
        if (found := re.fullmatch(r"(|.*[^a-z])s(|ec|ecs|econds)", name)) is None:
            continue
        roles = {(role, value) for role, value, _ in name_parts(found[1]).roles}
        if not roles <= {("what", "time"), ("noise", "")} or name_parts(found[1]).unknown:
            continue
        for part in ("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds", "ns"):
            if found[1] + part in at:
                return seconds, at[found[1] + part]
    return None


def _without_prefix(name: str) -> str:
    """Return a name such as `/vrpn/robot/pose/x` without the first parts that mean nothing."""
    parts = name.strip("/").split("/")
    while len(parts) > 1 and all(role == "noise" for role, _, _ in name_parts(parts[0]).roles):
        parts = parts[1:]
    return "/".join(parts)


def meaning_of(name: str, unit: str = "", *, of_motor: bool = False) -> ColumnMeaning:
    """Return the meaning of a column or of a topic's field by its name.

    Args:
        name: name of the column.
        unit: cell of the column in a row of units; empty without such a row.
        of_motor: True if the log is that of motors on a bench, whose columns need not name a wheel
            or motor.
    """
    bare, suffix = without_unit(name)
    unit = unit_in(unit) or unit or suffix
    texts = [bare] if "[" in name or "(" in name or "," in name else [bare, name]
    # An ending such as v may be a word (speed) instead of a unit: the whole name is tried first.
    if name[len(bare) :].lower()[1:] in _SHORT:
        texts.reverse()
    if "/" in bare and (inside := _without_prefix(bare)) != bare:
        texts.append(inside)
    tried = [(name_parts(text), strict) for strict in (True, False) for text in texts]
    for parts, strict in tried:
        if strict and (parts.unknown or parts.mended):
            continue
        if found := _motor_channel(parts, unit) if of_motor else _channel(parts, unit):
            channel, label = found
            unit = "rpm" if parts.has("what", "rpm") else unit
            fitting = unit if _fits(channel, unit) else ""
            return ColumnMeaning(channel, label, fitting, _doubt(parts, channel))
    return ColumnMeaning(unit=unit)


@lru_cache(maxsize=4096)
def is_unit(text: str) -> bool:
    """Return whether a string is a unit that converts to the unit of some channel."""
    return bool(text.strip()) and any(
        converts(text, target) for target in {*CHANNELS.values(), "pixel"}
    )


def unit_in(text: str) -> str:
    """Return the unit that a string such as V or ma stands for; empty if it is not a unit."""
    return text if is_unit(text) else _SUFFIXES.get(text.lower(), "")


def without_unit(name: str) -> tuple[str, str]:
    """Return a column name without its unit, and the unit, empty if the name has none.

    The unit may be in brackets, after a comma, or a suffix.
    """
    if inside := re.match(r"^(.*\S)\s*[\[(]([^\])]*)[\])]\s*$", name):
        if inside[2].isdecimal():
            return name, ""
        return inside[1], unit_in(inside[2])
    if (comma := re.match(r"^(.+), *([^,]+)$", name)) and is_unit(comma[2]):
        return comma[1], comma[2].strip()
    parts = re.split(r"[_/ ]", name.lower())
    for length in (2, 1):
        end = "_".join(parts[-length:])
        if len(parts) > length and end in _SUFFIXES:
            return name[: -len(end) - 1], _SUFFIXES[end]
    return name, ""


def _fits(channel: str, unit: str) -> bool:
    """Return whether a unit is given and possible for a channel."""
    targets = {
        "position": ("rad", "tick"),
        "v": ("V", "rad/s", "m/s"),
        "speed": ("rad/s", "m/s"),
        "x": ("m", "pixel"),
        "y": ("m", "pixel"),
    }.get(channel.rpartition("_")[2], (CHANNELS.get(channel, "1"),))
    return bool(unit) and any(converts(unit, target) for target in targets)


@dataclass(frozen=True)
class NameParts:
    """Words of a column's name, with their roles.

    Attributes:
        roles: (role, value, word) of each known word, such as ("what", "speed", "vel").
        numbers: numbers in the name, as strings.
        unknown: words that are not in the dictionary.
        mended: corrected misspellings, written as `headng -> heading`.
    """

    roles: tuple[tuple[str, str, str], ...]
    numbers: tuple[str, ...]
    unknown: tuple[str, ...]
    mended: tuple[str, ...]

    def has(self, role: str, *values: str) -> bool:
        """Return whether some word has a role and, if values are given, one of these values."""
        return any(r == role and (not values or v in values) for r, v, _ in self.roles)

    def of(self, role: str) -> list[str]:
        """Return the values of a role, in the order of the words."""
        return [v for r, v, _ in self.roles if r == role]

    def words(self, *values: str) -> list[str]:
        """Return the words with the role `what` (measured quantity) and one of these values."""
        return [w for r, v, w in self.roles if r == "what" and v in values]


def name_parts(name: str) -> NameParts:
    """Return the words of a column's name; misspelled words are corrected."""
    roles, numbers, unknown, mended = [], [], [], []
    for part in _split(name):
        if part.isdecimal():
            numbers.append(part)
            continue
        if len(part) > _LONGEST:
            unknown.append(part)
            continue
        for word in [part] if part in _ROLES else _apart(part):
            near = [word] if word in _ROLES else []
            if not near and len(word) >= 3:
                near = get_close_matches(word, _LONG, n=1, cutoff=_NEAR)
            if not near:
                unknown.append(word)
                continue
            if near[0] != word:
                mended.append(f"{word} -> {near[0]}")
            roles.append((*_ROLES[near[0]], near[0]))
    return NameParts(tuple(roles), tuple(numbers), tuple(unknown), tuple(mended))


def _split(name: str) -> list[str]:
    """Return the words and numbers of a name, in lower case.

    A name is split at capitals, at digits, and at characters that are neither letters nor digits;
    `1st` becomes 1.
    """
    name = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Za-z])(?=\d)", "_", name)
    name = re.sub(r"(\d)(?:st|nd|rd|th)\b", r"\1", name.lower())
    name = re.sub(r"(?<=\d)(?=[a-z])", "_", name)
    return re.findall(r"[a-z]+|\d+", name)


def _apart(word: str) -> list[str]:
    """Return the shortest list of known words that form a compound such as `setvel` or `wl`.

    If there is no such list, the result is the word itself.
    """
    best: list[list[str] | None] = [[]] + [None] * len(word)
    for end in range(1, len(word) + 1):
        for start in range(end):
            head, tail = best[start], word[start:end]
            if head is None or tail not in _ROLES:
                continue
            if best[end] is None or len(head) + 1 < len(best[end] or []):
                best[end] = [*head, tail]
    found = best[-1]
    if found is None or (len(word) > _LETTERS and any(len(part) == 1 for part in found[1:-1])):
        return [word]
    single = sum(len(part) == 1 for part in found)
    if single == len(found) > _LETTERS - 1 or (len(word) > _LETTERS and single > 1):
        return [word]
    return found


def is_electrical(name: str) -> bool:
    """Return whether a column has the speed of a motor's field: the shaft's times pole pairs."""
    return "erpm" in name_parts(name).words("rpm")


def _doubt(parts: NameParts, channel: str) -> str:
    """Return a question about an assumption that was made about a name, empty if none was made."""
    if "erpm" in parts.words("rpm"):
        return "erpm is the shaft's speed times the motor's pole pairs: give scale = 1 / pole pairs"
    if channel.startswith("twist") and not parts.has("what", "command"):
        return "is it a command? Measured speeds must not be used here"
    if _of_axis(parts):
        return "is it along the axis q of the motor?"
    if parts.mended:
        return "misspelled? " + ", ".join(parts.mended)
    return (
        f"its name contains {', '.join(parts.unknown)}, which is not understood"
        if parts.unknown
        else ""
    )


_OF_ROBOT = ("time", "battery", "gyro", "steering")
"""Measured quantities that are never those of a wheel, even if a name has its label."""


def _channel(parts: NameParts, unit: str) -> tuple[str, str] | None:
    """Return the channel and the label of a name, or None if it has no known meaning."""
    if parts.has("not") or _of_axis(parts):
        return ("odometry", "") if parts.has("not", "odometry") else None
    label = _label(parts)
    single = _single(parts)
    if not parts.unknown and single and (not label or parts.has("what", *_OF_ROBOT)):
        return single
    what = _measured(parts, unit)
    if what is None or not (label or parts.has("kind")):
        return None
    if what in ("current", "voltage", "duty"):
        return what, label
    if what == "ticks":
        return "wheel_ticks", label
    return f"{'motor' if parts.has('kind', 'motor') else 'wheel'}_{what}", label


def _of_axis(parts: NameParts) -> bool:
    """Return whether a name is that of a current or voltage along the axis d or q of a motor."""
    electric = parts.has("what", "current", "voltage", "v")
    return electric and any(word in ("d", "q") for _, _, word in parts.roles)


def _motor_channel(parts: NameParts, unit: str) -> tuple[str, str] | None:
    """Return the channel and the label of a name in a log of motors on a bench, or None."""
    if parts.has("not"):
        return None
    single = _single(parts)
    if single and single[0] in ("time", "bus_voltage"):
        return single
    what = _measured(parts, unit)
    names = {"v": "voltage", "position": "motor_angle", "speed": "motor_speed"}
    return (names.get(what, what), _label(parts)) if what else None


def _label(parts: NameParts) -> str:
    """Return the label of the wheel in a name, such as fl, r or 2; empty if it names no wheel."""
    if parts.has("corner"):
        return parts.of("corner")[0]
    side = parts.of("side")[:1]
    end = parts.of("end")[:1]
    if side and end:
        return end[0] + side[0]
    return side[0] if side else parts.numbers[-1] if parts.numbers else ""


def _measured(parts: NameParts, unit: str) -> str | None:
    """Return the measured quantity of a wheel or motor, or None.

    The quantity is the channel's name after `wheel_` or `motor_`; `position` may mean ticks or an
    angle, and `v` a voltage or a speed.
    """
    if parts.has("what", "command"):
        return "speed_command" if not parts.has("what", "current", "torque", "voltage") else None
    if parts.has("what", "rpm"):
        return "speed"
    for what in ("ticks", "current", "torque", "voltage", "duty", "speed"):
        if parts.has("what", what):
            return what
    # The word w is tried after these words, since it may mean a wheel instead of a speed.
    if parts.has("what", "position", "angle", "yaw"):
        return "position"
    if parts.has("what", "angular", "w"):
        return "speed"
    if parts.has("what", "v"):
        return "v"
    by_unit = (what for target, what in _BY_UNIT.items() if unit and converts(unit, target))
    return None if parts.has("what") else next(by_unit, None)


def _single(parts: NameParts) -> tuple[str, str] | None:
    """Return the channel of the whole robot that a name denotes, and the quaternion's component.

    The component is empty for channels other than a quaternion. The result is None if the name
    denotes no channel of the whole robot, but, for example, one of the wheels.
    """
    what = set(parts.of("what"))
    axis = parts.words("axis")
    if what and what <= {"time"}:
        return "time", ""
    if quaternion := parts.words("quaternion"):
        return "pose_quaternion", quaternion[0][1]
    if "orientation" in what and (axis or "w" in what):
        return "pose_quaternion", axis[-1] if axis else "w"
    if "battery" in what:
        return None if what & {"current", "duty"} else ("bus_voltage", "")
    angular = what >= {"angular", "speed"} or (what == {"w", "axis"} and axis == ["z"])
    if "steering" in what:
        return None if what & {"command", "speed", "current", "torque"} else ("steering_angle", "")
    if "gyro" in what or (angular and "command" not in what):
        return ("gyro", "") if axis in (["z"], []) else None
    if "command" in what or "linear" in what or "angular" in what:
        return _twist(what, axis)
    if what & {"speed", "current", "voltage", "torque", "ticks", "v", "w", "duty"}:
        return None
    if parts.has("kind") or parts.has("side"):
        return None
    if axis and what <= {"axis", "position"} and axis[-1] in "xy" and len(axis) == 1:
        return f"pose_{axis[0]}", ""
    turned = what & {"yaw", "angle", "orientation"} and not axis
    return ("pose_heading", "") if turned or (axis == ["z"] and "angle" in what) else None


def _twist(what: set[str], axis: list[str]) -> tuple[str, str] | None:
    """Return the channel of a commanded twist, with an empty label, or None.

    Args:
        what: values of the words that name the measured quantity.
        axis: words among x, y and z.
    """
    turning = what & {"w", "yaw", "angular", "angle"}
    if turning and axis in ([], ["z"]):
        return "twist_command_yaw", ""
    if axis == ["y"] and not turning:
        return "twist_command_y", ""
    straight = what & {"v", "linear", "speed", "position"} or axis == ["x"]
    ahead = straight and axis in ([], ["x"]) and not turning
    return ("twist_command_x", "") if ahead else None
