"""Gains designed from delay and lag of a robot's wheels, for every kind of drive."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.deploy.deploy import actuator_model_of
from slipid.exports.description import gains_sentence
from slipid.model.robot import build
from slipid.robot.closed_loop import ControlLoop, path_metrics, run_closed_loop
from slipid.robot.controller import Controller
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Odometry
from slipid.robot.gains import (
    LARGEST_JITTER,
    LATERAL_MARGIN_DEG,
    MARGIN_DEG,
    DesignedGains,
    Gains,
    used_gains,
)
from slipid.robot.interface import PERIOD
from slipid.robot.limits import Limits
from slipid.robot.loop_design import Actuator, SampledPlant
from slipid.robot.record import ActuatorRecord, Setting
from slipid.robot.trajectory import rectangle
from slipid.robot.twin import LONGEST_DELAY_S
from tests.helpers.kinds import FLOORS, SHAPES
from tests.helpers.known_robot import deploy_known
from tests.helpers.unicycle import Unicycle

SLOW, QUICK = Actuator(0.1, 0.22, PERIOD), Actuator(0.1, 0.0, PERIOD)


def known(
    kind: str, actuator: Actuator | None = SLOW, process: float = 0.0, floors: tuple[str, ...] = ()
) -> DeployedRobot:
    """Return a robot of some kind whose record has its actuators.

    Process noise is that of the given floors, of all if there are none; it is zero elsewhere.
    """
    noisy = floors or FLOORS
    std = {
        f"process.{f}.{axis}": process * (f in noisy)
        for f in FLOORS
        for axis in ("along", "across", "yaw")
    }
    robot = deploy_known(build(SHAPES[kind], list(FLOORS)), std=std)
    if actuator is None:
        return robot
    response = ActuatorRecord(Setting(actuator.delay_s, "logs"), Setting(actuator.lag_s, "config"))
    return DeployedRobot.of(replace(robot.record, actuators=response))


def numbers(gains: Gains) -> dict[str, float]:
    return {name: float(value) for name, value in vars(gains).items()}


def test_gains_are_set_by_hand_until_delay_and_lag_are_known():
    robot = known("omni 4", None)
    assert DesignedGains.of(robot) is None
    assert numbers(Gains.of(robot)) == numbers(Gains())
    half = replace(robot.record, actuators=ActuatorRecord(Setting(0.1)))
    assert numbers(Gains.of(DeployedRobot.of(half))) == numbers(Gains())
    assert "set by hand, since delay and lag of the wheels are unknown" in gains_sentence(robot)


@pytest.mark.parametrize("kind", ["omni 4", "differential"])
def test_every_loop_has_its_stated_margin(kind):
    robot = known(kind)
    found, gains = DesignedGains.of(robot), numbers(Gains.of(robot))
    one, two = SampledPlant.of(SLOW, 1), SampledPlant.of(SLOW, 2)
    assert one.crossover(np.array([gains["place"]]))[0] == pytest.approx(MARGIN_DEG, abs=0.01)
    assert gains["preview"] == pytest.approx(0.1 + 0.22 + 0.025)
    if robot.holonomic:
        assert list(found.loops) == ["position", "heading"]
        assert gains["yaw"] == pytest.approx(gains["place"])
        return
    assert list(found.loops) == ["along", "lateral"]
    margins = []
    for speed in (0.02, 0.1, 0.3, 1.0, 5.0):
        lateral = float(Gains.of(robot).lateral_at(jnp.asarray(speed))) * speed**2
        margins.append(two.crossover(np.array([lateral, gains["yaw"]]))[0])
    assert min(margins) == pytest.approx(LATERAL_MARGIN_DEG, abs=0.01)
    assert margins[0] > 60


def test_slow_wheels_make_slow_loops():
    slow, quick = numbers(Gains.of(known("omni 4"))), numbers(Gains.of(known("omni 4", QUICK)))
    assert quick["place"] > 2 * slow["place"]
    assert quick["preview"] < slow["preview"]


def test_gains_of_a_noisy_estimate_are_smaller():
    robot = known("differential", QUICK, process=0.2)
    found, limits, quiet = (
        DesignedGains.of(robot),
        Limits.of(robot),
        Gains.of(known("differential", QUICK)),
    )
    jump = 0.2 * (float(limits.speed) * PERIOD) ** 0.5
    gains = numbers(found.gains)
    assert gains["place"] * jump == pytest.approx(LARGEST_JITTER * limits.speed, rel=1e-5)
    assert gains["yaw"] * jump == pytest.approx(LARGEST_JITTER * limits.yaw_rate, rel=1e-5)
    assert gains["place"] < numbers(quiet)["place"]
    assert all(loop.margin_deg > LATERAL_MARGIN_DEG for loop in found.loops.values())


@pytest.mark.parametrize("floor", FLOORS)
def test_gains_suit_the_noisiest_floor(floor):
    loops = (DesignedGains.of(known("omni 4", QUICK, 0.2, floors)) for floors in ((floor,), ()))
    one, every = (numbers(found.gains) for found in loops)
    assert one == every


def test_exports_say_margin_and_bandwidth_and_only_gains_that_are_used():
    said = gains_sentence(known("differential"))
    assert "delay of 0.1 s and a lag of 0.22 s" in said
    assert "along loop with a phase margin of 60 deg and a bandwidth of 0.25 Hz" in said
    assert "lateral loop with a phase margin of 50 deg" in said
    lateral = {"lateral", "lateral_rate", "damping"}
    assert not lateral & {e.path for e in used_gains(known("omni 4"))}
    assert lateral < {e.path for e in used_gains(known("differential"))}


def test_the_twin_answers_like_the_robot():
    model = actuator_model_of(known("omni 4"), gyro=False)
    assert (model.delay_s, model.lag_s) == (0.1, 0.22)
    late = actuator_model_of(known("omni 4", Actuator(0.5, 0.1, PERIOD)), gyro=False)
    assert late.delay_s == LONGEST_DELAY_S


def test_a_design_tracks_as_well_as_gains_by_hand():
    """Both close the rectangle of a robot without slip that starts beside its path."""
    robot, start = known("omni 4"), (0.0, 0.0, 0.0)
    errors = []
    for gains in (Gains(), Gains.of(robot)):
        plant = Unicycle(robot, start, delay_s=SLOW.delay_s, lag_s=SLOW.lag_s)
        loop = ControlLoop(Odometry(robot), Controller(robot, gains))
        errors.append(path_metrics(run_closed_loop(loop, rectangle(), plant, start)))
    by_hand, designed = errors
    assert designed.finished
    assert designed.closure_mm < by_hand.closure_mm + 1.0
    assert designed.cross_track_rmse_mm < by_hand.cross_track_rmse_mm + 0.5
