"""Layouts that a config declares as a table, checked key by key."""

from collections.abc import Mapping
from dataclasses import fields, replace

from slipid.data.reading.layout import CHANNELS, PER_WHEEL, SINGLE, Channel, Layout, unknown
from slipid.data.reading.presets import PRESETS
from slipid.support.errors import DataError
from slipid.support.toml_file import checked

_SETTINGS = [f.name for f in fields(Layout) if f.name not in ("name", "channels")]


def declared_layout(table: Mapping[str, object], where: str) -> Layout:
    """Layout declared in a config: `format` names a preset, the rest overrides it.

    `columns` maps each channel to `{columns = [...] or column = ..., unit, scale, offset}`; `false`
    takes a channel of the preset away.

    Messages call the section `where`, such as `robotino.toml [layout]`.

    Raises:
        DataError: unknown key, channel, unit or format, wrong dimension, wrong type.
    """
    given = dict(table)
    name, columns = given.pop("format", None), given.pop("columns", {})
    if name is not None and name not in PRESETS:
        raise DataError(f"{where}: {unknown('format', name, PRESETS)}")
    for key in given:
        if key not in _SETTINGS:
            raise DataError(f"{where}: {unknown('key', key, ['format', 'columns', *_SETTINGS])}")
    if not isinstance(columns, dict):
        raise DataError(f"{where} columns: {columns!r}; expected a table")
    base = Layout(where, {}) if name is None else PRESETS[str(name)]
    channels = dict(base.channels)
    for channel, spec in columns.items():
        if channel not in CHANNELS:
            raise DataError(f"{where} columns.{channel}: {unknown('channel', channel, CHANNELS)}")
        channels.pop(channel, None)
        if spec is not False:
            channels[channel] = checked(f"{where} columns.{channel}", spec, Channel)
    layout = replace(checked(where, {**vars(base), **given}, Layout), channels=channels)
    if problem := _problem(layout):
        raise DataError(f"{where}: {problem}")
    for channel in channels:
        try:
            layout.to_si(channel)
        except ValueError as error:
            raise DataError(f"{where} columns.{channel}: {error}") from error
    return layout


def _problem(layout: Layout) -> str | None:
    """What does not belong together."""
    have = layout.channels
    counts = {name: len(c.columns) for name, c in have.items() if name in PER_WHEEL}
    single = {name: len(c.columns) for name, c in have.items() if name in SINGLE}
    if not have:
        return f"no columns; expected a table of channels ({', '.join(CHANNELS)})"
    if "time" not in have and layout.row_period is None:
        return "no time column; expected a channel 'time', or row_period in seconds"
    if "wheel_ticks" in have and layout.ticks_per_revolution is None:
        return "wheel_ticks without ticks_per_revolution; expected ticks per turn of the motor"
    if len(set(counts.values())) > 1:
        return f"channels disagree on the number of wheels: {counts}; expected the same of each"
    if many := [name for name, count in single.items() if count != 1]:
        return f"columns.{many[0]}: {single[many[0]]} columns; expected one column"
    if 0 < len({"pose_x", "pose_y", "pose_heading"} & set(have)) < 3:
        return "a pose in parts; expected pose_x, pose_y and pose_heading, or none of them"
    if layout.first_data_row <= max(layout.names_row, layout.units_row):
        return f"first_data_row {layout.first_data_row}; expected it below names and units"
    if not layout.names_row and any(isinstance(c, str) for c in layout.columns):
        return "columns by name, but names_row is 0; expected positions from 0"
    return None
