"""Layout of a log file: the columns and unit of each channel."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import field
from typing import Annotated, Literal

from pydantic import (
    AliasChoices,
    BeforeValidator,
    Field,
    StrictBool,
    StrictStr,
)
from pydantic.dataclasses import dataclass

from slipid.data.reading.units import converts, factor
from slipid.support.errors import did_you_mean, shown
from slipid.support.quantities import (
    Bounds,
    CellLength,
    GearRatio,
    Length,
    Offset,
    Scale,
    Seconds,
    TicksPerTurn,
)
from slipid.support.toml_file import CLOSED

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
"""Channels with a column for each wheel or motor, and their SI units."""
SINGLE = {
    "time": "s",
    "twist_x": "m/s",
    "twist_y": "m/s",
    "twist_yaw": "rad/s",
    "twist_command_x": "m/s",
    "twist_command_y": "m/s",
    "twist_command_yaw": "rad/s",
    "bus_voltage": "V",
    "gyro": "rad/s",
    "steering_angle": "rad",
    "pose_x": "m",
    "pose_y": "m",
    "pose_heading": "rad",
}
"""Channels with a single column, and their SI units."""
SEVERAL = {"pose_quaternion": "1"}
"""Channels with a fixed number of columns, and their SI units: x, y, z and w of a quaternion."""
CHANNELS: dict[str, str] = {**SINGLE, **SEVERAL, **PER_WHEEL}
"""Every channel that a layout may name, with its SI unit."""
GROUPS = {
    "pose": ("pose_x", "pose_y", "pose_heading"),
    "twist": ("twist_x", "twist_y", "twist_yaw"),
    "twist_command": ("twist_command_x", "twist_command_y", "twist_command_yaw"),
}
"""Groups of channels that one message contains, keyed by the group's name in a bag layout."""
AT_RIM = {"wheel_angle": "m", "wheel_speed": "m/s", "wheel_speed_command": "m/s"}
"""Channels of wheels that may be logged as lengths at the rim, and SI units of these lengths."""
TURNS = ("wheel_ticks", "wheel_angle", "motor_angle", "wheel_speed", "motor_speed")
"""Channels from which the turns of the wheels can be computed; the first available one is used."""

RowNumber = Annotated[int, Bounds(0, 10**6)]
"""Number of a row of a file, counted from 1; 0 for none."""
Position = Annotated[int, Bounds(0, 10**5)]
"""Position of a column, counted from 0."""


def several(value: object) -> object:
    """Return one value of a config, or a list of values, as a tuple."""
    return tuple(value) if isinstance(value, list | tuple) else (value,)


@dataclass(frozen=True, config=CLOSED)
class Channel:
    """Columns of one channel: value = (scale x cell + offset), in `unit`.

    Attributes:
        columns: names of the columns (one per wheel for channels of wheels; for a time, a second
            one may have nanoseconds), or, in a file without column names, their positions counted
            from 0.
        unit: unit of the numbers in the file; `pixel` is converted to metres by `metres_per_pixel`
            of the layout.
        scale: factor on the numbers, such as -1 for a reversed sign: one number for all columns, or
            one per column.
        offset: number that is added after scaling, in `unit`.
    """

    columns: Annotated[
        tuple[StrictStr | Position, ...],
        BeforeValidator(several),
        Field(min_length=1, validation_alias=AliasChoices("columns", "column")),
    ]
    unit: StrictStr
    scale: Annotated[tuple[Scale, ...], BeforeValidator(several)] = (1.0,)
    offset: Offset = 0.0

    def __post_init__(self) -> None:
        if len(self.scale) not in (1, len(self.columns)):
            raise ValueError(
                f"{len(self.scale)} scales for {len(self.columns)} columns; expected one scale, "
                "or one per column"
            )


