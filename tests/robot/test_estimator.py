"""Estimator and controllers under sensors that fail, lie or stop: no NaN, nothing beyond limits."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slipid.model import contact
from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.robot import closed_loop
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import LARGEST_INTEGRAL, Controller, limit_command
from slipid.robot.estimator import Estimator, Odometry
from slipid.robot.filter.floor import Floor
from slipid.robot.filter.floor_filter import FloorFilter
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.filter.pose_fix import _within
from slipid.robot.gains import Gains
from slipid.robot.interface import UNTIMED_S, Measurement, Readings, Settings
from slipid.robot.limits import Limits
from slipid.robot.supervision import RECOVERY_MOST
from slipid.robot.trajectory import rectangle
from slipid.robot.twin import Twin, TwinPlant
from tests.helpers import small_twin
from tests.helpers.compiled_loop import Flat
from tests.helpers.known_robot import deploy_known
from tests.helpers.stepped import stepped

PATH = rectangle()
LIMITS = Limits()
HAND = Gains(1.5, 1.5, 0.0, 0.0, 0.0)
WHEEL_ACCELERATION = LIMITS.acceleration / 0.04
"""Limit of wheel acceleration of wheels with a radius of 40 mm [rad/s^2]."""
DT = 0.05
KINDS = ("contact", "curve")
CHESS = Floor.of("abc", np.add.outer(np.arange(9), np.arange(9)) % 3, (-1.0, -1.0), 0.25, "abc")
solve = eqx.filter_jit(FloorFilter.solve)
limited = eqx.filter_jit(limit_command)
BAD = (np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-310, 0.0, -1.0, 1e9, 3e7, 50.0)


@cache
def robot():
    """A robot of three omni wheels on floors that differ in friction, creep and drag."""
    made = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ("a", "b", "c"))
    values = ([0.3, 0.45, 0.6], [0.2, 0.4, 0.9], [0.12, 0.25, 0.4], [0.15, 0.2, 0.4])
    made = eqx.tree_at(
        lambda r: (
            r.surfaces.friction,
            r.surfaces.creep,
            r.surfaces.roller_drag,
            r.surfaces.roller_creep,
        ),
        made,
        [jnp.asarray(v) for v in values],
    )
    return deploy_known(made, highest_speed=13.0)


@cache
def control_loop(kind):
    deployed = robot()
    if kind == "curve":
        gains = Gains(2.0, 2.0, 0.2, 0.0, 0.15)
        return ControlLoop(Odometry(deployed, curve=True), Controller(deployed, gains))
    gains = Gains(2.0, 2.0, 0.2, 0.3, 0.15)
    there = CHESS if kind == "mapped" else None
    return ControlLoop(Estimator(deployed, floor=there), Controller(deployed, gains))


@cache
def step(kind):
    p = control_loop(kind)
    return jax.jit(lambda state, z, dt: p.step(PATH, state, z, dt))


def reading(**known):
    """A measurement with only what is given."""
    return Measurement(**known).filled(3)


def sane(kind, state, said, before, dt):
    """Whether everything is finite and the command within its limits, for one robot."""
    p = control_loop(kind)
    f, order = p.controller.robot, Flat(state)
    last, now = before.controller, state.controller
    # an angle that was never read is NaN
    angle, numbers = order.place("estimator.wheels.angle"), order.ravel(state)
    rest = jnp.concatenate([numbers[: angle.start], numbers[angle.stop :]])
    finite = jnp.all(jnp.isfinite(rest)) & jnp.all(jnp.isfinite(Flat(said).ravel(said)))
    finite &= ~jnp.any(jnp.isinf(numbers[angle]))
    command, amps = said.command, said.estimate.current
    passed = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, 0.5), 0.0)
    stops = jnp.all(jnp.abs(command) <= jnp.abs(last.command))
    passed = jnp.where(stops, jnp.maximum(passed, UNTIMED_S), passed)
    allowed = WHEEL_ACCELERATION * passed + 1e-9
    slow = jnp.all(jnp.abs(command) <= LIMITS.wheel_speed + 1e-9)
    gentle = jnp.all(jnp.abs(command - last.command) <= allowed) | ~last.begun
    left = jnp.maximum(LIMITS.voltage - f.motor.resistance * jnp.abs(amps), 0.2 * LIMITS.voltage)
    most = jnp.min(left) / (f.motor.gear_ratio * f.motor.back_emf)
    had = jnp.where(last.begun, jnp.max(jnp.abs(last.command)), LIMITS.wheel_speed)
    held = jnp.max(jnp.abs(command)) <= jnp.maximum(most, had) + 1e-9
    return jnp.stack([finite, slow, gentle, held, jnp.all(command == now.command)])


@cache
def check(kind):
    return jax.jit(lambda *a: sane(kind, *a))


# whatever comes in ---------------------------------------------------------------------------


SENSED = Flat(Readings.nothing(3))


def adversary(key, count, angle):
    """Readings and time steps of so many robots, most of them broken in some way."""
    k = jax.random.split(key, 10)
    speed = jax.random.uniform(k[0], (count, 3), minval=-12.0, maxval=12.0)
    stuck = jax.random.bernoulli(k[9], 0.01, (count, 3))
    angle = jnp.where(stuck, angle, angle + DT * speed)
    # a reset or a jump of one encoder in a hundred, another hundredth stuck
    reset = jax.random.bernoulli(k[1], 0.01, (count, 3))
    angle = jnp.where(reset, jax.random.normal(k[2], (count, 3)) * 1e3, angle)
    good = jax.random.normal(k[3], (count, SENSED.size)) * 3.0
    good = good.at[:, SENSED.place("wheel_angle")].set(angle)
    good = good.at[:, SENSED.place("wheel_speed")].set(speed)
    std = SENSED.place("fix_std")
    good = good.at[:, std].set(jnp.abs(good[:, std]) * 0.01)
    bad = jax.random.choice(k[4], jnp.asarray(BAD), (count, SENSED.size))
    rate = jax.random.choice(k[5], jnp.array([0.0, 0.05, 0.5, 1.0]), (count, 1))
    z = jnp.where(jax.random.uniform(k[6], (count, SENSED.size)) < rate, bad, good)
    dt = jnp.where(
        jax.random.uniform(k[7], (count,)) < 0.1,
        jax.random.choice(k[8], jnp.asarray(BAD), (count,)),
        DT,
    )
    return z, dt, angle


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "steps"),
    [
        ("contact", 100),
        ("curve", 700),
        ("mapped", 100),
        pytest.param("contact", 10_000, marks=pytest.mark.nightly),
        pytest.param("mapped", 2000, marks=pytest.mark.nightly),
        pytest.param("curve", 10_000, marks=pytest.mark.nightly),
    ],
)
def test_adversarial_steps(kind, steps):
    """A hundred robots at once, so that the nightly ones take a million steps."""
    p, robots = control_loop(kind), 100

    def one(carry, key):
        state, angle = carry
        z, dt, angle = adversary(key, robots, angle)
        new, ok = jax.lax.map(of_one, (state, z, dt))  # vmap takes minutes to compile
        return (new, angle), jnp.all(ok, axis=0)

    def of_one(given):
        state, z, dt = given
        new, said = p.step(PATH, state, SENSED.unravel(z), dt)
        return new, sane(kind, new, said, state, dt)

    begin = jax.tree.map(lambda x: jnp.broadcast_to(x, (robots, *x.shape)), p.init())
    keys = jax.random.split(jax.random.key(0), steps)
    _, ok = jax.jit(lambda s, k: jax.lax.scan(one, (s, jnp.zeros((robots, 3))), k))(begin, keys)
    names = ("finite", "speed", "acceleration", "voltage", "kept")
    np.testing.assert_array_equal(np.asarray(ok).all(0), True, err_msg=str(names))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_any_reading_leaves_a_sound_state(kind, data):
    value = st.one_of(st.sampled_from(BAD), st.floats(), st.floats(-20, 20))
    state, size = control_loop(kind).init(), SENSED.size
    for _ in range(4):
        z = SENSED.unravel(jnp.array(data.draw(st.lists(value, min_size=size, max_size=size))))
        dt = data.draw(st.one_of(st.just(DT), value))
        new, said = step(kind)(state, z, dt)
        assert np.asarray(check(kind)(new, said, state, dt)).all(), (z, dt)
        state = new


# a wheel that is not heard -------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_stops_where_a_wheel_falls_silent_and_goes_on_without_a_bump(kind):
    state, angle, command, rows = control_loop(kind).init(), np.zeros(3), np.zeros(3), []
    for k in range(160):
        angle = angle + command * DT
        heard = angle.copy()
        if 60 <= k < 100:
            heard[1] = np.nan
        z = reading(wheel_angle=heard, current=np.full(3, 0.3))
        state, said = step(kind)(state, z, DT)
        command = np.asarray(said.command)
        rows.append(command)
    rows, quiet = np.array(rows), 60 + int(0.3 / DT) + 1
    assert np.abs(rows[55]).max() > 2.0, "it drives before"
    assert np.abs(np.diff(rows, axis=0)).max() <= WHEEL_ACCELERATION * DT + 1e-9
    brake = int(np.ceil(LIMITS.wheel_speed / WHEEL_ACCELERATION / DT)) + 1
    np.testing.assert_array_equal(rows[quiet + brake : 100], 0.0)
    assert np.abs(rows[100] - rows[99]).max() <= WHEEL_ACCELERATION * DT + 1e-9
    assert np.abs(rows[120:]).max() > 1.0, "it drives again"
    assert float(said.time) > 0


def test_a_pilot_that_wakes_on_a_moving_robot_starts_from_its_wheels():
    state, speed = control_loop("contact").init(), np.array([4.0, -3.0, 2.0])
    state, said = step("contact")(state, reading(wheel_speed=speed), DT)
    assert np.abs(np.asarray(said.command) - speed).max() <= WHEEL_ACCELERATION * DT + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_state_is_of_one_kind_from_the_start(kind):
    """Else a step is compiled twice."""
    begin = jax.eval_shape(control_loop(kind).init)
    after, _ = jax.eval_shape(control_loop(kind).step, PATH, begin, reading(), jnp.asarray(DT))
    for a, b in zip(jax.tree.leaves(begin), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)


# the parts -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_saturation_keeps_the_direction():
    rng = np.random.default_rng(0)
    for _ in range(50):
        wanted = rng.normal(size=3) * 30
        got = np.asarray(
            limited(jnp.asarray(wanted), jnp.zeros(3), jnp.zeros(3), robot(), LIMITS, 0.5)
        )
        np.testing.assert_allclose(np.cross(got, wanted), 0.0, atol=1e-9)
        assert got @ wanted > 0


@pytest.mark.parametrize("amps", [(0.0, 0.0, 0.0), (2.0, 0.0, -1.0)])
def test_a_command_needs_no_more_than_the_supply_has_left(amps):
    f, limits = robot(), Limits(voltage=6.0, acceleration=1e4)
    wanted, motor = np.array([10.0, -9.0, 2.0]), f.motor
    got = np.asarray(limited(jnp.asarray(wanted), jnp.zeros(3), jnp.asarray(amps), f, limits, DT))
    np.testing.assert_allclose(got / wanted, got[0] / wanted[0], rtol=1e-12)
    needs = np.abs(got) * float(motor.gear_ratio * motor.back_emf)
    left = 6.0 - float(motor.resistance) * np.abs(amps)
    assert np.max(needs / left) == pytest.approx(1.0)


@cache
def watch(s=None):
    est = Estimator(robot(), s)
    return est, stepped(est)


def drive(state, count, speed=(0.0, 0.0, 0.0), angle=None, **known):
    """States and estimates of an estimator over so many steps."""
    _, run = watch()
    said = []
    for _ in range(count):
        state, e = run(state, reading(wheel_speed=np.asarray(speed), **known), DT)
        said.append(e)
    return state, said


def wheels(twist):
    return np.asarray(robot().forward @ np.asarray(twist) / robot().frame.radius)


@pytest.mark.slow
def test_without_slip_it_is_the_encoders():
    f = robot()
    sticky = replace_floor(f)
    est = Estimator(sticky)
    run = partial(stepped(est), dt=DT)
    state = est.init()
    for _ in range(40):
        state, e = run(state, reading(wheel_speed=wheels([0.2, 0.1, 0.3])))
    twist = np.asarray(e.twist)
    np.testing.assert_allclose(twist, [0.2, 0.1, 0.3], atol=2e-3)


def replace_floor(f):
    """The robot on floors that neither drag nor let slip."""
    names = ("creep", "roller_drag", "roller_viscosity", "rolling_resistance", "scrub", "lead")
    return eqx.tree_at(
        lambda r: [getattr(r.floors, n) for n in names], f, [jnp.full(3, 1e-6, float)] * len(names)
    )


@pytest.mark.slow
def test_the_covariance_grows_and_a_fix_shrinks_it():
    est, _ = watch()
    state, said = drive(est.init(), 60, wheels([0.2, 0.0, 0.0]))
    size = [float(np.trace(np.asarray(e.covariance)[:2, :2])) for e in said]
    assert (np.diff(size) > 0).all()
    fix = np.asarray(said[-1].pose)
    _, after = drive(state, 1, fix=fix, fix_std=np.array([0.002, 0.004]), fix_age=0.0)
    assert np.trace(np.asarray(after[0].covariance)[:2, :2]) < 0.2 * size[-1]
    eigen = np.linalg.eigvalsh(np.asarray(after[0].covariance))
    assert eigen.min() > -1e-12


@pytest.mark.slow
def test_a_late_fix_corrects_as_a_prompt_one_does():
    est, run = watch()
    off, speed = np.array([0.05, -0.03, 0.1]), wheels([0.2, 0.05, 0.2])
    state, _ = drive(est.init(std=(0.1, 0.2)), 20, speed)
    state, more = drive(state, 10, speed)
    std = np.array([0.002, 0.004])
    now = np.asarray(more[-1].pose)
    was = np.asarray(more[-5].pose)

    def moved(pose):  # the whole way lies turned and shifted by a constant error
        c, s = np.cos(off[2]), np.sin(off[2])
        return np.array([c * pose[0] - s * pose[1], s * pose[0] + c * pose[1], pose[2]]) + off

    one = {"fix_std": std}
    _, prompt = run(state, reading(fix=moved(now), fix_age=0.0, **one), 1e-4)
    _, late = run(state, reading(fix=moved(was), fix_age=4 * DT, **one), 1e-4)
    np.testing.assert_allclose(prompt.pose, moved(now), atol=0.01)
    np.testing.assert_allclose(late.pose, prompt.pose, atol=0.01)


def test_a_late_fix_does_not_know_what_came_after_it():
    """Late, it leaves at least the covariance of one in time that was driven on from."""
    est, run = watch()
    speed, std = wheels([0.2, 0.05, 0.2]), np.array([0.001, 0.002])
    state, _ = drive(est.init(std=(0.05, 0.1)), 60, speed)
    there = np.asarray(state.place.pose)
    prompt, _ = run(state, reading(fix=there, fix_std=std, fix_age=0.0), 1e-4)
    prompt, _ = drive(prompt, 12, speed)
    late, _ = drive(state, 12, speed)
    late, _ = run(late, reading(fix=there, fix_std=std, fix_age=12 * DT), 1e-4)
    a, b = (np.asarray(x.place.covariance)[:3, :3] for x in (late, prompt))
    assert np.all(np.diag(a) > 0.7 * np.diag(b))
    assert np.all(np.diag(a) < 2.0 * np.diag(b))
    assert np.linalg.eigvalsh(a).min() > 0
    # one in time, then an old one: it knows next to nothing of now
    here = np.asarray(late.place.pose)
    before, _ = run(late, reading(fix=here, fix_std=std, fix_age=0.0), 1e-4)
    off = np.array([0.003, -0.003, 0.004])
    after, _ = run(before, reading(fix=there + off, fix_std=std, fix_age=12 * DT), 1e-4)
    without, _ = run(before, reading(), 1e-4)
    a, b = (x.place for x in (after, without))
    assert np.all(np.abs(a.pose - b.pose) < 0.25 * np.abs(off))
    assert np.linalg.eigvalsh(b.covariance[:3, :3] - a.covariance[:3, :3]).min() > -1e-12


def test_of_a_covariance_only_what_another_can_hold_is_set_aside():
    rng = np.random.default_rng(0)
    for scale in (1e-3, 0.1, 1.0, 30.0):
        for _ in range(20):
            a, b = rng.normal(size=(2, 3, 3))
            part, whole = scale * a @ a.T, b @ b.T
            held = np.asarray(_within(jnp.asarray(part), jnp.asarray(whole)))
            assert np.linalg.eigvalsh(whole - held).min() > -1e-9
            most = np.linalg.eigvals(np.linalg.solve(whole, part)).real.max()
            assert held[0, 0] >= part[0, 0] / max(1.16 * most, 1.0)


@pytest.mark.slow
def test_fixes_that_all_come_late_count_for_what_they_say():
    est, run = watch()
    speed, std = wheels([0.2, 0.05, 0.3]), np.array([0.001, 0.002])
    truth, state = [], est.init(std=(0.05, 0.1))
    bare, timely = est.init(), est.init(std=(0.05, 0.1))
    one = {"fix_std": std}
    for k in range(80):
        bare, said = run(bare, reading(wheel_speed=speed), DT)
        truth.append(np.asarray(said.pose))
        late = {"fix": truth[k - 5], "fix_age": 5 * DT} | one if k >= 5 and k % 2 else {}
        state, said = run(state, reading(wheel_speed=speed, **late), DT)
        prompt = {"fix": truth[k], "fix_age": 0.0} | one if k < 75 and k % 2 == 0 else {}
        timely, _ = run(timely, reading(wheel_speed=speed, **prompt), DT)
        if k == 30:  # pushed
            push = jnp.array([0.02, -0.02, 0.05])
            state = eqx.tree_at(lambda s: s.place.pose, state, state.place.pose + push)
    held = state.place
    assert np.all(np.abs(np.asarray(held.pose) - truth[-1]) < [0.01, 0.01, 0.02])
    for part in (slice(0, 2), slice(2, 3)):  # place, turned with the robot, and heading
        now, known = (np.trace(x.place.covariance[part, part]) for x in (state, timely))
        assert 0.6 * known < now < 2.0 * known


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lost", [(), (20,), (20, 21, 22), tuple(range(3, 60, 4))])
def test_readings_that_are_lost_do_not_make_the_way_longer(kind, lost):
    est = control_loop(kind).estimator
    run = stepped(est)

    def way(lost, twice=()):
        state, angle, speed = est.init(), np.zeros(3), wheels([0.2, 0.0, 0.0])
        for k in range(60):
            heard = reading() if k in lost else reading(wheel_angle=angle)
            state, said = run(state, heard, DT)
            if k in twice:  # the same time once more
                state, said = run(state, heard, 0.0)
            angle = angle + DT * speed
        return np.asarray(said.pose)

    np.testing.assert_allclose(way(lost), way(()), atol=2e-3)
    np.testing.assert_allclose(way((), lost), way(()), atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dt", [0.0, np.nan, -1.0])
def test_it_stops_where_the_clock_fails_for_good(kind, dt):
    p, run = control_loop(kind), step(kind)
    state, angle = p.init(), np.zeros(3)
    moved = 0.0
    for k in range(100):
        z = reading(wheel_angle=angle, current=jnp.full(3, 0.3))
        state, out = run(state, z, DT if k < 40 else dt)
        command = np.asarray(out.command)
        angle, moved = angle + DT * command, max(moved, np.abs(command).max())
    assert moved > 1.0
    assert np.abs(command).max() == 0.0


def test_the_gyro_bias_is_learnt_at_rest_and_not_while_it_creeps():
    est, _ = watch()
    state, _ = drive(est.init(), 60, gyro=0.012)
    assert abs(float(state.place.nuisance[-1]) - 0.012) < 0.002
    state, _ = drive(est.init(), 60, wheels([0.01, 0.0, 0.0]), gyro=0.012)
    assert abs(float(state.place.nuisance[-1])) < 1e-9
    state, _ = drive(est.init(), 60, gyro=0.1)  # wheels stand, the robot is turned by hand
    assert abs(float(state.place.nuisance[-1])) < 1e-9


@pytest.mark.slow
def test_heading_is_the_integral_of_a_gyro_without_bias_whatever_is_believed_of_the_floors():
    est, run = watch(Settings(gyro_bias_std=0.0))
    rng = np.random.default_rng(0)
    state, rates, pose = est.init(), rng.uniform(-0.4, 0.4, 50), None
    for k, rate in enumerate(rates):  # currents say another thing at every step
        amps = rng.uniform(0.0, float(robot().highest[1]), 3)
        speed = wheels([0.2 * np.cos(k), 0.2 * np.sin(k), 0.0])
        state, said = run(state, reading(wheel_speed=speed, gyro=rate, current=amps), DT)
        assert float(said.twist[2]) == pytest.approx(rate, abs=1e-9)
        pose = said.pose
    assert float(pose[2]) == pytest.approx(rates.sum() * DT, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("bias", [0.012, -0.008])
def test_a_robot_that_starts_at_once_learns_its_gyro_bias_from_the_contact_model(bias):
    one = robot().on("b")
    est, there = Estimator(one), FloorFilter(one, Settings())
    state, true, twist, before = est.init(), 0.0, jnp.zeros((1, 3)), jnp.zeros(3)
    turns = partial(solve, there)
    run = stepped(est)
    for k in range(500):
        speed = wheels([0.2 * np.cos(0.01 * k), 0.2 * np.sin(0.01 * k), 0.0])
        twist, amps = turns(twist, before, speed)
        before = speed
        rate = float(twist[0, 2])
        true += rate * DT
        z = reading(wheel_speed=speed, current=jnp.abs(amps[0]), gyro=rate + bias)
        state, said = run(state, z, DT)
    assert float(state.place.nuisance[-1]) == pytest.approx(bias, abs=0.002)
    off = abs(float(said.pose[2]) - true)
    assert off < 0.25 * abs(bias) * 500 * DT
    assert off < 3 * float(jnp.sqrt(said.covariance[2, 2])) + 1e-3


@pytest.mark.slow
def test_an_error_of_the_model_on_one_patch_is_not_taken_for_the_bias():
    """The model's yaw rate is off by half a per cent of the rim speed for half a metre."""
    one = robot().on("b")
    est, there = Estimator(one), FloorFilter(one, Settings())
    state, run, speed, off = est.init(), stepped(est), wheels([0.2, 0.0, 0.0]), 0.008
    twist, amps = partial(solve, there)(jnp.zeros((1, 3)), 0 * speed, speed)
    z = reading(wheel_speed=speed, current=jnp.abs(amps[0]), gyro=float(twist[0, 2]) + off)
    for _ in range(50):
        state, _ = run(state, z, DT)
    assert abs(float(state.place.nuisance[-1])) < 0.5 * off


