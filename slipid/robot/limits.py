"""Limits of the commands that a controller gives to a robot."""

from dataclasses import fields

import equinox as eqx

from slipid.robot.deployed import RobotArrays, with_record
from slipid.robot.interface import Scalar


class Limits(eqx.Module):
    """Limits of commands.

    Attributes:
        speed: largest translational speed that is demanded of the body [m/s].
        yaw_rate: largest yaw rate that is demanded of the body [rad/s].
        acceleration: largest acceleration of the rim of a wheel [m/s^2].
        wheel_speed: largest speed of a wheel [rad/s].
        voltage: voltage of the supply [V].
    """

    speed: Scalar = 0.5
    yaw_rate: Scalar = 2.0
    acceleration: Scalar = 1.0
    wheel_speed: Scalar = 13.0
    voltage: Scalar = 22.0

    @classmethod
    def of(cls, robot: RobotArrays) -> "Limits":
        """Return the limits in a robot's record.

        Raises:
            ValueError: the robot consists of arrays without a record.
        """
        limits = with_record(robot).record.limits
        return cls(**{f.name: getattr(limits, f.name).value for f in fields(cls)})
