"""Signals, thresholds and indicators against those of simulated runs."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.motion.reina import ReinaDeterministic
from slipid.lab.systems.motion.reina_indicators import (
    SlipThresholds,
    SmoothedSignals,
    smoothing,
)
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight
from tests.helpers.patchy_runs import patchy, slipping


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


def test_a_wheel_off_the_commanded_shape_raises_the_encoder_indicator():
    run = made_run(np.tile([1.0, 0.0, 0.0], (20, 1)), current=np.ones((20, 2)), spec=HUSKY)
    measured = replace(run.signals, turn=run.signals.turn * [1.0, 1.4])
    signals = SmoothedSignals.of(measured, HUSKY, 0.3)
    # of two wheels, the median ratio is in their middle
    assert signals.deviation == pytest.approx(np.full(20, 0.2 / 1.2), rel=1e-5)
    uncommanded = SmoothedSignals.of(replace(measured, command=None), HUSKY, 0.3)
    assert uncommanded.deviation == pytest.approx(np.zeros(20), abs=1e-6)


def test_a_slow_wheel_counts_in_units_of_the_fastest():
    run = made_run(straight(0.0, 0.2, 20), current=np.ones((20, 3)))
    rim = run.signals.speed * ROBOTINO.wheel_radius + [0.0, 0.01, 0.0]
    measured = replace(run.signals, turn=rim / ROBOTINO.wheel_radius * 0.1)
    fastest = 0.2 * np.cos(np.pi / 6)
    deviation = SmoothedSignals.of(measured, ROBOTINO, 0.3).deviation
    assert deviation == pytest.approx(np.full(20, 0.01 / (0.3 * fastest)), rel=1e-4)


def test_accelerations_are_those_of_the_fastest_changing_wheel():
    rolling = np.outer(np.linspace(0.0, 1.9, 20), [0.1, 0.0, 0.0])
    change = SmoothedSignals.of(
        made_run(rolling, current=np.ones((20, 3))).signals, ROBOTINO, 1e-3
    ).change
    assert change[1:] == pytest.approx(np.full(19, np.cos(np.pi / 6) / 0.04 * 0.1), rel=1e-4)


def test_the_smallest_current_is_that_of_the_wheels_that_drive():
    current = np.tile([0.6, 0.1, 0.7], (20, 1))
    ahead = SmoothedSignals.of(
        made_run(straight(0.0, 0.2, 20), current=current).signals, ROBOTINO, 0.3
    )
    assert ahead.amps == pytest.approx(np.full(20, 0.6))
    turning = np.tile([0.0, 0.0, 1.0], (20, 1))
    around = SmoothedSignals.of(made_run(turning, current=current).signals, ROBOTINO, 0.3)
    assert around.amps == pytest.approx(np.full(20, 0.1))


def test_indicators_are_signals_over_their_limits():
    run = patchy(0, gyro=True)
    signals = SmoothedSignals.of(run.signals, ROBOTINO, 1e-3)
    limits = SlipThresholds(change=2.0, turning=0.06, current_low=0.4, current_high=0.8)
    encoder, current, gyro = limits.indicators(signals)
    assert run.signals.current is not None
    fastest = np.abs(run.signals.speed).max(axis=1, keepdims=True)
    amps = np.where(np.abs(run.signals.speed) > 0.3 * fastest, run.signals.current, np.inf).min(
        axis=1
    )
    assert current == pytest.approx((amps - 0.4) / 0.4)
    assert run.signals.gyro is not None
    assert gyro == pytest.approx(
        np.abs(run.signals.rolling(ROBOTINO)[:, 2] - run.signals.gyro) / 0.06, rel=1e-3
    )
    assert (encoder >= signals.change / 2.0).all()
    assert replace(limits, turning=np.inf).indicators(signals)[2] is None


def test_limits_are_quantiles_of_the_steps_that_do_not_slip():
    runs = [patchy(k, gyro=True) for k in range(6)]
    limits = ReinaDeterministic(quantile=0.9).fit(runs, ROBOTINO).limits
    firm = ~np.concatenate([slipping(run) for run in runs])
    signals = [SmoothedSignals.of(run.signals, ROBOTINO, 0.3) for run in runs]
    amps = np.concatenate([s.amps for s in signals])[firm]
    assert limits.current_low == pytest.approx(np.median(amps))
    assert limits.current_high == pytest.approx(np.quantile(amps, 0.9))
    turning = np.concatenate([s.turning for s in signals if s.turning is not None])[firm]
    assert limits.turning == pytest.approx(np.quantile(turning, 0.9))
    change = np.concatenate([s.change for s in signals])[firm]
    assert limits.change == pytest.approx(np.quantile(change, 0.9))
