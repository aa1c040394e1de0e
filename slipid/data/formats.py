"""Layouts from presets and from configs: the same tables, checked the same way."""

from collections.abc import Mapping
from dataclasses import fields
from difflib import get_close_matches
from typing import Any

from slipid.data.layout import CHANNELS, NEW_RUN, PER_WHEEL, SINGLE, Channel, Layout
from slipid.data.log import DataError
from slipid.data.presets import PRESETS
from slipid.data.units import converts, factor

__all__ = ["CHANNELS", "PRESETS", "Channel", "Layout", "layout_from_mapping", "preset"]


def preset(name: str) -> Layout:
    """Layout of a known kind of log file.

    Raises:
        DataError: where there is no such preset; names the choices.
    """
    return layout_from_mapping({"format": name}, "preset")


def layout_from_mapping(mapping: Mapping[str, Any], where: str) -> Layout:
    """Layout declared in a config: `format` names a preset, the rest overrides it.

    `columns` maps each channel to `{columns = [...] or column = ..., unit, scale, offset}`; `false`
    takes a channel of the preset away.

    Args:
        mapping: as TOML gives it.
        where: what to call it in messages, such as `robotino.toml [layout]`.

    Raises:
        DataError: unknown key, channel, unit or format, wrong dimension, wrong type.
    """
    merged = dict(mapping)
    name = merged.pop("format", None)
    if name is not None:
        if name not in PRESETS:
            raise DataError(f"{where}: {_unknown('format', name, PRESETS)}")
        base = PRESETS[name]
        overrides = _expect(merged.get("columns", {}), Mapping, f"{where} columns", "a table")
        merged = {**base, **merged, "columns": {**base["columns"], **overrides}}
    declared = merged.pop("columns", None)
    if not isinstance(declared, Mapping) or not declared:
        raise DataError(f"{where}: no columns; expected a table of channels ({_names(CHANNELS)})")
    channels = {
        channel: _channel(channel, spec, f"{where} columns.{channel}")
        for channel, spec in declared.items()
        if spec is not False
    }
    settings = {"name": str(name or where), **_settings(merged, where)}
    return _checked(Layout(channels=channels, **settings), where)


def _channel(channel: str, spec: Any, where: str) -> Channel:
    if channel not in CHANNELS:
        raise DataError(f"{where}: {_unknown('channel', channel, CHANNELS)}")
    spec = dict(_expect(spec, Mapping, where, "{columns = [...], unit = ...}"))
    columns = spec.pop("columns", None)
    columns = [spec.pop("column")] if columns is None and "column" in spec else columns
    for column in _expect(columns, (list, tuple), where, "column = name, or columns = [names]"):
        _expect(column, (str, int), where, "columns by name, or by position from 0")
    if not columns or (channel in SINGLE and len(columns) != 1):
        wanted = "one column" if channel in SINGLE else "one column per wheel"
        raise DataError(f"{where}: {len(columns)} columns; expected {wanted}")
    unit = spec.pop("unit", None)
    _expect(unit, str, where, f"a unit that converts to {CHANNELS[channel]}")
    target = CHANNELS[channel]
    if not (channel in ("pose_x", "pose_y") and converts(unit, "pixel")):
        try:
            factor(unit, target)
        except ValueError as error:
            raise DataError(f"{where}: {error}") from error
    scale = spec.pop("scale", 1.0)
    scale = scale if isinstance(scale, (list, tuple)) else [scale] * len(columns)
    for value in (*scale, offset := spec.pop("offset", 0.0)):
        _expect(value, (int, float), where, "numbers for scale and offset")
    if len(scale) != len(columns):
        raise DataError(
            f"{where}: {len(scale)} scales for {len(columns)} columns; expected as many"
        )
    if spec:
        choices = ("columns", "column", "unit", "scale", "offset")
        raise DataError(f"{where}: {_unknown('key', next(iter(spec)), choices)}")
    return Channel(tuple(columns), unit, tuple(map(float, scale)), float(offset))


_TYPES: dict[str, tuple[Any, str]] = {
    "delimiter": (str, "one character"),
    "new_run": (str, f"one of {', '.join(NEW_RUN)}"),
    "ticks_are_increments": (bool, "true or false"),
    "current_is_signed": (bool, "true or false"),
    "drop_repeated_time": (bool, "true or false"),
    "metres_per_pixel": ((list, tuple, int, float), "a number of metres, or two"),
    **dict.fromkeys(
        ("names_row", "units_row", "first_data_row", "tick_bits"), (int, "a whole number")
    ),
}


def _settings(given: Mapping[str, Any], where: str) -> dict[str, Any]:
    known = [f.name for f in fields(Layout) if f.name not in ("name", "channels")]
    settings: dict[str, Any] = {}
    for key, value in given.items():
        if key not in known:
            raise DataError(f"{where}: {_unknown('key', key, ['format', 'columns', *known])}")
        kind, wording = _TYPES.get(key, ((int, float), "a number"))
        _expect(value, kind, f"{where} {key}", wording)
        settings[key] = value if key in _TYPES else float(value)
    scale = settings.get("metres_per_pixel")
    if scale is not None:
        pair = tuple(scale) if isinstance(scale, (list, tuple)) else (scale, scale)
        if len(pair) != 2 or not all(isinstance(v, (int, float)) and v > 0 for v in pair):
            raise DataError(
                f"{where} metres_per_pixel: {scale}; expected one or two numbers above 0"
            )
        settings["metres_per_pixel"] = (float(pair[0]), float(pair[1]))
    return settings


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
        problem = _unknown("new_run", layout.new_run, NEW_RUN)
    elif layout.first_data_row <= max(layout.names_row, layout.units_row):
        problem = f"first_data_row {layout.first_data_row}; expected it below names and units"
    elif not layout.names_row and any(isinstance(c, str) for c in layout.columns):
        problem = "columns by name, but names_row is 0; expected positions from 0"
    for key in (
        "row_period",
        "ticks_per_revolution",
        "gear_ratio",
        "max_gap",
        "max_pose_jump",
        "max_heading_jump",
    ):
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


def _expect(value: Any, kind: Any, where: str, wording: str) -> Any:
    wrong_bool = isinstance(value, bool) and kind is not bool
    if wrong_bool or not isinstance(value, kind):
        raise DataError(f"{where}: {value!r}; expected {wording}")
    return value


def _unknown(what: str, name: object, choices: Any) -> str:
    near = get_close_matches(str(name), list(choices), n=2)
    hint = f", did you mean {' or '.join(near)}?" if near else ""
    return f"no {what} '{name}'{hint}; expected one of {_names(choices)}"


def _names(choices: Any) -> str:
    return ", ".join(choices)
