"""Logs as files: slipid's own columns, and those of the published Robotino logs."""

from collections.abc import Collection
from typing import TypedDict

import numpy as np

from slipid.data.log import Log
from slipid.data.reading.layout import PER_WHEEL
from slipid.data.reading.presets import preset

OPTIONAL = {
    "voltage": ("V", "%.2f"),
    "duty": ("1", "%.3f"),
    "bus_voltage": ("V", "%.2f"),
    "gyro": ("rad/s", "%.5f"),
}
"""Channels that not every log has, with their unit and the format of their numbers."""
_IMAGE = (1920, 1080)


class ColumnTable(TypedDict, total=False):
    """Columns of one channel as a config declares them."""

    column: str
    columns: list[str]
    unit: str


class LayoutTable(TypedDict):
    """A layout as a config declares it."""

    ticks_per_revolution: int
    gear_ratio: float
    current_is_signed: bool
    columns: dict[str, ColumnTable]


def own_layout(
    wheels: int,
    gear_ratio: float,
    ticks_per_revolution: int,
    current_is_signed: bool = False,
    more: Collection[str] = ("voltage",),
) -> LayoutTable:
    """Layout of `own_csv`, as a config declares one.

    Args:
        wheels: number of wheels.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_per_revolution: ticks in one turn of the motor.
        current_is_signed: False where magnitudes are logged.
        more: channels beside ticks, current and pose: of voltage, duty, bus_voltage, gyro.
    """
    columns: dict[str, ColumnTable] = {
        "time": {"column": "time", "unit": "s"},
        "twist_command_x": {"column": "command_x", "unit": "m/s"},
        "twist_command_y": {"column": "command_y", "unit": "m/s"},
        "twist_command_yaw": {"column": "command_yaw", "unit": "rad/s"},
        "wheel_ticks": {"columns": _each("ticks", wheels), "unit": "tick"},
        "current": {"columns": _each("current", wheels), "unit": "A"},
    }
    for channel, (unit, _) in OPTIONAL.items():
        if channel in more:
            columns[channel] = (
                {"columns": _each(channel, wheels), "unit": unit}
                if channel in PER_WHEEL
                else {"column": channel, "unit": unit}
            )
    columns |= {
        "pose_x": {"column": "x", "unit": "mm"},
        "pose_y": {"column": "y", "unit": "mm"},
        "pose_heading": {"column": "heading", "unit": "deg"},
    }
    return {
        "ticks_per_revolution": ticks_per_revolution,
        "gear_ratio": gear_ratio,
        "current_is_signed": current_is_signed,
        "columns": columns,
    }


def own_csv(log: Log, gear_ratio: float, ticks_per_revolution: int) -> str:
    """Text of a log in slipid's own columns; `own_layout` reads it.

    Args:
        log: with commands, currents and poses; the `OPTIONAL` channels where it has them.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_per_revolution: ticks in one turn of the motor.
    """
    assert log.twist_command is not None
    assert log.current is not None
    assert log.pose is not None
    table = _Table()
    table.add(["time"], log.time[:, None], "%.4f")
    table.add(["command_x", "command_y", "command_yaw"], log.twist_command, "%.4f")
    table.add(_each("ticks", log.wheels), _ticks(log, gear_ratio, ticks_per_revolution), "%d")
    table.add(_each("current", log.wheels), log.current, "%.4f")
    for channel, (_, form) in OPTIONAL.items():
        values = getattr(log, channel)
        if values is not None and channel in PER_WHEEL:
            table.add(_each(channel, log.wheels), values, form)
        elif values is not None:
            table.add([channel], values[:, None], form)
    table.add(["x", "y"], 1000 * log.pose[:, :2], "%.3f")
    table.add(["heading"], np.degrees(log.pose[:, 2:]), "%.4f")
    return ",".join(table.names) + "\n" + table.rows(",", "\n")


