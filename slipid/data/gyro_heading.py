"""Headings from a gyro, for runs without any pose."""

from dataclasses import replace

import numpy as np

from slipid.data.log import Log
from slipid.data.wheel_signals import integral, stretches
from slipid.support.errors import DataError

REST_S = 0.5
"""Least time at rest from which the bias of a gyro is estimated [s]."""


def with_gyro_heading(log: Log) -> Log:
    """Return a log whose headings are the integral of its gyro, less the bias at rest.

    The gyro's scale counts as known, and the gyro is no longer a channel of its own.

    Raises:
        DataError: the wheels never rest for `REST_S`, so that the bias is unknown.
    """
    assert log.gyro is not None
    rest = np.zeros(log.samples, bool)
    still = (np.diff(log.wheel_angle, axis=0) == 0).all(axis=1)
    for start, end in stretches(still).tolist():
        if log.time[end] - log.time[start] >= REST_S:
            rest[start : end + 1] = True
    if not rest.any():
        raise DataError(
            f"{log.name}: no pose, and no rest of {REST_S:g} s that shows the bias of the gyro; "
            "expected columns of x and y or of a heading, or a robot at rest before its run"
        )
    bias = float(log.gyro[rest].mean())
    pose = np.full((log.samples, 3), np.nan)
    pose[:, 2:] = integral(log.time, log.gyro[:, None] - bias)
    note = f"headings are the integral of the gyro, less {bias:.4g} rad/s, its mean at rest"
    return replace(
        log, gyro=None, pose=pose, pose_fresh=np.ones(log.samples, bool), notes=(*log.notes, note)
    )
