"""Layouts of log files: presets for published formats, and layouts declared in a config.

Signs, offsets and orders of the presets were checked against the published logs, by regression of
the wheel speeds on the twist of the tracked pose; the tests repeat this if the logs are present.
"""

from collections.abc import Mapping
from dataclasses import fields, replace

from slipid.data.reading.layout import CHANNELS, PER_WHEEL, SINGLE, Channel, Layout, unknown
from slipid.data.reading.units import same_unit
from slipid.support.errors import DataError, shown
from slipid.support.quantities import inside
from slipid.support.toml_file import checked


def preset(name: str) -> Layout:
    """Return the layout of a published log format; raise `DataError` if the name is unknown."""
    if name not in PRESETS:
        raise DataError(f"preset: {unknown('format', name, PRESETS)}")
    return PRESETS[name]


def _one(column: str | int, unit: str, scale: float = 1.0, offset: float = 0.0) -> Channel:
    return Channel((column,), unit, (scale,), offset)


def _motors(pattern: str, unit: str) -> Channel:
    return Channel(tuple(pattern.format(i) for i in (1, 2, 3)), unit)


# The overhead camera of the Robotino logs has x to the right and y DOWN. X = -x, Y = y is a
# right-handed frame seen from above, in which the heading is measured. The logged columns dx, dy
# are not used: they are steps in the body frame at the same scale, but most steps above 5 pixels
# are clipped.
def _camera(x: str, y: str, angle: str, unit: str = "pixel") -> dict[str, Channel]:
    return {
        "pose_x": _one(x, unit, scale=-1.0),
        "pose_y": _one(y, unit),
        "pose_heading": _one(angle, "deg", offset=-90.0),
    }


# Scale of the camera along x and y, as its owners calibrated it. At this scale, logged motion is
# too short by a factor of about 1.117, which is not corrected here, because a fit estimates it.
_METRES_PER_PIXEL = (1.8404619693756104e-3, 1.8371639251708984e-3)
_ROBOTINO = Layout(
    channels={},
    delimiter=";",
    ticks_per_revolution=2000.0,
    gear_ratio=16.0,
    current_is_signed=False,
)
_ROBOTINO_2022 = replace(_ROBOTINO, names_row=3, units_row=2, first_data_row=4)
_MOTORS_2022 = {
    "time": _one("t", "ms"),
    "motor_speed": _motors("m{}vel", "rad/s"),
    "motor_speed_command": _motors("m{}setvel", "rad/s"),
    "current": _motors("m{}cur", "A"),
}
_DRIVE_2022 = {
    **_MOTORS_2022,
    "twist_command_x": _one("xsetspeed", "m/s"),
    "twist_command_y": _one("ysetspeed", "m/s"),
    "twist_command_yaw": _one("setvel", "rad/s"),
    "wheel_ticks": _motors("m{}pos", "tick"),
}
_DRIVE_2021 = {
    "twist_command_x": _one("X axis speed, mm/s", "mm/s"),
    "twist_command_y": _one("Y axis speed, mm/s", "mm/s"),
    "twist_command_yaw": _one("Rotational speed, deg/s", "deg/s"),
    "wheel_ticks": _motors("Motor {} encoder, ticks", "tick"),
    "motor_speed": _motors("Motor {} velocity, rpm", "rpm"),
    "current": _motors("Motor {} current, A", "A"),
    **_camera("X coordinate, pixels", "Y coodinate, pixels", "Angle, deg"),
}

