"""Encoders, corrected kinematics and the table of headings, on data of their own assumptions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from slipid.predict.kinematics import Corrected, Encoder, HeadingLookup
from slipid.predict.slip_model import TRIES, path_of
from slipid.predict.slip_models import ByFloor
from slipid.predict.steps import Steps, TrainingWindows, scaled_least_squares
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def wild(rng, steps, dt=0.1, **extra):
    """A run of the Robotino in which everything differs from step to step."""
    rolling, twist = rng.normal(size=(2, steps, 3)) * [0.2, 0.2, 0.5]
    run = made_run(rolling, twist, current=rng.uniform(0, 1, (steps, 3)), dt=dt, **extra)
    uneven = rng.uniform(0.05, 0.2, steps)
    signals = replace(run.signals, dt=uneven, turn=run.signals.turn / dt * uneven[:, None])
    return replace(run, signals=signals, pose=path_of(twist, uneven) + np.array([1.0, -2.0, 0.0]))


# encoders


def test_encoders_say_the_path_of_wheels_that_do_not_slip(rng):
    runs = [made_run(rng.normal(size=(n, 3)) * 0.2) for n in (40, 7, 25)]
    method = Encoder().fit(runs, ROBOTINO)
    predicted = method.predict([run.signals for run in runs], ROBOTINO)
    assert method.numbers == 0
    assert method.name == "encoder"
    for each, run in zip(predicted, runs, strict=True):
        assert np.allclose(each.path, run.pose)


# what methods share


def test_runs_are_smoothed_one_by_one_from_their_first_value(rng):
    runs = [wild(rng, n).signals for n in (30, 5, 12)]
    steps = Steps.of(runs)
    smoothed = np.split(steps.smoothed(steps.signals.current, 0.3), [30, 35])
    for run, found in zip(runs, smoothed, strict=True):
        expected = run.current[0]
        for k, (x, dt) in enumerate(zip(run.current, run.dt, strict=True)):
            expected = np.exp(-dt / 0.3) * expected + (1 - np.exp(-dt / 0.3)) * x
            assert np.allclose(found[k], expected)


def test_smoothing_in_even_steps_is_the_textbook_filter(rng):
    run = made_run(straight(0.2), current=rng.uniform(0, 1, (40, 3))).signals
    a, x = np.exp(-0.1 / 0.5), run.current
    expected = lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]
    assert np.allclose(Steps.of([run]).smoothed(x, 0.5), expected)


def test_ends_are_those_of_the_paths(rng):
    runs = [wild(rng, n) for n in (30, 5, 12)]
    steps = Steps.of([run.signals for run in runs])
    ends = steps.ends(np.concatenate([run.twist for run in runs]))
    paths = [path_of(run.twist, run.signals.dt) for run in runs]
    assert np.allclose(ends, [path[-1] for path in paths])


def test_windows_are_those_of_the_runs(rng):
    runs = [wild(rng, n) for n in (30, 3, 12)]
    w, windowed = TrainingWindows.of(runs), [run.windowed() for run in runs]
    assert np.allclose(w.dt, np.concatenate([run.signals.dt for run in windowed]))
    assert np.allclose(w.twist, np.concatenate([run.twist for run in windowed]))
    rolling = np.concatenate([run.signals.rolling(ROBOTINO) for run in windowed])
    assert np.allclose(w.means(w.steps.signals.rolling(ROBOTINO)), rolling)


def test_rows_are_displacements_with_yaw_at_the_base_radius():
    rolling = np.tile([0.2, 0.1, 0.4], (5, 1))
    run = made_run(rolling, rolling - [0.1, 0.0, 0.2])
    parts, gap = TrainingWindows.of([run]).rows(rolling[..., None], ROBOTINO)
    assert np.allclose(gap, [[0.05, 0.0, 0.1 * 0.125]])
    assert np.allclose(parts[..., 0], [[0.1, 0.05, 0.2 * 0.125]])


def test_columns_without_news_get_nothing():
    a = np.array([[1.0, 0.0, 1.0], [2.0, 0.0, 2.0], [0.5, 0.0, 0.5]])
    assert np.allclose(scaled_least_squares(a, a[:, 0] * 3), [1.5, 0.0, 1.5])
    a[:, 1] = 1e-17
    assert scaled_least_squares(a, np.ones(3))[1] == 0.0
    assert np.array_equal(scaled_least_squares(0 * a, np.ones(3)), np.zeros(3))


def test_a_channel_that_one_run_lacks_is_there_for_none(rng):
    full = wild(rng, 10, gyro=np.zeros(10)).signals
    assert Steps.of([full, full]).signals.gyro is not None
    lacking = Steps.of([full, replace(full, gyro=None, current=None)]).signals
    assert lacking.gyro is None
    assert lacking.current is None


def test_signed_and_unsigned_currents_are_not_mixed(rng):
    run = wild(rng, 10).signals
    with pytest.raises(ValueError, match="signed"):
        Steps.of([run, replace(run, current_is_signed=True)])


# corrected kinematics of skid steer


def skid_runs(rng, move, noise=0.0):
    """Runs of the Husky, whose body moves as `move` makes of what its encoders say."""
    runs = []
    for _ in range(6):
        s, d = rng.uniform(-1, 1, (2, 4)).repeat(10, axis=1)
        rolling = np.stack([s, 0 * s, d], axis=1)
        twist = move(s, d) + noise * rng.normal(size=(40, 3))
        runs.append(made_run(rolling, twist, spec=HUSKY, floor="grass"))
    return runs


def sides(s, d):
    """Mandow et al.: the sides' speeds with gains, turning about centres of their own."""
    left, right = 0.9 * (s - 0.275 * d), 1.1 * (s + 0.275 * d)
    y_left, y_right, x = 0.50, -0.42, 0.08
    yaw = (right - left) / (y_left - y_right)
    ahead = (right * y_left - left * y_right) / (y_left - y_right)
    return np.stack([ahead, -x * yaw, yaw], axis=1)


