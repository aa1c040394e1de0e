"""Scale and bias of a gyro are found from headings, with intervals that hold them."""

from pathlib import Path

import numpy as np
import pytest

from slipid.data.log import Log
from slipid.data.runs import collect
from slipid.fitting.calibration.gyro import gyro_errors

SCALE, BIAS, LAG = 1.03, 0.02, 0.15
"""True yaw rate = SCALE (reading - BIAS); headings are late by LAG [s]."""


def run(number: int, seed: int, **more: object) -> Log:
    rng = np.random.default_rng([seed, number])
    time = np.arange(0.0, 12.0, 0.02)
    knots = rng.uniform(-1.0, 1.0, 14)
    rate = np.interp(time, np.arange(14), knots)
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * 0.02)])
    pose = np.full((len(time), 3), np.nan)
    pose[:, 2] = np.interp(time - LAG, time, heading) + rng.normal(0.0, 0.005, len(time))
    values = {
        "name": f"{number}.csv",
        "path": Path(f"{number}.csv"),
        "sha256": "0" * 64,
        "time": time,
        "wheel_angle": np.zeros((len(time), 2)),
        "gyro": rate / SCALE + BIAS + rng.normal(0.0, 0.01, len(time)),
        "current_is_signed": True,
        "pose": pose,
        "pose_fresh": np.arange(len(time)) % 5 == 0,
        "surface": "floor",
        "load": "as_built",
    }
    return Log(**(values | more))


@pytest.mark.parametrize("runs", [1, 6])
def test_scale_and_bias_of_a_gyro(runs):
    """In nearly all of twelve sets the numbers are within two stds, which are small."""
    off = []
    for seed in range(12):
        found = gyro_errors(collect([run(k, seed) for k in range(runs)]), LAG)
        assert found is not None
        value, std = found
        assert std[0] < 0.01
        assert std[1] < 0.005
        off.append((value - [SCALE, BIAS]) / std)
    assert np.mean(np.abs(off) < 2.0) > 0.8
    assert np.mean(np.abs(off) < 0.2) < 0.5


def test_runs_without_gyro_or_headings_tell_nothing():
    blind = run(0, 0)
    blind.pose[:] = [0.0, 0.0, np.nan]
    assert gyro_errors(collect([blind]), LAG) is None
    assert gyro_errors(collect([run(0, 0, gyro=None)]), LAG) is None
