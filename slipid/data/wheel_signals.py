"""Signals of one run: increments of motion, telemetry stalls, first motion, swapped wheels."""

from collections.abc import Iterable
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Int

MOVED = 0.010
"""A run starts where the fastest wheel's rim has moved this distance [m]."""
STALLED = 3
"""Least number of steps without change in a stall."""
DOUBT = 0.05
"""Relative misfit of the declared order above which other orders are tried; errors of speed loops
stay below it."""
LEAST_CHANGES = 8
"""Least number of changes of a value from which its sensor's refresh period is estimated."""
LEAST_IN_A_RUN = 3
"""Least mean number of changes in a run."""
BETTER = 0.25
"""Another order must have less than this share of the declared one's misfit."""


def interpolate(
    time: Float[np.ndarray, " time"],
    values: Float[np.ndarray, "time column"],
    at: Float[np.ndarray, " at"],
) -> Float[np.ndarray, "at column"]:
    """Return columns at other times [s], linear in between and constant beyond both ends.

    Angles must be without wrap-around.
    """
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)


def integral(
    time: Float[np.ndarray, " time"], rate: Float[np.ndarray, "time column"]
) -> Float[np.ndarray, "time column"]:
    """Return the integral of each column from the first row on by trapezoids; it starts at 0."""
    areas = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(areas, axis=0)])


def readings(
    time: Float[np.ndarray, " time"], values: Float[np.ndarray, " time"]
) -> Bool[np.ndarray, " time"]:
    """Return whether a sensor that may be slower than the rows was read anew, for each row.

    It is True everywhere where the value changes in neighbouring rows, or hardly ever.
    """
    period = refresh_period([(time, values)])
    return np.ones(len(time), bool) if period is None else read_anew(time, values, period)


def refresh_period(
    runs: Iterable[tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]]],
) -> float | None:
    """Return the refresh period of a sensor slower than its rows [s], or None of one that is not.

    The value of a slow sensor never changes in two neighbouring rows, except one time in twenty; a
    sensor that is read in every row and happens to repeat itself changes in neighbouring rows, too.
    It changes several times in a run: a single change is a step of the measured quantity.
    """
    rows: list[np.ndarray] = []
    seconds: list[np.ndarray] = []
    count = 0
    for time, values in runs:
        count += 1
        changed = np.flatnonzero(np.diff(values) != 0) + 1
        rows.append(np.diff(changed))
        seconds.append(np.diff(time[changed]))
    apart = np.concatenate(rows) if rows else np.zeros(0, int)
    least = max(LEAST_CHANGES, LEAST_IN_A_RUN * count)
    if len(apart) < least or np.quantile(apart, 0.05) < 2:
        return None
    return float(np.median(np.concatenate(seconds)))


def read_anew(
    time: Float[np.ndarray, " time"], values: Float[np.ndarray, " time"], period: float
) -> Bool[np.ndarray, " time"]:
    """Return the rows in which a sensor of this period was read: at changes, or after a period.

    A value that stays constant for several periods was read several times.
    """
    out = np.zeros(len(time), dtype=bool)
    out[0] = True
    last = 0
    changed = np.append(np.flatnonzero(np.diff(values) != 0) + 1, len(time))
    for row in changed.tolist():
        end = time[min(row, len(time) - 1)]
        count = int(np.round((end - time[last]) / period))
        again = time[last] + (end - time[last]) / max(count, 1) * np.arange(1, count)
        out[np.searchsorted(time, again - 1e-9).clip(0, len(time) - 1)] = True
        if row < len(time):
            out[row] = True
            last = row
    return out


