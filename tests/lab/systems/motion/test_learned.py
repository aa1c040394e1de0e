"""Windows and slip ratios, and trees and networks on runs with known slip."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.motion.features import (
    Scale,
    SignalWindows,
    SlipExamples,
    at_steps,
    common,
    weight_of,
    with_slip,
)
from slipid.lab.systems.motion.learners import (
    MOST_PASSES,
    BoostedTrees,
    NeuralNetwork,
)
from slipid.predict.slip_model import Run, path_of
from slipid.predict.slip_models import ByFloor
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight

SIZES = np.array([1.0, 1.0, 0.125])
LEARNERS = [BoostedTrees(), NeuralNetwork()]


def slipping(angle, ratio, speed=0.2, steps=40, **measured) -> Run:
    """Return a straight run with this slip ratio: ahead, to the left, turning."""
    rolling = straight(angle, speed, steps)
    return made_run(rolling, rolling + speed * np.asarray(ratio) / SIZES, **measured)


def test_inputs_of_a_window_are_those_of_its_motion():
    amps = np.tile([-1.0, 2.0, 3.0], (40, 1))
    rolling = straight(0.4) * [0.8, 0.8, 1.0] + np.array([0.0, 0.0, 0.96])
    run = made_run(rolling, current=amps, gyro=np.full(40, 0.3))
    windows = SignalWindows.of([run.signals], ROBOTINO)
    inputs = windows.inputs(ROBOTINO, common([run]))
    # 0.16 m/s ahead and 0.12 m/s of turning make a size of 0.2 m/s
    twist = [0.16 * np.cos(0.4), 0.16 * np.sin(0.4), 0.96]
    direction = [0.8 * np.cos(0.4), 0.8 * np.sin(0.4), 0.6]
    harmonic = [0.64 * np.cos(0.8), 0.64 * np.sin(0.8)]
    gyro = [0.3, (0.3 - 0.96) * 0.125 / 0.2]
    parts = (twist, run.signals.speed[0], direction, harmonic, [1.0, 2.0, 3.0], twist, gyro)
    expected = np.concatenate(parts)
    assert inputs.shape == (8, len(expected))
    assert np.allclose(inputs, expected)


def test_a_robot_that_turns_on_the_spot_has_a_size_and_a_direction():
    run = made_run(np.tile([0.0, 0.0, -0.8], (20, 1)))
    windows = SignalWindows.of([run.signals], ROBOTINO)
    assert np.allclose(windows.size, 0.1)
    assert np.allclose(windows.direction(ROBOTINO), [0.0, 0.0, -1.0])


def test_channels_that_one_run_lacks_are_left_out():
    whole = made_run(straight(0.0), current=np.ones((40, 3)), gyro=np.zeros(40))
    lacking = replace(whole, signals=replace(whole.signals, gyro=None))
    assert common([whole]) == {"current", "gyro", "command"}
    assert common([whole, lacking]) == {"current", "command"}
    windows = SignalWindows.of([lacking.signals], ROBOTINO)
    with pytest.raises(ValueError, match="no gyro"):
        windows.inputs(ROBOTINO, common([whole]))


def test_slip_ratios_are_those_that_were_made_at_any_speed():
    ratio = [-0.3, 0.1, 0.25]
    runs = [slipping(0.5, ratio, speed) for speed in (0.1, 0.4)]
    runs.append(made_run(np.zeros((40, 3)), np.full((40, 3), 0.01)))
    lessons = SlipExamples.of(runs, ROBOTINO)
    # not one of a robot at rest
    assert lessons.run.tolist() == [0] * 8 + [1] * 8
    assert np.allclose(lessons.ratio, ratio)


def test_nothing_is_learned_of_robots_at_rest():
    with pytest.raises(ValueError, match="runs in which the robot drives"):
        SlipExamples.of([made_run(np.zeros((40, 3)))], ROBOTINO)


def test_weights_rise_with_the_square_and_then_are_level():
    weight = weight_of(np.array([0.01, 0.02, 2.0, 2.0, 2.0, 200.0]))
    assert weight.mean() == pytest.approx(1.0)
    assert weight[1] / weight[0] == pytest.approx(4.0, rel=1e-3)
    assert weight[5] / weight[2] == pytest.approx(1.25, rel=1e-3)


def test_a_path_with_the_slip_that_was_made_is_the_true_one():
    runs = [slipping(0.5, [-0.3, 0.1, 0.25]), slipping(2.0, [0.2, 0.0, -0.1], steps=23)]
    measured = [run.signals for run in runs]
    windows = SignalWindows.of(measured, ROBOTINO)
    ratio = np.array([[-0.3, 0.1, 0.25], [0.2, 0.0, -0.1]])[windows.run]
    for predicted, run in zip(with_slip(measured, windows, ratio, ROBOTINO), runs, strict=True):
        assert np.allclose(predicted.path, path_of(run.twist, run.signals.dt))


def test_values_of_windows_are_those_of_their_steps():
    runs = [made_run(straight(0.0, steps=steps)).signals for steps in (10, 7)]
    first, second = at_steps(
        np.array([[1.0], [2.0], [3.0]]), SignalWindows.of(runs, ROBOTINO), runs
    )
    assert first[:, 0].tolist() == [1.0] * 5 + [2.0] * 5
    assert second[:, 0].tolist() == [3.0] * 7


def test_scaled_columns_have_zero_mean_and_unit_std_and_are_clipped():
    x = np.random.default_rng(0).normal([1.0, -2.0], [3.0, 0.1], (500, 2))
    scale = Scale.of(np.column_stack([x, np.full(500, 0.7)]))
    scaled = scale.scaled(np.column_stack([x, np.full(500, 0.7)]))
    assert np.allclose(scaled.mean(axis=0), 0.0)
    assert np.allclose(scaled.std(axis=0), [1.0, 1.0, 0.0])
    assert np.allclose(scale.back(scaled)[:, :2], x)
    far = scale.scaled(np.array([[99.0, -99.0, 0.7]]))
    assert np.allclose(far, [[scaled[:, 0].max(), scaled[:, 1].min(), 0.0]])


def test_boosted_trees_come_as_near_to_two_levels_as_their_rate_lets_them():
    there, back = (
        slipping(angle, [ratio, 0.0, 0.0]) for angle, ratio in ((0.0, -0.2), (np.pi, 0.4))
    )
    method = BoostedTrees(rate=0.1, leaves=4, trees=20).fit([there] * 8 + [back] * 8, ROBOTINO)
    predicted = method.predict([there.signals, back.signals], ROBOTINO)
    # every tree takes a tenth of what is left away from the mean of the two
    left = 0.9**20
    for of_run, run, ratio in zip(predicted, (there, back), (-0.2, 0.4), strict=True):
        speed = run.signals.rolling(ROBOTINO)[0, 0] + 0.2 * (ratio * (1 - left) + 0.1 * left)
        assert of_run.path[-1, 0] == pytest.approx(speed * 4.0, rel=1e-6)
    # four leaves and three thresholds of twenty trees for each component
    assert method.numbers == 3 * 20 * 7
    few = method.fit([there], ROBOTINO)
    assert few.windows == 8
    assert few.numbers == 3 * 20


def test_trees_heed_windows_in_proportion_to_their_weight():
    # at a tenth of the usual speed slip is another; it counts 0.05 as much
    fast, slow = slipping(0.0, [-0.1, 0.0, 0.0]), slipping(0.0, [0.5, 0.0, 0.0], 0.025)
    stump = BoostedTrees(rate=0.1, leaves=2, trees=1)
    method = stump.fit([fast] * 30 + [slow] * 20, ROBOTINO)
    assert 0.6 * 50 * 8 < method.windows < 0.65 * 50 * 8


def test_a_neural_network_learns_how_slip_turns_with_the_direction():
    def run(angle: float) -> Run:
        return slipping(angle, [-0.3 * np.cos(angle), 0.2 * np.sin(angle), 0.1 * np.cos(2 * angle)])

    method = NeuralNetwork().fit([run(angle) for angle in np.linspace(0, 6.2, 60)], ROBOTINO)
    new = [run(angle) for angle in np.linspace(0.1, 6.1, 16)]
    predicted = method.predict([run.signals for run in new], ROBOTINO)
    errors = np.abs(
        [
            of_run.path[-1] - path_of(run.twist, run.signals.dt)[-1]
            for of_run, run in zip(predicted, new, strict=True)
        ]
    )
    # Slip moves the ends by 0.20 m and turns them by 0.41 rad on average; nine tenths are learnt.
    # The mean over directions is judged: that of one varies with the library and the processor.
    assert np.hypot(errors[:, 0], errors[:, 1]).mean() < 0.02
    assert errors[:, 2].mean() < 0.04


def test_the_numbers_of_a_network_are_its_weights():
    method = NeuralNetwork(hidden=(5, 4), alpha=0.1).fit([slipping(0.0, [0.1, 0.0, 0.0])], ROBOTINO)
    parts = (*method.regressor.network.coefs_, *method.regressor.network.intercepts_)
    assert method.numbers == sum(part.size for part in parts)
    assert NeuralNetwork().numbers == 0


def test_a_network_that_has_not_converged_does_not_warn():
    # few windows with different slips: none left out, and every pass gains a little
    runs = [slipping(k, [np.sin(3 * k), np.cos(k), 0.0], steps=5) for k in range(19)]
    assert NeuralNetwork().fit(runs, ROBOTINO).regressor.network.n_iter_ == MOST_PASSES


def test_the_output_of_a_network_is_clipped_to_the_training_range():
    runs = [slipping(angle, [0.2 * np.cos(angle), 0.0, 0.0]) for angle in np.linspace(0, 6, 40)]
    method = NeuralNetwork().fit(runs, ROBOTINO)
    fast = made_run(straight(0.0, speed=5.0))
    (predicted,) = method.predict([fast.signals], ROBOTINO)
    ratio = predicted.path[-1, 0] / 20.0 - 1
    assert abs(ratio) <= 0.2 + 1e-9


@pytest.mark.parametrize("method", LEARNERS, ids=lambda method: method.name)
def test_learned_slip_of_a_skid_steer_without_currents_is_that_of_each_floor(method):
    twist = np.tile([0.5, 0.0, 0.4], (60, 1))
    runs = [
        made_run(twist, twist * [1.0 - loss, 1.0, 0.5], spec=HUSKY, floor=floor)
        for floor, loss in (("ice", 0.5), ("grass", 0.1))
        for _ in range(5)
    ]
    fitted = ByFloor.of(method).fit(runs, HUSKY)
    predicted = fitted.predict([runs[0].signals, runs[-1].signals], HUSKY)
    for of_run, run in zip(predicted, (runs[0], runs[-1]), strict=True):
        assert np.allclose(of_run.path, run.pose, atol=0.02)


@pytest.mark.parametrize("method", LEARNERS, ids=lambda method: method.name)
def test_learned_methods_are_reproducible_and_rest_where_wheels_rest(method):
    runs = [slipping(angle, [0.2, -0.1, 0.3]) for angle in np.linspace(0, 6, 12)]
    at_rest = made_run(np.zeros((40, 3))).signals
    one, other = (
        method.fit(runs, ROBOTINO).predict([at_rest, runs[0].signals], ROBOTINO) for _ in "ab"
    )
    assert np.array_equal(one[1].path, other[1].path)
    assert np.abs(one[0].path).max() == 0.0
    assert len(method.candidates()) == 4
    assert {type(each) for each in method.candidates()} == {type(method)}
    with pytest.raises(ValueError, match="was not fitted"):
        method.predict([at_rest], ROBOTINO)
