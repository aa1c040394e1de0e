"""Scale and bias of a gyro, from the headings of poses.

    heading(t + lag) = c + s (integral of the gyro - b t)

with scale s, bias b, and a constant c for every part of a run. Least squares give s and s b; a
jackknife over the parts gives their uncertainty. Scale factor and bias are the first terms of the
error model of a gyro, IEEE Std 952.
"""

import numpy as np
from jaxtyping import Float

from slipid.data.runs import Runs
from slipid.data.wheel_signals import integral

LEAST_PARTS, LEAST_POSES = 12, 5
"""Number of parts into which runs are divided for the jackknife if there are fewer runs, and least
number of headings in a part."""


def gyro_errors(
    data: Runs, lag: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]] | None:
    """Return scale [1] and bias [rad/s] of a gyro, and their stds.

    The true yaw rate is the scale times (reading less bias). The result is None if no run has both
    a gyro and headings, or if they do not determine the numbers.

    Args:
        data: the runs.
        lag: lag of the poses behind the gyro [s].
    """
    parts = [part for k in range(len(data)) for part in _parts(data, k, lag)]
    if len(parts) < 3:
        return None
    matrices = np.array([x.T @ x for x, _ in parts])
    sides = np.array([x.T @ y for x, y in parts])
    if np.linalg.cond(matrices.sum(axis=0)) > 1e12:
        return None
    left_out = np.linalg.solve(
        matrices.sum(axis=0) - matrices, (sides.sum(axis=0) - sides)[..., None]
    )[..., 0]
    whole = np.linalg.solve(matrices.sum(axis=0), sides.sum(axis=0))

    def scale_and_bias(z: np.ndarray) -> np.ndarray:
        return np.stack([z[..., 0], -z[..., 1] / z[..., 0]], axis=-1)

    each, count = scale_and_bias(left_out), len(parts)
    variance = (count - 1) / count * ((each - each.mean(axis=0)) ** 2).sum(axis=0)
    return scale_and_bias(whole), np.sqrt(variance)


def _parts(data: Runs, run: int, lag: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return, for each part of a run, the gyro's integral and time, and the heading, centred."""
    gyro, rows = data.logs[run].gyro, data.rows(run)
    if gyro is None:
        return []
    time, heading = data.time[rows], data.pose[rows][:, 2]
    at = time - lag
    seen = data.fresh[rows] & np.isfinite(heading) & (at >= time[0]) & (at <= time[-1])
    turned = np.interp(at[seen], time, integral(time, gyro[:, None])[:, 0])
    columns = np.column_stack([turned, at[seen], heading[seen]])
    count = int(np.ceil(LEAST_PARTS / len(data)))
    out = []
    for part in np.array_split(columns, count):
        if len(part) >= LEAST_POSES:
            centred = part - part.mean(axis=0)
            out.append((centred[:, :2], centred[:, 2]))
    return out