PRESETS = {
    # One run per file: a straight drive under the overhead camera.
    "robotino2022": replace(
        _ROBOTINO_2022,
        metres_per_pixel=_METRES_PER_PIXEL,
        channels=_DRIVE_2022 | _camera("xpos", "ypos", "ang"),
    ),
    # The same robot out of sight of the camera, hence without poses.
    "robotino2022_blind": replace(_ROBOTINO_2022, channels=_DRIVE_2022),
    # Speed steps with the wheels in the air. The tick columns are left out on purpose: they do not
    # accumulate in these files, so the wheel angle is integrated from the reported speed.
    "robotino2022_motor": replace(_ROBOTINO_2022, channels=_MOTORS_2022),
    # Each row is a mean of 13 samples; a file has 204 runs, at whose start the encoders restart
    # from 0. There is no time column: ticks over reported speed (which is 1.3 % too high) give 0.45
    # s between rows. Headings near the wrap-around are wrong, since they are means of values near 0
    # and values near 360 deg; so the largest allowed jump of the heading is more than half a turn.
    "robotino2021": replace(
        _ROBOTINO,
        new_run="ticks_restart",
        row_period=0.45,
        max_heading_jump=3.2,
        metres_per_pixel=_METRES_PER_PIXEL,
        channels=_DRIVE_2021,
    ),
    # 69 runs over the whole field, with a row every 0.5 s. The gyro is in deg/s and has the sign of
    # the heading. (Columns X_new, Y_new, not used here, are the pixel coordinates shrunk by a
    # factor of 0.895 towards the image centre.)
    "robotino2021_field": replace(
        _ROBOTINO,
        new_run="time_restarts",
        metres_per_pixel=_METRES_PER_PIXEL,
        channels=_DRIVE_2021 | {"time": _one("Time, ms", "ms"), "gyro": _one("Z gyro", "deg/s")},
    ),
    # Speeds are at the motor shaft; currents are magnitudes here, too. Where the reference speed
    # steps, two rows have the same time, one before and one after the step.
    "robotino2021_motor": Layout(
        drop_repeated_time=True,
        gear_ratio=16.0,
        current_is_signed=False,
        channels={
            "time": _one("time_s", "s"),
            "motor_speed": _motors("motor{}_output", "rad/s"),
            "motor_speed_command": _motors("motor{}_reference", "rad/s"),
            "current": _motors("motor{}_current", "A"),
        },
    ),
    # Only the camera was logged in these runs, not the wheels. Positions are in mm along the axes
    # of the image.
    "robotino2021_camera": Layout(
        channels={"time": _one("time_s", "s"), **_camera("x_mm", "y_mm", "angle_deg", "mm")},
    ),
    # The file has no column names. The columns are time, x, y, heading, then the ticks of each
    # wheel since the previous row, with reversed sign. With the sign corrected, the wheels are at
    # azimuths of 300, 60 and 180 deg.
    "omni3_optitrack": Layout(
        names_row=0,
        first_data_row=1,
        ticks_per_revolution=1024.0,
        gear_ratio=12.0,
        ticks_are_increments=True,
        channels={
            "time": _one(0, "s"),
            "pose_x": _one(1, "m"),
            "pose_y": _one(2, "m"),
            "pose_heading": _one(3, "rad"),
            "wheel_ticks": Channel((4, 5, 6), "tick", scale=(-1.0,)),
        },
    ),
    # Files that `slipid track` writes for a video whose recording was started by hand.
    "tracked": Layout(
        clock="own",
        channels={
            "time": _one("time", "s"),
            "pose_x": _one("x", "m"),
            "pose_y": _one("y", "m"),
            "pose_heading": _one("heading", "rad"),
        },
    ),
}
"""Layouts of published log formats, keyed by the name of the preset."""
POSES = ("pose_x", "pose_y", "pose_heading", "pose_quaternion")
"""Channels of the pose, which may have been logged with another clock than the wheels."""
_SETTINGS = [f.name for f in fields(Layout) if f.name not in ("channels", "beside")]


def layout(table: Mapping[str, object]) -> Layout:
    """Return the layout for `read_runs` from the content of a table `[layouts.NAME]` of a config.

    Raises:
        DataError: unknown key, channel, unit or format, wrong dimension, wrong type.
    """
    return declared_layout(table, "layout")


def declared_layout(table: Mapping[str, object], where: str) -> Layout:
    """Return the layout that a table of a config declares.

    The key `format` names a preset, whose settings the other keys override. `columns` maps each
    channel to `{columns = [...] or column = ..., unit, scale, offset}`, or to `false`, which
    removes a channel of the preset. `beside` has a layout for each further file of a run.

    Args:
        table: content of the section.
        where: name of the section in messages, such as `robotino.toml [layout]`.

    Raises:
        DataError: unknown key, channel, unit or format, wrong dimension, wrong type.
    """
    given = dict(table)
    others = given.pop("beside", {})
    if not isinstance(others, dict) or not all(isinstance(v, dict) for v in others.values()):
        raise DataError(
            f"{where} beside: {shown(others)}; expected a table of layouts, keyed by file names"
        )
    layout = _declared_file(given, where)
    beside = dict(layout.beside)
    for name, one in others.items():
        try:
            inside(name)
        except ValueError as error:
            raise DataError(f"{where} beside: {error}") from error
        beside[name] = _declared_file(one, f"{where} beside.'{name}'")
    layout = replace(layout, beside=beside)
    if problem := _problem(layout):
        raise DataError(f"{where}: {problem}")
    return layout


