"""Findings of the check: what is wrong or could not be checked, and which config key to change."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose, pi
from typing import Literal

from slipid.data.check.interpretation import Interpretation
from slipid.data.check.joined import PoseConvention
from slipid.data.check.mistakes import Candidate, Mistake
from slipid.data.check.ratios import ScaleCause, ScaleRatios
from slipid.support.content import Content

Severity = Literal["wrong", "suspicious", "note"]
"""`wrong` must be corrected before a fit, `suspicious` needs a look, `note` could not be
checked."""
ORDER: tuple[Severity, ...] = ("wrong", "suspicious", "note")
NAMED = 4
"""Most runs that a sentence names; the others are counted."""


@dataclass(frozen=True)
class Finding:
    """One thing that the check found in the runs.

    Attributes:
        kind: name of the finding, such as `wheel_sign`; `sanity` lists all of them.
        found: what is wrong, with numbers.
        remedy: which key to change, and to what; or None.
        severity: how bad it is.
        runs: names of the runs concerned; empty where all are.
    """

    kind: str
    found: str
    remedy: str | None
    severity: Severity = "wrong"
    runs: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = f" (in {listed(self.runs)})" if self.runs else ""
        return self.found + where + (f"; {self.remedy}" if self.remedy else "")

    def explained(self, how: str, others: Iterable["Finding"] = ()) -> "Finding":
        """Return the finding with its evidence and the remedies of equally good ones."""
        more = "".join(f"; or, which explains these logs as well: {o.remedy}" for o in others)
        return replace(self, found=f"{self.found}: {how}", remedy=f"{self.remedy}{more}")

    def to_json(self) -> Content:
        """Return the finding as check.json has it."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "found": self.found,
            "remedy": self.remedy,
            "runs": list(self.runs),
        }


def listed(names: Sequence[str]) -> str:
    """Return the first few names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings, those that forbid a fit first."""
    return tuple(sorted(findings, key=lambda f: ORDER.index(f.severity)))


