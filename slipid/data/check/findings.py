"""Findings of the check, and their texts.

A finding describes what is wrong or could not be checked, and which key of the config to change.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isclose, pi
from typing import Literal

from slipid.data.check.joined import PoseConvention
from slipid.data.check.mistakes import Candidate, Mistake
from slipid.data.check.ratios import QUANTITIES, ScaleCause, ScaleRatio
from slipid.data.log import WheelReading
from slipid.support.content import Content

Severity = Literal["wrong", "suspicious", "note"]
"""Severity of a finding: `wrong` must be corrected before a fit, `suspicious` may be correct but
should be examined, `note` reports what could not be checked."""
SEVERITIES: tuple[Severity, ...] = ("wrong", "suspicious", "note")
LEAST_PATH_M = 0.2
"""A run is judged if the path length by the wheels exceeds this, since its poses must then move
[m]."""
ROUNDING_M = 1e-6
"""Poses with a path shorter than this are constant, except for rounding [m]."""
MOST_NAMED_RUNS = 4
"""Largest number of runs that a sentence names; further runs are only counted."""


@dataclass(frozen=True)
class Finding:
    """One thing that the check found in the runs.

    Attributes:
        kind: name of the kind of finding, such as `wheel_sign`; module `sanity` lists all kinds.
        found: description of what is wrong, with numbers.
        remedy: the key to change and its new value, as a sentence; or None.
        severity: severity of the finding.
        runs: names of the runs concerned; empty if all are.
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
        """Return the finding with its evidence and with alternative remedies.

        Args:
            how: evidence, which is appended to the description of what is wrong.
            others: alternative findings that explain the logs equally well, whose remedies are
                appended to the remedy.
        """
        more = "".join(f"; or, which explains these logs equally well: {o.remedy}" for o in others)
        return replace(self, found=f"{self.found}: {how}", remedy=f"{self.remedy}{more}")

    def to_json(self) -> Content:
        """Return the finding as an object of check.json."""
        return asdict(self) | {"runs": list(self.runs)}


def listed(names: Sequence[str]) -> str:
    """Return a string with the first `MOST_NAMED_RUNS` names and the number of further names."""
    more = len(names) - MOST_NAMED_RUNS
    return ", ".join(names[:MOST_NAMED_RUNS]) + (f" and {more} more" if more > 0 else "")


def by_reason(lines: Iterable[str]) -> list[str]:
    """Return lines, in which those of the form `set aside: RUN: REASON` come first, one a reason.

    The first runs with the reason are named, and the others are counted.
    """
    runs: dict[str, list[str]] = {}
    others = []
    for line in lines:
        if aside := re.fullmatch("set aside: (.+?): (.+)", line):
            runs.setdefault(aside[2], []).append(aside[1])
        else:
            others.append(line)
    counts = {r: f"{len(n)} runs ({listed(n)})" if len(n) > 1 else n[0] for r, n in runs.items()}
    return [*(f"set aside: {names}: {reason}" for reason, names in counts.items()), *others]


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings in order of severity, those that forbid a fit first."""
    return tuple(sorted(findings, key=lambda f: SEVERITIES.index(f.severity)))


def wrong(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings that forbid a fit."""
    return tuple(f for f in findings if f.severity == "wrong")


NOT_CALIBRATED = frozenset(
    (
        *(
            "no_motion",
            "wheel_constant",
            "position_constant",
            "wheels_exchanged",
            "wheel_sign",
            "wheel_order",
            "wheel_azimuths",
            "wheel_columns",
        ),
        *("heading_constant", "heading_sign", "heading_unit", "heading_offset"),
        *("heading_quaternion", "pose_axis", "pose_swapped", "pose_mirrored", "pose_constant"),
        *("pose_of_another_run", "pose_unexplained", "steering_sign"),
    )
)
"""Kinds of findings about order, signs, axes and missing motion, with which calibrated lengths
would be meaningless."""


LEAST_TURN_RAD, ROUNDING_RAD = 0.5, 1e-6
"""A run's heading is judged if the wheels turn the robot by more than the first angle, and is
constant if its range is below the second one [rad]."""


def heading_constant(turned: float, runs: Sequence[str], count: int) -> Finding:
    """Return the finding that the heading of the poses never changes in runs that turn.

    Args:
        turned: usual range of the heading that the wheels turn the robot by in such a run [rad].
        runs: names of these runs.
        count: number of all runs.
    """
    return Finding(
        "heading_constant",
        f"the heading of the poses never changes in {len(runs)} of {count} runs, although the "
        f"wheels turn the robot by {turned:.2g} rad",
        "check that the channel pose_heading names the column of the heading; if no heading was "
        "measured, remove pose_heading from the layout, since positions alone suffice",
        runs=() if len(runs) == count else tuple(runs),
    )


