"""Drafts of a config and its sections, from which its text is made; also a draft without logs."""

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
    """Draft of a channel in a layout.

    Attributes:
        channel: name of the channel.
        columns: names of the columns, or their positions from 0.
        unit: unit of the columns.
        comment: comment on the line of the config.
        question: open question; empty if there is none.
        commented_out: True if the line is written as a comment, without effect.
    """

    channel: str
    columns: tuple[str | int, ...]
    unit: str
    comment: str = ""
    question: str = ""
    commented_out: bool = False

    def line(self) -> ConfigLine:
        """Return the line of the config for the channel."""
        several = len(self.columns) > 1
        named = toml(list(self.columns) if several else self.columns[0])
        inside = f"column{'s' if several else ''} = {named}, unit = {toml(self.unit)}"
        return ConfigLine(
            self.channel, f"{{ {inside} }}", self.comment, self.question, self.commented_out
        )


@dataclass(frozen=True)
class FileDraft:
    """Draft of the layout of one kind of file.

    Attributes:
        channels: channels in the columns.
        delimiter: text between columns; empty for a file that is not text (Parquet).
        names_row, units_row, first_data_row: lines of names, units and first numbers, as in
            `Layout`.
        settings: lines with the other keys of the layout.
        above: comments above the columns.
        questions: open questions about the whole file.
        pattern: name of a further file of a run, as in `Layout.beside`; empty for the run's own
            file.
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
        """Return the lines of the layout except its columns."""
        if not self.delimiter:
            return self.settings
        rows = ("names_row", "units_row") if self.units_row else ("names_row",)
        lines = [layout_line("delimiter", self.delimiter)]
        lines += [layout_line(key, getattr(self, key)) for key in (*rows, "first_data_row")]
        return (*lines, *self.settings)


@dataclass(frozen=True)
class LayoutDraft:
    """Draft of the layout of all files of a run.

    Attributes:
        name: name of the layout.
        file: draft for the run's own file.
        beside: drafts for further files of the run.
        examples: True if examples of other channels and files are written below the layout.
    """

    name: str
    file: FileDraft
    beside: tuple[FileDraft, ...] = ()
    examples: bool = False

    @property
    def channels(self) -> Iterator[ChannelDraft]:
        """Yield every channel of all files that is not commented out."""
        for file in (self.file, *self.beside):
            yield from (channel for channel in file.channels if not channel.commented_out)


@dataclass(frozen=True)
class BagDraft:
    """Draft of a layout of bags.

    Attributes:
        name: name of the layout.
        settings: lines of the layout except its topics.
        topics: a line for each channel with its topic.
        above: comments above the topics.
        questions: open questions about the whole layout.
    """

    name: str
    settings: tuple[ConfigLine, ...]
    topics: tuple[ConfigLine, ...]
    above: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()


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
class RobotHint:
    """Question about a key of `[robot]` that replaces the usual one, since it suits the logs."""

    key: str
    question: str


@dataclass(frozen=True)
class ConfigDraft:
    """Draft of a whole config.

    Attributes:
        robot: answers about the robot.
        layouts: layouts of log files; logs in the format of a preset need none.
        logs: sections of logs.
        preset_channels: channels that are logged, but not in `layouts`: those of presets and bags.
        above: comments at the beginning of the file.
        data: data folder, as a command line names it.
        hints: questions about the robot that replace the usual ones.
        bags: layouts of bags.
    """

    robot: RobotAnswers
    layouts: tuple[LayoutDraft, ...]
    logs: tuple[LogsDraft, ...]
    preset_channels: frozenset[str] = frozenset()
    above: tuple[str, ...] = ()
    data: str = "DIR"
    hints: tuple[RobotHint, ...] = ()
    bags: tuple[BagDraft, ...] = ()

    @property
    def channels(self) -> frozenset[str]:
        """Return the names of all channels that are logged."""
        own = (channel.channel for layout in self.layouts for channel in layout.channels)
        return self.preset_channels | frozenset(own)


@dataclass(frozen=True)
class ConfigProposal:
    """Proposed draft of a config, with sentences about what was found in the logs."""

    draft: ConfigDraft
    sentences: tuple[str, ...]


def layout_line(key: str, value: object, question: str = "", comment: str = "") -> ConfigLine:
    """Return the line for a key of a layout, with its meaning as the comment by default."""
    return ConfigLine(key, toml(value), comment or in_short(Layout, key), question)


def template_draft(answers: RobotAnswers) -> ConfigDraft:
    """Return the draft of a config without logs.

    Its layout has every channel that the robot may log, in one file for each run.
    """
    layout = LayoutDraft(
        "mine", FileDraft(_channels(answers), settings=_settings(answers)), examples=True
    )
    return ConfigDraft(answers, (layout,), (LogsDraft("*/*.csv", "mine"),))


def _settings(answers: RobotAnswers) -> tuple[ConfigLine, ...]:
    gear = layout_line("gear_ratio", answers.gear_ratio, comment="as above")
    signed = layout_line(
        "current_is_signed", True, comment="false where only magnitudes are logged"
    )
    if not answers.ticks_per_revolution:
        return (gear, signed)
    question = ""
    if "ticks_per_revolution" in answers.defaults:
        question = "taken by default: look it up, of the motor shaft with all edges"
    ticks = layout_line("ticks_per_revolution", answers.ticks_per_revolution, question)
    increments = layout_line("ticks_are_increments", False)
    return (ticks, increments, gear, signed)


def _channels(answers: RobotAnswers) -> tuple[ChannelDraft, ...]:
    labels = _LABELS.get((answers.wheels, answers.shared))
    if labels is None or answers.drive in ("omni", "general"):
        labels = tuple(str(k + 1) for k in range(answers.wheels))

    def each(name: str) -> tuple[str, ...]:
        return tuple(f"{name}_{label}" for label in labels)

    ticks = bool(answers.ticks_per_revolution)
    turns = ChannelDraft("wheel_ticks", each("ticks"), "tick", "or wheel_angle, motor_angle")
    speed = ChannelDraft("wheel_speed", each("speed"), "rad/s", "or motor_speed, before the gear")
    sideways = answers.drive in ("omni", "mecanum", "general")
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
