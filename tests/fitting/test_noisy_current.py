"""A noisy ammeter must not make R too small; `benchmarks/bench_noisy_current.py` has many more."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import noisy_current as made
from tests.helpers.kept import kept


def attenuated(this):
    """R and C_e by regression of the voltage on the measured current, in logs less the truth."""
    w = this.windows
    x = np.stack([w.current.ravel(), 16 * (w.turn / w.dt[..., None]).ravel()], axis=1)
    return np.log(np.linalg.lstsq(x, w.voltage.ravel(), rcond=None)[0] / list(made.MOTOR.values()))


@pytest.mark.parametrize("signed", kept([True, False], [False]))
@pytest.mark.slow
def test_noise_as_large_as_the_signal_does_not_attenuate_the_resistance(signed):
    this = made.experiment(0, 0.1, signed)
    flowing = made.experiment(0, 0.0).windows.current
    assert flowing.std() == pytest.approx(made.SIGNAL, rel=0.05)
    if signed:  # what taking the ammeter at its word comes to
        assert attenuated(this)[0] < -0.4
    found = made.fitted(this)
    assert found.converged
    assert (np.abs(found.error) < 3 * found.std).all()
    assert (found.std < [0.04, 0.01]).all()


@pytest.mark.nightly
def test_motors_are_recovered_without_bias():
    found = [made.fitted(made.experiment(seed, 0.05)) for seed in range(24)]
    z = np.array([f.error / f.std for f in found])
    assert (np.abs(z.mean(axis=0)) < 4 / np.sqrt(len(z))).all()
    inside = (np.abs(z) < 1.645).mean()
    assert 0.75 < inside <= 0.98  # 48 intervals of 90 %
