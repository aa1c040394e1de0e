"""Indicators of slip: fuzzy rules by hand and by scikit-learn, thresholds, flags and paths."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.linear_model import Ridge
from sklearn.metrics import roc_auc_score

from slipid.baselines.interface import TRIES, ByFloor, Run, groups, path_of
from slipid.baselines.motion.fuzzy import Sugeno
from slipid.baselines.motion.reina import (
    Indicators,
    Limits,
    ReinaDeterministic,
    ReinaFuzzy,
    Signals,
    smoothing,
)
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight

BOTH = [ReinaDeterministic(), ReinaFuzzy()]
LOST = 0.4
"""What the made runs lose of their twist where they slip."""


def patchy(seed: int, gyro: bool = False, overlap: float = 0.02, lost: float = LOST) -> Run:
    """A run that slips in some windows of half a second; there its currents are higher."""
    rng = np.random.default_rng(seed)
    slips = np.repeat(rng.random(20) < 0.4, 5)
    rolling = straight(rng.uniform(-np.pi, np.pi), 0.2, 100)
    rolling[:, 2] = 0.3
    rolling *= rng.uniform(0.99, 1.01, (100, 1))
    twist = rolling * np.where(slips, 1.0 - lost, 1.0)[:, None]
    current = np.where(slips, 0.9, 0.5)[:, None] + overlap * rng.normal(size=(100, 3))
    yaw = twist[:, 2] + 0.001 * rng.normal(size=100) if gyro else None
    return made_run(rolling, twist, current=np.abs(current), gyro=yaw, name=f"made{seed}")


def slipping(run: Run) -> np.ndarray:
    """Which steps of a run of 0.1 s slip."""
    rolling = run.heard.rolling(ROBOTINO)
    return np.linalg.norm(rolling - run.twist, axis=1) > 0.2 * np.linalg.norm(rolling, axis=1)


def test_two_rules_by_hand():
    rules = Sugeno(2, np.array([0.1, 0.9]))
    assert rules.infer(np.array([[0.3]]))[0] == pytest.approx(0.7 * 0.1 + 0.3 * 0.9)
    assert rules.infer(np.array([[-1.0], [2.0]])) == pytest.approx([0.1, 0.9])


def test_two_inputs_with_two_sets_are_bilinear_and_the_last_changes_fastest():
    rng = np.random.default_rng(0)
    a, b, c, d = rng.normal(size=4)
    x, y = rng.random((2, 30))
    told = Sugeno(2, np.array([a, b, c, d])).infer(np.stack([x, y], axis=1))
    assert told == pytest.approx((1 - x) * ((1 - y) * a + y * b) + x * ((1 - y) * c + y * d))


def test_three_sets_are_linear_from_peak_to_peak():
    rules = Sugeno(3, np.array([0.2, 1.0, -0.4]))
    x = np.linspace(0.0, 1.0, 41)
    assert rules.infer(x[:, None]) == pytest.approx(np.interp(x, [0.0, 0.5, 1.0], [0.2, 1.0, -0.4]))
    strengths = Sugeno.logical_or(2, 3).strengths(np.random.default_rng(1).random((20, 2)))
    assert strengths.shape == (20, 9)
    assert strengths.sum(axis=1) == pytest.approx(np.ones(20))


def test_untrained_rules_are_a_logical_or():
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    assert Sugeno.logical_or(2, 2).infer(corners) == pytest.approx([0.0, 1.0, 1.0, 1.0])


def test_trained_consequents_are_those_of_ridge_regression_around_the_untrained():
    rng = np.random.default_rng(2)
    x, wanted = rng.random((50, 2)), (rng.random(50) < 0.5).astype(float)
    start = Sugeno.logical_or(2, 3)
    fires = start.strengths(x)
    ridge = Ridge(alpha=1.0, fit_intercept=False).fit(fires, wanted - fires @ start.consequents)
    assert start.trained(x, wanted).consequents == pytest.approx(start.consequents + ridge.coef_)


def test_a_rule_that_never_fires_keeps_its_answer():
    start = Sugeno.logical_or(2, 2)
    trained = start.trained(np.tile([1.0, 0.0], (500, 1)), np.zeros(500))
    assert trained.consequents[[0, 1, 3]] == pytest.approx(start.consequents[[0, 1, 3]])
    assert trained.consequents[2] == pytest.approx(0.0, abs=0.01)


def test_smoothing_is_the_recursive_filter_that_starts_with_the_first_value():
    x = np.random.default_rng(3).normal(size=40)
    kept = np.exp(-0.1 / 0.3)
    above = weight = 0.0
    recursive = []
    for value in x:
        above, weight = kept * above + value, kept * weight + 1.0
        recursive.append(above / weight)
    assert smoothing(np.full(40, 0.1), 0.3) @ x == pytest.approx(np.array(recursive))


def test_smoothing_of_uneven_steps_weighs_them_by_their_length():
    mean = smoothing(np.array([0.1, 0.3, 0.1]), 0.5)
    weights = np.array([0.1 * np.exp(-0.2 / 0.5), 0.3])
    assert mean[1] == pytest.approx([*(weights / weights.sum()), 0.0])


def test_a_wheel_off_the_commanded_shape_is_told_by_the_encoder_indicator():
    run = made_run(np.tile([1.0, 0.0, 0.0], (20, 1)), current=np.ones((20, 2)), machine=HUSKY)
    heard = replace(run.heard, turn=run.heard.turn * [1.0, 1.4])
    signals = Signals.of(heard, HUSKY, 0.3)
    # of two wheels, the median ratio is in their middle
    assert signals.deviation == pytest.approx(np.full(20, 0.2 / 1.2), rel=1e-5)
    uncommanded = Signals.of(replace(heard, command=None), HUSKY, 0.3)
    assert uncommanded.deviation == pytest.approx(np.zeros(20), abs=1e-6)


def test_a_slow_wheel_counts_in_units_of_the_fastest():
    run = made_run(straight(0.0, 0.2, 20), current=np.ones((20, 3)))
    rim = run.heard.speed * ROBOTINO.wheel_radius + [0.0, 0.01, 0.0]
    heard = replace(run.heard, turn=rim / ROBOTINO.wheel_radius * 0.1)
    fastest = 0.2 * np.cos(np.pi / 6)
    deviation = Signals.of(heard, ROBOTINO, 0.3).deviation
    assert deviation == pytest.approx(np.full(20, 0.01 / (0.3 * fastest)), rel=1e-4)


def test_accelerations_are_those_of_the_fastest_changing_wheel():
    rolling = np.outer(np.linspace(0.0, 1.9, 20), [0.1, 0.0, 0.0])
    change = Signals.of(made_run(rolling, current=np.ones((20, 3))).heard, ROBOTINO, 1e-3).change
    assert change[1:] == pytest.approx(np.full(19, np.cos(np.pi / 6) / 0.04 * 0.1), rel=1e-4)


def test_the_smallest_current_is_that_of_the_wheels_that_drive():
    current = np.tile([0.6, 0.1, 0.7], (20, 1))
    ahead = Signals.of(made_run(straight(0.0, 0.2, 20), current=current).heard, ROBOTINO, 0.3)
    assert ahead.amps == pytest.approx(np.full(20, 0.6))
    turning = np.tile([0.0, 0.0, 1.0], (20, 1))
    around = Signals.of(made_run(turning, current=current).heard, ROBOTINO, 0.3)
    assert around.amps == pytest.approx(np.full(20, 0.1))


def test_indicators_are_signals_over_their_limits():
    run = patchy(0, gyro=True)
    signals = Signals.of(run.heard, ROBOTINO, 1e-3)
    limits = Limits(change=2.0, turning=0.06, usual=0.4, highest=0.8)
    told = Indicators.of(signals, limits)
    assert run.heard.current is not None
    fastest = np.abs(run.heard.speed).max(axis=1, keepdims=True)
    amps = np.where(np.abs(run.heard.speed) > 0.3 * fastest, run.heard.current, np.inf).min(axis=1)
    assert told.current == pytest.approx((amps - 0.4) / 0.4)
    assert run.heard.gyro is not None
    assert told.gyro == pytest.approx(
        np.abs(run.heard.rolling(ROBOTINO)[:, 2] - run.heard.gyro) / 0.06, rel=1e-3
    )
    assert (told.encoder >= signals.change / 2.0).all()
    assert Indicators.of(signals, replace(limits, turning=np.inf)).gyro is None


def test_limits_are_quantiles_of_the_steps_that_do_not_slip():
    runs = [patchy(k, gyro=True) for k in range(6)]
    limits = ReinaDeterministic(quantile=0.9).fit(runs, ROBOTINO).limits
    firm = ~np.concatenate([slipping(run) for run in runs])
    signals = [Signals.of(run.heard, ROBOTINO, 0.3) for run in runs]
    amps = np.concatenate([s.amps for s in signals])[firm]
    assert limits.usual == pytest.approx(np.median(amps))
    assert limits.highest == pytest.approx(np.quantile(amps, 0.9))
    turning = np.concatenate([s.turning for s in signals if s.turning is not None])[firm]
    assert limits.turning == pytest.approx(np.quantile(turning, 0.9))
    change = np.concatenate([s.change for s in signals])[firm]
    assert limits.change == pytest.approx(np.quantile(change, 0.9))


def test_slip_is_flagged_by_the_gyro_or_by_all_currents_but_not_by_the_encoders():
    method = ReinaDeterministic(limits=Limits(0.01, 0.05, 0.4, 0.8), slip=0.5)
    encoder = np.array([5.0, 5.0, 5.0, 0.0])
    current, gyro = np.array([0.2, 1.1, 0.2, 0.2]), np.array([0.3, 0.3, 1.2, 0.3])
    assert (method._answer(Indicators(encoder, current, gyro)) >= 1.0).tolist() == [
        False,
        True,
        True,
        False,
    ]
    # without a gyro the encoders take its place
    assert (method._answer(Indicators(encoder, current, None)) >= 1.0).tolist() == [
        True,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
@pytest.mark.parametrize("gyro", [False, True])
def test_slip_is_detected_where_it_is_told_by_the_currents(method, gyro):
    fitted = method.fit([patchy(k, gyro) for k in range(8)], ROBOTINO)
    tests = [patchy(k, gyro) for k in range(100, 105)]
    said = fitted.predict([run.heard for run in tests], ROBOTINO)
    truth = np.concatenate([slipping(run) for run in tests])
    score = np.concatenate([one.slipping for one in said if one.slipping is not None])
    assert roc_auc_score(truth, score) > 0.9


def test_without_other_signs_the_area_is_that_of_the_currents_themselves():
    """Any rising function of a signal has its area under the curve."""
    runs = [patchy(k, overlap=0.3) for k in range(8)]
    steady = [replace(run, heard=replace(run.heard, command=None)) for run in runs]
    method = ReinaDeterministic(smoothing=1e-3).fit(steady, ROBOTINO)
    method = replace(method, limits=replace(method.limits, change=1e9))
    said = method.predict([run.heard for run in steady], ROBOTINO)
    score = np.concatenate([one.slipping for one in said if one.slipping is not None])
    truth = np.concatenate([slipping(run) for run in steady])
    amps = np.concatenate([Signals.of(r.heard, ROBOTINO, 1e-3).amps for r in steady])
    raised = np.maximum(amps - method.limits.usual, 0.0)
    assert 0.6 < roc_auc_score(truth, score) < 0.97
    assert roc_auc_score(truth, score.round(6)) == pytest.approx(
        roc_auc_score(truth, raised.round(6))
    )


def test_fuzzy_rules_tell_more_than_thresholds_where_the_gyro_misleads():
    """Here the yaw rate is off where nothing slips; training turns that sign around."""
    runs = []
    for k in range(12):
        run = patchy(k, overlap=0.4)
        yaw = run.twist[:, 2] + np.where(slipping(run), 0.0, 0.2)
        gyro = run.heard.rolling(ROBOTINO)[:, 2] - (yaw - run.twist[:, 2])
        runs.append(replace(run, heard=replace(run.heard, gyro=gyro)))
    truth = np.concatenate([slipping(run) for run in runs[8:]])

    def area(method):
        said = method.fit(runs[:8], ROBOTINO).predict([r.heard for r in runs[8:]], ROBOTINO)
        return roc_auc_score(truth, np.concatenate([one.slipping for one in said]))

    assert area(ReinaFuzzy()) > area(ReinaDeterministic()) + 0.2


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_what_is_flagged_loses_what_flagged_training_windows_lost(method):
    runs = [patchy(k, overlap=0.0) for k in range(10)]
    fitted = replace(method, smoothing=1e-3, quantile=1.0).fit(runs, ROBOTINO)
    assert fitted.slip == pytest.approx(LOST, abs=0.01)
    run = patchy(99, overlap=0.0)
    said = fitted.predict([run.heard], ROBOTINO)[0]
    kept = np.where(slipping(run), 1.0 - fitted.slip, 1.0)[:, None]
    path = path_of(run.heard.rolling(ROBOTINO) * kept, run.heard.dt)
    assert said.path == pytest.approx(path, abs=1e-6)
    rolled = path_of(run.heard.rolling(ROBOTINO), run.heard.dt)
    assert np.linalg.norm(said.path[-1] - run.pose[-1]) < 0.1 * np.linalg.norm(
        rolled[-1] - run.pose[-1]
    )


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_where_nothing_slipped_the_path_is_that_of_the_encoders(method):
    runs = [patchy(k, lost=0.0) for k in range(5)]
    heard = replace(patchy(7).heard, current=np.full((100, 3), 0.5))
    said = method.fit(runs, ROBOTINO).predict([heard], ROBOTINO)[0]
    assert said.path == pytest.approx(path_of(heard.rolling(ROBOTINO), heard.dt), abs=1e-6)


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_where_all_slips_all_is_flagged(method):
    runs = [made_run(straight(a), straight(a) * 0.5, current=np.ones((40, 3))) for a in (0.3, 1.1)]
    rng = np.random.default_rng(0)
    runs = [
        replace(r, heard=replace(r.heard, current=1.0 + 0.1 * rng.random((40, 3)))) for r in runs
    ]
    said = method.fit(runs, ROBOTINO).predict([runs[0].heard], ROBOTINO)[0]
    assert said.path[-1] == pytest.approx(runs[0].pose[-1], abs=0.02)


@pytest.mark.parametrize("method", BOTH, ids=lambda method: method.name)
def test_a_robot_that_stands_does_not_slip(method):
    still = made_run(np.zeros((40, 3)), current=np.full((40, 3), 3.0))
    fitted = method.fit([*[patchy(k) for k in range(5)], still], ROBOTINO)
    said = fitted.predict([still.heard], ROBOTINO)[0]
    assert said.slipping == pytest.approx(np.zeros(40))
    assert said.path == pytest.approx(np.zeros((41, 3)))


def test_a_gyro_that_some_runs_lack_does_not_count():
    runs = [patchy(k, gyro=k % 2 == 0) for k in range(8)]
    for method in BOTH:
        fitted = method.fit(runs, ROBOTINO)
        without = replace(runs[0].heard, gyro=None)
        with_, bare = fitted.predict([runs[0].heard, without], ROBOTINO)
        assert with_.slipping == pytest.approx(bare.slipping)


def test_a_gyro_that_is_lacking_only_later_says_nothing():
    fitted = ReinaFuzzy().fit([patchy(k, gyro=True) for k in range(8)], ROBOTINO)
    run = patchy(50, gyro=True)
    rolling = run.heard.rolling(ROBOTINO)[:, 2]
    agreeing, bare = fitted.predict(
        [replace(run.heard, gyro=rolling), replace(run.heard, gyro=None)], ROBOTINO
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
        runs.append(made_run(rolling, slow, machine=HUSKY, current=amps, gyro=gyro, floor="grass"))
    fitted = ByFloor.of(method).fit(runs, HUSKY)
    said = fitted.predict([run.heard for run in runs], HUSKY)
    assert np.isfinite(np.concatenate([one.path for one in said])).all()
    assert said[0].path[-1, 0] == pytest.approx(runs[0].pose[-1, 0], rel=0.1)


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
    """Turning 0.15 of 1 rad/s too little is 0.15 of what the encoders say; 0.25 is a fifth more."""
    for short, slips in ((0.15, False), (0.25, True)):
        rolling = np.tile([0.0, 0.0, 1.0], (40, 1))
        run = made_run(rolling, rolling * (1.0 - short), current=np.ones((40, 3)))
        fitted = ReinaFuzzy().fit([run], ROBOTINO)
        said = fitted.predict([run.heard], ROBOTINO)[0]
        assert said.slipping is not None
        assert (np.median(said.slipping) > 0.5) == slips
        assert len(groups(run.heard.dt, 0.5)) == 8


@pytest.mark.parametrize(("answer", "kept"), [(0.55, 0.7), (0.45, 1.0)])
def test_fuzzy_answers_flag_slip_from_one_half_on(answer, kept):
    method = ReinaFuzzy(
        rules=Sugeno(2, np.full(4, answer)), slip=0.3, limits=Limits(turning=np.inf)
    )
    run = patchy(3)
    said = method.predict([run.heard], ROBOTINO)[0]
    path = path_of(kept * run.heard.rolling(ROBOTINO), run.heard.dt)
    assert said.path == pytest.approx(path)
