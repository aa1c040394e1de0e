"""Layout of a log of motors on a bench, from columns named by the user or found by their names."""

from collections.abc import Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path

from slipid.data.reading.column_names import (
    ColumnMeaning,
    is_electrical,
    is_unit,
    meaning_of,
    stamp_columns,
    unit_in,
    without_unit,
)
from slipid.data.reading.layout import CHANNELS, Channel, Layout
from slipid.data.reading.motor_tools import tool_meanings
from slipid.data.reading.table_format import TableFormat
from slipid.data.reading.units import converts
from slipid.support.errors import DataError, bad_data, did_you_mean
from slipid.support.quantities import GearRatio, PolePairs, TicksPerTurn, limits_of

SHAFT_GEAR_RATIO = 10.0
"""Fictitious gear ratio of the layout, with which the checks allow a motor shaft to turn ten times
faster than a wheel."""
PULSES = "pulses"
"""Channel of a tachometer, from which the speed is computed; it is not one of `CHANNELS`."""
_CHANNELS = ("time", "voltage", "current", "motor_speed", "motor_angle", "duty", "bus_voltage")
_INSTEAD = {
    "voltage": {"duty"},
    "duty": {"voltage"},
    "bus_voltage": {"voltage"},
    "motor_speed": {"motor_angle", PULSES},
    "motor_angle": {"motor_speed", PULSES},
}
"""Alternative channels: a channel is not searched for if one of its alternatives is known."""


@dataclass(frozen=True)
class GivenColumns:
    """Columns of a channel, named by the user.

    Attributes:
        columns: names of the columns.
        unit: their unit; None if it was not given.
        scale: -1 if the sign is to be reversed, else 1.
        file: file of the columns; None for the main file.
    """

    columns: tuple[str, ...]
    unit: str | None
    scale: float = 1.0
    file: Path | None = None


@dataclass(frozen=True)
class MotorOptions:
    """Properties of a motor's log that no file tells.

    Attributes:
        signed: True if currents have a sign.
        pole_pairs: pole pairs of the motor, by which an electrical speed is divided; None if the
            speed is that of the shaft.
        gear_ratio: turns of the motor per turn of the sensor of its speed.
        pulses_per_revolution: pulses of a tachometer in one turn of its shaft; None without one.
        ignored: columns that are not searched for channels.
    """

    signed: bool = True
    pole_pairs: float | None = None
    gear_ratio: float = 1.0
    pulses_per_revolution: float | None = None
    ignored: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        for option, value, kind in (
            ("--pole-pairs", self.pole_pairs, PolePairs),
            ("--gear", self.gear_ratio, GearRatio),
            ("--pulses-per-revolution", self.pulses_per_revolution, TicksPerTurn),
        ):
            if value is not None and not limits_of(kind).holds(value):
                raise DataError(f"{option}: {value:g}; expected a number {limits_of(kind)}")


def given_columns(text: str, channel: str) -> GivenColumns:
    """Return the columns of a channel from an option's text: `NAME`, `NAME:UNIT` or `NAME:-UNIT`.

    `FILE::` before the name denotes another file. For several motors, several names are separated
    by commas.
    """
    place, _, rest = text.rpartition("::")
    file = Path(place) if place else None
    names, colon, unit = rest.rpartition(":")
    bare = unit.removeprefix("-")
    if not colon or not converts(bare, CHANNELS.get(channel, "s")):
        names, unit, bare = rest, "", ""
    columns = tuple(name.strip() for name in names.split(","))
    return GivenColumns(columns, bare or None, -1.0 if unit.startswith("-") else 1.0, file)


