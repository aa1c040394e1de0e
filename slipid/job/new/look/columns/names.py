"""What a column holds, by its name: the channel, the wheel and the unit that it says."""

import re
from dataclasses import dataclass
from functools import lru_cache

from slipid.data.reading.layout import CHANNELS
from slipid.data.reading.units import converts
from slipid.job.new.look.columns.words import Words, words_of

SUFFIXES = {
    **{"s": "s", "sec": "s", "secs": "s", "ms": "ms", "msec": "ms", "us": "us", "ns": "ns"},
    **{"m": "m", "mm": "mm", "cm": "cm", "px": "pixel", "pix": "pixel", "pixels": "pixel"},
    **{"rad": "rad", "deg": "deg", "degrees": "deg", "rev": "rev", "ticks": "tick"},
    **{"rpm": "rpm", "rads": "rad/s", "rad_s": "rad/s", "radps": "rad/s", "rps": "rev/s"},
    **{"degs": "deg/s", "deg_s": "deg/s", "dps": "deg/s", "mps": "m/s", "m_s": "m/s"},
    **{"mm_s": "mm/s", "mmps": "mm/s", "a": "A", "amps": "A", "ma": "mA", "v": "V", "mv": "mV"},
    **{"nm": "N*m", "percent": "percent", "pct": "percent", "nsec": "ns", "usec": "us"},
}
"""Ends of names that say a unit."""
_BY_UNIT = {"tick": "ticks", "A": "current", "V": "voltage", "N*m": "torque", "rad/s": "speed"}
_SHORT = ("_v", "_a", "_s", "_m", "/v", "/a", "/s", "/m")
"""Ends of names that mean a unit only where the rest of the name is not understood with them."""


@dataclass(frozen=True)
class Named:
    """What a name says.

    Attributes:
        channel: of `CHANNELS`, or `wheel_position` and `wheel_v` where numbers must tell between
            two (also `motor_`); empty where the name says nothing.
        label: which wheel, or which part of a quaternion.
        unit: that the name says, else empty.
        doubt: what was assumed, else empty.
    """

    channel: str = ""
    label: str = ""
    unit: str = ""
    doubt: str = ""


def named(name: str, unit: str = "") -> Named:
    """What a column of this name holds; `unit` is that of a row of units, if there is one."""
    bare, said = without_unit(name)
    unit = unit or said
    texts = [bare] if "[" in name or "(" in name or "," in name else [bare, name]
    if name[len(bare) :].lower() in _SHORT:  # v may be a speed, a and s other things
        texts.reverse()
    tried = [(words_of(text), strict) for strict in (True, False) for text in texts]
    for words, strict in tried:
        if strict and (words.unknown or words.mended):
            continue
        if found := _channel(words, unit):
            channel, label = found
            unit = "rpm" if words.has("what", "rpm") else unit
            return Named(
                channel, label, unit if _fits(channel, unit) else "", _doubt(words, channel)
            )
    return Named(unit=unit)


@lru_cache(maxsize=4096)
def is_unit(text: str) -> bool:
    """Whether a text is a unit of something that is logged."""
    return bool(text.strip()) and any(
        converts(text, target) for target in {*CHANNELS.values(), "pixel"}
    )


def without_unit(name: str) -> tuple[str, str]:
    """A name less the unit in it, and that unit: brackets, after a comma, or the end of it."""
    if inside := re.match(r"^(.*\S)\s*[\[(]([^\])]*)[\])]\s*$", name):
        if inside[2].isdecimal():
            return name, ""
        known = is_unit(inside[2]) or inside[2].lower() in SUFFIXES
        return inside[1], _unit(inside[2]) if known else ""
    if (comma := re.match(r"^(.+), *([^,]+)$", name)) and is_unit(comma[2]):
        return comma[1], comma[2].strip()
    for length in (2, 1):
        parts = name.lower().replace("/", "_").split("_")
        if len(parts) > length and (unit := SUFFIXES.get("_".join(parts[-length:]))):
            return name[: -len("_".join(parts[-length:])) - 1], unit
    return name, ""


def _unit(text: str) -> str:
    return text if is_unit(text) else SUFFIXES.get(text.lower(), text)


