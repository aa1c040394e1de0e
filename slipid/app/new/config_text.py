"""Text of a new config, with every key explained; it is read back before it is written."""

from dataclasses import dataclass
from pathlib import Path

from slipid.app.config import LimitsSection, LogsSection, OmniDrive, Wheels, geometry, parsed
from slipid.app.new.config_lines import ConfigBlock, ConfigLine, drawing, toml
from slipid.app.new.draft import ConfigDraft, LogsDraft
from slipid.app.new.from_reference import prior_text, remark, start_lines
from slipid.app.new.robot_questions import robot_of
from slipid.app.reference.keys import in_short

_ORDER = {
    "omni": "each wheel drives 90 deg counter-clockwise of its azimuth",
    "mecanum": "wheels: front left, front right, rear left, rear right",
    "skid": "wheels: front left, front right, rear left, rear right",
    "differential": "wheels: left, right",
    "steered": "bicycle, tricycle or car; x counts from the rear axle",
    "general": "any wheels",
}
_ANSWER_OF_KEY = {
    "wheel_azimuths_deg": "azimuths_deg",
    "half_length_m": "wheelbase_m",
    "half_width_m": "track_m",
    "wheel_places_m": "places_m",
    "drive_directions_deg": "directions_deg",
    "roller_angles_deg": "rollers_deg",
    "drives": "shared",
}
"""Name of the answer (in `RobotAnswers`) for a key of `[robot]`, where the names differ."""
_ASK_MEASURED = "default value: measure it, or look it up"
_ASK_PLACES = "default value: where do the wheels stand, in the order of the columns?"
_QUESTIONS = {
    "drive": "which drive is it: omni, mecanum, skid, differential, steered or general?",
    "wheel_azimuths_deg": _ASK_PLACES,
    "wheel_places_m": _ASK_PLACES,
    "drive_directions_deg": "default value: which way does each wheel roll?",
    "roller_angles_deg": "default value: do the wheels have rollers, and how are they tilted?",
    "gear_ratio": "default value: is there a gear, and are speeds and ticks those of the motor?",
    "mass_kg": "default value: weigh the robot",
    "wheel_radius_m": _ASK_MEASURED,
    "driven": "default value: which axle's wheels have the encoders?",
    "encoders": "default value: has the driven axle one encoder or two?",
}
_EXAMPLE_LIMITS = {
    "speed_m_s": 0.5,
    "yaw_rate_rad_s": 1.0,
    "acceleration_m_s2": 0.5,
    "wheel_speed_rad_s": 10.0,
    "voltage_v": 24.0,
}
"""Values in comments about limits that are not given."""
_DATASHEET = (
    "no motor voltages are logged, so this parameter and the next keep these values: what are they "
    "in the datasheet?"
)
FRAME = "x ahead, y left, angles counter-clockwise from ahead; wheels in the order of the columns"
_FIT = ConfigBlock(
    "",
    above=(
        'Which lengths are known? "poses" of motion capture, lidar or RTK, which make the wheel '
        'radius free; or "wheels" that were measured, which make the scale of the camera free:',
        "[fit]",
        'lengths_from = "poses"',
    ),
)
"""Table `[fit]` as a comment, which asks whether poses are in true metres, since no log shows this.
"""


def _head(draft: ConfigDraft, name: str) -> tuple[str, ...]:
    return (
        *draft.above,
        f"  slipid check {name} --data {draft.data}",
        f"  slipid identify {name} --data {draft.data} --out OUT",
        "Every number is SI or has its unit in the name of its key. `slipid reference` explains "
        'all keys, channels, units and parameters. A line that begins with "# ?" is to be '
        "answered, and then removed.",
    )


def _robot_block(draft: ConfigDraft, robot: Wheels, picture: str) -> ConfigBlock:
    """Return the table `[robot]`, with the drawing above it."""
    given = robot.model_dump(exclude_none=True, exclude={"limits", "sensors", "actuators"})
    if isinstance(robot, OmniDrive) and robot.roller_angle_deg == 90.0:
        del given["roller_angle_deg"]  # the default: ordinary omni wheels need no line for it
    # The keys of the type of drive come first; the keys that all robots have come after them.
    common = ("wheel_radius_m", "gear_ratio", "mass_kg")
    own = (key for key in given if key not in ("drive", *common))
    lines = []
    for key in ("drive", *own, *common):
        comment = _ORDER[robot.drive] if key == "drive" else in_short(type(robot), key)
        lines.append(ConfigLine(key, toml(given[key]), comment, _open_question(draft, key)))
    above = (remark(draft.robot.robot), "") if draft.robot.robot else ()
    return ConfigBlock("[robot]", tuple(lines), above=(*above, *picture.splitlines(), "", FRAME))


def _limits_block(robot: Wheels) -> ConfigBlock:
    """Return the table `[robot.limits]`; limits that the logs are to show are comments."""
    lines = []
    for key, value in robot.limits:
        lines.append(
            ConfigLine(
                key,
                toml(_EXAMPLE_LIMITS[key] if value is None else value),
                in_short(LimitsSection, key),
                commented_out=value is None,
            )
        )
    given = not all(line.commented_out for line in lines)
    above = (
        "Limits of a controller. Those without a value are the highest ones in the logs, which "
        "`slipid check` prints, with the noise of the sensors for [robot.sensors].",
    )
    return ConfigBlock("[robot.limits]" if given else "# [robot.limits]", tuple(lines), above)


