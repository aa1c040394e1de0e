"""The Husky of the public logs as its maker has it, and how its motors and ammeters behave.

Without a pose nothing tells what a motor's torque is; frictions of floors are then in units of the
assumed torque constant, and only their ratios mean something.
"""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

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


def in_the_air(root: Path) -> tuple[float, float, float]:
    """`ZERO_A`, `FREE_A` and `FREE_AS` by runs of a Husky with its wheels in the air.

    Rows count in which a wheel keeps its speed.
    """
    speed, amps = [], []
    for path in sorted(root.glob("*.csv")):
        rows = np.genfromtxt(path, delimiter=",", names=True)
        for side in "lr":
            w, i = rows[f"w{side}"], rows[f"i{side}"]
            steady = np.isfinite(w) & np.isfinite(i)
            steady &= np.abs(np.gradient(np.nan_to_num(w))) < 0.05
            speed.append(np.abs(w[steady]))
            amps.append(i[steady])
    w, i = np.concatenate(speed), np.concatenate(amps)
    zero = float(np.median(i[w < 0.02]))
    moving = w > 0.5
    # above three amperes a wheel is no longer free
    slope, level = np.polyfit(w[moving], np.minimum(i[moving] - zero, 3.0), 1)
    return zero, float(level), float(slope)
