"""Sentences about readings and factors: what was found, and which key of the config to change."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isclose, pi

from slipid.data.sanity.candidates import Candidate
from slipid.data.sanity.causes import Explained
from slipid.data.sanity.finding import Finding
from slipid.data.sanity.headings import Frame
from slipid.data.sanity.ratios import Ratios
from slipid.data.sanity.reading import Reading
from slipid.data.sanity.shape import Mistake

_WHAT_OF_FRAME = {
    "heading_sign": "the heading of the poses turns the other way round than the body does",
    "pose_axis": "an axis of the poses has the wrong sign",
    "pose_swapped": "x and y of the poses are exchanged",
    "pose_mirrored": "the poses are mirrored, as from below or in an image whose y points down",
    "heading_quaternion": "the heading is the z of a quaternion, sin(yaw / 2), not an angle",
}


@dataclass(frozen=True)
class Words:
    """What was found, and what to do."""

    found: str
    remedy: str


def of_mistake(mistake: Mistake) -> Finding:
    """The finding about order, signs or axes."""
    said = _of(mistake.found)
    found = (
        f"{said.found}: read so, {mistake.after:.2f} of the motion is left unexplained, "
        f"as declared {mistake.before:.2f}"
    )
    remedy = said.remedy
    for other in mistake.or_else[:2]:
        remedy += f"; or, which explains these logs as well: {_of(other).remedy}"
    return Finding(mistake.found.kind, found, remedy, "wrong")


def _of(candidate: Candidate) -> Words:
    """Words about one mistake in order, signs or axes."""
    kind, reading = candidate.kind, candidate.reading
    if kind in ("wheel_sign", "command_sign") and (reading.sign or reading.command_sign):
        said = reading.sign if kind == "wheel_sign" else reading.command_sign
        return _signs(kind, [k + 1 for k, s in enumerate(said) if s < 0], len(said))
    if kind == "command_sign":
        axes = [a for a, s in zip(("x", "y", "yaw"), reading.twist_sign, strict=True) if s < 0]
        listed = " and ".join(axes)
        return Words(
            f"the commanded twist has the wrong sign in {listed}",
            "turn the sign of scale for "
            + " and ".join(f"the channel twist_command_{axis}" for axis in axes),
        )
    if kind in ("wheel_order", "command_order"):
        return _order(kind, reading)
    if kind == "wheel_azimuths":
        return Words(
            f"the wheels stand turned by {reading.azimuth:+d} deg about the middle against what is "
            "declared",
            f"add {reading.azimuth} deg to wheel_azimuths_deg (or to wheel_places_m and "
            "drive_directions_deg) in [robot]",
        )
    if kind == "gyro_sign":
        return Words(
            "the gyro turns the other way round than the poses",
            "turn the sign of scale for the channel gyro",
        )
    return _frame(kind, reading.frame)


def _signs(kind: str, turned: Sequence[int], wheels: int) -> Words:
    """Words about wheels that count backwards."""
    names = " and ".join(map(str, turned))
    channel = "its column" if len(turned) == 1 else "their columns"
    if kind == "command_sign":
        return Words(
            f"the commanded speed of wheel {names} has the opposite sign of what it does",
            f"set scale = -1 for {channel} in the commanded speeds",
        )
    if len(turned) == wheels:
        return Words(
            "every wheel counts backwards: all turns have the opposite sign of what the poses say",
            "set scale = -1 for the channel of the wheels, if it is 1 (else turn its sign)",
        )
    verb = "wheel {} counts" if len(turned) == 1 else "wheels {} count"
    return Words(
        f"{verb.format(names)} backwards: the turns have the opposite sign of what the poses say",
        f"set scale = -1 for {channel}, if it is 1 (else turn its sign)",
    )


def _order(kind: str, reading: Reading) -> Words:
    """Words about columns in another order."""
    order = reading.order if kind == "wheel_order" else reading.command_order
    listed = ", ".join(str(k + 1) for k in order)
    what = "the wheels' columns" if kind == "wheel_order" else "the columns of the commanded speeds"
    return Words(
        f"{what} are in another order than the wheels of [robot]",
        f"list the columns in the order {listed} (counted as they are listed now)",
    )


def _frame(kind: str, frame: Frame) -> Words:
    """Words about the frame of the poses."""
    offset = (
        f" and add {frame.offset} deg to its offset" if frame.offset and kind != "pose_axis" else ""
    )
    if kind == "heading_offset":
        return Words(
            f"the heading of the poses is turned by {-frame.offset} deg against the body",
            f"add {frame.offset} deg to the offset of the channel pose_heading",
        )
    if kind == "heading_unit":
        is_said = ("deg", "rad") if frame.heading == "degrees" else ("rad", "deg")
        return Words(
            f"the heading of the poses is in {is_said[0]}, but is declared in {is_said[1]}",
            f"set unit = '{is_said[0]}' for the channel pose_heading",
        )
    if kind == "heading_quaternion":
        remedy = "log the yaw, 2 atan2(qz, qw), and name its column in the channel pose_heading"
    elif kind == "heading_sign":
        remedy = f"turn the sign of scale for the channel pose_heading{offset}"
    elif kind == "pose_axis":
        axis = "x" if abs(frame.offset) == 180 else "y"
        remedy = f"turn the sign of scale for the channel pose_{axis}"
    elif kind == "pose_swapped":
        remedy = "exchange the columns of the channels pose_x and pose_y"
    else:
        remedy = (
            "turn the sign of scale for the channels pose_y and pose_heading (or of pose_x and "
            f"pose_heading, with 180 deg more in its offset){offset}"
        )
    return Words(_WHAT_OF_FRAME[kind], remedy)


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
            "correct base_radius_m (or half_width_m, half_length_m, wheel_places_m) in [robot]",
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
