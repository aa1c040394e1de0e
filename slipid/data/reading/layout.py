"""What a log file's layout is: which column holds which channel, in which unit."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import field
from typing import Annotated, Literal

from pydantic import (
    AliasChoices,
    BeforeValidator,
    Field,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
)
from pydantic.dataclasses import dataclass

from slipid.data.reading.units import converts, factor
from slipid.support.errors import did_you_mean
from slipid.support.toml_file import CLOSED, Positive

PER_WHEEL = {
    "wheel_ticks": "tick",
    "wheel_angle": "rad",
    "motor_angle": "rad",
    "wheel_speed": "rad/s",
    "motor_speed": "rad/s",
    "wheel_speed_command": "rad/s",
    "motor_speed_command": "rad/s",
    "current": "A",
    "motor_torque": "N*m",
    "wheel_torque": "N*m",
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
SEVERAL = {"pose_quaternion": "1"}
"""Channels with a number of columns of their own: x, y, z and w of a quaternion."""
CHANNELS: dict[str, str] = {**SINGLE, **SEVERAL, **PER_WHEEL}
"""Every channel a layout may name, with the unit it is turned into."""

Count = Annotated[int, Field(ge=0, strict=True)]


def several(value: object) -> object:
    """One value of a config, or a list of them, as a tuple."""
    return tuple(value) if isinstance(value, list | tuple) else (value,)


@dataclass(frozen=True, config=CLOSED)
class Channel:
    """Columns of one channel: value = (scale x cell + offset), in `unit`.

    Attributes:
        columns: their names, one per wheel where the channel has one; positions counted from 0 in
            a file without names.
        unit: the unit in the file; `pixel` is turned into metres by the layout.
        scale: a sign or a correction, one number for all columns or one for each.
        offset: added after the scale, in `unit`.
    """

    columns: Annotated[
        tuple[StrictStr | StrictInt, ...],
        BeforeValidator(several),
        Field(min_length=1, validation_alias=AliasChoices("columns", "column")),
    ]
    unit: StrictStr
    scale: Annotated[tuple[StrictFloat, ...], BeforeValidator(several)] = (1.0,)
    offset: StrictFloat = 0.0

    def __post_init__(self) -> None:
        if len(self.scale) not in (1, len(self.columns)):
            raise ValueError(
                f"{len(self.scale)} scales for {len(self.columns)} columns; expected as many"
            )


@dataclass(frozen=True, config=CLOSED, kw_only=True)
class SensorLayout:
    """What a layout says of the robot's sensors, whatever the files are.

    Attributes:
        ticks_per_revolution: ticks of the encoder in one turn of the *motor* shaft.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_are_increments: whether ticks count since the last sample.
        tick_bits: width of the tick counter, at which it wraps around.
        current_is_signed: False where currents are magnitudes.
        torque_constant: torque per current of the *motor* [N m/A], where a driver reports torques.
        max_gap: longest time between samples of a wheel [s]; a longer one is called a clock jump.
        max_pose_jump: longest way between two poses [m]; a run with a longer one is set aside.
        max_heading_jump: largest turn between two poses [rad]; the same.
    """

    ticks_per_revolution: Positive | None = None
    gear_ratio: Positive = 1.0
    ticks_are_increments: StrictBool = False
    tick_bits: Count = 32
    current_is_signed: StrictBool = True
    torque_constant: Positive | None = None
    max_gap: Positive = 1.0
    max_pose_jump: Positive = 0.5
    max_heading_jump: Positive = 1.6

    def lacks(self, channels: Collection[str]) -> str | None:
        """Return what some channels need of the layout and do not have; None where nothing."""
        if "wheel_ticks" in channels and self.ticks_per_revolution is None:
            return "wheel_ticks without ticks_per_revolution; expected ticks per turn of the motor"
        if {"motor_torque", "wheel_torque"} & {*channels} and self.torque_constant is None:
            wanted = "expected the motor's torque per current [N m/A]"
            return f"a torque without torque_constant; {wanted}"
        return None


def _pair(value: object) -> object:
    """Scales along x and y; one number counts for both."""
    if isinstance(value, list | tuple):
        return tuple(value)
    return None if value is None else (value, value)


@dataclass(frozen=True, config=CLOSED)
class Layout(SensorLayout):
    """How one kind of log file is laid out.

    Attributes:
        name: what messages call it.
        channels: which columns hold which channel.
        delimiter: character between cells; not used for Parquet.
        names_row: line that holds the column names, counted from 1; 0 where there is none.
        units_row: line that holds the units, which are then checked; 0 where there is none.
        first_data_row: line on which the numbers start.
        row_period: time between rows of a file without a time column [s].
        metres_per_pixel: scale of the camera along its x and its y [m].
        new_run: what tells that the next run starts inside the file.
        drop_repeated_time: whether to keep the last of rows with the same time; else such rows are
            refused.
        clock: "own" of a file of poses beside a run's own whose times are not the robot's: how far
            they are apart, and drift, is then found from the motion.
        beside: layouts of files that lie beside a run's own and hold more of its channels, by their
            names; `{stem}` stands for that of the run's own file without its suffix.
    """

    name: str
    channels: Mapping[str, Channel]
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    names_row: Count = 1
    units_row: Count = 0
    first_data_row: Count = 2
    row_period: Positive | None = None
    metres_per_pixel: Annotated[tuple[Positive, Positive] | None, BeforeValidator(_pair)] = None
    new_run: Literal["never", "time_restarts", "ticks_restart"] = "never"
    drop_repeated_time: StrictBool = False
    clock: Literal["robot", "own"] = "robot"
    beside: Mapping[str, "Layout"] = field(default_factory=dict)

    @property
    def columns(self) -> tuple[str | int, ...]:
        """Every column the layout uses, each once."""
        used = (column for channel in self.channels.values() for column in channel.columns)
        return tuple(dict.fromkeys(used))

    @property
    def holds(self) -> frozenset[str]:
        """Every channel of a run, those in files beside its own included."""
        beside = (name for other in self.beside.values() for name in other.channels)
        return frozenset((*self.channels, *beside))

    def to_si(self, channel: str) -> float:
        """Factor from the channel's unit to that of `CHANNELS`, for pixels the camera's scale.

        Raises:
            ValueError: the unit does not convert, or the scale of the camera is not given.
        """
        unit, target = self.channels[channel].unit, CHANNELS[channel]
        if channel in ("pose_x", "pose_y") and converts(unit, "pixel"):
            if self.metres_per_pixel is None:
                raise ValueError(f"{channel} is in '{unit}', but metres_per_pixel is not given")
            scale = self.metres_per_pixel[0 if channel == "pose_x" else 1]
            return factor(unit, "pixel") * scale
        return factor(unit, target)


def unknown(what: str, name: object, choices: Iterable[str]) -> str:
    """Message about a name that is none of the choices: the nearest of them, then all."""
    names = list(choices)
    return f"no {what} '{name}'{did_you_mean(name, names)}; expected one of {', '.join(names)}"