@pytest.mark.slow
def test_a_late_gyro_is_taken_for_its_own_time():
    late = 3
    est, run = watch(Settings(gyro_delay_s=late * DT))
    turn = np.concatenate([np.zeros(10), np.full(40, 0.3), np.zeros(20)])
    state = est.init()
    for k, rate in enumerate(turn):
        z = reading(wheel_speed=wheels([0.0, 0.0, rate]), gyro=turn[k - late] if k >= late else 0.0)
        state, e = run(state, z, DT)
    # the model's turns before and after the delay are the same: what is left is the gyro's integral
    assert float(e.pose[2]) == pytest.approx(turn.sum() * DT, abs=0.01)


def test_a_robot_at_rest_turns_as_its_gyro_says_less_the_bias():
    est, _ = watch()
    state, said = drive(est.init(), 80, gyro=0.012)
    # what the heading drifted before the bias was known is taken back with it
    assert abs(float(said[-1].pose[2])) < 0.002
    _, said = drive(state, 20, gyro=0.012 + 0.2)  # by hand
    assert float(said[-1].pose[2]) == pytest.approx(0.2 * 20 * DT, abs=0.01)


@pytest.mark.slow
def test_the_observer_takes_a_constant_disturbance_out():
    """A body that does what it is asked to but for a constant: what is wanted comes about."""
    f, step = robot(), eqx.filter_jit(Controller.step)
    for gain, left in ((0.0, 1.0), (1.0, 0.0)):
        con = Controller(f, Gains(0.0, 0.0, 0.0, gain, 0.0))
        reference = jnp.array([0.0, 0.0, 0.0, 0.1, 0.05, 0.0])
        off, state, twist = np.array([-0.04, 0.02, 0.1]), con.init(), np.zeros(3)
        for _ in range(120):
            said = estimate(f, twist=jnp.asarray(twist), wheel_speed=state.command)
            state, command = step(con, state, reference, said, DT)
            twist = np.asarray(f.inverse @ (f.frame.radius * command)) + off
        np.testing.assert_allclose(twist, [0.1, 0.05, 0.0] + left * off, atol=1e-3)