def wrong(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings that forbid a fit."""
    return tuple(f for f in findings if f.severity == "wrong")


_CONVENTION_SENTENCES = {
    "heading_sign": "the heading of the poses turns the other way round than the body does",
    "pose_axis": "an axis of the poses has the wrong sign",
    "pose_swapped": "x and y of the poses are exchanged",
    "pose_mirrored": "the poses are mirrored, as from below or in an image whose y points down",
    "heading_quaternion": "the heading is the z of a quaternion, sin(yaw / 2), not an angle",
}
_CAUSE_KINDS = {
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
"""Kind of the finding about each wrong factor."""


def mistake_finding(mistake: Mistake) -> Finding:
    """Return the finding about a mistake in order, signs or axes."""
    how = (
        f"with this correction {mistake.after:.2f} of the motion is unexplained, "
        f"as declared {mistake.before:.2f}"
    )
    return _candidate_finding(mistake.found).explained(
        how, map(_candidate_finding, mistake.others[:2])
    )


def _candidate_finding(candidate: Candidate) -> Finding:
    """Return the finding about one interpretation that differs in order, signs or axes."""
    kind, meant = candidate.kind, candidate.meant
    if kind in ("wheel_sign", "command_sign") and (meant.sign or meant.command_sign):
        sign = meant.sign if kind == "wheel_sign" else meant.command_sign
        return _sign_finding(kind, [k + 1 for k, s in enumerate(sign) if s < 0], len(sign))
    if kind == "command_sign":
        axes = [a for a, s in zip(("x", "y", "yaw"), meant.twist_sign, strict=True) if s < 0]
        return Finding(
            kind,
            f"the commanded twist has the wrong sign in {' and '.join(axes)}",
            "turn the sign of scale for "
            + " and ".join(f"the channel twist_command_{axis}" for axis in axes),
        )
    if kind in ("wheel_order", "command_order"):
        return _order_finding(kind, meant)
    if kind == "wheel_azimuths":
        return Finding(
            kind,
            f"the wheels stand turned by {meant.azimuth:+d} deg about the middle against what is "
            "declared",
            f"add {meant.azimuth} deg to wheel_azimuths_deg (or to wheel_places_m and "
            "drive_directions_deg) in [robot]",
        )
    if kind == "gyro_sign":
        return Finding(
            kind,
            "the gyro turns the other way round than the poses",
            "turn the sign of scale for the channel gyro",
        )
    return _convention_finding(kind, meant.convention)


def _sign_finding(kind: str, turned: Sequence[int], wheels: int) -> Finding:
    """Return the finding about wheels that count backwards."""
    names = " and ".join(map(str, turned))
    channel = "its column" if len(turned) == 1 else "their columns"
    if kind == "command_sign":
        return Finding(
            kind,
            f"the commanded speed of wheel {names} has the opposite sign of what it does",
            f"set scale = -1 for {channel} in the commanded speeds",
        )
    which, channel = (
        ("every wheel counts", "the channel of the wheels")
        if len(turned) == wheels
        else (f"wheel {names} counts" if len(turned) == 1 else f"wheels {names} count", channel)
    )
    every = "all turns" if len(turned) == wheels else "the turns"
    return Finding(
        kind,
        f"{which} backwards: {every} have the opposite sign of what the poses say",
        f"set scale = -1 for {channel}, if it is 1 (else turn its sign)",
    )


def _order_finding(kind: str, meant: Interpretation) -> Finding:
    """Return the finding about columns in another order."""
    order, what = (
        (meant.order, "the wheels' columns")
        if kind == "wheel_order"
        else (meant.command_order, "the columns of the commanded speeds")
    )
    listed = ", ".join(str(k + 1) for k in order)
    return Finding(
        kind,
        f"{what} are in another order than the wheels of [robot]",
        f"list the columns in the order {listed} (counted as they are listed now)",
    )


def _convention_finding(kind: str, convention: PoseConvention) -> Finding:
    """Return the finding about the convention of the poses."""
    turn = convention.offset
    offset = f" and add {turn} deg to its offset" if turn else ""
    if kind == "heading_offset":
        found = f"the heading of the poses is turned by {-turn} deg against the body"
        return Finding(kind, found, f"add {turn} deg to the offset of the channel pose_heading")
    if kind == "heading_unit":
        unit, other = ("deg", "rad") if convention.heading == "degrees" else ("rad", "deg")
        found = f"the heading of the poses is in {unit}, but is declared in {other}"
        return Finding(kind, found, f"set unit = '{unit}' for the channel pose_heading")
    remedy = {
        "heading_quaternion": "log the yaw, 2 atan2(qz, qw), and name its column in the channel "
        "pose_heading",
        "heading_sign": f"turn the sign of scale for the channel pose_heading{offset}",
        "pose_axis": "turn the sign of scale for the channel pose_"
        + ("x" if abs(turn) == 180 else "y"),
        "pose_swapped": "exchange the columns of the channels pose_x and pose_y",
        "pose_mirrored": "turn the sign of scale for the channels pose_y and pose_heading (or of "
        f"pose_x and pose_heading, with 180 deg more in its offset){offset}",
    }[kind]
    return Finding(kind, _CONVENTION_SENTENCES[kind], remedy)


def cause_findings(
    fitting: Sequence[ScaleCause], single: bool, why: str, gear_ratio: float
) -> tuple[Finding, ...]:
    """Return findings about wrong factors: the likeliest with alternatives, or both of a pair.

    Args:
        fitting: causes that fit, the likeliest first.
        single: whether each of them fits alone.
        why: sentence about the ratios that are out of range.
        gear_ratio: gear ratio of the declared robot.
    """
    if not fitting:
        return ()
    if not single:
        return tuple(_factor_finding(one, gear_ratio).explained(why) for one in fitting)
    first, *others = (_factor_finding(one, gear_ratio) for one in fitting)
    likely = [
        other
        for other, cause in zip(others, fitting[1:], strict=True)
        if cause.common == fitting[0].common and other.kind != first.kind
    ]
    return (first.explained(why, likely[:2]),)


def ratio_sentence(scales: ScaleRatios) -> str:
    """Return a sentence about the ratios that are out of range."""
    sentences = {
        "travel": "the body's path length is {:.3g} times that of the wheels",
        "turning": "the body turns {:.3g} times as much as the wheels",
        "drive": "the commanded motion is {:.3g} times what the wheels did",
        "steer": "the commanded turn is {:.3g} times what the wheels did",
        "command": "the commanded wheel speeds are {:.3g} times the measured ones",
        "report": "the reported wheel speeds are {:.3g} times what the encoders say",
        "gyro": "the gyro turns {:.3g} times as much as the poses",
    }
    unnatural = {k: r.value for k, r in scales.known.items() if not r.natural}
    return ", ".join(sentences[k].format(value) for k, value in unnatural.items())


def _factor_finding(of: ScaleCause, gear_ratio: float) -> Finding:
    """Return the finding about a factor by which a channel is too large."""
    name, kind = of.name, _CAUSE_KINDS[of.name]
    size = of.factor if of.factor > 1 else 1 / of.factor
    much = f"{size:.3g} times too " + ("large" if of.factor > 1 else "small")
    if name == "time":
        unit = _unit_name(of.factor, {1e3: "ms", 1e6: "us", 1e9: "ns", 60.0: "s", 1e-3: "s"})
        to = f"set unit = '{unit}' for the channel time" if unit else "correct the unit of time"
        return Finding(kind, f"time is in another unit, {much}", to)
    if name == "pose_length":
        unit = _unit_name(of.factor, {1e3: "mm", 1e2: "cm", 1e-3: "m", 1e-2: "m"})
        to = f"set unit = '{unit}' for the channels" if unit else "correct the unit or scale of"
        remedy = f"{to} pose_x and pose_y (scale = {1 / of.factor:.3g})"
        return Finding(kind, f"the poses' lengths are {much}", remedy)
    if name == "heading":
        unit = "deg" if of.factor > 1 else "rad"
        remedy = f"set unit = '{unit}' for the channel pose_heading"
        return Finding(kind, f"the heading is {much}", remedy)
    if name in ("wheel_gear", "wheel_turns"):
        return Finding(kind, f"the wheels' turns are {much}", _turns(of.factor, gear_ratio))
    if name == "wheel_radius":
        return Finding(
            kind,
            f"wheel_radius_m is {much}, or the wheels' turns are",
            f"divide wheel_radius_m in [robot] by {of.factor:.3g}, or "
            + _turns(of.factor, gear_ratio),
        )
    if name == "base":
        return Finding(
            kind,
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
    return Finding(
        kind,
        f"the channel {channel} is {much}",
        f"correct unit or scale of the channel {channel}{_unit_of_rate(of.factor)} "
        f"(scale = {1 / of.factor:.3g})",
    )


def _turns(factor: float, gear_ratio: float) -> str:
    """Return the remedy for wheel turns that are too large by a factor."""
    remedies = [f"multiply ticks_per_revolution or the layout's gear_ratio by {factor:.3g}"]
    if gear_ratio > 1.5 and isclose(1 / factor, gear_ratio, rel_tol=0.02):
        remedies = [
            "set gear_ratio = 1 in the layout, if the encoder is at the wheel, not the motor"
        ]
    elif gear_ratio > 1.5 and isclose(factor, gear_ratio, rel_tol=0.02):
        remedies = [f"set gear_ratio = {gear_ratio:g} in the layout: the encoder is at the motor"]
    if unit := _unit_of_rate(factor):
        remedies.append("correct the unit, if wheels are logged as speeds or angles" + unit)
    return ", or ".join(remedies)


def _unit_of_rate(factor: float) -> str:
    """Return which units were confused if a factor is their ratio, else an empty text."""
    names = {
        30 / pi: ": 'rpm' was taken for 'rad/s'",
        pi / 30: ": 'rad/s' was taken for 'rpm'",
        180 / pi: ": degrees were taken for radians",
        pi / 180: ": radians were taken for degrees",
        1 / (2 * pi): ": revolutions were taken for radians",
        2 * pi: ": radians were taken for revolutions",
        1000.0: ": thousandths were taken for the whole",
    }
    return _unit_name(factor, names)


def _unit_name(factor: float, names: Mapping[float, str]) -> str:
    """Return the name that belongs to a factor, else an empty text."""
    return next((name for f, name in names.items() if isclose(f, factor, rel_tol=1e-3)), "")
