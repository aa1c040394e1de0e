"""Which single wrong factor explains ratios that are not natural.

A cause multiplies each ratio by a power of its factor. With the logarithms of ratios and of the
ends of their ranges, a cause fits where one factor brings all of them into their ranges:

    max_i  log(ratio_i / high_i) / e_i   <=   log factor   <=   min_i  log(ratio_i / low_i) / e_i

(ends exchanged where e_i < 0). Of causes that fit, one with a factor that people do get wrong is
believed: 1000, 2 pi, 57.3, the gear ratio.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, pi

from slipid.data.check.ratios import ScaleRatio, ScaleRatios

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
class Explained:
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
) -> tuple[tuple[Explained, ...], bool]:
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
                return (Explained(first, factor, True), second[0]), False
    return (), False


def _singles(
    known: Mapping[str, ScaleRatio],
    open_: Mapping[str, Mapping[str, float]],
    common: Mapping[str, Sequence[float]],
) -> list[Explained]:
    """Causes that fit alone."""
    found = []
    for name, power in open_.items():
        low, high = _range(known, power)
        if low > high:
            continue
        inside = [f for f in common[name] if low - NEAR <= log(f) <= high + NEAR]
        middle = min(max(_middle(known, power), low), high)
        best = min(inside, key=lambda f: abs(log(f) - middle), default=None)
        found.append(Explained(name, exp(middle) if best is None else best, best is not None))
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