def motor_layout(
    format: TableFormat,
    given: Mapping[str, GivenColumns],
    options: MotorOptions,
    texts: frozenset[str] = frozenset(),
    zeros: frozenset[str] = frozenset(),
) -> Layout:
    """Return the layout of a log of motors.

    For channels without given columns, columns are found by their names. A given channel replaces
    its alternatives as well: with a given duty cycle, no column of voltages is searched for.

    Args:
        format: format of the file, with the lines of its names and numbers.
        given: columns named by the user, keyed by channel; those in other files are not part of the
            layout.
        options: properties of the log that the file does not tell.
        texts: columns of text, which are no channels.
        zeros: columns that are zero in every row, which a known tool writes for what it lacks.

    Raises:
        DataError: a given column is absent, or there is no column for the time, the speed, or both
            voltage and current; or the speed is electrical, and no pole pairs are given.
    """
    names = _names(format)
    for name in sorted(options.ignored.difference(names)):
        found = f"no column '{name}' to ignore{did_you_mean(name, names)}"
        raise bad_data(format.path, found, f"one of {', '.join(names)}")
    own = {c: one for c, one in given.items() if one.file is None}
    channels = given_channels(format, own)
    stamp = stamp_columns(format.names)
    if stamp and "time" not in channels:
        channels["time"] = Channel(tuple(format.names[at] for at in stamp), "s")
    taken = {column for one in channels.values() for column in one.columns}
    units = dict(zip(format.names, format.units, strict=True))
    sought = [name for name in names if name not in options.ignored | texts]
    replaced = {c for c, instead in _INSTEAD.items() if instead & given.keys()}
    replaced |= {"voltage"} if "bus_voltage" in given else set()
    free = {n: m for n, m in _meanings(sought, units, zeros, replaced).items() if n not in taken}
    known = {*given, *channels} - ({"time"} - channels.keys())  # each file has its own time
    # With a given bus voltage, a duty cycle is meant if there is one.
    order = ("duty", *_CHANNELS) if "bus_voltage" in given else _CHANNELS
    for channel in order:
        columns = _called(channel, free)
        if columns and not {channel, *_INSTEAD.get(channel, ())} & known:
            unit = free[columns[0]].unit or None
            channels[channel] = _channel(channel, GivenColumns(columns, unit), format)
            known.add(channel)
    if "duty" in given and "bus_voltage" not in known:
        found = "a duty cycle, but no column for the bus voltage"
        raise bad_data(format.path, found, f"--bus with its name; the file has {', '.join(names)}")
    if "voltage" not in known and not {"duty", "bus_voltage"} <= known:
        channels = {k: v for k, v in channels.items() if k not in ("duty", "bus_voltage")}
        known -= {"duty", "bus_voltage"}
    _check_whole(format.path, known, channels, names)
    return layout_of(format, of_shaft(format.path, channels, options), options)


def layout_of(
    format: TableFormat, channels: Mapping[str, Channel], options: MotorOptions
) -> Layout:
    """Return the layout of a file with these channels."""
    return Layout(
        channels=channels,
        delimiter=format.delimiter or ",",
        names_row=format.names_row,
        first_data_row=format.first_data_row,
        gear_ratio=SHAFT_GEAR_RATIO,
        current_is_signed=options.signed,
        drop_repeated_time=True,
    )


def given_channels(format: TableFormat, given: Mapping[str, GivenColumns]) -> dict[str, Channel]:
    """Return the channels whose columns the user named; a name may lack the unit in its brackets.

    Raises:
        DataError: a column is absent, or its unit is unknown.
    """
    names, channels = _names(format), {}
    for channel, one in given.items():
        columns = []
        for name in one.columns:
            near = [n for n in names if without_unit(n)[0] == name]
            if name not in names and len(near) != 1:
                bare, _, unit = name.rpartition(":")
                if bare in {*names, *(without_unit(n)[0] for n in names)}:
                    found = f"no unit '{unit}' of a channel in {CHANNELS.get(channel, 's')}"
                    expected = "one of `slipid reference units`, or none"
                    raise bad_data(format.path, found, expected, column=bare)
                found = f"no column '{name}'{did_you_mean(name, names)}"
                raise bad_data(format.path, found, f"one of {', '.join(names)}")
            columns.append(name if name in names else near[0])
        channels[channel] = _channel(channel, replace(one, columns=tuple(columns)), format)
    return channels


def time_channel(format: TableFormat) -> Channel:
    """Return the time of a file by the names of its columns; raise `DataError` if none is one."""
    names = _names(format)
    if stamp := stamp_columns(format.names):
        return Channel(tuple(format.names[at] for at in stamp), "s")
    units = dict(zip(format.names, format.units, strict=True))
    if columns := _called("time", _meanings(names, units)):
        return _channel("time", GivenColumns(columns, None), format)
    found = f"no column for the time among {', '.join(names)}"
    raise bad_data(format.path, found, "a column whose name means a time, such as t or time")


def of_shaft(
    path: Path, channels: Mapping[str, Channel], options: MotorOptions
) -> dict[str, Channel]:
    """Return the channels with speeds and angles of the motor's shaft.

    Raises:
        DataError: the speed is electrical, and no pole pairs are given.
    """
    out = dict(channels)
    for channel in {"motor_speed", "motor_angle"} & out.keys():
        one, ratio = out[channel], options.gear_ratio
        electrical = [str(column) for column in one.columns if is_electrical(str(column))]
        if electrical and options.pole_pairs is None:
            found = f"column '{electrical[0]}' has the electrical speed, the shaft's times pole"
            expected = (
                "--pole-pairs with their number: half the number of magnets on the rotor, such as "
                "7 for 14 magnets"
            )
            raise bad_data(path, f"{found} pairs", expected)
        if channel == "motor_speed":
            ratio /= options.pole_pairs or 1.0
        out[channel] = replace(one, scale=tuple(ratio * scale for scale in one.scale))
    return out


