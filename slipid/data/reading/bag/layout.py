"""Layout of a bag: the topic of each channel, and the rule that separates the bag's runs."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AliasChoices, BeforeValidator, Field, StrictBool, StrictFloat, StrictStr
from pydantic.dataclasses import dataclass

from slipid.data.reading.bag.shape import check_path
from slipid.data.reading.layout import (
    CHANNELS,
    GROUPS,
    PER_WHEEL,
    TURNS,
    SensorLayout,
    several,
    unknown,
)
from slipid.data.reading.units import factor
from slipid.support.errors import DataError
from slipid.support.toml_file import CLOSED, NotNegative, Positive, checked

EFFORT = '"A" (current), "N*m" (motor_torque or wheel_torque), "V" (voltage) or "1" (duty)'
"""Text, for error messages, about the units that drivers use for the effort of a JointState."""


Texts = Annotated[tuple[StrictStr, ...], BeforeValidator(several)]


@dataclass(frozen=True, config=CLOSED)
class TopicChannel:
    """Position of one channel in a bag: value = (scale x number + offset), in `unit`.

    Attributes:
        topics: the topic; several where each holds some of the wheels.
        fields: paths of the numbers in a message, such as `motors[0].current`; an array without an
            index counts with all its elements. For a pose or a twist the field that holds it. Known
            message types need none.
        unit: unit of the numbers; known message types need none, except for the effort of joints.
        scale: a sign or a correction, one number for all columns or one for each.
        offset: added after the scale, in `unit`.
        frame: frame in which a pose is expressed, if it is looked up in transforms (`/tf`).
        child: frame whose pose is looked up.
    """

    topics: Annotated[Texts, Field(min_length=1, validation_alias=AliasChoices("topics", "topic"))]
    fields: Annotated[Texts, Field(validation_alias=AliasChoices("fields", "field"))] = ()
    unit: StrictStr | None = None
    scale: Annotated[tuple[StrictFloat, ...], BeforeValidator(several)] = (1.0,)
    offset: StrictFloat = 0.0
    frame: StrictStr | None = None
    child: StrictStr | None = None

    def __post_init__(self) -> None:
        for path in self.fields:
            check_path(path)
        if (self.frame is None) != (self.child is None):
            raise ValueError("one frame only; expected both frame and child, or none of them")
        if len(self.fields) > 1 and len(self.topics) > 1:
            raise ValueError("several topics and several fields; expected one field for all topics")


@dataclass(frozen=True, config=CLOSED)
class RunRule:
    """Rule that separates the runs of a bag: a topic, pauses or a table.

    Attributes:
        topic: topic whose value marks a run: true, or one value while it stays.
        field: path of that value.
        between: values between runs.
        surface, load: path of the field that names the floor, or the load set-up.
        pause_s: time without motion of any wheel after which a new run starts [s].
        table: CSV file with columns start and end [s], perhaps surface, load, name and bag,
            relative to the folder of the bag.
        from_start: whether its times count from the first sample of the bag; else as stamps do.
    """

    topic: StrictStr | None = None
    field: StrictStr = "data"
    between: tuple[str | int | float | bool, ...] = ("", 0, False)
    surface: StrictStr | None = None
    load: StrictStr | None = None
    pause_s: Positive | None = None
    table: StrictStr | None = None
    from_start: StrictBool = False

    def __post_init__(self) -> None:
        if sum(rule is not None for rule in (self.topic, self.pause_s, self.table)) != 1:
            raise ValueError("expected one of topic, pause_s and table")
        for path in (self.field, self.surface, self.load):
            if path is not None:
                check_path(path)


@dataclass(frozen=True, config=CLOSED)
class BagLayout(SensorLayout):
    """Layout of the bags of one robot.

    Attributes:
        topics: position of each channel, or group of channels.
        joints: names of the drives' joints, in the order of the drives.
        runs: rule that separates runs; without it a bag is one run.
        stamp: time that counts: the one in the messages (where they have one), or the one at which
            the recorder received them.
        max_disorder: largest delay of messages of a topic that are sorted [s].
        drop_nan: whether messages with NaN are left out; else they are refused.
        definitions: folder of .msg files, for message types whose definition the bag lacks.
    """

    topics: dict[str, TopicChannel]
    joints: tuple[StrictStr, ...] = ()
    runs: RunRule | None = None
    stamp: Literal["header", "received"] = "header"
    max_disorder: NotNegative = 0.1
    drop_nan: StrictBool = False
    definitions: Path | None = None

    @property
    def holds(self) -> frozenset[str]:
        """Return every channel of a run."""
        return frozenset(inner for name in self.topics for inner in GROUPS.get(name, (name,)))


_NAMES = [*GROUPS, *(name for name in CHANNELS if name not in ("time", "pose_quaternion"))]


def declared_bag_layout(
    table: Mapping[str, object], where: str, folder: Path = Path()
) -> BagLayout:
    """Return the layout of bags in a config: a table with `kind = "bag"`.

    Args:
        table: content of the section.
        where: name of the section in messages, such as `robot.toml [layouts.mine]`.
        folder: folder to which a relative `definitions` refers.

    Raises:
        DataError: unknown key, channel or unit, wrong dimension, wrong type.
    """
    given = {key: value for key, value in table.items() if key != "kind"}
    layout = checked(where, given, BagLayout)
    definitions = layout.definitions and folder / layout.definitions
    layout = replace(layout, definitions=definitions)
    for name, channel in layout.topics.items():
        if problem := _channel_problem(name, channel):
            raise DataError(f"{where} topics.{name}: {problem}")
    if problem := _problem(layout):
        raise DataError(f"{where}: {problem}")
    return layout


def _channel_problem(name: str, channel: TopicChannel) -> str | None:
    """Return a text about a contradiction in the position of one channel, or None."""
    if name not in _NAMES:
        return unknown("channel", name, _NAMES)
    if channel.frame is not None and name != "pose":
        return "frame and child, which belong to a pose; expected neither"
    if name in GROUPS:
        plain = channel.unit is None and channel.scale == (1.0,) and channel.offset == 0.0
        if plain and len(channel.topics) == 1 and len(channel.fields) <= 1:
            return None
        inner = ", ".join(GROUPS[name])
        return f"more than topic and field; expected these alone, or {inner} each with its own"
    if name not in PER_WHEEL and len(channel.topics) > 1:
        return f"{len(channel.topics)} topics; expected one"
    if channel.unit is None and any(path.endswith("effort") for path in channel.fields):
        return f"effort without a unit, and drivers disagree on it; expected unit = {EFFORT}"
    if channel.unit is not None:
        try:
            factor(channel.unit, CHANNELS[name])
        except ValueError as error:
            return str(error)
    return None


def _problem(layout: BagLayout) -> str | None:
    """Return a text about a contradiction in the layout, or None."""
    have = set(layout.topics)
    for group, inner in GROUPS.items():
        if group in have and (twice := have & set(inner)):
            return f"{group} and {min(twice)}; expected one of them"
    if not have:
        return "topics: no channel; expected a table of channels"
    if lacking := layout.lacks(layout.holds):
        return lacking
    if len(set(layout.joints)) < len(layout.joints):
        return f"joints {list(layout.joints)}; expected each once"
    if layout.runs is not None and layout.runs.pause_s is not None and not have & set(TURNS):
        return f"runs by pauses, but no wheels; expected one of the topics {', '.join(TURNS)}"
    if layout.definitions is not None and not layout.definitions.is_dir():
        return f"definitions: no folder {layout.definitions}; expected one with .msg files"
    return None
