"""Whether the columns of commanded and reported wheel speeds are exchanged.

A command comes before the motion, and holds still in between. So columns are exchanged where what
is called the command changes later than what is called the measured speed, and in more rows.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.sanity.finding import Finding
from slipid.data.sanity.motion.recorded import Flat, Recorded

LONGEST_S = 1.0
"""Lags between command and motion that are looked at, either way [s]."""
MOST_SHIFTS = 50
"""The same in rows, for time in a wrong unit."""
MOST_ROWS = 20_000
"""Rows that are looked at."""
ALIKE = 0.3
"""Correlation from which a lag is believed."""
BUSIER = 1.5
"""Times as many rows in which a measured speed changes as in a command."""


def exchanged(data: Recorded) -> Iterator[Finding]:
    """The finding, if columns are exchanged."""
    if data.commanded is None or data.reported is None:
        return
    row = float(np.median(data.row))
    when = np.arange(data.begin[0], data.end[-1], row)[:MOST_ROWS]
    inside = when + row <= data.end[data.runs_of(when).clip(0)]
    said, done = (
        _changes(channel, when, row, inside) for channel in (data.commanded, data.reported)
    )
    if not (said**2).sum() > 0 or not (done**2).sum() > 0:
        return
    most = min(int(LONGEST_S / row), MOST_SHIFTS)
    shifts = np.arange(-most, most + 1)
    alike = np.array([_correlation(said, done, int(k)) for k in shifts])
    best = int(np.argmax(alike))
    busy = [float((np.abs(x) > 1e-3 * np.abs(x).max()).mean()) for x in (said, done)]
    if alike[best] > ALIKE and shifts[best] < 0 and busy[0] > BUSIER * busy[1]:
        yield Finding(
            "command_exchanged",
            f"what is called the commanded wheel speed comes {-shifts[best] * row:.2g} s after the "
            f"measured one, and changes in {busy[0]:.0%} of the rows, the measured one in "
            f"{busy[1]:.0%}",
            "exchange the columns of wheel_speed_command and wheel_speed (or of "
            "motor_speed_command and motor_speed)",
            "wrong",
        )


def _changes(
    channel: Flat, when: Float[np.ndarray, " at"], row: float, inside: Bool[np.ndarray, " at"]
) -> Float[np.ndarray, "change wheel"]:
    """Change of a speed from row to row [rad/s], zero across the ends of runs."""
    speed = (channel.at(when + row) - channel.at(when)) / row
    speed[~inside] = np.nan
    return np.nan_to_num(np.diff(speed, axis=0))


def _correlation(said: np.ndarray, done: np.ndarray, shift: int) -> float:
    """Of a command with the speed so many rows later."""
    n = len(said) - abs(shift)
    first, second = (said[:n], done[-n:]) if shift >= 0 else (said[-n:], done[:n])
    size = np.sqrt((first**2).sum() * (second**2).sum())
    return float((first * second).sum() / size) if size > 0 else 0.0
