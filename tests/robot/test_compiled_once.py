"""Compiled code depends on a robot's structure, and on none of its numbers."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.robot.closed_loop import ControlLoop, run_closed_loop
from slipid.robot.controller import Controller
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator, Odometry
from slipid.robot.gains import Gains
from slipid.robot.interface import Measurement, Settings
from slipid.robot.limits import Limits
from slipid.robot.record import ActuatorRecord, Setting
from slipid.robot.trajectory import waypoints
from slipid.robot.twin import Twin, TwinPlant
from tests.helpers import small_twin
from tests.helpers.compilations import compilations
from tests.helpers.known_robot import deploy_known

REFERENCE = jnp.array([0.3, 0.1, 0.2, 0.2, 0.0, 0.1])
PATH = waypoints([(0.0, 0.0), (0.1, 0.0)])
ONE = Settings()
OTHER = Settings(
    forget_s=0.3,
    filter_s=0.04,
    patch_m=0.2,
    doubt_m=1.0,
    further_floor_penalty=1.0,
    unknown_std=4.0,
    ammeter_std_a=0.05,
    voltmeter_std_v=0.05,
    gyro_std=0.006,
    gyro_bias_std=0.02,
    gyro_delay_s=0.05,
    wheel_acceleration=80.0,
    supply_voltage=50.0,
    still_m_s=0.004,
    stale_s=0.4,
    longest_s=0.4,
)


def robot(load: str = "as_built", scale: float = 1.0) -> DeployedRobot:
    """A robot of three wheels on two floors, its numbers and its record scaled."""
    shape = omni([60.0, 180.0 + 5 * (scale - 1), 300.0], 0.125 * scale, 0.04 * scale, 16.0 * scale)
    made = build(shape, ["firm", "soft"], loads=[load])
    surfaces = replace(made.surfaces, creep=scale * made.surfaces.creep)
    std = {"process.firm.along": 0.004 * scale, "run.firm.along": 0.01 * scale}
    plain = deploy_known(
        replace(made, surfaces=surfaces),
        std=std,
        highest_speed=8.0 * scale,
        current_trend=(0.0, 0.1),
    )
    late = ActuatorRecord(Setting(0.1 * scale, "logs"), Setting(0.03, "logs"))
    return DeployedRobot.of(replace(plain.record, actuators=late, alike=3.0 / scale))


@pytest.fixture(scope="module")
def robots() -> tuple[DeployedRobot, DeployedRobot]:
    """Two robots of one structure that have no number in common."""
    one, two = robot(), robot("moved", 1.25)
    assert one.record != two.record
    assert one.load_setup != two.load_setup
    assert not np.isclose(float(one.motor.gear_ratio), float(two.motor.gear_ratio))
    return one, two


def reading(k: int) -> Measurement:
    """Some of all sensors."""
    return Measurement(
        wheel_angle=0.1 * k * jnp.array([1.0, -1.0, 0.5]),
        current=jnp.array([0.3, 0.2, 0.1]),
        voltage=jnp.array([2.0, -2.0, 1.0]),
        gyro=0.1,
        fix=jnp.array([0.1, 0.0, 0.0]),
        fix_std=jnp.array([0.01, 0.01]),
        fix_age=0.05,
    )


def steps(estimator: Estimator | Odometry, count: int = 3) -> list[jax.Array]:
    """Numbers of the estimates of some steps."""
    state, said = estimator.init((0.0, 0.0, 0.0)), []
    for k in range(count):
        state, estimate = estimator.step(state, reading(k), 0.02)
        said.append(np.concatenate([estimate.pose, estimate.current, estimate.slip]))
    return said


@eqx.filter_jit
def run(estimator: Estimator, angle: jax.Array) -> jax.Array:
    """Poses of a log of wheel angles."""

    def step(state, row):
        state, said = estimator.step(state, Measurement(wheel_angle=row), 0.02)
        return state, said.pose

    return jax.lax.scan(step, estimator.init((0.0, 0.0, 0.0)), angle)[1]


commanded = eqx.filter_jit(Controller.step)


def test_the_count_sees_what_is_compiled():
    with compilations() as found:
        jax.jit(lambda x: 2.0 * x)(jnp.ones(7))
    assert any(event.startswith("backend_compile") for event in found), found
    assert any(event.startswith("jaxpr_trace") for event in found), found


@pytest.mark.parametrize("kind", [Estimator, Odometry])
def test_another_robot_and_other_settings_step_without_compiling(robots, kind):
    one, two = robots
    before = steps(kind(one, ONE))
    steps(kind(one))
    with compilations() as found:
        after = [steps(kind(two)), steps(kind(two, ONE)), steps(kind(two, OTHER))]
        steps(kind(one, OTHER))
    assert found == []
    assert not any(np.allclose(before[-1], said[-1]) for said in after)
    if kind is Estimator:  # odometry from wheel angles alone has no use for these settings
        assert not np.allclose(after[1][-1], after[2][-1])


def test_another_robot_and_other_settings_run_a_log_without_compiling(robots):
    one, two = robots
    angle = jnp.cumsum(jnp.full((6, 3), 0.1) * jnp.array([1.0, -1.0, 0.5]), axis=0)
    before = run(Estimator(one), angle)
    with compilations() as found:
        after = [run(Estimator(two), angle), run(Estimator(two, OTHER), angle)]
    assert found == []
    assert not any(np.allclose(before, pose) for pose in after)


def test_another_robot_other_gains_and_limits_are_controlled_without_compiling(robots):
    one, two = robots
    estimator = Estimator(one)
    estimate = estimator.step(estimator.init((0.0, 0.0, 0.0)), reading(0), 0.02)[1]

    def step(controller: Controller) -> np.ndarray:
        return np.asarray(commanded(controller, controller.init(), REFERENCE, estimate, 0.05)[1])

    before = step(Controller(one, Gains()))
    gains = Gains(2.0, 1.0, 0.1, 0.2, 0.1)
    with compilations() as found:
        after = [
            step(Controller(two)),
            step(Controller(one, gains)),
            step(Controller(one, Gains(), Limits(0.1, 2.0, 0.12, 2.0, 4.0))),
        ]
    assert found == []
    assert not any(np.allclose(before, other) for other in after)


def test_another_robot_runs_a_closed_loop_without_compiling(robots):
    one, two = robots
    floor = small_twin.floor([[0, 1], [1, 0]])

    def course(robot: DeployedRobot, settings: Settings, limits: Limits) -> np.ndarray:
        control_loop = ControlLoop(Estimator(robot, settings), Controller(robot, Gains(), limits))
        plant = TwinPlant(Twin(robot, floor), (0.0, 0.0, 0.0), jax.random.key(0))
        return run_closed_loop(control_loop, PATH, plant, (0.0, 0.0, 0.0)).command

    before = course(one, ONE, Limits())
    with compilations() as found:
        after = [course(two, ONE, Limits()), course(one, OTHER, Limits(0.15, 2.0, 0.4, 6.0, 20.0))]
    assert found == []
    assert not any(np.allclose(before[:9], other[:9]) for other in after)


def test_loading_another_robot_compiles_nothing(robots, tmp_path):
    one, two = robots
    one.save(tmp_path / "one.json")
    two.save(tmp_path / "two.json")
    steps(Estimator(DeployedRobot.load(tmp_path / "one.json")))
    with compilations() as found:
        again = DeployedRobot.load(tmp_path / "two.json")
        steps(Estimator(again))
    assert found == []
    assert again.record == two.record


def test_arrays_alone_have_no_settings_and_no_gains(robots):
    for made in (Estimator, Odometry, Controller):
        with pytest.raises(ValueError, match="this robot has arrays but no record"):
            made(robots[0].arrays)
    assert steps(Estimator(robots[0].arrays, ONE))[0] == pytest.approx(
        steps(Estimator(robots[0], ONE))[0], abs=0.0
    )
    assert Controller(robots[0].arrays, Gains(), Limits()).init().command.shape == (3,)
