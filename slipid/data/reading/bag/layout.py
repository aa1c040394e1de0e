"""Layout of a bag: the topic of each channel, and the rule that separates the bag's runs."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AliasChoices, BeforeValidator, Field, StrictBool, StrictStr
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
from slipid.support.errors import DataError
from slipid.support.quantities import Bounds, InsidePath, Offset, Scale, Seconds
from slipid.support.toml_file import CLOSED, checked

EFFORT = '"A" (current), "N*m" (motor_torque or wheel_torque), "V" (voltage) or "1" (duty)'
"""Units in which drivers publish the effort of a JointState, as text for error messages."""


Texts = Annotated[tuple[StrictStr, ...], BeforeValidator(several)]


@dataclass(frozen=True, config=CLOSED)
class TopicChannel:
    """Topic and fields of one channel in a bag: value = (scale x number + offset), in `unit`.

    Attributes:
        topics: name of the topic, or a list of topics if the wheels are spread over several topics.
        fields: path of each number in a message, such as `motors[0].current`; an array without an
            index stands for all its elements. For a pose or a twist, the path of the field that
            contains it. Not needed for the message types that slipid knows.
        unit: unit of the numbers; not needed for the message types that slipid knows, except for
            the effort of joints.
        scale: factor on the numbers, such as -1 for a reversed sign: one number for all wheels, or
            one per wheel.
        offset: number that is added after scaling, in `unit`.
        frame: frame in which the pose is expressed, such as `map`, if the pose is taken from
            transforms (`/tf`).
        child: frame whose pose is taken from transforms, such as `base_link`.
    """

    topics: Annotated[Texts, Field(min_length=1, validation_alias=AliasChoices("topics", "topic"))]
    fields: Annotated[Texts, Field(validation_alias=AliasChoices("fields", "field"))] = ()
    unit: StrictStr | None = None
    scale: Annotated[tuple[Scale, ...], BeforeValidator(several), Field(min_length=1)] = (1.0,)
    offset: Offset = 0.0
    frame: StrictStr | None = None
    child: StrictStr | None = None

    def __post_init__(self) -> None:
        for path in self.fields:
            check_path(path)
        if (self.frame is None) != (self.child is None):
            raise ValueError("only one of frame and child is given; expected both, or none of them")
        if len(self.fields) > 1 and len(self.topics) > 1:
            raise ValueError("several topics and several fields; expected one field for all topics")


@dataclass(frozen=True, config=CLOSED)
class RunRule:
    """Rule that separates the runs of a bag: by a topic, by pauses or by a table.

    Attributes:
        topic: topic whose value tells runs apart: a run lasts as long as the value stays the same
            and is not one of `between`.
        field: path of this value in a message of the topic.
        between: values of the topic while no run is being driven.
        surface: path of the field with the name of the floor.
        load: path of the field with the name of the load set-up.
        pause_s: a new run starts after all wheels have stood still for this time [s].
        table: CSV file with one run per row, relative to the folder of the bag. Its columns are
            start and end [s], and optionally surface, load, name and bag.
        from_start: true if the times of the table are counted from the first sample of the bag; by
            default they are times as in the messages.
    """

    topic: StrictStr | None = None
    field: StrictStr = "data"
    between: tuple[str | int | float | bool, ...] = ("", 0, False)
    surface: StrictStr | None = None
    load: StrictStr | None = None
    pause_s: Seconds | None = None
    table: InsidePath | None = None
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
        topics: topic and fields of each channel or group of channels.
        joints: names of the joints of the wheels or motors, in the order of the drives.
        runs: rule that separates the runs of a bag; by default a bag is one run.
        stamp: "header" to use the time stamps in the headers of messages (if they have one),
            "received" to use the times at which the recorder received the messages.
        max_disorder: messages of a topic may be out of order by up to this time [s]; they are then
            sorted.
        drop_nan: true to leave out messages with NaN; by default they are an error.
        definitions: folder with the .msg files of message types whose definition is not in the bag.
    """

    topics: dict[str, TopicChannel]
    joints: tuple[StrictStr, ...] = ()
    runs: RunRule | None = None
    stamp: Literal["header", "received"] = "header"
    max_disorder: Annotated[float, Bounds(0, 1e6, "s")] = 0.1
    drop_nan: StrictBool = False
    definitions: Path | None = None

    @property
    def holds(self) -> frozenset[str]:
        """Names of all channels of a run."""
        return frozenset(inner for name in self.topics for inner in GROUPS.get(name, (name,)))


_NAMES = [*GROUPS, *(name for name in CHANNELS if name not in ("time", "pose_quaternion"))]


def declared_bag_layout(
    table: Mapping[str, object], where: str, folder: Path = Path()
) -> BagLayout:
    """Return the layout of bags in a config: a table with `kind = "bag"`.

    Args:
        table: content of the config section.
        where: name of the section in messages, such as `robot.toml [layouts.mine]`.
        folder: folder to which a relative `definitions` refers.

    Raises:
        DataError: a key, channel or unit is unknown, or a value has the wrong dimension or type.
    """
    given = {key: value for key, value in table.items() if key != "kind"}
    layout = checked(where, given, BagLayout)
    definitions = layout.definitions and folder / layout.definitions
    layout = replace(layout, definitions=definitions)
    for name, channel in layout.topics.items():
        if problem := _channel_problem(name, channel, layout):
            raise DataError(f"{where} topics.{name}: {problem}")
    if problem := _problem(layout):
        raise DataError(f"{where}: {problem}")
    return layout


def _channel_problem(name: str, channel: TopicChannel, layout: BagLayout) -> str | None:
    """Return a message about a contradiction in the settings of one channel, or None."""
    if name not in _NAMES:
        return unknown("channel", name, _NAMES)
    if channel.frame is not None and name != "pose":
        return "frame and child are for poses only; expected neither"
    if name in GROUPS:
        plain = channel.unit is None and channel.scale == (1.0,) and channel.offset == 0.0
        if plain and len(channel.topics) == 1 and len(channel.fields) <= 1:
            return None
        inner = ", ".join(GROUPS[name])
        return (
            "keys other than topic and field; expected only these two, or separate entries for "
            f"{inner}"
        )
    if name not in PER_WHEEL and len(channel.topics) > 1:
        return f"{len(channel.topics)} topics; expected one"
    if channel.unit is None and any(path.endswith("effort") for path in channel.fields):
        return f"effort without a unit, which differs between drivers; expected unit = {EFFORT}"
    if channel.unit is not None:
        try:
            layout.factor(name, channel.unit)
        except ValueError as error:
            return str(error)
    return None


def _problem(layout: BagLayout) -> str | None:
    """Return a message about a contradiction in the layout, or None."""
    have = set(layout.topics)
    for group, inner in GROUPS.items():
        if group in have and (twice := have & set(inner)):
            return f"both {group} and {min(twice)} are given; expected only one of them"
    if not have:
        return "topics: empty; expected a table of channels"
    if lacking := layout.lacks(layout.holds):
        return lacking
    if len(set(layout.joints)) < len(layout.joints):
        return f"joints {list(layout.joints)}; expected each name only once"
    if layout.runs is not None and layout.runs.pause_s is not None and not have & set(TURNS):
        return f"pause_s without a channel of the wheels; expected one of {', '.join(TURNS)}"
    if layout.definitions is not None and not os.path.isdir(layout.definitions):
        return f"definitions: no folder {layout.definitions}; expected a folder with .msg files"
    return None
