"""Functions on the signals of one run.

The functions compute increments of motion, find the rows in which a slow sensor was read,
interpolate across telemetry stalls, and detect the start of motion and a wrong order of the wheels.
"""

from collections.abc import Iterable
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Int

MOVED_M = 0.010
"""Motion starts in the first row in which the rim of some wheel has moved by this distance [m]."""
STALL_STEPS = 3
"""In a telemetry stall, no wheel angle changes for at least this number of rows."""
DOUBTFUL_MISFIT = 0.05
"""Another order of the wheels is considered only if the misfit of the declared order (see
`swapped_order`) exceeds this value [1]; speed-control errors cause a smaller misfit."""
LEAST_CHANGES = 8
"""Least number of changes of a sensor's value that suffices to estimate its refresh period."""
LEAST_CHANGES_PER_RUN = 3
"""Least number of changes per run, on average, that suffices to estimate a refresh period."""
CLEARLY_BETTER_RATIO = 0.25
"""Another order of the wheels is reported if its misfit is below this multiple of the declared
order's misfit [1]."""


def interpolate(
    time: Float[np.ndarray, " time"],
    values: Float[np.ndarray, "time column"],
    at: Float[np.ndarray, " at"],
) -> Float[np.ndarray, "at column"]:
    """Return columns interpolated linearly at other times [s]; beyond the ends they are constant.

    Angles must be without wrap-around.
    """
    return np.stack([np.interp(at, time, column) for column in values.T], axis=-1)


def integral(
    time: Float[np.ndarray, " time"], rate: Float[np.ndarray, "time column"]
) -> Float[np.ndarray, "time column"]:
    """Return the integral of each column over time by the trapezoidal rule, 0 in the first row."""
    areas = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(areas, axis=0)])


def readings(
    time: Float[np.ndarray, " time"], values: Float[np.ndarray, " time"]
) -> Bool[np.ndarray, " time"]:
    """Return whether each row has a new reading of a sensor that may be slower than the rows.

    All rows count as new if the value often changes from row to row, or changes too rarely to
    estimate a refresh period.
    """
    period = refresh_period([(time, values)])
    return np.ones(len(time), bool) if period is None else read_anew(time, values, period)


def refresh_period(
    runs: Iterable[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]],
) -> float | None:
    """Return the refresh period of a sensor that is read less often than rows are logged [s].

    The result is None if the sensor seems to be read in every row, or if its value changes too
    rarely to tell. At most one in twenty changes of a slow sensor follows another in the very next
    row, whereas a sensor that is read in every row and sometimes repeats a value often changes in
    two successive rows. A slow sensor must change several times in a run, because a single change
    may be a step of the measured quantity.
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
    least = max(LEAST_CHANGES, LEAST_CHANGES_PER_RUN * count)
    if len(apart) < least or np.quantile(apart, 0.05) < 2:
        return None
    return float(np.median(np.concatenate(seconds)))


def read_anew(
    time: Float[np.ndarray, " time"], values: Float[np.ndarray, " time"], period: float
) -> Bool[np.ndarray, " time"]:
    """Return whether a sensor with a refresh period [s] was read in each row.

    The sensor counts as read where its value changes, and once every period while the value stays
    constant.
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
    """Return the increments ahead [m], to the left [m] and of the heading [rad] between poses.

    The axes ahead and left are those of the body at the mean heading of each step.
    """
    middle = 0.5 * (after[:, 2] + before[:, 2])
    dx, dy, turn = (after - before).T
    ahead = np.cos(middle) * dx + np.sin(middle) * dy
    left = np.cos(middle) * dy - np.sin(middle) * dx
    return np.stack([ahead, left, turn], axis=1)


def body_steps(pose: Float[np.ndarray, "row 3"]) -> Float[np.ndarray, "step 3"]:
    """Return the `body_increments` between successive rows of poses."""
    return body_increments(pose[:-1], pose[1:])


def stretches(mask: Bool[np.ndarray, " row"]) -> Int[np.ndarray, "stretch 2"]:
    """Return the first row, and the row after the last, of every sequence of True values."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]]))).reshape(-1, 2)


def bridge_stalls(
    time: Float[np.ndarray, " time"], wheel_angle: Float[np.ndarray, "time wheel"]
) -> tuple[Float[np.ndarray, "time wheel"], Bool[np.ndarray, " time"]]:
    """Return the wheel angle, linear across telemetry stalls, and whether each row is in a stall.

    In a stall no wheel's angle changes for some rows, and then all angles change in one step by
    about the missed motion: the radio link was interrupted while the wheels went on turning. Speeds
    and currents reported in these rows are outdated, too.
    """
    stalled = np.zeros(len(time), dtype=bool)
    step = np.abs(np.diff(wheel_angle, axis=0)).max(axis=1, initial=0.0)
    if not step.any():
        return wheel_angle, stalled
    usual = float(np.median(step[step > 0]))
    bridged = wheel_angle
    for start, end in stretches(step == 0):
        # Rows start to end have the same angle; row end + 1 has the jump by the missed motion.
        if end - start < STALL_STEPS or end == len(step) or start == 0:
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
    """Return the first row in which some wheel's rim has moved by `MOVED_M`, or None if none does.

    `radius` is the radius of the wheels [m].
    """
    rim = radius * np.abs(wheel_angle - wheel_angle[:1]).max(axis=1, initial=0.0)
    moved = np.flatnonzero(rim >= MOVED_M)
    return int(moved[0]) if len(moved) else None


def swapped_order(
    measured: Float[np.ndarray, "time wheel"], reference: Float[np.ndarray, "time wheel"]
) -> tuple[int, ...] | None:
    """Return the measured column of each wheel, such as (3, -1, 2), or None to keep the order.

    Columns are counted from 1; a negative number is a column with the opposite sign. The result is
    the order and signs in which the measured steps are closest to the reference:

        misfit = sum_i |m_order(i) sign_i - ref_i|^2 / sum_i |ref_i|^2

    where i runs over the wheels and |.| is the norm over all steps. The misfit is computed from the
    sums of products of every pair of columns, so that trying all orders of six wheels is fast.
    Both arrays have a row for each step, with the same measure of wheel motion, such as the angle
    turned [rad]. An order is returned if the misfit of the declared order exceeds
    `DOUBTFUL_MISFIT`, and another order is clearly better; else the result is None.
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
    if declared <= DOUBTFUL_MISFIT or found >= CLEARLY_BETTER_RATIO * declared:
        return None
    return tuple(-(k + 1) if value < 0 else k + 1 for k, value in zip(best, along, strict=True))
