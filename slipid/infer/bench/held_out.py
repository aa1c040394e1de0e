"""Judgement of fitted motors on rows that were not used: open-loop simulation from the voltage.

Every record is cut into parts, and a motor is fitted to every second part. The others are simulated
with the voltage alone, together with those that were used, so that the simulation is continuous.
The two sets of parts change places.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool

from slipid.infer.bench.least_squares import RIVALS, least_squares
from slipid.infer.bench.motor import BenchMotor
from slipid.infer.bench.open_loop import Channels, open_loop, values_of
from slipid.infer.bench.rows import Rows
from slipid.infer.held_out import Errors, HeldOut

PARTS = 6
"""Number of parts of a record."""


def folds(rows: Rows) -> tuple[Bool[np.ndarray, "segment step"], Bool[np.ndarray, "segment step"]]:
    """Return both sets of parts; records are numbered through, so that short ones alternate."""
    odd = np.zeros(rows.used.shape, bool)
    for k in range(int(rows.record.max()) + 1):
        mine = rows.record == k
        longest = float(rows.time[mine].max()) + 1e-9
        odd |= mine & ((np.floor(PARTS * rows.time / longest).astype(int) + k) % 2 == 1)
    return ~odd & rows.used, odd & rows.used


def held_out(rows: Rows, fitted: Callable[[Bool[np.ndarray, "segment step"]], Channels]) -> HeldOut:
    """Return the errors of a fit and of the rivals.

    Args:
        rows: rows.
        fitted: function from the rows that are used to the readings of a motor fitted to them.
    """
    made: dict[str, list[np.ndarray]] = {name: [] for name in ("fit", *RIVALS)}
    parts = folds(rows)
    for use, other in (parts, parts[::-1]):
        readings = {"fit": fitted(use)}
        for name, with_offset in RIVALS.items():
            motor: BenchMotor = least_squares(rows, with_offset, use)
            readings[name] = open_loop(rows, values_of(motor), rows.start).readings
        measured = np.stack([rows.current, rows.speed])
        for name, predicted in readings.items():
            made[name].append(((measured - predicted)[:, other]) ** 2)
    errors = {}
    for name, squares in made.items():
        current, speed = np.sqrt(np.concatenate(squares, axis=1).mean(axis=1))
        errors[name] = Errors(float(speed), float(current) if rows.has_current else None)
    return HeldOut(errors.pop("fit"), errors)
