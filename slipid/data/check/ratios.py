"""Ratios of the motion in different channels, their natural ranges, and wrong factors behind them.

travel      body over wheels, along        pose / (r / J turns): less than 1 where wheels slip
turning     body over wheels, heading      the same in heading
drive       commanded over wheels, along
steer       commanded over wheels, heading
command     commanded over measured wheel speeds
report      reported speeds over encoders
gyro        gyro over heading of the poses

A cause, such as a wrong unit, multiplies each ratio by a power of its factor. With the logarithms
of ratios and of the ends of their ranges, a cause fits where one factor brings all of them into
their ranges:

    max_i  log(ratio_i / high_i) / e_i   <=   log factor   <=   min_i  log(ratio_i / low_i) / e_i

(ends exchanged where e_i < 0). Of the causes that fit, one with a common error is preferred: 1000,
2 pi, 57.3, the gear ratio.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, pi

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

TURNS = 0.01
"""Least share of turning in the predicted motion for which headings are compared."""
FORWARD = 0.02
"""Least share of translation for which lengths are compared."""
RIGID = 1e-6
"""Relative difference of angle and integrated speed below which one was computed from the other."""

_Range = tuple[float, float, float]
"""Least, usual and largest value of a ratio."""
_WIDE: Mapping[str, _Range] = {
    # A carpet may hold a robot in place, so the lower end is low where commands confirm wheels;
    # a camera's scale may be off by an eighth.
    "travel": (0.012, 0.8, 1.35),
    "turning": (0.35, 0.8, 1.35),
    # Commands precede the motion, and exceed it where brakes or limits act.
    "drive": (0.65, 1.1, 1.75),
    "steer": (0.65, 1.1, 1.75),
    "command": (0.7, 1.1, 1.75),
    "report": (0.8, 1.0, 1.25),
    "gyro": (0.75, 1.0, 1.33),
}
_UNVOUCHED: _Range = (0.3, 0.8, 1.35)
"""Range of `travel` where no command was logged."""
_SCRUBBING: Mapping[str, _Range] = {"turning": (0.25, 0.55, 1.15), "steer": (0.4, 1.3, 3.2)}
"""Ranges of robots whose wheels cannot roll sideways: they turn less than their track says, and
command more."""


@dataclass(frozen=True)
class ScaleRatio:
    """One ratio with the range in which it is natural, and its usual value."""

    value: float
    low: float
    usual: float
    high: float

    @property
    def natural(self) -> bool:
        """Return whether the ratio is in its range."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True)
class ScaleRatios:
    """Ratios of a set of runs.

    Attributes:
        known: ratios by name.
        speed_is_angle: whether the wheels' angle is the integral of the reported speeds.
    """

    known: Mapping[str, ScaleRatio]
    speed_is_angle: bool


def ratios(
    data: JoinedRuns,
    at: StepEdges,
    moved: ChannelIncrements,
    evidence: Evidence,
    meant: Interpretation,
) -> ScaleRatios:
    """Return the ratios under an interpretation in which order, signs and axes are right."""
    values: dict[str, float | None] = {}
    predict = to_body(evidence, meant)
    pose = evidence.pose.get(meant.convention.bare)
    if pose is not None:
        values["travel"], values["turning"] = _along(pose, predict, meant.convention.offset)
        values["gyro"] = _gyro(at, moved, pose, meant)
    if evidence.twist is not None:
        signs = np.array(meant.twist_sign)
        twist = evidence.twist
        signed = replace(
            twist, across=twist.across * signs, body=twist.body * np.outer(signs, signs)
        )
        values["drive"], values["steer"] = _along(signed, predict, 0)
    if evidence.command is not None:
        values["command"] = evidence.command.product(meant) / evidence.command.turns
    values["report"], same = _reported(data)
    if same:
        values["report"] = None
    wide = dict(_WIDE)
    if values.get("drive") is None and values.get("command") is None:
        wide["travel"] = _UNVOUCHED
    if not evidence.free:
        wide.update(_SCRUBBING)
    known = {k: ScaleRatio(v, *wide[k]) for k, v in values.items() if v is not None and v > 0}
    return ScaleRatios(known, same)


def _along(
    sums: Products, predict: Float[np.ndarray, "3 wheel"], offset: int
) -> tuple[float | None, float | None]:
    """Return least-squares ratios of the body's to the predicted motion, along and in heading."""
    predicted, both = sums.predicted(predict), sums.matched(predict, rotation(-offset))
    total = predicted.sum()
    if not total > 0:
        return None, None
    ahead, about = predicted[:2].sum(), predicted[2]
    along = float(both[:2].sum() / ahead) if ahead > FORWARD * total else None
    # small predicted turns are hidden by the turns that slip causes
    turns = about > TURNS * total and both[2] ** 2 > 0.25 * about * sums.body[2, 2]
    return along, float(both[2] / about) if turns else None


def _gyro(
    at: StepEdges, moved: ChannelIncrements, pose: Products, meant: Interpretation
) -> float | None:
    """Return the turn of the gyro over that of the heading, or None where they do not correlate."""
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
    """Return the ratio of reported speeds to encoders, and whether they are the same data."""
    if data.reported is None:
        return None, False
    edges = [data.begin, 0.5 * (data.begin + data.end), data.end]
    reported, turned = (
        np.concatenate([channel.at(edge) - channel.at(edges[0]) for edge in edges[1:]])
        for channel in (data.reported, data.angle)
    )
    known = usable(reported, turned)
    reported, turned = reported[known], turned[known]
    total = float((turned**2).sum())
    if not total > 0:
        return None, False
    same = float(((reported - turned) ** 2).sum()) < RIGID**2 * total
    ratio = float(np.abs(reported * turned).sum()) / total
    return ratio, same


