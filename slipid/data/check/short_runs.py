"""Search for runs in which the robot hardly moves, such as a log that was cut off at its beginning.

A fit of motors and contact needs poses while the robot drives; one such run among many would
otherwise prevent it.
"""

import numpy as np

from slipid.data.check.findings import LEAST_PATH_M
from slipid.data.runs import Runs
from slipid.data.wheel_signals import MOVED_M, first_moved


def short_runs(data: Runs, radius: float, fewest: int) -> dict[int, str]:
    """Return a sentence about each run in which the robot hardly moves, keyed by its index.

    In such a run neither a wheel nor the poses move by `LEAST_PATH_M`, and there are too few poses
    after the first motion. The result is empty if this applies to half of the runs or more: then
    the unit of a length may be wrong, or the robot is slow.

    Args:
        data: the runs.
        radius: radius of the wheels [m].
        fewest: least number of poses after the first motion.
    """
    out = {}
    for run, log in enumerate(data.logs):
        rows = data.rows(run)
        turned = float(np.ptp(data.wheel_angle[rows], axis=0).max(initial=0.0))
        place = data.pose[rows, :2]
        place = place[np.isfinite(place).all(axis=1)]
        moved = np.hypot(*np.ptp(place, axis=0)) if len(place) else 0.0
        if max(moved, radius * turned) >= LEAST_PATH_M:
            continue
        first = first_moved(data.wheel_angle[rows], radius)
        poses = 0 if first is None else int(data.fresh[rows][first:].sum())
        if first is None:
            out[run] = f"{log.name}: no wheel rim moves by {1000 * MOVED_M:.0f} mm"
        elif poses < fewest:
            out[run] = f"{log.name}: {poses} poses while the robot drives, {fewest} are needed"
    return out if 2 * len(out) < len(data) else {}