def test_the_integral_asks_for_no_more_than_it_may_however_long_a_robot_is_off():
    f = robot()
    con = Controller(f, Gains(0.0, 0.0, 1.0, 0.0, 0.0))
    step = jax.jit(lambda s, e: con.step(s, jnp.array([0.3, -0.1, 0.0, 0.0, 0.0, 0.0]), e, DT))
    state = con.init()
    for _ in range(40):
        state, command = step(state, estimate(f, wheel_speed=state.command))
    np.testing.assert_allclose(state.integral, [LARGEST_INTEGRAL, -LARGEST_INTEGRAL], rtol=1e-12)
    np.testing.assert_allclose(
        command, wheels([LARGEST_INTEGRAL, -LARGEST_INTEGRAL, 0.0]), rtol=1e-9
    )


def test_a_stuck_robot_turns_and_drives_alternately_twice_as_hard_then_gives_up_until_rearmed():
    """Going and turning cancel at two of its three wheels, as they do where only one spins."""
    f = robot()
    con = Controller(f, HAND, Limits(acceleration=1e4), recovery=True)
    reference = jnp.array([0.0, 0.05, np.arcsin(0.25), 0.0, 0.0, 0.0])
    said = estimate(f, immobilised=jnp.ones((), bool))
    step = jax.jit(lambda s, e, r: con.step(s, r, replace(e, wheel_speed=s.command), DT))
    state, commands, helpless = con.init(), [], []
    for _ in range(400):
        state, command = step(state, said, reference)
        commands.append(np.asarray(command))
        helpless.append(bool(state.gave_up))
    rows = np.array(commands)
    end = helpless.index(True)
    assert 14.0 < end * DT < 16.0
    tried = rows[12:end]
    turns = np.ptp(tried, axis=1) < 1e-6
    goes = np.abs(tried.sum(axis=1)) < 1e-6
    assert turns.sum() > 60
    assert goes.sum() > 60
    sizes = np.abs(tried).max(axis=1)
    assert sizes[turns][-1] > 1.5 * sizes[turns][0]
    assert sizes[turns].max() <= RECOVERY_MOST * np.abs(rows[5]).max()
    assert np.abs(rows).max() <= LIMITS.wheel_speed
    np.testing.assert_allclose(rows[end + 20 :], 0.0)
    # it has stopped, whatever is believed of it afterwards, until it is armed again
    for _ in range(20):
        state, command = step(state, estimate(f), reference)
    assert bool(state.gave_up)
    np.testing.assert_allclose(command, 0.0)
    by_call, _ = step(con.rearmed(state), estimate(f), reference)
    assert not bool(by_call.gave_up)
    assert np.abs(by_call.command).max() > 0.1
    for k in range(21):
        state, _ = step(state, estimate(f), jnp.zeros(6))
        assert bool(state.gave_up) == (k < 19)


