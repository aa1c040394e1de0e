"""Sentences about units and sizes: what was found, and which key of the config to change."""

from collections.abc import Mapping, Sequence
from math import isclose, pi

from slipid.data.sanity.finding import Finding, Words
from slipid.data.sanity.scales.causes import Explained
from slipid.data.sanity.scales.ratios import Ratios

_KIND = {
    "time": "time_unit",
    "pose_length": "pose_length",
    "heading": "heading_unit",
    "wheel_gear": "wheel_scale",
    "wheel_turns": "wheel_scale",
    "wheel_radius": "wheel_scale",
    "base": "base_radius",
    "gyro": "gyro_unit",
    "report": "wheel_speed_unit",
    "command_wheels": "command_unit",
    "command_twist": "command_unit",
    "command_yaw": "command_unit",
}


def of_causes(
    fitting: Sequence[Explained], single: bool, why: str, gear_ratio: float
) -> tuple[Finding, ...]:
    """Findings about factors: the likeliest with the others as ways out, or all of a pair.

    Args:
        fitting: causes that fit, the likeliest first.
        single: whether each of them fits alone.
        why: the ratios that are not natural, as a sentence.
        gear_ratio: of the declared robot.
    """
    if not fitting:
        return ()
    if not single:
        return tuple(_finding(one, (), why, gear_ratio) for one in fitting)
    first, *others = fitting
    as_likely = [
        e for e in others if e.common == first.common and _KIND[e.name] != _KIND[first.name]
    ]
    return (_finding(first, as_likely[:2], why, gear_ratio),)


def of_ratios(seen: Ratios) -> str:
    """The ratios that are not natural, as a sentence."""
    words = {
        "travel": "the body moves {:.3g} times as far as the wheels say",
        "turning": "the body turns {:.3g} times as far as the wheels say",
        "drive": "the commanded motion is {:.3g} times what the wheels did",
        "steer": "the commanded turn is {:.3g} times what the wheels did",
        "command": "the commanded wheel speeds are {:.3g} times the measured ones",
        "report": "the reported wheel speeds are {:.3g} times what the encoders say",
        "gyro": "the gyro turns {:.3g} times as far as the poses",
    }
    return ", ".join(words[k].format(r.value) for k, r in seen.known.items() if not r.natural)


def _finding(of: Explained, others: Sequence[Explained], why: str, gear_ratio: float) -> Finding:
    said = _factor(of, gear_ratio)
    remedy = said.remedy
    for other in others:
        remedy += f"; or, which explains these logs as well: {_factor(other, gear_ratio).remedy}"
    return Finding(_KIND[of.name], f"{said.found}: {why}", remedy, "wrong")


def _factor(of: Explained, gear_ratio: float) -> Words:
    """Words about a factor by which readings are too large."""
    size = of.factor if of.factor > 1 else 1 / of.factor
    much = f"{size:.3g} times too " + ("large" if of.factor > 1 else "small")
    name = of.name
    if name == "time":
        unit = _named(of.factor, {1e3: "ms", 1e6: "us", 1e9: "ns", 60.0: "s", 1e-3: "s"})
        to = f"set unit = '{unit}' for the channel time" if unit else "correct the unit of time"
        return Words(f"time is in another unit, {much}", to)
    if name == "pose_length":
        unit = _named(of.factor, {1e3: "mm", 1e2: "cm", 1e-3: "m", 1e-2: "m"})
        set_unit = (
            f"set unit = '{unit}' for the channels" if unit else "correct the unit or scale of"
        )
        return Words(
            f"the poses' lengths are {much}",
            f"{set_unit} pose_x and pose_y (scale = {1 / of.factor:.3g})",
        )
    if name == "heading":
        unit = "deg" if of.factor > 1 else "rad"
        return Words(f"the heading is {much}", f"set unit = '{unit}' for the channel pose_heading")
    if name in ("wheel_gear", "wheel_turns"):
        return Words(f"the wheels' turns are {much}", _turns(of.factor, gear_ratio))
    if name == "wheel_radius":
        return Words(
            f"wheel_radius_m is {much}, or the wheels' turns are",
            f"divide wheel_radius_m in [robot] by {of.factor:.3g}, or "
            + _turns(of.factor, gear_ratio),
        )
    if name == "base":
        return Words(
            f"the distance of the wheels from the middle is {'less' if of.factor < 1 else 'more'} "
            f"than declared, by a factor of {size:.3g}",
            "correct base_radius_m (or track_m, half_width_m, half_length_m, wheel_places_m) of "
            "[robot]",
        )
    channel = {
        "gyro": "gyro",
        "report": "wheel_speed (or motor_speed)",
        "command_wheels": "wheel_speed_command (or motor_speed_command)",
        "command_twist": "twist_command_x and twist_command_y",
        "command_yaw": "twist_command_yaw",
    }[name]
    return Words(
        f"the channel {channel} is {much}",
        f"correct unit or scale of the channel {channel}{_unit_of_rate(of.factor)} "
        f"(scale = {1 / of.factor:.3g})",
    )


def _turns(factor: float, gear_ratio: float) -> str:
    """What to do about turns that are too large by a factor."""
    ways = [f"multiply ticks_per_revolution or the layout's gear_ratio by {factor:.3g}"]
    if gear_ratio > 1.5 and isclose(1 / factor, gear_ratio, rel_tol=0.02):
        ways = ["set gear_ratio = 1 in the layout, if the encoder sits at the wheel, not the motor"]
    elif gear_ratio > 1.5 and isclose(factor, gear_ratio, rel_tol=0.02):
        ways = [f"set gear_ratio = {gear_ratio:g} in the layout: the encoder sits at the motor"]
    if unit := _unit_of_rate(factor):
        ways.append("correct the unit, if wheels are logged as speeds or angles" + unit)
    return ", or ".join(ways)


def _unit_of_rate(factor: float) -> str:
    """Name of a unit that is taken for radians, if a factor says so."""
    names = {
        30 / pi: ": 'rpm' was taken for 'rad/s'",
        pi / 30: ": 'rad/s' was taken for 'rpm'",
        180 / pi: ": degrees were taken for radians",
        pi / 180: ": radians were taken for degrees",
        1 / (2 * pi): ": revolutions were taken for radians",
        2 * pi: ": radians were taken for revolutions",
        1000.0: ": thousandths were taken for the whole",
    }
    return _named(factor, names)


def _named(factor: float, names: Mapping[float, str]) -> str:
    """The name of a factor, or nothing."""
    return next((said for f, said in names.items() if isclose(f, factor, rel_tol=1e-3)), "")
