"""Windows in which a sensor was not read carry no information, whatever values they hold."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.windows import UNREAD_VARIANCE
from slipid.fitting.problem import Problem
from tests.helpers.made_windows import made, robot

ROBOT = robot(sessions=("one",))


def weights(w):
    """Whitened residuals of currents and voltages at the truth."""
    problem = Problem(w, ROBOT, [])
    z, log_v = problem.space.start, 2 * np.log(problem.noise.typical)
    residual, _ = problem.linear(z, problem.electric(z, log_v))
    root = problem.whitening(residual, log_v, problem.full_weight).root
    return {k: np.asarray(jnp.einsum("nij,nj->ni", root[k], residual[k])) for k in root}


@pytest.mark.slow
def test_what_was_not_read_weighs_nothing():
    w = made(ROBOT, runs=6, count=4, voltage=True)
    hidden = np.zeros_like(w.current)
    hidden[:, 1:3] = 1.0
    spoilt = replace(
        w,
        current=w.current + 3.0 * hidden,
        voltage=w.voltage + 20.0 * hidden,
        current_var=np.where(hidden > 0, UNREAD_VARIANCE, w.current_var),
        voltage_var=UNREAD_VARIANCE * hidden,
    )
    there = hidden.reshape(len(w), -1) > 0
    for name, found in weights(spoilt).items():
        if name in ("current", "voltage"):
            assert np.abs(found[there]).max() < 0.1, name
    counted = replace(spoilt, current_var=w.current_var, voltage_var=w.voltage_var)
    for name, found in weights(counted).items():
        if name in ("current", "voltage"):
            assert np.abs(found[there]).max() > 1.0, name  # weighed as outliers
