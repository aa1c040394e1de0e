"""Controllers of every drive: both modes, drives that are off, and robots that steer."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import differential, skid_steer
from slipid.model.kinematics import Steering
from slipid.model.robot import build, steady_states
from slipid.robot.controller import RESPONSE_S, Controller
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Odometry
from slipid.robot.gains import Gains
from slipid.robot.interface import Readings
from slipid.robot.record import ActuatorRecord, Setting
from slipid.robot.supervision import OFF_S, PROBE_S
from slipid.search_space import Choice, Space
from tests.helpers.kinds import FLOORS, SHAPES, numbers
from tests.helpers.known_robot import deploy_known
from tests.helpers.motors_cut import ASKED, CUT, DT, patterns


@pytest.fixture(scope="module", params=list(SHAPES))
def truth(request):
    """The model of a robot with known parameters."""
    robot = build(SHAPES[request.param], list(FLOORS), ("as_built",), ("today",))
    choices = [Choice(path, fixed=value) for path, value in numbers(robot).items()]
    return Space(robot, choices).template


@pytest.fixture(scope="module")
def robot(truth) -> DeployedRobot:
    return deploy_known(truth)


@eqx.filter_jit
def cut(robot, dead):
    """Drive at `ASKED` with wheels that stand while `dead` is true, and else turn as commanded."""
    estimator, controller = Odometry(robot), Controller(robot, Gains(), recovery=True)
    nothing = Readings.nothing(robot.drives)

    def step(carry, stands):
        (e, c), angle = carry
        angle = angle + jnp.where(stands, 0.0, c.command) * DT
        e, estimate = estimator.advance(e, replace(nothing, wheel_angle=angle), jnp.asarray(DT))
        c, command = controller.drive(c, jnp.asarray(ASKED), estimate, DT)
        return ((e, c), angle), (estimate.twist, command, c.drives_off, c.gave_up, c.tried)

    begin = (estimator.init(), controller.init()), jnp.zeros(robot.drives)
    return jax.lax.scan(step, begin, dead)[1]


def test_a_robot_whose_motors_were_cut_drives_on_with_a_ramp(robot):
    dead = patterns() == CUT
    twist, command, off, gave_up, tried = (
        np.asarray(x) for x in jax.vmap(cut, (None, 0))(robot, jnp.asarray(dead))
    )
    radius, limit = float(robot.frame.radius), 1.0
    assert np.hypot(twist[..., 0], twist[..., 1]).max() <= 1.001 * ASKED[0]
    assert np.abs(twist[..., 2]).max() <= 1.001 * ASKED[2]
    assert np.abs(np.diff(command, axis=1)).max() * radius <= limit * DT + 1e-9
    assert not gave_up.any()
    assert (tried == 0).all()
    # off within a second of the cut, with a small speed to probe; on within a second of the release
    late = dead[:5, :-1].copy()
    for row, flags, commands in zip(late, off, command, strict=False):
        cuts = np.flatnonzero(row)
        assert flags[cuts[0] + round((OFF_S + 0.3) / DT) : cuts[-1]].all()
        assert np.abs(commands[cuts[-1]]).max() * radius <= PROBE_S * limit + 1e-9 or len(cuts) < 21
    ended = twist[:4, -20:]
    np.testing.assert_allclose(ended, np.broadcast_to(ASKED, ended.shape), atol=1e-6)
    assert not off[:4, -20:].any()


def test_the_velocity_mode_compensates_slip_on_every_floor(truth, robot):
    """In the steady state of the force balance at the commanded wheel speeds."""
    free = robot.holonomic
    twists = np.array([[0.2, 0, 0], [0.2, 0, 0.3], [-0.2, 0, 0.2], [0, 0, 0.5]])
    if free:
        twists = np.concatenate([twists, [[0.0, 0.2, 0.0], [0.14, -0.14, 0.2]]])
    scale = np.array([1.0, 1.0, float(robot.frame.base)])

    def missed(matrix, floor):
        speed = twists @ np.asarray(matrix).T
        found = steady_states(truth, speed, np.full(len(twists), floor), 0).twist
        off = scale * (found - twists)
        return np.linalg.norm(off if free else off[:, [0, 2]], axis=1)

    rolling = np.asarray(robot.forward) / float(robot.frame.radius)
    for k in range(len(robot.labels)):
        with_slip = missed(robot.inverse_kinematics[k], k)
        without = missed(rolling, k)
        assert with_slip.max() < 0.01
        if without.max() > 0.01:
            assert with_slip.max() < 0.35 * without.max()


def test_no_single_wheel_speeds_up_on_a_floor_that_is_believed_under_it_alone(robot):
    """Its slip comes from the drag at all wheels, so that the others' floors count as much."""
    controller, twist = Controller(robot, Gains()), jnp.asarray(ASKED)
    nothing = replace(Readings.nothing(robot.drives), wheel_angle=jnp.zeros(robot.drives))
    estimator = Odometry(robot)
    _, estimate = estimator.advance(estimator.init(), nothing, jnp.asarray(DT))

    def wheels(soft):
        belief = np.zeros((robot.wheels, 3))
        belief[:, 0], belief[soft] = 1.0, (0.0, 1.0, 0.0)
        believed = replace(estimate, surface_probability=jnp.asarray(belief))
        return np.asarray(controller._wheel_speeds(twist, believed, jnp.zeros((), bool)))

    np.testing.assert_allclose(wheels(0), wheels(robot.wheels - 1), atol=1e-12)
    assert np.abs(wheels(0) - wheels(slice(None))).max() > 1e-3


