"""Sentences about order, signs and axes: what was found, and which key of the config to change."""

from collections.abc import Sequence

from slipid.data.sanity.axes.candidates import Candidate
from slipid.data.sanity.axes.reading import Reading
from slipid.data.sanity.axes.shape import Mistake
from slipid.data.sanity.finding import Finding, Words
from slipid.data.sanity.motion.headings import Frame

_WHAT_OF_FRAME = {
    "heading_sign": "the heading of the poses turns the other way round than the body does",
    "pose_axis": "an axis of the poses has the wrong sign",
    "pose_swapped": "x and y of the poses are exchanged",
    "pose_mirrored": "the poses are mirrored, as from below or in an image whose y points down",
    "heading_quaternion": "the heading is the z of a quaternion, sin(yaw / 2), not an angle",
}


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
