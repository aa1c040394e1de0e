"""The twin: wheels, body, noise and sensors, its derivatives, and that it is a plant."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model import contact
from slipid.model.geometry import skid_steer
from slipid.model.robot import build
from slipid.robot.closed_loop import ControlLoop, Plant, run_closed_loop
from slipid.robot.controller import Controller
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Odometry
from slipid.robot.gains import Gains
from slipid.robot.trajectory import waypoints
from slipid.robot.twin import KEPT_COMMANDS, ActuatorModel, Twin, TwinPlant
from tests.helpers.known_robot import deploy_known
from tests.helpers.rolled_out import rollout
from tests.helpers.small_twin import deployed, floor, stacked

KEY = jax.random.PRNGKey(3)
START = (0.1, -0.05, 0.3)
FIRM, BOTH = floor([[0]]), floor([[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 0, 1, 0]])
SILENT = ActuatorModel(ammeter_a=0.0, voltmeter_v=0.0, gyro_noise=0.0, gyro_bias=0.0, smooth=True)


def control_loop(robot, gains=(1.5, 1.5, 0.1, 0.2, 0.1)):
    return ControlLoop(Odometry(robot), Controller(robot, Gains(*gains)))


def driven(twin, commands, key=KEY):
    """States after each of some commands."""

    def step(state, now):
        state, reading = twin.step(state, now[0], twin.noise(key, now[1]))
        return state, (state, reading)

    steps = jnp.arange(1, len(commands) + 1)
    return jax.lax.scan(step, twin.init(START, key), (commands, steps))[1]


def test_commands_arrive_late_as_a_fine_grid_says():
    for delay in (0.0, 0.03, 0.12, 0.25):
        share = ActuatorModel(delay_s=delay).command_weights()
        grid = (np.arange(100_000) + 0.5) / 100_000 * 0.05
        index = -np.floor((grid - delay) / 0.05).astype(int)
        brute = [[np.mean(part == k) for k in range(KEPT_COMMANDS)] for part in np.split(index, 2)]
        np.testing.assert_allclose(share, brute, atol=1e-4)
        np.testing.assert_allclose(share.sum(axis=1), 1.0)


def test_a_delay_beyond_the_ring_is_refused():
    with pytest.raises(ValueError, match=r"delay_s = 0\.4; expected a delay from 0 to 0\.25 s"):
        Twin(deployed(), FIRM, ActuatorModel(delay_s=0.4))


@pytest.mark.slow
def test_wheels_wait_then_slew_then_hold():
    state, _ = driven(Twin(deployed(), FIRM, SILENT), jnp.full((40, 3), 4.0))
    w = np.asarray(state.speed)
    assert np.all(w[:2] == 0.0)  # 0.12 s
    rise = np.diff(w[:, 0]) / 0.05
    assert rise.max() == pytest.approx(25.0, rel=0.03)
    np.testing.assert_allclose(w[-1], 4.0, rtol=1e-6)


@pytest.mark.slow
def test_a_body_at_constant_speed_moves_as_the_contact_says():
    robot = deployed()
    command = jnp.asarray([3.0, -2.0, 0.5])
    for cells, surface in ((FIRM, 0), (floor([[1]]), 1)):
        state, _ = driven(Twin(robot, cells, SILENT), jnp.broadcast_to(command, (40, 3)))
        rim = robot.frame.radius * command
        xi = contact.equilibrium(rim, robot.frame, robot.floors.at(surface), robot.rest)
        np.testing.assert_allclose(state.twist[-1], xi, atol=1e-6)
        pose = np.asarray(state.pose)
        gone = np.hypot(*(pose[-1] - pose[-2])[:2]) / 0.05
        assert gone == pytest.approx(float(jnp.hypot(xi[0], xi[1])), rel=1e-3)


@pytest.mark.slow
def test_a_body_on_a_calibrated_floor_moves_by_its_kinematics():
    """One motor a side; on both floors at once, and on the other floor, forces decide."""
    robot = deploy_known(build(skid_steer(0.15, 0.2, 0.1, drive_of=(0, 1, 0, 1)), ["firm", "soft"]))
    rows = ((0.04, 0.04), (0.005, -0.005), (-0.1, 0.1))
    firm, soft = robot.record.floors
    known = replace(firm, kinematics=rows)
    robot = DeployedRobot.of(replace(robot.record, floors=(known, soft)))
    command = jnp.array([2.0, 4.0])
    on_firm, on_soft, across = (
        Twin(robot, floor(cells), SILENT) for cells in ([[0]], [[1]], [[0, 1], [0, 1]])
    )
    state, reading = driven(on_firm, jnp.tile(command, (30, 1)))
    np.testing.assert_allclose(state.twist[-1], [0.24, -0.01, 0.2], rtol=1e-6)
    assert reading.wheel_angle.shape == reading.current.shape == (30, 2)
    np.testing.assert_allclose(np.diff(reading.wheel_angle[-2:], axis=0)[0] / 0.05, command)
    balance = robot.standing(jnp.full(4, 1)).twist(jnp.array([2.0, 4.0, 2.0, 4.0]))
    state, _ = driven(on_soft, jnp.tile(command, (30, 1)))
    np.testing.assert_allclose(state.twist[-1], balance, atol=1e-6)
    astride = robot.standing(jnp.array([1, 1, 0, 0])).twist(jnp.array([2.0, 4.0, 2.0, 4.0]))
    np.testing.assert_allclose(
        across._twist(across.floor.under(jnp.zeros(3), robot.places), command), astride, atol=1e-6
    )


@pytest.mark.slow
def test_runs_differ_by_what_the_fit_says():
    robot = deployed(run=1.0)
    twin = Twin(robot, FIRM, SILENT)
    command = robot.forward @ jnp.asarray([0.2, 0.0, 0.0]) / robot.frame.radius
    keys = jax.random.split(KEY, 400)
    poses = jax.jit(jax.vmap(lambda k: driven(twin, jnp.broadcast_to(command, (40, 3)), k)[0].pose))
    end, calm = (
        poses(keys)[:, -1],
        driven(Twin(deployed(), FIRM, SILENT), jnp.tile(command, (40, 1))),
    )
    far = float(jnp.hypot(*(calm[0].pose[-1] - jnp.asarray(START))[:2]))
    turned = np.asarray(end[:, 2] - calm[0].pose[-1, 2]) / far
    assert turned.std() == pytest.approx(0.03, rel=0.12)
    along = np.asarray((end - calm[0].pose[-1])[:, :2] @ np.array([np.cos(0.3), np.sin(0.3)])) / far
    assert along.std() == pytest.approx(0.01, rel=0.15)


@pytest.mark.slow
def test_sensors_read_ticks_and_magnitudes_and_nothing_that_is_not_there():
    habits = ActuatorModel(ticks=320.0, voltage=False)
    _, z = driven(Twin(deployed(current=1.0), FIRM, habits), jnp.full((30, 3), -3.0))
    tick = 2 * np.pi / 320.0
    np.testing.assert_allclose(z.wheel_angle / tick, np.round(z.wheel_angle / tick), atol=1e-9)
    assert np.all(np.asarray(z.current) >= 0)
    for part in (z.voltage, z.gyro, z.wheel_speed, z.fix, z.fix_age):
        assert np.all(np.isnan(part))
    every = ActuatorModel(gyro=True, signed=True)
    state, z = driven(Twin(deployed(), FIRM, every), jnp.full((30, 3), -3.0))
    assert np.all(np.asarray(z.current[10:]).mean(axis=0) < 0)
    assert np.all(np.asarray(z.voltage[-5:]) < 0)
    assert np.mean(z.gyro[-10:]) == pytest.approx(float(state.twist[-1, 2]), abs=0.03)


@pytest.mark.slow
def test_a_rollout_is_the_run_of_a_plant():
    robot, path = deployed(1.0, 1.0, 1.0), waypoints([(0.0, 0.0), (0.15, 0.0)], pause=0.2)
    path = path.moved(START)
    twin, own = Twin(robot, BOTH), control_loop(robot)
    plant = TwinPlant(twin, START, KEY)
    assert isinstance(plant, Plant)
    course = run_closed_loop(own, path, plant, START)
    pose, said = jax.jit(lambda k: rollout(own, path, twin, START, k, len(course.pose)))(KEY)
    np.testing.assert_allclose(pose[:, :2], course.pose[:, :2], atol=1e-12)
    np.testing.assert_allclose(said.command, course.command, atol=1e-12)
    np.testing.assert_allclose(said.time, course.path_time, atol=1e-12)
    other = run_closed_loop(own, path, TwinPlant(twin, START, jax.random.PRNGKey(4)), START)
    assert np.abs(other.pose[-1] - course.pose[-1]).max() > 1e-5
    for one, again in zip(*(jax.tree.leaves(plant.reset()) for _ in range(2)), strict=True):
        np.testing.assert_array_equal(one, again)


@pytest.mark.slow
def test_derivative_by_gains_is_that_of_finite_differences():
    robot = deployed(1.0, 1.0)
    path = waypoints([(0.0, 0.0), (0.2, 0.0)], pause=0.2).moved(START)
    twin = Twin(robot, FIRM, ActuatorModel(smooth=True))

    def end(gains):
        return rollout(control_loop(robot, gains), path, twin, START, KEY, 50)[0][-1]

    gains = jnp.asarray([1.5, 1.2, 0.3, 0.4, 0.113])  # between rows of the path
    slope = jax.jit(jax.jacfwd(end))(gains)
    quick = jax.jit(jax.vmap(end))
    step = 1e-5 * jnp.eye(len(gains))
    by_hand = (quick(gains + step) - quick(gains - step)).T / 2e-5
    np.testing.assert_allclose(slope, by_hand, atol=1e-6 + 2e-4 * np.abs(by_hand).max())


@pytest.mark.slow
def test_many_twins_at_once():
    twins = stacked([Twin(deployed(), c, SILENT) for c in (floor([[0]]), floor([[1]]))])
    command = jnp.full(3, 3.0)
    turned = jax.vmap(lambda t: t.step(t.init(START, KEY), command, t.noise(KEY, 1))[0])(twins)
    assert turned.pose.shape[0] == 2
