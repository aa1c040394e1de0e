"""Text of a new config, with every key explained; it is read back before it is written."""

from dataclasses import dataclass
from pathlib import Path

from slipid.app.config import LogsSection, OmniDrive, Wheels, geometry, parsed
from slipid.app.new.config_lines import ConfigBlock, ConfigLine, drawing, toml
from slipid.app.new.draft import BagDraft, ConfigDraft, FileDraft, LayoutDraft, LogsDraft
from slipid.app.new.robot_questions import robot_of
from slipid.app.reference.keys import in_short
from slipid.support.errors import DataError
from slipid.support.files import write_bytes

_ORDER = {
    "omni": "each wheel drives 90 deg further than it stands",
    "mecanum": "wheels: front left, front right, rear left, rear right",
    "skid": "wheels: front left, front right, rear left, rear right",
    "differential": "wheels: left, right",
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
_ASK_MEASURED = "taken by default: measure it, or look it up"
_ASK_PLACES = "taken by default: where do the wheels stand, in the order of the columns?"
_QUESTIONS = {
    "drive": "which drive is it: omni, mecanum, skid, differential or general?",
    "wheel_azimuths_deg": _ASK_PLACES,
    "wheel_places_m": _ASK_PLACES,
    "drive_directions_deg": "taken by default: which way does each wheel roll?",
    "roller_angles_deg": "taken by default: do the wheels have rollers, and how are they tilted?",
    "gear_ratio": "taken by default: is there a gear, and are speeds and ticks of the motor?",
    "mass_kg": "taken by default: weigh the robot",
    "wheel_radius_m": _ASK_MEASURED,
}
_DATASHEET = (
    "without the voltages of the motors this and the next keep their values: what are they, by the "
    "datasheet?"
)
FRAME = "x ahead, y left, angles counter-clockwise from ahead; wheels in the order of the columns"
_LENGTHS_HELP = (
    '"poses" of motion capture, lidar or RTK, which make the wheel radius free; or "wheels" that '
    "were measured, which make the scale of the camera free:"
)
_COLUMNS_HELP = (
    "The channel and unit of each column of your files. Time: s, ms, us or ns, since the start "
    "or since 1970. Others: rad, deg, rev, rad/s, rpm, tick, m, mm, A, mA, V, percent and so on.",
    "Remove what you do not log. A fit needs time, the motion of the wheels and the pose; currents "
    "identify friction, voltages (or duty and bus_voltage) the motor's constants.",
)
_OTHER_CHANNELS = (
    'With a quaternion: pose_quaternion = { columns = ["qx", "qy", "qz", "qw"], unit = "1" }',
    'Effort of a JointState: current (unit "A"), or motor_torque or wheel_torque (unit "N*m"), for '
    "which the layout needs torque_constant [N m/A]. Sensors may be slower than the rows: leave "
    "cells empty, or repeat the last value.",
)
_MORE_FILES = (
    "More files of the same run, each with its own rows, beside the first one:",
    '[layouts.mine.beside."mocap.csv"]    # or "{stem}_pose.csv"; keys as above',
    '[layouts.mine.beside."mocap.csv".columns]',
    'time = { column = "stamp", unit = "ns" }',
)


def blocks_of(draft: ConfigDraft, robot: Wheels, picture: str, name: str) -> list[ConfigBlock]:
    """Return all tables of a config in order.

    Args:
        draft: draft of the config.
        robot: section `[robot]`, made from the answers in the draft.
        picture: drawing of the robot.
        name: name of the config file.
    """
    return [
        ConfigBlock("", above=_head(draft, name)),
        _robot_block(draft, robot, picture),
        *(block for layout in draft.layouts for block in _layout_blocks(layout)),
        *(block for bag in draft.bags for block in _bag_blocks(bag)),
        *(_logs_block(logs, first=k == 0) for k, logs in enumerate(draft.logs)),
        _fit_block(),
        _weights_block(geometry(robot).wheels),
        _parameters_block(draft.channels),
    ]


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
    lines = [
        ConfigLine("drive", toml(robot.drive), _ORDER[robot.drive], _open_question(draft, "drive"))
    ]
    given = robot.model_dump(exclude_none=True, exclude={"drive"}, exclude_defaults=False)
    if isinstance(robot, OmniDrive) and robot.roller_angle_deg == 90.0:
        del given["roller_angle_deg"]  # the default, that of ordinary omni wheels
    # The keys of the type of drive come first, those that all robots have after them.
    common = ("wheel_radius_m", "gear_ratio", "mass_kg")
    for key in (*(k for k in given if k not in common), *common):
        comment = in_short(type(robot), key)
        lines.append(ConfigLine(key, toml(given[key]), comment, _open_question(draft, key)))
    return ConfigBlock("[robot]", tuple(lines), above=(*picture.splitlines(), "", FRAME))


def _open_question(draft: ConfigDraft, key: str) -> str:
    """Return the question about a key of `[robot]` with a default; empty if it was answered."""
    if _ANSWER_OF_KEY.get(key, key) not in draft.robot.defaults or key == "drives":
        return ""
    hints = (hint.question for hint in draft.hints if hint.key == key and hint.question)
    return next(hints, _QUESTIONS.get(key, _ASK_MEASURED))


def _layout_blocks(layout: LayoutDraft) -> list[ConfigBlock]:
    """Return the tables of a layout and its columns, those of further files of a run included."""
    where = f"layouts.{layout.name}"
    below = (*_OTHER_CHANNELS, *_MORE_FILES) if layout.examples else ()
    blocks = _file_blocks(where, layout.file, _COLUMNS_HELP, below)
    for one in layout.beside:
        above = (f"Of the same run, in {one.pattern}:",)
        blocks += _file_blocks(f"{where}.beside.{toml(one.pattern)}", one, above)
    return blocks


def _file_blocks(
    where: str, file: FileDraft, above: tuple[str, ...], below: tuple[str, ...] = ()
) -> list[ConfigBlock]:
    columns = tuple(channel.line() for channel in file.channels)
    return [
        ConfigBlock(f"[{where}]", file.lines(), above=above, questions=file.questions),
        ConfigBlock(f"[{where}.columns]", columns, above=file.above, below=below),
    ]


def _bag_blocks(bag: BagDraft) -> list[ConfigBlock]:
    """Return the tables of a layout of bags and its topics."""
    above = (
        "The topic of each channel. Known types of messages need neither field nor unit; the frame "
        "of a pose in /tf and the meaning of the effort of joints must be given.",
    )
    return [
        ConfigBlock(f"[layouts.{bag.name}]", bag.settings, above=above, questions=bag.questions),
        ConfigBlock(f"[layouts.{bag.name}.topics]", bag.topics, above=bag.above),
    ]


def _logs_block(logs: LogsDraft, first: bool) -> ConfigBlock:
    """Return the table of a section of logs; the keys are explained only in the first section."""

    def line(key: str, value: str, commented_out: bool = False) -> ConfigLine:
        return ConfigLine(
            key,
            toml(value),
            in_short(LogsSection, key) if first else "",
            commented_out=commented_out,
        )

    surface = in_short(LogsSection, "surface") + '; "folder": the folder names it'
    lines = [
        line("glob", logs.glob, logs.commented_out),
        line("format", logs.format, logs.commented_out),
        ConfigLine(
            "surface",
            toml(logs.surface),
            surface if first else "",
            logs.question,
            logs.commented_out,
        ),
        line("load", "as_built", logs.commented_out),
    ]
    if logs.session:
        lines.append(line("session", logs.session, logs.commented_out))
    if first:
        lines.append(line("map", "maps/site.toml", commented_out=True))
    above = logs.above or (("One section per set of logs.",) if first else ())
    return ConfigBlock(
        "# [[logs]]" if logs.commented_out else "[[logs]]", tuple(lines), above=above
    )


def _fit_block() -> ConfigBlock:
    """Return the commented-out table `[fit]`, which asks whether poses are in true metres.

    Logs do not show it.
    """
    above = (
        "Which lengths are known? " + _LENGTHS_HELP,
        "[fit]",
    )
    return ConfigBlock(
        "", (ConfigLine("lengths_from", toml("poses"), commented_out=True),), above=above
    )


def _weights_block(wheels: int) -> ConfigBlock:
    kg = toml([round(10.0 / wheels, 1)] * wheels)
    lines = (
        ConfigLine("kg", kg, "in the order of the wheels", commented_out=True),
        ConfigLine("std_kg", "0.05", "standard deviation of each scale", commented_out=True),
    )
    above = ("Reading of scales under each wheel, if you weighed the robot:", "[weights.as_built]")
    return ConfigBlock("", lines, above=above)


def _parameters_block(channels: frozenset[str]) -> ConfigBlock:
    """Return the table `[parameters]`, with choices that suit logs with the given channels."""
    current = channels & {"current", "motor_torque", "wheel_torque"}
    voltage = "voltage" in channels or {"duty", "bus_voltage"} <= channels
    yaw = '"camera.marker_yaw"'
    lines = [
        ConfigLine(yaw, "{ free = true }", "marker's heading less the robot's [rad]"),
    ]
    if current:
        ask = "" if voltage else _DATASHEET
        resistance, emf = "{ mean = 1.0, std = 0.5 }", "{ mean = 0.05, std = 0.025 }"
        lines.append(
            ConfigLine('"motor.resistance"', f"{{ prior = {resistance} }}", "[ohm], datasheet", ask)
        )
        lines.append(ConfigLine('"motor.back_emf"', f"{{ prior = {emf} }}", "[V s/rad]"))
    else:
        lines.append(ConfigLine('"motor.*"', "{ free = false }", "no current: motors unknown"))
        lines.append(
            ConfigLine('"surface.*.friction"', "{ free = false }", "nor the friction of floors")
        )
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
        robot: section `[robot]`.
        drawing: drawing of the robot.
        questions: open questions in the text.
    """

    text: str
    robot: Wheels
    drawing: str
    questions: tuple[str, ...]

    def write(self, out: Path, force: bool = False) -> None:
        """Write the file; raise `DataError` if it exists, unless `force`."""
        refuse_existing(out, force)
        write_bytes(out, self.text.encode())


def refuse_existing(out: Path, force: bool) -> None:
    """Raise `DataError` if a file exists, unless `force`; this is done before the user is asked."""
    if out.exists() and not force:
        raise DataError(f"{out}: exists already; expected a new file, or --force")


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
    blocks = blocks_of(draft, robot, picture, name)
    text = "\n\n".join(block.text() for block in blocks) + "\n"
    parsed(Path(name), text)
    questions = tuple(question for block in blocks for question in block.open_questions)
    return NewConfig(text, robot, picture, questions)
