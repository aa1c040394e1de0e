"""Sentences on the origin of a controller's gains and limits."""

from collections.abc import Mapping

from slipid.control.deployed import DeployedRobot
from slipid.control.export.text import one_line

LIMITS: Mapping[str, tuple[str, str]] = {
    "wheel_speed": ("rad/s", "largest speed of a wheel"),
    "acceleration": ("rad/s^2", "largest change of a wheel's speed"),
    "voltage": ("V", "of the supply"),
    "twist": ("m/s", "largest speed asked of the body"),
}
"""Unit and meaning of every field of `slipid.control.controller.Limits`."""


def origin(robot: DeployedRobot) -> str:
    """Where the gains of a robot come from, and that limits were not identified, as sentences."""
    limits = "Limits are the defaults of slipid: put in those of your motors and supply."
    tuned = robot.record.gains
    if tuned is None:
        return f"Gains set by hand. {limits}"
    if tuned.load != robot.load_setup:
        load = one_line(tuned.load)
        return f"Gains set by hand; those tuned are for the load set-up {load}. {limits}"
    if not tuned.is_better:
        return f"Gains set by hand; those tuned are {tuned.verdict}. {limits}"
    loss = f"loss {tuned.loss.tuned:.1f} mm, by hand {tuned.loss.hand:.1f} mm"
    gyro = "with a gyro" if tuned.gyro else "without a gyro"
    return f"Gains tuned on the twin {gyro}: better than by hand in rehearsals ({loss}). {limits}"
