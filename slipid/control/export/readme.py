"""README of an exported folder."""

from collections.abc import Mapping, Sequence

from slipid.control.deployed import DeployedRobot
from slipid.control.export.header import in_markdown

ABOUT: Mapping[str, str] = {
    "c": "estimator and controller in C99, with a test of themselves and an example; also a "
    "library for PlatformIO and the Arduino IDE",
    "ros2": "parameters for drive controllers of ros2_controllers, for robot_localization, and of "
    "a node of your own with their declaration",
    "stablehlo": "the same step for programs in JAX: `jax.export.deserialize`, or "
    "`slipid.control.export.stablehlo.load_program`, which compares it first",
    "table": "gains, limits and matrices for a person who types them in",
}


def readme(robot: DeployedRobot, forms: Sequence[str], controller: str) -> str:
    """Text of README.md."""
    lines = [
        "# One identified robot, ready to be taken along",
        "",
        *in_markdown(robot),
        f"Everything here is made of `robot.json`, for the controller `{controller}`.",
        "",
        *(f"- `{form}/`: {ABOUT[form]}." for form in forms),
        "",
        "`sha256sum -c SHA256SUMS` tells whether a byte was changed; with slipid, "
        "`slipid export --check` and this folder.",
    ]
    return "\n".join(lines) + "\n"
