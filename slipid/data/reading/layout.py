"""Layout of a log file: the columns and unit of each channel."""

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
"""Channels with a fixed number of columns: x, y, z and w of a quaternion."""
CHANNELS: dict[str, str] = {**SINGLE, **SEVERAL, **PER_WHEEL}
"""Every channel that a layout may name, with its SI unit."""
GROUPS = {
    "pose": ("pose_x", "pose_y", "pose_heading"),
    "twist_command": ("twist_command_x", "twist_command_y", "twist_command_yaw"),
}
"""Groups of channels that one message contains, by the name of the group in the layout of a bag."""
TURNS = ("wheel_ticks", "wheel_angle", "motor_angle", "wheel_speed", "motor_speed")
"""Channels from which the wheels' turns are known; the first available one counts."""

Count = Annotated[int, Field(ge=0, strict=True)]


def several(value: object) -> object:
    """Return one value of a config, or a list of values, as a tuple."""
    return tuple(value) if isinstance(value, list | tuple) else (value,)


@dataclass(frozen=True, config=CLOSED)
class Channel:
    """Columns of one channel: value = (scale x cell + offset), in `unit`.

    Attributes:
        columns: their names, one per wheel where the channel has one; positions counted from 0 in
            a file without names.
        unit: the unit in the file; `pixel` is converted to metres by the layout.
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
    """Properties of the robot's sensors that do not depend on the type of its files.

    Attributes:
        ticks_per_revolution: ticks of the encoder in one turn of the *motor* shaft.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_are_increments: whether ticks count since the last sample.
        tick_bits: width of the tick counter, at which it wraps around.
        current_is_signed: False where currents are magnitudes.
        torque_constant: torque per current of the *motor* [N m/A], where a driver reports torques.
        max_gap: longest time between samples of a wheel [s]; a longer one is refused.
        max_pose_jump: longest path between two poses [m]; a run with a longer one is left out.
        max_heading_jump: largest turn between two poses [rad]; a run with a larger one is left out.
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
        """Return a text about a channel or setting that channels need and that is absent, or None.

        `channels` are all channels of a run.
        """
        have = {*channels}
        if "wheel_ticks" in have and self.ticks_per_revolution is None:
            return "wheel_ticks without ticks_per_revolution; expected ticks per turn of the motor"
        if {"motor_torque", "wheel_torque"} & have and self.torque_constant is None:
            wanted = "expected the motor's torque per current [N m/A]"
            return f"a torque without torque_constant; {wanted}"
        turned = {"pose_heading", "pose_quaternion"} & have
        if 0 < len({"pose_x", "pose_y"} & have) + len(turned) != 3:
            return (
                "a pose in parts; expected x, y and either heading or quaternion, or none of them"
            )
        return None


def _pair(value: object) -> object:
    """Return scales along x and y; one number counts for both."""
    if isinstance(value, list | tuple):
        return tuple(value)
    return None if value is None else (value, value)


@dataclass(frozen=True, config=CLOSED)
class Layout(SensorLayout):
    """Layout of one type of log file.

    Attributes:
        channels: columns of each channel.
        delimiter: character between cells; not used for Parquet.
        names_row: line with the column names, counted from 1; 0 where there is none.
        units_row: line with the units, which are then checked; 0 where there is none.
        first_data_row: line of the first numbers.
        row_period: time between rows of a file without a time column [s].
        metres_per_pixel: scale of the camera along its x and its y [m].
        new_run: event that starts the next run inside the file.
        drop_repeated_time: whether to keep the last of rows with the same time; else such rows are
            refused.
        clock: "own" for a file of poses beside a run's own whose clock is not the robot's; its
            offset and drift are then found from the motion.
        beside: layouts of files beside a run's own that hold more of its channels, by their names;
            `{stem}` stands for the name of the run's own file without its suffix.
    """

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
        """Return every column that the layout uses, each once."""
        used = (column for channel in self.channels.values() for column in channel.columns)
        return tuple(dict.fromkeys(used))

    @property
    def holds(self) -> frozenset[str]:
        """Return every channel of a run, those in files beside its own included."""
        beside = (name for other in self.beside.values() for name in other.channels)
        return frozenset((*self.channels, *beside))

    def to_si(self, channel: str) -> float:
        """Return the factor from the channel's unit to SI; for pixels it has the camera's scale.

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
    """Return a message about a name that is not among the choices: similar ones, then all."""
    names = list(choices)
    return f"no {what} '{name}'{did_you_mean(name, names)}; expected one of {', '.join(names)}"
