"""Readings that are wrong are set aside and counted; what readings agree on is believed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.robot import build
from slipid.model.se2 import advance, compose
from slipid.robot.estimator import Estimator
from slipid.robot.filter.wheels import WheelState, read_wheels
from slipid.robot.interface import Readings, Settings
from tests.helpers.kinds import FLOORS, SHAPES
from tests.helpers.known_robot import deploy_known
from tests.robot.test_estimator import BAD, DT, reading, robot, watch, wheels

REGION = 11.34
"""99 % quantile of chi-square with three degrees of freedom."""
GYRO, ENCODER, CURRENT, FIX = range(4)


def journey(spoil=None, twist=(0.2, 0.05, 0.3), steps=70, at=50, count=1, **more):
    """The estimate of a robot that accelerates and drives, some readings of which are spoilt."""
    est, run = watch()
    rng, state = np.random.default_rng(1), est.init()
    angle, speed, target = np.zeros(3), np.zeros(3), wheels(twist)
    for k in range(steps):
        speed = speed + np.clip(target - speed, -1.25, 1.25)
        angle = angle + DT * speed
        share = np.abs(speed).max() / max(np.abs(target).max(), 1e-9)
        z = {
            "wheel_angle": angle + 0.003 * rng.normal(size=3),
            "current": np.array([0.3, 0.25, 0.35]) + 0.07 * rng.normal(size=3),
            "gyro": twist[2] * share + 0.004 * rng.normal(),
        } | more
        if spoil is not None and at <= k < at + count:
            z = spoil(z, np.asarray(state.place.pose))
        state, said = run(state, reading(**z), DT)
        if k == at + count - 1:
            then = said
    return then, said


def moved(spoil, believed=False, **more):
    """Largest distance by a spoilt reading at once and later, and how often was set aside.

    It is relative to the region after the reading or, if `believed`, to that without it: a fix that
    is not set aside makes the region smaller than any error that it is allowed to have.
    """
    found = []
    for right, wrong in zip(journey(**more), journey(spoil, **more), strict=True):
        gap = np.asarray(wrong.pose - right.pose)
        cov = np.asarray((right if believed else wrong).covariance) + 1e-12 * np.eye(3)
        found.append(gap @ np.linalg.solve(cov, gap))
    return max(found), np.asarray(wrong.rejected - right.rejected)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("rate", [8.0, 30.0, -30.0, 1e4])
def test_wrong_gyro_readings_turn_nothing(rate, count):
    """Even if they agree, for less than the time after which they are believed."""
    far, rejected = moved(lambda z, _: z | {"gyro": rate}, count=count)
    assert far < 0.05
    np.testing.assert_array_equal(rejected, [count, 0, 0, 0])


@pytest.mark.parametrize("jump", [-100.0, -1.0, -0.4, 0.2, 0.4, 1.0, 7.0])
def test_a_wrong_angle_of_an_encoder_moves_nothing(jump):
    off = jump * np.array([1.0, 0.0, 0.0])
    for gyro in ({}, {"gyro": np.nan}):
        far, rejected = moved(lambda z, _: z | {"wheel_angle": z["wheel_angle"] + off}, **gyro)
        assert far < (0.05 if abs(jump) >= 1.0 else REGION / 2)
        np.testing.assert_array_equal(rejected, [0, int(abs(jump) >= 1.0), 0, 0])


@pytest.mark.parametrize("amps", [1.0, 5.0, 20.0])
def test_a_wrong_current_moves_the_pose_within_its_region(amps):
    for all_motors in (1.0, 0.0):
        wrong = amps * np.array([1.0, all_motors, all_motors])
        far, rejected = moved(lambda z, _, wrong=wrong: z | {"current": wrong}, gyro=np.nan)
        assert far < REGION / 4
        count = (1 + 2 * all_motors) if amps == 20.0 else 0
        np.testing.assert_array_equal(rejected, [0, 0, count, 0])


@pytest.mark.parametrize("distance", [0.05, 0.2, 5.0])
def test_a_wrong_fix_moves_the_pose_within_its_region(distance):
    for std in (0.01, 0.05):

        def spoil(z, pose, std=std):
            fix = pose + np.array([distance, 0.0, 0.0])
            return z | {"fix": fix, "fix_std": np.array([std, std]), "fix_age": 0.0}

        far, rejected = moved(spoil, believed=True)
        assert far < REGION
        assert rejected[FIX] == (distance > 6 * std)
        assert far < 0.01 or rejected[FIX] == 0


@pytest.mark.parametrize("period", [1, 20])
def test_three_fixes_that_agree_move_the_robot_whatever_was_believed(period):
    """A robot that was carried elsewhere and turned, which drives on; two cameras a second."""
    est, run = watch()
    state, angle, speed = est.init(), np.zeros(3), wheels([0.2, 0.0, 0.2])
    truth, heard = jnp.array([3.0, -2.0, 2.5]), 0
    rng = np.random.default_rng(0)
    for k in range(5 * period):
        state, said = run(state, reading(wheel_angle=angle, gyro=0.2), DT)
        angle = angle + DT * speed
        truth = compose(truth, advance(said.twist, DT))
        if k % period == period - 1:
            heard += 1
            fix = np.asarray(truth) + 0.01 * rng.normal(size=3)
            z = reading(fix=fix, fix_std=np.array([0.01, 0.01]), fix_age=0.0)
            state, said = run(state, z, 1e-4)
            near = np.hypot(*(said.pose - truth)[:2]) < 0.05
            assert near == (heard >= 3)
    np.testing.assert_allclose(said.rejected[FIX], 2)
    assert np.abs(np.asarray(said.pose - truth)).max() < 0.03
    assert np.linalg.eigvalsh(np.asarray(said.covariance)).min() > 0


def turned_by_hand(angle, seconds, rate_hz=20, drives=0.0):
    """Heading and its std half a second after a robot is turned by hand."""
    est, run = watch()
    state, dt, angles, speed = est.init(), 1 / rate_hz, np.zeros(3), wheels([drives, 0.0, 0.0])
    turning = round(seconds * rate_hz)
    for k in range(rate_hz + turning + rate_hz // 2):
        x = np.clip((k - rate_hz + np.arange(2)) / turning, 0.0, 1.0)
        far = angle * (x - np.sin(2 * np.pi * x) / (2 * np.pi))
        angles = angles + dt * speed
        z = reading(wheel_angle=angles, gyro=(far[1] - far[0]) / dt)
        state, said = run(state, z, dt)
        if k == rate_hz + turning - 1:
            at_once = float(said.pose[2])
    return at_once, float(said.pose[2]), float(jnp.sqrt(said.covariance[2, 2])), said


@pytest.mark.parametrize("drives", [0.0, 0.2])
@pytest.mark.parametrize("rate_hz", [5, 20, 50])
def test_a_robot_that_is_turned_by_hand_is_believed_in_half_a_second(rate_hz, drives):
    once, later, _, said = turned_by_hand(np.pi / 2, 0.5 if rate_hz > 5 else 0.6, rate_hz, drives)
    assert once == pytest.approx(np.pi / 2, abs=0.02)
    assert later == pytest.approx(np.pi / 2, abs=0.02)
    assert 0 < said.rejected[GYRO] <= 0.2 * rate_hz


def test_a_bump_that_is_too_short_to_be_believed_is_doubted():
    _, later, std, said = turned_by_hand(0.3, 0.12, 50)
    assert abs(later - 0.3) < 3 * std
    assert 2 <= said.rejected[GYRO] <= 6


# encoders ------------------------------------------------------------------------------------


@cache
def encoders():
    f, s = robot().arrays, jax.tree.map(jnp.asarray, Settings())
    read = jax.jit(
        lambda state, angle, dt: read_wheels(
            f, s, state, replace(Readings.nothing(3), wheel_angle=angle), dt
        )
    )
    return WheelState.init(f, s), read


def rolled(angles, dt=DT):
    """Motion that is accounted for in every step, and how many readings were set aside."""
    state, read = encoders()
    found = []
    for angle in angles:
        state = read(state, jnp.broadcast_to(jnp.asarray(angle, float), (3,)), jnp.asarray(dt))
        found.append(float(state.speed[0]) * dt)
    return np.array(found), float(state.rejected) / 3


def steady(speed=4.0, steps=60):
    """Angles of a wheel that accelerates and then keeps its speed."""
    return np.cumsum(DT * np.minimum(0.5 + 1.0 * np.arange(steps), speed))


@pytest.mark.parametrize("offset", [-50.0, 3.0])
def test_a_lasting_offset_of_an_encoder_is_no_motion(offset):
    angle = steady()
    shifted = angle + np.where(np.arange(60) >= 30, offset, 0.0)
    found, rejected = rolled(shifted)
    np.testing.assert_allclose(found, rolled(angle)[0], atol=1e-9)
    assert rejected == 1


def test_motion_between_readings_that_are_lost_counts_when_they_return():
    angle = steady()
    for lost in (slice(30, 31), slice(30, 35), slice(30, 45)):
        gaps = angle.copy()
        gaps[lost] = np.nan
        found, rejected = rolled(gaps)
        assert found.sum() == pytest.approx(angle[-1] - angle[0], abs=1e-9)
        assert rejected <= 1


def test_an_encoder_that_repeats_its_angle_may_be_late_and_catches_up_in_parts():
    angle = steady()
    late = angle.copy()
    late[30:36] = angle[29]
    late[36] = angle[32]
    late[37] = angle[32]
    found, rejected = rolled(late)
    assert found.sum() == pytest.approx(angle[-1] - angle[0], abs=1e-9)
    assert rejected == 0


def test_a_wheel_that_stops_or_starts_at_once_is_believed_at_the_second_reading():
    stops = np.minimum(steady(8.0), steady(8.0)[30])
    starts = np.maximum(0.6 * (np.arange(40) - 20), 0.0)
    for angle in (stops, starts):
        found, rejected = rolled(angle)
        assert found.sum() == pytest.approx(angle[-1] - angle[0], abs=1e-9)
        assert rejected <= 1
    assert np.abs(found[:21]).max() == 0.0
    np.testing.assert_allclose(found[25:], 0.6, atol=1e-9)


def test_ticks_of_a_coarse_encoder_all_count():
    """Twenty ticks a turn, read a hundred times a second."""
    tick = 2 * np.pi / 20
    angle = tick * np.floor(np.cumsum(0.01 * np.minimum(0.1 * np.arange(400), 5.0)) / tick)
    found, rejected = rolled(angle, 0.01)
    assert found.sum() == pytest.approx(angle[-1], abs=1e-9)
    assert rejected == 0


def test_a_wheel_that_starts_at_once_is_believed_by_the_ticks_of_a_coarse_encoder():
    """Two readings in a row differ by a tick, which is fast for a hundredth of a second."""
    tick = 2 * np.pi / 20
    angle = tick * np.floor(0.4 * np.maximum(np.arange(60) - 20, 0) / tick + 0.3)
    found, rejected = rolled(angle, 0.01)
    assert found.sum() == pytest.approx(angle[-1], abs=1e-9)
    assert rejected <= 1


# whatever comes in ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["omni 3", "differential"])
def test_after_any_readings_the_estimate_tracks_again(kind):
    """Four robots in turn among wrong readings of all kinds, then among right ones."""
    made = robot() if kind == "omni 3" else deploy_known(build(SHAPES[kind], list(FLOORS)))
    est = Estimator(made)
    f, sensed = made.arrays, Readings.nothing(made.drives)

    def spoilt(key, z):
        flat, tree = jax.tree.flatten(z)
        keys = jax.random.split(key, len(flat) + 1)
        rate = jax.random.choice(keys[-1], jnp.array([0.0, 0.1, 0.5, 1.0]))

        def one(key, x):
            k = jax.random.split(key, 4)
            bad = jax.random.choice(k[0], jnp.asarray(BAD), x.shape)
            far = x + jax.random.normal(k[1], x.shape) * 10 ** jax.random.uniform(k[2], x.shape)
            wrong = jnp.where(jax.random.bernoulli(k[3], 0.5, x.shape), bad, far)
            return jnp.where(jax.random.uniform(k[2], x.shape) < rate, wrong, x)

        return jax.tree.unflatten(tree, [one(k, x) for k, x in zip(keys[:-1], flat, strict=True)])

    def step(carry, row):
        (state, angle, speed, pose), (key, wrong) = carry, row
        k = jax.random.split(key, 4)
        aim = jax.random.uniform(k[0], (3,), minval=-1.0) * jnp.array([0.3, 0.2, 0.8])
        aim = jnp.where(jax.random.bernoulli(k[1], 0.05), f.forward @ aim / f.frame.radius, speed)
        speed = speed + jnp.clip(aim - speed, -2.0, 2.0)
        twist = f.inverse @ (f.frame.radius * speed)
        pose, angle = compose(pose, advance(twist, DT)), angle + DT * speed
        z = replace(sensed, wheel_angle=angle, wheel_speed=speed, gyro=twist[2], fix=pose)
        z = replace(z, fix_std=jnp.array([0.01, 0.02]), current=jnp.full(f.drives, 0.3))
        bad, one = spoilt(k[2], z), jax.random.choice(k[3], jnp.asarray([*BAD, DT, DT, DT, DT]))
        z = jax.tree.map(lambda a, b: jnp.where(wrong, a, b), bad, z)
        state, said = est.advance(state, z, jnp.where(wrong, one, DT))
        cov = said.covariance
        std = jnp.sqrt(jnp.maximum(jnp.diag(cov), 1e-12))
        least = jnp.linalg.eigvalsh(0.5 * (cov + cov.T) / std[:, None] / std)[0]
        sound = said.finite & (least > -1e-9) & jnp.all(jnp.abs(cov - cov.T) <= 1e-9)
        return (state, angle, speed, pose), (sound, said.pose - pose, said.rejected)

    @jax.jit
    def ran(key):
        wrong = jnp.tile(jnp.arange(100) < 40, 4)
        begin = est.init(), jnp.zeros(f.drives), jnp.zeros(f.drives), jnp.zeros(3)
        return jax.lax.scan(step, begin, (jax.random.split(key, 400), wrong))[1]

    for seed in range(4):
        sound, gap, rejected = map(np.asarray, ran(jax.random.key(seed)))
        assert sound.all()
        ends = gap[99::100]
        assert np.hypot(ends[:, 0], ends[:, 1]).max() < 0.03
        assert np.abs(np.arctan2(np.sin(ends[:, 2]), np.cos(ends[:, 2]))).max() < 0.1
        assert (rejected[-1] > 0).all()
        np.testing.assert_array_equal(rejected[99::100], rejected[89::100])
