"""What a log file's layout is: which column holds which channel, in which unit."""

from collections.abc import Mapping
from dataclasses import dataclass

from slipid.data.units import converts, factor

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
        if channel in ("pose_x", "pose_y") and converts(unit, "pixel"):
            if self.metres_per_pixel is None:
                raise ValueError(f"{channel} is in '{unit}', but metres_per_pixel is not given")
            scale = self.metres_per_pixel[0 if channel == "pose_x" else 1]
            return factor(unit, "pixel") * scale
        return factor(unit, target)
