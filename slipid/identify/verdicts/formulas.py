"""Directions of the parameter space in words."""

from typing import NamedTuple

import numpy as np

from slipid.identify.verdicts.estimates import NEEDS_VOLTAGE
from slipid.identify.verdicts.remedies import listed
from slipid.parameter import Entry

_LARGE = 10.0
"""Powers that differ more are no formula for people."""
_SAME = 0.05
"""Powers that differ less are one."""

NOTHING = "the data say next to nothing of "
SMALL = ", while others move a little"


class Axis(NamedTuple):
    """One coordinate of the search space, the number it is of, and what people call it.

    The unit is of a step along it; a step of a logarithm multiplies the number.
    """

    entry: Entry
    label: str
    unit: str
    is_log: bool


def axes_of(entry: Entry) -> list[Axis]:
    """The coordinates of a free number, of shares the log ratios that their basis is made of."""
    d = entry.declaration
    unit = "log-odds" if np.isfinite(d.upper) else d.unit
    is_log = bool(np.isfinite(d.lower) and not np.isfinite(d.upper))
    if entry.size == 1:
        return [Axis(entry, entry.path, unit, is_log)]
    if d.shares:
        wheels = [", ".join(map(str, range(1, k))) for k in range(2, entry.size + 1)]
        before = ["wheel 1", *(f"wheels {several}" for several in wheels[1:])]
        each = [f"{entry.path} ({first} : wheel {k})" for k, first in enumerate(before, start=2)]
        return [Axis(entry, label, d.unit, True) for label in each]
    return [Axis(entry, f"{entry.path} [{label}]", unit, is_log) for label in entry.labels]


def formula(axes: list[Axis], power: np.ndarray, step: np.ndarray) -> str:
    """Direction in words: powers relative to the largest, step of one prior std."""
    names = [axis.label for axis in axes]
    if len(axes) == 1:
        return NOTHING + names[0]
    if all(axis.is_log for axis in axes) and np.ptp(np.log(np.abs(power))) < np.log(_LARGE):
        return _product(axes, power)
    if not any(axis.is_log for axis in axes) and len({axis.unit for axis in axes}) == 1:
        return _sum(names, power)
    moves = [
        f"{axis.label} x {np.exp(s):.4g}" if axis.is_log else f"{axis.label} {s:+.2g} {axis.unit}"
        for axis, s in zip(axes, step, strict=True)
    ]
    return f"nearly unseen if together: {', '.join(moves)}"


def _product(axes: list[Axis], power: np.ndarray) -> str:
    names = [axis.label for axis in axes]
    if (np.abs(power - 1) < _SAME).all():
        short = _short(axes)
        last = NEEDS_VOLTAGE[1] if NEEDS_VOLTAGE[1] in short else short[0]
        return f"{', '.join(short)} only as {', '.join(f'{p}/{last}' for p in short if p != last)}"
    if len(names) == 2:
        k = float(power[1] / power[0])  # b / a^k does not change
        first, other = names if abs(k) >= 1 else names[::-1]
        k = k if abs(k) >= 1 else 1 / k
        held = _power(first, abs(k))
        held = f"{held} * {other}" if k < 0 else f"{other} / {held}"
        return f"{names[0]} and {names[1]} only as {held}"
    if (np.abs(np.abs(power) - 1) < _SAME).all():
        up, down = (
            listed([n for n, k in zip(names, power, strict=True) if s * k > 0]) for s in (1, -1)
        )
        return f"unseen for any factor: {up} times it, {down} divided by it"
    parts = [_power(p, k) for p, k in zip(names, power, strict=True)]
    return f"{', '.join(parts)} (each times t to the power shown, any t)"


def _power(name: str, k: float) -> str:
    return name if abs(k - 1) < _SAME else f"{name}^{k:.2g}"


def _sum(names: list[str], weight: np.ndarray) -> str:
    if (np.abs(weight - 1) < _SAME).all():
        return f"{', '.join(names)} only as their differences"
    if len(names) == 2:
        k = float(weight[1] / weight[0])  # b - k a does not change
        first, other = names if abs(k) >= 1 else names[::-1]
        k = k if abs(k) >= 1 else 1 / k
        times = "" if abs(abs(k) - 1) < _SAME else f"{abs(k):.2g} "
        sign = "+" if k < 0 else "-"
        return f"{names[0]} and {names[1]} only as {other} {sign} {times}{first}"
    parts = [f"{n} {k:+.2g} t" for n, k in zip(names, weight, strict=True)]
    return f"unseen for any t: {', '.join(parts)}"


def _short(axes: list[Axis]) -> list[str]:
    """Their names, with one pattern in place of the frictions of several floors."""
    others = [axis.label for axis in axes if axis.entry.quantity != "surface.friction"]
    several = len(axes) - len(others) > 1
    return [*others, "surface.*.friction"] if several else [axis.label for axis in axes]
