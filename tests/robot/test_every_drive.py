"""Estimators of robots that share drives or do not drive sideways."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.deploy.robot_record import moved_per_metre, spread_of
from slipid.lab.selftest.logs import SimulatedSensors, simulate_logs
from slipid.model.robot import build
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator, Odometry
from slipid.robot.interface import Readings, Settings
from slipid.search_space import Choice, Space
from tests.helpers.kinds import FLOORS, SHAPES, numbers, plan
from tests.helpers.known_robot import deploy_known

STILL = SimulatedSensors(
    std={}, ripple=0.0, current_step=1e-6, voltage_noise=0.0, voltage_step=1e-6, signed=True
)
"""Sensors without noise, of a robot that does what its model says."""


@pytest.fixture(scope="module", params=["skid", "differential"])
def driven(request):
    """A robot, and runs of it that turn, on either floor."""
    shape = SHAPES[request.param]
    drives = [d for d in plan(shape, 4) if d.command[2] != 0][::3]
    robot = build(shape, list(FLOORS), ("as_built",), sorted({d.session for d in drives}))
    choices = [Choice(path, fixed=value) for path, value in numbers(robot).items()]
    fixed = [*choices, Choice("camera.lag", fixed=0.0), Choice("camera.marker_place", fixed=[0, 0])]
    truth = Space(robot, fixed).template
    return deploy_known(truth, highest_speed=40.0), simulate_logs(truth, drives, 0, STILL)


ROWS = 512
"""To which logs are filled up with steps in which no time passes, so that all compile once."""


def followed(estimator, log):
    """Pose where the estimator ends, from where the log starts, and its beliefs in the end."""
    assert log.samples <= ROWS
    nothing = Readings.nothing(estimator.robot.drives)
    filled = jnp.minimum(jnp.arange(ROWS), log.samples - 1)
    z = replace(
        jax.tree.map(lambda x: jnp.broadcast_to(x, (ROWS, *x.shape)), nothing),
        wheel_angle=jnp.asarray(log.wheel_angle)[filled],
        current=jnp.asarray(log.current)[filled],
    )
    dt = jnp.concatenate([jnp.zeros(1), jnp.diff(jnp.asarray(log.time)[filled])])
    pose, floors = ran(estimator, estimator.init(tuple(log.pose[0])), z, dt)
    return np.asarray(pose), np.asarray(floors)


@eqx.filter_jit
def ran(estimator, state, z, dt):
    def step(state, row):
        state, estimate = estimator.advance(state, *row)
        return state, (estimate.pose, estimate.surface_probability)

    _, (pose, floors) = jax.lax.scan(step, state, (z, dt))
    return pose[-1], floors[-1]


def gap(found, log):
    far = np.abs(np.diff(log.wheel_angle, axis=0)).sum() / log.wheel_angle.shape[1]
    return float(np.hypot(*(found - log.pose[-1])[:2])), far


@pytest.mark.slow
def test_the_estimator_ends_nearer_than_encoders(driven):
    robot, logs = driven
    radius = float(robot.frame.radius)
    signed = replace(Settings.of(robot), current_is_signed=True)
    ours, encoders = [], []
    for log in logs:
        # two wheels and casters drag nothing along, so that their currents tell no floor
        known = robot if robot.wheels > 2 else robot.on(log.surface)
        contact = Estimator(known, signed)
        for estimator, errors in ((contact, ours), (Odometry(robot), encoders)):
            end, floors = followed(estimator, log)
            off, far = gap(end, log)
            errors.append(off / (radius * far))
            if estimator is contact:
                k = known.labels.index(log.surface)
                assert (floors.argmax(axis=1) == k).mean() > 0.5, (log.name, floors)
    slips = robot.wheels > 2  # what drags nothing along hardly slips
    assert slips == (np.mean(encoders) > 0.01)
    assert np.mean(ours) < (0.25 * np.mean(encoders) if slips else 1e-4), (ours, encoders)


@pytest.mark.slow
def test_a_robot_that_creeps_while_it_rests_still_finds_the_bias_of_its_gyro(driven):
    """As a controller makes it that follows the drift of the heading."""
    robot, _ = driven
    estimator, rows, bias, turn = Estimator(robot), 60, 0.004, 0.003
    speed = jnp.asarray(robot.forward[:, 2] * turn / robot.frame.radius)
    angle, zero = 0.05 * jnp.arange(rows)[:, None] * speed, jnp.zeros((rows, robot.drives))
    nothing = Readings.nothing(robot.drives)
    z = jax.tree.map(lambda x: jnp.broadcast_to(x, (rows, *x.shape)), nothing)
    gyro = jnp.full(rows, bias + turn)
    z = replace(z, wheel_angle=angle, current=zero, gyro=gyro)

    def step(state, row):
        return estimator.advance(state, row, jnp.asarray(0.05))[0], None

    state, _ = jax.jit(lambda s, z: jax.lax.scan(step, s, z))(estimator.init(), z)
    assert float(state.place.still) > 1.0
    assert float(state.place.nuisance[-1]) == pytest.approx(bias, abs=0.4 * turn)


@pytest.mark.slow
def test_wheels_of_a_drive_with_one_speed_move_the_body_as_declared(driven):
    robot, _ = driven
    rim = jnp.arange(1.0, robot.drives + 1)
    np.testing.assert_allclose(robot.by_wheels @ robot.at_wheels(rim), robot.inverse @ rim)


@pytest.mark.slow
def test_what_is_unsure_of_turns_on_the_spot_counts_in_full():
    """Two draws that differ in scrub: turns of a skid-steer robot differ, its straights do not."""
    robot = build(SHAPES["skid"], ["floor"])
    both = [replace(robot.surfaces, scrub=jnp.asarray([cz])) for cz in (0.002, 0.1)]
    draws = jax.tree.map(lambda *x: jnp.stack(x), *(replace(robot, surfaces=s) for s in both))
    turn = jnp.array([[0.0, 0.0, 1.0 / float(robot.geometry.base_radius)]])
    moved = moved_per_metre(draws, jnp.asarray(0), jnp.asarray(0.2), turn)
    ((_, _, yaw),) = deploy_known(robot, draws=draws).record.loads[0].spread
    assert yaw == pytest.approx(float(spread_of(np.asarray(moved))[0, 0, 2]), rel=1e-6)
    assert yaw > 0.01


@pytest.mark.slow
def test_the_robot_survives_its_file(driven, tmp_path):
    robot, _ = driven
    robot.save(tmp_path / "robot.json")
    again = DeployedRobot.load(tmp_path / "robot.json")
    assert again.drives == robot.drives == len(robot.forward)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(robot), strict=True):
        np.testing.assert_array_equal(a, b)
