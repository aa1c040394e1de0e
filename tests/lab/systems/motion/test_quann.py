"""Gaussian processes against closed forms, covariance of a path's end, and laws of energy."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.motion.features import SignalWindows
from slipid.lab.systems.motion.quann import (
    INFLATION_PARTS,
    MOST_WINDOWS,
    ProcessRows,
    QuannEnergy,
    QuannSlip,
    end_spread,
    end_squares,
    fitted_numbers,
    parts,
    places,
    slip_inputs,
    untuned_kernel,
)
from slipid.predict.slip_model import Run, RunSignals, path_of
from tests.helpers.made_runs import ROBOTINO, made_run, straight

SIZES = np.array([1.0, 1.0, 0.125])
KERNEL = untuned_kernel(np.array([0.7, 1.5]), free=True).clone_with_theta(
    np.log([1.3, 0.7, 1.5, 0.05])
)


def matern(a, b, kernel):
    variance, *lengths, _ = np.exp(kernel.theta)
    d = np.sqrt((((a[:, None] - b[None]) / np.array(lengths)) ** 2).sum(axis=2))
    return variance * (1 + np.sqrt(3) * d) * np.exp(-np.sqrt(3) * d)


def rows(n=60, seed=0) -> ProcessRows:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, (n, 2))
    y = np.stack([np.sin(2 * x[:, 0]), 5.0 + 3.0 * np.cos(x[:, 1])], axis=1)
    return ProcessRows(x, y + rng.normal(0.0, 0.1, y.shape), np.ones(n))


def test_a_posterior_is_that_of_the_closed_form():
    known = rows()
    new = np.random.default_rng(1).uniform(-3, 3, (7, 2))
    found, spread = known.process(KERNEL).predict(new, return_std=True)
    mean, std = known.y.mean(axis=0), known.y.std(axis=0)
    gram = matern(known.x, known.x, KERNEL) + 0.05 * np.eye(60)
    across = matern(new, known.x, KERNEL)
    assert np.allclose(found, mean + std * (across @ np.linalg.solve(gram, (known.y - mean) / std)))
    explained = (across * np.linalg.solve(gram, across.T).T).sum(axis=1)
    assert np.allclose(spread, np.sqrt(1.3 + 0.05 - explained)[:, None] * std)


def likelihood(known, kernel):
    """Return the log probability of all outputs, up to a constant."""
    z = (known.y - known.y.mean(axis=0)) / known.y.std(axis=0)
    gram = matern(known.x, known.x, kernel) + np.exp(kernel.theta[-1]) * np.eye(len(z))
    return -0.5 * (z * np.linalg.solve(gram, z)).sum() - 0.5 * 2 * np.linalg.slogdet(gram)[1]


def test_hyperparameters_make_what_is_known_most_likely():
    known = rows()
    start = untuned_kernel(np.array([2.0, 2.0]), free=True)
    best = known.tuned(start)
    there = likelihood(known, best)
    assert there > likelihood(known, start) + 10
    for factor in (0.7, 1.4):
        for k in range(4):
            shift = np.log(factor) * np.eye(4)[k]
            assert likelihood(known, best.clone_with_theta(best.theta + shift)) < there
    assert fitted_numbers(known.process(best)) == 4 + known.y.size
    fixed = known.tuned(untuned_kernel(0.9, free=False))
    assert fixed.k1.k2.length_scale == 0.9
    assert fitted_numbers(known.process(fixed)) == 2 + known.y.size


def test_rows_are_drawn_in_proportion_to_their_weight():
    many = rows(n=4000)
    weighted = replace(many, weight=np.where(many.x[:, 0] > 0, 3.0, 1.0))
    drawn = weighted.drawn(MOST_WINDOWS)
    assert len(drawn.x) == MOST_WINDOWS == len(np.unique(drawn.x, axis=0))
    assert (drawn.x[:, 0] > 0).mean() == pytest.approx(0.75, abs=0.08)
    assert len(many.drawn(5000).x) == 4000


def test_the_end_spreads_as_errors_that_last_for_the_run_move_it():
    rng = np.random.default_rng(2)
    twist = np.array([0.2, -0.1, 0.3]) + rng.normal(0.0, 0.05, (30, 3))
    std, dt = rng.uniform(0.01, 0.05, (30, 3)), rng.uniform(0.1, 0.2, 30)
    root = np.zeros((2, 3))
    for k in range(3):
        moved = np.zeros((30, 3))
        moved[:, k] = 1e-6 * std[:, k]
        ends = [path_of(twist + sign * moved, dt)[-1, :2] for sign in (1, -1)]
        root[:, k] = (ends[0] - ends[1]) / 2e-6
    got = end_spread(path_of(twist, dt), std, dt)
    assert np.allclose(got, root @ root.T, rtol=1e-3)


def slipping(angle: float, seed: int, scatter: float = 0.0) -> Run:
    """Return runs with slip in proportion to the current, and a random part for each run."""
    rng = np.random.default_rng(seed)
    amps = rng.uniform(0.4, 1.2)
    ratio = np.array([-0.3 * amps, 0.1 * np.sin(angle), 0.1]) + scatter * rng.normal(size=3)
    rolling = straight(angle)
    current = np.full((40, 3), amps)
    return made_run(rolling, rolling + 0.2 * ratio / SIZES, current=-current, signed=True)


def test_slip_is_learned_from_currents_and_direction():
    runs = [slipping(angle, k) for k, angle in enumerate(np.linspace(0, 6.2, 40))]
    method = QuannSlip().fit(runs, ROBOTINO)
    for k in range(3):
        new = slipping(1.3 + k, 100 + k)
        (predicted,) = method.predict([new.signals], ROBOTINO)
        error = predicted.path[-1] - path_of(new.twist, new.signals.dt)[-1]
        assert np.hypot(*error[:2]) < 0.02 * 0.8
    assert method.numbers == 1 + (2 + 9) + 3 * 40 * 8  # runs of eight windows
    assert [each.anisotropic for each in method.candidates()] == [True, False]
    assert method.needs == {"current"}
    assert method.inflation < 1.0


def test_inputs_of_slip_are_magnitudes_and_a_direction():
    run = slipping(2.0, 3)
    windows = SignalWindows.of([run.signals], ROBOTINO)
    row = slip_inputs(windows, ROBOTINO)[0]
    assert np.allclose(row[:3], np.abs(run.signals.current[0]))
    assert np.allclose(row[3:6], np.abs(run.signals.speed[0]))
    assert np.allclose(row[6:], [np.cos(2.0), np.sin(2.0), 0.0])


@pytest.mark.slow
def test_covariances_of_ends_are_as_large_as_errors_of_new_runs():
    angles = np.random.default_rng(4).uniform(0, 6.28, 220)
    runs = [slipping(angle, k, scatter=0.1) for k, angle in enumerate(angles)]
    method = QuannSlip().fit(runs[:100], ROBOTINO)
    predicted = method.predict([run.signals for run in runs[100:]], ROBOTINO)
    errors = [
        s.path - path_of(r.twist, r.signals.dt) for s, r in zip(predicted, runs[100:], strict=True)
    ]
    ends = np.array([error[-1, :2] for error in errors])
    square = [
        e @ np.linalg.solve(s.end_covariance, e) for s, e in zip(predicted, ends, strict=True)
    ]
    # Chi-squared with two degrees of freedom. The mean would be that of a few runs with currents
    # beyond the fitted ones.
    assert np.median(square) == pytest.approx(1.386, rel=0.35)
    assert np.mean(np.array(square) < 4.605) == pytest.approx(0.9, abs=0.07)


def test_a_covariance_is_that_of_the_slip_in_metres_and_radians():
    runs = [slipping(angle, k, scatter=0.1) for k, angle in enumerate(np.linspace(0, 6.2, 16))]
    method = QuannSlip().fit(runs, ROBOTINO)
    new = slipping(1.0, 77).signals
    (predicted,) = method.predict([new], ROBOTINO)
    inputs = slip_inputs(SignalWindows.of([new], ROBOTINO), ROBOTINO)
    std = method.process.predict(method.scale.scaled(inputs), return_std=True)[1][0] * 0.2 / SIZES
    spread = end_spread(predicted.path, np.tile(std, (40, 1)), new.dt)
    assert np.allclose(predicted.end_covariance, method.inflation * spread + 1e-6 * np.eye(2))


def test_inflation_is_from_runs_that_the_process_does_not_know():
    # every run is alone in its direction, so that the process learns its own slip by heart
    runs = [slipping(angle, k, scatter=0.1) for k, angle in enumerate(np.linspace(0, 6.2, 16))]
    method = QuannSlip().fit(runs, ROBOTINO)
    by_heart = end_squares(replace(method, inflation=1.0), runs, ROBOTINO).mean()
    assert method.inflation > 5 * by_heart


def test_every_run_is_in_one_part():
    numbers = np.array([3, 5, 8, 9, 11, 12])
    dealt = parts(numbers)
    assert len(dealt) == INFLATION_PARTS
    assert sorted(np.concatenate(dealt).tolist()) == numbers.tolist()
    assert [part.tolist() for part in parts(np.array([4]))] == [[4]]


def test_a_single_run_is_enough_and_rest_is_certain_to_a_millimetre():
    run = slipping(0.3, 0)
    method = QuannSlip(anisotropic=False).fit([run], ROBOTINO)
    rest = made_run(np.zeros((40, 3)), current=np.zeros((40, 3))).signals
    (predicted,) = method.predict([rest], ROBOTINO)
    assert np.abs(predicted.path).max() == 0.0
    assert np.allclose(predicted.end_covariance, 1e-6 * np.eye(2))


LAW = np.array([20.0, 30.0, 80.0, 15.0])
"""Coefficients of the energy per metre: constant, speed, its square, yaw rate."""


def drawing(twist: np.ndarray, energy_factor: np.ndarray | float = 1.0) -> RunSignals:
    """Return a run whose energy is that of `LAW` times a factor."""
    run = made_run(twist)
    speed = np.hypot(twist[:, 0], twist[:, 1])
    energy = LAW[0] + LAW[1] * speed + LAW[2] * speed**2 + LAW[3] * np.abs(twist[:, 2])
    power = energy_factor * energy * np.maximum(speed, 0.02) / 3
    shaft = np.abs(ROBOTINO.gear_ratio * run.signals.speed)
    # R I^2 + C_e w I = a third of it, for each motor
    emf, ohm = ROBOTINO.back_emf * shaft, ROBOTINO.resistance
    amps = (-emf + np.sqrt(emf**2 + 4 * ohm * power[:, None])) / (2 * ohm)
    return replace(run, signals=replace(run.signals, current=amps))


def moving(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    speed, angle, turn = rng.uniform(0.05, 0.4), rng.uniform(0, 6.28), rng.uniform(-0.8, 0.8)
    # a run in four turns on the spot
    return np.tile([speed * np.cos(angle), speed * np.sin(angle), turn], (40, 1)) * (
        [0.0, 0.0, 1.0] if seed % 4 == 0 else [1.0, 1.0, 1.0]
    )


def test_a_law_of_energy_is_found_and_predicts_power_without_currents():
    runs = [drawing(moving(seed)) for seed in range(60)]
    method = QuannEnergy().fit(runs, ROBOTINO)
    assert method.law == pytest.approx(LAW, rel=1e-3)
    assert method.numbers == 4 + 2 + 60 * 8  # runs of eight windows
    for seed in (100, 101, 102):
        new = drawing(moving(seed)).signals
        (predicted,) = method.predict([replace(new, current=None)], ROBOTINO)
        assert predicted.power == pytest.approx(new.power(ROBOTINO), rel=0.01)
        assert np.allclose(predicted.path, path_of(new.rolling(ROBOTINO), new.dt))
    (rest,) = method.predict([made_run(np.zeros((40, 3))).signals], ROBOTINO)
    assert rest.power == pytest.approx(np.full(40, 20.0 * 0.02), rel=0.05)


def test_a_law_leaves_the_least_squares_of_power():
    factors = np.random.default_rng(6).uniform(0.5, 1.5, 40)
    runs = [drawing(moving(seed), factor) for seed, factor in enumerate(factors)]
    method = QuannEnergy().fit(runs, ROBOTINO)
    windows = SignalWindows.of([run.signals for run in runs], ROBOTINO)
    power = np.concatenate([run.power(ROBOTINO) for run in windows.signals])
    speed = np.hypot(windows.rolling[:, 0], windows.rolling[:, 1])
    terms = np.stack([speed**0, speed, speed**2, np.abs(windows.rolling[:, 2])], axis=1)
    terms = terms * np.maximum(speed, 0.02)[:, None]
    assert np.allclose(terms.T @ (power - terms @ method.law), 0.0, atol=1e-6)


def test_places_are_in_the_middle_of_windows_relative_to_the_start():
    runs = [made_run(straight(0.0)).signals, made_run(straight(np.pi / 2)).signals]
    found = places(SignalWindows.of(runs, ROBOTINO), ROBOTINO)
    assert np.allclose(found[:2], [[0.05, 0.0], [0.15, 0.0]])
    assert np.allclose(found[8:10], [[0.0, 0.05], [0.0, 0.15]])


def test_above_the_training_speeds_energy_is_that_of_the_fastest():
    runs = [drawing(straight(0.0, speed)) for speed in np.linspace(0.05, 0.2, 30)]
    method = QuannEnergy().fit(runs, ROBOTINO)
    fast = made_run(straight(0.0, 0.8, 5) + np.array([0.0, 0.0, 0.5])).signals
    (predicted,) = method.predict([fast], ROBOTINO)
    assert predicted.power == pytest.approx((20.0 + 30.0 * 0.2 + 80.0 * 0.04) * 0.8, rel=0.02)


def test_a_map_knows_places_that_cost_more():
    # beyond 0.4 m ahead the ground is soft
    def crossing(speed: float) -> Run:
        ahead = speed * 0.1 * (np.arange(60) + 0.5)
        return drawing(straight(0.0, speed, 60), np.where(ahead > 0.4, 2.0, 1.0))

    method = QuannEnergy(length=0.2).fit([crossing(v) for v in np.linspace(0.1, 0.3, 15)], ROBOTINO)
    new = crossing(0.17).signals
    (predicted,) = method.predict([new], ROBOTINO)
    true = new.power(ROBOTINO)
    assert predicted.power[:20].mean() == pytest.approx(true[:20].mean(), rel=0.1)
    assert predicted.power[-20:].mean() == pytest.approx(true[-20:].mean(), rel=0.1)
    assert [each.length for each in method.candidates()] == [0.1, 0.2, 0.5]


@pytest.mark.parametrize("method", [QuannSlip(), QuannEnergy()], ids=lambda method: method.name)
def test_nothing_is_predicted_before_a_fit(method):
    assert method.numbers == 0
    with pytest.raises(ValueError, match="was not fitted"):
        method.predict([made_run(straight(0.0)).signals], ROBOTINO)
