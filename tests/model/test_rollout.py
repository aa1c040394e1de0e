from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model import contact
from slipid.model.geometry import omni, skid_steer
from slipid.model.robot import build, twist, wheel_torque
from slipid.model.rollout import SpeedLoop, inertia, replay, replay_twist, simulate
from slipid.search_space import Choice, Space

RADIUS, DT = 0.04, 0.002
NUMBERS = {
    "robot.mass": 12.0,
    "motor.resistance": 5.95,
    "motor.back_emf": 0.0514,
    "motor.inductance": 8.9e-3,
    "motor.rotor_inertia": 7.1e-6,
    "motor.coulomb_friction": 0.07,
    "surface.soft.creep": 0.4,
    "surface.hard.creep": 0.04,
    "surface.hard.roller_drag": 0.12,
}


def made(geometry=None, floors=("hard", "soft"), **more):
    geometry = omni([60.0, 180.0, 300.0], 0.125, RADIUS, 16.0) if geometry is None else geometry
    robot = build(geometry, floors)
    return Space(robot, [Choice(k, fixed=v) for k, v in {**NUMBERS, **more}.items()]).template


ROBOT = made()
HARD, SOFT = 0, 1


def wheels_for(xi):
    return np.asarray(ROBOT.geometry.forward()) @ np.asarray(xi) / RADIUS


@functools.cache
def compiled(function, **how):
    return eqx.filter_jit(functools.partial(function, **how))


def driven(xi, steps=600, robot=ROBOT, loop=None, **how):
    command = jnp.asarray(np.tile(wheels_for(xi), (2000, 1)))
    loop = SpeedLoop() if loop is None else loop
    run = compiled(simulate, **how)(robot, loop, command, DT, jnp.asarray(SOFT), jnp.asarray(0))
    return jax.tree.map(lambda x: x[: steps + 1], run)


def replayed(robot, time, angle, floor=SOFT, start=None, **how):
    return compiled(replay, **how)(robot, time, angle, jnp.asarray(floor), jnp.asarray(0), start)


@pytest.fixture(scope="module")
def curve():
    return driven([0.15, 0.08, 0.6])


@pytest.mark.parametrize("body_inertia", [True, False])
@pytest.mark.slow
def test_replay_of_simulated_wheels_is_the_simulated_path(body_inertia):
    run = driven([0.15, 0.08, 0.6], body_inertia=body_inertia)
    pose = replayed(ROBOT, run.time, run.wheel_angle, body_inertia=body_inertia)
    np.testing.assert_allclose(pose, run.pose, atol=1e-9)
    assert np.hypot(*run.pose[-1, :2]) > 0.1


@pytest.mark.slow
def test_wheels_obey_their_torque_balance_in_every_step(curve):
    frame, motor = ROBOT.geometry.frame(), ROBOT.motor

    def gap(xi, w, before, amps):
        load = wheel_torque(ROBOT, frame, xi, w, jnp.asarray(SOFT), jnp.asarray(0))
        rotor = motor.gear_ratio**2 * motor.rotor_inertia
        return motor.torque(amps, w) - load - rotor * (w - before) / DT

    w = curve.wheel_speed
    gaps = jax.vmap(gap)(curve.twist[1:], w[1:], w[:-1], curve.current[1:])
    assert float(jnp.abs(gaps).max()) < 1e-7
    held = jax.vmap(motor.voltage)(curve.current[1:], w[1:])
    np.testing.assert_allclose(curve.voltage[:-1], held, atol=1e-6)


def test_body_obeys_newton_in_every_step(curve):
    frame = ROBOT.geometry.frame()
    share = ROBOT.body.load_share[0]
    mass = inertia(ROBOT, SOFT)

    def force(xi, w):
        out = contact.forces(xi, frame.radius * w, frame, ROBOT.surfaces.at(SOFT), share).residual
        return out.at[2].multiply(frame.base)

    pushed = jax.vmap(force)(curve.twist[1:], curve.wheel_speed[1:])
    np.testing.assert_allclose(pushed, mass * jnp.diff(curve.twist, axis=0) / DT, atol=1e-8)


