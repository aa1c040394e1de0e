"""Gains of the controller."""

from dataclasses import fields

import equinox as eqx
from jaxtyping import Array

from slipid.parameter import as_numbers, parameter
from slipid.robot.deployed import RobotArrays, with_record


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
    damping: Array = parameter("1", "zeta", "damping of the lateral loop", start=0.8)

    @classmethod
    def of(cls, robot: RobotArrays, forced: bool = False) -> "Gains":
        """Return a robot's tuned gains, or the gains set by hand.

        Tuned gains are returned if they are better than the gains set by hand, or if `forced` is
        True. Without tuned gains for the robot's load set-up, the gains set by hand are returned.

        Raises:
            ValueError: the robot consists of arrays without a record.
        """
        known = with_record(robot)
        tuned = known.record.gains
        if tuned is None or tuned.load != known.load_setup:
            return cls()
        if not (tuned.is_better or forced):
            return cls()
        kept = {f.name for f in fields(cls)} & {f.name for f in fields(tuned.values)}
        return cls(**{name: as_numbers(getattr(tuned.values, name).value) for name in kept})
