"""Drafts of a config and its sections, from which its text is made; also a draft without logs."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from slipid.app.new.config_lines import ConfigBlock, ConfigLine, toml
from slipid.app.new.robot_answers import RobotAnswers
from slipid.app.reference.keys import in_short
from slipid.data.reading.layout import Layout

_EXAMPLE_NAMES = "the column names and units below are examples: write those of your files"
COLUMNS_HELP = (
    "The channel and unit of each column of your files. Time: s, ms, us or ns, since the start "
    "or since 1970. Others: rad, deg, rev, rad/s, rpm, tick, m, mm, A, mA, V, percent and so on.",
    "Remove what you do not log. A fit needs time, the motion of the wheels and the pose; currents "
    "identify friction, voltages (or duty and bus_voltage) the motor's constants.",
)
_EXAMPLES = (
    'With a quaternion: pose_quaternion = { columns = ["qx", "qy", "qz", "qw"], unit = "1" }',
    'Effort of a JointState: current (unit "A"), or motor_torque or wheel_torque (unit "N*m"); '
    "torque_constant [N m/A] in the layout makes currents of torques. Sensors may be slower than "
    "the rows: leave cells empty, or repeat the last value.",
    "More files of the same run, each with its own rows, beside the first one:",
    '[layouts.mine.beside."mocap.csv"]    # or "{stem}_pose.csv"; keys as above',
    '[layouts.mine.beside."mocap.csv".columns]',
    'time = { column = "stamp", unit = "ns" }',
)


@dataclass(frozen=True)
class LayoutDraft:
    """Draft of the layout of one kind of file, or of bags.

    Attributes:
        name: name of the layout; for a further file of a run, the name of the main file's layout,
            `beside` and the file's name, joined by dots.
        settings: lines of the layout except its channels.
        channels: a line for each channel with its columns, or with its topic.
        table: key of the table of channels: columns or topics.
        help: comments above the layout.
        above, below: comments above and below the channels.
        questions: open questions about the whole layout.
    """

    name: str
    settings: tuple[ConfigLine, ...]
    channels: tuple[ConfigLine, ...]
    table: str = "columns"
    help: tuple[str, ...] = COLUMNS_HELP
    above: tuple[str, ...] = ()
    below: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()

    @property
    def remarks(self) -> list[str]:
        """Return the comments above the channels, and a line about each channel that is not used.

        A channel that is not used because a question is open is not among them.
        """
        unused = (one for one in self.channels if one.commented_out and not one.question)
        return [*self.above, *(f"Not used: {one.key}: {one.comment}" for one in unused)]

    def blocks(self) -> list[ConfigBlock]:
        """Return the tables of the layout and of its channels."""
        head = f"layouts.{self.name}"
        return [
            ConfigBlock(f"[{head}]", self.settings, self.help, questions=self.questions),
            ConfigBlock(f"[{head}.{self.table}]", self.channels, self.above, self.below),
        ]


@dataclass(frozen=True)
class LogsDraft:
    """Draft of a section `[[logs]]`.

    Attributes:
        glob, format, surface, session: values of these keys, as in `LogsSection`; an empty session
            is not written, so that the default holds.
        above: comments above the section.
        question: open question about the surface; empty if there is none.
        commented_out: True if the section is written as a comment, without effect.
    """

    glob: str
    format: str
    surface: str = "folder"
    above: tuple[str, ...] = ()
    question: str = ""
    commented_out: bool = False
    session: str = ""


@dataclass(frozen=True)
class ConfigDraft:
    """Draft of a whole config.

    Attributes:
        robot: answers about the robot.
        layouts: layouts of log files and bags; logs in the format of a preset need none.
        logs: sections of logs.
        preset_channels: channels that are logged in the format of a preset.
        above: comments at the beginning of the file.
        data: data folder, as a command line names it.
        hints: questions about keys of `[robot]`, keyed by the key; they replace the general
            questions because they suit the logs.
        sentences: lines about what was found in the logs.
    """

    robot: RobotAnswers
    layouts: tuple[LayoutDraft, ...]
    logs: tuple[LogsDraft, ...]
    preset_channels: frozenset[str] = frozenset()
    above: tuple[str, ...] = ()
    data: str = "DIR"
    hints: Mapping[str, str] = field(default_factory=dict)
    sentences: tuple[str, ...] = ()

    @property
    def channels(self) -> frozenset[str]:
        """Return the names of all channels that are logged."""
        lines = (line for layout in self.layouts for line in layout.channels)
        return self.preset_channels | {line.key for line in lines if not line.commented_out}


def channel_line(
    channel: str, columns: tuple[str | int, ...], unit: str, comment: str = "", question: str = ""
) -> ConfigLine:
    """Return the line for a channel; columns are given by their names or positions from 0."""
    several = len(columns) > 1
    named = toml(columns if several else columns[0])
    inside = f"column{'s' if several else ''} = {named}, unit = {toml(unit)}"
    return ConfigLine(channel, f"{{ {inside} }}", comment, question)


def layout_line(key: str, value: object, question: str = "", comment: str = "") -> ConfigLine:
    """Return the line for a key of a layout, with its meaning as the comment by default."""
    return ConfigLine(key, toml(value), comment or in_short(Layout, key), question)


def row_lines(
    delimiter: str = ",", names_row: int = 1, units_row: int = 0, first_data_row: int = 2
) -> list[ConfigLine]:
    """Return the lines about the rows of a text file; none for a file that is not text (Parquet).

    Arguments are the keys of a layout; there is no line about a missing row of units.
    """
    rows = {"delimiter": delimiter, "names_row": names_row, "units_row": units_row}
    rows["first_data_row"] = first_data_row
    shown = (key for key in rows if delimiter and (units_row or key != "units_row"))
    return [layout_line(key, rows[key]) for key in shown]


def template_draft(answers: RobotAnswers) -> ConfigDraft:
    """Return the draft of a config without logs.

    Its layout has every channel that the robot may log, in one file for each run.
    """
    settings = (*row_lines(), *_settings(answers))
    layout = LayoutDraft("mine", settings, _channels(answers), below=_EXAMPLES)
    return ConfigDraft(answers, (layout,), (LogsDraft("*/*.csv", "mine"),))


def _settings(answers: RobotAnswers) -> tuple[ConfigLine, ...]:
    ask = "default value: look it up, for one turn of the motor shaft, with all edges counted"
    ask = ask if "ticks_per_revolution" in answers.defaults else ""
    ticks = (
        layout_line("ticks_per_revolution", answers.ticks_per_revolution, ask),
        layout_line("ticks_are_increments", False),
    )
    return (
        *(ticks if answers.ticks_per_revolution else ()),
        layout_line("gear_ratio", answers.gear_ratio, comment="as above"),
        layout_line("current_is_signed", True, comment="false where only magnitudes are logged"),
    )


def _channels(answers: RobotAnswers) -> tuple[ConfigLine, ...]:
    labels = ["fl", "fr", "rl", "rr"]
    if answers.drive in ("omni", "general"):
        labels = [str(k + 1) for k in range(answers.wheels)]
    elif answers.drive == "steered" and answers.encoders == 1:
        labels = [answers.driven]
    elif answers.shared or answers.drive in ("differential", "steered"):
        labels = ["left", "right"]

    def each(name: str) -> tuple[str, ...]:
        return tuple(f"{name}_{label}" for label in labels)

    ticks = channel_line("wheel_ticks", each("ticks"), "tick", "or wheel_angle, motor_angle")
    speed = channel_line("wheel_speed", each("speed"), "rad/s", "or motor_speed, before the gear")
    sideways = channel_line("twist_command_y", ("command_y",), "m/s")
    motors = (
        channel_line("current", each("current"), "A"),
        channel_line("voltage", each("voltage"), "V", "at the motors, not the battery's"),
    )
    steering = channel_line("steering_angle", ("steering",), "rad", "of the wheel, left positive")
    return (
        channel_line("time", ("time",), "s", question=_EXAMPLE_NAMES),
        ticks if answers.ticks_per_revolution else speed,
        *((steering,) if answers.drive == "steered" else motors),
        channel_line("pose_x", ("x",), "m", "at the rate of its sensor; empty cells between"),
        channel_line("pose_y", ("y",), "m"),
        channel_line("pose_heading", ("heading",), "rad"),
        channel_line("twist_command_x", ("command_x",), "m/s"),
        *([sideways] if answers.drive in ("omni", "mecanum", "general") else []),
        channel_line("twist_command_yaw", ("command_yaw",), "rad/s"),
    )