def test_a_robot_that_hardly_goes_where_it_is_asked_to_go_counts_as_stuck_and_one_that_goes_not():
    f = robot()
    con = Controller(f, HAND, recovery=True)
    reference = jnp.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0])
    step = jax.jit(lambda s, e: con.step(s, reference, replace(e, wheel_speed=s.command), DT))
    for speed, stuck in ((0.1, False), (0.02, True)):
        state, said = con.init(), estimate(f, twist=jnp.array([speed, 0.0, 0.0]))
        for _ in range(20):
            state, _ = step(state, said)
        assert (float(state.tried) > 0) == stuck
    for _ in range(100):
        state, _ = step(state, said)
    assert float(state.tried) > 4.5  # turning on the spot is no going
    # one that goes again for a while goes on as usual
    for _ in range(40):
        state, command = step(state, estimate(f, twist=jnp.array([0.2, 0.0, 0.0])))
    assert float(state.tried) == 0.0
    np.testing.assert_allclose(command, wheels([0.2, 0.0, 0.0]), atol=1e-9)


@pytest.mark.slow
def test_a_robot_that_nothing_frees_gives_up_and_its_run_ends():
    """Its rollers drag so much that wheels spin in place; the estimator knows."""
    numbers = (jnp.full(2, 4.0), jnp.full(2, 0.2))
    slick = eqx.tree_at(
        lambda r: (r.floors.roller_drag, r.floors.creep), small_twin.deployed(), numbers
    )
    start, alone = (0.0, 0.0, 0.0), small_twin.floor([[0]])
    plant = TwinPlant(Twin(slick, alone), start, jax.random.key(0))
    course = closed_loop.run_closed_loop(
        ControlLoop(Estimator(slick), Controller(slick, Gains(), recovery=True)), PATH, plant, start
    )
    assert 15.0 < course.time[-1] < 25.0
    assert course.path_time[-1] < 0.5 * PATH.duration
    rolled = DT * float(slick.frame.radius) * np.abs(course.command).max(axis=1).sum()
    assert np.abs(course.pose[:, :2]).max() < 0.02 * rolled
    assert np.abs(course.command[150:300]).max() > 1.2 * np.abs(course.command[:20]).max()