def one_track(s, d):
    return np.stack([1.2 * s, -0.15 * 0.6 * d, 0.6 * d], axis=1)


def test_the_effective_track_comes_back(rng):
    runs = skid_runs(rng, one_track)
    method = Corrected("effective_track").fit(runs[:3], HUSKY)
    assert method.coefficients == pytest.approx([1.2, 0.6, 0.15])
    predicted = method.predict([run.signals for run in runs[3:]], HUSKY)
    for each, run in zip(predicted, runs[3:], strict=True):
        assert np.allclose(each.path, run.pose)


def test_the_effective_track_is_the_joint_least_squares(rng):
    runs = skid_runs(rng, one_track, noise=0.1)
    method = Corrected("effective_track").fit(runs, HUSKY)
    windows = [run.windowed() for run in runs]
    s, _, d = np.concatenate([run.signals.rolling(HUSKY) for run in windows]).T
    twist = np.concatenate([run.twist for run in windows])

    def gap(q):
        return (np.stack([q[0] * s, -q[2] * q[1] * d, q[1] * d], axis=1) - twist).ravel()

    a, b, x = least_squares(gap, [1.0, 1.0, 0.0], xtol=1e-12, ftol=1e-12).x
    assert method.coefficients == pytest.approx([a, b, x], rel=1e-5)


def test_instantaneous_centres_come_back_where_sides_differ(rng):
    runs = skid_runs(rng, sides)
    method = Corrected("instantaneous_centres").fit(runs[:3], HUSKY)
    assert method.coefficients[2] == pytest.approx(0.08)
    plain = Corrected("effective_track").fit(runs[:3], HUSKY)
    for run in runs[3:]:
        predicted, less = (m.predict([run.signals], HUSKY)[0] for m in (method, plain))
        assert np.allclose(predicted.path, run.pose)
        assert np.abs(less.path - run.pose).max() > 0.05


