"""Ratios between the motion in different channels, their natural ranges, and wrong factors.

travel      translation of the body by poses over that by wheels; below 1 if wheels slip
turning     rotation of the body by poses over that by wheels
drive       commanded translation over that by wheels
steer       commanded rotation over that by wheels
command     commanded wheel speeds over measured ones
report      reported wheel speeds over those of the encoders
gyro        rotation by the gyro over that of the poses

A cause, such as a wrong unit, multiplies ratio i by factor^e_i, where the exponents e_i are known
and the factor is not. The cause explains the ratios if some factor brings all of them into their
natural ranges, that is, if ratio_i / factor^e_i lies between low_i and high_i for every i:

    max_i  log(ratio_i / high_i) / e_i   <=   log factor   <=   min_i  log(ratio_i / low_i) / e_i

(with low and high exchanged where e_i < 0). Of the causes that explain the ratios, those whose
factor is a common error, such as 1000, 2 pi, 57.3 or the gear ratio, are preferred.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import exp, inf, isclose, log, pi
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from slipid.data.check.interpretation import Evidence, Interpretation, to_body
from slipid.data.check.joined import (
    ChannelIncrements,
    JoinedRuns,
    Products,
    StepEdges,
    body_motion,
    rotation,
    usable,
)
from slipid.data.log import WheelReading

LEAST_TURNING = 0.01
"""Least fraction of rotation in the predicted motion for which rotations are compared [1]."""
LEAST_TRANSLATION = 0.02
"""Least fraction of translation in the predicted motion for which translations are compared [1]."""
SAME_DATA = 1e-6
"""Relative difference between the wheels' angle and their integrated speed below which the angle
must have been computed from the speed [1]."""

_Range = tuple[float, float, float]
"""Least, usual and largest natural value of a ratio [1]."""
_WIDE: Mapping[str, _Range] = {
    # The lower end is small because a robot may slip in place on carpet. If no command confirms the
    # motion of the wheels, `_UNVOUCHED` replaces this range. The upper end allows for a camera
    # scale that is wrong by an eighth.
    "travel": (0.012, 0.8, 1.35),
    "turning": (0.35, 0.8, 1.35),
    # The upper ends are large because commands exceed the motion if brakes or limits act.
    "drive": (0.65, 1.1, 1.75),
    "steer": (0.65, 1.1, 1.75),
    "command": (0.7, 1.1, 1.75),
    "report": (0.8, 1.0, 1.25),
    "gyro": (0.75, 1.0, 1.33),
}
_UNVOUCHED: _Range = (0.3, 0.8, 1.35)
"""Natural range of `travel` if no command was logged to confirm the motion of the wheels."""
_SCRUBBING: Mapping[str, _Range] = {"turning": (0.25, 0.55, 1.15), "steer": (0.4, 1.3, 3.2)}
"""Natural ranges for robots whose wheels cannot roll sideways: they turn less than their wheel
speeds and track predict, and their drivers command more rotation to make up for it."""


@dataclass(frozen=True)
class ScaleRatio:
    """One ratio [1], with its natural range from `low` to `high` and its usual value."""

    value: float
    low: float
    usual: float
    high: float

    @property
    def natural(self) -> bool:
        """Return whether the ratio is in its range."""
        return self.low <= self.value <= self.high


def ratios(
    data: JoinedRuns,
    at: StepEdges,
    moved: ChannelIncrements,
    evidence: Evidence,
    meant: Interpretation,
) -> tuple[dict[str, ScaleRatio], bool]:
    """Return the ratios under an interpretation whose order, signs and axes are right.

    Ratios that cannot be computed are omitted. The second result is True if the wheels' angle is
    the integral of the reported speeds, in which case the ratio `report` is omitted, too.
    """
    values: dict[str, float | None] = {}
    predict = to_body(evidence, meant)
    pose = evidence.pose.get(meant.convention.bare)
    if pose is not None:
        values["travel"], values["turning"] = _along(
            pose, predict, rotation(-meant.convention.offset)
        )
        values["gyro"] = _gyro(at, moved, pose, meant)
    if evidence.twist is not None:
        signs = np.diag(np.array(meant.twist_sign, float))
        values["drive"], values["steer"] = _along(evidence.twist, predict, signs)
    if evidence.command is not None:
        values["command"] = evidence.command.product(meant) / evidence.command.turns
    values["report"], same = _reported(data)
    wide = dict(_WIDE)
    if values.get("drive") is None and values.get("command") is None:
        wide["travel"] = _UNVOUCHED
    if not evidence.free:
        wide.update(_SCRUBBING)
    known = {k: ScaleRatio(v, *wide[k]) for k, v in values.items() if v is not None and v > 0}
    return known, same


def _along(
    sums: Products, predict: Float[np.ndarray, "3 wheel"], axes: Float[np.ndarray, "3 3"]
) -> tuple[float | None, float | None]:
    """Return least-squares ratios of measured to predicted motion, for translation and rotation.

    A ratio is None if there is too little motion to compute it. The matrix `axes` maps the axes of
    the measured body increments to the true axes.
    """
    predicted, both = sums.predicted(predict), sums.matched(predict, axes)
    total = predicted.sum()
    if not total > 0:
        return None, None
    ahead, about = predicted[:2].sum(), predicted[2]
    along = float(both[:2].sum() / ahead) if ahead > LEAST_TRANSLATION * total else None
    # Rotations due to slip may hide small predicted rotations, so a correlation of 0.5 is required.
    turns = about > LEAST_TURNING * total and both[2] ** 2 > 0.25 * about * sums.body[2, 2]
    return along, float(both[2] / about) if turns else None


def _gyro(
    at: StepEdges, moved: ChannelIncrements, pose: Products, meant: Interpretation
) -> float | None:
    """Return the ratio of rotation by the gyro to that of the poses.

    The ratio is None if there is no gyro, or if gyro and heading have a correlation below 0.5.
    """
    if moved.gyro is None:
        return None
    body = body_motion(at, meant.convention.bare)[pose.known, 2]
    gyro = meant.gyro_sign * moved.gyro[pose.known, 0]
    known = np.isfinite(gyro)
    weight, body, gyro = pose.weight[known], body[known], gyro[known]
    gyro_square, both, pose_square = (
        (weight * a * b).sum() for a, b in ((gyro, gyro), (gyro, body), (body, body))
    )
    if not gyro_square * pose_square > 0 or both < 0.5 * np.sqrt(gyro_square * pose_square):
        return None
    return float(np.sqrt(gyro_square / pose_square))


def _reported(data: JoinedRuns) -> tuple[float | None, bool]:
    """Return the ratio of reported to encoder wheel speeds, and whether they are the same data.

    Both are the same data if the wheel angle is the integral of the reported speed. The ratio is
    None in this case, and also if no speeds were reported or no wheel turns.
    """
    if "wheel_speed" not in data.channels:
        return None, False
    edges = [data.begin, 0.5 * (data.begin + data.end), data.end]
    reported, turned = (
        np.concatenate([channel.at(edge) - channel.at(edges[0]) for edge in edges[1:]])
        for channel in (data.channels["wheel_speed"], data.angle)
    )
    known = usable(reported, turned)
    reported, turned = reported[known], turned[known]
    total = float((turned**2).sum())
    if not total > 0:
        return None, False
    same = float(((reported - turned) ** 2).sum()) < SAME_DATA**2 * total
    return None if same else float(np.abs(reported * turned).sum()) / total, same


MARGIN = 0.02
"""Margin in the logarithm by which a common factor may lie outside the range of factors that
explain the ratios [1]."""
USUAL_ROW_S = (0.001, 1.5)
"""Range of the time between rows in which the unit of time is not suspected [s]."""


class ScaledQuantity(NamedTuple):
    """A quantity that may be wrong by a factor.

    Attributes:
        kind: kind of the finding about it.
        text: name of the quantity in the text of the finding.
        powers: exponent of the factor in every ratio that the factor changes, keyed by the name of
            the ratio; a factor above 1 means that the values of the quantity's channels are too
            large.
        common: factors that are common errors, such as ratios of units; their inverses are common
            errors as well.
    """

    kind: str
    text: str
    powers: Mapping[str, float]
    common: tuple[float, ...]


_ANGLE = "the angle of the wheels"
_OF_WHEELS = {"travel": -1.0, "turning": -1.0, "drive": -1.0, "steer": -1.0}
_OF_TURNS = _OF_WHEELS | {"command": -1.0, "report": -1.0}
_OF_TIME = {"drive": 1.0, "steer": 1.0, "command": 1.0, "gyro": 1.0, "report": 1.0}
_OF_BASE = {"turning": 1.0, "steer": 1.0}
_RATES = (30 / pi, 180 / pi, 2 * pi, 1e3, 10.0)
QUANTITIES: Mapping[str, ScaledQuantity] = {
    "time": ScaledQuantity("time_unit", "time", _OF_TIME, (1e3, 1e6, 1e9, 60.0)),
    "pose_length": ScaledQuantity(
        "pose_length", "the scale of the poses", {"travel": 1.0}, (1e3, 1e2, 10.0, 25.4)
    ),
    "heading": ScaledQuantity(
        "heading_unit", "the heading", {"turning": 1.0, "gyro": -1.0}, (180 / pi,)
    ),
    "wheel_gear": ScaledQuantity(
        "wheel_scale", _ANGLE, _OF_WHEELS | {"command": -1.0}, (2.0, 4.0, 2 * pi, 180 / pi, 1e3)
    ),
    "wheel_turns": ScaledQuantity(
        "wheel_scale", _ANGLE, _OF_TURNS, (2.0, 4.0, 10.0, 2 * pi, 180 / pi, 1e3)
    ),
    "wheel_radius": ScaledQuantity(
        "wheel_scale", "wheel_radius_m", _OF_WHEELS, (2.0, 10.0, 1e2, 1e3, 25.4)
    ),
    "base": ScaledQuantity(
        "base_radius", "the distance of the wheels from the centre", _OF_BASE, (2.0, 10.0, 1e2, 1e3)
    ),
    "gyro": ScaledQuantity("gyro_unit", "the channel gyro", {"gyro": 1.0}, (180 / pi, 1e3)),
    "report": ScaledQuantity(
        "wheel_speed_unit", "the channel wheel_speed (or motor_speed)", {"report": 1.0}, _RATES
    ),
    "command_wheels": ScaledQuantity(
        "command_unit",
        "the channel wheel_speed_command (or motor_speed_command)",
        {"command": 1.0},
        _RATES,
    ),
    "command_twist": ScaledQuantity(
        "command_unit",
        "the pair of channels twist_command_x and twist_command_y",
        {"drive": 1.0},
        (1e3, 1e2, 10.0),
    ),
    "command_yaw": ScaledQuantity(
        "command_unit", "the channel twist_command_yaw", {"steer": 1.0}, (180 / pi, 1e3, 2 * pi)
    ),
}
"""Quantities by name, the likeliest to be wrong first."""
_WHEEL_SCALES = {name for name, one in QUANTITIES.items() if one.kind == "wheel_scale"}
_BY_GEAR = ("wheel_gear", "wheel_turns", "command_wheels", "report")
"""Quantities for which the gear ratio is a common factor as well."""


class ScaleCause(NamedTuple):
    """A quantity that is wrong by a factor, as a possible cause of ratios outside their ranges.

    Attributes:
        name: name of the quantity in `QUANTITIES`.
        factor: factor by which the quantity, or the values of its channels, are too large [1].
        common: True if the factor is a common error, such as 1000.
    """

    name: str
    factor: float
    common: bool


_NEAR_UNIT = log(1.4)
"""Largest logarithm of a ratio by which a reported speed may differ from that of the wheels, in
some unit, for the number of ticks per radian to follow from it [1]."""


def ticks_per_radian(known: Mapping[str, ScaleRatio]) -> float | None:
    """Return the ticks per radian of the wheels if their angle is in ticks; None if in radians.

    The number follows from the motion of the body, and is refined by the reported speeds, which do
    not depend on slip.
    """
    of_wheels = [known[name] for name in _OF_WHEELS | {"command": 0} if name in known]
    if not of_wheels or all(ratio.natural for ratio in of_wheels):
        return None
    ticks = 1.0 / of_wheels[0].value
    if "report" in known:
        likely = ticks * of_wheels[0].usual
        units = [1.0, *_RATES, *(1 / rate for rate in _RATES)]
        apart = {unit: abs(log(known["report"].value * likely / unit)) for unit in units}
        unit = min(units, key=lambda unit: apart[unit])
        if apart[unit] < _NEAR_UNIT:
            ticks = unit / known["report"].value
    return ticks


def without_factor(
    known: Mapping[str, ScaleRatio], powers: Mapping[str, float], factor: float
) -> dict[str, ScaleRatio]:
    """Return the ratios as they are once a quantity with these powers is divided by a factor."""
    return {
        name: replace(r, value=r.value / factor ** powers.get(name, 0.0))
        for name, r in known.items()
    }


def single_causes(
    known: Mapping[str, ScaleRatio],
    speed_is_angle: bool,
    row_s: float,
    gear_ratio: float,
    reading: WheelReading,
) -> tuple[tuple[ScaleCause, ...], bool]:
    """Return the causes that explain the ratios, the likeliest first, and whether one suffices.

    If no single cause explains all ratios, the first pair of causes that does so is returned. There
    are no causes if every ratio is natural, or if no pair of causes explains the ratios.

    Args:
        known: ratios by name.
        speed_is_angle: True if the wheels' angle was integrated from their speeds.
        row_s: median time between rows [s].
        gear_ratio: declared gear ratio.
        reading: what the wheels' angle was computed from.
    """
    if all(r.natural for r in known.values()):
        return (), True
    possible = _possible(speed_is_angle, gear_ratio, reading)
    if USUAL_ROW_S[0] <= row_s <= USUAL_ROW_S[1]:
        del possible["time"]
    if single := _singles(known, possible):
        return tuple(sorted(single, key=lambda e: not e.common)), True
    for first, quantity in possible.items():
        for factor in quantity.common:
            left = without_factor(known, quantity.powers, factor)
            # Two wrong factors of the wheels' angle, or of angle and radius, would be one.
            twice = {first} if quantity.kind != "wheel_scale" else _WHEEL_SCALES
            rest = {name: other for name, other in possible.items() if name not in twice}
            if second := [e for e in _singles(left, rest) if e.common]:
                return (ScaleCause(first, factor, True), second[0]), False
    return (), False


def _possible(
    speed_is_angle: bool, gear_ratio: float, reading: WheelReading
) -> dict[str, ScaledQuantity]:
    """Return the quantities by name, with all their common factors.

    The arguments are those of `single_causes`. The gear ratio is no common factor of the wheels'
    angle where the layout has divided by it already, and its inverse only where it has.
    """
    found = dict(QUANTITIES)
    if speed_is_angle:
        integrated = {"travel": -1.0, "turning": -1.0, "gyro": 1.0}
        found["time"] = found["time"]._replace(powers=integrated)
        of_rates = (30 / pi, 180 / pi, 2 * pi, 1000.0, 60.0)
        found["wheel_gear"] = found["wheel_gear"]._replace(common=of_rates)
    for name, quantity in found.items():
        both = tuple(f for one in quantity.common for f in (one, 1 / one))
        gear: tuple[float, ...] = ()
        if name in _BY_GEAR and gear_ratio > 1.5:
            gear = (gear_ratio, 1 / gear_ratio)
        if gear and name in _WHEEL_SCALES and reading.channel:
            gear = gear[1:] if isclose(reading.divided_by, gear_ratio) else gear[:1]
        found[name] = quantity._replace(common=(*gear, *both))
    return found


def _singles(
    known: Mapping[str, ScaleRatio], possible: Mapping[str, ScaledQuantity]
) -> list[ScaleCause]:
    """Return the causes that explain all ratios by themselves, each with its likeliest factor."""
    found = []
    for name, quantity in possible.items():
        low, high = _range(known, quantity.powers)
        if low > high:
            continue
        inside = [f for f in quantity.common if low - MARGIN <= log(f) <= high + MARGIN]
        middle = min(max(_middle(known, quantity.powers), low), high)
        best = min(inside, key=lambda f: abs(log(f) - middle), default=None)
        found.append(ScaleCause(name, exp(middle) if best is None else best, best is not None))
    return found


def _range(known: Mapping[str, ScaleRatio], powers: Mapping[str, float]) -> tuple[float, float]:
    """Return the least and largest log factor that bring every ratio into its range.

    If no factor does so, the least is above the largest.
    """
    low, high = -inf, inf
    for name, ratio in known.items():
        power = powers.get(name, 0.0)
        if power == 0.0:
            if not ratio.natural:
                return inf, -inf
            continue
        ends = sorted((log(ratio.value) - log(end)) / power for end in (ratio.low, ratio.high))
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


def _middle(known: Mapping[str, ScaleRatio], powers: Mapping[str, float]) -> float:
    """Return the log factor that brings the ratios closest to their usual values.

    Each ratio has the weight 1 / (log width of its range)^2.
    """
    total = weights = 0.0
    for name, ratio in known.items():
        if power := powers.get(name, 0.0):
            weight = log(ratio.high / ratio.low) ** -2
            total += weight * log(ratio.value / ratio.usual) / power
            weights += weight
    return total / weights if weights else 0.0
