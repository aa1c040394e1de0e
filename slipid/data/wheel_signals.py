"""Signals of one run: steps of motion, stalls of the telemetry, the start, swapped wheels."""

from collections.abc import Iterable
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Int

MOVED = 0.010
"""A run counts from where the fastest wheel's rim has moved this far [m]."""
STALLED = 3
"""Steps without change from which a stretch can be a stall."""
DOUBT = 0.05
"""Relative misfit from which the declared order is doubted; speed loops keep below it."""
LEAST_CHANGES = 8
"""Changes of a value from which on its sensor's own period can be told."""
LEAST_IN_A_RUN = 3
"""The same, of a run on average."""
BETTER = 0.25
"""Another order must have less than this share of the declared one's misfit to be believed."""


def interpolate(
    time: Float[np.ndarray, " time"],
    values: Float[np.ndarray, "time column"],
    at: Float[np.ndarray, " at"],
) -> Float[np.ndarray, "at column"]:
    """Columns at other times [s], linear in between, constant beyond both ends.

    Angles have to be without wrap-around.
    """
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)


def integral(
    time: Float[np.ndarray, " time"], rate: Float[np.ndarray, "time column"]
) -> Float[np.ndarray, "time column"]:
    """Integral of each column from the first row on, by trapezoids; the first row is 0."""
    areas = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(areas, axis=0)])


def readings(
    time: Float[np.ndarray, " time"], values: Float[np.ndarray, " time"]
) -> Bool[np.ndarray, " time"]:
    """Rows in which a sensor that may be slower than the rows was read anew.

    All of them where the value also changes from row to row, or hardly ever.
    """
    period = refresh_period([(time, values)])
    return np.ones(len(time), bool) if period is None else read_anew(time, values, period)


def refresh_period(
    runs: Iterable[tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]]],
) -> float | None:
    """Period of a sensor that is slower than the rows it is logged in [s]; None of one that is not.

    Its value never changes in two rows one after the other, but for one in twenty: a sensor that
    is read in every row and happens to repeat itself changes in neighbouring rows, too. In a run
    it changes several times: what changes once is a step of what is measured.
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
    """Rows in which a sensor of this period was read: where its value changes, or must have been.

    A value that stays for several periods was read several times.
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
    """Increments ahead [m], to the left [m] and in heading [rad] from poses to others.

    They are in the body's axes halfway through each step: turned back by the mean heading.
    """
    middle = 0.5 * (after[:, 2] + before[:, 2])
    dx, dy, turn = (after - before).T
    ahead = np.cos(middle) * dx + np.sin(middle) * dy
    left = np.cos(middle) * dy - np.sin(middle) * dx
    return np.stack([ahead, left, turn], axis=1)


def body_steps(pose: Float[np.ndarray, "row 3"]) -> Float[np.ndarray, "step 3"]:
    """Increments from each row of a pose to the next, as `body_increments`."""
    return body_increments(pose[:-1], pose[1:])


def stretches(mask: Bool[np.ndarray, " row"]) -> Int[np.ndarray, "stretch 2"]:
    """First row of every stretch that is true, and the row behind its last."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]]))).reshape(-1, 2)


def bridge_stalls(
    time: Float[np.ndarray, " time"], wheel_angle: Float[np.ndarray, "time wheel"]
) -> tuple[Float[np.ndarray, "time wheel"], Bool[np.ndarray, " time"]]:
    """Wheel angle with stalls of the telemetry bridged, and the rows in which it was stalled.

    A stall is a stretch in which no wheel's angle changes and that ends in one step as large as the
    motion missed: the radio froze, not the wheels. The angle is made linear across it; speeds and
    currents reported in the marked rows are as stale as the angle was.
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
    """First row by which some wheel's rim has moved `MOVED`; None where none ever does."""
    rim = radius * np.abs(wheel_angle - wheel_angle[:1]).max(axis=1, initial=0.0)
    moved = np.flatnonzero(rim >= MOVED)
    return int(moved[0]) if len(moved) else None


def swapped_order(
    measured: Float[np.ndarray, "time wheel"], reference: Float[np.ndarray, "time wheel"]
) -> tuple[int, ...] | None:
    """Where each wheel's motion is found, as (3, -1, 2); None where the declared order is right.

    Wheels are counted from 1, and negative where they count backwards. It is the order in which the
    measured steps come closest to the reference:

        misfit = sum_i |m_order(i) sign_i - ref_i|^2 / sum_i |ref_i|^2

    Only the products of every pair enter, so that all orders of six wheels cost nothing. Steps are
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