def test_kinematics_are_counted_by_floor(rng):
    grass = skid_runs(rng, one_track)
    ice = [replace(run, floor="ice").with_floor(True) for run in grass]
    for method, numbers in (
        (Corrected("effective_track"), 3),
        (Corrected("instantaneous_centres"), 5),
    ):
        assert method.fit(grass, HUSKY).numbers == numbers
        assert ByFloor.of(method).fit(grass + ice, HUSKY).numbers == 2 * numbers
        of_unknown_floor = [run.with_floor(False) for run in grass + ice]
        assert ByFloor.of(method).fit(of_unknown_floor, HUSKY).numbers == numbers
        assert method.needs == frozenset()
        with pytest.raises(ValueError, match="not fitted"):
            method.predict([grass[0].signals], HUSKY)


# the table of headings


def turned(angle, v):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ v


def by_heading(angle, speed=0.2):
    """A run whose slip is a Fourier series in its direction of travel."""
    along, across = 0.8 + 0.1 * np.cos(3 * angle), 0.05 * np.sin(2 * angle)
    yaw = 0.3 - 0.9 * np.sin(6 * angle)
    twist = np.append(turned(angle, [along, across]), yaw) * speed
    return made_run(straight(angle, speed), np.tile(twist, (40, 1)))


HEADINGS = np.radians(np.arange(0, 360, 15))


def test_headings_that_were_not_driven_are_interpolated():
    method = HeadingLookup(ridge=0.0).fit([by_heading(a) for a in HEADINGS], ROBOTINO)
    assert method.numbers == 39
    between = [by_heading(a + 0.1, speed=0.3) for a in HEADINGS]
    predicted = method.predict([run.signals for run in between], ROBOTINO)
    for each, run in zip(predicted, between, strict=True):
        assert np.allclose(each.path, run.pose, atol=1e-9)


def test_the_ridge_is_least_squares_with_rows_of_its_own(rng):
    angles = rng.uniform(-np.pi, np.pi, 30)
    runs = [
        by_heading(a, speed) for a, speed in zip(angles, rng.uniform(0.1, 0.3, 30), strict=True)
    ]
    method = HeadingLookup(ridge=0.02).fit(runs, ROBOTINO)
    far = np.array([run.speed for run in runs]).repeat(8) * 0.5
    angle = angles.repeat(8)[:, None]
    k = np.arange(1, 7)
    waves = np.stack([np.cos(k * angle), np.sin(k * angle)], axis=-1).reshape(len(far), -1)
    phi = np.column_stack([np.ones(len(far)), waves]) * far[:, None]
    held = np.diag(np.sqrt(0.02 * (far**2).sum() * np.append(0.0, k.repeat(2) ** 4.0)))
    yaw = np.concatenate([run.windowed().twist[:, 2] for run in runs]) * 0.5
    rows = np.concatenate([phi, held]), np.concatenate([yaw, np.zeros(13)])
    assert np.allclose(method.coefficients[:, 2], np.linalg.lstsq(*rows, rcond=None)[0])


def test_a_heavy_ridge_leaves_what_all_headings_share():
    runs = [by_heading(a) for a in HEADINGS]
    series = HeadingLookup(ridge=1e6).fit(runs, ROBOTINO).coefficients
    assert series[0] == pytest.approx([-0.2, 0.0, 0.3], abs=1e-6)
    assert np.abs(series[1:]).max() < 1e-5


def test_a_robot_that_stands_still_stays_so():
    still = made_run(np.zeros((10, 3)))
    method = HeadingLookup().fit([still], ROBOTINO)
    predicted = method.predict([still.signals, made_run(straight(0.3)).signals], ROBOTINO)
    assert np.allclose(predicted[0].path, 0.0)
    assert np.allclose(predicted[1].path, made_run(straight(0.3)).pose)


def test_the_table_tries_ridges_and_wants_a_twist():
    tried = HeadingLookup().candidates()
    assert len({method.ridge for method in tried}) == len(tried) <= TRIES
    assert HeadingLookup().needs == {"twist"}
    with pytest.raises(ValueError, match="not fitted"):
        HeadingLookup().predict([by_heading(0.1).signals], ROBOTINO)
