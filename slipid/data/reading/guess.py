"""Columns of a log of a motor that nobody described: guessed by name, or named by a person."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from slipid.data.reading.layout import CHANNELS, Channel, Layout
from slipid.data.reading.units import converts
from slipid.support.errors import DataError, bad_data, near

SHAFT = 10.0
"""Times by which a motor's shaft may turn faster than any wheel, whose speed the reader checks."""
WORDS = {
    "time": ("t", "time", "timestamp", "stamp", "seconds"),
    "voltage": ("u", "v", "voltage", "volt", "volts", "umotor", "vmotor"),
    "current": ("i", "current", "amp", "amps", "ampere", "imotor", "cur"),
    "motor_speed": ("w", "omega", "speed", "rpm", "velocity", "vel"),
    "motor_angle": ("angle", "theta", "position", "pos"),
    "duty": ("duty", "pwm"),
    "bus_voltage": ("bus", "vbus", "ubus", "battery", "supply"),
}
"""Words in the names of columns, by channel."""
_NOT = {"set", "setpoint", "reference", "ref", "command", "cmd", "target", "wanted", "error"}
_UNITS = {
    **{u: u for u in ("s", "ms", "us", "rpm", "rad", "deg", "rad/s", "deg/s", "rev/s", "%")},
    **{"ma": "mA", "a": "A", "mv": "mV", "v": "V", "rads": "rad/s", "percent": "%"},
}


@dataclass(frozen=True)
class Named:
    """Columns of a channel as a person named them, and their unit; None for the usual one."""

    columns: tuple[str, ...]
    unit: str | None


@dataclass(frozen=True)
class Header:
    """Names of the columns and their units ("" where none is written), and where both stand.

    Lines are counted from 1; a line of units may be above the names or below them.
    """

    columns: tuple[str, ...]
    units: tuple[str, ...]
    delimiter: str
    names_row: int
    first_data_row: int


def named(text: str, channel: str) -> Named:
    """`NAME`, `NAME:UNIT`, or several names by commas for several motors."""
    names, colon, unit = text.rpartition(":")
    if colon and converts(unit, CHANNELS[channel]):
        return Named(tuple(n.strip() for n in names.split(",")), unit)
    return Named(tuple(n.strip() for n in text.split(",")), None)


def header_of(path: Path, delimiter: str | None) -> Header:
    """Where names and numbers are in a text file; DataError where there are none."""
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()[:40]
    except OSError as error:
        raise bad_data(path, f"cannot be read ({error.strerror})", "a log, a CSV file") from error
    for k, line in enumerate(lines):
        between = delimiter or max(";\t|,", key=line.count)
        if line.count(between) and _numbers(cells := _cells(line, between)):
            above = [_cells(lines[j], between) for j in (k - 1, k - 2) if j >= 0]
            names, other = [*above, [], []][:2]
            row, units = k, other if _are_units(other) else []
            if _are_units(names):
                names, units, row = other, names, k - 1
            if k == 0 or len(names) < len([c for c in cells if c]):
                found = f"no names for {len(cells)} columns"
                raise bad_data(path, found, "a line of column names above the numbers", row=k + 1)
            known = tuple(n for n in names if n)
            return Header(known, (*units, *[""] * len(known))[: len(known)], between, row, k + 1)
    raise bad_data(path, "no row of numbers", "a CSV file with column names and rows of numbers")


def _are_units(cells: list[str]) -> bool:
    """Whether most cells of a line are units."""
    known = [c.lower() in _UNITS for c in cells if c]
    return sum(known) > len(known) / 2


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip().strip("\"'").strip() for cell in line.split(delimiter)]


def _numbers(cells: list[str]) -> bool:
    """Whether a line is of numbers, some perhaps missing."""
    known = [c for c in cells if c.lower() not in ("", "nan", "na", "null", "none")]
    return bool(known) and all(re.fullmatch(r"[+-]?[\d.]+([eE][+-]?\d+)?", c) for c in known)


