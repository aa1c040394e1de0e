"""Gains of the controller: designed for the robot's actuators, or set by hand.

Where delay and lag of the wheels are known, gains follow from them by `slipid.robot.loop_design`,
at the phase margins `MARGIN_DEG` and `LATERAL_MARGIN_DEG`. Gains are smaller where the estimate is
so noisy that the command would jitter. Once a filter is in steady state, the corrections of its
estimate have the variance by which its uncertainty grows in the same time, whatever the noise of
the measurements is. So the estimate jumps by p sqrt(v T) from period to period, with p the std of
the model's random errors [m/sqrt(m)] or [rad/sqrt(m)], v the limit of speed [m/s] and T the period
[s]; gains are such that the command jumps by at most `LARGEST_JITTER` of its limit.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.parameter import Entry, as_numbers, entries, parameter
from slipid.robot.deployed import RobotArrays, with_record
from slipid.robot.interface import PERIOD, Scalar
from slipid.robot.limits import Limits
from slipid.robot.loop_design import Actuator, LoopDesign, design

MARGIN_DEG, LATERAL_MARGIN_DEG = 60.0, 50.0
"""Phase margins of designed loops with one error, and of the lateral loop [deg]. The latter has two
integrators, so that a margin of 60 degrees makes it slow: behind a delay of 0.1 s and a lag of
0.22 s at 0.2 m/s, the error across simulated paths is 1.4 to 1.6 times that at 50 degrees."""
LARGEST_JITTER = 0.05
"""Largest std of the command's changes by noise, as a fraction of the command's limit [1]."""


class Gains(eqx.Module):
    """Gains of a controller; the defaults were set by hand."""

    place: Array = parameter("1/s", "k", "pose loop", start=1.5)
    yaw: Array = parameter("1/s", "k_yaw", "heading loop", start=1.5)
    integral: Array = parameter("1/s^2", "k_i", "pose error's integral", start=0.0)
    observer: Array = parameter("1", "k_d", "disturbance observer", start=0.0)
    preview: Array = parameter(
        "s",
        "t_p",
        "time by which reference rates are read ahead on the path, to compensate the wheels' delay",
        start=0.2,
    )
    lateral: Array = parameter(
        "1/m^2", "g", "lateral loop of a robot that cannot drive sideways", start=10.0
    )
    lateral_rate: Array = parameter(
        "1/s",
        "w_g",
        "highest natural frequency of the lateral loop: the faster the robot drives, the more g is "
        "reduced, to w_g^2 / v^2",
        start=1.0,
    )
    damping: Array = parameter("1", "zeta", "damping of the lateral loop", start=0.8)

    def lateral_at(self, speed: Float[Array, ""]) -> Float[Array, ""]:
        """Return the lateral gain at a speed along the path [1/m^2]."""
        return jnp.minimum(self.lateral, self.lateral_rate**2 / (speed**2 + 1e-9))

    @classmethod
    def of(cls, robot: RobotArrays) -> "Gains":
        """Return the gains designed for a robot, or those set by hand if its actuators are unknown.

        Raises:
            ValueError: the robot consists of arrays without a record.
        """
        found = DesignedGains.of(robot)
        return cls() if found is None else found.gains


def used_gains(robot: RobotArrays) -> tuple[Entry, ...]:
    """Return the gains that the controller of a robot uses."""
    unused = ("lateral", "lateral_rate", "damping") if robot.holonomic else ()
    return tuple(e for e in entries(Gains()) if e.path not in unused)


def known_actuator(robot: RobotArrays) -> Actuator | None:
    """Return the response of a robot's wheels; None if its record lacks the delay or the lag.

    Raises:
        ValueError: the robot consists of arrays without a record.
    """
    known = with_record(robot).record.actuators
    if known.delay_s is None or known.lag_s is None:
        return None
    return Actuator(known.delay_s.value, known.lag_s.value, PERIOD)


@dataclass(frozen=True, eq=False)
class DesignedGains:
    """Gains designed for a robot's actuators.

    Attributes:
        actuator: response of the wheels.
        gains: the gains.
        loops: the designed loops: `position` and `heading` of a robot that can drive sideways,
            `along` and `lateral` of any other robot.
    """

    actuator: Actuator
    gains: Gains
    loops: Mapping[str, LoopDesign]

    @classmethod
    def of(cls, robot: RobotArrays) -> "DesignedGains | None":
        """Return the gains designed for a robot; None if its actuators are unknown.

        Raises:
            ValueError: the robot consists of arrays without a record.
        """
        actuator = known_actuator(robot)
        return None if actuator is None else cls.designed(robot, actuator, Limits.of(robot))

    @classmethod
    def designed(cls, robot: RobotArrays, actuator: Actuator, limits: Limits) -> "DesignedGains":
        """Return the gains designed for a robot with given actuators and limits."""
        jumps = np.asarray(robot.process).max(axis=0) * np.sqrt(float(limits.speed) * PERIOD)
        shift, turn = float(jumps[:2].max()), float(jumps[2])
        position = design(actuator, MARGIN_DEG, most=_most(limits.speed, shift))
        most = _most(limits.yaw_rate, turn)
        margin = MARGIN_DEG if robot.holonomic else LATERAL_MARGIN_DEG
        heading = design(actuator, margin, lateral=not robot.holonomic, most=most)
        gains = {"place": position.gains[0], "yaw": heading.gains[-1], "preview": actuator.late_s}
        if robot.holonomic:
            loops = {"position": position, "heading": heading}
        else:
            loops = {"along": position, "lateral": heading}
            # k_yaw alone damps the lateral loop at every speed
            gains |= {"lateral_rate": heading.gains[0] ** 0.5, "damping": 0.0}
        return cls(actuator, Gains(**{n: as_numbers(v) for n, v in gains.items()}), loops)


def _most(limit: Scalar, jump: float) -> float:
    """Return the largest gain [1/s] for a limit of the command and jumps of the estimate."""
    return LARGEST_JITTER * float(limit) / max(jump, 1e-12)
