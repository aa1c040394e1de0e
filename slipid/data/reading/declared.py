"""Layouts that a config declares as a table, checked key by key."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

from slipid.data.reading.layout import (
    CHANNELS,
    NEW_RUN,
    PER_WHEEL,
    SINGLE,
    Channel,
    Layout,
    unknown,
)
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.units import converts, factor
from slipid.support.errors import DataError

T = TypeVar("T")


def declared_layout(table: Mapping[str, object], where: str) -> Layout:
    """Layout declared in a config: `format` names a preset, the rest overrides it.

    `columns` maps each channel to `{columns = [...] or column = ..., unit, scale, offset}`; `false`
    takes a channel of the preset away.

    Args:
        table: the layout's section, as TOML gives it.
        where: what messages call the section, such as `robotino.toml [layout]`.

    Raises:
        DataError: unknown key, channel, unit or format, wrong dimension, wrong type.
    """
    given = dict(table)
    name = given.pop("format", None)
    if name is None:
        base = Layout(name=where, channels={})
    elif isinstance(name, str) and name in PRESETS:
        base = PRESETS[name]
    else:
        raise DataError(f"{where}: {unknown('format', name, PRESETS)}")
    columns = _expect(given.pop("columns", {}), dict, f"{where} columns", "a table")
    channels = dict(base.channels)
    for channel, spec in columns.items():
        if spec is False:
            channels.pop(channel, None)
        else:
            channels[channel] = _channel(channel, spec, f"{where} columns.{channel}")
    if not channels:
        raise DataError(
            f"{where}: no columns; expected a table of channels ({', '.join(CHANNELS)})"
        )
    return _checked(replace(base, channels=channels, **_settings(given, where)), where)


def _channel(channel: str, spec: object, where: str) -> Channel:
    if channel not in CHANNELS:
        raise DataError(f"{where}: {unknown('channel', channel, CHANNELS)}")
    given = dict(_expect(spec, dict, where, "{columns = [...], unit = ...}"))
    columns = given.pop("columns", None)
    columns = [given.pop("column")] if columns is None and "column" in given else columns
    listed = _listed(columns, where, "column = name, or columns = [names]")
    named = [_column(column, where) for column in listed]
    if not named or (channel in SINGLE and len(named) != 1):
        wanted = "one column" if channel in SINGLE else "one column per wheel"
        raise DataError(f"{where}: {len(named)} columns; expected {wanted}")
    unit = _expect(
        given.pop("unit", None), str, where, f"a unit that converts to {CHANNELS[channel]}"
    )
    if not (channel in ("pose_x", "pose_y") and converts(unit, "pixel")):
        try:
            factor(unit, CHANNELS[channel])
        except ValueError as error:
            raise DataError(f"{where}: {error}") from error
    scale = given.pop("scale", 1.0)
    scales = scale if isinstance(scale, (list, tuple)) else [scale] * len(named)
    numbers = [
        _number(value, where, "numbers for scale and offset")
        for value in (*scales, given.pop("offset", 0.0))
    ]
    if len(scales) != len(named):
        raise DataError(f"{where}: {len(scales)} scales for {len(named)} columns; expected as many")
    if given:
        choices = ("columns", "column", "unit", "scale", "offset")
        raise DataError(f"{where}: {unknown('key', next(iter(given)), choices)}")
    return Channel(tuple(named), unit, tuple(numbers[:-1]), numbers[-1])


_TYPES: dict[str, tuple[type, str]] = {
    "delimiter": (str, "one character"),
    "new_run": (str, f"one of {', '.join(NEW_RUN)}"),
    **dict.fromkeys(
        ("ticks_are_increments", "current_is_signed", "drop_repeated_time"), (bool, "true or false")
    ),
    **dict.fromkeys(
        ("names_row", "units_row", "first_data_row", "tick_bits"), (int, "a whole number")
    ),
}


def _settings(given: Mapping[str, object], where: str) -> dict[str, Any]:
    """Fields of a layout other than its channels, each of the type that it has there."""
    known = [f.name for f in fields(Layout) if f.name not in ("name", "channels")]
    settings: dict[str, Any] = {}
    for key, value in given.items():
        if key not in known:
            raise DataError(f"{where}: {unknown('key', key, ['format', 'columns', *known])}")
        if key == "metres_per_pixel":
            settings[key] = _pair(value, f"{where} {key}")
        elif key in _TYPES:
            kind, wording = _TYPES[key]
            settings[key] = _expect(value, kind, f"{where} {key}", wording)
        else:
            settings[key] = _number(value, f"{where} {key}", "a number")
    return settings


def _pair(value: object, where: str) -> tuple[float, float]:
    """Scales of a camera along x and y; one number counts for both."""
    both = value if isinstance(value, (list, tuple)) else (value, value)
    numbers = [_number(v, where, "a number of metres, or two") for v in both]
    if len(numbers) != 2 or min(numbers) <= 0:
        raise DataError(f"{where}: {value}; expected one or two numbers above 0")
    return numbers[0], numbers[1]


_ABOVE_ZERO = (
    "row_period",
    "ticks_per_revolution",
    "gear_ratio",
    "max_gap",
    "max_pose_jump",
    "max_heading_jump",
)


def _checked(layout: Layout, where: str) -> Layout:
    """The layout, if its parts belong together."""
    have = layout.channels
    problem = None
    counts = {name: len(c.columns) for name, c in have.items() if name in PER_WHEEL}
    if "time" not in have and layout.row_period is None:
        problem = "no time column; expected a channel 'time', or row_period in seconds"
    elif "wheel_ticks" in have and layout.ticks_per_revolution is None:
        problem = "wheel_ticks without ticks_per_revolution; expected ticks per turn of the motor"
    elif len(set(counts.values())) > 1:
        problem = f"channels disagree on the number of wheels: {counts}; expected the same of each"
    elif 0 < len({"pose_x", "pose_y", "pose_heading"} & set(have)) < 3:
        problem = "a pose in parts; expected pose_x, pose_y and pose_heading, or none of them"
    elif len(layout.delimiter) != 1:
        problem = f"delimiter {layout.delimiter!r}; expected one character"
    elif layout.new_run not in NEW_RUN:
        problem = unknown("new_run", layout.new_run, NEW_RUN)
    elif layout.first_data_row <= max(layout.names_row, layout.units_row):
        problem = f"first_data_row {layout.first_data_row}; expected it below names and units"
    elif not layout.names_row and any(isinstance(c, str) for c in layout.columns):
        problem = "columns by name, but names_row is 0; expected positions from 0"
    for key in _ABOVE_ZERO:
        value = getattr(layout, key)
        if value is not None and not value > 0:
            problem = f"{key} = {value}; expected a number above 0"
    if problem is None:
        try:
            for channel in have:
                layout.to_si(channel)
        except ValueError as error:
            problem = str(error)
    if problem is not None:
        raise DataError(f"{where}: {problem}")
    return layout


def _expect(value: object, kind: type[T], where: str, wording: str) -> T:
    """The value, if it is of a kind; true and false are no numbers."""
    wrong_bool = isinstance(value, bool) and kind is not bool
    if wrong_bool or not isinstance(value, kind):
        raise DataError(f"{where}: {value!r}; expected {wording}")
    return value


def _number(value: object, where: str, wording: str) -> float:
    if isinstance(value, float):
        return value
    return float(_expect(value, int, where, wording))


def _column(value: object, where: str) -> str | int:
    if isinstance(value, str):
        return value
    return _expect(value, int, where, "columns by name, or by position from 0")


def _listed(value: object, where: str, wording: str) -> Sequence[object]:
    if not isinstance(value, (list, tuple)):
        raise DataError(f"{where}: {value!r}; expected {wording}")
    return value
