"""Layouts of published log formats, as data: the same tables a config would declare.

Signs, offsets and orders were checked against the logs themselves, by regression of the wheel speeds
on the twist of the tracked pose; `tests/test_real_logs.py` repeats it where the logs are present.
"""

from typing import Any

# Overhead camera of the Robotino logs, as its owners calibrated it: x right, y DOWN. The pose is
# turned into a right-handed frame by X = -x, Y = y, and a heading measured from there. The scale is
# the nominal one; that it is too small by about 1.117 is for a fit to find, not for a reader to know.
_CAMERA_2022: dict[str, Any] = {
    "pose_x": {"column": "xpos", "unit": "pixel", "scale": -1.0},
    "pose_y": {"column": "ypos", "unit": "pixel"},
    "pose_heading": {"column": "ang", "unit": "deg", "offset": -90.0},
}
_METRES_PER_PIXEL = [1.8404619693756104e-3, 1.8371639251708984e-3]
_ROBOTINO: dict[str, Any] = {
    "delimiter": ";",
    "ticks_per_revolution": 2000,
    "gear_ratio": 16,
    "current_is_signed": False,
    "current_step": 1 / 39,
}


def _motors(pattern: str, unit: str, **more: Any) -> dict[str, Any]:
    return {"columns": [pattern.format(i) for i in (1, 2, 3)], "unit": unit, **more}


_ROBOTINO_2022: dict[str, Any] = {
    **_ROBOTINO,
    "names_row": 3,
    "units_row": 2,
    "first_data_row": 4,
}
_MOTORS_2022: dict[str, Any] = {
    "time": {"column": "t", "unit": "ms"},
    "motor_speed": _motors("m{}vel", "rad/s"),
    "motor_speed_command": _motors("m{}setvel", "rad/s"),
    "current": _motors("m{}cur", "A"),
}
_TWIST_2022: dict[str, Any] = {
    "twist_command_x": {"column": "xsetspeed", "unit": "m/s"},
    "twist_command_y": {"column": "ysetspeed", "unit": "m/s"},
    "twist_command_yaw": {"column": "setvel", "unit": "rad/s"},
}
_TICKS_2022 = _motors("m{}pos", "tick")
_COMMON_2021: dict[str, Any] = {
    "twist_command_x": {"column": "X axis speed, mm/s", "unit": "mm/s"},
    "twist_command_y": {"column": "Y axis speed, mm/s", "unit": "mm/s"},
    "twist_command_yaw": {"column": "Rotational speed, deg/s", "unit": "deg/s"},
    "wheel_ticks": _motors("Motor {} encoder, ticks", "tick"),
    "motor_speed": _motors("Motor {} velocity, rpm", "rpm"),
    "current": _motors("Motor {} current, A", "A"),
    "pose_x": {"column": "X coordinate, pixels", "unit": "pixel", "scale": -1.0},
    "pose_y": {"column": "Y coodinate, pixels", "unit": "pixel"},
    "pose_heading": {"column": "Angle, deg", "unit": "deg", "offset": -90.0},
}

PRESETS: dict[str, dict[str, Any]] = {
    # One run: straight drive under the overhead camera.
    "robotino2022": {
        **_ROBOTINO_2022,
        "metres_per_pixel": _METRES_PER_PIXEL,
        "columns": {**_MOTORS_2022, **_TWIST_2022, **_CAMERA_2022, "wheel_ticks": _TICKS_2022},
    },
    # Wheels in the air, speed steps. The tick columns are left out on purpose: they do not
    # accumulate in these files, so the angle comes from the reported speed.
    "robotino2022_motor": {**_ROBOTINO_2022, "columns": _MOTORS_2022},
}
