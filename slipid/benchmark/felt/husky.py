"""The Husky of the public logs as its maker has it, and how its motors and ammeters behave.

Without a pose nothing tells what a motor's torque is; frictions of floors are then in units of the
assumed torque constant, and only their ratios mean something.
"""

from dataclasses import replace

import jax.numpy as jnp

from slipid.model.geometry import skid_steer
from slipid.model.robot import Robot, build

RADIUS = 0.165
"""Of the wheels [m]."""
MASS = 60.0
"""[kg]"""
ZERO_A = 0.59
"""What the ammeters show of wheels that stand [A]; of wheels that brake they show nothing."""
FREE_A, FREE_AS = 0.54, 0.032
"""Friction of a wheel in the air, and its growth with the wheel's speed [A], [A s/rad]."""


def husky() -> Robot:
    """The robot, on no floor yet."""
    robot = build(skid_steer(0.256, 0.275, RADIUS, 78.71, drive_of=(0, 1, 0, 1)), ())
    gain = float(robot.motor.gain)
    motor = replace(
        robot.motor,
        coulomb_friction=jnp.asarray(gain * FREE_A),
        viscous_friction=jnp.asarray(gain * FREE_AS),
    )
    return replace(robot, motor=motor, body=replace(robot.body, mass=jnp.asarray(MASS)))
