"""Errors of the estimator are as large as it says: news counted once, NEES, NIS, effects."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from slipid.model import contact
from slipid.model.se2 import advance, compose
from slipid.robot.estimator import Estimator
from slipid.robot.filter.effects import DIRECTION_STD, SETTLING_LENGTH, effect_correlation
from slipid.robot.filter.floor import Floor
from slipid.robot.filter.floor_filter import FloorFilter
from slipid.robot.filter.pose_filter import PoseFilter, _scalar_update
from slipid.robot.filter.pose_fix import _given, apply_fix
from slipid.robot.interface import MIXED_FLOORS_PENALTY, Measurement, Readings, Settings
from slipid.robot.twin import ActuatorModel, Twin
from tests.helpers.kept import kept
from tests.helpers.small_twin import deployed, floor
from tests.helpers.stepped import stepped

DT = 0.05
FIRM = floor([[0]])
corrected, given = jax.jit(apply_fix), jax.jit(_given)
solve = eqx.filter_jit(FloorFilter.solve)
ROUND = ((0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (-0.2, 0.0, 0.0), (0.1, -0.15, 0.3))


def rolling(robot, twist):
    """Wheel speeds of a twist without slip [rad/s]."""
    return robot.forward @ jnp.asarray(twist) / robot.frame.radius


def settled(robot, w, surface):
    """Twist on a floor [m/s, m/s, rad/s]."""
    rim = robot.frame.radius * jnp.asarray(w)
    return contact.equilibrium(rim, robot.frame, robot.floors.at(surface), robot.rest)


def ended(*ways):
    """Pose after some times [s] at some twists."""
    pose = jnp.zeros(3)
    for twist, seconds in ways:
        pose = compose(pose, advance(twist, seconds))
    return np.asarray(pose)


def sure_of(state, hypothesis, count, of_others=1e-9):
    """The state with another belief."""
    belief = jnp.full(count + 1, of_others).at[hypothesis].set(1.0)
    return eqx.tree_at(lambda s: s.floors.belief, state, belief / belief.sum())


# belief changes are handed over once -----------------------------------------------------------


@pytest.mark.slow
def test_late_evidence_corrects_the_pose_by_the_difference_of_the_paths_once():
    robot = deployed()
    est = Estimator(robot, Settings(patch_m=1e9))  # floors do not change on the way
    run = partial(stepped(est), dt=DT)
    w = rolling(robot, (0.2, 0.05, 0.1))
    state = est.init()
    for _ in range(5):  # hypotheses settle; this way is not counted
        state, _ = run(state, Measurement(wheel_speed=w).filled(3))
    place, twists = est.init().place, state.floors.twist
    state = eqx.tree_at(lambda s: (s.place, s.floors.apart), state, (place, jnp.zeros((8, 3))))
    state, steps = sure_of(state, 0, 8), 30
    for _ in range(steps):
        state, said = run(state, Measurement(wheel_speed=w).filled(3))
    np.testing.assert_allclose(said.pose, ended((twists[0], steps * DT)), atol=2e-5)
    state = sure_of(state, 7, 8)
    for more in (1, 2, 3):
        state, said = run(state, Measurement(wheel_speed=w).filled(3))
        there = ended((twists[7], (steps + more) * DT))
        np.testing.assert_allclose(said.pose, there, atol=2e-5)
    assert np.hypot(*(there - ended((twists[0], (steps + more) * DT)))[:2]) > 0.02


@pytest.mark.slow
def test_a_floor_that_changes_within_a_step_moves_the_pose_by_what_was_travelled():
    robot = eqx.tree_at(lambda r: r.current_std, deployed(), jnp.full(2, 0.003))
    sure = Settings(
        current_is_signed=True, ammeter_std_a=0.003, forget_s=DT, filter_s=1e-3, patch_m=0.05
    )
    est = Estimator(robot, sure)
    run = partial(stepped(est), dt=DT)
    w = rolling(robot, (0.2, 0.05, 0.1))
    near, amps = solve(FloorFilter(robot, sure), jnp.zeros((8, 3)), w, w)
    for _ in range(5):
        near, amps = solve(FloorFilter(robot, sure), near, w, w)
    state = est.init()
    for _ in range(10):
        state, said = run(state, Measurement(wheel_speed=w, current=amps[0]).filled(3))
    assert float(said.surface_probability[:, 0].min()) > 0.99
    begin = eqx.tree_at(lambda s: s.place, state, est.init().place)
    state, steps = begin, 20
    for k in range(2 * steps):
        z = Measurement(wheel_speed=w, current=amps[0 if k < steps else 7]).filled(3)
        state, said = run(state, z)
        at_once = float(said.surface_probability[:, 0 if k < steps else 1].min())
        assert at_once > 0.99
    a, b = (settled(robot, w, k) for k in (0, 1))
    there = ended((a, steps * DT), (b, steps * DT))
    # a step of the way on the other floor is 5 mm and 10 mrad
    np.testing.assert_allclose(said.pose, there, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("own", [1.0, 1e-2, 1e-4])
def test_what_a_late_fix_sets_aside_leaves_a_covariance(own):
    """Most of the noise that came in since then is known by what it has in common with the rest."""
    rng, start = np.random.default_rng(0), PoseFilter(deployed(), Settings()).init(jnp.zeros(3))
    late = replace(
        Readings.nothing(3),
        fix=jnp.zeros(3),
        fix_std=jnp.array([0.03, 1e-4]),
        fix_age=jnp.asarray(1.0),
    )
    for _ in range(20):
        a, b, way = rng.normal(size=(3, 3)), rng.normal(size=(12, 12)), rng.normal(size=(3, 12))
        rest, alone = b @ b.T, own * (a @ a.T + 0.1 * np.eye(3))
        cov = np.block([[way @ rest @ way.T + alone, way @ rest], [rest @ way.T, rest]])
        np.testing.assert_allclose(given(jnp.asarray(cov)), alone, atol=1e-6 * own)
        now = replace(
            start,
            pose=jnp.array([8.0, 4.0, 0.0]),
            covariance=jnp.asarray(cov),
            noise=jnp.asarray(cov[:3, :3]),
            history=start.history.at[:, 0].set(1.0),
        )
        values = np.linalg.eigvalsh(corrected(now, late)[0].covariance)
        assert values[0] > -1e-9 * values[-1]


@pytest.mark.slow
def test_a_late_fix_after_news_of_the_floors_does_not_count_the_hand_over_twice():
    """News, then a fix of a moment before it that says the same: the pose is where the robot is."""
    robot = eqx.tree_at(lambda r: r.current_std, deployed(1.0, 1.0, 1.0), jnp.full(2, 0.003))
    # floors do not change on the way, and currents tell them at once
    sure = Settings(
        current_is_signed=True, ammeter_std_a=0.003, forget_s=DT, filter_s=1e-3, patch_m=1e9
    )
    est = Estimator(robot, sure)
    run = stepped(est)
    w, near = rolling(robot, (0.2, 0.05, 0.1)), jnp.zeros((8, 3))
    for _ in range(8):  # hypotheses settle
        near, amps = solve(FloorFilter(robot, sure), near, w, w)
    state, steps, late = est.init(std=(0.01, 0.02)), 40, 10
    state = sure_of(state, 0, 8)
    state = eqx.tree_at(lambda s: (s.floors.twist, s.wheels.speed), state, (near, w))
    for k in range(steps + 3):  # what was taken for the first floor is the second
        z = Measurement(wheel_speed=w, current=amps[0 if k < steps else 7])
        state, said = run(state, z.filled(3), DT)
        if k == steps - 1:
            np.testing.assert_allclose(said.pose, ended((near[0], steps * DT)), atol=1e-3)
    there, then = (ended((near[7], (steps + 3 - k) * DT)) for k in (0, late))
    np.testing.assert_allclose(said.pose, there, atol=1e-3)
    assert np.hypot(*(there - ended((near[0], (steps + 3) * DT)))[:2]) > 0.03
    fix = Measurement(fix=then, fix_std=(0.001, 0.002), fix_age=late * DT)
    after, _ = run(state, fix.filled(3), 1e-4)
    np.testing.assert_allclose(after.place.pose, there, atol=2e-3)


# effects ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 7, 200])
def test_an_effect_correlates_over_a_turn_as_the_kernel_says_in_however_many_steps(steps):
    for turn in (0.0, 0.1, 0.3, np.pi):
        before, now = np.eye(3)[0], np.array([np.cos(turn), np.sin(turn), 0.0])
        far = jnp.asarray(10 * SETTLING_LENGTH / steps)
        kept, v = 1.0, jnp.asarray(before)
        for _ in range(steps):
            v, keep = effect_correlation(v, jnp.asarray(now), jnp.zeros(1), far)
            kept *= float(keep[0])
        expected = np.exp(-np.sum((now - before) ** 2) / (2 * DIRECTION_STD**2))
        assert kept == pytest.approx(expected, abs=1e-3)


def test_a_direction_that_trembles_keeps_its_effect_and_a_floor_left_does_not():
    rng, v, kept = np.random.default_rng(0), jnp.zeros(3), 1.0
    for angle in rng.normal(0.0, np.radians(0.5), 200):
        now = jnp.array([jnp.cos(angle), jnp.sin(angle), 0.0])
        v, keep = effect_correlation(v, now, jnp.zeros(1), jnp.asarray(0.005))  # a metre
        kept *= float(keep[0])
    assert kept > 0.9
    _, keep = effect_correlation(v, v, jnp.array([0.0, 1.0]), jnp.asarray(0.5))
    assert keep[0] == pytest.approx(1.0, abs=1e-6)
    assert keep[1] < 0.01


@pytest.mark.slow
def test_a_way_back_errs_anew():
    """Errors of a way on add up, those of a way back are independent of the way out."""
    robot = deployed(run=1.0).on("firm")
    robot = eqx.tree_at(lambda r: r.effect, robot, robot.effect.at[:, 2].set(0.0))
    est = Estimator(robot)
    run = partial(stepped(est), dt=DT)

    def along(*speeds):
        state = est.init()
        for speed in speeds:
            w = rolling(robot, (speed, 0.0, 0.0))
            for _ in range(200):
                state, said = run(state, Measurement(wheel_speed=w).filled(3))
        return float(said.covariance[0, 0])

    once = along(0.1)
    assert along(0.1, 0.1) == pytest.approx(4 * once, rel=0.02)
    assert along(0.1, -0.1) == pytest.approx(2 * once, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("under", [(0, 0, 0), (1, 0, 0), (0, 1, 1)])
def test_motion_by_friction_is_that_of_finite_differences(under):
    bias = jnp.asarray([[0.1, -0.15, 0.05], [-0.2, 0.05, 0.15]])
    robot = eqx.tree_at(
        lambda r: (r.floors.drag_exponent, r.floors.load_bias),
        deployed(),
        (jnp.asarray([1.0, 1.6]), bias),
    )
    w = rolling(robot, (0.2, 0.1, 0.1))
    rim = robot.frame.radius * w

    def twist(friction):
        floors = eqx.tree_at(lambda f: f.friction, robot.floors, friction).at(np.array(under))
        return contact.equilibrium(rim, robot.frame, floors, robot.rest)

    sure, mu = jnp.eye(2)[jnp.asarray(under)], robot.floors.friction
    slope = FloorFilter(robot, Settings())._by_friction(twist(mu), w, sure)
    by_hand = jax.jacfwd(twist)(mu) * mu
    np.testing.assert_allclose(slope, by_hand, atol=1e-6)
    assert (np.abs(slope).max() > 0.01) == (len(set(under)) > 1)


def test_a_reading_moves_what_learns_and_leaves_the_rest_with_the_right_covariance():
    robot = deployed(process=1.0, run=1.0)
    state = PoseFilter(robot, Settings()).init(jnp.zeros(3), (0.05, 0.1))
    rng, count = np.random.default_rng(0), len(state.covariance)
    mix = rng.normal(size=(count, count))
    cov, look = mix @ mix.T / count, rng.normal(size=count)
    noise, learns = 0.3, np.isin(np.arange(count), [2, count - 1]).astype(float)
    state, var = replace(state, covariance=jnp.asarray(cov)), look @ cov @ look + noise
    now = _scalar_update(
        state, jnp.asarray(look), jnp.asarray(0.7), jnp.asarray(var), jnp.asarray(learns)
    )
    change = np.concatenate([now.pose - state.pose, now.nuisance - state.nuisance])
    np.testing.assert_array_equal(change[learns == 0], 0.0)
    assert np.abs(change[learns == 1]).min() > 0
    gain = learns * (cov @ look) / var
    left = np.eye(count) - np.outer(gain, look)
    exact = left @ cov @ left.T + noise * np.outer(gain, gain)
    np.testing.assert_allclose(now.covariance, exact, atol=1e-12)


@pytest.mark.slow
def test_a_gyro_leaves_what_pushes_the_body_as_it_is():
    """The belief about the floors already uses the same gyro."""
    robot = deployed(process=1.0, run=1.0, current=1.0)
    state, speed = Estimator(robot).init(), rolling(robot, (0.2, 0.0, 0.0))
    est = Estimator(robot)
    run = partial(stepped(est), dt=DT)
    for k in range(40):
        reading = Measurement(wheel_angle=k * DT * speed, current=jnp.full(3, 0.4), gyro=0.1)
        state, _ = run(state, reading)
    np.testing.assert_array_equal(state.place.nuisance[:-1], 0.0)
    assert float(state.place.nuisance[-1]) > 0.001


# errors are as large as it says --------------------------------------------------------------


def path(robot):
    """Wheel speeds of a second at rest and of four ways in other directions (step, wheel)."""
    legs = [jnp.broadcast_to(rolling(robot, twist), (60, 3)) for twist in ROUND]
    return jnp.concatenate([jnp.zeros((20, 3)), *legs])


def squared(pose, cov, truth):
    """Square of an error over its covariance."""
    gap = pose - truth
    gap = gap.at[2].set(jnp.arctan2(jnp.sin(gap[2]), jnp.cos(gap[2])))
    return gap @ jnp.linalg.solve(cov + 1e-12 * jnp.eye(3), gap)


@cache
def driven(count=200):
    """Function of whether a gyro is there and whether fixes are heard; see `runs`."""
    whole, sure = deployed(process=1.0, run=1.0, current=1.0), Settings(gyro_bias_std=0.005)
    twin = Twin(whole, FIRM, ActuatorModel(gyro=True, smooth=True, voltage=False))
    est, commands, std = Estimator(whole.on("firm"), sure), path(whole), jnp.array([0.002, 0.004])
    wide = std[jnp.array([0, 0, 1])]

    def after(state, z, fix, heard):
        """State and estimate without the fix, and, if it is heard, with it."""
        nothing = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(est.step, state, z, DT)
        )

        def one(now):
            fix, is_there = now
            z_now = replace(z, fix=fix, fix_std=jnp.where(jnp.isnan(fix[0]), jnp.nan, std))
            return jax.lax.cond(
                is_there, lambda: est.step(state, z_now, DT), lambda: nothing
            )  # compiled once for both

        fixes = jnp.stack([jnp.full(3, jnp.nan), fix])
        both = jax.lax.map(one, (fixes, jnp.stack([jnp.asarray(True), heard])))
        new = jax.tree.map(lambda x: jnp.where(heard, x[1], x[0]), both[0])
        return new, jax.tree.map(lambda x: x[0], both[1])

    def one(key, gyro, fixes):
        def step(carry, now):
            true, state = carry
            command, number, off = now
            true, z = twin.step(true, command, twin.noise(key, number))
            z = replace(z, gyro=jnp.where(gyro, z.gyro, jnp.nan))
            turned = z.gyro - state.place.nuisance[-1]
            by_rest = turned**2 / (state.place.covariance[-1, -1] + sure.gyro_std**2)
            fix = true.pose + wide * off
            new, said = after(state, z, fix, fixes & (number % 20 == 0))
            by_fix = squared(said.pose, said.covariance + jnp.diag(wide**2), fix)
            return (true, new), (squared(said.pose, said.covariance, true.pose), by_fix, by_rest)

        off = jax.random.normal(jax.random.fold_in(key, 7), (len(commands), 3))
        begin = twin.init((0.0, 0.0, 0.0), key), est.init((0.0, 0.0, 0.0))
        steps = jnp.arange(1, len(commands) + 1)
        return jax.lax.scan(step, begin, (commands, steps, off))[1]

    keys = jax.random.split(jax.random.key(21), count)
    every = jax.jit(lambda gyro, fixes: jax.lax.map(lambda key: one(key, gyro, fixes), keys))
    return lambda gyro, fixes: every(jnp.asarray(gyro), jnp.asarray(fixes))


def runs(gyro, fixes):
    """Squared errors of the pose, of a fix at every step, and of gyro readings at rest.

    Robots drawn from what a fit says that the model misses, on a floor that is known; with `fixes`
    every twentieth is heard.
    """
    return [np.asarray(x) for x in driven()(gyro, fixes)]


def within(values, freedom):
    """Whether the mean of so many chi-squares lies within its 95 % band."""
    values = np.ravel(values)
    low, high = chi2.ppf([0.025, 0.975], freedom * values.size) / values.size
    print(f"mean {values.mean():.2f} of {freedom}, band {low:.2f} to {high:.2f}")
    return low < values.mean() < high


@pytest.mark.slow
@pytest.mark.parametrize("gyro", kept([False, True], [True]))
def test_nees_of_the_pose_after_each_of_four_paths(gyro):
    """Right to a fifth: 200 runs tell the mean to a ninth, and the filter is a linearised one."""
    nees, _, _ = runs(gyro, False)
    after = nees[:, 79::60].mean(axis=0)
    assert len(after) == len(ROUND)
    assert after.min() > 0.8 * 3
    assert after.max() < 1.2 * 3


@pytest.mark.slow
@pytest.mark.parametrize("gyro", kept([False, True], [True]))
def test_nis_of_fixes_and_of_the_gyro(gyro):
    _, by_fix, by_rest = runs(gyro, True)
    assert within(by_fix[:, 39::20], 3)
    if gyro:  # its bias is learnt at rest, each reading once
        assert within(by_rest[:, 8:20:12], 1)


@pytest.mark.slow
def test_regions_on_floors_that_are_not_known_are_not_too_narrow():
    """Patches drawn for every run, crossed over and over."""
    whole = deployed(process=1.0, run=1.0, current=1.0)
    est, commands = (
        Estimator(whole, Settings(further_floor_penalty=MIXED_FLOORS_PENALTY)),
        path(whole),
    )

    def one(key):
        cells = jax.random.bernoulli(jax.random.fold_in(key, 3), 0.5, (5, 5)).astype(int)
        drawn = Floor(cells, jnp.array([-1.0, -1.0]), jnp.asarray(0.4))
        twin = Twin(whole, drawn, ActuatorModel(smooth=True, voltage=False))

        def step(carry, now):
            true, state = carry
            true, z = twin.step(true, now[0], twin.noise(key, now[1]))
            state, said = est.step(state, z, DT)
            return (true, state), squared(said.pose, said.covariance, true.pose)

        begin = twin.init((0.0, 0.0, 0.0), key), est.init((0.0, 0.0, 0.0))
        steps = jnp.arange(1, len(commands) + 1)
        return jax.lax.scan(step, begin, (commands, steps))[1][-1]

    keys = jax.random.split(jax.random.key(5), 60)
    nees = np.asarray(jax.jit(lambda k: jax.lax.map(one, k))(keys))
    assert np.mean(nees < chi2.ppf(0.9, 3)) > 0.85
    assert nees.mean() > 0.5  # nor are they as wide as one likes
