"""Text of log files, with slipid's own columns or with those of the published Robotino logs."""

from collections.abc import Sequence
from io import StringIO

import numpy as np

from slipid.data.log import Log
from slipid.data.reading.layout import PER_WHEEL
from slipid.data.reading.presets import preset
from slipid.support.content import Content

OPTIONAL = {
    "voltage": ("V", "%.2f"),
    "duty": ("1", "%.3f"),
    "bus_voltage": ("V", "%.2f"),
    "gyro": ("rad/s", "%.5f"),
}
"""Unit and number format of the optional channels of a log."""
_IMAGE = (1920, 1080)
"""Width and height of the camera's image [pixel]."""


def own_columns(wheels: int, more: Sequence[str]) -> Content:
    """Return the `columns` table of a config for files written by `own_csv`.

    `more` lists the channels of `OPTIONAL` that the file has.
    """
    columns: Content = {
        "time": {"column": "time", "unit": "s"},
        "twist_command_x": {"column": "command_x", "unit": "m/s"},
        "twist_command_y": {"column": "command_y", "unit": "m/s"},
        "twist_command_yaw": {"column": "command_yaw", "unit": "rad/s"},
        "wheel_ticks": {"columns": _each("ticks", wheels), "unit": "tick"},
        "current": {"columns": _each("current", wheels), "unit": "A"},
    }
    for channel in more:
        per_wheel = {"columns": _each(channel, wheels)}
        named: Content = per_wheel if channel in PER_WHEEL else {"column": channel}
        columns[channel] = named | {"unit": OPTIONAL[channel][0]}
    return columns | {
        "pose_x": {"column": "x", "unit": "mm"},
        "pose_y": {"column": "y", "unit": "mm"},
        "pose_heading": {"column": "heading", "unit": "deg"},
    }


def own_csv(log: Log, gear_ratio: float, ticks_per_revolution: int) -> str:
    """Return the text of a CSV file of a run, with the columns of slipid.

    The run must have commands, currents and poses; `ticks_per_revolution` is the number of encoder
    ticks per turn of the motor.
    """
    assert log.twist_command is not None
    assert log.current is not None
    assert log.pose is not None
    more = [channel for channel in OPTIONAL if getattr(log, channel) is not None]
    values = [
        (log.time[:, None], "%.4f"),
        (log.twist_command, "%.4f"),
        (_ticks(log, gear_ratio, ticks_per_revolution), "%d"),
        (log.current, "%.4f"),
        *((getattr(log, c).reshape(log.samples, -1), OPTIONAL[c][1]) for c in more),
        (1000 * log.pose[:, :2], "%.3f"),
        (np.degrees(log.pose[:, 2:]), "%.4f"),
    ]
    columns = own_columns(log.wheels, more).values()
    names = [name for c in columns for name in c.get("columns", [c.get("column")])]
    return _csv(",".join(names), values, ",", "\n")


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
    "m1cur;m2cur;m3cur;xcur;ycur;rotcur;xpos;ypos;ang;dx;dy;dang"
)


def robotino2022_csv(log: Log, gear_ratio: float, ticks_per_revolution: int) -> str:
    """Return the text of a run's file in the layout of the 2022 Robotino logs.

    The preset `robotino2022` reads such files. The run must have three wheels, commands, speeds,
    currents and poses. The origin of the poses is the centre of the image. The published logs also
    have columns of projected currents and of pose steps; these columns are zeros here.
    """
    assert log.twist_command is not None
    assert log.wheel_speed is not None
    assert log.wheel_speed_command is not None
    assert log.current is not None
    assert log.pose is not None
    if log.wheels != 3:
        raise ValueError(f"{log.name}: {log.wheels} wheels; expected three for the 2022 layout")
    scale = preset("robotino2022").metres_per_pixel
    assert scale is not None
    x = 0.5 * _IMAGE[0] - log.pose[:, 0] / scale[0]
    y = 0.5 * _IMAGE[1] + log.pose[:, 1] / scale[1]
    heading = np.mod(np.degrees(log.pose[:, 2]) + 90.0, 360.0)
    nothing = np.zeros((log.samples, 3))
    columns = [
        (1000 * log.time[:, None], "%.4f"),
        (log.twist_command, "%.6g"),
        (gear_ratio * log.wheel_speed_command, "%.6g"),
        (_ticks(log, gear_ratio, ticks_per_revolution), "%d"),
        (gear_ratio * log.wheel_speed, "%.6g"),
        (log.current, "%.6g"),
        (nothing, "%d"),
        (np.stack([x, y], axis=1), "%.3f"),
        (heading[:, None], "%.4f"),
        (nothing, "%d"),
    ]
    return _csv("\n".join([_WORDS_2022, _UNITS_2022, _NAMES_2022]), columns, ";", ";\n")


def _csv(header: str, columns: Sequence[tuple[np.ndarray, str]], delimiter: str, end: str) -> str:
    """Return the text of a CSV file: a header, then columns, each with its number format."""
    forms = [form for values, form in columns for _ in range(values.shape[1])]
    table = np.concatenate([values for values, _ in columns], axis=1)
    text = StringIO()
    np.savetxt(text, table, forms, delimiter, newline=end, header=header, comments="")
    return text.getvalue()


def _each(what: str, wheels: int) -> list[str]:
    return [f"{what}_{k + 1}" for k in range(wheels)]


def _ticks(log: Log, gear_ratio: float, ticks_per_revolution: int) -> np.ndarray:
    return np.round(log.wheel_angle * ticks_per_revolution * gear_ratio / (2 * np.pi))