def layout_of(path: Path, given: Mapping[str, Named], header: Header, signed: bool) -> Layout:
    """Layout of a log of motors: what was named, and a guess for the rest.

    Raises:
        DataError: a column is not there, or none was found for time, current or speed.
    """
    channels = {}
    for channel, wish in given.items():
        for name in wish.columns:
            if name not in header.columns:
                found = f"no column '{name}'{near(name, header.columns)}"
                raise bad_data(path, found, f"one of {', '.join(header.columns)}")
        unit = wish.unit or _unit(wish.columns[0], channel, header)
        channels[channel] = Channel(wish.columns, unit)
    taken = {c for channel in channels.values() for c in channel.columns}
    for channel in WORDS:
        other = {"motor_speed": "motor_angle", "motor_angle": "motor_speed"}.get(channel)
        more = channel in ("duty", "bus_voltage") and "voltage" in channels
        found_columns = _guessed(channel, [c for c in header.columns if c not in taken])
        if channel in channels or other in channels or more or not found_columns:
            continue
        channels[channel] = Channel(found_columns, _unit(found_columns[0], channel, header))
        taken |= {*found_columns}
    if "voltage" not in channels and not {"duty", "bus_voltage"} <= channels.keys():
        channels = {k: v for k, v in channels.items() if k not in ("duty", "bus_voltage")}
    _whole(path, channels, header)
    return Layout(
        name="motor",
        channels=channels,
        delimiter=header.delimiter,
        names_row=header.names_row,
        first_data_row=header.first_data_row,
        gear_ratio=SHAFT,
        current_is_signed=signed,
        drop_repeated_time=True,
    )


def _whole(path: Path, channels: Mapping[str, Channel], header: Header) -> None:
    """DataError where something is missing, or motors differ in number."""
    have = f"it has {', '.join(header.columns)}"
    for names, option in (
        (("time",), "--time"),
        (("current",), "--current"),
        (("motor_speed", "motor_angle"), "--speed or --angle"),
    ):
        if not {*names} & channels.keys():
            what = " or ".join(n.removeprefix("motor_") for n in names)
            raise bad_data(path, f"no column for the {what}", f"{option} with its name; {have}")
    count = {k: len(c.columns) for k, c in channels.items() if k not in ("time", "bus_voltage")}
    if len({*count.values()}) > 1:
        said = ", ".join(f"{k} {', '.join(map(str, channels[k].columns))}" for k in count)
        raise DataError(f"{path}: columns for different numbers of motors ({said}); name them")


def _guessed(channel: str, columns: list[str]) -> tuple[str, ...]:
    """Columns that have a word of the channel in their name, one where a channel has one."""
    found = []
    for name in columns:
        words = _words(name)
        hits = [w for w in words if w in WORDS[channel] and (len(w) > 1 or w == words[0])]
        # a letter alone may be a unit: of a name with more words it counts in the first place only
        if hits and not {*words} & _NOT and not _meant_otherwise(channel, words):
            found.append(name)
    return tuple(found[:1] if channel in ("time", "bus_voltage") else found)


def _meant_otherwise(channel: str, words: list[str]) -> bool:
    """A bus voltage is none of the motor; a time of something else no clock."""
    return channel == "voltage" and bool({*words} & {*WORDS["bus_voltage"]})


def _words(name: str) -> list[str]:
    """Words of a name; numbers only count motors."""
    return [w for w in re.split(r"[^a-z%/]+", name.lower()) if w]


def _unit(name: str, channel: str, header: Header) -> str:
    """Unit that is written for a column, or stands in its name, else the usual one."""
    usual = CHANNELS[channel]
    written = header.units[header.columns.index(name)]
    if written and converts(written, usual):
        return written
    for word in reversed(_words(name)[1:] + [w for w in _words(name) if w == "rpm"]):
        unit = _UNITS.get(word)
        if unit is not None and converts(unit, usual):
            return unit
    return usual
