"""Feed-forward gains of robots: what each motor moves along an axis, and how well that is known."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import general
from slipid.robot.deployed import DeployedRobot
from slipid.robot.feedforward import robot_feedforwards
from tests.helpers.exported import known
from tests.helpers.kinds import SHAPES
from tests.helpers.known_gains import CORRELATION, STDS, fitted_motors

CHOSEN = {"provenance": "override"}


def by_name(robot):
    return {one.name: one for one in robot_feedforwards(robot)}


def number(robot, path):
    return float(robot.record.parameters[path].value)


@pytest.mark.parametrize("kind", SHAPES)
def test_motors_give_the_power_that_the_body_takes(kind):
    """While one axis accelerates, torques times wheel speeds are the change of kinetic energy."""
    robot = fitted_motors(kind)
    wheel = robot.record.wheels.gear_ratio**2 * number(robot, "motor.rotor_inertia")
    eta = number(robot, "motor.efficiency")
    constant = robot.record.wheels.gear_ratio * eta * number(robot, "motor.back_emf")
    found = by_name(robot)
    sideways = {"linear_y"} if robot.holonomic else set()
    assert set(found) == {"linear", "angular"} | sideways
    inertias = {"linear": (0, "mass"), "linear_y": (1, "mass"), "angular": (2, "yaw_inertia")}
    for name, gains in found.items():
        axis, inertia = inertias[name]
        twist = np.eye(3)[axis]
        speed = np.asarray(robot.forward) @ twist / float(robot.frame.radius)
        torque = gains.kA.value * constant / number(robot, "motor.resistance") * speed
        load = torque - eta * wheel * speed
        assert load @ speed == pytest.approx(number(robot, f"robot.{inertia}"))
        assert gains.kS == found["linear"].kS
        assert gains.kV == found["linear"].kV


def test_each_of_two_sides_has_half_the_mass_and_twice_the_inertia_over_track_squared():
    robot = fitted_motors("skid")
    r, track = 0.1, 0.5
    mass, yaw_inertia = number(robot, "robot.mass"), number(robot, "robot.yaw_inertia")
    rotor = 16**2 * number(robot, "motor.rotor_inertia")
    eta = number(robot, "motor.efficiency")
    per_torque = number(robot, "motor.resistance") / (16 * eta * number(robot, "motor.back_emf"))
    found = by_name(robot)
    linear = per_torque * (eta * rotor + mass * r**2 / 2)
    angular = per_torque * (eta * rotor + 2 * yaw_inertia * r**2 / track**2)
    assert found["linear"].kA.value == pytest.approx(linear)
    assert found["angular"].kA.value == pytest.approx(angular)
    assert found["linear"].per_metre().kA.value == pytest.approx(linear / r)


def test_a_load_accelerates_with_its_own_mass():
    heavy = by_name(fitted_motors("skid", **{"mass_ratio@as_built": {"value": 1.3}}))
    mass = 1.3 * number(fitted_motors("skid"), "robot.mass")
    as_heavy = by_name(fitted_motors("skid", mass={"value": mass}))
    assert heavy["linear"].kA.value == pytest.approx(as_heavy["linear"].kA.value)
    assert heavy["angular"].kA == as_heavy["angular"].kA
    fitted = {"value": 1.3, "std": 0.3, "verdict": "weak", "provenance": "measured"}
    unsure = by_name(fitted_motors("skid", **{"mass_ratio@as_built": fitted}))
    assert heavy["linear"].kA.std < 0.7 * unsure["linear"].kA.std
    assert (heavy["linear"].kA.verdict, unsure["linear"].kA.verdict) == ("identified", "weak")


def test_inertias_that_nobody_knows_are_not_identified():
    found = by_name(fitted_motors("mecanum"))
    assert {g.verdict for g in (found["linear"].kS, found["linear"].kV)} == {"identified"}
    assert found["angular"].kA.verdict == "not_identified"
    # the rotor behind a gear of 16 is a sixth of what a motor moves
    assert found["linear"].kA.verdict == "not_identified"
    rotor = by_name(fitted_motors("mecanum", rotor_inertia=CHOSEN))
    assert rotor["linear"].kA.verdict == "identified"
    assert rotor["angular"].kA.verdict == "not_identified"
    both = by_name(fitted_motors("mecanum", rotor_inertia=CHOSEN, yaw_inertia=CHOSEN))
    assert both["angular"].kA.verdict == "identified"
    assert both["angular"].kA.std < rotor["angular"].kA.std


def test_a_motor_of_which_priors_alone_tell_gives_gains_that_are_not_identified():
    borrowed = {"verdict": "not_identified", "provenance": "borrowed"}
    found = by_name(fitted_motors(resistance=borrowed, back_emf=borrowed))["linear"]
    assert {g.verdict for g in found.gains.values()} == {"not_identified"}


def test_intervals_take_account_of_correlations():
    gains = by_name(fitted_motors(rotor_inertia=CHOSEN))["linear"]
    r, c, tau, _ = STDS.values()
    expected = np.sqrt(r**2 + c**2 + tau**2 + 2 * CORRELATION * r * tau)
    assert gains.kS.std / gains.kS.value == pytest.approx(expected, rel=0.02)
    alone = by_name(fitted_motors(draws=2, rotor_inertia=CHOSEN))["linear"]
    assert alone.kS.std / alone.kS.value == pytest.approx(np.sqrt(r**2 + c**2 + tau**2))


def test_a_robot_without_a_fitted_motor_has_no_gains():
    robot = fitted_motors()
    given = DeployedRobot.of(replace(robot.record, source="given"))
    unknown = fitted_motors(resistance={"std": 2.0})
    default = fitted_motors(back_emf={"verdict": "fixed", "provenance": "borrowed", "std": None})
    assert robot_feedforwards(given) == robot_feedforwards(unknown) == ()
    assert robot_feedforwards(default) == ()


def test_axes_that_influence_each_other_have_the_gains_of_a_wheel_alone():
    """Three wheels on one side of the body: pushing it ahead turns it."""
    places = np.array([[0.1, 0.2], [-0.1, 0.2], [0.0, 0.3]])
    shape = general(places, [0.0, 60.0, -60.0], [90.0] * 3, 0.05, 16.0)
    robot = known(shape)
    fitted = DeployedRobot.of(replace(robot.record, source="laplace"))
    (found,) = robot_feedforwards(fitted)
    assert found.name == "wheel"
    rotor = number(robot, "motor.rotor_inertia")
    r_over_c = number(robot, "motor.resistance") / number(robot, "motor.back_emf")
    assert found.kA.value == pytest.approx(r_over_c * 16 * rotor)
    assert jnp.isfinite(found.kS.value)