@pytest.mark.slow
def test_small_inertia_is_quasi_static():
    t = np.linspace(0, 2, 81)
    angle = jnp.asarray(np.outer(t + 0.2 * np.sin(3 * t), wheels_for([0.15, 0.05, 0.3])))
    time = jnp.asarray(t)
    balanced = replayed(ROBOT, time, angle)
    gaps = []
    for mass in (1e-1, 1e-2, 1e-3):
        light = eqx.tree_at(lambda r: r.body.yaw_inertia, ROBOT, jnp.asarray(mass / 50))
        # friction torque scales with the weight: a light body under the same mu m g
        light = eqx.tree_at(lambda r: r.body.mass, light, jnp.asarray(mass))
        grip = ROBOT.surfaces.friction * ROBOT.body.mass / mass
        light = eqx.tree_at(lambda r: r.surfaces.friction, light, grip)
        heavy = replayed(light, time, angle, body_inertia=True)
        gaps.append(float(jnp.abs(heavy - balanced).max()))
    assert gaps[0] / gaps[1] == pytest.approx(10, rel=0.05)
    assert gaps[1] / gaps[2] == pytest.approx(10, rel=0.05)
    assert gaps[2] < 1e-5


@pytest.mark.slow
def test_inertia_delays_but_ends_at_the_same_twist():
    steady = jnp.tile(jnp.asarray(wheels_for([0.2, 0.0, 0.0])), (400, 1))
    dt = jnp.full(400, 0.005)
    xi = replay_twist(ROBOT, dt, steady, SOFT, 0, body_inertia=True)
    at_once = replay_twist(ROBOT, dt, steady, SOFT, 0)
    assert float(xi[0, 0]) < 0.3 * float(at_once[0, 0])
    np.testing.assert_allclose(xi[-1], at_once[-1], atol=1e-9)


@pytest.mark.slow
def test_smooth_motion_converges_with_the_step():
    def end(steps):
        t = np.linspace(0, 2, steps + 1)
        t = np.concatenate([t, 2 + 0.01 * np.arange(1, 1601 - steps)])  # one shape to compile
        angle = np.outer(1 - np.cos(t.clip(0, 2)), wheels_for([0.1, 0.05, 0.4]))
        return np.asarray(replayed(ROBOT, jnp.asarray(t), jnp.asarray(angle))[-1])

    fine = end(1600)
    coarse = [np.abs(end(n) - fine).max() for n in (50, 100, 200)]
    assert coarse[2] < 1e-5
    assert coarse[0] / coarse[1] > 1.8
    assert coarse[1] / coarse[2] > 1.8


@pytest.mark.slow
def test_floors_may_change_on_the_way():
    t = jnp.asarray(np.linspace(0, 2, 41))
    angle = jnp.asarray(np.outer(t, wheels_for([0.1, 0.0, 0.0])))
    both = replayed(ROBOT, t, angle, [HARD] * 20 + [SOFT] * 20)
    first = replayed(ROBOT, t[:21], angle[:21], [HARD] * 20)
    second = replayed(ROBOT, t[20:], angle[20:], [SOFT] * 20, start=both[20])
    np.testing.assert_allclose(both, jnp.concatenate([first, second[1:]]), atol=1e-12)
    assert float(first[-1, 0]) > 1.1 * float(both[-1, 0] - both[20, 0])


def test_electrical_energy_covers_the_mechanical(curve):
    electric = float(jnp.sum(curve.voltage[:-1] * curve.current[1:]) * DT)
    shaft = jax.vmap(ROBOT.motor.torque)(curve.current, curve.wheel_speed)
    mechanical = float(jnp.sum(shaft * curve.wheel_speed) * DT)
    heat = float(jnp.sum(ROBOT.motor.resistance * curve.current**2) * DT)
    v, turn = curve.twist[-1, :2], curve.twist[-1, 2]
    rotor = ROBOT.motor.gear_ratio**2 * ROBOT.motor.rotor_inertia
    kinetic = 0.5 * float(
        ROBOT.body.mass * v @ v
        + ROBOT.body.yaw_inertia * turn**2
        + rotor * jnp.sum(curve.wheel_speed[-1] ** 2)
    )
    assert electric > mechanical + heat  # the rest is lost in the gear
    assert mechanical > kinetic > 0.05


@pytest.mark.slow
def test_inductance_changes_the_start_and_not_the_end(curve):
    slow = driven([0.15, 0.08, 0.6], inductance=True, steps=2000)
    quick = driven([0.15, 0.08, 0.6], steps=2000)
    fastest = int(jnp.argmax(jnp.abs(quick.current[1])))
    assert abs(float(slow.current[1, fastest])) < 0.7 * abs(float(quick.current[1, fastest]))
    np.testing.assert_allclose(slow.current[-1], quick.current[-1], atol=1e-4)
    np.testing.assert_allclose(slow.twist[-1], quick.twist[-1], atol=1e-5)


