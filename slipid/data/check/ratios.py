"""How far different channels have the robot go, as ratios, and what of that is natural.

travel      body over wheels, along        pose / (r / J turns): less than 1 where wheels slip
turning     body over wheels, heading      the same in heading
drive       commanded over wheels, along
steer       commanded over wheels, heading
command     commanded over measured wheel speeds
report      reported speeds over encoders
gyro        gyro over heading of the poses

Which single wrong factor explains ratios that are not natural.

A cause multiplies each ratio by a power of its factor. With the logarithms of ratios and of the
ends of their ranges, a cause fits where one factor brings all of them into their ranges:

    max_i  log(ratio_i / high_i) / e_i   <=   log factor   <=   min_i  log(ratio_i / low_i) / e_i

(ends exchanged where e_i < 0). Of causes that fit, one with a factor that people do get wrong is
believed: 1000, 2 pi, 57.3, the gear ratio.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, pi

import numpy as np
from jaxtyping import Float

from slipid.data.check.interpretation import Evidence, Interpretation, columns, to_body
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
"""Share of the predicted motion that must be turning, for the heading to be compared."""
FORWARD = 0.02
"""Share that must be along, for lengths to be compared."""
RIGID = 1e-6
"""Relative difference of angle and integrated speed below which one was made of the other."""

_Range = tuple[float, float, float]
"""Least, usual and most."""
_WIDE: Mapping[str, _Range] = {
    # A carpet may hold a robot in place, so below is no end where commands vouch for the wheels; a
    # camera's scale may be off by an eighth.
    "travel": (0.012, 0.8, 1.35),
    "turning": (0.35, 0.8, 1.35),
    # Commands lead, and end where brakes or limits take over.
    "drive": (0.65, 1.1, 1.75),
    "steer": (0.65, 1.1, 1.75),
    "command": (0.7, 1.1, 1.75),
    "report": (0.8, 1.0, 1.25),
    "gyro": (0.75, 1.0, 1.33),
}
_UNVOUCHED: _Range = (0.3, 0.8, 1.35)
"""Of `travel` where no command was logged."""
_SCRUBBING: Mapping[str, _Range] = {"turning": (0.25, 0.55, 1.15), "steer": (0.4, 1.3, 3.2)}
"""Robots whose wheels cannot roll sideways turn less than their track says, and command more."""


@dataclass(frozen=True)
class ScaleRatio:
    """One ratio, the range in which it is natural, and what is usual."""

    value: float
    low: float
    usual: float
    high: float

    @property
    def natural(self) -> bool:
        """Whether nothing is wrong with it."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True)
class ScaleRatios:
    """Ratios of a set of runs.

    Attributes:
        known: by name.
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
    """Ratios under an interpretation: order, signs and axes are put right before."""
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
        mine = columns(meant, evidence.wheels)
        theirs = columns(Interpretation(meant.command_order, meant.command_sign), evidence.wheels)
        both = float(np.trace(mine @ evidence.command.across @ theirs.T))
        values["command"] = both / evidence.command.turns
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
    of: Products, predict: Float[np.ndarray, "3 wheel"], offset: int
) -> tuple[float | None, float | None]:
    """Ratios of the body's motion to the predicted one along and in heading, by least squares."""
    predicted = np.einsum("aw,wv,av->a", predict, of.turns, predict)
    both = np.einsum("aw,wa->a", predict, of.across @ rotation(-offset).T)
    total = predicted.sum()
    if not total > 0:
        return None, None
    far, about = predicted[:2].sum(), predicted[2]
    along = float(both[:2].sum() / far) if far > FORWARD * total else None
    # what wheels hardly turn says nothing beside what slip turns
    turns = about > TURNS * total and both[2] ** 2 > 0.25 * about * of.body[2, 2]
    return along, float(both[2] / about) if turns else None


