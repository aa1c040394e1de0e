"""The law and the noise of simulated runs are recovered."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.motion.ward_iagnemma import PosedWindows, WardIagnemma
from slipid.lab.systems.motion.ward_iagnemma_dynamics import motor_forces
from tests.helpers.driven_runs import FLOOR, TRUE, driven, pulling, scattered
from tests.helpers.made_runs import ROBOTINO


@pytest.mark.slow
def test_the_law_is_found_again():
    fitted = WardIagnemma().fit([driven(FLOOR, k) for k in range(20)], ROBOTINO)
    assert fitted.law.rise == pytest.approx(FLOOR.rise, rel=0.1)
    assert fitted.law.rolling == pytest.approx(FLOOR.rolling, rel=0.1)
    assert fitted.law.turning == pytest.approx(FLOOR.turning, rel=0.15)
    assert fitted.law.drag == pytest.approx(FLOOR.drag, rel=0.2)
    plain = replace(FLOOR, drag=0.0)
    runs = [driven(plain, k) for k in range(5)]
    assert WardIagnemma(with_drag=False).fit(runs, ROBOTINO).law.drag == 0.0


@pytest.mark.slow
def test_noise_is_found_again():
    true, fitted = TRUE, WardIagnemma().fit(scattered(40, True), ROBOTINO).noise
    assert fitted.bias == pytest.approx(true.bias, rel=0.3)
    assert fitted.gyro == pytest.approx(true.gyro, rel=0.15)
    # what of the drift goes along the motion is partly taken for resistance
    assert fitted.drift[2] == pytest.approx(true.drift[2], rel=0.5)
    assert fitted.rolling == pytest.approx(true.rolling, rel=0.6)


@pytest.mark.slow
def test_gain_and_offset_of_the_currents_are_found_again():
    runs = [pulling(driven(FLOOR, k), FLOOR, 1.3, 2.0) for k in range(20)]
    fitted = WardIagnemma.with_current().fit(runs, ROBOTINO)
    assert fitted.noise.gain == pytest.approx(1.3, rel=0.03)
    assert fitted.noise.offset == pytest.approx(2.0, abs=0.3)
    assert fitted.noise.force < 0.5


@pytest.mark.slow
def test_the_noise_of_currents_is_that_of_the_means_of_runs():
    """A constant error of a run has the weight of its effect on the run's mean."""
    rng = np.random.default_rng(1)
    runs = []
    for k in range(30):
        run = pulling(driven(FLOOR, k), FLOOR, 1.0, rng.normal())
        runs.append(run)
    noise = WardIagnemma.with_current().fit(runs, ROBOTINO).noise
    counts = [np.isfinite(motor_forces(run.signals.windowed(), ROBOTINO)).sum() for run in runs]
    assert noise.force == pytest.approx(np.sqrt(np.mean(counts) / 3), rel=0.35)


def test_windows_are_drawn_from_few_runs_and_thinned_evenly():
    windows = PosedWindows.of([driven(FLOOR, k) for k in range(45)], ROBOTINO)
    assert len(np.unique(windows.run)) == 40
    assert len(windows.dt) == 40 * 8
    assert windows.thinned(100).run.tolist() == windows.run[::4].tolist()
    assert len(windows.thinned(1000).dt) == 320