@dataclass(frozen=True, config=CLOSED, kw_only=True)
class SensorLayout:
    """Properties of the robot's sensors that do not depend on the type of its files.

    Attributes:
        ticks_per_revolution: encoder ticks in one turn of the *motor* shaft.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_are_increments: true if each row has the ticks since the previous row, not the total
            count.
        tick_bits: number of bits of the tick counter, after which it wraps around.
        current_is_signed: false if the logged currents are magnitudes.
        torque_constant: torque of the *motor* per current [N m/A], by which logged torques become
            currents. Without it, a fit compares torques with those of its contact and friction, and
            fits nothing electric.
        wheel_radius: radius by which travels and speeds of wheels at the rim are divided, if their
            unit is one of length [m]; by default that of the robot in the config.
        max_gap: longest allowed time between two samples of a wheel [s]; a log with a longer gap is
            an error.
        max_pose_jump: longest allowed distance between two successive poses [m]; a run with a
            longer one is left out.
        max_heading_jump: largest allowed turn between two successive poses [rad]; a run with a
            larger one is left out.
    """

    ticks_per_revolution: TicksPerTurn | None = None
    gear_ratio: GearRatio = 1.0
    ticks_are_increments: StrictBool = False
    tick_bits: Annotated[int, Bounds(1, 64)] = 32
    current_is_signed: StrictBool = True
    torque_constant: Annotated[float, Bounds(1e-6, 1e4, "N m/A")] | None = None
    wheel_radius: Length | None = None
    max_gap: Seconds = 1.0
    max_pose_jump: Annotated[float, Bounds(1e-6, 1e6, "m")] = 0.5
    max_heading_jump: Annotated[float, Bounds(1e-6, 1e6, "rad")] = 1.6

    def factor(self, channel: str, unit: str) -> float:
        """Return the factor from a unit to the SI unit of a channel.

        Raises:
            ValueError: the unit cannot be converted, or needs `wheel_radius`, which is not given.
        """
        if channel not in AT_RIM or not converts(unit, AT_RIM[channel]):
            return factor(unit, CHANNELS[channel])
        if self.wheel_radius is None:
            raise ValueError(f"{channel} is in '{unit}', but wheel_radius [m] is not given")
        return factor(unit, AT_RIM[channel]) / self.wheel_radius

    def note(self, channel: str, unit: str) -> list[str]:
        """Return a note about a channel that was divided by the wheel radius."""
        if channel not in AT_RIM or not converts(unit, AT_RIM[channel]):
            return []
        return [f"{channel} in {unit} was divided by a wheel radius of {self.wheel_radius:g} m"]

    def lacks(self, channels: Collection[str]) -> str | None:
        """Return a message about a missing channel or setting that some channels need, or None.

        `channels` are all channels of a run.
        """
        have = {*channels}
        if "wheel_ticks" in have and self.ticks_per_revolution is None:
            return "wheel_ticks without ticks_per_revolution; expected ticks per turn of the motor"
        if len({"pose_x", "pose_y"} & have) == 1:
            return "only one of pose_x and pose_y; expected both or neither"
        if {"pose_heading", "pose_quaternion"} <= have:
            return "both pose_heading and pose_quaternion; expected only one of them"
        return None


def _pair(value: object) -> object:
    """Return the scales along x and y as a tuple; a single number is used for both."""
    if isinstance(value, list | tuple):
        return tuple(value)
    return None if value is None else (value, value)


@dataclass(frozen=True, config=CLOSED)
class Layout(SensorLayout):
    """Layout of one type of log file.

    Attributes:
        channels: columns of each channel, keyed by the name of the channel.
        delimiter: character between the cells of a CSV file; not used for Parquet.
        names_row: number of the line with the column names, counted from 1; 0 if there is none.
        units_row: number of the line with the units, which are checked against this layout; 0 if
            there is none.
        first_data_row: number of the first line with data, counted from 1.
        row_period: time between rows of a file without a time column [s].
        metres_per_pixel: length on the floor of one pixel along the x and y axes of the picture
            [m]; one number if both are equal.
        new_run: event that marks the start of another run in the same file.
        drop_repeated_time: true to keep only the last of several rows with the same time; by
            default such rows are an error.
        clock: "own" if an additional file of poses was logged with another clock than that of the
            robot; the offset and drift of this clock are then estimated from the motion.
        beside: layouts of additional files in the same folder with more channels of the same run,
            keyed by the name of the file; `{stem}` in a name stands for the name of the run's main
            file without its suffix.
    """

    channels: Mapping[str, Channel]
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    names_row: RowNumber = 1
    units_row: RowNumber = 0
    first_data_row: RowNumber = 2
    row_period: Seconds | None = None
    metres_per_pixel: Annotated[tuple[CellLength, CellLength] | None, BeforeValidator(_pair)] = None
    new_run: Literal["never", "time_restarts", "ticks_restart"] = "never"
    drop_repeated_time: StrictBool = False
    clock: Literal["robot", "own"] = "robot"
    beside: Mapping[str, "Layout"] = field(default_factory=dict)

    @property
    def columns(self) -> tuple[str | int, ...]:
        """Names or positions of all columns that the layout uses, without duplicates."""
        used = (column for channel in self.channels.values() for column in channel.columns)
        return tuple(dict.fromkeys(used))

    @property
    def holds(self) -> frozenset[str]:
        """Names of all channels of a run, including those in additional files."""
        beside = (name for other in self.beside.values() for name in other.channels)
        return frozenset((*self.channels, *beside))

    def to_si(self, channel: str) -> float:
        """Return the factor from the unit of a channel to SI units.

        For a channel in pixels, the factor includes `metres_per_pixel`.

        Raises:
            ValueError: the unit cannot be converted, or `metres_per_pixel` is needed and not given.
        """
        unit = self.channels[channel].unit
        if channel in ("pose_x", "pose_y") and converts(unit, "pixel"):
            if self.metres_per_pixel is None:
                raise ValueError(f"{channel} is in '{unit}', but metres_per_pixel is not given")
            scale = self.metres_per_pixel[0 if channel == "pose_x" else 1]
            return factor(unit, "pixel") * scale
        return self.factor(channel, unit)


def unknown(what: str, name: object, choices: Iterable[str]) -> str:
    """Return a message about a name that is not among the choices: similar ones, then all."""
    names = list(choices)
    text = name if isinstance(name, str) else shown(name)
    return f"no {what} '{text}'{did_you_mean(text, names)}; expected one of {', '.join(names)}"