def _gyro(
    at: StepEdges, moved: ChannelIncrements, pose: Products, meant: Interpretation
) -> float | None:
    """Turn of the gyro over that of the heading, where both are alike."""
    if moved.gyro is None:
        return None
    body = body_motion(at, meant.convention.bare)[pose.known, 2]
    gyro = meant.gyro_sign * moved.gyro[pose.known, 0]
    known = np.isfinite(gyro)
    weight, body, gyro = pose.weight[known], body[known], gyro[known]
    own, both, other = (
        (weight * a * b).sum() for a, b in ((gyro, gyro), (gyro, body), (body, body))
    )
    if not own * other > 0 or both < 0.5 * np.sqrt(own * other):
        return None
    return float(np.sqrt(own / other))


def _reported(data: JoinedRuns) -> tuple[float | None, bool]:
    """Ratio of reported speeds to encoders, whole runs; and whether they are the same thing."""
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
"""A range that ends this near a factor (in its logarithm) still holds it."""
ROWS_S = (0.001, 1.5)
"""Times between rows that are natural [s]."""

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
"""Of turns that are integrated from speeds."""


@dataclass(frozen=True)
class ScaleCause:
    """A cause that fits.

    Attributes:
        name: of the cause.
        factor: divisor of the declared number, or factor of the values of its channels.
        common: whether it is one that people do get wrong.
    """

    name: str
    factor: float
    common: bool


def causes(speed_is_angle: bool) -> Mapping[str, Mapping[str, float]]:
    """Everything that may be wrong by a factor, the likeliest first.

    Each has the power of its factor in every ratio that it changes. A factor above 1 stands for
    channels that are too large: turns, lengths, angles, time.
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


def explained(
    seen: ScaleRatios, row_s: float, gear_ratio: float
) -> tuple[tuple[ScaleCause, ...], bool]:
    """Causes that fit, the likeliest first, and whether single ones do.

    Where no single cause fits, the first pair that does is returned. Nothing where every ratio is
    natural, or no pair of causes fits.
    """
    if all(r.natural for r in seen.known.values()):
        return (), True
    open_ = dict(causes(seen.speed_is_angle))
    if ROWS_S[0] <= row_s <= ROWS_S[1]:
        del open_["time"]
    common = _common(gear_ratio, seen.speed_is_angle)
    single = _singles(seen.known, open_, common)
    if single:
        return tuple(sorted(single, key=lambda e: not e.common)), True
    for first, power in open_.items():
        for factor in common[first]:
            left = {
                name: replace(r, value=r.value / factor ** power.get(name, 0.0))
                for name, r in seen.known.items()
            }
            rest = {name: other for name, other in open_.items() if name != first}
            second = [e for e in _singles(left, rest, common) if e.common]
            if second:
                return (ScaleCause(first, factor, True), second[0]), False
    return (), False


def _singles(
    known: Mapping[str, ScaleRatio],
    open_: Mapping[str, Mapping[str, float]],
    common: Mapping[str, Sequence[float]],
) -> list[ScaleCause]:
    """Causes that fit alone."""
    found = []
    for name, power in open_.items():
        low, high = _range(known, power)
        if low > high:
            continue
        inside = [f for f in common[name] if low - NEAR <= log(f) <= high + NEAR]
        middle = min(max(_middle(known, power), low), high)
        best = min(inside, key=lambda f: abs(log(f) - middle), default=None)
        found.append(ScaleCause(name, exp(middle) if best is None else best, best is not None))
    return found


def _range(known: Mapping[str, ScaleRatio], powers: Mapping[str, float]) -> tuple[float, float]:
    """Logarithms of the factors that bring every ratio into its range; empty where none does."""
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
    """Logarithm of the factor by usual ratios; narrow ranges count most."""
    total = weights = 0.0
    for name, ratio in known.items():
        if power := powers.get(name, 0.0):
            weight = log(ratio.high / ratio.low) ** -2
            total += weight * log(ratio.value / ratio.usual) / power
            weights += weight
    return total / weights if weights else 0.0


def _common(gear_ratio: float, speed_is_angle: bool) -> Mapping[str, Sequence[float]]:
    """Factors that people get wrong by name of the cause, with their inverses."""
    named = dict(_COMMON)
    if speed_is_angle:
        named["wheel_gear"] = _OF_RATES
    if gear_ratio > 1.5:
        named |= {name: (gear_ratio, *named[name]) for name in _BY_GEAR}
    return {name: [f for one in all_ for f in (one, 1 / one)] for name, all_ in named.items()}
