"""Layouts of published log formats, as data: the same tables a config would declare.

Signs, offsets and orders were checked against the logs themselves, by regression of the wheel
speeds on the twist of the tracked pose; the tests repeat it where the logs are present.
"""

from typing import Any

# Overhead camera of the Robotino logs: x right, y DOWN. X = -x, Y = y is right-handed as the robot
# is seen from above, and the heading is measured from there. The logged steps dx, dy are not used:
# they are body-frame steps at the same scale, but most steps above 5 pixels are cut short in them.
_CAMERA_2022: dict[str, Any] = {
    "pose_x": {"column": "xpos", "unit": "pixel", "scale": -1.0},
    "pose_y": {"column": "ypos", "unit": "pixel"},
    "pose_heading": {"column": "ang", "unit": "deg", "offset": -90.0},
}
# As its owners calibrated it, per axis. That motion seen so is too short by about 1.117 is for a
# fit to find, not for a reader to know.
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
_DRIVE_2021: dict[str, Any] = {
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
    # The same robot out of the camera's sight.
    "robotino2022_blind": {
        **_ROBOTINO_2022,
        "columns": {**_MOTORS_2022, **_TWIST_2022, "wheel_ticks": _TICKS_2022},
    },
    # Wheels in the air, speed steps. The tick columns are left out on purpose: they do not
    # accumulate in these files, so the angle comes from the reported speed.
    "robotino2022_motor": {**_ROBOTINO_2022, "columns": _MOTORS_2022},
    # Means of 13 samples each, 204 runs a file, told apart by the encoders that start again from 0.
    # There is no time: ticks over reported speed (which reads 1.3 % high) say 0.45 s a row. Angles
    # near the wrap are means of 0 and 360, hence wrong; so no jump of the heading is refused.
    "robotino2021": {
        **_ROBOTINO,
        "new_run": "ticks_restart",
        "row_period": 0.45,
        "max_heading_jump": 3.2,
        "metres_per_pixel": _METRES_PER_PIXEL,
        "columns": _DRIVE_2021,
    },
    # 69 runs over the whole field, one row each 0.5 s. The gyro is in deg/s, with the sign of the
    # heading. (Columns X_new, Y_new are the pixels shrunk by 0.895 towards the image centre.)
    "robotino2021_field": {
        **_ROBOTINO,
        "new_run": "time_restarts",
        "metres_per_pixel": _METRES_PER_PIXEL,
        "columns": {
            **_DRIVE_2021,
            "time": {"column": "Time, ms", "unit": "ms"},
            "gyro": {"column": "Z gyro", "unit": "deg/s"},
        },
    },
    # Speeds at the motor shaft; currents are magnitudes here as well. Where the reference steps,
    # the row is there twice, before and after the step.
    "robotino2021_motor": {
        "drop_repeated_time": True,
        "gear_ratio": 16,
        "current_is_signed": False,
        "columns": {
            "time": {"column": "time_s", "unit": "s"},
            "motor_speed": _motors("motor{}_output", "rad/s"),
            "motor_speed_command": _motors("motor{}_reference", "rad/s"),
            "current": _motors("motor{}_current", "A"),
        },
    },
    # Camera only: no wheel of these runs was logged. Millimetres already, axes of the image.
    "robotino2021_camera": {
        "columns": {
            "time": {"column": "time_s", "unit": "s"},
            "pose_x": {"column": "x_mm", "unit": "mm", "scale": -1.0},
            "pose_y": {"column": "y_mm", "unit": "mm"},
            "pose_heading": {"column": "angle_deg", "unit": "deg", "offset": -90.0},
        },
    },
    # No names: t, x, y, heading, then the ticks of each wheel since the last row, which count
    # backwards. With the sign turned, the wheels stand at azimuths 300, 60 and 180 deg.
    "omni3_optitrack": {
        "names_row": 0,
        "first_data_row": 1,
        "ticks_per_revolution": 1024,
        "gear_ratio": 12,
        "ticks_are_increments": True,
        "columns": {
            "time": {"column": 0, "unit": "s"},
            "pose_x": {"column": 1, "unit": "m"},
            "pose_y": {"column": 2, "unit": "m"},
            "pose_heading": {"column": 3, "unit": "rad"},
            "wheel_ticks": {"columns": [4, 5, 6], "unit": "tick", "scale": -1.0},
        },
    },
}