_CONVENTION_SENTENCES = {
    "heading_sign": "the heading of the poses turns in the opposite direction of the body",
    "pose_axis": "an axis of the poses has the wrong sign",
    "pose_swapped": "x and y of the poses are exchanged",
    "pose_mirrored": "the poses are mirrored, as if seen from below or with y pointing down",
    "heading_quaternion": "the heading is the z of a quaternion, sin(yaw / 2), not an angle",
}


def mistake_finding(mistake: Mistake) -> Finding:
    """Return the finding about a mistake in order, signs or axes, with at most two alternatives."""
    how = (
        f"with this correction {mistake.after:.2f} of the motion remains unexplained, instead of "
        f"{mistake.before:.2f} as declared"
    )
    return _candidate_finding(mistake.found).explained(
        how, map(_candidate_finding, mistake.others[:2])
    )


def _candidate_finding(candidate: Candidate) -> Finding:
    """Return the finding about the mistake in order, signs or axes that a candidate corrects."""
    kind, meant = candidate.kind, candidate.meant
    if kind == "wheel_sign":
        return _sign_finding(kind, meant.sign, "")
    if kind == "command_sign" and meant.command_sign:
        return _sign_finding(kind, meant.command_sign, "commanded ")
    if kind == "command_sign":
        axes = [a for a, s in zip(("x", "y", "yaw"), meant.twist_sign, strict=True) if s < 0]
        found = f"the commanded twist has the wrong sign in {' and '.join(axes)}"
        channels = " and ".join(f"the channel twist_command_{axis}" for axis in axes)
        return Finding(kind, found, f"reverse the sign of scale for {channels}")
    if kind == "wheel_order":
        return _order_finding(kind, meant.order, "the wheels' columns")
    if kind == "command_order":
        return _order_finding(kind, meant.command_order, "the columns of the commanded speeds")
    if kind == "wheel_azimuths":
        return Finding(
            kind,
            f"the wheels are rotated by {meant.azimuth:+d} deg about the centre from the declared "
            "directions",
            f"add {meant.azimuth} deg to wheel_azimuths_deg (or to wheel_places_m and "
            "drive_directions_deg) in [robot]",
        )
    if kind == "gyro_sign":
        remedy = "reverse the sign of scale for the channel gyro"
        return Finding(kind, "the gyro turns in the opposite direction of the poses", remedy)
    return _convention_finding(kind, meant.convention)


def _sign_finding(kind: str, sign: Sequence[int], commanded: str) -> Finding:
    """Return the finding about wheels whose turns or commanded turns have the wrong sign.

    `commanded` is the text before the word "rotation" in the finding: "commanded ", or empty.
    """
    turned = [str(k + 1) for k, s in enumerate(sign) if s < 0]
    wheels = f"wheel{'s' if len(turned) > 1 else ''} {' and '.join(turned)}"
    column = "their columns" if len(turned) > 1 else "its column"
    if len(turned) == len(sign):
        wheels, column = "every wheel", "the channel of the wheels"
    return Finding(
        kind,
        f"the {commanded}rotation of {wheels} has the opposite sign of the motion",
        f"reverse the sign of scale for {column}{' in the commanded speeds' if commanded else ''} "
        "(scale = -1 if no scale is set)",
    )


def _order_finding(kind: str, order: Sequence[int], columns: str) -> Finding:
    """Return the finding that columns are in a wrong order; `columns` describes them in words."""
    listed = ", ".join(str(k + 1) for k in order)
    if len(order) == 2:
        return Finding(
            kind,
            f"left and right seem to be exchanged in {columns}",
            "exchange the two columns in the layout: [left, right] becomes [right, left]",
        )
    return Finding(
        kind,
        f"{columns} are in another order than the wheels of [robot]",
        f"list the columns in the order {listed} (numbers of their present positions)",
    )