_WORDS_2022 = (
    "Time;Robot speed set along x;Robot speed set along y;Robot rotation set;Motor 1 speed set;"
    "Motor 2 speed set;Motor 3 speed set;Motor 1 position;Motor 2 position;Motor 3 position;"
    "Motor 1 speed;Motor 2 speed;Motor 3 speed;Motor 1 current;Motor 2 current;Motor 3 current;"
    "Current along x;Current along y;Rotation current;Position x;Position y;Heading;"
    "Body step x;Body step y;Heading step;"
)
_UNITS_2022 = (
    "ms;m/s;m/s;rad/s;rad/s;rad/s;rad/s;ticks;ticks;ticks;rad/s;rad/s;rad/s;A;A;A;A;A;A;"
    "pix;pix;deg;mm;mm;deg;"
)
_NAMES_2022 = (
    "t;xsetspeed;ysetspeed;setvel;m1setvel;m2setvel;m3setvel;m1pos;m2pos;m3pos;m1vel;m2vel;m3vel;"
    "m1cur;m2cur;m3cur;xcur;ycur;rotcur;xpos;ypos;ang;dx;dy;dang;"
)


def robotino2022_csv(log: Log, gear_ratio: float, ticks_per_revolution: int) -> str:
    """Text of a log as the 2022 Robotino logs are laid out; the preset `robotino2022` reads it.

    The pose's origin is the middle of the image. Projected currents and steps are zeros.

    Args:
        log: a log of three wheels, with commands, speeds, currents and poses.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_per_revolution: ticks in one turn of the motor.
    """
    assert log.twist_command is not None
    assert log.wheel_speed is not None
    assert log.wheel_speed_command is not None
    assert log.current is not None
    assert log.pose is not None
    if log.wheels != 3:
        raise ValueError(f"{log.name}: {log.wheels} wheels; the 2022 layout has three")
    scale = preset("robotino2022").metres_per_pixel
    assert scale is not None
    x = 0.5 * _IMAGE[0] - log.pose[:, 0] / scale[0]
    y = 0.5 * _IMAGE[1] + log.pose[:, 1] / scale[1]
    heading = np.mod(np.degrees(log.pose[:, 2]) + 90.0, 360.0)
    nothing = np.zeros((log.samples, 3))
    table = _Table()
    table.add(["t"], 1000 * log.time[:, None], "%.4f")
    table.add(["x", "y", "turn"], log.twist_command, "%.6g")
    table.add(["speed set"] * 3, gear_ratio * log.wheel_speed_command, "%.6g")
    table.add(["position"] * 3, _ticks(log, gear_ratio, ticks_per_revolution), "%d")
    table.add(["speed"] * 3, gear_ratio * log.wheel_speed, "%.6g")
    table.add(["current"] * 3, log.current, "%.6g")
    table.add(["projected"] * 3, nothing, "%d")
    table.add(["pixels"] * 2, np.stack([x, y], axis=1), "%.3f")
    table.add(["heading"], heading[:, None], "%.4f")
    table.add(["step"] * 3, nothing, "%d")
    return "\n".join([_WORDS_2022, _UNITS_2022, _NAMES_2022]) + "\n" + table.rows(";", ";\n")


class _Table:
    """Columns and how each is written."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._columns: list[np.ndarray] = []
        self._forms: list[str] = []

    def add(self, names: list[str], values: np.ndarray, form: str) -> None:
        self.names += names
        self._columns.append(values)
        self._forms += [form] * len(names)

    def rows(self, delimiter: str, end: str) -> str:
        form = delimiter.join(self._forms) + end
        return "".join(form % tuple(row) for row in np.concatenate(self._columns, axis=1).tolist())


def _each(what: str, wheels: int) -> list[str]:
    return [f"{what}_{k + 1}" for k in range(wheels)]


def _ticks(log: Log, gear_ratio: float, ticks_per_revolution: int) -> np.ndarray:
    return np.round(log.wheel_angle * ticks_per_revolution * gear_ratio / (2 * np.pi))
