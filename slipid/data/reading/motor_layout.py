"""Layout of a log of motors on a bench, from columns named by the user or found by their names."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from slipid.data.reading.column_names import (
    ColumnMeaning,
    is_electrical,
    meaning_of,
    stamp_columns,
    unit_in,
    without_unit,
)
from slipid.data.reading.layout import CHANNELS, Channel, Layout
from slipid.data.reading.table_format import TableFormat
from slipid.data.reading.units import converts
from slipid.support.errors import DataError, bad_data, did_you_mean

SHAFT_GEAR_RATIO = 10.0
"""Fictitious gear ratio of the layout, with which the checks allow a motor shaft to turn ten times
faster than a wheel."""
_CHANNELS = ("time", "voltage", "current", "motor_speed", "motor_angle", "duty", "bus_voltage")
_INSTEAD = {"motor_speed": "motor_angle", "motor_angle": "motor_speed"}
"""Alternative channels: a channel is not searched for if its alternative is given."""


@dataclass(frozen=True)
class GivenColumns:
    """Columns of a channel, named by the user, and their unit; None for the channel's SI unit."""

    columns: tuple[str, ...]
    unit: str | None


def given_columns(text: str, channel: str) -> GivenColumns:
    """Return the columns of a channel from an option's text: `NAME` or `NAME:UNIT`.

    For several motors, several names are separated by commas.
    """
    names, colon, unit = text.rpartition(":")
    if colon and converts(unit, CHANNELS[channel]):
        return GivenColumns(tuple(n.strip() for n in names.split(",")), unit)
    return GivenColumns(tuple(n.strip() for n in text.split(",")), None)


def motor_layout(
    format: TableFormat,
    given: Mapping[str, GivenColumns],
    signed: bool,
    pole_pairs: float | None = None,
) -> Layout:
    """Return the layout of a log of motors.

    For channels without given columns, columns are found by their names.

    Args:
        format: format of the file, with the lines of its names and numbers.
        given: columns named by the user, keyed by channel.
        signed: True if currents have a sign.
        pole_pairs: pole pairs of the motor, by which an electrical speed is divided; None if the
            speed is that of the shaft.

    Raises:
        DataError: a given column is absent, or there is no column for time, current or speed; or
            the speed is electrical, and no pole pairs are given.
    """
    names = [name for name in format.names if name]
    if not names:
        found = f"no names for {len(format.names)} columns"
        expected = "a line of column names above the numbers"
        raise bad_data(format.path, found, expected, row=format.first_data_row)
    meanings = {
        name: meaning_of(name, unit, of_motor=True)
        for name, unit in zip(format.names, format.units, strict=True)
        if name
    }
    channels = {}
    for channel, one in given.items():
        for name in one.columns:
            if name not in names:
                found = f"no column '{name}'{did_you_mean(name, names)}"
                raise bad_data(format.path, found, f"one of {', '.join(names)}")
        channels[channel] = _channel(channel, one.columns, format, one.unit)
    stamp = stamp_columns(format.names)
    if stamp and "time" not in channels:
        channels["time"] = Channel(tuple(format.names[at] for at in stamp), "s")
    taken = {column for one in channels.values() for column in one.columns}
    for channel in _CHANNELS:
        more = channel in ("duty", "bus_voltage") and "voltage" in channels
        columns = _called(channel, {n: m for n, m in meanings.items() if n not in taken})
        if columns and not more and not {channel, _INSTEAD.get(channel)} & channels.keys():
            channels[channel] = _channel(channel, columns, format)
    if "voltage" not in channels and not {"duty", "bus_voltage"} <= channels.keys():
        channels = {k: v for k, v in channels.items() if k not in ("duty", "bus_voltage")}
    _check_whole(format.path, channels, names)
    if (speed := channels.get("motor_speed")) is not None:
        channels["motor_speed"] = _of_shaft(format.path, speed, pole_pairs)
    return Layout(
        channels=channels,
        delimiter=format.delimiter or ",",
        names_row=format.names_row,
        first_data_row=format.first_data_row,
        gear_ratio=SHAFT_GEAR_RATIO,
        current_is_signed=signed,
        drop_repeated_time=True,
    )


def _called(channel: str, meanings: Mapping[str, ColumnMeaning]) -> tuple[str, ...]:
    """Return the columns whose names denote a channel; only the first for time and bus voltage.

    Columns whose meaning the user must confirm (`ColumnMeaning.doubt`), and columns without the
    number of a motor, are used only if there are no others.
    """
    found = {name: one for name, one in meanings.items() if one.channel == channel}
    names = [name for name, one in found.items() if not one.doubt] or list(found)
    names = [name for name in names if found[name].label] or names
    return tuple(names[:1] if channel in ("time", "bus_voltage") else names)


def _channel(
    channel: str, columns: tuple[str, ...], format: TableFormat, unit: str | None = None
) -> Channel:
    """Return a channel from its columns.

    The unit is the argument `unit` if it is given, else the unit in the column's name or in the row
    of units, else the channel's SI unit.
    """
    usual, name = CHANNELS[channel], columns[0]
    row = format.units[format.names.index(name)]
    own = (meaning_of(name, row, of_motor=True).unit, unit_in(row), without_unit(name)[1])
    known = (one for one in own if one and converts(one, usual))
    return Channel(columns, unit or next(known, usual))


def _of_shaft(path: Path, speed: Channel, pole_pairs: float | None) -> Channel:
    """Return the speed of the shaft; raise `DataError` if it is electrical without pole pairs."""
    electrical = [str(column) for column in speed.columns if is_electrical(str(column))]
    if electrical and pole_pairs is None:
        found = f"column '{electrical[0]}' has the electrical speed, the shaft's times pole pairs"
        expected = (
            "--pole-pairs with their number: half the number of magnets on the rotor, such as 7 "
            "for 14 magnets"
        )
        raise bad_data(path, found, expected)
    return replace(speed, scale=(1.0 / (pole_pairs or 1.0),))


def _check_whole(path: Path, channels: Mapping[str, Channel], names: list[str]) -> None:
    """Raise `DataError` if a required channel is missing, or channels differ in number of motors.

    `names` are the columns of the file, for the message.
    """
    have = f"the file has {', '.join(names)}"
    for wanted, option in (
        (("time",), "--time"),
        (("current",), "--current"),
        (("motor_speed", "motor_angle"), "--speed or --angle"),
    ):
        if not {*wanted} & channels.keys():
            what = " or ".join(n.removeprefix("motor_") for n in wanted)
            if wanted == ("current",) and "voltage" in channels:
                found = (
                    "no column for the current: voltage and speed alone tell kS, kV and kA (the "
                    "voltages for friction, speed and acceleration), which slipid does not fit yet"
                )
                expected = f"--current with the column of the motor's current; {have}"
                raise bad_data(path, found, expected)
            raise bad_data(path, f"no column for the {what}", f"{option} with its name; {have}")
    count = {k: len(c.columns) for k, c in channels.items() if k not in ("time", "bus_voltage")}
    if len({*count.values()}) > 1:
        listed = ", ".join(f"{k} {', '.join(map(str, channels[k].columns))}" for k in count)
        raise DataError(
            f"{path}: columns for different numbers of motors ({listed}); expected the same number "
            "for every channel: name the columns of each channel by options"
        )
