"""An estimator run over a log says what it says step by step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.deploy.replay import LONGEST_STEP_S, Start, estimated
from slipid.model.geometry import omni
from slipid.robot.estimator import Estimator
from slipid.robot.interface import Measurement
from tests.helpers.exported import known
from tests.helpers.stepped import stepped

ROBOT = known(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0))
TIME = np.concatenate([np.arange(0.0, 1.0, 0.05), np.arange(1.9, 2.5, 0.05)])
RATE = np.array([-5.0, 0.5, 4.5])
LOG = Log(
    name="run",
    path=Path("run"),
    sha256="0",
    time=TIME,
    wheel_angle=RATE * TIME[:, None],
    current=np.tile([0.4, 0.1, 0.3], (len(TIME), 1)),
    current_fresh=np.tile(np.arange(len(TIME))[:, None] % 2 == 0, 3),
    current_is_signed=False,
    gyro=0.01 * np.cos(TIME),
    surface=None,
    load="as built",
)
START = Start(0.13, (1.0, -2.0, 0.3), (0.001, 0.002))


def test_a_replay_is_that_of_steps_taken_one_by_one():
    estimator = Estimator(ROBOT)
    found = estimated(estimator, LOG, START)
    rows = np.flatnonzero(START.time < TIME)
    np.testing.assert_array_equal(found.time, TIME[rows])
    step, before, state = stepped(estimator), START.time, estimator.init(START.pose, START.std)
    state, _ = step(state, Measurement(wheel_angle=RATE * START.time), 0.0)
    for k, row in enumerate(rows):
        parts = int(np.ceil((TIME[row] - before) / LONGEST_STEP_S - 1e-9))
        for part in range(1, parts):  # the gap of 0.95 s is crossed in four steps
            at = before + (TIME[row] - before) * part / parts
            between = Measurement(wheel_angle=RATE * at)
            state, estimate = step(state, between, (TIME[row] - before) / parts)
        amps = np.where(LOG.current_fresh[row], LOG.current[row], np.nan)
        z = Measurement(LOG.wheel_angle[row], current=amps, gyro=LOG.gyro[row])
        state, estimate = step(state, z, (TIME[row] - before) / parts)
        before = TIME[row]
        for name in ("pose", "covariance", "slip", "surface_probability", "current"):
            np.testing.assert_allclose(
                getattr(found.estimate, name)[k], getattr(estimate, name), atol=1e-9
            )
    assert not found.estimate.stale.any()
    np.testing.assert_array_equal(found.rows(np.array([2, 3])).time, TIME[rows][2:4])


def test_readings_between_the_rows_are_not_made_up():
    """Repeated currents of a log without currents give the estimate without currents."""
    stale = replace(LOG, current_fresh=np.zeros((len(TIME), 3), bool))
    none = replace(LOG, current=None, current_fresh=None)
    estimator = Estimator(ROBOT)
    beliefs = [
        estimated(estimator, log, START).estimate.surface_probability for log in (stale, none)
    ]
    np.testing.assert_array_equal(*beliefs)
    whole = estimated(estimator, LOG, START).estimate.surface_probability
    assert np.abs(whole - beliefs[0]).max() > 0.01
