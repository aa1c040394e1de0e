"""Runs between pauses in which no wheel moves."""

from collections.abc import Mapping
from math import tau

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.reading.bag.layout import TURNS, BagLayout
from slipid.data.reading.bag.runs.stretch import Stretch
from slipid.data.reading.signal import Signal

STILL = 0.02
"""A wheel that turned by less [rad], or is turning slower [rad/s], stands still."""
PAUSE_S = 1.0
"""Pause at which a long drive is proposed to be cut [s]."""


def by_pauses(layout: BagLayout, signals: Mapping[str, Signal], pause_s: float) -> list[Stretch]:
    """Runs between pauses, each with half of the shortest pause before and behind it.

    Args:
        layout: how the wheels are read.
        signals: with one of `TURNS`.
        pause_s: shortest time without motion that parts two runs [s].
    """
    moves = _moves(layout, signals)
    if not len(moves):
        return []
    cuts = np.flatnonzero(np.diff(moves) > pause_s)
    firsts, lasts = moves[[0, *(cuts + 1)]], moves[[*cuts, len(moves) - 1]]
    rest = 0.5 * pause_s
    ends = zip((firsts - rest).tolist(), (lasts + rest).tolist(), strict=True)
    return [Stretch(first, last) for first, last in ends]


def _moves(layout: BagLayout, signals: Mapping[str, Signal]) -> Float[np.ndarray, " move"]:
    """Times at which some wheel was seen to have moved [s]."""
    name = next(name for name in TURNS if name in signals)
    time, values = signals[name].time, signals[name].values
    if name.startswith("motor_") or name == "wheel_ticks":
        values = values / layout.gear_ratio
    if name.endswith("_speed"):
        return time[(np.abs(values) > STILL).any(axis=1)]
    if name == "wheel_ticks":
        values = values * (tau / float(layout.ticks_per_revolution or 1.0))
        values = np.cumsum(values, axis=0) if layout.ticks_are_increments else values
    moved = {row for column in values.T for row in _moved(column)}
    return time[sorted(moved)]


def _moved(angle: Float[np.ndarray, " sample"]) -> list[int]:
    """Samples at which an angle is farther than `STILL` from where it last was found moved.

    So neither the last digit of an encoder, which may flicker, nor noise counts as motion.
    """
    found, held = [], float(angle[0])
    changed = np.flatnonzero(np.diff(angle)) + 1
    for row, value in zip(changed.tolist(), angle[changed].tolist(), strict=True):
        if abs(value - held) > STILL:
            held = value
            found.append(row)
    return found


def parts_between_pauses(log: Log, pause_s: float) -> int:
    """Into how many runs longer pauses of its wheels would cut a log."""
    turned = np.abs(np.diff(log.wheel_angle, axis=0)) > STILL * np.diff(log.time)[:, None]
    moves = log.time[1:][turned.any(axis=1)]
    return int((np.diff(moves) > pause_s).sum()) + 1 if len(moves) else 0