def test_a_robot_that_cannot_go_sideways_reaches_its_reference(truth):
    """Starts beside, behind and turned away; a reference at rest, ahead, in reverse, turning."""
    robot = deploy_known(truth)
    if robot.holonomic:
        return
    controller = Controller(robot, Gains())

    @eqx.filter_jit
    def end(start, rates):
        def step(carry, k):
            pose, speed, waiting = carry
            heading = rates[1] * k * DT
            far = rates[0] * k * DT
            ref = jnp.stack([far, 0.0, heading, rates[0], 0.0, rates[1]])
            v, _, turn = controller._limited_twist(
                controller._tangent_pose_loop(ref, pose, ref[:2] - pose[:2], jnp.zeros(2))
            )
            waiting = jnp.roll(waiting, 1, axis=0).at[0].set(jnp.stack([v, turn]))
            speed = speed + 0.7 * (waiting[2] - speed)
            middle = pose[2] + 0.5 * speed[1] * DT
            moved = jnp.stack([speed[0] * jnp.cos(middle), speed[0] * jnp.sin(middle), speed[1]])
            return (pose + moved * DT, speed, waiting), ref

        begin = jnp.asarray(start, float), jnp.zeros(2), jnp.zeros((4, 2))
        (pose, _, _), refs = jax.lax.scan(step, begin, jnp.arange(600.0))
        off = pose - refs[-1, :3]
        return off.at[2].set(jnp.arctan2(jnp.sin(off[2]), jnp.cos(off[2])))

    starts = [(0, 0.3, 0), (0, -0.3, 2.5), (0.2, 0.1, -3.0), (-0.3, 0.0, 0.5), (0.1, 0.5, 1.6)]
    for rates in ((0.2, 0.0), (-0.2, 0.0), (0.0, 0.5), (0.0, 0.0)):
        for start in starts:
            x, y, yaw = np.asarray(end(start, jnp.asarray(rates)))
            # a reference at rest is reached to where the robot no longer turns towards it
            most = 0.055 + float(controller._sideways()) if rates[0] == 0 else 0.06
            assert np.hypot(x, y) < most, (rates, start)
            assert abs(yaw) < 0.25, (rates, start)


def test_a_robot_that_turns_about_another_point_than_its_middle_does_not_turn_for_that():
    """A turn moves the middle by up to half the distance between the axles, again and again."""
    skid, pair = (
        Controller(deploy_known(build(shape, ["firm"])), Gains())
        for shape in (skid_steer(0.15, 0.2, 0.1), differential(0.2, 0.1))
    )

    def yaw_rate(controller, y):
        ref, gap = jnp.zeros(6), jnp.array([0.0, -y])
        return float(controller._tangent_pose_loop(ref, jnp.zeros(3), gap, jnp.zeros(2))[2])

    assert [float(c._sideways()) for c in (skid, pair)] == pytest.approx([0.15, 0.0])
    assert [yaw_rate(skid, 0.17), yaw_rate(pair, 0.02)] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert yaw_rate(skid, 0.24) < -1.0
    assert yaw_rate(pair, 0.17) < -1.0


def test_wheels_answer_as_late_as_the_record_says(robot):
    slow = ActuatorRecord(delay_s=Setting(0.2, "config"), lag_s=Setting(0.3, "logs"))
    known = DeployedRobot.of(replace(robot.record, actuators=slow))
    assert float(Controller(known).response) == 0.5
    half = DeployedRobot.of(replace(robot.record, actuators=replace(slow, lag_s=None)))
    assert float(Controller(half).response) == float(Controller(robot).response) == RESPONSE_S


def test_a_robot_that_steers_has_no_controller(robot):
    steering = Steering(*jnp.zeros((5, len(robot.labels))))
    with pytest.raises(ValueError, match=r"steered wheels.* expected omni, mecanum, differential"):
        Controller(replace(robot, steering=steering), Gains())


def test_an_unknown_floor_is_taken_for_the_known_ones(robot):
    controller = Controller(robot, Gains())
    _, nothing = Odometry(robot).step(Odometry(robot).init(), Readings.nothing(robot.drives), DT)
    probability = jnp.zeros((robot.wheels, 3)).at[:].set(jnp.array([0.01, 0.0, 0.99]))
    on_first = replace(nothing, surface_probability=probability)
    asked, no = jnp.asarray(ASKED), jnp.zeros((), bool)
    found = controller._wheel_speeds(asked, on_first, no)
    np.testing.assert_allclose(found, robot.inverse_kinematics[0] @ asked, rtol=1e-9)
    rolling = robot.forward @ asked / robot.frame.radius
    np.testing.assert_allclose(controller._wheel_speeds(asked, nothing, no), rolling, rtol=1e-9)