def body_increments(
    before: Float[np.ndarray, "step 3"], after: Float[np.ndarray, "step 3"]
) -> Float[np.ndarray, "step 3"]:
    """Return increments ahead [m], left [m] and of the heading [rad] between poses.

    They are in the body's axes at the middle of each step, rotated by the mean heading.
    """
    middle = 0.5 * (after[:, 2] + before[:, 2])
    dx, dy, turn = (after - before).T
    ahead = np.cos(middle) * dx + np.sin(middle) * dy
    left = np.cos(middle) * dy - np.sin(middle) * dx
    return np.stack([ahead, left, turn], axis=1)


def body_steps(pose: Float[np.ndarray, "row 3"]) -> Float[np.ndarray, "step 3"]:
    """Return the `body_increments` from each row of a pose to the next."""
    return body_increments(pose[:-1], pose[1:])


def stretches(mask: Bool[np.ndarray, " row"]) -> Int[np.ndarray, "stretch 2"]:
    """Return the first row of every stretch of True, and the row after its last."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]]))).reshape(-1, 2)


def bridge_stalls(
    time: Float[np.ndarray, " time"], wheel_angle: Float[np.ndarray, "time wheel"]
) -> tuple[Float[np.ndarray, "time wheel"], Bool[np.ndarray, " time"]]:
    """Return the wheel angle with stalls of the telemetry bridged, and whether each row is stalled.

    A stall is a stretch in which no wheel's angle changes and that ends in one step as large as the
    missed motion: the radio froze, not the wheels. The angle is made linear across it; speeds and
    currents reported in the stalled rows are as stale as the angle was.
    """
    stalled = np.zeros(len(time), dtype=bool)
    step = np.abs(np.diff(wheel_angle, axis=0)).max(axis=1, initial=0.0)
    if not step.any():
        return wheel_angle, stalled
    usual = float(np.median(step[step > 0]))
    bridged = wheel_angle
    for start, end in stretches(step == 0):
        # Rows start..end hold the same angle; row end + 1 is the burst.
        if end - start < STALLED or end == len(step) or start == 0:
            continue
        if step[end] < 0.5 * (end - start + 1) * min(usual, step[start - 1]):
            continue
        if bridged is wheel_angle:
            bridged = wheel_angle.copy()
        inside = slice(start + 1, end + 1)
        ends = np.array([start, end + 1])
        bridged[inside] = interpolate(time[ends], wheel_angle[ends], time[inside])
        stalled[inside] = True
    return bridged, stalled


def first_moved(wheel_angle: Float[np.ndarray, "time wheel"], radius: float) -> int | None:
    """Return the first row by which some wheel's rim has moved `MOVED`; None where none does."""
    rim = radius * np.abs(wheel_angle - wheel_angle[:1]).max(axis=1, initial=0.0)
    moved = np.flatnonzero(rim >= MOVED)
    return int(moved[0]) if len(moved) else None


def swapped_order(
    measured: Float[np.ndarray, "time wheel"], reference: Float[np.ndarray, "time wheel"]
) -> tuple[int, ...] | None:
    """Return the column of each wheel, such as (3, -1, 2); None where the order is right.

    Wheels are counted from 1, and negative where they count backwards. It is the order in which the
    measured steps come closest to the reference:

        misfit = sum_i |m_order(i) sign_i - ref_i|^2 / sum_i |ref_i|^2

    Only the products of every pair enter, so that all orders of six wheels take no time. Steps are
    in any measure of wheel motion, such as the angle turned.
    """
    products = measured.T @ reference
    norm, reference_norm = float(np.sum(measured**2)), float(np.sum(reference**2))
    if not norm > 0 or not reference_norm > 0:
        return None
    wheels = range(len(products))
    best = max(permutations(wheels), key=lambda p: float(np.abs(products[p, wheels]).sum()))
    along = products[best, wheels]
    declared, found = (
        (norm - 2.0 * float(total)) / reference_norm + 1.0
        for total in (np.trace(products), np.abs(along).sum())
    )
    if declared <= DOUBT or found >= BETTER * declared:
        return None
    return tuple(-(k + 1) if value < 0 else k + 1 for k, value in zip(best, along, strict=True))