def _fits(channel: str, unit: str) -> bool:
    """Whether a unit can be that of a channel."""
    targets = {
        "position": ("rad", "tick"),
        "v": ("V", "rad/s", "m/s"),
        "speed": ("rad/s", "m/s"),
        "x": ("m", "pixel"),
        "y": ("m", "pixel"),
    }.get(channel.rpartition("_")[2], (CHANNELS.get(channel, "1"),))
    return bool(unit) and any(converts(unit, target) for target in targets)


def _doubt(words: Words, channel: str) -> str:
    """What was assumed about a name."""
    if channel.startswith("twist") and not words.has("what", "command"):
        return "is it what was commanded? Measured speeds do not belong here"
    if words.mended:
        return "misspelled? " + ", ".join(words.mended)
    return f"{', '.join(words.unknown)} in its name is not known" if words.unknown else ""


def _channel(words: Words, unit: str) -> tuple[str, str] | None:
    """Channel and label of a name; None where it says none."""
    if words.has("not"):
        return ("odometry", "") if words.has("not", "odometry") else None
    label = _label(words)
    single = _single(words, unit)
    if not words.unknown and single and (not label or words.has("what", "time", "battery", "gyro")):
        return single
    what = _measured(words, unit)
    if what is None or not (label or words.has("kind")):
        return None
    kind = "motor" if words.has("kind", "motor") else "wheel"
    if what in ("current", "voltage", "duty"):
        return what, label
    if what == "ticks":
        return "wheel_ticks", label
    return f"{kind}_{what}", label


def _label(words: Words) -> str:
    """Which wheel a name is of: fl, r, 2; empty for none."""
    if words.has("corner"):
        return words.of("corner")[0]
    side = words.of("side")[:1]
    end = words.of("end")[:1]
    if side and end:
        return end[0] + side[0]
    return side[0] if side else words.numbers[-1] if words.numbers else ""


def _measured(words: Words, unit: str) -> str | None:
    """What of a wheel is measured: the end of the channel's name."""
    if words.has("what", "command"):
        return "speed_command" if not words.has("what", "current", "torque", "voltage") else None
    if words.has("what", "rpm"):
        return "speed"
    for what in ("ticks", "current", "torque", "voltage", "duty", "speed"):
        if words.has("what", what):
            return what
    if words.has("what", "position", "angle", "yaw"):  # before w, which may be a wheel
        return "position"
    if words.has("what", "angular", "w"):
        return "speed"
    if words.has("what", "v"):
        return "v"
    by_unit = (what for target, what in _BY_UNIT.items() if unit and converts(unit, target))
    return None if words.has("what") else next(by_unit, None)


def _single(words: Words, unit: str) -> tuple[str, str] | None:
    """Channel of the whole robot, and which part of a quaternion."""
    what = set(words.of("what"))
    axis = words.words("axis")
    if what and what <= {"time"}:
        return "time", ""
    if quaternion := words.words("quaternion"):
        return "pose_quaternion", quaternion[0][1]
    if "orientation" in what and (axis or "w" in what):
        return "pose_quaternion", axis[-1] if axis else "w"
    if "battery" in what:
        return None if what & {"current", "duty"} else ("bus_voltage", "")
    angular = what >= {"angular", "speed"} or (what == {"w", "axis"} and axis == ["z"])
    if "gyro" in what or (angular and "command" not in what):
        return ("gyro", "") if axis in (["z"], []) else None
    if "command" in what or "linear" in what or "angular" in what:
        return _twist(what, axis)
    if what & {"speed", "current", "voltage", "torque", "ticks", "v", "w", "duty"}:
        return None
    if words.has("kind") or words.has("side"):
        return None
    if axis and what <= {"axis", "position"} and axis[-1] in "xy" and len(axis) == 1:
        return f"pose_{axis[0]}", ""
    turned = what & {"yaw", "angle", "orientation"} and not axis
    return ("pose_heading", "") if turned or (axis == ["z"] and "angle" in what) else None


def _twist(what: set[str], axis: list[str]) -> tuple[str, str] | None:
    """Which part of a commanded twist."""
    turning = what & {"w", "yaw", "angular", "angle"}
    if turning and axis in ([], ["z"]):
        return "twist_command_yaw", ""
    if axis == ["y"] and not turning:
        return "twist_command_y", ""
    straight = what & {"v", "linear", "speed", "position"} or axis == ["x"]
    ahead = straight and axis in ([], ["x"]) and not turning
    return ("twist_command_x", "") if ahead else None
