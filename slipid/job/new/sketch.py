"""What a new config shall say: layouts, sections of logs and a robot, before they are text."""

from collections.abc import Iterator
from dataclasses import dataclass

from slipid.data.reading.layout import Layout
from slipid.job.new.answers import Answers
from slipid.job.new.lines import Line, toml
from slipid.job.reference.meanings import in_short


@dataclass(frozen=True)
class ChannelSketch:
    """A channel of a layout: columns and unit as of `Channel`, the rest as of `Line`."""

    channel: str
    columns: tuple[str | int, ...]
    unit: str
    comment: str = ""
    question: str = ""
    scale: float = 1.0
    off: bool = False

    def line(self) -> Line:
        """Its line in the config."""
        several = len(self.columns) > 1
        named = toml(list(self.columns) if several else self.columns[0])
        inside = f"column{'s' if several else ''} = {named}, unit = {toml(self.unit)}"
        inside += "" if self.scale == 1.0 else f", scale = {toml(self.scale)}"
        return Line(self.channel, f"{{ {inside} }}", self.comment, self.question, self.off)


@dataclass(frozen=True)
class FileSketch:
    """One kind of file.

    Attributes:
        channels: what its columns hold.
        delimiter, names_row, units_row, first_data_row: as of `Layout`; a delimiter of "" is that
            of a file without text (Parquet).
        settings: other keys of its layout.
        above: comments on the columns; questions: on the whole file.
        preset: name of the preset that the layout is made from.
    """

    channels: tuple[ChannelSketch, ...]
    delimiter: str = ","
    names_row: int = 1
    units_row: int = 0
    first_data_row: int = 2
    settings: tuple[Line, ...] = ()
    above: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()

    def lines(self) -> tuple[Line, ...]:
        """Keys of its layout but for the columns."""
        if not self.delimiter:
            return self.settings
        rows = ("names_row", "units_row") if self.units_row else ("names_row",)
        lines = [setting("delimiter", self.delimiter)]
        lines += [setting(key, getattr(self, key)) for key in (*rows, "first_data_row")]
        return (*lines, *self.settings)


@dataclass(frozen=True)
class BesideSketch:
    """A file that lies beside a run's own: its name as of `Layout.beside`."""

    pattern: str
    file: FileSketch


@dataclass(frozen=True)
class LayoutSketch:
    """A layout of the config's own; `examples`: whether other ways to log are shown below it."""

    name: str
    file: FileSketch
    beside: tuple[BesideSketch, ...] = ()
    examples: bool = False

    @property
    def channels(self) -> Iterator[ChannelSketch]:
        """Every channel that counts, of all its files."""
        for file in (self.file, *(one.file for one in self.beside)):
            yield from (channel for channel in file.channels if not channel.off)


@dataclass(frozen=True)
class BagSketch:
    """A layout of bags: its keys, a line for each topic that counts, and what they hold."""

    name: str
    settings: tuple[Line, ...]
    topics: tuple[Line, ...]
    above: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()


@dataclass(frozen=True)
class LogsSketch:
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
class Hint:
    """What to ask of a key of `[robot]` that nobody answered, instead of the usual words."""

    key: str
    asks: str


@dataclass(frozen=True)
class Sketch:
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

    robot: Answers
    layouts: tuple[LayoutSketch, ...]
    logs: tuple[LogsSketch, ...]
    carries: frozenset[str] = frozenset()
    above: tuple[str, ...] = ()
    data: str = "DIR"
    hints: tuple[Hint, ...] = ()
    bags: tuple[BagSketch, ...] = ()

    @property
    def channels(self) -> frozenset[str]:
        """Every channel that is logged."""
        own = (channel.channel for layout in self.layouts for channel in layout.channels)
        return self.carries | frozenset(own)


def setting(key: str, value: object, question: str = "", comment: str = "") -> Line:
    """A key of a layout with what it means."""
    return Line(key, toml(value), comment or in_short(Layout, key), question)