@pytest.mark.slow
def test_current_rises_with_the_electrical_time_constant():
    stuck = made(**{"motor.rotor_inertia": 1e3, "motor.inductance": 0.5})
    run = driven([0.2, 0.0, 0.0], robot=stuck, loop=SpeedLoop(integral=0.0), inductance=True)
    tau = float(stuck.motor.inductance / stuck.motor.resistance)
    at = round(tau / DT)
    volt = run.voltage[0, 2]
    want = volt / stuck.motor.resistance * (1 - (1 + DT / tau) ** -at)  # implicit Euler's decay
    assert float(run.current[at, 2]) == pytest.approx(float(want), rel=2e-3)


@pytest.mark.slow
def test_wheels_settle_at_the_set_speed():
    run = driven([0.15, 0.08, 0.6], steps=2000)
    np.testing.assert_allclose(run.wheel_speed[-1], wheels_for([0.15, 0.08, 0.6]), rtol=2e-3)
    frame = ROBOT.geometry.frame()
    balanced = twist(ROBOT, frame, run.wheel_speed[-1], jnp.asarray(SOFT), jnp.asarray(0))
    np.testing.assert_allclose(run.twist[-1], balanced, atol=1e-4)


def test_voltage_stays_inside_its_limit_and_the_integral_does_not_wind_up():
    weak = driven([0.6, 0.0, 0.0], loop=SpeedLoop(limit=3.0))
    assert float(jnp.abs(weak.voltage).max()) == pytest.approx(3.0)
    assert float(weak.wheel_speed[-1, 2]) < 0.5 * wheels_for([0.6, 0.0, 0.0])[2]


@pytest.mark.slow
def test_standing_still_stays_still():
    run = driven([0.0, 0.0, 0.0])
    assert float(jnp.abs(run.pose).max()) < 1e-12
    assert float(jnp.abs(run.voltage).max()) < 1e-12
    standing = replayed(ROBOT, run.time, run.wheel_angle, HARD)
    assert float(jnp.abs(standing).max()) < 1e-9


def test_turning_the_command_by_a_third_turns_the_path():
    c, s = np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)
    start = driven([0.15, 0.04, 0.2])
    turned = driven([c * 0.15 - s * 0.04, s * 0.15 + c * 0.04, 0.2])
    x, y = np.asarray(start.pose[:, :2]).T
    np.testing.assert_allclose(turned.pose[:, 0], c * x - s * y, atol=1e-9)
    np.testing.assert_allclose(turned.pose[:, 1], s * x + c * y, atol=1e-9)
    np.testing.assert_allclose(turned.pose[:, 2], start.pose[:, 2], atol=1e-9)
    # wheel k stands where wheel k - 1 stood
    np.testing.assert_allclose(turned.current, jnp.roll(start.current, 1, axis=1), atol=1e-8)


@pytest.mark.slow
def test_vmap_over_runs_is_each_run_by_itself():
    twists = [0.1, 0.0, 0.0], [0.0, 0.1, 1.0]
    commands = jnp.asarray([np.tile(wheels_for(xi), (100, 1)) for xi in twists])
    one = lambda c: simulate(ROBOT, SpeedLoop(), c, DT, jnp.asarray(SOFT), jnp.asarray(0))  # noqa: E731
    together = jax.jit(jax.vmap(one))(commands)
    for k, xi in enumerate(twists):
        np.testing.assert_allclose(together.pose[k], driven(xi, steps=100).pose, atol=1e-10)


@pytest.mark.slow
def test_four_ordinary_wheels_drive_and_turn():
    geometry = skid_steer(0.1, 0.15, RADIUS, 16.0)
    robot = made(geometry)
    command = jnp.tile(jnp.asarray([2.0, 4.0, 2.0, 4.0]), (500, 1))
    go = compiled(simulate)
    run = go(robot, SpeedLoop(), command, DT, jnp.asarray(HARD), jnp.asarray(0))
    assert float(run.twist[-1, 0]) == pytest.approx(0.12, rel=0.1)
    assert 0.02 < float(run.twist[-1, 2]) < 0.08 / 0.3  # slower than wheels that do not scrub