def _convention_finding(kind: str, convention: PoseConvention) -> Finding:
    """Return the finding about poses that follow another convention than declared."""
    turn = convention.offset
    offset = f" and add {turn} deg to its offset" if turn else ""
    if kind == "heading_offset":
        found = f"the heading of the poses is rotated by {-turn} deg relative to the body"
        return Finding(kind, found, f"add {turn} deg to the offset of the channel pose_heading")
    if kind == "heading_unit":
        unit, other = ("deg", "rad") if convention.heading == "degrees" else ("rad", "deg")
        found = f"the heading of the poses is in {unit}, but is declared in {other}"
        return Finding(kind, found, f"set unit = '{unit}' for the channel pose_heading")
    remedy = {
        "heading_quaternion": "log the yaw, 2 atan2(qz, qw), and name its column in the channel "
        "pose_heading",
        "heading_sign": f"reverse the sign of scale for the channel pose_heading{offset}",
        "pose_axis": "reverse the sign of scale for the channel pose_"
        + ("x" if abs(turn) == 180 else "y"),
        "pose_swapped": "exchange the columns of the channels pose_x and pose_y",
        "pose_mirrored": "reverse the sign of scale for pose_y and pose_heading (or for pose_x and "
        f"pose_heading, with 180 deg added to the offset){offset}",
    }[kind]
    return Finding(kind, _CONVENTION_SENTENCES[kind], remedy)


def ticks_finding(
    ticks: float | None, scales: Mapping[str, ScaleRatio], reading: WheelReading
) -> Finding:
    """Return the finding that angles of the wheels, declared in radians, are ticks.

    Args:
        ticks: ticks per radian as logged, divided by the gear ratio of a motor's angle; None if
            nothing was logged that tells it.
        scales: ratios by name.
        reading: what the angles were computed from.
    """
    remedy = (
        f"name the columns in the channel wheel_ticks instead of {reading.channel}, with unit = "
        "'tick', and give ticks_per_revolution, the ticks in a turn of the motor shaft"
    )
    found = f"the channel {reading.channel} has whole numbers only, as ticks have, not radians"
    if ticks is None:
        return Finding("wheel_ticks", found, remedy, "suspicious")
    per_rad = ticks * reading.divided_by
    per_turn = 2 * pi * per_rad / reading.gear_ratio
    return Finding(
        "wheel_ticks",
        f"positions look like ticks (about {_rounded(per_rad)} per rad of wheel): {found}, and "
        f"{ratio_sentence(scales)}",
        f"{remedy} (about {_rounded(per_turn)} with the layout's gear_ratio = "
        f"{reading.gear_ratio:g})",
    )


def _rounded(value: float) -> str:
    """Return a number with three digits that count, without an exponent."""
    return f"{float(f'{value:.3g}'):.10g}"


def cause_findings(
    fitting: Sequence[ScaleCause],
    single: bool,
    scales: Mapping[str, ScaleRatio],
    gear_ratio: float,
    reading: WheelReading,
) -> tuple[Finding, ...]:
    """Return findings about wrong factors, from ratios outside their ranges.

    If single causes explain the ratios, the likeliest one is the finding and the other causes are
    alternatives in its text; if only two causes together explain the ratios, both are findings.

    Args:
        fitting: causes that explain the ratios, the likeliest first.
        single: True if each of these causes explains all ratios without another cause.
        scales: ratios by name.
        gear_ratio: gear ratio of the declared robot.
        reading: what the wheels' angle was computed from.
    """
    why = ratio_sentence(scales)
    if not fitting:
        found = Finding(
            "scales",
            "the channels disagree about the motion, and neither one nor two wrong factors explain "
            f"this: {why}",
            "check the units of all channels, gear_ratio, wheel_radius_m and base_radius_m",
        )
        return (found,) if why else ()
    if not single:
        return tuple(_factor_finding(one, gear_ratio, reading).explained(why) for one in fitting)
    first, *others = (_factor_finding(one, gear_ratio, reading) for one in fitting)
    likely = [
        other
        for other, cause in zip(others, fitting[1:], strict=True)
        if cause.common == fitting[0].common and other.kind != first.kind
    ]
    return (first.explained(why, likely[:2]),)


def ratio_sentence(known: Mapping[str, ScaleRatio]) -> str:
    """Return a sentence with the value of every ratio that is outside its range."""
    sentences = {
        "travel": "the body's path length is {:.3g} times that of the wheels",
        "turning": "the rotation of the body is {:.3g} times that computed from the wheels",
        "drive": "the commanded motion is {:.3g} times that of the wheels",
        "steer": "the commanded rotation is {:.3g} times that of the wheels",
        "command": "the commanded wheel speeds are {:.3g} times the measured ones",
        "report": "the reported wheel speeds are {:.3g} times those of the encoders",
        "gyro": "the rotation measured by the gyro is {:.3g} times that of the poses",
    }
    return ", ".join(sentences[k].format(r.value) for k, r in known.items() if not r.natural)