def _open_question(draft: ConfigDraft, key: str) -> str:
    """Return the question about a key of `[robot]` with a default; empty if it was answered."""
    if _ANSWER_OF_KEY.get(key, key) not in draft.robot.defaults or key == "drives":
        return ""
    return draft.hints.get(key) or _QUESTIONS.get(key, _ASK_MEASURED)


def _logs_block(logs: LogsDraft, first: bool) -> ConfigBlock:
    """Return the table of a section of logs; the keys are explained only in the first section."""
    values = {"glob": logs.glob, "format": logs.format, "surface": logs.surface}
    values |= {"load": "as_built"} | ({"session": logs.session} if logs.session else {})
    lines = []
    for key, value in values.items():
        comment = in_short(LogsSection, key) if first else ""
        if key == "surface" and first:
            comment += '; "folder": the folder\'s name'
        question = logs.question if key == "surface" else ""
        lines.append(ConfigLine(key, toml(value), comment, question, logs.commented_out))
    if first:
        example = toml("maps/site.toml")
        lines.append(ConfigLine("map", example, in_short(LogsSection, "map"), commented_out=True))
    above = logs.above or (("One section per set of logs.",) if first else ())
    return ConfigBlock("# [[logs]]" if logs.commented_out else "[[logs]]", tuple(lines), above)


def _weights_block(wheels: int) -> ConfigBlock:
    kg = toml([round(10.0 / wheels, 1)] * wheels)
    lines = (
        ConfigLine("kg", kg, "in the order of the wheels", commented_out=True),
        ConfigLine("std_kg", "0.05", "standard deviation of each scale", commented_out=True),
    )
    above = ("Reading of scales under each wheel, if you weighed the robot:", "[weights.as_built]")
    return ConfigBlock("", lines, above=above)


def _parameters_block(channels: frozenset[str], robot: str) -> ConfigBlock:
    """Return the table `[parameters]`, with choices that suit logs with the given channels.

    `robot` is the reference robot that gives start values; empty without one.
    """
    free, fixed = "{ free = true }", "{ free = false }"
    lines = [ConfigLine('"camera.marker_yaw"', free, "marker's heading less the robot's [rad]")]
    if "current" in channels:
        voltage = "voltage" in channels or {"duty", "bus_voltage"} <= channels
        known = prior_text(robot, "motor.resistance")
        ask = "" if voltage or known else _DATASHEET
        resistance = known or "{ prior = { mean = 1.0, std = 0.5 } }"
        emf = prior_text(robot, "motor.back_emf") or "{ prior = { mean = 0.05, std = 0.025 } }"
        lines += [
            ConfigLine('"motor.resistance"', resistance, "[ohm], datasheet", ask),
            ConfigLine('"motor.back_emf"', emf, "[V s/rad]"),
        ]
    elif not channels & {"motor_torque", "wheel_torque"}:
        lines += [
            ConfigLine('"motor.*"', fixed, "no current: motors unknown"),
            ConfigLine('"surface.*.friction"', fixed, "nor the friction of floors"),
        ]
    lines += start_lines(robot, channels)
    above = (
        "Patterns of parameter names. fixed = value; start = value; free = true or false; prior is "
        "Gaussian in the parameter's own unit. `slipid reference parameters` lists the names.",
    )
    return ConfigBlock("[parameters]", tuple(lines), above=above)


@dataclass(frozen=True)
class NewConfig:
    """Text of a new config that was read back without errors.

    Attributes:
        text: text of the file.
        drawing: drawing of the robot.
        questions: open questions in the text.
        simulated: False for a robot that steers, which `slipid selftest` cannot simulate.
    """

    text: str
    drawing: str
    questions: tuple[str, ...]
    simulated: bool


def new_config(draft: ConfigDraft, name: str) -> NewConfig:
    """Return the config made from a draft, which was checked by reading it back.

    Args:
        draft: draft of the config.
        name: name of the config file.

    Raises:
        DataError: the answers in the draft describe no possible robot.
    """
    robot = robot_of(draft.robot)
    picture = drawing(geometry(robot))
    blocks = [
        ConfigBlock("", above=_head(draft, name)),
        _robot_block(draft, robot, picture),
        *([] if robot.drive == "steered" else [_limits_block(robot)]),
        *(block for layout in draft.layouts for block in layout.blocks()),
        *(_logs_block(logs, first=k == 0) for k, logs in enumerate(draft.logs)),
        _FIT,
        *([] if robot.drive == "steered" else [_weights_block(geometry(robot).wheels)]),
        _parameters_block(draft.channels, draft.robot.robot),
    ]
    text = "\n\n".join(block.text() for block in blocks) + "\n"
    parsed(Path(name), text)
    questions = tuple(question for block in blocks for question in block.open_questions)
    return NewConfig(text, picture, questions, robot.drive != "steered")