NEAR = 0.02
"""Tolerance of a range about a common factor (in the logarithm)."""
ROWS_S = (0.001, 1.5)
"""Plausible times between rows [s]."""

_COMMON = {
    "time": (1000.0, 1e6, 1e9, 60.0),
    "wheel_gear": (2.0, 4.0, 2 * pi, 180 / pi, 1000.0),
    "wheel_turns": (2.0, 4.0, 10.0, 2 * pi, 180 / pi, 1000.0),
    "wheel_radius": (2.0, 10.0, 100.0, 1000.0, 25.4),
    "pose_length": (1000.0, 100.0, 10.0, 25.4),
    "heading": (180 / pi,),
    "base": (2.0, 10.0, 100.0, 1000.0),
    "command_twist": (1000.0, 100.0, 10.0),
    "command_yaw": (180 / pi, 1000.0, 2 * pi),
    "command_wheels": (30 / pi, 180 / pi, 2 * pi, 1000.0, 10.0),
    "report": (30 / pi, 180 / pi, 2 * pi, 1000.0, 10.0),
    "gyro": (180 / pi, 1000.0),
}
_BY_GEAR = ("wheel_gear", "wheel_turns", "command_wheels", "report")
_OF_RATES = (30 / pi, 180 / pi, 2 * pi, 1000.0, 60.0)
"""Common errors of turns that are integrated from speeds."""


@dataclass(frozen=True)
class ScaleCause:
    """A wrong factor that explains the ratios.

    Attributes:
        name: name of the cause.
        factor: divisor of the declared number, or factor of the values of its channels.
        common: whether people often make this error.
    """

    name: str
    factor: float
    common: bool


def causes(speed_is_angle: bool) -> Mapping[str, Mapping[str, float]]:
    """Return the power of each cause's factor in every ratio that it changes, the likeliest first.

    A factor above 1 means that channels are too large: turns, lengths, angles, time.
    """
    rates = {"drive": 1.0, "steer": 1.0, "command": 1.0, "gyro": 1.0, "report": 1.0}
    integrated = {"travel": -1.0, "turning": -1.0, "gyro": 1.0}
    wheels = {"travel": -1.0, "turning": -1.0, "drive": -1.0, "steer": -1.0}
    return {
        "time": integrated if speed_is_angle else rates,
        "pose_length": {"travel": 1.0},
        "heading": {"turning": 1.0, "gyro": -1.0},
        "wheel_gear": wheels | {"command": -1.0},
        "wheel_turns": wheels | {"command": -1.0, "report": -1.0},
        "wheel_radius": wheels,
        "base": {"turning": 1.0, "steer": 1.0},
        "gyro": {"gyro": 1.0},
        "report": {"report": 1.0},
        "command_wheels": {"command": 1.0},
        "command_twist": {"drive": 1.0},
        "command_yaw": {"steer": 1.0},
    }


def single_causes(
    scales: ScaleRatios, row_s: float, gear_ratio: float
) -> tuple[tuple[ScaleCause, ...], bool]:
    """Return the causes that fit, the likeliest first, and whether single ones do.

    Where no single cause fits, the first pair that does is returned. The result is empty where
    every ratio is natural, or no pair of causes fits.
    """
    if all(r.natural for r in scales.known.values()):
        return (), True
    possible = dict(causes(scales.speed_is_angle))
    if ROWS_S[0] <= row_s <= ROWS_S[1]:
        del possible["time"]
    common = _common(gear_ratio, scales.speed_is_angle)
    single = _singles(scales.known, possible, common)
    if single:
        return tuple(sorted(single, key=lambda e: not e.common)), True
    for first, power in possible.items():
        for factor in common[first]:
            left = {
                name: replace(r, value=r.value / factor ** power.get(name, 0.0))
                for name, r in scales.known.items()
            }
            rest = {name: other for name, other in possible.items() if name != first}
            second = [e for e in _singles(left, rest, common) if e.common]
            if second:
                return (ScaleCause(first, factor, True), second[0]), False
    return (), False


def _singles(
    known: Mapping[str, ScaleRatio],
    possible: Mapping[str, Mapping[str, float]],
    common: Mapping[str, Sequence[float]],
) -> list[ScaleCause]:
    """Return the causes that fit alone."""
    found = []
    for name, power in possible.items():
        low, high = _range(known, power)
        if low > high:
            continue
        inside = [f for f in common[name] if low - NEAR <= log(f) <= high + NEAR]
        middle = min(max(_middle(known, power), low), high)
        best = min(inside, key=lambda f: abs(log(f) - middle), default=None)
        found.append(ScaleCause(name, exp(middle) if best is None else best, best is not None))
    return found


def _range(known: Mapping[str, ScaleRatio], powers: Mapping[str, float]) -> tuple[float, float]:
    """Return log factors that bring every ratio into its range; they are empty where none does."""
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
    """Return the log factor that brings ratios to their usual values; narrow ranges count most."""
    total = weights = 0.0
    for name, ratio in known.items():
        if power := powers.get(name, 0.0):
            weight = log(ratio.high / ratio.low) ** -2
            total += weight * log(ratio.value / ratio.usual) / power
            weights += weight
    return total / weights if weights else 0.0


def _common(gear_ratio: float, speed_is_angle: bool) -> Mapping[str, Sequence[float]]:
    """Return common errors by name of the cause, with their inverses."""
    named = dict(_COMMON)
    if speed_is_angle:
        named["wheel_gear"] = _OF_RATES
    if gear_ratio > 1.5:
        named |= {name: (gear_ratio, *named[name]) for name in _BY_GEAR}
    return {name: [f for one in factors for f in (one, 1 / one)] for name, factors in named.items()}