def _names(format: TableFormat) -> list[str]:
    """Return the names of the columns that have one; raise `DataError` if none has."""
    names = [name for name in format.names if name]
    if not names:
        found = f"no names for {len(format.names)} columns"
        expected = "a line of column names above the numbers"
        raise bad_data(format.path, found, expected, row=format.first_data_row)
    return names


def _meanings(
    names: list[str],
    units: Mapping[str, str],
    zeros: frozenset[str] = frozenset(),
    replaced: Set[str] = frozenset(),
) -> dict[str, ColumnMeaning]:
    """Return the meanings of columns: those of a known tool, or else those of their words.

    A tool is not known by columns of zeros, or by channels that the user replaced. A column of time
    is searched for by words if the tool has none of its own.
    """
    words = {name: meaning_of(name, units[name], of_motor=True) for name in names}
    tool = tool_meanings([name for name in names if name not in zeros], replaced)
    if not tool:
        return words
    if all(one.channel != "time" for one in tool.values()):
        tool |= {name: one for name, one in words.items() if one.channel == "time"}
    # The units that a file declares are better known than those that a tool usually has.
    return {n: replace(one, unit=unit_in(units[n]) or one.unit) for n, one in tool.items()}


def _called(channel: str, meanings: Mapping[str, ColumnMeaning]) -> tuple[str, ...]:
    """Return the columns whose names denote a channel; only the first for time and bus voltage.

    Columns whose meaning the user must confirm (`ColumnMeaning.doubt`), and columns without the
    number of a motor, are used only if there are no others.
    """
    found = {name: one for name, one in meanings.items() if one.channel == channel}
    names = [name for name, one in found.items() if not one.doubt] or list(found)
    names = [name for name in names if found[name].label] or names
    return tuple(names[:1] if channel in ("time", "bus_voltage") else names)


def _channel(channel: str, given: GivenColumns, format: TableFormat) -> Channel:
    """Return a channel from its columns.

    The unit is the given one, else the unit in the column's name or in the row of units, else the
    channel's SI unit.

    Raises:
        DataError: the unit in brackets or in the row of units is not one of the channel.
    """
    usual, name = CHANNELS.get(channel, "s"), given.columns[0]
    row = format.units[format.names.index(name)]
    suffix = without_unit(name)[1]
    own = (given.unit, meaning_of(name, row, of_motor=True).unit, unit_in(row), suffix)
    known = next((one for one in own if one and converts(one, usual)), None)
    declared = unit_in(row) or (suffix if name.endswith((")", "]")) else "")
    if known is None and channel != PULSES and is_unit(declared):
        found = f"the unit '{declared}' of the {channel.removeprefix('motor_')}"
        expected = f"a unit that converts to {usual}; if it is another, add it: '{name}:UNIT'"
        raise bad_data(format.path, found, expected, column=name)
    return Channel(given.columns, known or usual, (given.scale,))


def _check_whole(
    path: Path, known: set[str], channels: Mapping[str, Channel], names: list[str]
) -> None:
    """Raise `DataError` if a required channel is missing, or channels differ in number of motors.

    Args:
        path: path of the main file.
        known: channels that are known, including those in other files.
        channels: channels of the main file.
        names: columns of the main file, for the message.
    """
    have = f"the file has {', '.join(names)}"
    if "time" not in channels:
        raise bad_data(path, "no column for the time", f"--time with its name; {have}")
    for wanted, option in (
        (("motor_speed", "motor_angle", PULSES), "--speed or --angle"),
        (("current", "voltage", "duty"), "--current or --voltage"),
    ):
        if not {*wanted} & known:
            what = "speed or angle" if PULSES in wanted else "current or voltage"
            raise bad_data(path, f"no column for the {what}", f"{option} with its name; {have}")
    count = {k: len(c.columns) for k, c in channels.items() if k not in ("time", "bus_voltage")}
    if len({*count.values()}) > 1:
        listed = ", ".join(f"{k} {', '.join(map(str, channels[k].columns))}" for k in count)
        raise DataError(
            f"{path}: columns for different numbers of motors ({listed}); expected the same number "
            "for every channel: name the columns of each channel by options, or --ignore some"
        )
