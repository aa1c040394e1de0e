"""Features of floor classifiers, and accumulation of their evidence."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.floors.cosine_energy import CosineEnergyClassifier
from slipid.lab.systems.floors.interface import (
    DEFAULT_CHANNELS,
    TrailingWindow,
    accumulated,
    training_rows,
)
from slipid.lab.systems.floors.learned import (
    SPEEDS_ONLY,
    BoostedTreesClassifier,
    GaussianClassifier,
    features,
)
from tests.helpers.made_floor_runs import HZ, ahead, made_floor_run, made_floor_runs
from tests.helpers.made_runs import HUSKY

LOG = np.log(np.array([[0.6, 0.4], [0.9, 0.1], [0.2, 0.8]]))


def test_beliefs_are_products_of_likelihoods_and_are_normalised():
    run = made_floor_run("grass", ahead(3), 2.0)
    beliefs = accumulated(LOG, run, apart_s=1 / HZ)
    likelihood = np.cumprod(np.exp(LOG), axis=0)
    assert np.allclose(beliefs, likelihood / likelihood.sum(axis=1, keepdims=True))


def test_rows_that_are_near_count_as_fewer_witnesses():
    run = made_floor_run("grass", ahead(3), 2.0)
    beliefs = accumulated(LOG, run, apart_s=2 / HZ)
    likelihood = np.cumprod(np.exp(LOG / 2), axis=0)
    assert np.allclose(beliefs, likelihood / likelihood.sum(axis=1, keepdims=True))


def test_memory_fades_by_hand():
    run = made_floor_run("grass", ahead(3), 2.0)
    memory = 0.5
    keep = np.exp(-1 / HZ / memory)
    log = ((LOG[0] * keep) + LOG[1]) * keep + LOG[2]
    beliefs = accumulated(LOG, run, apart_s=1 / HZ, memory_s=memory)
    assert np.allclose(beliefs[-1], np.exp(log) / np.exp(log).sum())


def test_a_robot_that_stands_learns_nothing():
    run = made_floor_run("grass", np.array([[1.0, 1.0], [0.0, 0.0], [1.0, 1.0]]), 2.0)
    beliefs = accumulated(LOG, run, apart_s=1.0, memory_s=1.0)
    assert np.allclose(beliefs[1], beliefs[0])
    assert not np.allclose(beliefs[2], beliefs[1])


def test_a_row_without_a_likelihood_changes_nothing():
    log = LOG.copy()
    log[1, 0] = np.nan
    beliefs = accumulated(log, made_floor_run("grass", ahead(3), 2.0), apart_s=1.0)
    assert np.allclose(beliefs[1], beliefs[0])
    assert np.isfinite(beliefs).all()


def test_segments_are_the_run_cut_up():
    run = made_floor_run("grass", ahead(61), 2.0)
    segments = run.segments(2.0)
    assert [len(segment) for segment in segments] == [13, 13, 13, 13, 9]
    assert np.array_equal(np.concatenate([segment.time for segment in segments]), run.time)
    assert np.array_equal(np.concatenate([segment.current for segment in segments]), run.current)


def test_windows_hold_the_last_seconds_and_nothing_else():
    rng = np.random.default_rng(0)
    x = 100 + rng.normal(size=30)
    time = np.cumsum(rng.uniform(0.1, 0.2, 30))
    mean, std = TrailingWindow.of(time, 0.5).mean_and_std(x)
    for t in range(30):
        mine = x[: t + 1][time[: t + 1] > time[t] - 0.5 + 1e-6]
        assert mean[t] == pytest.approx(mine.mean())
        assert std[t] == pytest.approx(mine.std(), abs=1e-6)


def test_a_window_of_half_a_second_holds_two_rows_a_quarter_apart():
    assert TrailingWindow.of(0.25 * np.arange(5), 0.5).first.tolist() == [0, 0, 1, 2, 3]


def test_windows_leave_out_missing_values():
    x = np.array([np.nan, 1.0, np.nan, 3.0])
    mean, std = TrailingWindow.of(np.arange(4.0), 10.0).mean_and_std(x)
    assert np.isnan(mean[0])
    assert mean[1:].tolist() == [1.0, 1.0, 2.0]
    assert std[3] == pytest.approx(1.0)


def test_features_are_of_the_requested_channels():
    run = made_floor_run("grass", ahead(20), 2.0)
    other = replace(run, current=run.current + 1.0)
    driving = SPEEDS_ONLY
    same = features(run, HUSKY, driving), features(other, HUSKY, driving)
    assert np.array_equal(*same)
    assert not np.array_equal(features(run, HUSKY), features(other, HUSKY))
    shaken = replace(run, vibration=2 * run.vibration)
    assert np.array_equal(features(run, HUSKY), features(shaken, HUSKY))
    vibration = DEFAULT_CHANNELS | {"vibration"}
    assert not np.array_equal(features(run, HUSKY, vibration), features(shaken, HUSKY, vibration))


def test_the_gyro_counts_as_what_it_falls_short_whichever_way_it_turns():
    left = replace(
        made_floor_run("grass", np.tile([-1.0, 2.0], (20, 1)), 2.0), gyro=np.full(20, 0.3)
    )
    right = replace(left, speed=left.speed[:, ::-1], gyro=np.full(20, -0.3))
    assert np.allclose(features(left, HUSKY)[:, -3:], features(right, HUSKY)[:, -3:])
    turn = left.rolling(HUSKY)[0, 2]
    assert features(left, HUSKY)[-1, -2] == pytest.approx(turn - 0.3)


def test_features_of_a_restarted_run_are_those_of_its_segments():
    run = made_floor_run("grass", ahead(61), 2.0)
    each = [features(segment, HUSKY) for segment in run.segments(2.0)]
    assert np.allclose(features(run, HUSKY, restart_s=2.0), np.concatenate(each), atol=1e-6)
    assert not np.allclose(features(run, HUSKY), np.concatenate(each), atol=1e-3)


def test_rows_to_train_on_are_apart_and_move():
    run = made_floor_run("grass", ahead(52), 2.0)
    still = replace(run, speed=np.where(np.arange(52)[:, None] < 26, 0.0, run.speed))
    rows, floor = training_rows([run, still], lambda f: f.time[:, None], every_s=0.3)
    assert (floor == "grass").all()
    assert len(rows) == 26 + 13
    assert np.diff(rows[:26, 0]) == pytest.approx(2 / HZ)
    assert rows[26:].min() >= 26 / HZ


@pytest.mark.parametrize(
    "method",
    [
        GaussianClassifier(),
        CosineEnergyClassifier(),
        BoostedTreesClassifier(trees=5),
        BoostedTreesClassifier(trees=5, without_driving=True),
    ],
    ids=lambda m: f"{m.name}{len(m.fitted)}" if isinstance(m, BoostedTreesClassifier) else m.name,
)
def test_later_signals_change_no_belief(method):
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0})
    done = method.fit(runs, HUSKY)
    run = runs[0]
    later = replace(
        run,
        speed=np.where(np.arange(60)[:, None] < 30, run.speed, 2 * run.speed),
        current=np.where(np.arange(60)[:, None] < 30, run.current, 9.0),
        gyro=np.where(np.arange(60) < 30, run.gyro, 1.0),
    )
    before, after = done.probability([run, later], HUSKY)
    assert np.allclose(before[:30], after[:30], atol=1e-9)
    assert not np.allclose(before[30:], after[30:])
    assert np.allclose(before.sum(axis=1), 1.0)


@pytest.mark.parametrize(
    "method", [GaussianClassifier(), CosineEnergyClassifier(), BoostedTreesClassifier(trees=20)]
)
def test_floors_that_differ_in_current_are_classified(method):
    levels = {"grass": 2.0, "ice": 1.0, "snow": 4.0}
    done = method.fit(made_floor_runs(levels), HUSKY)
    assert done.labels == ("grass", "ice", "snow")
    others = [
        made_floor_run(f, ahead(13), level, seed=50 + k)
        for k, (f, level) in enumerate(levels.items())
    ]
    for run, beliefs in zip(others, done.probability(others, HUSKY), strict=True):
        assert done.labels[int(beliefs[-1].argmax())] == run.floor
    assert done.numbers > 0


@pytest.mark.parametrize(
    "method", [GaussianClassifier(), CosineEnergyClassifier(), BoostedTreesClassifier()]
)
def test_an_unfitted_classifier_raises(method):
    with pytest.raises(ValueError, match="not fitted"):
        method.probability([made_floor_run("grass", ahead(), 2.0)], HUSKY)
    assert method.numbers == 0


@pytest.mark.parametrize(
    "method", [GaussianClassifier(), CosineEnergyClassifier(), BoostedTreesClassifier()]
)
def test_candidates_are_few_and_differ(method):
    assert 1 < len(method.candidates()) <= 4
    assert len(set(map(repr, method.candidates()))) == len(method.candidates())


def test_runs_without_a_gyro_are_classified():
    runs = [
        made_floor_run(floor, ahead(), level, seed=k, gyro=False)
        for k, (floor, level) in enumerate([("grass", 2.0), ("snow", 4.0)] * 3)
    ]
    for method in (GaussianClassifier(), CosineEnergyClassifier(), BoostedTreesClassifier(trees=5)):
        beliefs = method.fit(runs, HUSKY).probability(runs[:2], HUSKY)
        assert [int(b[-1].argmax()) for b in beliefs] == [0, 1]
