"""Thresholds and fuzzy rules flag slip of simulated runs, and correct their paths."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from slipid.lab.systems.motion.reina import ReinaDeterministic, ReinaFuzzy
from slipid.lab.systems.motion.reina_indicators import (
    SlipThresholds,
    SmoothedSignals,
    Sugeno,
)
from slipid.predict.slip_model import TRIES, groups, path_of
from slipid.predict.slip_models import ByFloor
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight
from tests.helpers.patchy_runs import LOST, patchy, slipping

BOTH = [ReinaDeterministic(), ReinaFuzzy()]


def test_slip_is_flagged_by_the_gyro_or_by_all_currents_but_not_by_the_encoders():
    method = ReinaDeterministic(limits=SlipThresholds(0.01, 0.05, 0.4, 0.8), slip=0.5)
    encoder = np.array([5.0, 5.0, 5.0, 0.0])
    current, gyro = np.array([0.2, 1.1, 0.2, 0.2]), np.array([0.3, 0.3, 1.2, 0.3])
    assert (method._moving_score(encoder, current, gyro) >= 1.0).tolist() == [
        False,
        True,
        True,
        False,
    ]
    # without a gyro the encoders take its place
    assert (method._moving_score(encoder, current, None) >= 1.0).tolist() == [
        True,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
@pytest.mark.parametrize("gyro", [False, True])
def test_slip_is_detected_by_the_currents(method, gyro):
    fitted = method.fit([patchy(k, gyro) for k in range(8)], ROBOTINO)
    tests = [patchy(k, gyro) for k in range(100, 105)]
    predicted = fitted.predict([run.signals for run in tests], ROBOTINO)
    truth = np.concatenate([slipping(run) for run in tests])
    score = np.concatenate([one.slipping for one in predicted if one.slipping is not None])
    assert roc_auc_score(truth, score) > 0.9


def test_without_other_signs_the_area_is_that_of_the_currents_themselves():
    """Every increasing function of a signal has the same area under the curve."""
    runs = [patchy(k, overlap=0.3) for k in range(8)]
    steady = [replace(run, signals=replace(run.signals, command=None)) for run in runs]
    method = ReinaDeterministic(smoothing=1e-3).fit(steady, ROBOTINO)
    method = replace(method, limits=replace(method.limits, change=1e9))
    predicted = method.predict([run.signals for run in steady], ROBOTINO)
    score = np.concatenate([one.slipping for one in predicted if one.slipping is not None])
    truth = np.concatenate([slipping(run) for run in steady])
    amps = np.concatenate([SmoothedSignals.of(r.signals, ROBOTINO, 1e-3).amps for r in steady])
    raised = np.maximum(amps - method.limits.current_low, 0.0)
    assert 0.6 < roc_auc_score(truth, score) < 0.97
    assert roc_auc_score(truth, score.round(6)) == pytest.approx(
        roc_auc_score(truth, raised.round(6))
    )


def test_fuzzy_rules_detect_more_than_thresholds_where_the_gyro_misleads():
    """Here the yaw rate is off where nothing slips; training turns that sign around."""
    runs = []
    for k in range(12):
        run = patchy(k, overlap=0.4)
        yaw = run.twist[:, 2] + np.where(slipping(run), 0.0, 0.2)
        gyro = run.signals.rolling(ROBOTINO)[:, 2] - (yaw - run.twist[:, 2])
        runs.append(replace(run, signals=replace(run.signals, gyro=gyro)))
    truth = np.concatenate([slipping(run) for run in runs[8:]])

    def area(method):
        predicted = method.fit(runs[:8], ROBOTINO).predict([r.signals for r in runs[8:]], ROBOTINO)
        return roc_auc_score(truth, np.concatenate([one.slipping for one in predicted]))

    assert area(ReinaFuzzy()) > area(ReinaDeterministic()) + 0.2


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_what_is_flagged_loses_what_flagged_training_windows_lost(method):
    runs = [patchy(k, overlap=0.0) for k in range(10)]
    fitted = replace(method, smoothing=1e-3, quantile=1.0).fit(runs, ROBOTINO)
    assert fitted.slip == pytest.approx(LOST, abs=0.01)
    run = patchy(99, overlap=0.0)
    predicted = fitted.predict([run.signals], ROBOTINO)[0]
    kept = np.where(slipping(run), 1.0 - fitted.slip, 1.0)[:, None]
    path = path_of(run.signals.rolling(ROBOTINO) * kept, run.signals.dt)
    assert predicted.path == pytest.approx(path, abs=1e-6)
    rolled = path_of(run.signals.rolling(ROBOTINO), run.signals.dt)
    assert np.linalg.norm(predicted.path[-1] - run.pose[-1]) < 0.1 * np.linalg.norm(
        rolled[-1] - run.pose[-1]
    )


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_where_nothing_slipped_the_path_is_that_of_the_encoders(method):
    runs = [patchy(k, lost=0.0) for k in range(5)]
    measured = replace(patchy(7).signals, current=np.full((100, 3), 0.5))
    predicted = method.fit(runs, ROBOTINO).predict([measured], ROBOTINO)[0]
    assert predicted.path == pytest.approx(
        path_of(measured.rolling(ROBOTINO), measured.dt), abs=1e-6
    )


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_where_all_slips_all_is_flagged(method):
    runs = [made_run(straight(a), straight(a) * 0.5, current=np.ones((40, 3))) for a in (0.3, 1.1)]
    rng = np.random.default_rng(0)
    runs = [
        replace(r, signals=replace(r.signals, current=1.0 + 0.1 * rng.random((40, 3))))
        for r in runs
    ]
    predicted = method.fit(runs, ROBOTINO).predict([runs[0].signals], ROBOTINO)[0]
    assert predicted.path[-1] == pytest.approx(runs[0].pose[-1], abs=0.02)


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_a_robot_that_stands_does_not_slip(method):
    still = made_run(np.zeros((40, 3)), current=np.full((40, 3), 3.0))
    fitted = method.fit([*[patchy(k) for k in range(5)], still], ROBOTINO)
    predicted = fitted.predict([still.signals], ROBOTINO)[0]
    assert predicted.slipping == pytest.approx(np.zeros(40))
    assert predicted.path == pytest.approx(np.zeros((41, 3)))


def test_a_gyro_that_some_runs_lack_does_not_count():
    runs = [patchy(k, gyro=k % 2 == 0) for k in range(8)]
    for method in BOTH:
        fitted = method.fit(runs, ROBOTINO)
        without = replace(runs[0].signals, gyro=None)
        with_, bare = fitted.predict([runs[0].signals, without], ROBOTINO)
        assert with_.slipping == pytest.approx(bare.slipping)


def test_a_gyro_that_is_missing_after_training_indicates_no_slip():
    fitted = ReinaFuzzy().fit([patchy(k, gyro=True) for k in range(8)], ROBOTINO)
    run = patchy(50, gyro=True)
    rolling = run.signals.rolling(ROBOTINO)[:, 2]
    agreeing, bare = fitted.predict(
        [replace(run.signals, gyro=rolling), replace(run.signals, gyro=None)], ROBOTINO
    )
    assert agreeing.slipping == pytest.approx(bare.slipping)


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_skid_steer_and_floors(method):
    runs = []
    for k in range(6):
        rolling = np.tile([0.5, 0.0, 0.2 * k], (40, 1))
        slow = rolling * [0.7, 1.0, 0.5]
        amps = np.full((40, 2), 4.0) + 0.1 * np.random.default_rng(k).normal(size=(40, 2))
        gyro = slow[:, 2]
        runs.append(made_run(rolling, slow, spec=HUSKY, current=amps, gyro=gyro, floor="grass"))
    fitted = ByFloor.of(method).fit(runs, HUSKY)
    predicted = fitted.predict([run.signals for run in runs], HUSKY)
    assert np.isfinite(np.concatenate([one.path for one in predicted])).all()
    assert predicted[0].path[-1, 0] == pytest.approx(runs[0].pose[-1, 0], rel=0.1)


def test_settings_to_try_and_numbers_fitted():
    for method in BOTH:
        tried = method.candidates()
        assert len({repr(one) for one in tried}) == len(tried) <= TRIES
        assert {one.name for one in tried} == {method.name}
        assert method.needs == {"current"}
    assert ReinaDeterministic().fit([patchy(0)], ROBOTINO).numbers == 4
    assert ReinaDeterministic().fit([patchy(0, gyro=True)], ROBOTINO).numbers == 5
    assert ReinaFuzzy(sets=3).fit([patchy(0)], ROBOTINO).numbers == 4 + 9
    assert ReinaFuzzy(sets=2).fit([patchy(0, gyro=True)], ROBOTINO).numbers == 5 + 8


def test_windows_that_slip_are_those_of_more_than_a_fifth_with_turning_in_metres():
    """A yaw rate 0.15 rad/s below 1 rad/s is a slip of 0.15; one of 0.25 is above the limit."""
    for short, slips in ((0.15, False), (0.25, True)):
        rolling = np.tile([0.0, 0.0, 1.0], (40, 1))
        run = made_run(rolling, rolling * (1.0 - short), current=np.ones((40, 3)))
        fitted = ReinaFuzzy().fit([run], ROBOTINO)
        predicted = fitted.predict([run.signals], ROBOTINO)[0]
        assert predicted.slipping is not None
        assert (np.median(predicted.slipping) > 0.5) == slips
        assert len(groups(run.signals.dt, 0.5)) == 8


@pytest.mark.parametrize(("answer", "kept"), [(0.55, 0.7), (0.45, 1.0)])
def test_fuzzy_answers_flag_slip_from_one_half_on(answer, kept):
    method = ReinaFuzzy(
        rules=Sugeno(2, np.full(4, answer)), slip=0.3, limits=SlipThresholds(turning=np.inf)
    )
    run = patchy(3)
    predicted = method.predict([run.signals], ROBOTINO)[0]
    path = path_of(kept * run.signals.rolling(ROBOTINO), run.signals.dt)
    assert predicted.path == pytest.approx(path)
