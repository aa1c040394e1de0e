"""The content of a new config before it is text; also the one for logs that nobody has shown."""

from collections.abc import Iterator
from dataclasses import dataclass

from slipid.app.new.config_lines import ConfigLine, toml
from slipid.app.new.robot_questions import RobotAnswers
from slipid.app.reference.keys import in_short
from slipid.data.reading.layout import Layout

_EXAMPLE_NAMES = "the column names and units below are examples: write those of your files"
_LABELS = {
    (4, False): ("fl", "fr", "rl", "rr"),
    (4, True): ("left", "right"),
    (2, False): ("left", "right"),
}


@dataclass(frozen=True)
class ChannelDraft:
    """A channel of a layout: columns and unit as of `Channel`, the rest as of `Line`."""

    channel: str
    columns: tuple[str | int, ...]
    unit: str
    comment: str = ""
    question: str = ""
    off: bool = False

    def line(self) -> ConfigLine:
        """Its line in the config."""
        several = len(self.columns) > 1
        named = toml(list(self.columns) if several else self.columns[0])
        inside = f"column{'s' if several else ''} = {named}, unit = {toml(self.unit)}"
        return ConfigLine(self.channel, f"{{ {inside} }}", self.comment, self.question, self.off)


@dataclass(frozen=True)
class FileDraft:
    """One kind of file.

    Attributes:
        channels: what its columns hold.
        delimiter, names_row, units_row, first_data_row: as of `Layout`; a delimiter of "" is that
            of a file without text (Parquet).
        settings: other keys of its layout.
        above: comments on the columns; questions: on the whole file.
        pattern: name of a file that lies beside a run's own, as of `Layout.beside`; empty for that.
    """

    channels: tuple[ChannelDraft, ...]
    delimiter: str = ","
    names_row: int = 1
    units_row: int = 0
    first_data_row: int = 2
    settings: tuple[ConfigLine, ...] = ()
    above: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()
    pattern: str = ""

    def lines(self) -> tuple[ConfigLine, ...]:
        """Keys of its layout but for the columns."""
        if not self.delimiter:
            return self.settings
        rows = ("names_row", "units_row") if self.units_row else ("names_row",)
        lines = [layout_line("delimiter", self.delimiter)]
        lines += [layout_line(key, getattr(self, key)) for key in (*rows, "first_data_row")]
        return (*lines, *self.settings)


@dataclass(frozen=True)
class LayoutDraft:
    """A layout of the config's own; `examples`: whether other ways to log are shown below it."""

    name: str
    file: FileDraft
    beside: tuple[FileDraft, ...] = ()
    examples: bool = False

    @property
    def channels(self) -> Iterator[ChannelDraft]:
        """Every channel that counts, of all its files."""
        for file in (self.file, *self.beside):
            yield from (channel for channel in file.channels if not channel.off)


@dataclass(frozen=True)
class BagDraft:
    """A layout of bags: its keys, a line for each topic that counts, and what they hold."""

    name: str
    settings: tuple[ConfigLine, ...]
    topics: tuple[ConfigLine, ...]
    above: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()


@dataclass(frozen=True)
class LogsDraft:
    """A section of logs; attributes as of `Logs`, and what is said or asked of it.

    A session of "" is not written: the default holds.
    """

    glob: str
    format: str
    surface: str = "folder"
    above: tuple[str, ...] = ()
    question: str = ""
    off: bool = False
    session: str = ""


@dataclass(frozen=True)
class RobotHint:
    """What to ask of a key of `[robot]` that nobody answered, instead of the usual words."""

    key: str
    asks: str


@dataclass(frozen=True)
class ConfigDraft:
    """A whole config.

    Attributes:
        robot: answers to the questions.
        layouts, logs: of the log files; logs that use a preset need no layout.
        carries: channels of the presets that are used.
        above: comments at its beginning.
        data: the data folder, as it is called on the command line.
        hints: questions about the robot in words that fit its logs.
        bags: layouts of bags.
    """

    robot: RobotAnswers
    layouts: tuple[LayoutDraft, ...]
    logs: tuple[LogsDraft, ...]
    carries: frozenset[str] = frozenset()
    above: tuple[str, ...] = ()
    data: str = "DIR"
    hints: tuple[RobotHint, ...] = ()
    bags: tuple[BagDraft, ...] = ()

    @property
    def channels(self) -> frozenset[str]:
        """Every channel that is logged."""
        own = (channel.channel for layout in self.layouts for channel in layout.channels)
        return self.carries | frozenset(own)


@dataclass(frozen=True)
class ConfigProposal:
    """A config to be, and what was found in the logs, in sentences."""

    sketch: ConfigDraft
    sentences: tuple[str, ...]


def layout_line(key: str, value: object, question: str = "", comment: str = "") -> ConfigLine:
    """A key of a layout with what it means."""
    return ConfigLine(key, toml(value), comment or in_short(Layout, key), question)


def template_draft(known: RobotAnswers) -> ConfigDraft:
    """Everything that this robot may log, in one file for each run."""
    layout = LayoutDraft(
        "mine", FileDraft(_channels(known), settings=_settings(known)), examples=True
    )
    return ConfigDraft(known, (layout,), (LogsDraft("*/*.csv", "mine"),))


def _settings(known: RobotAnswers) -> tuple[ConfigLine, ...]:
    gear = layout_line("gear_ratio", known.gear_ratio, comment="as above")
    signed = layout_line(
        "current_is_signed", True, comment="false where only magnitudes are logged"
    )
    if not known.ticks_per_revolution:
        return (gear, signed)
    question = ""
    if "ticks_per_revolution" in known.taken:
        question = "taken by default: look it up, of the motor shaft with all edges"
    ticks = layout_line("ticks_per_revolution", known.ticks_per_revolution, question)
    increments = layout_line("ticks_are_increments", False)
    return (ticks, increments, gear, signed)


def _channels(known: RobotAnswers) -> tuple[ChannelDraft, ...]:
    labels = _LABELS.get((known.wheels, known.shared))
    if labels is None or known.drive in ("omni", "general"):
        labels = tuple(str(k + 1) for k in range(known.wheels))

    def each(name: str) -> tuple[str, ...]:
        return tuple(f"{name}_{label}" for label in labels)

    ticks = bool(known.ticks_per_revolution)
    turns = ChannelDraft("wheel_ticks", each("ticks"), "tick", "or wheel_angle, motor_angle")
    speed = ChannelDraft("wheel_speed", each("speed"), "rad/s", "or motor_speed, before the gear")
    sideways = known.drive in ("omni", "mecanum", "general")
    twist = [("twist_command_x", "command_x", "m/s"), ("twist_command_y", "command_y", "m/s")]
    twist = twist if sideways else twist[:1]
    commands = [
        ChannelDraft(*(channel, (column,), unit))
        for channel, column, unit in (*twist, ("twist_command_yaw", "command_yaw", "rad/s"))
    ]
    return (
        ChannelDraft("time", ("time",), "s", question=_EXAMPLE_NAMES),
        turns if ticks else speed,
        ChannelDraft("current", each("current"), "A"),
        ChannelDraft("voltage", each("voltage"), "V", "at the motors, not the battery's"),
        ChannelDraft("pose_x", ("x",), "m", "at the rate of its sensor; empty cells between"),
        ChannelDraft("pose_y", ("y",), "m"),
        ChannelDraft("pose_heading", ("heading",), "rad"),
        *commands,
    )