def estimate(f, **known):
    """An estimate of zeros but for what is given."""
    _, said = Odometry(f).step(Odometry(f).init(), Measurement(), DT)
    return replace(jax.tree.map(jnp.zeros_like, said), **known)


@pytest.mark.slow
def test_twists_of_the_hypotheses_are_at_the_wheel_speeds_of_the_estimate():
    f, speed = robot(), wheels([0.15, -0.1, 0.4])
    state, said = drive(watch()[0].init(), 30, speed, current=np.full(3, 0.4))
    e = said[-1]
    each = jax.vmap(
        lambda under: contact.equilibrium(
            f.frame.radius * e.wheel_speed, f.frame, f.floors.at(under), f.rest
        )
    )(jnp.asarray(hypotheses_of(f).under))
    np.testing.assert_allclose(state.floors.twist, each, atol=3e-3)


@pytest.mark.slow
def test_wheels_that_creep_count_as_those_that_go():
    """Slower than counts as moving; the same way then moves and doubts as much."""
    f = small_twin.deployed(process=1.0, run=1.0)
    est, found = Estimator(f), []
    run = partial(stepped(est), dt=DT)
    for speed, steps in ((0.02, 1200), (0.2, 120)):
        turning = f.forward @ jnp.array([0.0, 0.0, speed]) / f.frame.radius
        state = est.init()
        for _ in range(steps):
            state, e = run(state, reading(wheel_speed=turning))
        found.append((e.pose, state.place.toward, np.diag(state.place.covariance)))
    assert 0.02 * f.frame.base < Settings().still_m_s
    assert found[0][0][2] > 0.6
    *slow, slow_variance = found[0]
    *fast, fast_variance = found[1]
    for a, b in zip(slow, fast, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.1, atol=0.02)
    known = fast_variance > 0  # the doubt about floors in yaw is a third less where rollers creep
    assert np.all(np.abs(np.log(slow_variance[known] / fast_variance[known])) < np.log(1.6))


