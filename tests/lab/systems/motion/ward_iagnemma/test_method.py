"""Ends and scores of simulated runs agree with the method's uncertainty."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from slipid.lab.systems.motion.ward_iagnemma import WardIagnemma
from slipid.lab.systems.motion.ward_iagnemma_dynamics import ForceLaw
from slipid.lab.systems.motion.ward_iagnemma_filter import FilterNoise
from slipid.predict.slip_model import TRIES, body_increments
from slipid.predict.slip_models import ByFloor
from tests.helpers.driven_runs import FLOOR, MACHINES, TRUE, driven, pulling, scattered
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight


def test_a_robot_that_stands_keeps_standing():
    still = made_run(np.zeros((40, 3)), current=np.full((40, 3), 0.5), gyro=np.full(40, 0.02))
    for method in (WardIagnemma(), WardIagnemma.with_current()):
        predicted = method.predict([still.signals], ROBOTINO)[0]
        assert predicted.path[:, :2] == pytest.approx(np.zeros((41, 2)), abs=1e-6)
        assert predicted.slipping == pytest.approx(np.zeros(40))
    without = replace(still.signals, gyro=None)
    assert WardIagnemma().predict([without], ROBOTINO)[0].path == pytest.approx(np.zeros((41, 3)))


def test_wheels_that_spin_on_the_spot_are_detected():
    run = made_run(straight(0.0), current=np.ones((40, 3)))
    stuck = WardIagnemma(law=ForceLaw(rolling=2.0), noise=FilterNoise(rolling=1e-6))
    rolls = WardIagnemma(law=ForceLaw(rise=200.0, rolling=1e-3), noise=FilterNoise(rolling=1e-6))
    assert (stuck.predict([run.signals], ROBOTINO)[0].slipping[3:] > 0.8).all()
    assert (rolls.predict([run.signals], ROBOTINO)[0].slipping < 0.05).all()


@pytest.mark.slow
@MACHINES
def test_runs_by_the_law_are_predicted(spec):
    runs = [driven(FLOOR, k, spec) for k in range(14)]
    fitted = WardIagnemma().fit(runs[:10], spec)
    foretold = fitted.predict([run.signals for run in runs[10:]], spec)
    # after the wheels change, the robot's mass needs some steps to follow
    settled = np.r_[10:20, 30:40]
    for run, predicted in zip(runs[10:], foretold, strict=True):
        twist = body_increments(predicted.path) / run.signals.dt[:, None]
        off = np.abs((twist - run.twist) * spec.size)[settled]
        slip = np.abs((run.signals.rolling(spec) - run.twist) * spec.size)[settled]
        assert off.max() < 0.05 * slip.max()


@pytest.mark.slow
@pytest.mark.parametrize("gyro", [False, True])
def test_nine_ends_of_ten_lie_in_their_regions(gyro):
    runs = scattered(400, gyro)
    method = WardIagnemma(law=FLOOR, noise=TRUE)
    predicted = method.predict([run.signals for run in runs], ROBOTINO)
    off = np.array(
        [one.path[-1, :2] - run.pose[-1, :2] for one, run in zip(predicted, runs, strict=True)]
    )
    spread = np.array([one.end_covariance for one in predicted])
    square = np.einsum("ri,rij,rj->r", off, np.linalg.inv(spread), off)
    assert np.mean(square < chi2.ppf(0.9, 2)) == pytest.approx(0.9, abs=0.045)
    assert square.mean() == pytest.approx(2.0, rel=0.2)


@pytest.mark.slow
def test_the_gyro_makes_the_end_surer():
    noise = FilterNoise(0.03, (0.003, 0.004, 0.02), 0.001, 0.001)
    method = WardIagnemma(law=FLOOR, noise=noise)
    for run in scattered(3, True):
        sure, unsure = method.predict([run.signals, replace(run.signals, gyro=None)], ROBOTINO)
        assert np.linalg.det(sure.end_covariance) < 0.2 * np.linalg.det(unsure.end_covariance)


def test_currents_identify_runs_with_more_resistance():
    heavier = replace(FLOOR, rolling=0.25)
    noise = FilterNoise(rolling=0.05, drift=(1e-3, 1e-3, 1e-3), force=0.5)
    run = pulling(driven(heavier, 5), FLOOR, 1.0, 0.0)
    method = replace(WardIagnemma.with_current(), law=FLOOR, noise=noise)
    deaf = replace(method, needs=frozenset())
    ends = [m.predict([run.signals], ROBOTINO)[0].path[-1, :2] for m in (method, deaf)]
    off = [np.linalg.norm(end - run.pose[-1, :2]) for end in ends]
    assert off[0] < 0.3 * off[1]


def test_runs_do_not_affect_those_beside_them():
    short = driven(FLOOR, 1).signals
    long = made_run(straight(1.0, 0.2, 70), gyro=np.zeros(70), current=np.ones((70, 3))).signals
    method = WardIagnemma(law=FLOOR)
    both, alone = method.predict([long, short], ROBOTINO)[1], method.predict([short], ROBOTINO)[0]
    assert both.path == pytest.approx(alone.path, abs=1e-7)
    assert both.end_covariance == pytest.approx(alone.end_covariance, rel=1e-4)


def test_rho_that_wanders_makes_the_end_less_sure():
    measured = made_run(straight(0.2)).signals
    noise = FilterNoise(0.02, (1e-4, 1e-4, 1e-4))
    spread = [
        np.trace(
            WardIagnemma(law=FLOOR, noise=noise, wander=w)
            .predict([measured], ROBOTINO)[0]
            .end_covariance
        )
        for w in (0.0, 0.5)
    ]
    # over 4 s: T^2 of the start, and w^2 T^3 / 3 more
    assert spread[1] / spread[0] == pytest.approx(1.0 + 0.25 * 4.0 / 3.0, rel=0.05)


def test_a_skid_steer_that_turns_with_a_gyro_and_by_floor():
    runs = [driven(FLOOR, k, HUSKY) for k in range(8)]
    measured = [replace(r.signals, gyro=r.twist[:, 2]) for r in runs]
    runs = [replace(r, signals=h) for r, h in zip(runs, measured, strict=True)]
    fitted = ByFloor.of(WardIagnemma()).fit(runs, HUSKY)
    for run, predicted in zip(runs, fitted.predict(measured, HUSKY), strict=True):
        assert predicted.path[-1, 2] == pytest.approx(run.pose[-1, 2], abs=0.02)
        assert predicted.path[-1, :2] == pytest.approx(run.pose[-1, :2], abs=0.05)


def test_settings_to_try_and_numbers_fitted():
    method, measured = WardIagnemma(), WardIagnemma.with_current()
    assert (method.name, method.needs) == ("ward_iagnemma", frozenset())
    assert (measured.name, measured.needs) == ("ward_iagnemma_current", {"current"})
    for one in (method, measured):
        tried = one.candidates()
        assert len({repr(m) for m in tried}) == len(tried) <= TRIES
        assert {(m.name, m.needs) for m in tried} == {(one.name, one.needs)}
    assert (method.numbers, replace(method, with_drag=False).numbers, measured.numbers) == (
        8,
        7,
        11,
    )
    run = driven(FLOOR, 0)
    run = replace(run, signals=replace(run.signals, gyro=run.twist[:, 2]))
    assert method.fit([run], ROBOTINO).numbers == 10