def _declared_file(table: Mapping[str, object], where: str) -> Layout:
    """Return the layout of a single file from its table; `where` is its name in messages."""
    given = dict(table)
    name, columns = given.pop("format", None), given.pop("columns", {})
    if name is not None and not (isinstance(name, str) and name in PRESETS):
        raise DataError(f"{where}: {unknown('format', name, PRESETS)}")
    for key in given:
        if key not in _SETTINGS:
            known = ["format", "columns", "beside", *_SETTINGS]
            raise DataError(f"{where}: {unknown('key', key, known)}")
    if not isinstance(columns, dict):
        raise DataError(f"{where} columns: {shown(columns)}; expected a table of channels")
    base = Layout({}) if name is None else PRESETS[name]
    channels = dict(base.channels)
    for channel, spec in columns.items():
        if channel not in CHANNELS:
            raise DataError(f"{where} columns.{channel}: {unknown('channel', channel, CHANNELS)}")
        channels.pop(channel, None)
        if spec is not False:
            channels[channel] = checked(f"{where} columns.{channel}", spec, Channel)
    layout = replace(checked(where, {**vars(base), **given}, Layout), channels=channels)
    if problem := _file_problem(layout):
        raise DataError(f"{where}: {problem}")
    for channel in channels:
        try:
            layout.to_si(channel)
        except ValueError as error:
            raise DataError(f"{where} columns.{channel}: {error}") from error
    return layout


def _file_problem(layout: Layout) -> str | None:
    """Return a message about a contradiction in the layout of a single file, or None."""
    have = layout.channels
    single = {name: len(c.columns) for name, c in have.items() if name in SINGLE}
    if not have:
        return f"no columns; expected a table of channels ({', '.join(CHANNELS)})"
    if "time" not in have and layout.row_period is None:
        return "no time column; expected a channel 'time', or row_period in seconds"
    if single.get("time") == 2 and not same_unit(have["time"].unit, "s"):
        return (
            f"columns.time: seconds and nanoseconds in '{have['time'].unit}'; expected unit = 's'"
        )
    if many := [n for n, count in single.items() if count != 1 and (n, count) != ("time", 2)]:
        return f"columns.{many[0]}: {single[many[0]]} columns; expected one column"
    if "pose_quaternion" in have and len(have["pose_quaternion"].columns) != 4:
        count = len(have["pose_quaternion"].columns)
        return f"columns.pose_quaternion: {count} columns; expected four: x, y, z and w"
    if layout.first_data_row <= max(layout.names_row, layout.units_row):
        return (
            f"first_data_row {layout.first_data_row}; expected a row below those of names and units"
        )
    if not layout.names_row and any(isinstance(c, str) for c in layout.columns):
        return "columns are given by name, but names_row is 0; expected positions counted from 0"
    return None


def _problem(layout: Layout) -> str | None:
    """Return a message about a contradiction between the layouts of a run's files, or None."""
    files = [layout, *layout.beside.values()]
    names = [name for one in files for name in one.channels if name != "time"]
    if twice := [name for name in names if names.count(name) > 1]:
        return f"channel '{twice[0]}' is in two files; expected it in only one of them"
    have = {name: c for one in files for name, c in one.channels.items()}
    counts = {name: len(c.columns) for name, c in have.items() if name in PER_WHEEL}
    if len(set(counts.values())) > 1:
        return (
            f"channels have different numbers of wheels: {counts}; expected the same number in all"
        )
    if lacking := layout.lacks(have):
        return lacking
    for name, one in [("the robot's own file", layout), *layout.beside.items()]:
        if one.clock == "own" and not set(one.channels) <= {"time", *POSES}:
            return f"{name}: clock = 'own'; allowed only for a file with poses and no other channel"
    if layout.beside and layout.new_run != "never":
        return (
            f"new_run = '{layout.new_run}' together with `beside`; expected new_run = 'never', "
            "one run per file"
        )
    return None