@pytest.mark.slow
def test_a_robot_that_stands_stays_as_sure_as_it_is():
    state, _ = drive(watch()[0].init(), 20, wheels([0.2, 0.1, 0.3]))
    _, later = drive(state, 1200)
    np.testing.assert_allclose(later[-1].pose, later[1].pose, atol=1e-6)
    np.testing.assert_allclose(later[-1].covariance, later[1].covariance, atol=1e-12)


def test_flags_come_on_and_go_off():
    est, _ = watch()
    speed = wheels([0.2, 0.0, 0.0])
    state, said = drive(est.init(), 40, speed)
    assert not any(float(x) for e in said[5:] for x in (e.stale, e.immobilised))
    state, said = drive(state, 10, np.full(3, np.nan))
    assert float(said[-1].stale) == 1
    state, said = drive(state, 5, speed)
    assert float(said[-1].stale) == 0
    fast = 1.4 * 13.0 * speed / np.abs(speed).max()
    assert float(drive(state, 2, fast)[1][-1].out_of_range) == 1


@pytest.mark.slow
def test_currents_that_no_floor_explains_are_out_of_range():
    sure = eqx.tree_at(lambda f: f.current_std, robot(), jnp.full(3, 0.03, float))
    est = Estimator(sure, Settings(ammeter_std_a=0.02))
    run = partial(stepped(est), dt=DT)
    state, speed = est.init(), wheels([0.2, 0.0, 0.0])
    for amps, beyond in ((0.3, 0.0), (1.25 * float(sure.highest[1]), 1.0)):
        for _ in range(60):
            z = reading(wheel_speed=speed, current=amps * np.array([1.0, 0.0, 1.0]) + 0.1 * beyond)
            state, said = run(state, z)
        assert float(said.out_of_range) == beyond
    assert np.asarray(said.surface_probability)[0, -1] > 0.5


@pytest.mark.slow
def test_a_robot_that_spins_its_wheels_in_place_is_immobilised():
    slick = eqx.tree_at(
        lambda r: (r.floors.roller_drag, r.floors.creep),
        robot(),
        (jnp.full(3, 4.0, float), jnp.full(3, 0.2, float)),
    )
    est = Estimator(slick, Settings())
    run = partial(stepped(est), dt=DT)
    state = est.init()
    for _ in range(30):
        state, e = run(state, reading(wheel_speed=wheels([0.2, 0.0, 0.0])))
    assert float(e.immobilised) == 1
