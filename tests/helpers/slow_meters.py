"""Meters that are read less often than the wheels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slipid.data.log import Log


def held(log: Log, rows: int, first: int = 0) -> Log:
    """The log, had its meters been read once in so many rows and held until they were read again.

    Args:
        first: row of a reading; the first row of the log is another one in any case.
    """
    number = np.arange(log.samples)
    read = number % rows == first % rows
    read[0] = True
    last = np.maximum.accumulate(np.where(read, number, 0))
    fresh = np.repeat(read[:, None], log.wheel_angle.shape[1], axis=1)
    kept = {"current": log.current[last], "voltage": log.voltage[last]}
    return replace(log, **kept, current_fresh=fresh, voltage_fresh=fresh)
