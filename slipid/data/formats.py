"""Layouts of log files: which column holds which channel, in which unit."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches
from typing import Any

from slipid.data.log import DataError
from slipid.data.presets import PRESETS
from slipid.data.units import factor

PER_WHEEL = {
    "wheel_ticks": "tick",
    "wheel_angle": "rad",
    "motor_angle": "rad",
    "wheel_speed": "rad/s",
    "motor_speed": "rad/s",
    "wheel_speed_command": "rad/s",
    "motor_speed_command": "rad/s",
    "current": "A",
    "voltage": "V",
    "duty": "1",
}
SINGLE = {
    "time": "s",
    "twist_command_x": "m/s",
    "twist_command_y": "m/s",
    "twist_command_yaw": "rad/s",
    "bus_voltage": "V",
    "gyro": "rad/s",
    "pose_x": "m",
    "pose_y": "m",
    "pose_heading": "rad",
}
CHANNELS: dict[str, str] = {**SINGLE, **PER_WHEEL}
"""Every channel a layout may name, with the unit it is turned into."""

NEW_RUN = ("never", "time_restarts", "ticks_restart")


@dataclass(frozen=True)
class Channel:
    """Columns of one channel: value = (scale x cell + offset), in `unit`.

    Attributes:
        columns: names, one per wheel where the channel has one; positions from 0 in a file without
            names.
        unit: as written in the file; `pixel` is turned into metres by the layout.
        scale: one number per column; a sign or a correction.
        offset: in `unit`, added after the scale.
    """

    columns: tuple[str | int, ...]
    unit: str
    scale: tuple[float, ...]
    offset: float = 0.0


@dataclass(frozen=True)
class Layout:
    """How one kind of log file is laid out.

    Attributes:
        name: for messages.
        channels: what is in which columns.
        delimiter: between cells; not used for Parquet.
        names_row: line that holds the column names, counted from 1; 0 where there is none.
        units_row: line that holds the units, which are then checked; 0 where there is none.
        first_data_row: line the numbers start on.
        row_period: [s] between rows of a file without a time column.
        ticks_per_revolution: of the encoder, one turn of the *motor* shaft.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_are_increments: the cells hold the ticks since the last row.
        tick_bits: width of the counter; it wraps around there.
        current_is_signed: False where the cells are magnitudes.
        current_step: [A] of the analogue-to-digital converter, None where unknown.
        metres_per_pixel: of the camera along its x and y, [m].
        new_run: what tells that the next run starts inside the file.
        drop_repeated_time: of rows with the same time keep the last, instead of refusing them.
        max_gap: [s] between rows before it is called a clock jump.
        max_pose_jump: [m] between rows before it is called a marker swap.
        max_heading_jump: [rad] likewise.
    """

    name: str
    channels: Mapping[str, Channel]
    delimiter: str = ","
    names_row: int = 1
    units_row: int = 0
    first_data_row: int = 2
    row_period: float | None = None
    ticks_per_revolution: float | None = None
    gear_ratio: float = 1.0
    ticks_are_increments: bool = False
    tick_bits: int = 32
    current_is_signed: bool = True
    current_step: float | None = None
    metres_per_pixel: tuple[float, float] | None = None
    new_run: str = "never"
    drop_repeated_time: bool = False
    max_gap: float = 1.0
    max_pose_jump: float = 0.5
    max_heading_jump: float = 1.6

    @property
    def wheels(self) -> int:
        """Number of wheels, 0 where the file has poses only."""
        return next((len(c.columns) for n, c in self.channels.items() if n in PER_WHEEL), 0)

    @property
    def columns(self) -> tuple[str | int, ...]:
        """Every column the layout uses, each once."""
        used = (column for channel in self.channels.values() for column in channel.columns)
        return tuple(dict.fromkeys(used))

    def to_si(self, channel: str) -> float:
        """Factor from the channel's unit to that of `CHANNELS`; pixels by the camera's scale."""
        unit, target = self.channels[channel].unit, CHANNELS[channel]
        if channel in ("pose_x", "pose_y") and _converts(unit, "pixel"):
            if self.metres_per_pixel is None:
                raise ValueError(f"{channel} is in '{unit}', but metres_per_pixel is not given")
            scale = self.metres_per_pixel[0 if channel == "pose_x" else 1]
            return factor(unit, "pixel") * scale
        return factor(unit, target)


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
    if not (channel in ("pose_x", "pose_y") and _converts(unit, "pixel")):
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
        settings[key] = _expect(value, kind, f"{where} {key}", wording)
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


def _converts(unit: str, target: str) -> bool:
    try:
        factor(unit, target)
    except ValueError:
        return False
    return True


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