def _factor_finding(cause: ScaleCause, gear_ratio: float, reading: WheelReading) -> Finding:
    """Return the finding about a quantity that is too large or too small by a factor."""
    factor, (kind, channel, *_) = cause.factor, QUANTITIES[cause.name]
    ratio = f"{max(factor, 1 / factor):.3g}"
    size = f"{ratio} times too {'large' if factor > 1 else 'small'}"
    found = f"{channel} is {size}"
    if cause.name == "time":
        unit = _unit_name(factor, {1e3: "ms", 1e6: "us", 1e9: "ns", 60.0: "s", 1e-3: "s"})
        remedy = f"set unit = '{unit}' for the channel time" if unit else "correct the unit of time"
        found = f"time is in another unit than declared: it is {size}"
    elif cause.name == "pose_length":
        unit = _unit_name(factor, {1e3: "mm", 1e2: "cm", 1e-3: "m", 1e-2: "m"})
        to = f"set unit = '{unit}' for the channels" if unit else "correct the unit or scale of"
        remedy = f"{to} pose_x and pose_y (scale = {1 / factor:.3g})"
    elif cause.name == "heading":
        remedy = f"set unit = '{'deg' if factor > 1 else 'rad'}' for the channel pose_heading"
    elif cause.name == "wheel_radius":
        found = f"wheel_radius_m is {size}, or the rotation of the wheels is"
        turns = _turns(factor, gear_ratio, reading)
        remedy = f"divide wheel_radius_m in [robot] by {factor:.3g}, or {turns}"
    elif kind == "wheel_scale":
        remedy = f"{_turns(factor, gear_ratio, reading)}, or correct wheel_radius_m in [robot]"
    elif cause.name == "base":
        found = (
            f"{channel} is {'more' if factor > 1 else 'less'} than declared, by a factor of {ratio}"
        )
        remedy = (
            "correct base_radius_m (or track_m, half_width_m, half_length_m, wheel_places_m) of "
            "[robot]"
        )
    else:
        unit = _unit_of_rate(factor)
        remedy = f"correct unit or scale of {channel}{unit} (scale = {1 / factor:.3g})"
    return Finding(kind, found, remedy)


def _turns(factor: float, gear_ratio: float, reading: WheelReading) -> str:
    """Return the remedy for a logged rotation of the wheels that is too large by a factor.

    A gear ratio that the layout has already is not advised.
    """
    geared = isclose(reading.divided_by, gear_ratio, rel_tol=0.02)
    of_wheel = reading.channel in ("wheel_angle", "wheel_speed")
    remedies = [f"multiply ticks_per_revolution or the layout's gear_ratio by {factor:.3g}"]
    if of_wheel:
        remedies = [f"correct unit or scale of {reading.channel} (scale = {1 / factor:.3g})"]
    elif reading.channel.startswith("motor"):
        remedies = [f"multiply the layout's gear_ratio by {factor:.3g}"]
    forgotten = gear_ratio > 1.5 and isclose(factor, gear_ratio, rel_tol=0.02)
    if forgotten and of_wheel:
        other = reading.channel.replace("wheel", "motor")
        remedies = [
            f"name the columns in the channel {other} instead of {reading.channel}, with "
            f"gear_ratio = {gear_ratio:g} in the layout: the encoder is at the motor"
        ]
    elif forgotten and not geared:
        remedies = [f"set gear_ratio = {gear_ratio:g} in the layout: the encoder is at the motor"]
    elif (
        (geared or not reading.channel)
        and gear_ratio > 1.5
        and isclose(1 / factor, gear_ratio, rel_tol=0.02)
    ):
        remedies = [
            "set gear_ratio = 1 in the layout, if the encoder is at the wheel, not the motor"
        ]
    if unit := _unit_of_rate(factor):
        remedies.append("correct the unit, if wheels are logged as speeds or angles" + unit)
    return ", or ".join(remedies)


def _unit_of_rate(factor: float) -> str:
    """Return a note on two confused units if the factor is their ratio, else an empty string."""
    names = {
        30 / pi: ": 'rpm' was taken for 'rad/s'",
        pi / 30: ": 'rad/s' was taken for 'rpm'",
        180 / pi: ": degrees were taken for radians",
        pi / 180: ": radians were taken for degrees",
        1 / (2 * pi): ": revolutions were taken for radians",
        2 * pi: ": radians were taken for revolutions",
        1000.0: ": thousandths of the unit were taken for the whole unit",
    }
    return _unit_name(factor, names)


def _unit_name(factor: float, names: Mapping[float, str]) -> str:
    """Return the value in `names` whose key equals the factor within 0.1 %, else ""."""
    return next((name for f, name in names.items() if isclose(f, factor, rel_tol=1e-3)), "")
