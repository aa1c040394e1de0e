"""Classifiers against other libraries, and against the series behind simulated data."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.discriminant_analysis import (
    LinearDiscriminantAnalysis,
    QuadraticDiscriminantAnalysis,
)
from sklearn.ensemble import HistGradientBoostingClassifier

from slipid.lab.systems.floors.cosine_energy import (
    CosineEnergyClassifier,
    terms,
)
from slipid.lab.systems.floors.interface import training_rows
from slipid.lab.systems.floors.learned import (
    SPEEDS_ONLY,
    BoostedTreesClassifier,
    GaussianClassifier,
    features,
    tree_classifiers,
)
from slipid.model.robot import GRAVITY
from tests.helpers.made_floor_runs import HZ, ahead, made_floor_run, made_floor_runs
from tests.helpers.made_runs import HUSKY, ROBOTINO


def mixed_runs(seed: int = 0):
    """Return runs at varying speeds on floors with overlapping currents."""
    rng = np.random.default_rng(seed)
    runs = []
    for k in range(12):
        floor, level = [("grass", 2.0), ("ice", 2.6), ("snow", 3.0)][k % 3]
        speed = ahead(52) + rng.normal(size=(52, 2))
        runs.append(made_floor_run(floor, speed, level, seed=seed + k, noise=1.0))
    return runs


def training(method, runs):
    """Return the features and floors that a method trains on."""
    if isinstance(method, GaussianClassifier):
        return training_rows(runs, lambda f: method._features(f, HUSKY, method.restart_s))

    def take(f):
        return features(f, HUSKY, method.channels, restart_s=method.restart_s)

    return training_rows(runs, take, method.rows_s)


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_a_gaussian_is_discriminant_analysis(shared):
    runs = mixed_runs()
    method = GaussianClassifier(shared=shared, ridge=1e-9, apart_s=1 / HZ)
    done = method.fit(runs, HUSKY)
    rows, floor = training(method, runs)
    log = done.fitted.log_likelihood(rows)
    rows, even = done.fitted.comparable(rows), np.full(3, 1 / 3)
    if shared:
        # its covariance is a mean weighted by rows; floors have as many rows each here
        oracle = LinearDiscriminantAnalysis(solver="lsqr", priors=even).fit(rows, floor)
    else:
        oracle = QuadraticDiscriminantAnalysis(priors=even).fit(rows, floor)
    mine = np.exp(log - log.max(axis=1, keepdims=True))
    mine /= mine.sum(axis=1, keepdims=True)
    # one library divides covariances by n, the other by n - 1
    assert np.abs(mine - oracle.predict_proba(rows)).max() < 0.03
    assert np.mean(mine.argmax(axis=1) == oracle.predict_proba(rows).argmax(axis=1)) > 0.99


def test_a_shared_part_lies_between():
    runs, found = mixed_runs(), []
    for shared in (0.0, 0.5, 1.0):
        method = GaussianClassifier(shared=shared)
        root = method.fit(runs, HUSKY).fitted.root
        found.append(np.linalg.inv(root) @ np.linalg.inv(root).transpose(0, 2, 1))
    assert np.allclose(found[1], 0.5 * (found[0] + found[2]))


def test_trees_are_those_of_the_library():
    runs = mixed_runs()
    method = BoostedTreesClassifier(trees=15, apart_s=1 / HZ, memory_s=np.inf)
    done = method.fit(runs, HUSKY)
    rows, floor = training(method, runs)
    oracle = HistGradientBoostingClassifier(
        max_iter=15,
        learning_rate=method.rate,
        max_leaf_nodes=method.leaves,
        min_samples_leaf=20,
        l2_regularization=1.0,
        early_stopping=False,
        random_state=0,
    ).fit(rows, floor)
    run = made_floor_run("ice", ahead(7), 2.6, seed=99)
    frequency = np.array([np.mean(floor == name) for name in done.labels])
    log = np.log(oracle.predict_proba(features(run, HUSKY)) / frequency).sum(axis=0)
    expected = np.exp(log - log.max())
    assert np.allclose(done.probability([run], HUSKY)[0][-1], expected / expected.sum())


def test_how_often_a_floor_was_driven_is_no_evidence():
    """Of two floors with equal signals, the one with ten times the runs is not more probable."""
    many = [made_floor_run("grass", ahead(), 2.0, seed=k) for k in range(20)]
    few = [made_floor_run("snow", ahead(), 2.0, seed=100 + k) for k in range(2)]
    done = BoostedTreesClassifier(trees=10).fit([*many, *few], HUSKY)
    unseen = [made_floor_run("grass", ahead(13), 2.0, seed=200 + k) for k in range(30)]
    mean = np.mean([b[3] for b in done.probability(unseen, HUSKY)], axis=0)
    assert mean[0] < 0.65


def test_trees_with_the_driving_off_do_not_go_by_the_speed():
    """One floor is driven faster with the same currents; only trees without it ignore the speed."""

    def runs(start: int):
        return [
            made_floor_run(floor, ahead(rate=rate), 2.0, seed=start + k)
            for k, (floor, rate) in enumerate([("road", 3.0), ("snow", 1.0)] * 6)
        ]

    plain, off, driving, _ = tree_classifiers()
    fast = made_floor_run("snow", ahead(26, rate=3.0), 2.0, seed=77)

    def believed(method):
        return float(method.fit(runs(0), HUSKY).probability([fast], HUSKY)[0][-1, 0])

    assert believed(plain) > 0.95
    assert believed(driving) > 0.95
    assert believed(off) < 0.8


def test_rows_of_trees_use_the_channels_of_their_names():
    plain, off, driving, vibration = tree_classifiers()
    assert [r.name for r in (plain, off, driving, vibration)] == [
        "boosted_trees",
        "boosted_trees_felt",
        "boosted_trees_driving",
        "boosted_trees_vibration",
    ]
    assert plain.channels == off.channels == {"current", "gyro"}
    assert driving.channels == SPEEDS_ONLY == set()
    assert vibration.channels == {"current", "gyro", "vibration"}
    assert off.without_driving
    assert not plain.without_driving


def circle_run(weight: np.ndarray, floor: str, seed: int = 0, noise: float = 0.0):
    """Return a run in all directions whose energy coefficient is a series plus noise."""
    rng = np.random.default_rng(seed)
    rows = 72
    angle = np.linspace(-np.pi, np.pi, rows, endpoint=False) + 1e-3
    twist = 0.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    speed = twist @ ROBOTINO.forward.T / ROBOTINO.wheel_radius
    energy = terms(angle, 2) @ weight + noise * rng.normal(size=rows)
    power = energy * ROBOTINO.mass * GRAVITY * 0.2
    # the same power in every motor: R I^2 + C |w| I = P / 3
    c, r = ROBOTINO.back_emf * ROBOTINO.gear_ratio * np.abs(speed), ROBOTINO.resistance
    amps = (np.sqrt(c**2 + 4 * r * power[:, None] / 3) - c) / (2 * r)
    run = made_floor_run(floor, speed, 1.0)
    return replace(run, current=amps, time=10.0 * np.arange(rows))


def test_a_series_is_the_one_that_data_were_made_from():
    weight = np.array([0.5, 0.1, -0.05, 0.0, 0.08])
    method = CosineEnergyClassifier(harmonics=2, ridge=0.0)
    done = method.fit([circle_run(weight, "gray")], ROBOTINO)
    assert np.allclose(done.weight[0], weight, atol=1e-9)
    noisy = method.fit([circle_run(weight, "gray", noise=0.05)], ROBOTINO)
    assert noisy.std[0] == pytest.approx(0.05, rel=0.2)
    assert np.allclose(noisy.weight[0], weight, atol=0.02)


def test_a_ridge_pulls_waves_towards_nothing_and_not_the_mean():
    weight = np.array([0.5, 0.1, 0.0, 0.0, 0.0])
    rows = 72
    done = CosineEnergyClassifier(harmonics=2, ridge=rows / 2).fit(
        [circle_run(weight, "gray")], ROBOTINO
    )
    assert np.allclose(done.weight[0], [0.5, 0.05, 0, 0, 0], atol=2e-3)


def test_the_likelihood_is_that_of_normal_coefficients():
    weights = {"gray": np.array([0.5, 0.2, 0, 0, 0.0]), "green": np.array([0.6, -0.2, 0, 0, 0.0])}
    runs = [
        circle_run(w, name, seed=k, noise=0.05 * (k + 1))
        for k, (name, w) in enumerate(weights.items())
    ]
    method = CosineEnergyClassifier(harmonics=2, ridge=0.0, apart_s=10.0, memory_s=np.inf)
    done = method.fit(runs, ROBOTINO)
    assert done.std[1] > 1.5 * done.std[0]
    one = runs[0].rows(0, 2)
    beliefs = done.probability([replace(one, time=np.array([0.0, 10.0]))], ROBOTINO)[0]
    angle, energy = method._direction_and_energy(one, ROBOTINO).T
    series = terms(angle, 2) @ done.weight.T
    density = np.exp(-0.5 * ((energy[:, None] - series) / done.std) ** 2) / done.std
    expected = np.cumprod(density, axis=0)
    assert np.allclose(beliefs, expected / expected.sum(axis=1, keepdims=True))


def test_a_logarithm_of_the_coefficient_may_be_modelled():
    run = circle_run(np.array([0.5, 0.1, 0, 0, 0]), "gray")
    plain, log = (
        CosineEnergyClassifier(logarithm=x)._direction_and_energy(run, ROBOTINO)
        for x in (False, True)
    )
    assert np.allclose(np.log(plain[:, 1]), log[:, 1])


def test_the_direction_of_a_skid_steer_is_that_of_going_and_turning():
    method = CosineEnergyClassifier()
    for wheels, expected in [([1, 1], 0), ([-1, -1], np.pi), ([-1, 1], np.pi / 2)]:
        run = made_floor_run("grass", np.tile(np.array(wheels, float), (5, 1)), 1.0)
        angle = method._direction_and_energy(run, HUSKY)[-1, 0]
        assert np.cos(angle - expected) == pytest.approx(1.0)


def test_a_robot_that_stands_has_no_coefficient():
    run = made_floor_run("grass", np.zeros((4, 2)), 1.0)
    assert np.isnan(CosineEnergyClassifier()._direction_and_energy(run, HUSKY)[:, 1]).all()


def test_candidates_of_the_series_are_with_and_without_heat_and_logarithm():
    pairs = {(c.losses, c.logarithm) for c in CosineEnergyClassifier().candidates()}
    assert pairs == {(True, True), (True, False), (False, True), (False, False)}


def test_without_heat_a_coefficient_does_not_depend_on_how_fast_all_wheels_turn():
    slow = made_floor_run("grass", ahead(5, rate=1.0), 2.0)
    fast = replace(slow, speed=3 * slow.speed)
    for losses, same in ((True, False), (False, True)):
        one, other = (
            CosineEnergyClassifier(losses=losses)._direction_and_energy(f, HUSKY)[:, 1]
            for f in (slow, fast)
        )
        assert np.allclose(one, other) == same


def test_a_gaussian_treats_missing_features_as_the_mean():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0})
    done = GaussianClassifier().fit(runs, HUSKY)
    deaf = replace(runs[0], gyro=np.full(60, np.nan))
    assert np.isfinite(done.probability([deaf], HUSKY)[0]).all()
    assert done.probability([deaf], HUSKY)[0][-1, 0] > 0.9
